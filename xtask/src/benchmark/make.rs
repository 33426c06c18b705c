//! Makes the scenes of a list and holds them to its checksums.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use gump_eval::benchmarks::{BenchmarkList, MadePart, checksums, sha256, verify_made};
use gump_scene::{Scenario, Seed};
use gump_synthesis::{SumoDemand, SynthesisConfig, synthesize};
use rayon::prelude::*;

use crate::progress::Progress;
use crate::run::{Unseen, stop_if_interrupted};
use crate::sumo::{FUTURE_S, Place, Sumo};

/// So many runs of SUMO more than are needed mean that there is no room to drive.
const SPARE_RUNS: u64 = 200;

/// Which generator, and its version.
enum Generator {
    Procedural(SynthesisConfig),
    Sumo(SumoDemand),
}

impl Generator {
    /// The generator of a part.
    ///
    /// Error: a generator or a version that this build does not have.
    fn of(part: &MadePart) -> anyhow::Result<Self> {
        let mut generator = Self::named(&part.generator)?;
        if let Some(asked) = part.density {
            let (Self::Procedural(SynthesisConfig { density, .. })
            | Self::Sumo(SumoDemand { density, .. })) = &mut generator;
            *density = asked;
        }
        Ok(generator)
    }

    fn named(name: &str) -> anyhow::Result<Self> {
        let known = name.split_once('/').and_then(|(kind, version)| {
            let version = version.parse().ok()?;
            match kind {
                "procedural" => SynthesisConfig::of_version(version).map(Self::Procedural),
                "sumo" => SumoDemand::of_version(version).map(Self::Sumo),
                _ => None,
            }
        });
        known.with_context(|| {
            let newest = gump_synthesis::GENERATOR_VERSION;
            format!(
                "expected the generator procedural/N or sumo/N with N from 1 to {newest}, \
                 found {name}"
            )
        })
    }
}

/// Makes the file of a part below `folder`, where it is not there yet as it should be; true if it
/// was made.
///
/// Error: SUMO is missing or of another version, a network differs, or scenes come out otherwise
/// than the list says.
pub(crate) fn make(
    list: &BenchmarkList,
    part: &MadePart,
    folder: &Path,
    progress: &Progress,
) -> anyhow::Result<bool> {
    if !part.scenes.is_empty() && verify_made(list, part, folder, &Unseen).is_ok() {
        progress.advance(part.kept() as u64);
        return Ok(false);
    }
    write(list, part, folder, progress)?;
    verify_made(list, part, folder, &Unseen).with_context(|| {
        let n = gump_synthesis::GENERATOR_VERSION;
        format!(
            "scenes of {} come out otherwise than they were frozen (newest version: {n})",
            part.generator
        )
    })?;
    Ok(true)
}

/// Makes the file of a part and returns what the list should say of its scenes.
///
/// Error: as [`make`], sums aside.
pub(crate) fn freeze(
    list: &BenchmarkList,
    part: &MadePart,
    folder: &Path,
    progress: &Progress,
) -> anyhow::Result<Vec<String>> {
    write(list, part, folder, progress)?;
    Ok(checksums(&list.file(folder, part), &Unseen)?)
}

fn write(
    list: &BenchmarkList,
    part: &MadePart,
    folder: &Path,
    progress: &Progress,
) -> anyhow::Result<()> {
    let scenes = match Generator::of(part)? {
        Generator::Procedural(config) => (0..part.count as u64)
            .into_par_iter()
            .filter(|&k| part.keeps(k as usize))
            .map(|k| {
                stop_if_interrupted()?;
                let scene = synthesize(&config, Seed(part.seed).fork(k));
                progress.advance(1);
                Ok(scene)
            })
            .collect::<anyhow::Result<Vec<_>>>()?,
        Generator::Sumo(demand) => {
            let path = list.file(folder, part).with_extension("work");
            let mut scenes = Simulation::begin(list, part, demand, path)?.scenes(progress)?;
            let mut index = 0;
            scenes.retain(|_| {
                index += 1;
                part.keeps(index - 1)
            });
            scenes
        }
    };
    let path = list.file(folder, part);
    let parent = path.parent().unwrap_or(folder);
    std::fs::create_dir_all(parent)
        .with_context(|| format!("cannot create the folder {}", parent.display()))?;
    gump_data::womd::write_scenarios(&path, scenes)?;
    Ok(())
}

/// SUMO at work on a part.
struct Simulation<'a> {
    part: &'a MadePart,
    sumo: Sumo,
    demand: SumoDemand,
    /// Networks to take in turn; none: made anew for every run.
    places: Vec<Place>,
    work: PathBuf,
}

impl<'a> Simulation<'a> {
    fn begin(
        list: &BenchmarkList,
        part: &'a MadePart,
        demand: SumoDemand,
        work: PathBuf,
    ) -> anyhow::Result<Self> {
        let sumo = Sumo::find().with_context(|| format!("cannot make the part {}", part.file))?;
        let (expected, found) = (part.sumo.as_deref().unwrap_or_default(), sumo.version()?);
        anyhow::ensure!(
            found
                .split_whitespace()
                .any(|word| { word.trim_start_matches(['v', 'V']) == expected }),
            "the part {} of {} expects SUMO {expected} \
             (`pip install eclipse-sumo=={expected}`), found \"{found}\"",
            part.file,
            list.path().display()
        );
        std::fs::create_dir_all(&work)
            .with_context(|| format!("cannot create the folder {}", work.display()))?;
        let mut places = Vec::new();
        for network in &part.networks {
            let path = list.beside(&network.path);
            let found = sha256(&path)?;
            anyhow::ensure!(
                found == network.sha256,
                "expected a network of SHA-256 {}, found {found}: {}",
                network.sha256,
                path.display()
            );
            places.push(sumo.prepare(&path, &work)?);
        }
        Ok(Self {
            part,
            sumo,
            demand,
            places,
            work,
        })
    }

    /// Run `r` comes from `seed.fork(r)` and scenes are taken in the order of their runs, so the
    /// number of threads changes nothing.
    fn scenes(self, progress: &Progress) -> anyhow::Result<Vec<Scenario>> {
        let (count, per_run) = (self.part.count, self.part.per_run.unwrap_or(1).max(1));
        let (mut scenes, mut next) = (Vec::new(), 0_u64);
        let most = count.div_ceil(per_run) as u64 + SPARE_RUNS;
        while scenes.len() < count {
            anyhow::ensure!(
                next < most,
                "{next} runs of SUMO gave {} scenes of the {count} of part {}: \
                 is there room to drive?",
                scenes.len(),
                self.part.file
            );
            let runs = (count - scenes.len()).div_ceil(per_run) as u64;
            let found = (next..next + runs).into_par_iter().map(|r| {
                let found = self.run(r, per_run)?;
                progress.advance(found.len() as u64);
                Ok(found)
            });
            let found = found.collect::<anyhow::Result<Vec<_>>>()?;
            scenes.extend(found.into_iter().flatten());
            next += runs;
        }
        scenes.truncate(count);
        std::fs::remove_dir_all(&self.work)
            .with_context(|| format!("cannot remove {}", self.work.display()))?;
        Ok(scenes)
    }

    /// A few scenes of a run, from its whole length.
    fn run(&self, r: u64, few: usize) -> anyhow::Result<Vec<Scenario>> {
        stop_if_interrupted()?;
        let folder = self.work.join(format!("run-{r:05}"));
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot create the folder {}", folder.display()))?;
        let seed = Seed(self.part.seed).fork(r);
        let fresh;
        let place = match self.places.get(r as usize % self.places.len().max(1)) {
            Some(place) => place,
            None => {
                fresh = self.sumo.generate(seed, &folder)?;
                &fresh
            }
        };
        let id = format!("{}-{}-{r:05}", place.name, self.part.seed);
        let mut all =
            self.sumo
                .scenes(place, &self.demand, FUTURE_S, seed.fork(2), &id, &folder)?;
        let n = all.len();
        let taken: Vec<usize> = (0..few.min(n)).map(|k| k * n / few.min(n)).collect();
        let mut index = 0;
        all.retain(|_| {
            index += 1;
            taken.contains(&(index - 1))
        });
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::machine::repository;

    fn shipped(name: &str) -> BenchmarkList {
        BenchmarkList::read(&repository().join(format!("datasets/benchmarks/{name}.toml"))).unwrap()
    }

    /// The first scenes of the parts that are `wanted` come out as the lists say.
    fn first_scenes_are_as_frozen(n: usize, wanted: impl Fn(&MadePart) -> bool) {
        let folder = tempfile::tempdir().unwrap();
        let silent = Progress::begin(true, "", 0, "");
        let mut parts = 0;
        for name in ["synthetic-tune", "synthetic-test"] {
            let list = shipped(name);
            for part in list.made.iter().filter(|part| wanted(part)) {
                let first = MadePart {
                    count: n,
                    scenes: part.scenes[..n].to_vec(),
                    ..part.clone()
                };
                assert!(make(&list, &first, folder.path(), &silent).unwrap());
                // What is there as it should be is left alone.
                assert!(!make(&list, &first, folder.path(), &silent).unwrap());
                parts += 1;
            }
        }
        assert!(parts > 0);
    }

    #[test]
    fn procedural_scenes_come_out_as_frozen() {
        first_scenes_are_as_frozen(3, |part| part.generator.starts_with("procedural/"));
    }

    #[test]
    fn scenes_of_sumo_come_out_as_frozen() {
        if Sumo::find().is_err() {
            eprintln!("SKIPPED: no SUMO here, `pip install eclipse-sumo==1.28.0` brings it");
            return;
        }
        // One run of the smallest part, unless there is time for a run of each.
        let all = std::env::var_os("RUN_SLOW_TESTS").is_some();
        let is_small = |part: &MadePart| {
            part.networks
                .iter()
                .any(|n| n.path.ends_with("i80.net.xml.gz"))
        };
        first_scenes_are_as_frozen(2, |part| {
            part.generator.starts_with("sumo/") && (all || is_small(part))
        });
    }

    #[test]
    fn scenes_that_differ_and_generators_that_are_not_there_are_told() {
        let folder = tempfile::tempdir().unwrap();
        let silent = Progress::begin(true, "", 0, "");
        let list = shipped("synthetic-tune");
        let part = MadePart {
            count: 1,
            scenes: vec!["0123456789abcdef other".into()],
            ..list.made[0].clone()
        };
        let error = |part: &MadePart| {
            format!(
                "{:#}",
                make(&list, part, folder.path(), &silent).unwrap_err()
            )
        };
        let told = error(&part);
        assert!(told.contains("expected scene 0 of procedural"), "{told}");
        assert!(told.contains("synthetic-tune.toml"), "{told}");
        let unknown = MadePart {
            generator: "procedural/99".into(),
            ..part
        };
        assert!(error(&unknown).contains("found procedural/99"));
    }
}
