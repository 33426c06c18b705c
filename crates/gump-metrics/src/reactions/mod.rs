//! Who runs into an ego that leaves its log.
//!
//! The ego brakes, stops, speeds up, changes lane or runs the light where its log did none of that.
//! Recorded traffic does not notice and drives through it; traffic that reacts makes room. The rate
//! says how much a world reacts, for whoever wants to test a planner in it.
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
//! **The way.** All but `log` and `change-lane` drive along the positions of the log, with its
//! headings, by the changed speed; where the log ends they go on along the lane graph, at forks
//! the straightest way, and straight on where there is none. Velocities are those of the positions.
//!
//! **Near** is an agent that moves by itself, is there and does not overlap the ego in the present,
//! gets more than 1 m from its place in the log and comes in it within 2 m of a place (box to box)
//! that the ego of the manoeuvre takes, not more than 1 s before it and not more than 3 s after
//! it. Rates are per such agent: they are chosen from the log and the manoeuvre alone, so they
//! are the same for every world.
//!
//! **Runs into the ego** who comes to overlap its box by more than 0.1 m, at any frame, and is to
//! blame. Whose fault it is, is nuPlan's rule ([`crate::encounter`]), judged where the overlap begins: the
//! ego's if its front bumper hits the other or the other stands (below 0.3 m/s), and if they meet
//! side to side while the ego does not keep its lane (its middle within 0.9 m of the centre line of
//! a lane that points its way, within 30 degrees; where there are no lanes it does); else the
//! other's: from behind, into its side, or into an ego that stands. Boxes more than 3 m above one
//! another do not meet. Each agent counts once, by its first contact. Once the ego itself ran into
//! somebody, a future is over: the way it drives on then is nobody's to react to.
//!
//! **Not scored** is a manoeuvre ([`Reason`]) that asks for what is not there, that does not leave
//! its log by 3 m, in which nobody is near, and in which the ego is the first to run into somebody
//! of the log: no driver does that.
//!
//! Start with [`Reactions`]. Nothing here steps a world: [`Attempt::plan`] says where the ego is to be driven.
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

/// A manoeuvre that stays nearer to the log than this does not leave it, metres.
const LEAVES_M: f64 = 3.0;

/// Why a scenario says nothing about reactions.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Unfit {
    /// The log ends before the horizon.
    #[error("expected a log that goes on for {needed} s, found {found:.1} s")]
    TooShort {
        /// Seconds of log after the present.
        found: f64,
        /// Seconds asked for.
        needed: f64,
    },
    /// Where the ego is, is not known all the time.
    #[error("expected the ego in every frame of the log, not found {at:.1} s after the present")]
    EgoLost {
        /// The first moment without it, seconds after the present.
        at: f64,
    },
}

/// Why a manoeuvre is not scored in a scenario.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reason {
    /// The ego is slower than the manoeuvre asks for.
    TooSlow,
    /// No lane runs beside the ego's.
    NoLane,
    /// Somebody is on the lane beside.
    NoRoom,
    /// No red light ahead at which the log stopped.
    NoLight,
    /// The log does much the same.
    LikeLog,
    /// The ego itself would be the first to run into somebody of the log.
    OwnFault,
    /// Nobody is near.
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
    /// Looks `seconds` ahead from the present of `scenario`.
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

/// A manoeuvre that can be driven, and whom it concerns.
pub struct Attempt<'a> {
    scenario: &'a Scenario,
    /// From the present, `dt` apart.
    plan: Vec<AgentState>,
    /// Whether the ego keeps its lane at each state of the plan.
    keeps_lane: Vec<bool>,
    near: Vec<AgentId>,
}

impl Attempt<'_> {
    /// Where the ego is driven: box-centre states in the world frame from the present, included, to
    /// the horizon, as far apart as the frames of the scenario.
    pub fn plan(&self) -> &[AgentState] {
        &self.plan
    }

    /// Agents whose reaction is asked for, by id; never empty.
    pub fn near(&self) -> &[AgentId] {
        &self.near
    }

    /// What happened in a future in which the ego was driven like that, from the present of the
    /// scenario and at its rate; frames past the horizon do not count.
    pub fn outcome(&self, rollout: &Rollout) -> Outcome {
        self.judge(rollout.imagined())
    }

    /// What happens where the others follow their logs.
    pub fn replayed(&self) -> Outcome {
        self.judge(self.scenario.future())
    }
}
