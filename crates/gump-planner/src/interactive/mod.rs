//! The interactive planner in the closed loop: every proposal is a policy that drives among
//! simulated agents, and the one with the best value over several futures is followed.
//!
//! Start with [`InteractiveDriver`]. `imagine` simulates policies and world in turns, `choice`
//! computes values and chooses; `modes` draws drives of the world's own ego, `warm_start` says which
//! candidates need not be simulated again. Lines, tracker, road and score are those of [`crate::PdmClosed`],
//! so the two planners differ only in their predictions of other agents.
//!
//! Source: the planner of the GUMP paper, which was never released; details that the paper leaves
//! open are fields of [`InteractiveDriverConfig`].

mod choice;
mod imagine;
mod modes;
#[cfg(test)]
mod modes_tests;
mod policies;
#[cfg(test)]
mod tests;
mod warm_start;
#[cfg(test)]
mod warm_start_tests;

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use gump_metrics::Score;
use gump_nuplan::closed_loop::{Driver, PlannerInitialization, PlannerInput};
use gump_nuplan::tracking::Trajectory;
use gump_rollout::{BoxError, WorldModel};
use gump_scene::{EgoState, Rollout, Seed};
use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

use crate::candidates::{Candidate, Explain};
use crate::pdm::propose::DT;
use crate::pdm::state::{State, brake, trajectory};
use crate::pdm::{self, STEPS, TRAJECTORY_STEPS};
use crate::{PdmConfig, PlanError, ProposalKind};
pub use choice::CandidateScore;
use choice::{choose, is_emergency};
use imagine::Imagination;
use modes::Following;
pub use warm_start::WarmStart;

/// Settings of candidates, rollouts and values.
#[derive(Clone, Debug, PartialEq)]
pub struct InteractiveDriverConfig {
    /// The rule-based policies.
    pub proposals: PdmConfig,
    /// Whether other driving styles are candidates as well: two brisk ones, one that keeps a long
    /// distance and one that creeps, all along the centre.
    pub driving_styles: bool,
    /// Whether changes into the lanes beside the ego's are candidates as well, two for each side.
    pub lane_changes: bool,
    /// Whether the world's own ego is a candidate as well.
    pub imitation: bool,
    /// From 2 on, up to so many drives of the world's own ego are candidates as well, beside
    /// imitation. Each is a single drive, drawn once and the same in all futures of the others;
    /// draws that are alike count once. With 0 or 1 there are none: imitation has one draw.
    pub network_modes: usize,
    /// Futures per candidate, > 0; fewer for candidates that drop out.
    pub n_futures: usize,
    /// Distribution of the rollouts over candidates.
    pub allocation: Allocation,
    /// What the last decision spares this one; no effect with [`Allocation::Uniform`].
    pub warm_start: WarmStart,
    /// The seed: future *k* of every candidate has the same random numbers.
    pub seed: Seed,
    /// Iterations of the loop between two decisions, > 0; in between the chosen policy is followed.
    pub replan_every: usize,
    /// The value of a future.
    pub value: ValueEstimate,
    /// Combination of the values of a candidate's futures into one.
    pub aggregate: Aggregate,
    /// Number of standard deviations over the futures that are subtracted from the mean, at least
    /// 0.
    pub caution: f64,
    /// Weight of a further future in which other agents keep their velocity, 0 to 1; the rest is that
    /// of the futures in the world. A world that expects others to make way is right on average,
    /// and expensive where it is wrong.
    pub hedge: f64,
    /// Bonus for the previous choice, added to its value.
    pub hysteresis: f64,
    /// Budget of the rollouts.
    pub budget: PlanBudget,
}

impl Default for InteractiveDriverConfig {
    /// The paper's 15 policies and imitation, four more policies of other driving styles, changes of
    /// lane, 4 futures of 4 s for the finalists of sequential halving, the mean, half of the value
    /// from the hedge (result 9 compares shares); a decision every half second, which is a frame of
    /// the learned world.
    fn default() -> Self {
        Self {
            proposals: PdmConfig::default(),
            driving_styles: true,
            lane_changes: true,
            imitation: true,
            network_modes: 0,
            n_futures: 4,
            allocation: Allocation::default(),
            warm_start: WarmStart::default(),
            seed: Seed(0),
            replan_every: 5,
            value: ValueEstimate::Rollout,
            aggregate: Aggregate::default(),
            caution: 0.0,
            hedge: 0.5,
            hysteresis: 0.0,
            budget: PlanBudget::default(),
        }
    }
}

/// Distribution of the rollouts over candidates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Allocation {
    /// All futures of all candidates, as in the paper.
    Uniform,
    /// Sequential halving (Karnin, Koren and Somekh, 2013): one future of each, then one of the
    /// better half, two of the better half of those, and so on, until some candidates have had all
    /// futures. Every candidate of a round has the same random numbers.
    #[default]
    Halving,
}

impl Allocation {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 2] = [Self::Uniform, Self::Halving];
}

impl fmt::Display for Allocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Allocation {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// Combination of the values of a candidate's futures into one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Aggregate {
    /// Their mean minus [`InteractiveDriverConfig::caution`] standard deviations.
    #[default]
    Mean,
    /// Their minimum.
    Worst,
}

impl Aggregate {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 2] = [Self::Mean, Self::Worst];
}

impl fmt::Display for Aggregate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Aggregate {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// The value of a future.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum ValueEstimate {
    /// The score of the whole drive, 0 to 1: the product of PDM's gates times the mean of progress,
    /// time to collision, the speed limit and comfort with the weights of nuPlan's closed-loop
    /// score. Comfort is that of nuPlan's metric, including the last 2 s of the drive so far; any
    /// speed complies with a limit that is not stated.
    Rollout,
    /// The same of every half second, discounted: the weighted mean with weights gamma^t, 0 to 1. A
    /// gate that closes stays closed.
    DiscountedStep {
        /// Gamma, 0 to 1; lower values reduce the weight of later half seconds.
        gamma: f64,
    },
}

/// Budget of the rollouts.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanBudget {
    /// Number of moving agents to simulate, those nearest to the ego; others keep their velocity.
    pub nearest: usize,
    /// Horizon in seconds, 0.5 to 4, in whole half seconds.
    pub horizon: f64,
    /// Time limit: rollouts stop at the half second in which it is used up, and all candidates are
    /// scored over the same, shorter horizon. A later round of [`Allocation::Halving`] that is
    /// unfinished by then does not count. Needs a clock: [`InteractiveDriver::with_clock`].
    pub wall: Option<Duration>,
}

impl Default for PlanBudget {
    /// 12 agents, the paper's 4 s, without a time limit. Time grows with the agents; result 9 plans
    /// with 8, and neither number was tuned.
    fn default() -> Self {
        Self {
            nearest: 12,
            horizon: 4.0,
            wall: None,
        }
    }
}

/// Time spent in the parts of a decision; zeros without a clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Phases {
    /// Opening the world: map and history.
    pub open: Duration,
    /// The world's frames.
    pub frames: Duration,
    /// The policies: leaders, speeds, tracking.
    pub policies: Duration,
    /// Scoring.
    pub score: Duration,
}

impl Phases {
    /// In total.
    pub fn total(&self) -> Duration {
        self.open + self.frames + self.policies + self.score
    }
}

/// One candidate with its rollouts and scores.
#[derive(Clone, Debug)]
pub struct CandidateEvaluation {
    /// The policy, or the world's ego.
    pub kind: ProposalKind,
    /// The result of each future.
    pub score: CandidateScore,
    /// The value by which it is chosen: [`InteractiveDriverConfig::aggregate`] of its futures, and
    /// the [`hedge`](InteractiveDriverConfig::hedge), less a small cost of changing lane. Of one that
    /// rests, the value in the decision that simulated it last.
    pub value: f64,
    /// The score among agents that keep their velocity; `None` where it has no weight.
    pub hedge: Option<Score>,
    /// Whether it was simulated to the end and could be chosen: [`Allocation::Halving`] drops
    /// others on the way.
    pub finalist: bool,
    /// Number of decisions in a row, this one included, that did not simulate it in the world
    /// ([`WarmStart::Rest`]). Above 0 its only future is the one in which others keep their velocity.
    pub rests: usize,
    /// Number of futures with a collision at the ego's fault.
    pub collisions: usize,
    /// Mean progress along the way, metres.
    pub progress_m: f64,
    /// Mean time to the first collision at the ego's fault, seconds; the horizon counts where there
    /// is none.
    pub collision_s: f64,
    /// The rollouts: the ego and the agents near it, every half second, until the future could have
    /// no value any more.
    pub futures: Vec<Rollout>,
    /// The ego's motion in each future: states of the rear axle, a tenth of a second apart.
    pub drives: Vec<Vec<EgoState>>,
}

impl CandidateEvaluation {
    /// Means over the futures of every gate's factor and every term's value, by name, and the total
    /// of the hedge as `hedge`.
    pub fn parts(&self) -> Vec<(&'static str, f64)> {
        let mut parts = self.score.parts();
        parts.extend(self.hedge.as_ref().map(|hedge| ("hedge", hedge.total)));
        parts
    }
}

/// A decision with all candidates.
#[derive(Clone, Debug)]
pub struct Decision {
    /// Index of the chosen candidate.
    pub chosen: usize,
    /// True if the ego brakes instead, because even the best candidate collides soon.
    pub brakes: bool,
    /// All candidates: lateral offsets one after another, within each the speeds; other driving
    /// styles, changes of lane, the network's modes, imitation last.
    pub candidates: Vec<CandidateEvaluation>,
    /// Horizon that was simulated, seconds.
    pub horizon: f64,
    /// Time spent.
    pub phases: Phases,
}

/// Rolls out every policy and follows the best one.
///
/// Each policy is rolled out separately in each future: every half second it sees the positions of
/// the simulated agents and drives on, and the world reacts within the same frame. A plan is thus
/// not a fixed line, and the motion of other agents is not a fixed forecast.
///
/// Whatever a candidate drives within a metre behind something that stands, until the end of its
/// future, is no progress.
///
/// A future in which a gate of the score has closed for good can gain no further value, so the
/// rest of it is not simulated. This bound is exact.
///
/// Ties of values (within 1e-6) are broken by fewer collisions, more progress, the previous choice,
/// the lower index. If no candidate has a value above 0, the one that collides last is followed; if
/// even that collides within 2 s and the ego is slow, it brakes as PDM does.
pub struct InteractiveDriver<'w> {
    world: &'w dyn WorldModel,
    config: InteractiveDriverConfig,
    clock: Box<dyn Fn() -> Duration + 'w>,
    state: Option<State>,
    decision: Option<Decision>,
    decided_at: usize,
    /// Number of decisions of this drive.
    n_decisions: usize,
    /// The path of the chosen imitation or mode.
    following: Option<Following>,
}

impl<'w> InteractiveDriver<'w> {
    /// A planner that rolls candidates out in `world`.
    ///
    /// # Errors
    /// [`PlanError::Parameter`] for a number out of its range.
    pub fn new(
        world: &'w dyn WorldModel,
        config: InteractiveDriverConfig,
    ) -> Result<Self, PlanError> {
        check(&config)?;
        Ok(Self {
            world,
            config,
            clock: Box::new(|| Duration::ZERO),
            state: None,
            decision: None,
            decided_at: 0,
            n_decisions: 0,
            following: None,
        })
    }

    /// The clock: the time since any fixed instant.
    #[must_use]
    pub fn with_clock(self, clock: impl Fn() -> Duration + 'w) -> Self {
        Self {
            clock: Box::new(clock),
            ..self
        }
    }

    fn is_due(&self, input: &PlannerInput<'_>) -> bool {
        let old = input.iteration >= self.decided_at + self.config.replan_every;
        let ends = |f: &Following| f.way.end_us() < input.ego.time_us + 2_000_000;
        old || self.decision.is_none() || self.following.as_ref().is_some_and(ends)
    }

    fn decide(&mut self, input: &PlannerInput<'_>, speeds: &[f64]) -> Result<(), PlanError> {
        let state = self.state.as_ref().ok_or(PlanError::NotInitialized)?;
        let imagination = Imagination {
            world: self.world,
            config: &self.config,
            state,
            speeds,
            input,
            clock: &*self.clock,
            last: self.decision.as_ref(),
            n_decisions: self.n_decisions,
            following: self.following.as_ref(),
        };
        let mut decision = imagination.imagine()?;
        // Changes of lane come and go: the previous choice is found by its kind.
        let kind = |decision: &Decision| decision.candidates[decision.chosen].kind;
        let kind = self.decision.as_ref().map(kind);
        let under_way = self.following.as_ref().and_then(|following| {
            following.mode_under_way(input.ego.time_us, self.config.budget.horizon)
        });
        // A new mode with an old number is another drive.
        let kind = kind.filter(|kind| match kind {
            ProposalKind::NetworkMode { index } => under_way == Some(*index),
            _ => true,
        });
        let same = |evaluation: &CandidateEvaluation| Some(evaluation.kind) == kind;
        let previous = decision.candidates.iter().position(same);
        decision.chosen = choose(&decision.candidates, previous, self.config.hysteresis);
        let chosen = &decision.candidates[decision.chosen];
        decision.brakes = is_emergency(chosen, input.ego);
        let goes_on = match chosen.kind {
            ProposalKind::NetworkMode { index } => under_way == Some(index),
            _ => false,
        };
        if decision.brakes {
            self.following = None;
        } else if !goes_on {
            // A mode that goes on is followed as it was drawn, not as the vehicle would follow it
            // from here: deviations do not add up.
            self.following = Following::begin(chosen, input.ego, decision.horizon)?;
        }
        self.decision = Some(decision);
        self.decided_at = input.iteration;
        self.n_decisions += 1;
        Ok(())
    }

    /// Lets the chosen policy drive on from the actual positions of all agents.
    fn follow(&self, input: &PlannerInput<'_>, speeds: &[f64]) -> Result<Trajectory, PlanError> {
        let state = self.state.as_ref().ok_or(PlanError::NotInitialized)?;
        let decision = self.decision.as_ref().ok_or(PlanError::NotInitialized)?;
        let ego = input.ego;
        if decision.brakes {
            return Ok(trajectory(ego.time_us, &brake(ego, &state.vehicle))?);
        }
        if let Some(following) = &self.following {
            return Ok(following.way.clone());
        }
        let policies = policies::all(&self.config, speeds, state.lane_changes());
        let chosen = &policies[decision.chosen];
        let proposer = state.proposer(&chosen.law, speeds);
        let mut policy = [proposer.begin(chosen.line, ego.rear_axle, ego.velocity.x)];
        policy[0].desired_speed = chosen.desired_speed;
        proposer.drive(&mut policy, 1..=TRAJECTORY_STEPS);
        Ok(trajectory(ego.time_us, &policy[0].poses)?)
    }
}

impl Driver for InteractiveDriver<'_> {
    fn name(&self) -> &str {
        "interactive"
    }

    fn start(&mut self, initialization: &PlannerInitialization<'_>) -> Result<(), BoxError> {
        self.state = Some(State::new(initialization)?);
        (self.decision, self.following) = (None, None);
        self.n_decisions = 0;
        Ok(())
    }

    fn drive(&mut self, input: &PlannerInput<'_>) -> Result<Trajectory, BoxError> {
        let state = self.state.as_mut().ok_or(PlanError::NotInitialized)?;
        let speeds = state.prepare(input, &self.config.proposals)?;
        if self.is_due(input) {
            let chosen = |decision: &Decision| decision.candidates[decision.chosen].kind;
            let under_way = match self.decision.as_ref().map(chosen) {
                Some(ProposalKind::LaneChange { side, .. }) => Some(side),
                _ => None,
            };
            let state = self.state.as_mut().ok_or(PlanError::NotInitialized)?;
            if self.config.lane_changes {
                state.lay_changes(input.ego, &self.config.proposals, under_way)?;
            }
            self.decide(input, &speeds)?;
        }
        Ok(self.follow(input, &speeds)?)
    }
}

impl Explain for InteractiveDriver<'_> {
    fn candidates(&self) -> Vec<Candidate> {
        let Some(decision) = &self.decision else {
            return Vec::new();
        };
        let evaluations = decision.candidates.iter().enumerate();
        let mut all: Vec<Candidate> = evaluations
            .map(|(i, evaluation)| Candidate {
                name: evaluation.kind.to_string(),
                chosen: i == decision.chosen && !decision.brakes,
                score: Some(evaluation.value),
                parts: evaluation.parts(),
                poses: evaluation.drives[0].iter().map(|s| s.rear_axle).collect(),
            })
            .collect();
        if decision.brakes {
            let name = ProposalKind::EmergencyBrake.to_string();
            all.push(Candidate::alone(&name, Vec::new()));
        }
        all
    }

    fn decision(&self) -> Option<&Decision> {
        self.decision.as_ref()
    }
}

/// Steps of a tenth of a second within the horizon.
fn steps(budget: &PlanBudget) -> usize {
    let decisions = (budget.horizon / imagine::DECISION_S).floor() as usize;
    decisions * imagine::DECISION
}

fn check(config: &InteractiveDriverConfig) -> Result<(), PlanError> {
    pdm::check(&config.proposals)?;
    let wrong = |name, value, expected| {
        Err(PlanError::Parameter {
            name,
            value,
            expected,
        })
    };
    for (name, n) in [
        ("n_futures", config.n_futures),
        ("replan_every", config.replan_every),
    ] {
        if n == 0 {
            return wrong(name, 0.0, "at least 1");
        }
    }
    for (name, value) in [
        ("caution", config.caution),
        ("hysteresis", config.hysteresis),
    ] {
        if !(value >= 0.0 && value.is_finite()) {
            return wrong(name, value, "0 or more");
        }
    }
    if !(0.0..=1.0).contains(&config.hedge) {
        return wrong("hedge", config.hedge, "0 to 1");
    }
    if let ValueEstimate::DiscountedStep { gamma } = config.value
        && !(gamma > 0.0 && gamma <= 1.0)
    {
        return wrong("gamma", gamma, "more than 0 and at most 1");
    }
    let horizon = config.budget.horizon;
    let longest = STEPS as f64 * DT;
    if !(imagine::DECISION_S <= horizon && horizon <= longest) {
        return wrong("horizon", horizon, "0.5 to 4 s");
    }
    Ok(())
}
