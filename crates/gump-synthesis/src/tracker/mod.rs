//! Simulation of a tracker on the ego: hidden agents are missing, tracks begin late and end early,
//! and states have errors.
//!
//! Start with [`track`]. `sight` determines which agents are visible, `noise` the errors of their
//! states. Both are drawn per agent from the seed and the agent's id, so the errors of an agent do
//! not depend on other agents.

mod noise;
mod sight;

use std::collections::BTreeMap;

use gump_scene::{Agent, AgentId, Frame, Light, Scenario, Seed};

use self::noise::Noise;
use self::sight::Sight;

/// Quality of a tracker.
#[derive(Clone, Debug, PartialEq)]
pub struct Tracker {
    /// Maximum distance of visible agents from the ego, metres; `None` means no limit and no
    /// occlusion.
    pub range_m: Option<f64>,
    /// Share of an agent's outline that must be visible.
    pub visible_share: f64,
    /// Metres beside the road that are open; behind are buildings, which block the view.
    pub open_m: std::ops::Range<f64>,
    /// Time in view before a track begins, seconds.
    pub begins_after_s: std::ops::Range<f64>,
    /// Time out of view before a track ends, seconds.
    pub coasts_s: std::ops::Range<f64>,
    /// Rate at which a visible vehicle is lost anyway, per second, at the end of the range.
    /// Pedestrians and bicycles are lost more often, see `sight`.
    pub misses_per_s: f64,
    /// Multiplies all errors of pose, velocity and size; 0 gives true states.
    pub noise: f64,
}

impl Tracker {
    /// The quality of the recordings from which `configs/targets/waymo-like.toml` was measured,
    /// fitted by hand to those distributions.
    pub fn recorded_like() -> Self {
        Self {
            range_m: Some(79.0),
            visible_share: 0.3,
            open_m: 9.0..20.0,
            begins_after_s: 0.0..0.4,
            coasts_s: 0.1..0.8,
            misses_per_s: 0.2,
            noise: 1.0,
        }
    }

    /// A perfect tracker.
    pub fn perfect() -> Self {
        Self {
            range_m: None,
            noise: 0.0,
            ..Self::recorded_like()
        }
    }
}

/// Replaces the log of a scenario by the tracker's recording of it.
///
/// The ego is always present, with the errors of its own motion only; static agents (cones, signs)
/// are not changed. Targets and objects of interest that are not visible at the present are
/// dropped, and the tags are those of what is visible.
pub fn track(scenario: &mut Scenario, tracker: &Tracker, seed: Seed) {
    let seen = Sight::of(scenario, tracker, seed.fork(0));
    let mut noises: BTreeMap<AgentId, Noise> = BTreeMap::new();
    let dt = scenario.dt;
    let mut log = Vec::with_capacity(scenario.log.len());
    for (step, frame) in scenario.log.iter().enumerate() {
        let ego = frame.agent(scenario.ego).map(|ego| ego.state.pose.position);
        let mut agents = Vec::with_capacity(frame.agents().len());
        for agent in frame.agents() {
            if !agent.kind.is_moving() {
                agents.push(*agent);
                continue;
            }
            let is_ego = agent.id == scenario.ego;
            let noise = noises.entry(agent.id).or_insert_with(|| {
                let seed = seed.fork(1).fork(agent.id.0 as u64);
                Noise::new(agent, is_ego, tracker.noise, seed)
            });
            let position = agent.state.pose.position;
            let distance = ego.map_or(0.0, |ego| ego.distance(position));
            // Errors continue out of sight, so that visibility changes no error.
            let shown = noise.step(agent, distance, dt);
            if is_ego || seen.is_tracked(agent.id, step) {
                agents.push(shown);
            }
        }
        let lights = frame.lights().iter();
        let lights = lights.filter(|light| is_light_seen(light, ego, tracker));
        log.push(Frame::new(agents, lights.copied().collect()));
    }
    scenario.log = log;
    let now = scenario.log[scenario.now].clone();
    let is_there = |id: &AgentId| now.agent(*id).is_some();
    scenario.targets.retain(is_there);
    scenario.objects_of_interest.retain(is_there);
    scenario.tags = gump_metrics::tags::extract_tags(scenario);
}

/// Lights are visible from farther than boxes, because they face the traffic; a tenth is a
/// guess.
fn is_light_seen(light: &Light, ego: Option<gump_geometry::DVec2>, tracker: &Tracker) -> bool {
    match (light.stop_point, ego, tracker.range_m) {
        (Some(at), Some(ego), Some(range)) => at.distance(ego) < 1.1 * range,
        _ => true,
    }
}

/// True if the agent has hardly moved so far.
fn stands(agent: &Agent) -> bool {
    agent.state.speed() < 0.05
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{SynthesisConfig, synthesize};

    fn tracked(tracker: &Tracker) -> (Scenario, Scenario) {
        let clean = synthesize(&SynthesisConfig::standard(), Seed(4));
        let mut seen = clean.clone();
        track(&mut seen, tracker, Seed(9));
        seen.validate().unwrap();
        (clean, seen)
    }

    #[test]
    fn a_perfect_tracker_changes_nothing() {
        let (clean, seen) = tracked(&Tracker::perfect());
        assert_eq!(clean.log, seen.log);
        assert_eq!(clean.targets, seen.targets);
    }

    #[test]
    fn one_seed_one_recording() {
        let tracker = Tracker::recorded_like();
        assert_eq!(tracked(&tracker).1.log, tracked(&tracker).1.log);
        let mut other = tracked(&tracker).0;
        track(&mut other, &tracker, Seed(10));
        assert_ne!(other.log, tracked(&tracker).1.log);
    }

    #[test]
    fn nobody_is_seen_beyond_the_range_and_everybody_near_their_place() {
        let (clean, seen) = tracked(&Tracker::recorded_like());
        let (mut states, mut all) = (0, 0);
        for (before, after) in clean.log.iter().zip(&seen.log) {
            let ego = after.agent(seen.ego).unwrap().state.pose.position;
            all += before.agents().len();
            states += after.agents().len();
            for agent in after.agents() {
                let truth = before.agent(agent.id).unwrap();
                let pose = agent.state.pose;
                assert!(pose.position.distance(ego) < 82.0);
                assert!(pose.position.distance(truth.state.pose.position) < 1.0);
                assert_eq!(agent.kind, truth.kind);
            }
        }
        assert!(states < all && states * 10 > all, "{states} of {all}");
    }

    #[test]
    fn without_noise_what_is_seen_is_true() {
        let tracker = Tracker {
            noise: 0.0,
            ..Tracker::recorded_like()
        };
        let (clean, seen) = tracked(&tracker);
        for (before, after) in clean.log.iter().zip(&seen.log) {
            for agent in after.agents() {
                assert_eq!(before.agent(agent.id), Some(agent));
            }
        }
    }
}
