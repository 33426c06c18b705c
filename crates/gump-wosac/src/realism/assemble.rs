//! Checked trajectories of all simulated agents on the time steps of the log.
//!
//! The past is the log's, step by step; the future is a rollout's, or the log's own, with the boxes
//! of the present step. Logged futures are assembled the same way, so they have these boxes too.

use std::collections::{BTreeMap, BTreeSet};

use gump_scene::{AgentId, AgentKind};

use super::WosacError;
use super::config::{Algorithm, Config, Mode};
use super::input::{Log, N_FUTURE, N_HISTORY, N_STEPS, Rollouts, State, Track, Trajectory};

/// The present step.
const NOW: usize = N_HISTORY - 1;

/// All simulated agents over [`N_STEPS`].
pub(crate) struct SimulatedAgents {
    /// State of an agent at a step, agent-major.
    states: Vec<State>,
    /// The kinds of the agents.
    pub(crate) kinds: Vec<AgentKind>,
}

impl SimulatedAgents {
    /// Number of agents.
    pub(crate) fn n_agents(&self) -> usize {
        self.kinds.len()
    }

    /// All states of an agent.
    pub(crate) fn states(&self, agent: usize) -> &[State] {
        &self.states[agent * N_STEPS..][..N_STEPS]
    }

    /// The logged agents; `simulated` are their tracks.
    pub(crate) fn logged(simulated: &[&Track], config: &Config) -> Self {
        let mut states = Vec::with_capacity(simulated.len() * N_STEPS);
        for track in simulated {
            let now = track.states[NOW];
            states.extend(track.states.iter().enumerate().map(|(step, &state)| {
                match (config.mode, config.algorithm) {
                    (Mode::Generation, _) => State {
                        valid: now.valid,
                        ..state
                    },
                    (Mode::SimAgents, _) if step <= NOW => state,
                    (Mode::SimAgents, algorithm) => State {
                        size: now.size,
                        valid: state.valid || algorithm == Algorithm::V2023V0,
                        ..state
                    },
                }
            }));
        }
        let kinds = simulated.iter().map(|track| track.kind).collect();
        Self { states, kinds }
    }

    /// One rollout, which has been checked.
    pub(crate) fn imagined(simulated: &[&Track], future: &[Trajectory], mode: Mode) -> Self {
        let by_id: BTreeMap<AgentId, &Trajectory> = future.iter().map(|t| (t.id, t)).collect();
        let mut states = Vec::with_capacity(simulated.len() * N_STEPS);
        let mut kinds = Vec::with_capacity(simulated.len());
        for track in simulated {
            let drive = by_id[&track.id];
            let now = track.states[NOW];
            let at = |i: usize, size| State {
                position: [drive.x[i], drive.y[i], drive.z[i]],
                heading: drive.heading[i],
                size,
                valid: true,
            };
            match (mode, &drive.shape) {
                (Mode::Generation, Some((kind, sizes))) => {
                    kinds.push(*kind);
                    states.extend(sizes.iter().enumerate().map(|(i, &size)| at(i, size)));
                }
                _ => {
                    kinds.push(track.kind);
                    states.extend(&track.states[..N_HISTORY]);
                    states.extend((0..N_FUTURE).map(|i| at(i, now.size)));
                }
            }
        }
        Self { states, kinds }
    }
}

/// Checks a log; the tracks that are simulated, and which of them are scored.
///
/// Scored agents come sorted by id, as the reference has them; for scenario generation all, in the
/// order of the log.
pub(crate) fn roles(log: &Log, mode: Mode) -> Result<(Vec<&Track>, Vec<usize>), WosacError> {
    check_log(log)?;
    let simulated: Vec<_> = log.tracks.iter().filter(|t| t.is_simulated()).collect();
    if mode == Mode::Generation {
        let all = (0..simulated.len()).collect();
        return Ok((simulated, all));
    }
    let scenario = || log.scenario.clone();
    let ego = log.ego.ok_or_else(|| WosacError::NoEgo {
        scenario: scenario(),
    })?;
    let mut scored = Vec::new();
    for id in BTreeSet::from_iter(log.targets.iter().copied().chain([ego])) {
        match simulated.iter().position(|track| track.id == id) {
            Some(i) => scored.push(i),
            None if log.tracks.iter().any(|track| track.id == id) => {
                return Err(WosacError::AbsentNow {
                    scenario: scenario(),
                    agent: id,
                });
            }
            None => {
                let role = if id == ego { "the ego" } else { "target" };
                return Err(WosacError::NoTrack {
                    scenario: scenario(),
                    role,
                    agent: id,
                });
            }
        }
    }
    Ok((simulated, scored))
}

fn check_log(log: &Log) -> Result<(), WosacError> {
    let scenario = || log.scenario.clone();
    let mut seen = BTreeSet::new();
    for track in &log.tracks {
        let agent = track.id;
        if !seen.insert(agent) {
            return Err(WosacError::LoggedTwice {
                scenario: scenario(),
                agent,
            });
        }
        if track.states.len() != N_STEPS {
            return Err(WosacError::LoggedSteps {
                scenario: scenario(),
                agent,
                expected: N_STEPS,
                found: track.states.len(),
            });
        }
        for (step, state) in track.states.iter().enumerate().filter(|(_, s)| s.valid) {
            if let Some((field, expected, value)) = problem(state) {
                return Err(WosacError::LoggedState {
                    scenario: scenario(),
                    agent,
                    field,
                    expected,
                    step,
                    value,
                });
            }
        }
    }
    if !log.signals.is_empty() && log.signals.len() != N_STEPS {
        return Err(WosacError::Clock {
            scenario: scenario(),
            expected: "signals of 91 steps or of none",
            found: format!("{} steps", log.signals.len()),
        });
    }
    check_map(log)
}

/// The name of the first invalid field of a state marked valid.
fn problem(state: &State) -> Option<(&'static str, &'static str, f32)> {
    let [x, y, z] = state.position;
    let [length, width, height] = state.size;
    let numbers = [("x", x), ("y", y), ("z", z), ("heading", state.heading)];
    let extents = [("length", length), ("width", width), ("height", height)];
    let not_number = numbers.into_iter().find(|(_, v)| !v.is_finite());
    let not_extent = extents
        .into_iter()
        .find(|(_, v)| !(v.is_finite() && *v >= 0.0));
    let number = not_number.map(|(field, v)| (field, "a number", v));
    number.or(not_extent.map(|(field, v)| (field, "an extent", v)))
}

fn check_map(log: &Log) -> Result<(), WosacError> {
    let scenario = || log.scenario.clone();
    if !log.road_edges.iter().any(|edge| edge.len() >= 2) {
        return Err(WosacError::NoRoadEdges {
            scenario: scenario(),
        });
    }
    let edges = log.road_edges.iter().flatten().flatten();
    let lanes = log
        .lanes
        .iter()
        .flat_map(|lane| lane.points.iter().flatten());
    let stops = log
        .signals
        .iter()
        .flatten()
        .flat_map(|s| s.stop_point.iter());
    let mut numbers = edges
        .map(|v| ("a road edge", v))
        .chain(lanes.map(|v| ("a lane", v)))
        .chain(stops.map(|v| ("a stop point", v)));
    match numbers.find(|(_, value)| !value.is_finite()) {
        Some((feature, &value)) => Err(WosacError::Map {
            scenario: scenario(),
            feature,
            value,
        }),
        None => Ok(()),
    }
}

/// Checks that rollouts contain what the log requires.
pub(crate) fn check_rollouts(
    scenario: &str,
    simulated: &[&Track],
    rollouts: &Rollouts,
    mode: Mode,
) -> Result<(), WosacError> {
    if rollouts.scenario != scenario {
        return Err(WosacError::OtherScenario {
            expected: scenario.into(),
            found: rollouts.scenario.clone(),
        });
    }
    if rollouts.futures.is_empty() {
        return Err(WosacError::NoRollouts {
            scenario: scenario.into(),
        });
    }
    let expected: BTreeSet<AgentId> = simulated.iter().map(|track| track.id).collect();
    for (rollout, future) in rollouts.futures.iter().enumerate() {
        let scenario = || scenario.to_owned();
        let mut seen = BTreeSet::new();
        for drive in future {
            let agent = drive.id;
            if !expected.contains(&agent) {
                return Err(WosacError::Extra {
                    scenario: scenario(),
                    rollout,
                    agent,
                });
            }
            if !seen.insert(agent) {
                return Err(WosacError::Twice {
                    scenario: scenario(),
                    rollout,
                    agent,
                });
            }
            check_trajectory(scenario, rollout, drive, mode)?;
        }
        if let Some(&agent) = expected.difference(&seen).next() {
            return Err(WosacError::Missing {
                scenario: scenario(),
                rollout,
                agent,
            });
        }
    }
    Ok(())
}

fn check_trajectory(
    scenario: impl Fn() -> String,
    rollout: usize,
    drive: &Trajectory,
    mode: Mode,
) -> Result<(), WosacError> {
    let (agent, expected) = match mode {
        Mode::SimAgents => (drive.id, N_FUTURE),
        Mode::Generation => (drive.id, N_STEPS),
    };
    let steps = |field, found| match found == expected {
        true => Ok(()),
        false => Err(WosacError::Steps {
            scenario: scenario(),
            rollout,
            agent,
            field,
            expected,
            found,
        }),
    };
    let finite = |field, step: Option<usize>, value: &dyn Fn(usize) -> f32| match step {
        None => Ok(()),
        Some(step) => Err(WosacError::NotFinite {
            scenario: scenario(),
            rollout,
            agent,
            field,
            step,
            value: value(step),
        }),
    };
    let columns = [
        ("x", &drive.x),
        ("y", &drive.y),
        ("z", &drive.z),
        ("heading", &drive.heading),
    ];
    for (field, column) in columns {
        steps(field, column.len())?;
        let bad = column.iter().position(|v| !v.is_finite());
        finite(field, bad, &|step| column[step])?;
    }
    if mode == Mode::Generation {
        let none = Vec::new();
        let sizes = drive.shape.as_ref().map_or(&none, |(_, sizes)| sizes);
        steps("size", sizes.len())?;
        for (i, field) in ["length", "width", "height"].into_iter().enumerate() {
            let bad = sizes.iter().position(|size| !size[i].is_finite());
            finite(field, bad, &|step| sizes[step][i])?;
        }
    }
    Ok(())
}
