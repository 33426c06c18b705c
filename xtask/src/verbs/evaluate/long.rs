//! The long part of `evaluate generation`: thirty seconds of traffic with and without agents that
//! come and leave and lights that change, against what was simulated by rules.

use std::collections::BTreeSet;
use std::path::PathBuf;

use gump_model::world::TransformerWorld;
use gump_rollout::{BoxError, Start, WorldModel as _};
use gump_scene::{AgentId, Frame, LightState, Scenario, SceneState, Seed};
use gump_synthesis::{SynthesisConfig, try_synthesize};
use gump_viz::Bars;
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::charts;
use crate::run::{Run, stop_if_interrupted};
use crate::verbs::generate;

/// How far ahead is imagined.
const SECONDS: f64 = 30.0;
/// Worlds are looked at as often as networks step, seconds.
const DT: f64 = 0.5;
/// Agents are counted up to this distance from the ego along either axis of the world, metres.
const COUNTED_M: f64 = 80.0;

/// What frames of half a minute show.
#[derive(Clone, Copy, Default)]
struct Seen {
    at_end: f64,
    entries: f64,
    exits: f64,
    exit_m: f64,
    light_changes: f64,
    lights: f64,
}

/// One row per world: log, frozen casts, traffic that lives.
///
/// Error: weights that cannot be read, or a world that fails.
pub(super) fn rows(run: &Run, weights: Option<&PathBuf>, n: usize) -> anyhow::Result<Vec<Value>> {
    let config = SynthesisConfig {
        future_s: SECONDS,
        ..SynthesisConfig::standard()
    };
    let seed = run.seed();
    // Few drive through a scene for half a minute, and in some scenes nobody does.
    let mut scenarios: Vec<Scenario> = (0..2 * n as u64)
        .into_par_iter()
        .filter_map(|i| try_synthesize(&config, seed.fork(100 + i)))
        .collect();
    scenarios.truncate(n);
    let logged: Vec<Seen> = scenarios
        .iter()
        .map(|scenario| seen(scenario.present(), &strided(scenario, DT)))
        .collect();
    let mut rows = vec![row("log", &logged, &logged)];
    for (name, life) in [("those who are there", false), ("life", true)] {
        stop_if_interrupted()?;
        let world = generate::world(run.device(), weights, life)?;
        let imagined = imagined(&world, &scenarios, seed)?;
        rows.push(row(name, &imagined, &logged));
    }
    Ok(rows)
}

/// What each scene shows when its ego drives as it was recorded: how many are around it depends on
/// where it goes first of all.
fn imagined(
    world: &TransformerWorld,
    scenarios: &[Scenario],
    seed: Seed,
) -> anyhow::Result<Vec<Seen>> {
    let one = |(i, scenario): (usize, &Scenario)| {
        let start = Start {
            scene: scenario.present(),
            n_futures: 1,
            seed: seed.fork(i as u64),
        };
        let imagine = || {
            let mut session = world.open(&[start])?;
            let mut frames = Vec::new();
            for recorded in strided(scenario, DT) {
                let ego = recorded.agent(scenario.ego).map(|ego| ego.state);
                let ego = ego.map(|state| vec![state]);
                frames.extend(session.step(ego.as_deref())?);
            }
            Ok(frames)
        };
        let frames: Result<Vec<Frame>, BoxError> = imagine();
        let frames = frames.map_err(|error| anyhow::anyhow!(error))?;
        Ok(seen(scenario.present(), &frames))
    };
    scenarios.par_iter().enumerate().map(one).collect()
}

/// The recorded future, a frame every `dt` seconds.
fn strided(scenario: &Scenario, dt: f64) -> Vec<Frame> {
    let stride = (dt / scenario.dt).round().max(1.0) as usize;
    let frames = scenario.future().iter().skip(stride - 1);
    frames.step_by(stride).cloned().collect()
}

/// What frames after a present show.
fn seen(present: SceneState<'_>, frames: &[Frame]) -> Seen {
    let mut seen = Seen::default();
    let mut before = present.now();
    for frame in frames {
        let near = |frame: &Frame| near(frame, present.ego);
        let (then, now) = (near(before), near(frame));
        seen.entries += now.difference(&then).count() as f64;
        for id in then.difference(&now) {
            seen.exits += 1.0;
            let ego = before.agent(present.ego).map(|ego| ego.state.pose.position);
            let left = before.agent(*id).map(|agent| agent.state.pose.position);
            if let (Some(ego), Some(left)) = (ego, left) {
                seen.exit_m += ego.distance(left);
            }
        }
        let known = |state: LightState| state != LightState::Unknown;
        for light in frame.lights().iter().filter(|light| known(light.state)) {
            let was = before.light(light.lane).map(|light| light.state);
            let changed = was.is_some_and(|was| known(was) && was != light.state);
            seen.light_changes += f64::from(u8::from(changed));
        }
        before = frame;
    }
    seen.lights = before.lights().len() as f64;
    seen.at_end = near(before, present.ego).len() as f64;
    seen
}

/// Moving agents around the ego, by id.
fn near(frame: &Frame, ego: AgentId) -> BTreeSet<AgentId> {
    let Some(centre) = frame.agent(ego).map(|ego| ego.state.pose.position) else {
        return BTreeSet::new();
    };
    let agents = frame.agents().iter();
    agents
        .filter(|agent| agent.id != ego && agent.kind.is_moving())
        .filter(|agent| (agent.state.pose.position - centre).abs().max_element() <= COUNTED_M)
        .map(|agent| agent.id)
        .collect()
}

fn row(world: &str, seen: &[Seen], logged: &[Seen]) -> Value {
    let n = seen.len().max(1) as f64;
    let sum = |of: fn(&Seen) -> f64| seen.iter().map(of).sum::<f64>();
    let pairs = seen.iter().zip(logged);
    let error: f64 = pairs.map(|(a, b)| (a.at_end - b.at_end).abs()).sum();
    json!({
        "world": world,
        "scenes": seen.len(),
        "agents_at_30_s": sum(|s| s.at_end) / n,
        "agent_count_error": error / n,
        "entries": sum(|s| s.entries) / n,
        "exits": sum(|s| s.exits) / n,
        "exit_distance_m": sum(|s| s.exit_m) / sum(|s| s.exits).max(1.0),
        "changes_per_light": sum(|s| s.light_changes) / sum(|s| s.lights).max(1.0),
    })
}

/// What changes in half a minute, in every world.
pub(super) fn chart(rows: &[Value]) -> Bars {
    let counts = [
        ("agents at 30 s", "agents_at_30_s"),
        ("error of the count", "agent_count_error"),
        ("entries", "entries"),
        ("exits", "exits"),
        ("changes per light", "changes_per_light"),
    ];
    let worlds = rows.iter().filter_map(|row| row["world"].as_str());
    let legend = worlds.map(String::from).collect();
    let label = "within 80 m of the ego, mean over scenes";
    let names = counts.map(|(name, _)| name.into()).into();
    charts::bars(label, names, legend, |count, world| {
        charts::bar(&rows[world][counts[count].1], &Value::Null, &Value::Null)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::fixture;
    use gump_viz::log_as_rollout;

    #[test]
    fn who_comes_and_goes_is_counted() {
        // One drives out of the counted square, one into it; one stays.
        let scenario = fixture::scenario(
            "ego vehicle 0: 0,0\nagent vehicle 1: 70,0 velocity 5,0\n\
             agent vehicle 2: -90,0 velocity 5,0\nagent pedestrian 3: 5,5",
        )
        .unwrap();
        let rollout = log_as_rollout(&scenario);
        let found = seen(scenario.present(), rollout.imagined());
        assert_eq!((found.entries, found.exits, found.at_end), (1.0, 1.0, 2.0));
        assert!((found.exit_m - 80.0).abs() < 1.0);
    }
}
