//! What the viewer tells of agents beside where they are: how realistic their futures are, metrics
//! over time, what a learned world drew from.

use anyhow::Context as _;
use gump_engine::{PredictiveSamples, ProbeConfig};
use gump_eval::worlds::World;
use gump_metrics::behaviour::{Behaviour, Judged, judge};
use gump_rollout::SimulateConfig;
use gump_scene::{Agent, AgentId, Rollout, Scenario, SceneState};
use gump_viz::{HeatMap, MetricTrack, Viewer};
use gump_wosac::realism::{Component, Config, Features, Log, Reference, Rollouts, Year};

use crate::imagine::imagine;
use crate::run::Run;

/// Agents told of, those nearest to the ego: more would make the page larger than it needs to be.
const AGENTS: usize = 32;
/// Draws per agent and step of a heat map.
const DRAWS: usize = 128;
/// How far the futures that the challenge is defined on go, seconds.
const HORIZON_S: u32 = 8;
/// Beyond that a distance means that there is nothing, metres.
const NOTHING: f32 = 1e9;

/// Metrics of the page, by the benchmark's components.
const METRICS: [(Component, &str); 3] = [
    (
        Component::DistanceToNearestObject,
        "distance to the nearest agent, m",
    ),
    (
        Component::TimeToCollision,
        "time to collision, s (capped at 5 s)",
    ),
    (Component::DistanceToRoadEdge, "beyond the road edge, m"),
];

/// Tells how plausible the futures of the agents near the ego are: how likely the log is under
/// them, as the Waymo Sim Agents Challenge of 2025 measures it, times the share of futures in which
/// the agent does nothing that a driver would not do; and what the challenge measures on the way.
/// Nothing of a scene or of futures that the challenge is not defined on: other rates, no log to
/// compare with, no road edge.
pub(crate) fn realism(viewer: &mut Viewer<'_>, scenario: &Scenario, futures: &[Rollout]) {
    let config = Config::of(Year::Y2025);
    let Ok(mut log) = Log::of(scenario) else {
        return;
    };
    log.targets = near(&scenario.present());
    let imagined = Rollouts::of(&scenario.id, futures, config.mode);
    let (Ok(reference), Ok(imagined)) = (Reference::new(&log, &config), imagined) else {
        return;
    };
    let Ok(evaluation) = reference.evaluate(&imagined) else {
        return;
    };
    let realism = evaluation.realism();
    let conduct = Behaviour::new(scenario, HORIZON_S).conduct(futures);
    for judged in judge(realism.iter().map(|one| (one.agent, one.realism)), conduct) {
        if judged.realism.is_some() {
            viewer.realism(judged.conduct.agent, judged.plausibility);
            viewer.deeds(judged.conduct.agent, deeds(&judged));
        }
    }
    for agent in realism {
        viewer.metric(MetricTrack {
            name: "realism of the futures, 0 to 1".into(),
            agent: agent.agent,
            future: None,
            first: scenario.now + 1,
            values: agent.steps,
        });
    }
    let features = reference.features();
    metrics(viewer, features, None, scenario.now + 1);
    for (k, features) in evaluation.imagined.iter().enumerate() {
        metrics(viewer, features, Some(k), 1);
    }
}

/// What an agent does that a driver would not, in words; empty if it does nothing such.
fn deeds(judged: &Judged) -> String {
    let deeds = judged.conduct.deeds.iter();
    let words = deeds.map(|(deed, share)| {
        let name = deed
            .name()
            .replace("slip", "lateral slip")
            .replace('_', " ");
        format!("{name} in {:.0} % of futures", 100.0 * share)
    });
    words.collect::<Vec<_>>().join(", ")
}

/// Agents that move and are near to the ego, without it.
fn near(scene: &SceneState<'_>) -> Vec<AgentId> {
    let ego = scene.ego_now().state.pose.position;
    let mut near: Vec<&Agent> = scene.now().agents().iter().collect();
    near.retain(|agent| agent.kind.is_moving() && agent.id != scene.ego);
    let away = |agent: &Agent| agent.state.pose.position.distance(ego);
    near.sort_by(|a, b| away(a).total_cmp(&away(b)).then(a.id.cmp(&b.id)));
    near.iter().take(AGENTS).map(|agent| agent.id).collect()
}

fn metrics(viewer: &mut Viewer<'_>, features: &Features, future: Option<usize>, first: usize) {
    for (component, name) in METRICS {
        let values = features.values(component).chunks(features.n_steps);
        for (agent, values) in features.agents.iter().zip(values) {
            let there = |&value: &f32| (value.abs() < NOTHING).then_some(f64::from(value));
            viewer.metric(MetricTrack {
                name: name.into(),
                agent: *agent,
                future,
                first,
                values: values.iter().map(there).collect(),
            });
        }
    }
}

/// Imagines the first `n_futures` once more and tells what each agent might have done at every
/// step; a future is the same whatever is imagined beside it.
///
/// Error: a world that is not learned, and what it reports.
pub(crate) fn heat(
    run: &Run,
    viewer: &mut Viewer<'_>,
    world: World,
    scenario: &Scenario,
    n_futures: usize,
    config: &SimulateConfig,
) -> anyhow::Result<()> {
    let watch = ProbeConfig {
        futures: n_futures,
        draws: DRAWS,
    };
    let world = world.watching(watch);
    imagine(run, &world, scenario, n_futures, config, run.seed())?;
    let outlooks = world
        .take_predictive_samples()
        .context("a world that follows rules draws nothing")?;
    for outlook in outlooks {
        viewer.heat(HeatMap {
            agent: outlook.agent,
            future: outlook.future,
            from_s: outlook.from_s(),
            ahead_s: PredictiveSamples::AHEAD_S,
            draws: outlook.draws,
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scenario(future: &str) -> Scenario {
        gump_scene::fixture::scenario(&format!(
            "lane 1: -50,0 250,0
             edge: -50,-4 250,-4
             ego vehicle 3: 10,0 velocity 10,0
             agent vehicle 4: 30,0 velocity 10,0
             agent pedestrian 5: 40,3 velocity 0,1
             agent other 6: 60,3
             history 1 future {future} dt 0.1"
        ))
        .unwrap()
    }

    #[test]
    fn those_who_move_near_the_ego_are_told_of() {
        let scenario = scenario("8");
        assert_eq!(near(&scenario.present()), [AgentId(4), AgentId(5)]);
        let futures = vec![gump_metrics::logged(&scenario); 2];
        let plain = Viewer::new(&scenario).to_html();
        let mut viewer = Viewer::new(&scenario);
        viewer.futures(&futures);
        realism(&mut viewer, &scenario, &futures);
        let html = viewer.to_html();
        let is_told = |what: &str| html.contains(what) && !plain.contains(what);
        for (_, name) in METRICS {
            assert!(is_told(name), "{name}");
        }
        // The ego and two others have a number, the obstacle has none.
        assert_eq!(html.matches("\"realism\":null").count(), 1);
        assert_eq!(plain.matches("\"realism\":null").count(), 4);
    }

    #[test]
    fn a_parked_car_that_pulls_out_in_every_future_has_the_worst_colour() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 250,0
             edge: -50,-8 250,-8
             ego vehicle 3: 10,0 velocity 10,0
             agent vehicle 4: 30,-5
             agent vehicle 5: 30,0 velocity 10,0
             history 1 future 8 dt 0.1",
        )
        .unwrap();
        let pulls_out = || {
            let mut rollout = Rollout::begin(scenario.present());
            for (k, frame) in scenario.future().iter().enumerate() {
                let agents = frame.agents().iter().map(|agent| {
                    let mut agent = *agent;
                    if agent.id == AgentId(4) {
                        agent.state.pose.position.x += 0.002 * (k as f64).powi(2);
                    }
                    agent
                });
                rollout.push(gump_scene::Frame::new(agents.collect(), Vec::new()));
            }
            rollout
        };
        let futures = vec![pulls_out(); 4];
        let mut viewer = Viewer::new(&scenario);
        viewer.futures(&futures);
        realism(&mut viewer, &scenario, &futures);
        let html = viewer.to_html();
        assert!(html.contains("\"deeds\":\"parked move in 100 % of futures\""));
        assert_eq!(html.matches("\"realism\":0.0").count(), 1);
    }

    #[test]
    fn without_a_log_there_is_nothing_to_tell() {
        let scenario = scenario("0");
        let futures = vec![Rollout::begin(scenario.present())];
        let mut viewer = Viewer::new(&scenario);
        realism(&mut viewer, &scenario, &futures);
        assert_eq!(viewer.to_html(), Viewer::new(&scenario).to_html());
    }
}
