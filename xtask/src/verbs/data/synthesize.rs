//! `data synthesize`: scenarios made up on the spot.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;

use gump_scene::Scenario;
use gump_synthesis::{RoadFamily, SynthesisConfig, synthesize};
use rayon::prelude::*;
use serde::Serialize;

use crate::run::{self, Common, Run};

/// Files to spread scenes over; fewer if there are fewer scenes.
const SHARDS: usize = 8;

/// Arguments of `data synthesize`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// How scenes come about
    #[arg(long, value_enum, default_value_t = Kind::Procedural)]
    kind: Kind,
    /// How many scenes
    #[arg(long, value_name = "N")]
    scenes: NonZeroUsize,
    /// Multiplies the number of agents, 0.1 to 3
    #[arg(long, value_name = "X", default_value_t = 1.0)]
    density: f64,
    /// The kind of road, for instance "roundabout" [default: any]
    #[arg(long, value_name = "NAME", value_parser = road_family)]
    #[serde(serialize_with = "as_name")]
    family: Option<RoadFamily>,
    /// Files to spread the scenes over [default: 8, or one per scene if those are fewer]
    #[arg(long, value_name = "N")]
    shards: Option<NonZeroUsize>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// How scenes come about.
#[derive(Clone, Copy, Debug, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
enum Kind {
    /// Drawn roads, rule-driven traffic.
    Procedural,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let Kind::Procedural = self.kind;
        let config = SynthesisConfig {
            density: self.density,
            family: self.family,
            ..SynthesisConfig::standard()
        };
        let scenes = run.phase("synthesize", |run| {
            let n = self.scenes.get() as u64;
            let progress = run.progress("synthesizing", n, "scenes");
            let seed = run.seed();
            let scene = |k: u64| {
                run::stop_if_interrupted()?;
                let scene = synthesize(&config, seed.fork(k));
                progress.advance(1);
                Ok(scene)
            };
            (0..n)
                .into_par_iter()
                .map(scene)
                .collect::<anyhow::Result<Vec<_>>>()
        })?;
        let files = run.phase("write", |run| self.write(run, &scenes))?;
        run.result("scenes", scenes.len())?;
        run.result(
            "agents",
            count(&scenes, |scene| scene.present().now().agents().len()),
        )?;
        run.result("by_class", by_class(&scenes))?;
        run.result("by_road", by_road(&scenes))?;
        run.result("files", files)?;
        Ok(())
    }

    /// Writes the shards; scene `k` goes to shard `k` modulo their number.
    fn write(&self, run: &Run, scenes: &[Scenario]) -> anyhow::Result<Vec<String>> {
        let n_shards = self
            .shards
            .map_or(SHARDS, NonZeroUsize::get)
            .min(scenes.len());
        let names: Vec<String> = (0..n_shards)
            .map(|shard| format!("scenes-{shard:05}-of-{n_shards:05}.tfrecord.gz"))
            .collect();
        names.par_iter().enumerate().try_for_each(|(shard, name)| {
            let of_shard = scenes.iter().skip(shard).step_by(n_shards);
            gump_data::womd::write_scenarios(&run.path(name), of_shard).map(drop)
        })?;
        Ok(names)
    }
}

fn count(scenes: &[Scenario], of: impl Fn(&Scenario) -> usize) -> usize {
    scenes.iter().map(of).sum()
}

fn by_class(scenes: &[Scenario]) -> BTreeMap<&'static str, usize> {
    let mut counts = BTreeMap::new();
    for agent in scenes
        .iter()
        .flat_map(|scene| scene.present().now().agents())
    {
        *counts.entry(agent.kind.name()).or_default() += 1;
    }
    counts
}

/// Scenes per road family, told from the front of their ids.
fn by_road(scenes: &[Scenario]) -> BTreeMap<&'static str, usize> {
    let families = RoadFamily::ALL.iter().map(|family| family.name());
    let counts =
        families.map(|name| (name, count(scenes, |s| usize::from(s.id.starts_with(name)))));
    counts.filter(|&(_, n)| n > 0).collect()
}

fn road_family(name: &str) -> Result<RoadFamily, String> {
    let found = RoadFamily::ALL
        .into_iter()
        .find(|family| family.name() == name);
    found.ok_or_else(|| {
        let known: Vec<_> = RoadFamily::ALL.iter().map(|family| family.name()).collect();
        format!("expected one of {}", known.join(", "))
    })
}

#[expect(clippy::ref_option, reason = "serde hands the field over by reference")]
fn as_name<S: serde::Serializer>(
    family: &Option<RoadFamily>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    family.map(RoadFamily::name).serialize(serializer)
}
