//! Conversion of scenes and rollouts of `gump-scene` to the inputs of the metrics.

use std::collections::BTreeMap;

use gump_scene::{Agent, AgentId, Frame, LaneKind, LightState, Rollout, Scenario};

use super::input::{
    Log, N_FUTURE, N_HISTORY, N_STEPS, Rollouts, Signal, SignalLane, State, Track, Trajectory,
};
use super::{Mode, WosacError};

impl Log {
    /// The 9.1 s around the present of a scenario at 10 Hz.
    ///
    /// A scenario does not contain the values of invalid states of a Waymo recording, nor whether a
    /// red light flashes: invalid states are zeros, and all red lights require a stop. To reproduce
    /// official scores of Waymo recordings to the last digit, convert the messages instead.
    ///
    /// # Errors
    /// [`WosacError::Clock`] for another rate, fewer than 10 frames of past or 80 of future.
    pub fn of(scenario: &Scenario) -> Result<Self, WosacError> {
        let log = window(scenario)?;
        let mut tracks: BTreeMap<AgentId, Track> = BTreeMap::new();
        for (step, agent) in by_step(log) {
            let track = tracks.entry(agent.id).or_insert_with(|| {
                Track::new(agent.id, agent.kind, vec![State::default(); N_STEPS])
            });
            track.states[step] = state(agent);
        }
        let map = &scenario.map;
        let edges = map.road_edges().iter().map(|edge| {
            let points = edge.line.points().iter().zip(&edge.elevation);
            points
                .map(|(p, &z)| [p.x as f32, p.y as f32, z as f32])
                .collect()
        });
        let streets = map.lanes().iter();
        let streets = streets.filter(|lane| lane.kind == LaneKind::SurfaceStreet);
        Ok(Self {
            scenario: scenario.id.clone(),
            tracks: tracks.into_values().collect(),
            ego: Some(scenario.ego),
            targets: scenario.targets.clone(),
            road_edges: edges.collect(),
            lanes: streets
                .map(|lane| SignalLane {
                    id: lane.id.0,
                    points: lane
                        .centerline
                        .points()
                        .iter()
                        .map(|p| [p.x as f32, p.y as f32])
                        .collect(),
                })
                .collect(),
            signals: log.iter().map(signals).collect(),
        })
    }
}

fn window(scenario: &Scenario) -> Result<&[Frame], WosacError> {
    let wrong = |expected, found| WosacError::Clock {
        scenario: scenario.id.clone(),
        expected,
        found,
    };
    if (scenario.dt - 0.1).abs() > 1e-6 {
        let found = format!("{} s", scenario.dt);
        return Err(wrong("steps of 0.1 s", found));
    }
    let first = (scenario.now + 1).checked_sub(N_HISTORY);
    let window = first.and_then(|first| scenario.log.get(first..first + N_STEPS));
    window.ok_or_else(|| {
        let (past, future) = (scenario.now, scenario.future().len());
        let found = format!("{past} and {future}");
        wrong(
            "at least 10 steps before the present and 80 after it",
            found,
        )
    })
}

fn by_step(frames: &[Frame]) -> impl Iterator<Item = (usize, &Agent)> {
    let steps = frames.iter().enumerate();
    steps.flat_map(|(step, frame)| frame.agents().iter().map(move |agent| (step, agent)))
}

fn state(agent: &Agent) -> State {
    let pose = agent.state.pose;
    let position = [pose.position.x, pose.position.y, agent.elevation].map(|v| v as f32);
    State::new(position, pose.heading as f32, size(agent))
}

fn size(agent: &Agent) -> [f32; 3] {
    [agent.length, agent.width, agent.height].map(|v| v as f32)
}

fn signals(frame: &Frame) -> Vec<Signal> {
    let lights = frame.lights().iter();
    let signal = |light: &gump_scene::Light| Signal {
        lane: light.lane.0,
        stop: light.state == LightState::Red,
        stop_point: light
            .stop_point
            .map_or([0.0; 2], |p| [p.x as f32, p.y as f32]),
    };
    lights.map(signal).collect()
}

impl Rollouts {
    /// Rollouts of a world, at 10 Hz and 80 steps long, of the agents present at the start.
    ///
    /// The challenge has no absent agents, so an agent that a world removes stays at its last
    /// position. Scenario generation also needs past and boxes: the past is the history of the
    /// rollouts, and an agent that was not yet present stands where it first appears.
    ///
    /// # Errors
    /// [`WosacError::Clock`] for another rate or another number of steps.
    pub fn of(scenario: &str, rollouts: &[Rollout], mode: Mode) -> Result<Self, WosacError> {
        let wrong = |expected, found| WosacError::Clock {
            scenario: scenario.into(),
            expected,
            found,
        };
        let future = |rollout: &Rollout| {
            let n_past = rollout.history().len();
            if (rollout.dt() - 0.1).abs() > 1e-6 {
                return Err(wrong(
                    "rollouts in steps of 0.1 s",
                    format!("{} s", rollout.dt()),
                ));
            }
            if rollout.steps() != N_FUTURE {
                let found = format!("{} steps", rollout.steps());
                return Err(wrong("rollouts of 80 steps", found));
            }
            if mode == Mode::Generation && n_past < N_HISTORY {
                return Err(wrong("11 steps of history", format!("{n_past} steps")));
            }
            let past = match mode {
                Mode::SimAgents => &[],
                Mode::Generation => &rollout.history()[n_past - N_HISTORY..],
            };
            let frames: Vec<&Frame> = past.iter().chain(rollout.imagined()).collect();
            let agents = rollout.start().agents().iter();
            Ok(agents
                .map(|agent| trajectory(agent, &frames, mode))
                .collect())
        };
        let futures = rollouts.iter().map(future).collect::<Result<_, _>>()?;
        Ok(Self::new(scenario, futures))
    }
}

fn trajectory(present: &Agent, frames: &[&Frame], mode: Mode) -> Trajectory {
    let found = frames.iter().map(|frame| frame.agent(present.id));
    let mut last = found.clone().flatten().next().unwrap_or(present);
    if mode == Mode::SimAgents {
        last = present;
    }
    let agents = found.map(|agent| {
        last = agent.unwrap_or(last);
        last
    });
    let agents: Vec<&Agent> = agents.collect();
    let column = |f: &dyn Fn(&Agent) -> f64| agents.iter().map(|a| f(a) as f32).collect();
    let drive = Trajectory::new(
        present.id,
        column(&|a| a.state.pose.position.x),
        column(&|a| a.state.pose.position.y),
        column(&|a| a.elevation),
        column(&|a| a.state.pose.heading),
    );
    match mode {
        Mode::SimAgents => drive,
        Mode::Generation => drive.with_box(
            present.kind,
            agents.iter().map(|agent| size(agent)).collect(),
        ),
    }
}
