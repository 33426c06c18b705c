//! Scenarios to train on: held in memory, in a cache, or streamed as they are made up.
//!
//! Which files a set has and which scenes are for training is in [`gump_eval::datasets`].

use std::borrow::Cow;
use std::ops::Range;
use std::path::{Path, PathBuf};

use gump_data::cache::Cache;
use gump_eval::datasets::{Part, read};
use gump_model::ModelError;
use gump_scene::{Scenario, Seed};
use gump_train::ScenarioSource;

use crate::fresh::{Fresh, Stream};
use crate::progress::Progress;

/// Scenarios to train on: those in a cache stay there until they are asked for, others are held;
/// or a stream of scenes that are made up.
pub(crate) struct Training {
    /// Each with the number of the first scenario after it.
    sources: Vec<(usize, Source)>,
    /// Takes the place of all sources.
    fresh: Option<Fresh>,
    /// Takes the place of both: sets of which samples are drawn in these shares.
    mixed: Vec<(f64, Training)>,
}

enum Source {
    Held(Vec<Scenario>),
    Cached { cache: Cache, start: usize },
}

impl Training {
    /// Opens the parts, and reads those that are no cache.
    ///
    /// Error: the first record that cannot be read, a damaged index of a cache, or Ctrl-C.
    pub(crate) fn open(parts: &[Part], progress: &Progress) -> anyhow::Result<Self> {
        let (mut sources, mut end) = (Vec::new(), 0);
        for part in parts {
            let source = if Cache::is_at(&part.path)? {
                let cache = Cache::open(&part.path)?;
                let Range { start, end: stop } = part.scenes;
                end += stop.min(cache.len()).saturating_sub(start);
                Source::Cached { cache, start }
            } else {
                let held = read(std::slice::from_ref(part), progress)?;
                end += held.len();
                Source::Held(held)
            };
            sources.push((end, source));
        }
        Ok(Self {
            sources,
            fresh: None,
            mixed: Vec::new(),
        })
    }

    /// A stream, for steps of `batch` samples.
    pub(crate) fn fresh(stream: Stream, batch: usize) -> Self {
        Self {
            sources: Vec::new(),
            fresh: Some(Fresh::start(stream, batch)),
            mixed: Vec::new(),
        }
    }

    /// Samples of several sets, each with its share.
    pub(crate) fn mixed(mut sets: Vec<(f64, Self)>) -> Self {
        if sets.len() == 1 {
            return sets.remove(0).1;
        }
        Self {
            sources: Vec::new(),
            fresh: None,
            mixed: sets,
        }
    }

    /// The ids of all.
    pub(crate) fn ids(&self) -> Box<dyn Iterator<Item = &str> + '_> {
        let of_mixed = self.mixed.iter().flat_map(|(_, set)| set.ids());
        let starts = std::iter::once(0).chain(self.sources.iter().map(|(end, _)| *end));
        let sources = self.sources.iter().zip(starts);
        let own = sources.flat_map(|((end, source), begin)| {
            (0..end - begin).filter_map(move |i| match source {
                Source::Held(held) => held.as_slice().get(i).map(|scene| scene.id.as_str()),
                Source::Cached { cache, start } => cache.id(start + i),
            })
        });
        Box::new(own.chain(of_mixed))
    }
}

impl ScenarioSource for Training {
    fn len(&self) -> usize {
        let held = self.sources.last().map_or(0, |(end, _)| *end);
        let own = self.fresh.as_ref().map_or(held, Fresh::len);
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

    fn get(&self, index: usize) -> Result<Cow<'_, Scenario>, ModelError> {
        if let Some(fresh) = &self.fresh {
            return fresh.get(index);
        }
        if !self.mixed.is_empty() {
            let n = self.mixed.len();
            return self.mixed[index % n].1.get(index / n);
        }
        let missing = || ModelError::Scene(format!("there is no scenario {index}"));
        let i = self.sources.partition_point(|(end, _)| *end <= index);
        let begin = i.checked_sub(1).map_or(0, |before| self.sources[before].0);
        match self.sources.get(i).map(|(_, source)| source) {
            None => Err(missing()),
            Some(Source::Held(held)) => Ok(Cow::Borrowed(&held[index - begin])),
            Some(Source::Cached { cache, start }) => {
                let found = cache.get(start + index - begin);
                let found = found.map_err(|error| ModelError::Scene(error.to_string()))?;
                found.map(Cow::Owned).ok_or_else(missing)
            }
        }
    }
}

/// A number in 0..1 from a number drawn at random, and another one drawn at random.
fn uniform_and_rest(draw: u64) -> (f64, u64) {
    let seed = Seed(draw);
    let share = (seed.fork(0).0 >> 11) as f64 / (1u64 << 53) as f64;
    (share, seed.fork(1).0)
}

/// `PATH=SHARE` as a path and a share; a path alone has 1.
pub(crate) fn with_share(named: &Path) -> (PathBuf, f64) {
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
        let silent = Progress::begin(true, "", 0, "");
        let numbers = |parts: &[Part]| {
            let scenes = Training::open(parts, &silent).unwrap();
            let ids: Vec<&str> = scenes.ids().collect();
            let read = (0..scenes.len()).map(|i| scenes.get(i).unwrap().id.clone());
            assert_eq!(ids, read.collect::<Vec<_>>());
            let id = |i| scenes.get(i).unwrap().id.clone();
            assert!(scenes.get(scenes.len()).is_err());
            (0..scenes.len()).map(id).collect::<Vec<_>>().join("")
        };
        let parts = [part(&shard, 2..4), part(&file, 1..3), part(&shard, 5..99)];
        assert_eq!(numbers(&parts), "231256");
        assert_eq!(numbers(&[Part::whole(&shard)]), "0123456");
        assert_eq!(numbers(&[Part::whole(&file)]), "0123456");
    }
}
