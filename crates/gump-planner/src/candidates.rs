//! Candidates: what a driver weighed before it decided.

use gump_geometry::Pose;
use gump_nuplan::closed_loop::Driver;

use crate::Decision;

/// A driver that can say what it weighed in its last step.
pub trait Explain: Driver {
    /// All candidates of its last step, one of them chosen; empty before the first.
    fn candidates(&self) -> Vec<Candidate>;

    /// What the last step rests on, from those who imagine before they decide.
    fn decision(&self) -> Option<&Decision> {
        None
    }
}

/// One thing a driver might have done.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// What it is, in a few words.
    pub name: String,
    /// Whether it was done.
    pub chosen: bool,
    /// How good it was found; `None` where nothing is compared.
    pub score: Option<f64>,
    /// What the score is made of, by name.
    pub parts: Vec<(&'static str, f64)>,
    /// Where it leads: rear axle, world frame; may be empty.
    pub poses: Vec<Pose>,
}

impl Candidate {
    /// What was done without an alternative.
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
