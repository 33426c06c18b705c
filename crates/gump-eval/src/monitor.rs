//! Progress and interruption of long work, seen from outside.

use crate::EvalError;

/// Hears how far long work has come, and may end it.
///
/// `()` is the monitor of work that nobody watches.
pub trait Monitor: Sync {
    /// `n` more units are done: scenarios, or frames of a simulation.
    fn advance(&self, n: u64);

    /// Whether the work should end soon.
    fn is_stopped(&self) -> bool;

    /// Ends the work if it should end.
    ///
    /// # Errors
    /// [`EvalError::Stopped`] if it should.
    fn check(&self) -> Result<(), EvalError> {
        match self.is_stopped() {
            true => Err(EvalError::Stopped),
            false => Ok(()),
        }
    }
}

impl Monitor for () {
    fn advance(&self, _: u64) {}

    fn is_stopped(&self) -> bool {
        false
    }
}
