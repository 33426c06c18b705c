//! Scenarios that are left out because the benchmark is not defined on them.

use gump_wosac::motion::MotionProblem;
use gump_wosac::realism::WosacError;

use crate::EvalError;

/// The scenarios of an evaluation whose recordings have another length or rate than the benchmark.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Exclusions {
    reasons: Vec<String>,
}

impl Exclusions {
    /// One sentence for each of them, in their order.
    pub fn reasons(&self) -> &[String] {
        &self.reasons
    }

    /// Returns the result of a scenario; `None`, with the reason noted, if its recording has another
    /// length or rate.
    ///
    /// Error: any other error of the scenario.
    pub(crate) fn sift<T>(&mut self, scored: Result<T, EvalError>) -> Result<Option<T>, EvalError> {
        match scored {
            Err(error) if is_of_another_length(&error) => {
                self.reasons.push(error.sentence());
                Ok(None)
            }
            scored => scored.map(Some),
        }
    }
}

fn is_of_another_length(error: &EvalError) -> bool {
    match error.cause() {
        EvalError::Realism(error) => matches!(error, WosacError::Clock { .. }),
        EvalError::Motion(error) => matches!(
            error.problem,
            MotionProblem::ShortLog { .. } | MotionProblem::TimeStep { .. }
        ),
        _ => false,
    }
}
