//! `evaluate generation`: how like recorded scenes generated ones are, beside simpler ways of
//! making them.
//!
//! Likeness is the maximum mean discrepancy in TrafficGen's protocol, as the GUMP paper has it:
//! vehicles within 50 m of the recorded ego, which every source is given with as many vehicles as
//! were recorded. Prompts are judged on scenes of their own.

use std::path::PathBuf;
use std::sync::Arc;

use gump_metrics::mmd::{MmdMean, MmdProtocol, scene_mmd};
use gump_model::generation::baseline::{
    overlapping_vehicles, random_along_lanes, retrieved, wrong_way,
};
use gump_model::generation::constraint::{Bounds, ObjectSpec};
use gump_model::generation::verdict::off_road;
use gump_model::generation::{Counts, GenerateConfig, GenerateRequest, Placement};
use gump_model::world::TransformerWorld;
use gump_scene::{AgentKind, Frame, Scenario, Seed};
use gump_viz::Bars;
use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Value, json};

use super::{long, prompts};
use crate::charts;
use crate::run::{Common, Run, stop_if_interrupted};
use crate::verbs::generate;

/// Arguments of `evaluate generation`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// A file or folder of scenarios
    #[arg(long, value_name = "PATH")]
    scenarios: PathBuf,
    /// At most so many scenarios that take part [default: all]
    #[arg(long, value_name = "N")]
    limit: Option<usize>,
    /// Recorded vehicles within 50 m that a scenario needs to take part
    #[arg(long, value_name = "N", default_value_t = 8)]
    min_vehicles: usize,
    /// Maps that each tag is asked for on, among those that admit it; 0 leaves prompts out
    #[arg(long, value_name = "N", default_value_t = 2)]
    prompt_maps: usize,
    /// Scenes made per prompt before the last one counts
    #[arg(long, value_name = "N", default_value_t = 12)]
    attempts: usize,
    /// Made-up scenes that are imagined for 30 s, with and without agents that come and leave
    #[arg(long, value_name = "N", default_value_t = 8)]
    long_scenes: usize,
    /// Weights of the model [default: the shipped ones]
    #[arg(long, value_name = "FILE")]
    weights: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Where scenes come from.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Source {
    Model(Placement),
    Random,
    Retrieval,
    Log,
}

impl Source {
    const ALL: [Self; 5] = [
        Self::Model(Placement::Guided),
        Self::Model(Placement::Free),
        Self::Random,
        Self::Retrieval,
        Self::Log,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Model(Placement::Guided) => "model guided",
            Self::Model(Placement::Free) => "model free",
            Self::Random => "random along lanes",
            Self::Retrieval => "retrieval",
            Self::Log => "log",
        }
    }
}

/// What one source made.
#[derive(Default)]
struct Tally {
    mmd: MmdMean,
    failed: usize,
    vehicles: usize,
    overlapping: usize,
    off_road: usize,
    moving: usize,
    wrong_way: usize,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let world = run.phase("load", |run| {
            generate::world(run.device(), self.weights.as_ref(), false)
        })?;
        let protocol = MmdProtocol {
            min_vehicles: self.min_vehicles,
            ..MmdProtocol::gump()
        };
        let scenarios = run.phase("read", |_| self.read(&protocol))?;
        anyhow::ensure!(
            scenarios.len() > 1,
            "{} scenarios have {} vehicles within 50 m, expected at least 2",
            scenarios.len(),
            self.min_vehicles
        );
        run.result("scenarios", scenarios.len())?;
        let seed = run.seed();
        let mut tallies = Vec::new();
        for source in Source::ALL {
            stop_if_interrupted()?;
            let tally = run.phase(source.name(), |_| {
                Ok(tally(&world, source, &scenarios, &protocol, seed))
            })?;
            tallies.push((source, tally));
        }
        let prompts = run.phase("prompts", |run| {
            prompts::satisfaction(run, &world, &scenarios, self.prompt_maps, self.attempts)
        })?;
        let rows = tallies.iter().map(|(source, tally)| {
            let satisfaction = match source {
                Source::Model(Placement::Guided) => prompts.satisfaction,
                Source::Model(Placement::Free) => prompts.unconditional,
                Source::Log => prompts.logged,
                Source::Random | Source::Retrieval => None,
            };
            row(*source, tally, satisfaction)
        });
        let rows: Vec<Value> = rows.collect();
        charts::save(run, "likeness", &chart(&rows))?;
        run.result("rows", rows)?;
        run.result("prompts", prompts.rows)?;
        if self.long_scenes > 0 {
            let (weights, n) = (self.weights.as_ref(), self.long_scenes);
            let rows = run.phase("long", |run| long::rows(run, weights, n))?;
            charts::save(run, "life", &long::chart(&rows))?;
            run.result("life", rows)?;
        }
        Ok(())
    }

    fn read(&self, protocol: &MmdProtocol) -> anyhow::Result<Vec<Scenario>> {
        let mut scenarios = Vec::new();
        for record in gump_data::open(&self.scenarios)? {
            stop_if_interrupted()?;
            let scenario = record?.scenario;
            let present = scenario.present();
            if scene_mmd(&present, present.now(), protocol).is_some() {
                scenarios.push(scenario);
            }
            if self.limit.is_some_and(|limit| scenarios.len() >= limit) {
                break;
            }
        }
        Ok(scenarios)
    }
}

fn tally(
    world: &TransformerWorld,
    source: Source,
    scenarios: &[Scenario],
    protocol: &MmdProtocol,
    seed: Seed,
) -> Tally {
    let made: Vec<Option<Frame>> = (0..scenarios.len())
        .into_par_iter()
        .map(|i| scene_of(world, source, scenarios, i, protocol, seed.fork(i as u64)))
        .collect();
    let mut tally = Tally::default();
    for (scenario, frame) in scenarios.iter().zip(made) {
        let Some(frame) = frame else {
            tally.failed += 1;
            continue;
        };
        if let Some(mmd) = scene_mmd(&scenario.present(), &frame, protocol) {
            tally.mmd.add(&mmd);
        }
        let (overlapping, vehicles) = overlapping_vehicles(&frame);
        let (wrong, moving) = wrong_way(&scenario.map, &frame);
        tally.overlapping += overlapping;
        tally.vehicles += vehicles;
        tally.wrong_way += wrong;
        tally.moving += moving;
        tally.off_road += off_road(&alone(scenario, frame));
    }
    tally
}

/// The frame as the only one of a scenario.
fn alone(scenario: &Scenario, frame: Frame) -> Scenario {
    Scenario {
        log: vec![frame],
        now: 0,
        ..scenario.clone()
    }
}

/// The scene that a source makes in place of a recorded one, vehicles only; `None` if it fails.
fn scene_of(
    world: &TransformerWorld,
    source: Source,
    scenarios: &[Scenario],
    i: usize,
    protocol: &MmdProtocol,
    seed: Seed,
) -> Option<Frame> {
    let scenario = &scenarios[i];
    let present = scenario.present();
    let ego = present.ego_now();
    let ego_from_world = ego.state.pose.inverse();
    let near = |agent: &&gump_scene::Agent| {
        let place = ego_from_world * agent.state.pose.position;
        agent.kind == AgentKind::Vehicle
            && (agent.id == ego.id || place.abs().max_element() <= protocol.half_side)
    };
    let recorded: Vec<_> = present
        .now()
        .agents()
        .iter()
        .filter(near)
        .copied()
        .collect();
    let n = (recorded.len() - 1).min(protocol.max_vehicles);
    match source {
        Source::Log => Some(Frame::new(recorded, Vec::new())),
        Source::Random => Some(random_along_lanes(&present, n, protocol.half_side, seed)),
        Source::Retrieval => {
            // Any other scene, but the same for the same seed.
            let others = scenarios.len() - 1;
            let pick = (seed.fork(1).0 % others as u64) as usize;
            let other = &scenarios[if pick < i { pick } else { pick + 1 }];
            Some(retrieved(&present, &other.present(), n))
        }
        Source::Model(placement) => {
            let side = Some(Bounds::new(-protocol.half_side, protocol.half_side));
            let object = |i: usize| ObjectSpec {
                id: format!("vehicle {i}"),
                x: side,
                y: side,
                ..ObjectSpec::default()
            };
            let mut request = GenerateRequest {
                counts: Some(Counts {
                    vehicles: n,
                    ..Counts::default()
                }),
                objects: (0..n).map(object).collect(),
                config: GenerateConfig {
                    placement,
                    ..GenerateConfig::default()
                },
                map: Arc::clone(&scenario.map),
                ..generate::request(scenario)
            };
            request.ego.velocity = Some(ego.state.velocity);
            let made = world.generate(&request, &[seed]).ok()?;
            let scene = made.into_iter().next()?.ok()?;
            // The recorded ego has its own id, by which both scenes are seen.
            let agents = scene.frame.agents().iter().map(|agent| {
                let mut agent = *agent;
                agent.id = match agent.id {
                    id if id == scene.ego => ego.id,
                    id => gump_scene::AgentId(ego.id.0.saturating_add(id.0)),
                };
                agent
            });
            let moving = agents.filter(|agent| agent.kind.is_moving());
            Some(Frame::new(moving.collect(), Vec::new()))
        }
    }
}

/// The discrepancy of every source on every attribute; the log's is none.
fn chart(rows: &[Value]) -> Bars {
    let attributes = ["position", "heading", "speed", "size"];
    let rows: Vec<&Value> = rows.iter().filter(|row| row["source"] != "log").collect();
    let sources = rows.iter().filter_map(|row| row["source"].as_str());
    let legend = sources.map(String::from).collect();
    let label = "maximum mean discrepancy from recorded scenes, lower is nearer";
    let names = attributes.map(String::from).into();
    charts::bars(label, names, legend, |attribute, source| {
        charts::bar(
            &rows[source][attributes[attribute]],
            &Value::Null,
            &Value::Null,
        )
    })
}

fn row(source: Source, tally: &Tally, prompt_satisfaction: Option<f64>) -> Value {
    let mean = tally.mmd.mean();
    let rate = |n: usize, of: usize| n as f64 / of.max(1) as f64;
    json!({
        "source": source.name(),
        "position": mean.position,
        "heading": mean.heading,
        "speed": mean.velocity,
        "size": mean.size,
        "overlap_rate": rate(tally.overlapping, tally.vehicles),
        "offroad_rate": rate(tally.off_road, tally.vehicles),
        "wrong_way_rate": rate(tally.wrong_way, tally.moving),
        "prompt_satisfaction": prompt_satisfaction,
        "scenes": tally.mmd.scenes(),
        "failed": tally.failed,
    })
}
