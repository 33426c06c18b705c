//! Makes the scenes of a list and verifies them against its checksums.

use std::path::{Path, PathBuf};

use gump_scene::{Scenario, Seed};
use gump_synthesis::{SumoDemand, SynthesisConfig, synthesize};
use rayon::prelude::*;

use super::{BenchmarkList, GeneratedPart, checksums, sha256, verify_generated};
use crate::sumo::{FUTURE_S, Sumo, SumoNetwork};
use crate::{BenchmarkError, ErrorContext, EvalError, Monitor, SumoError};

/// Runs of SUMO beyond those needed, after which there is no room to drive. Chosen by hand.
const SPARE_RUNS: u64 = 200;

/// A generator of some version.
enum Generator {
    Procedural(SynthesisConfig),
    Sumo(SumoDemand),
}

impl Generator {
    /// The generator of a part.
    ///
    /// Error: a generator or a version that this build does not have.
    fn of(part: &GeneratedPart) -> Result<Self, EvalError> {
        let mut generator = Self::named(&part.generator)?;
        if let Some(requested) = part.density {
            let (Self::Procedural(SynthesisConfig { density, .. })
            | Self::Sumo(SumoDemand { density, .. })) = &mut generator;
            *density = requested;
        }
        Ok(generator)
    }

    fn named(name: &str) -> Result<Self, EvalError> {
        let known = name.split_once('/').and_then(|(kind, version)| {
            let version = version.parse().ok()?;
            match kind {
                "procedural" => SynthesisConfig::of_version(version).map(Self::Procedural),
                "sumo" => SumoDemand::of_version(version).map(Self::Sumo),
                _ => None,
            }
        });
        known.ok_or_else(|| {
            let found = name.into();
            BenchmarkError::NoSuchGenerator { found }.into()
        })
    }
}

/// Makes the file of a part below `folder`, unless it is there and verified; true if it was made. The
/// monitor counts scenes.
///
/// # Errors
/// SUMO is missing or of another version, a network differs, the scenes differ from the list's
/// checksums, or [`EvalError::Stopped`].
pub fn make(
    list: &BenchmarkList,
    part: &GeneratedPart,
    folder: &Path,
    monitor: &dyn Monitor,
) -> Result<bool, EvalError> {
    let check = || verify_generated(list, part, folder, monitor);
    if !part.scenes.is_empty() && check().is_ok() {
        monitor.advance(part.kept() as u64);
        return Ok(false);
    }
    write(list, part, folder, monitor)?;
    check().map_err(|error| {
        let generator = part.generator.clone();
        error.at(ErrorContext::Remaking { generator })
    })?;
    Ok(true)
}

/// Makes the file of a part and returns the checksums and ids that the list should have for its
/// scenes.
///
/// # Errors
/// As [`make`], checksums aside.
pub fn freeze(
    list: &BenchmarkList,
    part: &GeneratedPart,
    folder: &Path,
    monitor: &dyn Monitor,
) -> Result<Vec<String>, EvalError> {
    write(list, part, folder, monitor)?;
    checksums(&list.file(folder, part), monitor)
}

fn write(
    list: &BenchmarkList,
    part: &GeneratedPart,
    folder: &Path,
    monitor: &dyn Monitor,
) -> Result<(), EvalError> {
    let scenes = match Generator::of(part)? {
        Generator::Procedural(config) => (0..part.count as u64)
            .into_par_iter()
            .filter(|&k| part.keeps(k as usize))
            .map(|k| {
                monitor.check()?;
                let scene = synthesize(&config, Seed(part.seed).fork(k));
                monitor.advance(1);
                Ok(scene)
            })
            .collect::<Result<Vec<_>, EvalError>>()?,
        Generator::Sumo(demand) => {
            let path = list.file(folder, part).with_extension("work");
            let mut scenes = Simulation::begin(list, part, demand, path)?.scenes(monitor)?;
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
    create_folder(parent)?;
    gump_data::womd::write_scenarios(&path, scenes)?;
    Ok(())
}

fn create_folder(path: &Path) -> Result<(), EvalError> {
    std::fs::create_dir_all(path).map_err(|cause| EvalError::io("create the folder", path, cause))
}

/// SUMO at work on a part.
struct Simulation<'a> {
    part: &'a GeneratedPart,
    sumo: Sumo,
    demand: SumoDemand,
    /// Networks to take in turn; none: made anew for every run.
    places: Vec<SumoNetwork>,
    work: PathBuf,
}

impl<'a> Simulation<'a> {
    fn begin(
        list: &BenchmarkList,
        part: &'a GeneratedPart,
        demand: SumoDemand,
        work: PathBuf,
    ) -> Result<Self, EvalError> {
        let place = || ErrorContext::Making {
            part: part.file.clone(),
        };
        let sumo = Sumo::find().map_err(|error| error.at(place()))?;
        let (expected, found) = (part.sumo.as_deref().unwrap_or_default(), sumo.version()?);
        let mut words = found.split_whitespace();
        if !words.any(|word| word.trim_start_matches(['v', 'V']) == expected) {
            return Err(SumoError::Version {
                part: part.file.clone(),
                list: list.path().to_owned(),
                expected: expected.into(),
                found,
            }
            .into());
        }
        create_folder(&work)?;
        let mut places = Vec::new();
        for network in &part.networks {
            let path = list.beside(&network.path);
            let found = sha256(&path)?;
            if found != network.sha256 {
                return Err(BenchmarkError::NetworkChecksum {
                    expected: network.sha256.clone(),
                    found,
                    path,
                }
                .into());
            }
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
    fn scenes(self, monitor: &dyn Monitor) -> Result<Vec<Scenario>, EvalError> {
        let (count, per_run) = (self.part.count, self.part.per_run.unwrap_or(1).max(1));
        let (mut scenes, mut next) = (Vec::new(), 0_u64);
        let most = count.div_ceil(per_run) as u64 + SPARE_RUNS;
        while scenes.len() < count {
            if next >= most {
                return Err(SumoError::TooFewScenes {
                    runs: next,
                    found: scenes.len(),
                    expected: count,
                    part: self.part.file.clone(),
                }
                .into());
            }
            let runs = (count - scenes.len()).div_ceil(per_run) as u64;
            let found = (next..next + runs).into_par_iter().map(|r| {
                monitor.check()?;
                let found = self.run(r, per_run)?;
                monitor.advance(found.len() as u64);
                Ok(found)
            });
            let found = found.collect::<Result<Vec<_>, EvalError>>()?;
            scenes.extend(found.into_iter().flatten());
            next += runs;
        }
        scenes.truncate(count);
        std::fs::remove_dir_all(&self.work)
            .map_err(|cause| EvalError::io("remove", &self.work, cause))?;
        Ok(scenes)
    }

    /// A few scenes of a run, from its whole length.
    fn run(&self, r: u64, few: usize) -> Result<Vec<Scenario>, EvalError> {
        let folder = self.work.join(format!("run-{r:05}"));
        create_folder(&folder)?;
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
    use crate::benchmarks::tests::repository;

    fn shipped(name: &str) -> BenchmarkList {
        BenchmarkList::read(&repository().join(format!("datasets/benchmarks/{name}.toml"))).unwrap()
    }

    /// Checks that the first scenes of the parts that are `wanted` have the checksums of the lists.
    fn first_scenes_are_as_frozen(n: usize, wanted: impl Fn(&GeneratedPart) -> bool) {
        let folder = tempfile::tempdir().unwrap();
        let mut parts = 0;
        for name in [
            "synthetic-tune",
            "synthetic-test",
            "learning-usual",
            "learning-dense",
        ] {
            let list = shipped(name);
            for part in list.generated.iter().filter(|part| wanted(part)) {
                let first = GeneratedPart {
                    count: n,
                    scenes: part.scenes[..n].to_vec(),
                    ..part.clone()
                };
                assert!(make(&list, &first, folder.path(), &()).unwrap());
                // A verified file is left alone.
                assert!(!make(&list, &first, folder.path(), &()).unwrap());
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
        let is_small = |part: &GeneratedPart| {
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
        let list = shipped("synthetic-tune");
        let part = GeneratedPart {
            count: 1,
            scenes: vec!["0123456789abcdef other".into()],
            ..list.generated[0].clone()
        };
        let error = |part: &GeneratedPart| {
            let result = make(&list, part, folder.path(), &());
            result.unwrap_err().to_string()
        };
        let message = error(&part);
        assert!(
            message.contains("expected scene 0 of procedural"),
            "{message}"
        );
        assert!(message.contains("synthetic-tune.toml"), "{message}");
        let unknown = GeneratedPart {
            generator: "procedural/99".into(),
            ..part
        };
        assert!(error(&unknown).contains("found procedural/99"));
    }
}
