//! The long part of `evaluate generation`: thirty seconds of traffic with and without agents that
//! come and leave and lights that change, against what was simulated by rules.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use gump_engine::SamplingConfig;
use gump_eval::worlds::World;
use gump_rollout::{BoxError, Start, WorldModel};
use gump_scene::{AgentId, Frame, LaneId, LightState, Scenario, SceneState, Seed};
use gump_synthesis::{SynthesisConfig, try_synthesize};
use gump_viz::Bars;
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::charts;
use crate::run::{Run, stop_if_interrupted};
use crate::shipped;
use crate::verbs::generate;

/// How far ahead is imagined.
const SECONDS: f64 = 30.0;
/// Worlds are looked at as often as networks step, seconds.
const DT: f64 = 0.5;
/// Agents are counted up to this distance from the ego along either axis of the world, metres.
const COUNTED_M: f64 = 80.0;

/// What frames of half a minute show.
#[derive(Clone, Default)]
struct Seen {
    at_end: f64,
    /// How far from the ego agents come, and leave, metres.
    entries_m: Vec<f64>,
    exits_m: Vec<f64>,
    light_changes: f64,
    lights: f64,
    /// Changes from green to yellow, from there to red, from there to green.
    in_order: f64,
    /// How long lights that were seen to change showed [`COLOURS`] until they changed again, seconds.
    phases_s: [Vec<f64>; 3],
}

/// What lights show, in the order in which they do.
const COLOURS: [LightState; 3] = [LightState::Green, LightState::Yellow, LightState::Red];

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
        let sampling = SamplingConfig {
            life,
            ..SamplingConfig::default()
        };
        let traffic = World::without_log(run.device(), &shipped::world(), &sampling)?;
        let imagined = imagined(traffic.model(), &scenarios, seed)?;
        rows.push(row(name, &imagined, &logged));
    }
    stop_if_interrupted()?;
    let world = generate::world(run.device(), weights, true)?;
    let imagined = imagined(&world, &scenarios, seed)?;
    rows.push(row("life of the sequence network", &imagined, &logged));
    Ok(rows)
}

/// What each scene shows when its ego drives as it was recorded: how many are around it depends on
/// where it goes first of all.
fn imagined(
    world: &dyn WorldModel,
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
    let mut began: BTreeMap<LaneId, usize> = BTreeMap::new();
    for (i, frame) in frames.iter().enumerate() {
        let near = |frame: &Frame| near(frame, present.ego);
        let (then, now) = (near(before), near(frame));
        let distance = |frame: &Frame, id: &AgentId| {
            let place = |id| frame.agent(id).map(|agent| agent.state.pose.position);
            Some(place(present.ego)?.distance(place(*id)?))
        };
        let entries = now.difference(&then);
        let entries = entries.filter_map(|id| distance(frame, id));
        seen.entries_m.extend(entries);
        let exits = then.difference(&now);
        let exits = exits.filter_map(|id| distance(before, id));
        seen.exits_m.extend(exits);
        for light in frame.lights() {
            let colour = |state| COLOURS.iter().position(|colour| *colour == state);
            let was = before.light(light.lane).map(|light| light.state);
            let (Some(was), Some(is)) = (was.and_then(colour), colour(light.state)) else {
                continue;
            };
            if was != is {
                seen.light_changes += 1.0;
                seen.in_order += f64::from(u8::from(is == (was + 1) % 3));
                if let Some(began) = began.insert(light.lane, i) {
                    seen.phases_s[was].push((i - began) as f64 * DT);
                }
            }
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
    let mean = |values: &[f64]| {
        let n = values.len();
        (n > 0).then(|| values.iter().sum::<f64>() / n as f64)
    };
    let all = |of: fn(&Seen) -> &[f64]| {
        let pool = |seen: &[Seen]| seen.iter().flat_map(of).copied().collect::<Vec<f64>>();
        (pool(seen), pool(logged))
    };
    let (entries, logged_entries) = all(|s| &s.entries_m);
    let (exits, logged_exits) = all(|s| &s.exits_m);
    let [green, yellow, red] = [
        all(|s| &s.phases_s[0]),
        all(|s| &s.phases_s[1]),
        all(|s| &s.phases_s[2]),
    ];
    let off = [&green, &yellow, &red];
    let off = off.map(|(own, logged)| apart(own, logged));
    let off: Vec<f64> = off.into_iter().flatten().collect();
    json!({
        "world": world,
        "scenes": seen.len(),
        "agents_at_30_s": sum(|s| s.at_end) / n,
        "agent_count_error": error / n,
        "entries": entries.len() as f64 / n,
        "exits": exits.len() as f64 / n,
        "entry_m": mean(&entries),
        "exit_m": mean(&exits),
        "entry_off_m": apart(&entries, &logged_entries),
        "exit_off_m": apart(&exits, &logged_exits),
        "changes_per_light": sum(|s| s.light_changes) / sum(|s| s.lights).max(1.0),
        "changes_in_order": sum(|s| s.in_order) / sum(|s| s.light_changes).max(1.0),
        "green_s": mean(&green.0),
        "yellow_s": mean(&yellow.0),
        "red_s": mean(&red.0),
        "phase_off_s": mean(&off),
    })
}

/// How far apart two distributions are, in the unit of their values: the area between their
/// quantiles (Wasserstein's first distance), at a hundred of them. `None` if one is empty.
fn apart(a: &[f64], b: &[f64]) -> Option<f64> {
    const N: usize = 100;
    if a.is_empty() || b.is_empty() {
        return None;
    }
    let sorted = |values: &[f64]| {
        let mut values = values.to_vec();
        values.sort_by(f64::total_cmp);
        values
    };
    let (a, b) = (sorted(a), sorted(b));
    let quantile = |values: &[f64], i: usize| values[(2 * i + 1) * values.len() / (2 * N)];
    let off = (0..N).map(|i| (quantile(&a, i) - quantile(&b, i)).abs());
    Some(off.sum::<f64>() / N as f64)
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
    use gump_scene::{Light, fixture};
    use gump_viz::log_as_rollout;

    use super::*;

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
        let counts = (found.entries_m.len(), found.exits_m.len());
        assert_eq!((counts, found.at_end), ((1, 1), 2.0));
        assert!((found.exits_m[0] - 80.0).abs() < 1.0 && (found.entries_m[0] - 80.0).abs() < 1.0);
    }

    #[test]
    fn phases_count_from_change_to_change() {
        let scenario = fixture::scenario("lane 1: 0,0 9,0\nego vehicle 0: 0,0").unwrap();
        let frame = |state: LightState| {
            let light = Light {
                lane: LaneId(1),
                state,
                stop_point: None,
            };
            Frame::new(scenario.present().now().agents().to_vec(), vec![light])
        };
        let [green, yellow, red] = COLOURS;
        let mut shown = vec![green; 4];
        shown.extend([yellow; 6]);
        shown.extend([red; 10]);
        shown.extend([yellow; 3]);
        let frames: Vec<Frame> = shown.into_iter().map(frame).collect();
        let found = seen(scenario.present(), &frames);
        // Green was there before the first change, the last yellow goes on.
        assert_eq!(found.phases_s, [vec![], vec![3.0], vec![5.0]]);
        assert_eq!((found.light_changes, found.in_order), (3.0, 2.0));
    }

    #[test]
    fn distributions_are_as_far_apart_as_their_values_are() {
        assert_eq!(apart(&[1.0, 3.0], &[3.0, 1.0]), Some(0.0));
        assert_eq!(apart(&[1.0], &[2.0, 2.0, 4.0, 4.0]), Some(2.0));
        assert_eq!(apart(&[], &[1.0]), None);
    }
}
