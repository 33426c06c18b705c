//! Scenarios to train on: held in memory, in a cache, or streamed as they are generated.
//!
//! The files of a set, and which of its scenes are for training, are in [`datasets`](crate::datasets).

use std::borrow::Cow;
use std::ops::Range;
use std::path::{Path, PathBuf};

use gump_data::cache::Cache;
use gump_scene::{Scenario, Seed};
use gump_train::{ScenarioSource, TrainError, identity_of};

use crate::datasets::{Part, read};
use crate::fresh::{FreshScenes, SceneStream};
use crate::{EvalError, Monitor};

/// Scenarios to train on: those in a cache are read when needed, others are held in memory; or a
/// stream of synthetic scenes.
pub struct TrainingSet {
    /// Each with the number of the first scenario after it.
    stores: Vec<(usize, ScenarioStore)>,
    /// Takes the place of all stores.
    fresh: Option<FreshScenes>,
    /// Takes the place of both: sets of which samples are drawn in these shares.
    mixed: Vec<(f64, Self)>,
}

enum ScenarioStore {
    Held(Vec<Scenario>),
    Cached { cache: Cache, start: usize },
}

impl TrainingSet {
    /// Opens the parts, and reads those that are no cache; the monitor counts scenarios.
    ///
    /// # Errors
    /// The first record that cannot be read, a damaged index of a cache, or [`EvalError::Stopped`].
    pub fn open(parts: &[Part], monitor: &dyn Monitor) -> Result<Self, EvalError> {
        let (mut stores, mut end) = (Vec::new(), 0);
        for part in parts {
            let store = if Cache::is_at(&part.path)? {
                let cache = Cache::open(&part.path)?;
                let Range { start, end: stop } = part.scenes;
                end += stop.min(cache.len()).saturating_sub(start);
                ScenarioStore::Cached { cache, start }
            } else {
                let held = read(std::slice::from_ref(part), monitor)?;
                end += held.len();
                ScenarioStore::Held(held)
            };
            stores.push((end, store));
        }
        Ok(Self {
            stores,
            fresh: None,
            mixed: Vec::new(),
        })
    }

    /// A stream, for steps of `batch` samples.
    pub fn fresh(stream: SceneStream, batch: usize) -> Self {
        Self {
            stores: Vec::new(),
            fresh: Some(FreshScenes::start(stream, batch)),
            mixed: Vec::new(),
        }
    }

    /// Several sets, of which samples are drawn in proportion to their shares.
    pub fn mixed(mut sets: Vec<(f64, Self)>) -> Self {
        if sets.len() == 1 {
            return sets.remove(0).1;
        }
        Self {
            stores: Vec::new(),
            fresh: None,
            mixed: sets,
        }
    }

    /// The ids of all scenarios; of a stream none.
    pub fn ids(&self) -> Box<dyn Iterator<Item = &str> + '_> {
        let of_mixed = self.mixed.iter().flat_map(|(_, set)| set.ids());
        let starts = std::iter::once(0).chain(self.stores.iter().map(|(end, _)| *end));
        let stores = self.stores.iter().zip(starts);
        let own = stores.flat_map(|((end, store), begin)| {
            (0..end - begin).filter_map(move |i| match store {
                ScenarioStore::Held(held) => held.as_slice().get(i).map(|scene| scene.id.as_str()),
                ScenarioStore::Cached { cache, start } => cache.id(start + i),
            })
        });
        Box::new(own.chain(of_mixed))
    }
}

impl ScenarioSource for TrainingSet {
    fn len(&self) -> usize {
        let held = self.stores.last().map_or(0, |(end, _)| *end);
        let own = self.fresh.as_ref().map_or(held, FreshScenes::len);
        own + self.mixed.iter().map(|(_, set)| set.len()).sum::<usize>()
    }

    fn pick(&self, step: usize, draw: u64) -> usize {
        if !self.mixed.is_empty() {
            let (mut left, within) = uniform_and_rest(draw);
            left *= self.mixed.iter().map(|(share, _)| share).sum::<f64>();
            let chosen = self.mixed.iter().position(|(share, _)| {
                left -= share;
                left < 0.0
            });
            let i = chosen.unwrap_or(self.mixed.len() - 1);
            return self.mixed[i].1.pick(step, within) * self.mixed.len() + i;
        }
        match &self.fresh {
            Some(fresh) => fresh.pick(step, draw),
            None => (draw % self.len() as u64) as usize,
        }
    }

    fn get(&self, index: usize) -> Result<Cow<'_, Scenario>, TrainError> {
        if let Some(fresh) = &self.fresh {
            return Ok(fresh.get(index));
        }
        if !self.mixed.is_empty() {
            let n = self.mixed.len();
            return self.mixed[index % n].1.get(index / n);
        }
        let missing = || TrainError::Source(format!("there is no scenario {index}").into());
        let i = self.stores.partition_point(|(end, _)| *end <= index);
        let begin = i.checked_sub(1).map_or(0, |before| self.stores[before].0);
        match self.stores.get(i).map(|(_, store)| store) {
            None => Err(missing()),
            Some(ScenarioStore::Held(held)) => Ok(Cow::Borrowed(&held[index - begin])),
            Some(ScenarioStore::Cached { cache, start }) => {
                let found = cache.get(start + index - begin);
                let found = found.map_err(|error| TrainError::Source(error.into()))?;
                found.map(Cow::Owned).ok_or_else(missing)
            }
        }
    }

    fn identity(&self) -> String {
        if let Some(fresh) = &self.fresh {
            return fresh.identity();
        }
        if self.mixed.is_empty() {
            return identity_of(self.ids());
        }
        let parts = self.mixed.iter();
        let parts: Vec<String> = parts
            .map(|(share, set)| format!("{share} of {}", set.identity()))
            .collect();
        parts.join(", ")
    }
}

/// A number in 0..1 from a number drawn at random, and another one drawn at random.
fn uniform_and_rest(draw: u64) -> (f64, u64) {
    let seed = Seed(draw);
    let share = (seed.fork(0).0 >> 11) as f64 / (1u64 << 53) as f64;
    (share, seed.fork(1).0)
}

/// `PATH=SHARE` as a path and a share; a path alone has 1.
pub fn with_share(named: &Path) -> (PathBuf, f64) {
    let split = named.to_str().and_then(|text| text.rsplit_once('='));
    let share = split.and_then(|(path, share)| Some((path, share.parse::<f64>().ok()?)));
    match share {
        Some((path, share)) if share.is_finite() && share > 0.0 => (path.into(), share),
        _ => (named.to_owned(), 1.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_of_a_cache_and_of_a_file_have_the_same_numbers() {
        let folder = tempfile::tempdir().unwrap();
        let named = |id: &usize| Scenario {
            id: id.to_string(),
            ..gump_scene::fixture::scenario("lane 1: 0,0 99,0\nego vehicle 0: 0,0").unwrap()
        };
        let ids: Vec<usize> = (0..7).collect();
        let [file, shard] = ["file.tfrecord", "shard"].map(|name| folder.path().join(name));
        gump_data::womd::write_scenarios(&file, ids.iter().map(named)).unwrap();
        gump_data::cache::write_shard(&shard, ids.iter().map(named)).unwrap();
        let part = |path: &Path, scenes| Part {
            path: path.to_owned(),
            scenes,
        };
        let numbers = |parts: &[Part]| {
            let scenes = TrainingSet::open(parts, &()).unwrap();
            let ids: Vec<&str> = scenes.ids().collect();
            let read = (0..scenes.len()).map(|i| scenes.get(i).unwrap().id.clone());
            assert_eq!(ids, read.collect::<Vec<_>>());
            let id = |i| scenes.get(i).unwrap().id.clone();
            assert!(scenes.get(scenes.len()).is_err());
            (0..scenes.len()).map(id).collect::<Vec<_>>().join("")
        };
        let parts = [part(&shard, 2..4), part(&file, 1..3), part(&shard, 5..99)];
        assert_eq!(numbers(&parts), "231256");
        let identity = |parts: &[Part]| TrainingSet::open(parts, &()).unwrap().identity();
        assert_eq!(identity(&parts), identity(&parts));
        assert_ne!(identity(&parts), identity(&parts[..2]));
        assert_eq!(
            identity(&[Part::whole(&shard)]),
            identity(&[Part::whole(&file)])
        );
        assert_eq!(numbers(&[Part::whole(&shard)]), "0123456");
        assert_eq!(numbers(&[Part::whole(&file)]), "0123456");
    }
}
