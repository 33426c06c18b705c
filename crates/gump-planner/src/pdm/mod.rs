//! PDM-Closed: fifteen rule-based proposals, each simulated and scored against a constant-velocity
//! forecast; the best one is followed.
//!
//! Start with [`PdmClosed`]. `propose` makes the proposals on lines along the route, `track`
//! simulates them, `score` scores them with the road of `ground` and the objects of `forecast`.
//!
//! The behaviour equals that of the authors' code, including oddities; comments mark them where
//! they matter. Only where outlines of lanes are derived, which nuPlan's are not, the shoulder beside them is
//! road here. Source: Dauner et al. 2023, "Parting with Misconceptions about Learning-based
//! Vehicle Motion Planning", and the released tuPlan Garage; agrees with its goldens.

pub(crate) mod comfort;
pub(crate) mod forecast;
pub(crate) mod ground;
pub(crate) mod lane_change;
pub(crate) mod propose;
#[cfg(test)]
mod scene_tests;
pub(crate) mod score;
pub(crate) mod state;
#[cfg(test)]
mod tests;
pub(crate) mod track;

pub use lane_change::Side;
pub use score::PdmScore;

use gump_nuplan::closed_loop::{Driver, PlannerInitialization, PlannerInput};
use gump_nuplan::tracking::Trajectory;
use gump_rollout::BoxError;
use gump_rollout::worlds::IdmConfig;
use gump_scene::EgoState;

use crate::candidates::{Candidate, Explain};
use crate::{PlanError, ProposalKind};
use comfort::ComfortFilters;
use propose::{DT, Proposal};
use score::Judge;
use state::{State, brake, trajectory};
use track::Tracker;

// tuPlan Garage's values: 4 s, 8 s, 2 s and 5 m/s.

/// Steps of a proposal.
pub(crate) const STEPS: usize = 40;
/// Steps of the trajectory that is followed.
pub(crate) const TRAJECTORY_STEPS: usize = 80;
/// A collision sooner than this, in steps, triggers the brake ...
pub(crate) const BRAKE_STEPS: usize = 20;
/// ... if the ego is not faster than this, metres per second.
pub(crate) const BRAKE_SPEED: f64 = 5.0;

/// Settings of the proposals.
#[derive(Clone, Debug, PartialEq)]
pub struct PdmConfig {
    /// Desired speeds as shares of the limit.
    pub speed_fractions: Vec<f64>,
    /// Lines to follow, metres to the left of the centre.
    pub lateral_offsets: Vec<f64>,
    /// The limit of a lane that states neither a limit nor its type, metres per second.
    pub fallback_speed: f64,
    /// The car-following law; only its two accelerations are used as limits.
    pub law: IdmConfig,
}

impl Default for PdmConfig {
    /// The released configuration.
    fn default() -> Self {
        Self {
            speed_fractions: vec![0.2, 0.4, 0.6, 0.8, 1.0],
            lateral_offsets: vec![0.0, -1.0, 1.0],
            fallback_speed: 15.0,
            law: IdmConfig {
                min_gap: 1.0,
                headway: 1.5,
                max_acceleration: 1.5,
                max_deceleration: 3.0,
                exponent: 10.0,
                ..IdmConfig::default()
            },
        }
    }
}

/// The planner PDM-Closed.
#[derive(Debug)]
pub struct PdmClosed {
    config: PdmConfig,
    state: Option<State>,
    tracker: Tracker,
    comfort: ComfortFilters,
    thought: Thought,
}

/// The state of the last step.
#[derive(Clone, Debug, Default)]
pub(crate) struct Thought {
    pub(crate) proposals: Vec<Proposal>,
    pub(crate) drives: Vec<Vec<EgoState>>,
    pub(crate) scores: Vec<PdmScore>,
    pub(crate) best: usize,
    pub(crate) braked: bool,
}

impl Default for PdmClosed {
    fn default() -> Self {
        Self::new(PdmConfig::default()).expect("the released configuration is valid")
    }
}

impl PdmClosed {
    /// A planner with these proposals.
    ///
    /// # Errors
    /// [`PlanError::Parameter`] for a number out of its range.
    pub fn new(config: PdmConfig) -> Result<Self, PlanError> {
        check(&config)?;
        Ok(Self {
            config,
            state: None,
            tracker: Tracker::new(STEPS),
            comfort: ComfortFilters::new(STEPS + 1, DT),
            thought: Thought::default(),
        })
    }

    /// The scores of the last step's proposals: lateral offsets one after another, within each the
    /// speeds.
    pub fn scores(&self) -> &[PdmScore] {
        &self.thought.scores
    }

    /// Index of the proposal that was best in the last step.
    pub fn best(&self) -> usize {
        self.thought.best
    }

    #[cfg(test)]
    pub(crate) fn thought(&self) -> &Thought {
        &self.thought
    }
}

pub(crate) fn check(config: &PdmConfig) -> Result<(), PlanError> {
    let law = &config.law;
    let numbers = [
        ("fallback_speed", config.fallback_speed),
        ("min_gap", law.min_gap),
        ("headway", law.headway),
        ("max_acceleration", law.max_acceleration),
        ("max_deceleration", law.max_deceleration),
        ("exponent", law.exponent),
    ];
    let fractions = config
        .speed_fractions
        .iter()
        .map(|&f| ("speed_fraction", f));
    for (name, value) in numbers.into_iter().chain(fractions) {
        if !(value > 0.0 && value.is_finite()) {
            let expected = "a positive number";
            return Err(PlanError::Parameter {
                name,
                value,
                expected,
            });
        }
    }
    let n = config.speed_fractions.len() * config.lateral_offsets.len();
    if n == 0
        || config
            .lateral_offsets
            .iter()
            .any(|offset| !offset.is_finite())
    {
        return Err(PlanError::Parameter {
            name: "number of proposals",
            value: n as f64,
            expected: "at least one speed and one finite offset",
        });
    }
    Ok(())
}

impl Driver for PdmClosed {
    fn name(&self) -> &str {
        "pdm-closed"
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        let state = State::new(initialization)?;
        self.thought = Thought::default();
        self.state = Some(state);
        Ok(())
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let state = self.state.as_mut().ok_or(PlanError::NotInitialized)?;
        let speeds = state.prepare(input, &self.config)?;
        let proposer = state.proposer(&self.config.law, &speeds);
        let ego = input.ego;
        let thought = &mut self.thought;
        thought.proposals = proposer.propose(ego.rear_axle, ego.velocity.x, STEPS);
        thought.drives.resize(thought.proposals.len(), Vec::new());
        for (proposal, states) in thought.proposals.iter().zip(&mut thought.drives) {
            let wheel_base = state.vehicle.wheel_base;
            self.tracker.drive(ego, &proposal.poses, wheel_base, states);
        }
        let judge = Judge {
            vehicle: &state.vehicle,
            forecast: &state.forecast,
            ground: &state.ground,
            centerline: state.centerline(),
        };
        thought.scores = judge.judge(&thought.drives, &mut self.comfort);
        thought.best = first_best(&thought.scores);
        let best = &thought.scores[thought.best];
        let soon = best.collision_step.is_some_and(|step| step <= BRAKE_STEPS);
        thought.braked = soon && ego.speed() <= BRAKE_SPEED;
        let poses = if thought.braked {
            brake(ego, &state.vehicle)
        } else {
            let mut chosen = [thought.proposals[thought.best].clone()];
            proposer.drive(&mut chosen, STEPS + 1..=TRAJECTORY_STEPS);
            let [chosen] = chosen;
            chosen.poses
        };
        Ok(trajectory(ego.time_us, &poses)?)
    }
}

fn first_best(scores: &[PdmScore]) -> usize {
    let mut best = 0;
    for (i, score) in scores.iter().enumerate() {
        if score.total > scores[best].total {
            best = i;
        }
    }
    best
}

impl Explain for PdmClosed {
    fn candidates(&self) -> Vec<Candidate> {
        let thought = &self.thought;
        let n = self.config.speed_fractions.len();
        let name = |i: usize| {
            ProposalKind::Idm {
                speed_fraction: self.config.speed_fractions[i % n],
                lateral_offset: self.config.lateral_offsets[i / n],
            }
            .to_string()
        };
        let proposals = thought.proposals.iter().zip(&thought.scores).enumerate();
        let mut all: Vec<Candidate> = proposals
            .map(|(i, (proposal, score))| Candidate {
                name: name(i),
                chosen: i == thought.best && !thought.braked,
                score: Some(score.total),
                parts: vec![
                    ("no_at_fault_collisions", score.no_at_fault_collision),
                    ("drivable_area", score.drivable_area),
                    ("driving_direction", score.driving_direction),
                    ("progress", score.progress),
                    ("time_to_collision", score.time_to_collision),
                    ("comfort", score.comfort),
                ],
                poses: proposal.poses.clone(),
            })
            .collect();
        if thought.braked {
            all.push(Candidate::alone("emergency brake", Vec::new()));
        }
        all
    }
}
