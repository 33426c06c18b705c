//! Inputs of the metric as plain arrays: a recorded scenario and the rollouts of a world.
//!
//! [`Log`] contains everything the reference reads of a recording, including invalid states and the
//! order of the map, because its quirks depend on them. [`Log::of`] converts a
//! [`gump_scene::Scenario`], [`Rollouts::of`] rollouts.

use gump_scene::{AgentId, AgentKind};

use super::WosacError;

/// Steps of a log: 9.1 s at 10 Hz.
pub const N_STEPS: usize = 91;
/// Of these, past and present.
pub const N_HISTORY: usize = 11;
/// Of these, the future.
pub const N_FUTURE: usize = N_STEPS - N_HISTORY;

/// A recorded agent at one step.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct State {
    /// Box centre, world frame, metres.
    pub position: [f32; 3],
    /// Radians, counter-clockwise from +x.
    pub heading: f32,
    /// Length, width, height, metres.
    pub size: [f32; 3],
    /// False where the agent was not observed; the other fields then have the values of the
    /// recording.
    pub valid: bool,
}

impl State {
    /// A valid state: box centre, heading, and length, width, height.
    pub fn new(position: [f32; 3], heading: f32, size: [f32; 3]) -> Self {
        Self {
            position,
            heading,
            size,
            valid: true,
        }
    }
}

/// One recorded agent over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// Identity, unique in the log.
    pub id: AgentId,
    /// Its kind.
    pub kind: AgentKind,
    /// [`N_STEPS`] states, 0.1 s apart.
    pub states: Vec<State>,
}

impl Track {
    /// A track of [`N_STEPS`] states.
    pub fn new(id: AgentId, kind: AgentKind, states: Vec<State>) -> Self {
        Self { id, kind, states }
    }

    /// True if the agent is present at the present step, so that it must be simulated.
    pub fn is_simulated(&self) -> bool {
        self.states.get(N_HISTORY - 1).is_some_and(|now| now.valid)
    }
}

/// A lane of a surface street, with the data that traffic lights need.
#[derive(Clone, Debug, PartialEq)]
pub struct SignalLane {
    /// The lane's id, to which signals refer.
    pub id: i64,
    /// Centre line in the direction of travel, metres.
    pub points: Vec<[f32; 2]>,
}

/// The signal of one lane at one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Signal {
    /// The controlled lane.
    pub lane: i64,
    /// True if it shows red, as a disc or as an arrow, and does not flash.
    pub stop: bool,
    /// Point at which vehicles stop for it, metres.
    pub stop_point: [f32; 2],
}

/// The parts of a recorded scenario that the metric reads.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Log {
    /// Name of the scenario.
    pub scenario: String,
    /// All agents, in the order of the recording.
    pub tracks: Vec<Track>,
    /// The ego; it is always scored.
    pub ego: Option<AgentId>,
    /// Other agents that are scored.
    pub targets: Vec<AgentId>,
    /// Road edges in the order of the map, with the road on their left, metres; those of fewer than
    /// two points do not count.
    pub road_edges: Vec<Vec<[f32; 3]>>,
    /// Lanes of surface streets in the order of the map; those of fewer than two points do not
    /// count.
    pub lanes: Vec<SignalLane>,
    /// Signals per step, [`N_STEPS`] or none at all.
    pub signals: Vec<Vec<Signal>>,
}

impl Log {
    /// A log of these tracks, without map and roles.
    pub fn new(scenario: impl Into<String>, tracks: Vec<Track>) -> Self {
        Self {
            scenario: scenario.into(),
            tracks,
            ..Self::default()
        }
    }

    /// Sets the ego.
    ///
    /// # Errors
    /// [`WosacError::NoTrack`].
    pub fn ego(mut self, ego: AgentId) -> Result<Self, WosacError> {
        self.check_track("the ego", ego)?;
        self.ego = Some(ego);
        Ok(self)
    }

    /// Sets other agents that are scored.
    ///
    /// # Errors
    /// [`WosacError::NoTrack`].
    pub fn targets(mut self, targets: Vec<AgentId>) -> Result<Self, WosacError> {
        for &target in &targets {
            self.check_track("target", target)?;
        }
        self.targets = targets;
        Ok(self)
    }

    /// Sets the road edges, with the road on their left.
    pub fn road_edges(mut self, road_edges: Vec<Vec<[f32; 3]>>) -> Self {
        self.road_edges = road_edges;
        self
    }

    /// Sets the lanes of surface streets and the signals of every step.
    pub fn signals(mut self, lanes: Vec<SignalLane>, signals: Vec<Vec<Signal>>) -> Self {
        self.lanes = lanes;
        self.signals = signals;
        self
    }

    /// The log as `n` equal rollouts: in practice the best possible score, less than 1. `whole`
    /// selects the scenario-generation mode, which needs all steps.
    pub fn oracle(&self, n: usize, whole: bool) -> Rollouts {
        let simulated = self.tracks.iter().filter(|track| track.is_simulated());
        let future = simulated.map(|track| {
            let states = &track.states[if whole { 0 } else { N_HISTORY }..];
            let column = |f: fn(&State) -> f32| states.iter().map(f).collect::<Vec<_>>();
            let drive = Trajectory::new(
                track.id,
                column(|s| s.position[0]),
                column(|s| s.position[1]),
                column(|s| s.position[2]),
                column(|s| s.heading),
            );
            if whole {
                let sizes = states.iter().map(|s| s.size).collect();
                drive.with_box(track.kind, sizes)
            } else {
                drive
            }
        });
        Rollouts::new(self.scenario.clone(), vec![future.collect()]).repeated(n)
    }

    fn check_track(&self, role: &'static str, agent: AgentId) -> Result<(), WosacError> {
        if self.tracks.iter().any(|track| track.id == agent) {
            return Ok(());
        }
        Err(WosacError::NoTrack {
            scenario: self.scenario.clone(),
            role,
            agent,
        })
    }
}

/// One agent in one rollout.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// Id of the agent.
    pub id: AgentId,
    /// Box centre per step, metres; [`N_FUTURE`] steps, [`N_STEPS`] for scenario generation.
    pub x: Vec<f32>,
    /// As `x`.
    pub y: Vec<f32>,
    /// As `x`.
    pub z: Vec<f32>,
    /// Radians per step.
    pub heading: Vec<f32>,
    /// Kind, and length, width, height per step: for scenario generation only, which generates
    /// them; simulated agents keep those of the present step.
    pub shape: Option<(AgentKind, Vec<[f32; 3]>)>,
}

impl Trajectory {
    /// Centre and heading per step.
    pub fn new(id: AgentId, x: Vec<f32>, y: Vec<f32>, z: Vec<f32>, heading: Vec<f32>) -> Self {
        Self {
            id,
            x,
            y,
            z,
            heading,
            shape: None,
        }
    }

    /// Sets generated values of scenario generation: the kind, and length, width, height per step.
    pub fn with_box(mut self, kind: AgentKind, sizes: Vec<[f32; 3]>) -> Self {
        self.shape = Some((kind, sizes));
        self
    }
}

/// The rollouts of a world for one scenario.
#[derive(Clone, Debug, PartialEq)]
pub struct Rollouts {
    /// Name of the scenario.
    pub scenario: String,
    /// Trajectories of all agents that are present at the present step, in any order, per rollout.
    pub futures: Vec<Vec<Trajectory>>,
    /// Number of equal rollouts that each future stands for, ≥ 1: deterministic worlds need to be
    /// computed only once.
    pub copies: usize,
}

impl Rollouts {
    /// Rollouts of the named scenario; the challenge requires 32.
    pub fn new(scenario: impl Into<String>, futures: Vec<Vec<Trajectory>>) -> Self {
        Self {
            scenario: scenario.into(),
            futures,
            copies: 1,
        }
    }

    /// The same with every future repeated `n` times.
    pub fn repeated(self, n: usize) -> Self {
        Self {
            copies: n.max(1),
            ..self
        }
    }

    /// The number of rollouts.
    pub fn count(&self) -> usize {
        self.futures.len() * self.copies
    }
}
