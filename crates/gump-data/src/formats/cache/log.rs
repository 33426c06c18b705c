//! Encoding of a scenario's log, roles and route; the map is in `map`.
//!
//! Agents are stored by track: the steps at which it is present, then a column per quantity.

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_geometry::{Polyline, Pose, dvec2};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Frame, LaneId, Light, LightState, MapGraph, RoadblockId,
    Route, Scenario, ScenarioTag,
};

use super::bytes::{Decoded, Decoder, Encoder};
use super::map;
use crate::DataError;
use crate::complete::recording::MAX_STEPS;

/// The most lights over all frames, far more than any log has. A run of equal lights takes little
/// room for each, so a damaged file could ask for any amount of memory.
const MAX_LIGHTS: usize = 1 << 24;

const AGENT_KINDS: [AgentKind; 7] = [
    AgentKind::Vehicle,
    AgentKind::Pedestrian,
    AgentKind::Bicycle,
    AgentKind::TrafficCone,
    AgentKind::Barrier,
    AgentKind::Sign,
    AgentKind::Other,
];

const LIGHT_STATES: [LightState; 4] = [
    LightState::Green,
    LightState::Yellow,
    LightState::Red,
    LightState::Unknown,
];

/// The bytes of a scenario.
///
/// Error: [`DataError::Unwritable`] for a log longer than any that is read.
pub(super) fn encode(scenario: &Scenario) -> Result<Vec<u8>, DataError> {
    let unwritable = |problem| DataError::Unwritable {
        id: scenario.id.clone(),
        problem,
    };
    if scenario.log.len() > MAX_STEPS {
        let found = scenario.log.len();
        return Err(unwritable(format!(
            "expected at most {MAX_STEPS} frames, found {found}"
        )));
    }
    let lights: usize = scenario.log.iter().map(|frame| frame.lights().len()).sum();
    if lights > MAX_LIGHTS {
        return Err(unwritable(format!(
            "expected at most {MAX_LIGHTS} lights, found {lights}"
        )));
    }
    let mut to = Encoder::default();
    to.text(&scenario.id);
    to.number(scenario.dt);
    to.count(scenario.now);
    to.id(scenario.ego.0);
    to.ids(scenario.targets.iter().map(|id| id.0));
    to.ids(scenario.objects_of_interest.iter().map(|id| id.0));
    to.count(scenario.tags.len());
    scenario.tags.iter().for_each(|tag| to.text(tag.name()));
    to.option(scenario.route.as_deref(), write_route);
    to.count(scenario.log.len());
    write_tracks(&mut to, &scenario.log);
    write_lights(&mut to, &scenario.log);
    map::write(&mut to, scenario.map.parts());
    Ok(to.bytes)
}

/// The scenario of some bytes, not yet validated.
pub(super) fn decode(bytes: &[u8]) -> Decoded<Scenario> {
    let from = &mut Decoder::new(bytes);
    let id = from.text()?.to_owned();
    let dt = from.number()?;
    let now = from.count()?;
    let ego = AgentId(from.id()?);
    let targets = from.ids(AgentId)?;
    let objects_of_interest = from.ids(AgentId)?;
    let tags = from.list(1, read_tag)?;
    let route = from.option(read_route)?.map(Arc::new);
    let steps = from.count()?;
    if steps > MAX_STEPS {
        return Err(from.damage(format!("at most {MAX_STEPS} frames"), &steps));
    }
    let agents = read_tracks(from, steps)?;
    let lights = read_lights(from, steps)?;
    let frames = agents.into_iter().zip(lights);
    let log = frames.map(|(agents, lights)| Frame::new(agents, lights));
    let log = log.collect();
    let parts = map::read(from)?;
    from.end()?;
    let map = MapGraph::new(parts).map_err(|error| from.damage("a sound map", &error))?;
    Ok(Scenario {
        id,
        map: Arc::new(map),
        route,
        log,
        dt,
        now,
        ego,
        targets,
        objects_of_interest,
        tags,
    })
}

fn read_tag(from: &mut Decoder<'_>) -> Decoded<ScenarioTag> {
    let name = from.text()?;
    name.parse()
        .map_err(|_| from.damage("a scenario tag", &format!("\"{name}\"")))
}

fn write_route(to: &mut Encoder, route: &Route) {
    to.ids(route.lanes.iter().map(|id| id.0));
    to.ids(route.roadblocks.iter().map(|id| id.0));
    to.points(route.path.points());
}

fn read_route(from: &mut Decoder<'_>) -> Decoded<Route> {
    let lanes = from.ids(LaneId)?;
    let roadblocks = from.ids(RoadblockId)?;
    let path: Polyline = from.polyline()?;
    Ok(Route {
        lanes,
        roadblocks,
        path,
    })
}

fn write_tracks(to: &mut Encoder, log: &[Frame]) {
    let mut tracks: BTreeMap<(AgentId, u8), Vec<(usize, &Agent)>> = BTreeMap::new();
    for (step, frame) in log.iter().enumerate() {
        for agent in frame.agents() {
            // An agent may change its kind: then it is two tracks that are never there at once.
            let track = tracks.entry((agent.id, agent.kind as u8)).or_default();
            track.push((step, agent));
        }
    }
    to.count(tracks.len());
    for ((id, _), states) in tracks {
        to.id(id.0);
        to.variant(&AGENT_KINDS, &states[0].1.kind);
        write_steps(to, states.iter().map(|(step, _)| *step));
        let agents = states.iter().map(|(_, agent)| *agent);
        to.numbers(agents.clone().map(|a| a.state.pose.position.x));
        to.numbers(agents.clone().map(|a| a.state.pose.position.y));
        to.numbers(agents.clone().map(|a| a.state.pose.heading));
        to.numbers(agents.clone().map(|a| a.state.velocity.x));
        to.numbers(agents.clone().map(|a| a.state.velocity.y));
        to.even_numbers(agents.clone().map(|a| a.elevation));
        to.even_numbers(agents.clone().map(|a| a.length));
        to.even_numbers(agents.clone().map(|a| a.width));
        to.even_numbers(agents.map(|a| a.height));
    }
}

fn read_tracks(from: &mut Decoder<'_>, steps: usize) -> Decoded<Vec<Vec<Agent>>> {
    let mut frames = vec![Vec::new(); steps];
    for _ in 0..from.count()? {
        let id = AgentId(from.id()?);
        let kind = from.variant(&AGENT_KINDS)?;
        let runs = read_steps(from, steps)?;
        let n = runs.iter().map(|run| run.len()).sum();
        let [x, y, heading] = [from.numbers(n)?, from.numbers(n)?, from.numbers(n)?];
        let [vx, vy] = [from.numbers(n)?, from.numbers(n)?];
        let [elevation, length] = [from.even_numbers(n)?, from.even_numbers(n)?];
        let [width, height] = [from.even_numbers(n)?, from.even_numbers(n)?];
        for (i, step) in runs.into_iter().flatten().enumerate() {
            frames[step].push(Agent {
                id,
                kind,
                length: length[i],
                width: width[i],
                height: height[i],
                elevation: elevation[i],
                state: AgentState {
                    pose: Pose::new(x[i], y[i], heading[i]),
                    velocity: dvec2(vx[i], vy[i]),
                },
            });
        }
    }
    Ok(frames)
}

fn write_lights(to: &mut Encoder, log: &[Frame]) {
    /// A light by its lane and, to the bit, its stop point: the same one from frame to frame.
    type Signal = (LaneId, Option<[u64; 2]>);
    let mut signals: BTreeMap<Signal, Vec<(usize, &Light)>> = BTreeMap::new();
    for (step, frame) in log.iter().enumerate() {
        for light in frame.lights() {
            let place = light.stop_point.map(|p| p.to_array().map(f64::to_bits));
            let signal = signals.entry((light.lane, place)).or_default();
            signal.push((step, light));
        }
    }
    to.count(signals.len());
    for ((lane, place), lights) in signals {
        to.id(lane.0);
        to.option(place, |to, place| {
            place
                .into_iter()
                .for_each(|bits| to.number(f64::from_bits(bits)));
        });
        write_steps(to, lights.iter().map(|(step, _)| *step));
        for (_, light) in lights {
            to.variant(&LIGHT_STATES, &light.state);
        }
    }
}

fn read_lights(from: &mut Decoder<'_>, steps: usize) -> Decoded<Vec<Vec<Light>>> {
    let mut frames = vec![Vec::new(); steps];
    let mut total = 0;
    for _ in 0..from.count()? {
        let lane = LaneId(from.id()?);
        let stop_point = from.option(|from| Ok(dvec2(from.number()?, from.number()?)))?;
        let runs = read_steps(from, steps)?;
        total += runs.iter().map(|run| run.len()).sum::<usize>();
        if total > MAX_LIGHTS {
            return Err(from.damage(format!("at most {MAX_LIGHTS} lights"), &"more"));
        }
        for step in runs.into_iter().flatten() {
            frames[step].push(Light {
                lane,
                state: from.variant(&LIGHT_STATES)?,
                stop_point,
            });
        }
    }
    Ok(frames)
}

/// Ascending steps as runs: the gap before each, and its length.
fn write_steps(to: &mut Encoder, steps: impl Iterator<Item = usize>) {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for step in steps {
        match runs.last_mut() {
            Some((_, end)) if *end == step => *end += 1,
            _ => runs.push((step, step + 1)),
        }
    }
    to.count(runs.len());
    let mut before = 0;
    for (start, end) in runs {
        to.count(start - before);
        to.count(end - start);
        before = end;
    }
}

fn read_steps(from: &mut Decoder<'_>, steps: usize) -> Decoded<Vec<std::ops::Range<usize>>> {
    let mut before = 0_usize;
    from.list(2, |from| {
        let start = before.saturating_add(from.count()?);
        let end = start.saturating_add(from.count()?);
        if end > steps {
            return Err(from.damage(format!("steps up to {steps}"), &end));
        }
        before = end;
        Ok(start..end)
    })
}

#[cfg(test)]
mod tests {
    use gump_scene::{Seed, fixture};
    use rand::Rng as _;

    use super::*;

    #[test]
    fn every_kind_has_its_place() {
        let all = [AgentKind::MOVING.as_slice(), AgentKind::STATIC.as_slice()].concat();
        assert_eq!(all, AGENT_KINDS);
    }

    /// Checksums catch accidents; a record made up with a fitting checksum must do no harm either.
    #[test]
    fn false_records_are_refused_or_harmless() {
        let scenario = fixture::scenario(
            "lane 1: 0,0 50,0 speed 10 next 2
             lane 2: 50,0 90,0
             light 1 red: 50,0
             crosswalk: 40,-3 44,-3 44,3 40,3
             ego vehicle 0: 10,0 velocity 8,0
             agent pedestrian 4: 41,2 velocity 0,-1
             history 0.5 future 0.5 dt 0.1",
        );
        let bytes = encode(&scenario.unwrap()).unwrap();
        decode(&bytes).unwrap();
        let (mut refused, mut rng) = (0, Seed(1).rng());
        for _ in 0..20_000 {
            let mut damaged = bytes.clone();
            for _ in 0..rng.random_range(1..4) {
                let at = rng.random_range(0..damaged.len());
                damaged[at] = rng.random();
            }
            damaged
                .truncate(bytes.len() - rng.random_range(0..2) * rng.random_range(0..bytes.len()));
            refused += usize::from(decode(&damaged).is_err());
        }
        assert!(refused > 10_000, "{refused}");
    }
}
