//! Half a minute of traffic in which agents come and leave and lights change, observed in a world
//! beside what was simulated by rules.

use std::collections::{BTreeMap, BTreeSet};

use gump_rollout::{BoxError, Start, WorldModel};
use gump_scene::{AgentId, Frame, LaneId, LightState, Scenario, SceneState, Seed};
use gump_synthesis::{SynthesisConfig, try_synthesize};
use rayon::prelude::*;
use serde::Serialize;

use crate::EvalError;

/// Length of the futures, seconds: agents come and leave, and lights change, within it.
const SECONDS: f64 = 30.0;
/// Worlds are looked at as often as networks step, seconds.
const DT: f64 = 0.5;
/// Agents are counted up to this distance from the ego along either axis of the world, metres: a
/// network's window of 100 m, which follows the ego every 20 m, always has it.
const COUNTED_M: f64 = 80.0;

/// Observations of one scene over half a minute.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LongObservation {
    /// Agents around the ego at the end.
    at_end: f64,
    /// Distances from the ego at which agents come, and leave, metres.
    entries_m: Vec<f64>,
    exits_m: Vec<f64>,
    light_changes: f64,
    lights: f64,
    /// Changes from green to yellow, from there to red, from there to green.
    in_order: f64,
    /// Durations of [`COLOURS`] between two observed changes of a light, seconds.
    phases_s: [Vec<f64>; 3],
}

/// The observations of several scenes beside those of the log; `None` where nothing was observed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LongSummary {
    /// Number of scenes.
    pub scenes: usize,
    /// Agents around the ego after 30 s, mean over scenes.
    pub agents_at_30_s: f64,
    /// Mean absolute difference of that number from the log's.
    pub agent_count_error: f64,
    /// Agents that come per scene.
    pub entries: f64,
    /// Agents that leave per scene.
    pub exits: f64,
    /// Mean distance from the ego at which agents come, metres.
    pub entry_m: Option<f64>,
    /// Mean distance from the ego at which agents leave, metres.
    pub exit_m: Option<f64>,
    /// Wasserstein distance of the former distances from the log's, metres.
    pub entry_off_m: Option<f64>,
    /// Wasserstein distance of the latter distances from the log's, metres.
    pub exit_off_m: Option<f64>,
    /// Changes per traffic light.
    pub changes_per_light: f64,
    /// Share of changes from green to yellow, yellow to red, red to green.
    pub changes_in_order: f64,
    /// Mean length of green, seconds.
    pub green_s: Option<f64>,
    /// Mean length of yellow, seconds.
    pub yellow_s: Option<f64>,
    /// Mean length of red, seconds.
    pub red_s: Option<f64>,
    /// Wasserstein distance of the lengths from the log's, mean over colours, seconds.
    pub phase_off_s: Option<f64>,
}

/// States of a traffic light in their order.
const COLOURS: [LightState; 3] = [LightState::Green, LightState::Yellow, LightState::Red];

/// At most `n` synthetic scenes with 30 s of future. There are fewer where more than half fail: few
/// agents drive through a scene for half a minute, and in some scenes nobody does.
pub fn long_scenes(n: usize, seed: Seed) -> Vec<Scenario> {
    let config = SynthesisConfig {
        future_s: SECONDS,
        ..SynthesisConfig::standard()
    };
    let mut scenarios: Vec<Scenario> = (0..2 * n as u64)
        .into_par_iter()
        .filter_map(|i| try_synthesize(&config, seed.fork(100 + i)))
        .collect();
    scenarios.truncate(n);
    scenarios
}

/// The observations of the logs.
pub fn observe_logs(scenarios: &[Scenario]) -> Vec<LongObservation> {
    let of_log = |scenario: &Scenario| observe(scenario.present(), &strided(scenario, DT));
    scenarios.iter().map(of_log).collect()
}

/// The observations of one future of each scene in a world. The ego drives as it was recorded,
/// because the number of agents around it depends most on where it goes.
///
/// # Errors
/// An error of the world.
pub fn observe_world(
    world: &dyn WorldModel,
    scenarios: &[Scenario],
    seed: Seed,
) -> Result<Vec<LongObservation>, EvalError> {
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
        let frames = frames.map_err(EvalError::of_simulation)?;
        Ok(observe(scenario.present(), &frames))
    };
    scenarios.par_iter().enumerate().map(one).collect()
}

/// The recorded future, a frame every `dt` seconds.
fn strided(scenario: &Scenario, dt: f64) -> Vec<Frame> {
    let stride = (dt / scenario.dt).round().max(1.0) as usize;
    let frames = scenario.future().iter().skip(stride - 1);
    frames.step_by(stride).cloned().collect()
}

/// The observations of the frames after a present.
fn observe(present: SceneState<'_>, frames: &[Frame]) -> LongObservation {
    let mut seen = LongObservation::default();
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

/// Sums observations up, beside those of the log of the same scenes.
pub fn summarize_long(seen: &[LongObservation], logged: &[LongObservation]) -> LongSummary {
    let n = seen.len().max(1) as f64;
    let sum = |of: fn(&LongObservation) -> f64| seen.iter().map(of).sum::<f64>();
    let pairs = seen.iter().zip(logged);
    let error: f64 = pairs.map(|(a, b)| (a.at_end - b.at_end).abs()).sum();
    let mean = |values: &[f64]| {
        let n = values.len();
        (n > 0).then(|| values.iter().sum::<f64>() / n as f64)
    };
    let all = |of: fn(&LongObservation) -> &[f64]| {
        let pool =
            |seen: &[LongObservation]| seen.iter().flat_map(of).copied().collect::<Vec<f64>>();
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
    LongSummary {
        scenes: seen.len(),
        agents_at_30_s: sum(|s| s.at_end) / n,
        agent_count_error: error / n,
        entries: entries.len() as f64 / n,
        exits: exits.len() as f64 / n,
        entry_m: mean(&entries),
        exit_m: mean(&exits),
        entry_off_m: apart(&entries, &logged_entries),
        exit_off_m: apart(&exits, &logged_exits),
        changes_per_light: sum(|s| s.light_changes) / sum(|s| s.lights).max(1.0),
        changes_in_order: sum(|s| s.in_order) / sum(|s| s.light_changes).max(1.0),
        green_s: mean(&green.0),
        yellow_s: mean(&yellow.0),
        red_s: mean(&red.0),
        phase_off_s: mean(&off),
    }
}

/// Distance of two distributions in the unit of their values: the area between their quantile
/// functions (first Wasserstein distance), from a hundred quantiles. `None` if one is empty.
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

#[cfg(test)]
mod tests {
    use gump_scene::{Light, fixture};

    use super::*;

    #[test]
    fn who_comes_and_goes_is_counted() {
        // One drives out of the counted square, one into it; one stays.
        let scenario = fixture::scenario(
            "ego vehicle 0: 0,0\nagent vehicle 1: 70,0 velocity 5,0\n\
             agent vehicle 2: -90,0 velocity 5,0\nagent pedestrian 3: 5,5",
        )
        .unwrap();
        let found = observe(scenario.present(), scenario.future());
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
        let found = observe(scenario.present(), &frames);
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
