//! Annotations of the viewer: [`gump_eval::annotations`] as it shows them.

use gump_eval::annotations::Annotations;
use gump_rollout::{PredictiveSamples, ProbeConfig};
use gump_scene::{Rollout, Scenario};
use gump_viz::{HeatMap, MetricTrack, Viewer};

/// Draws per agent and step of a heat map: smooth enough to the eye. Chosen by eye.
const DRAWS: usize = 128;

/// Shows how plausible the futures of the agents near the ego are, and what the challenge measures
/// of them; nothing where it is not defined.
pub(crate) fn plausibility(viewer: &mut Viewer<'_>, scenario: &Scenario, futures: &[Rollout]) {
    let Some(annotations) = Annotations::of(scenario, futures) else {
        return;
    };
    for agent in annotations.agents {
        viewer.plausibility(agent.agent, agent.plausibility);
        viewer.deeds(agent.agent, agent.deeds);
    }
    for series in annotations.series {
        viewer.metric(MetricTrack {
            name: series.name.into(),
            agent: series.agent,
            future: series.future,
            first: series.first,
            values: series.values,
        });
    }
}

/// The predictive samples that heat maps of the first `n_futures` are made of.
pub(crate) fn probe(n_futures: usize) -> ProbeConfig {
    ProbeConfig {
        futures: n_futures,
        draws: DRAWS,
    }
}

/// Shows what each agent might have done at every step of the futures that were probed.
pub(crate) fn heat(viewer: &mut Viewer<'_>, samples: Vec<PredictiveSamples>) {
    for sample in samples {
        viewer.heat(HeatMap {
            agent: sample.agent,
            future: sample.future,
            from_s: sample.from_s(),
            ahead_s: sample.step_s,
            draws: sample.draws,
        });
    }
}

#[cfg(test)]
mod tests {
    use gump_scene::AgentId;

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
    fn agents_near_the_ego_have_annotations() {
        let scenario = scenario("8");
        let futures = vec![gump_metrics::logged(&scenario); 2];
        let plain = Viewer::new(&scenario).to_html();
        let mut viewer = Viewer::new(&scenario);
        viewer.futures(&futures);
        plausibility(&mut viewer, &scenario, &futures);
        let html = viewer.to_html();
        let is_shown = |what: &str| html.contains(what) && !plain.contains(what);
        for name in [
            "distance to the nearest agent, m",
            "beyond the road edge, m",
        ] {
            assert!(is_shown(name), "{name}");
        }
        // The ego and two others have a number, the obstacle has none.
        assert_eq!(html.matches("\"plausibility\":null").count(), 1);
        assert_eq!(plain.matches("\"plausibility\":null").count(), 4);
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
        plausibility(&mut viewer, &scenario, &futures);
        let html = viewer.to_html();
        assert!(html.contains("\"deeds\":\"parked move in 100 % of futures\""));
        assert_eq!(html.matches("\"plausibility\":0.0").count(), 1);
    }

    #[test]
    fn without_a_log_there_are_no_annotations() {
        let scenario = scenario("0");
        let futures = vec![Rollout::begin(scenario.present())];
        let mut viewer = Viewer::new(&scenario);
        plausibility(&mut viewer, &scenario, &futures);
        assert_eq!(viewer.to_html(), Viewer::new(&scenario).to_html());
    }
}
