//! Annotations of agents beside where they are: how plausible their futures are, and metrics over
//! time.

use gump_metrics::behaviour::{Behaviour, Judged, judge};
use gump_scene::{Agent, AgentId, Rollout, Scenario, SceneState};
use gump_wosac::realism::{Component, Config, Features, Log, Reference, Rollouts, Year};

/// Agents with annotations, those nearest to the ego: more would make pages larger than they need
/// to be. Chosen by hand.
const AGENTS: usize = 32;
/// Length of the futures in the challenge, seconds.
const HORIZON_S: u32 = 8;
/// Distances beyond this mean that there is no object, metres: the metric then has 1e10.
const NOTHING: f32 = 1e9;

/// Metrics with their names, by the benchmark's components.
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

/// Annotations of the futures of a scenario.
#[derive(Clone, Debug, PartialEq)]
pub struct Annotations {
    /// Agents whose log was scored.
    pub agents: Vec<AgentAnnotation>,
    /// Metrics over time.
    pub series: Vec<MetricSeries>,
}

/// Plausibility of an agent's futures.
#[derive(Clone, Debug, PartialEq)]
pub struct AgentAnnotation {
    /// Its id.
    pub agent: AgentId,
    /// The likelihood of its log under the futures, as the Waymo Sim Agents Challenge of 2025
    /// measures it, times the share of futures in which it does nothing that a driver would not do;
    /// 0 to 1.
    pub plausibility: f64,
    /// Its implausible actions, in words; empty if there are none.
    pub deeds: String,
}

/// A metric of one agent over time.
#[derive(Clone, Debug, PartialEq)]
pub struct MetricSeries {
    /// The metric, with its unit.
    pub name: &'static str,
    /// Id of the agent.
    pub agent: AgentId,
    /// The future it is of; `None` for the log.
    pub future: Option<usize>,
    /// The frame of the first value: of the log, or of the future, whose frame 0 is the present.
    pub first: usize,
    /// One value per frame from there on; `None` where undefined.
    pub values: Vec<Option<f64>>,
}

impl Annotations {
    /// Annotations of the agents near the ego; `None` of a scenario or of futures that the challenge
    /// is not defined on: other rates, no log to compare with, no road edge.
    pub fn of(scenario: &Scenario, futures: &[Rollout]) -> Option<Self> {
        let config = Config::of(Year::Y2025);
        let mut log = Log::of(scenario).ok()?;
        log.targets = near(&scenario.present());
        let reference = Reference::new(&log, &config).ok()?;
        let imagined = Rollouts::of(&scenario.id, futures, config.mode).ok()?;
        let evaluation = reference.evaluate(&imagined).ok()?;
        let realism = evaluation.realism();
        let conduct = Behaviour::new(scenario, HORIZON_S).conduct(futures);
        let judged = judge(realism.iter().map(|one| (one.agent, one.realism)), conduct);
        let scored = judged.iter().filter(|judged| judged.realism.is_some());
        let agents = scored.map(|judged| AgentAnnotation {
            agent: judged.conduct.agent,
            plausibility: judged.plausibility,
            deeds: deeds(judged),
        });
        let agents = agents.collect();
        let mut series: Vec<MetricSeries> = realism
            .into_iter()
            .map(|agent| MetricSeries {
                name: "realism of the futures, 0 to 1",
                agent: agent.agent,
                future: None,
                first: scenario.now + 1,
                values: agent.steps,
            })
            .collect();
        series.extend(series_of(reference.features(), None, scenario.now + 1));
        for (k, features) in evaluation.imagined.iter().enumerate() {
            series.extend(series_of(features, Some(k), 1));
        }
        Some(Self { agents, series })
    }
}

/// Implausible actions of an agent, in words; empty if there are none.
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

fn series_of(
    features: &Features,
    future: Option<usize>,
    first: usize,
) -> impl Iterator<Item = MetricSeries> + '_ {
    METRICS.into_iter().flat_map(move |(component, name)| {
        let values = features.values(component).chunks(features.n_steps);
        let agents = features.agents.iter().zip(values);
        agents.map(move |(&agent, values)| {
            let there = |&value: &f32| (value.abs() < NOTHING).then_some(f64::from(value));
            MetricSeries {
                name,
                agent,
                future,
                first,
                values: values.iter().map(there).collect(),
            }
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moving_agents_near_the_ego_are_annotated() {
        let scenario = |future: &str| {
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
        };
        let recorded = scenario("8");
        assert_eq!(near(&recorded.present()), [AgentId(4), AgentId(5)]);
        let futures = vec![gump_metrics::logged(&recorded); 2];
        let annotations = Annotations::of(&recorded, &futures).unwrap();
        let agents: Vec<i64> = annotations.agents.iter().map(|one| one.agent.0).collect();
        assert!(agents.contains(&4) && agents.contains(&5) && !agents.contains(&6));
        for (_, name) in METRICS {
            let mut series = annotations.series.iter();
            let found = series.any(|one| one.name == name && one.future == Some(1));
            assert!(found, "{name}");
        }
        let bare = scenario("0");
        let futures = [Rollout::begin(bare.present())];
        assert_eq!(Annotations::of(&bare, &futures), None);
    }
}
