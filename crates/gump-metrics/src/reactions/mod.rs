//! Reactions of traffic to an ego that leaves its log.
//!
//! The ego brakes, stops, speeds up, changes lane or runs the light where its log did none of that.
//! Recorded traffic does not react and drives through it; reactive traffic makes room. The rate
//! measures how well a world reacts, for users who want to test a planner in it.
//!
//! | manoeuvre | the ego | where |
//! |---|---|---|
//! | `log` | follows its log: what happens without any reason | everywhere |
//! | `brake` | brakes with 3 m/s² to a stop | it drives faster than 3 m/s |
//! | `stop` | brakes with 6 m/s² to a stop | it drives faster than 3 m/s |
//! | `speed-up` | gains 2 m/s² until it is 5 m/s faster | it drives faster than 3 m/s |
//! | `change-lane` | drives as fast as in its log, within 3 s over to the lane beside, left before right, and on along it | it drives faster than 5 m/s, now and on average over the change, the lane graph has a lane beside outside of intersections, and nobody is there, nor would be before the change is over: from 2 m and three seconds of the difference in speed behind its box to 2 m before it |
//! | `run-light` | keeps its speed, gaining 2 m/s² up to 8 m/s if it is slower, past a stop line that is red in the present and in the log of that moment | its log stands at some time (below 0.5 m/s) and does not pass that line |
//!
//! **Path.** All manoeuvres except `log` and `change-lane` drive along the positions of the log,
//! with its headings, at the changed speed. Where the log ends they continue along the lane graph,
//! at forks on the straightest lane, and straight on where there is none. Velocities are computed
//! from positions.
//!
//! **Near** is an agent of a moving kind that is present and does not overlap the ego in the
//! present, moves more than 1 m from its place in the log, and in the log comes within 2 m (box to
//! box) of a place that the ego of the manoeuvre occupies, at most 1 s before and at most 3 s after
//! it. Rates are per near agent. Near agents are chosen from the log and the manoeuvre only, so
//! they are the same for every world.
//!
//! **To run into the ego** is to begin to overlap its box by more than 0.1 m, at any frame, and to
//! be at fault. Fault follows nuPlan's rule ([`crate::encounter`]), evaluated where the overlap
//! begins. The ego is at fault if its front bumper hits the other or the other stands (below 0.3
//! m/s), and in side contacts if the ego does not keep its lane (its centre within 0.9 m of the
//! centre line of a lane with its direction, within 30 degrees; without lanes it counts as keeping
//! it). Otherwise the other is at fault: from behind, into the ego's side, or into a standing ego.
//! Boxes more than 3 m above one another do not meet. Each agent counts once, by its first contact.
//! A future ends when the ego itself runs into an agent.
//!
//! A manoeuvre is **not scored** ([`Reason`]) if the scene does not offer what it needs, if it
//! stays within 3 m of the log, if no agent is near, or if the ego would be the first to run into
//! an agent that follows its log.
//!
//! Start with [`Reactions`]. The module does not step a world: [`Attempt::plan`] gives the states
//! of the ego to simulate.
//!
//! ```
//! use gump_metrics::reactions::{Manoeuvre, Reactions};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: -100,0 300,0
//!      ego vehicle 0: 0,0 velocity 10,0
//!      agent vehicle 1: -20,0 velocity 10,0",
//! ).unwrap();
//! let reactions = Reactions::new(&scenario, 8.0).unwrap();
//! // Who follows in the log runs into an ego that stops, and does not where it follows its log.
//! let stop = reactions.attempt(Manoeuvre::Stop).unwrap();
//! assert_eq!(stop.replayed().run_into_ego.len(), 1);
//! let log = reactions.attempt(Manoeuvre::Log).unwrap();
//! assert_eq!((log.near().len(), log.replayed().run_into_ego.len()), (1, 0));
//! ```

mod contact;
mod manoeuvre;
mod near;
mod path;
#[cfg(test)]
mod tests;

use gump_scene::{AgentId, AgentState, Rollout, Scenario};

pub use contact::{Contact, Outcome};
pub use manoeuvre::Manoeuvre;

/// A manoeuvre that stays nearer to the log than this does not leave it, metres: about a lane's
/// width. Chosen by hand.
const LEAVES_M: f64 = 3.0;

/// Why a scenario cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Unfit {
    /// The log ends before the horizon.
    #[error("expected a log that goes on for {needed} s, found {found:.1} s")]
    TooShort {
        /// Seconds of log after the present.
        found: f64,
        /// Seconds required.
        needed: f64,
    },
    /// The ego is not observed all the time.
    #[error("expected the ego in every frame of the log, not found {at:.1} s after the present")]
    EgoLost {
        /// The first moment without it, seconds after the present.
        at: f64,
    },
}

/// Why a manoeuvre is not scored in a scenario.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Reason {
    /// The ego is too slow for the manoeuvre.
    TooSlow,
    /// There is no lane beside the ego's.
    NoLane,
    /// The lane beside is occupied.
    NoRoom,
    /// No red light ahead at which the log stopped.
    NoLight,
    /// The log does almost the same.
    LikeLog,
    /// The ego would be the first to run into an agent that follows its log.
    OwnFault,
    /// No agent is near.
    Nobody,
}

impl Reason {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::TooSlow,
        Self::NoLane,
        Self::NoRoom,
        Self::NoLight,
        Self::LikeLog,
        Self::OwnFault,
        Self::Nobody,
    ];

    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::TooSlow => "too_slow",
            Self::NoLane => "no_lane_beside",
            Self::NoRoom => "no_room_beside",
            Self::NoLight => "no_red_light",
            Self::LikeLog => "like_the_log",
            Self::OwnFault => "ego_at_fault",
            Self::Nobody => "nobody_near",
        }
    }
}

/// One scenario in which the ego may leave its log.
pub struct Reactions<'a> {
    scenario: &'a Scenario,
    /// Frames after the present.
    n: usize,
    /// The ego in the log, from the present to the horizon: `n + 1` states, `dt` apart.
    logged: Vec<AgentState>,
}

impl<'a> Reactions<'a> {
    /// Examines `seconds` from the present of `scenario`.
    ///
    /// # Errors
    /// [`Unfit`] if the log is shorter, or the ego is not in all of it.
    pub fn new(scenario: &'a Scenario, seconds: f64) -> Result<Self, Unfit> {
        let n = (seconds / scenario.dt).round().max(1.0) as usize;
        let ahead = &scenario.log[scenario.now..];
        if ahead.len() <= n {
            return Err(Unfit::TooShort {
                found: scenario.future().len() as f64 * scenario.dt,
                needed: seconds,
            });
        }
        let mut logged = Vec::with_capacity(n + 1);
        for (k, frame) in ahead.iter().take(n + 1).enumerate() {
            let ego = frame.agent(scenario.ego);
            let at = k as f64 * scenario.dt;
            logged.push(ego.ok_or(Unfit::EgoLost { at })?.state);
        }
        Ok(Self {
            scenario,
            n,
            logged,
        })
    }

    /// A manoeuvre in this scenario.
    ///
    /// # Errors
    /// The [`Reason`] why it is not scored.
    pub fn attempt(&self, manoeuvre: Manoeuvre) -> Result<Attempt<'a>, Reason> {
        let plan = self.plan(manoeuvre)?;
        let apart = |(a, b): (&AgentState, &AgentState)| a.pose.position.distance(b.pose.position);
        let leaves = plan.iter().zip(&self.logged).map(apart);
        if manoeuvre != Manoeuvre::Log && leaves.fold(0.0, f64::max) < LEAVES_M {
            return Err(Reason::LikeLog);
        }
        let near = near::near(self.scenario, &plan);
        if near.is_empty() {
            return Err(Reason::Nobody);
        }
        let attempt = Attempt {
            scenario: self.scenario,
            keeps_lane: contact::keeps_lane(&self.scenario.map, &plan),
            plan,
            near,
        };
        let outcome = attempt.replayed();
        let is_first = outcome.run_into_ego.is_empty() && outcome.others.is_empty();
        match outcome.ego_runs_into {
            Some(_) if is_first => Err(Reason::OwnFault),
            _ => Ok(attempt),
        }
    }
}

/// A manoeuvre that can be driven, and the agents near it.
pub struct Attempt<'a> {
    scenario: &'a Scenario,
    /// From the present, `dt` apart.
    plan: Vec<AgentState>,
    /// Whether the ego keeps its lane at each state of the plan.
    keeps_lane: Vec<bool>,
    near: Vec<AgentId>,
}

impl Attempt<'_> {
    /// The states of the ego: box-centre states in the world frame from the present, included, to
    /// the horizon, at the time step of the scenario.
    pub fn plan(&self) -> &[AgentState] {
        &self.plan
    }

    /// The near agents, by id; never empty.
    pub fn near(&self) -> &[AgentId] {
        &self.near
    }

    /// The contacts in a future in which the ego was driven by the plan, from the present of the
    /// scenario and at its time step; frames past the horizon do not count.
    pub fn outcome(&self, rollout: &Rollout) -> Outcome {
        self.judge(rollout.imagined())
    }

    /// The contacts where the other agents follow their logs.
    pub fn replayed(&self) -> Outcome {
        self.judge(self.scenario.future())
    }
}
