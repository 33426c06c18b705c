//! `data synthesize`: scenarios made up on the spot.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::Context as _;
use gump_eval::benchmarks::RESERVED_SEEDS;
use gump_eval::fresh::profile_of_name;
use gump_eval::sumo::{self, FUTURE_S, Sumo};
use gump_scene::{Scenario, Seed};
use gump_synthesis::{Profile, RoadFamily, SumoDemand, SynthesisConfig};
use rayon::prelude::*;
use serde::Serialize;

use crate::cli::WrongArguments;
use crate::run::{self, Common, Run};

/// Files to spread scenes over, for readers with several threads; fewer if there are fewer scenes.
/// Chosen by hand.
const SHARDS: usize = 8;
/// Procedural scenes made together, by all threads, before they are written. Chosen by hand; they
/// are held in memory until then.
const AT_A_TIME: usize = 64;
/// Scenes of SUMO per file at most, where the number of files is not given: they are held in
/// memory until their file is written. Chosen by hand.
const SHARD_SCENES: usize = 200;
/// Scenes that a run of SUMO gives at least, as a rule (docs/results/0006-factory.md: 200 scenes of
/// 17 runs).
const RUN_SCENES: u64 = 12;
/// So many runs without a scene mean that there will be none. Chosen by hand.
const BARREN_RUNS: u64 = 8;

/// Arguments of `data synthesize`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Generator of the scenes
    #[arg(long, value_enum, default_value_t = Kind::Procedural)]
    kind: Kind,
    /// Number of scenes
    #[arg(long, value_name = "N")]
    scenes: NonZeroUsize,
    /// Multiplies the number of agents, 0.1 to 3
    #[arg(long, value_name = "X", default_value_t = 1.0)]
    density: f64,
    /// For --kind sumo: seconds of future in each scene, 1 to 600
    #[arg(long, value_name = "X", default_value_t = FUTURE_S)]
    seconds: f64,
    /// The kind of road, for instance "roundabout" [default: any]
    #[arg(long, value_name = "NAME", value_parser = road_family)]
    #[serde(serialize_with = "as_name")]
    family: Option<RoadFamily>,
    /// Profile of the scenes: plain, or recorded-like
    #[arg(long, value_name = "NAME", value_parser = profile_of_name, default_value = "plain")]
    #[serde(serialize_with = "profile_name")]
    profile: Profile,
    /// Ground truth of a profile's scenes, without simulated tracker errors
    #[arg(long)]
    clean: bool,
    /// Write the training cache instead of Waymo's format
    #[arg(long)]
    cache: bool,
    /// Files to spread the scenes over [default: 8, or one per scene if those are fewer]
    #[arg(long, value_name = "N")]
    shards: Option<NonZeroUsize>,
    /// For --kind sumo: a network, or a folder of networks to take in turn [default: generated]
    #[arg(long, value_name = "FILE_OR_DIR")]
    network: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// Generator of the scenes.
#[derive(Clone, Copy, Debug, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
enum Kind {
    /// Drawn roads, rule-driven traffic.
    Procedural,
    /// Roads and traffic of SUMO, which must be installed.
    Sumo,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        self.check()?;
        check_seed(run.seed())?;
        let mut counts = GeneratedCounts::default();
        match self.kind {
            Kind::Procedural => self.procedural(run, &mut counts)?,
            Kind::Sumo => self.sumo(run, &mut counts)?,
        }
        run.result("scenes", counts.scenes)?;
        run.result("agents", counts.by_class.values().sum::<usize>())?;
        run.result("by_class", counts.by_class)?;
        run.result("by_road", counts.by_road)?;
        run.result("by_tag", counts.by_tag)?;
        run.result("files", counts.files)?;
        Ok(())
    }

    fn check(&self) -> anyhow::Result<()> {
        if !(1.0..=600.0).contains(&self.seconds) {
            let found = self.seconds;
            let wrong = format!("--seconds: expected 1 to 600, found {found}");
            return Err(WrongArguments(wrong).into());
        }
        if !(0.1..=3.0).contains(&self.density) {
            let found = self.density;
            let wrong = format!("--density: expected 0.1 to 3, found {found}");
            return Err(WrongArguments(wrong).into());
        }
        let why = match self.kind {
            Kind::Procedural if self.network.is_some() => "--network is for --kind sumo",
            // In few drawn places anybody drives on for longer, so the ego could leave its scene.
            Kind::Procedural if self.seconds != FUTURE_S => "--seconds is for --kind sumo",
            Kind::Sumo if self.family.is_some() => "--family is for --kind procedural",
            Kind::Sumo if self.profile != Profile::Plain || self.cache || self.clean => {
                "--profile, --cache and --clean are for --kind procedural"
            }
            _ => return Ok(()),
        };
        Err(WrongArguments(why.into()).into())
    }

    fn n_shards(&self, default: usize) -> usize {
        let shards = self.shards.map_or(default, NonZeroUsize::get);
        shards.min(self.scenes.get())
    }

    /// Makes and writes file by file, some scenes at a time, so that any number of scenes needs
    /// little memory. Scene `k` comes from `seed.fork(k)` and goes to file `k` modulo their number.
    fn procedural(&self, run: &mut Run, counts: &mut GeneratedCounts) -> anyhow::Result<()> {
        let config = SynthesisConfig {
            density: self.density,
            family: self.family,
            ..self.profile.config()
        };
        let n = self.scenes.get();
        let progress = run.progress("synthesizing", n as u64, "scenes");
        let seed = run.seed();
        let one = |k: usize| {
            let seed = seed.fork(k as u64);
            let scene = if self.clean {
                self.profile.synthesize_clean(&config, seed)
            } else {
                self.profile.synthesize(&config, seed)
            };
            progress.advance(1);
            scene
        };
        let names = shard_names(self.n_shards(SHARDS));
        for (shard, name) in names.iter().enumerate() {
            let name = match self.cache {
                true => name.replace(".tfrecord.gz", ".cache"),
                false => name.clone(),
            };
            let numbers: Vec<usize> = (shard..n).step_by(names.len()).collect();
            let mut stopped = Ok(());
            let chunks = numbers.chunks(AT_A_TIME).map_while(|chunk| {
                stopped = run::stop_if_interrupted();
                let scenes: Vec<Scenario> = chunk.par_iter().map(|&k| one(k)).collect();
                counts.add(&scenes);
                stopped.is_ok().then_some(scenes)
            });
            run.phase("synthesize", |run| {
                let path = run.path(&name);
                if self.cache {
                    gump_data::cache::write_shard(&path, chunks.flatten())?;
                } else {
                    gump_data::womd::write_scenarios(&path, chunks.flatten())?;
                }
                Ok(())
            })?;
            // A file that was cut short would look like a whole one.
            if stopped.is_err() {
                std::fs::remove_file(run.path(&name)).ok();
            }
            stopped?;
            counts.files.push(name);
        }
        Ok(())
    }

    /// Simulates and writes shard by shard, so that thousands of scenes need little memory.
    ///
    /// Run `r` comes from `seed.fork(r)` and scenes are taken in the order of their runs, so the
    /// number of threads changes nothing.
    fn sumo(&self, run: &mut Run, counts: &mut GeneratedCounts) -> anyhow::Result<()> {
        let sumo = Sumo::find()?;
        run.setting("sumo", sumo.version()?)?;
        let work = run.path("work");
        std::fs::create_dir_all(&work)
            .with_context(|| format!("cannot create the folder {}", work.display()))?;
        let files = match &self.network {
            Some(path) => sumo::networks(path)?,
            None => Vec::new(),
        };
        let places = files.iter().map(|file| Ok(sumo.prepare(file, &work)?));
        let places = places.collect::<anyhow::Result<Vec<_>>>()?;
        let demand = SumoDemand {
            density: self.density,
            ..SumoDemand::standard()
        };
        let seed = run.seed();
        let one = |r: u64| -> anyhow::Result<Vec<Scenario>> {
            run::stop_if_interrupted()?;
            let folder = work.join(format!("run-{r:05}"));
            std::fs::create_dir_all(&folder)
                .with_context(|| format!("cannot create the folder {}", folder.display()))?;
            let seed = seed.fork(r);
            let fresh;
            let place = match places.get(r as usize % places.len().max(1)) {
                Some(place) => place,
                None => {
                    fresh = sumo.generate(seed, &folder)?;
                    &fresh
                }
            };
            let id = format!("{}-{r:05}", place.name);
            Ok(sumo.scenes(place, &demand, self.seconds, seed.fork(2), &id, &folder)?)
        };
        let n = self.scenes.get();
        let names = shard_names(self.n_shards(SHARDS.max(n.div_ceil(SHARD_SCENES))));
        let progress = run.progress("simulating", n as u64, "scenes");
        let (mut left, mut next, mut barren) = (Vec::new(), 0_u64, 0);
        for (shard, name) in names.iter().enumerate() {
            let wanted = n * (shard + 1) / names.len() - n * shard / names.len();
            while left.len() < wanted {
                let runs = ((wanted - left.len()) as u64)
                    .div_ceil(RUN_SCENES)
                    .max(places.len() as u64);
                let found = run.phase("simulate", |_| {
                    let found = (next..next + runs).into_par_iter().map(|r| {
                        let scenes = one(r)?;
                        progress.advance(scenes.len() as u64);
                        Ok(scenes)
                    });
                    found.collect::<anyhow::Result<Vec<_>>>()
                })?;
                next += runs;
                let before = left.len();
                // Taken in turn, so that every network has its share however few are wanted.
                interleave(found, &mut left);
                barren = if left.len() > before {
                    0
                } else {
                    barren + runs
                };
                anyhow::ensure!(
                    barren < BARREN_RUNS,
                    "{barren} runs of SUMO in a row gave no scene: is there room to drive?"
                );
            }
            let rest = left.split_off(wanted);
            run.phase("write", |run| write(run, std::slice::from_ref(name), &left))?;
            counts.add(&left);
            counts.files.push(name.clone());
            left = rest;
        }
        drop(progress);
        std::fs::remove_dir_all(&work)
            .with_context(|| format!("cannot remove {}", work.display()))?;
        run.result("runs", next)?;
        Ok(())
    }
}

/// Error: [`WrongArguments`] for a seed of the frozen sets.
fn check_seed(seed: Seed) -> anyhow::Result<()> {
    let reserved = RESERVED_SEEDS;
    if !reserved.contains(&seed.0) {
        return Ok(());
    }
    let why = format!(
        "--seed: expected none from {} to {}, found {}: those are of the frozen sets, \
         which `data benchmark` makes and training never sees",
        reserved.start,
        reserved.end - 1,
        seed.0
    );
    Err(WrongArguments(why).into())
}

/// Counts of what a run generated.
#[derive(Default)]
struct GeneratedCounts {
    scenes: usize,
    by_class: BTreeMap<&'static str, usize>,
    by_road: BTreeMap<String, usize>,
    by_tag: BTreeMap<&'static str, usize>,
    files: Vec<String>,
}

impl GeneratedCounts {
    fn add(&mut self, scenes: &[Scenario]) {
        self.scenes += scenes.len();
        for scene in scenes {
            for agent in scene.present().now().agents() {
                *self.by_class.entry(agent.kind.name()).or_default() += 1;
            }
            for tag in &scene.tags {
                *self.by_tag.entry(tag.name()).or_default() += 1;
            }
            *self.by_road.entry(road(&scene.id)).or_default() += 1;
        }
    }
}

/// The kind of road, or the network, from the beginning of a scene's id.
fn road(id: &str) -> String {
    let families = RoadFamily::ALL.iter().map(|family| family.name());
    let plain = id.strip_prefix("like-").unwrap_or(id);
    if let Some(family) = families.into_iter().find(|name| plain.starts_with(name)) {
        return family.to_owned();
    }
    // NETWORK-RUN-WINDOW-EGO
    id.rsplitn(4, '-').nth(3).unwrap_or(id).to_owned()
}

/// Adds the first of every list, then the second, and so on.
fn interleave(lists: Vec<Vec<Scenario>>, all: &mut Vec<Scenario>) {
    let mut lists: Vec<_> = lists.into_iter().map(Vec::into_iter).collect();
    loop {
        let before = all.len();
        all.extend(lists.iter_mut().filter_map(Iterator::next));
        if all.len() == before {
            return;
        }
    }
}

fn shard_names(n_shards: usize) -> Vec<String> {
    (0..n_shards)
        .map(|shard| format!("scenes-{shard:05}-of-{n_shards:05}.tfrecord.gz"))
        .collect()
}

/// Writes shards; scene `k` goes to shard `k` modulo their number.
fn write(run: &Run, names: &[String], scenes: &[Scenario]) -> anyhow::Result<()> {
    names.par_iter().enumerate().try_for_each(|(shard, name)| {
        let of_shard = scenes.iter().skip(shard).step_by(names.len());
        gump_data::womd::write_scenarios(&run.path(name), of_shard).map(drop)
    })?;
    Ok(())
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

fn profile_name<S: serde::Serializer>(profile: &Profile, to: S) -> Result<S::Ok, S::Error> {
    profile.name().serialize(to)
}

#[expect(clippy::ref_option, reason = "serde hands the field over by reference")]
fn as_name<S: serde::Serializer>(
    family: &Option<RoadFamily>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    family.map(RoadFamily::name).serialize(serializer)
}
