//! Candidates: the alternatives that a driver compared before its decision.

use gump_geometry::Pose;
use gump_nuplan::closed_loop::Driver;

use crate::Decision;

/// A driver that reports the candidates of its last step.
pub trait Explain: Driver {
    /// All candidates of its last step, one of them chosen; empty before the first.
    fn candidates(&self) -> Vec<Candidate>;

    /// Details of the last step, of drivers that use rollouts.
    fn decision(&self) -> Option<&Decision> {
        None
    }
}

/// One alternative of a driver.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// A short description.
    pub name: String,
    /// Whether it was chosen.
    pub chosen: bool,
    /// Its score; `None` for drivers that do not compare.
    pub score: Option<f64>,
    /// The parts of the score, by name.
    pub parts: Vec<(&'static str, f64)>,
    /// Its path: rear axle, world frame; may be empty.
    pub poses: Vec<Pose>,
}

impl Candidate {
    /// The only candidate of a driver without alternatives.
    pub fn alone(name: &str, poses: Vec<Pose>) -> Self {
        Self {
            name: name.to_owned(),
            chosen: true,
            score: None,
            parts: Vec::new(),
            poses,
        }
    }
}
