//! Progress and interruption of long work, seen from outside.

use crate::EvalError;

/// Receives the progress of long work, and can stop it.
///
/// `()` is the monitor of unobserved work.
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

    /// Begins a part of the work, `total` units long: "simulating", 3200, "frames". Its monitor
    /// counts those units and stops with this one. By default they are not counted.
    fn part<'a>(&'a self, _name: &str, _total: u64, _unit: &'static str) -> Box<dyn Monitor + 'a> {
        Box::new(Uncounted(self))
    }
}

/// The monitor of a simulation of so many frames; `None` where nothing is simulated.
pub(crate) fn simulating<'a>(
    monitor: &'a dyn Monitor,
    frames: Option<u64>,
) -> Box<dyn Monitor + 'a> {
    match frames {
        Some(frames) => monitor.part("simulating", frames, "frames"),
        None => Box::new(Uncounted(monitor)),
    }
}

/// A part of the work whose units are not counted.
struct Uncounted<'a, M: ?Sized>(&'a M);

impl<M: Monitor + ?Sized> Monitor for Uncounted<'_, M> {
    fn advance(&self, _: u64) {}

    fn is_stopped(&self) -> bool {
        self.0.is_stopped()
    }

    // Without this, each nested part would have another type, without end.
    fn part<'a>(&'a self, _: &str, _: u64, _: &'static str) -> Box<dyn Monitor + 'a> {
        Box::new(Uncounted(self.0))
    }
}

impl Monitor for () {
    fn advance(&self, _: u64) {}

    fn is_stopped(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Stopped;

    impl Monitor for Stopped {
        fn advance(&self, _: u64) {
            unreachable!("a part counts for itself")
        }

        fn is_stopped(&self) -> bool {
            true
        }
    }

    #[test]
    fn a_part_ends_with_the_whole_and_counts_for_itself() {
        let part = Stopped.part("simulating", 10, "frames");
        part.advance(1);
        assert!(matches!(part.check(), Err(EvalError::Stopped)));
        assert!(().part("simulating", 10, "frames").check().is_ok());
    }
}
