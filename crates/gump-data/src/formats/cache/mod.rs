//! The cache: scenarios as they are after reading, in files for training.
//!
//! A cache is a folder of shards (or one of them), each with its own index, so that shards can be
//! copied, combined and deleted like any file. Opening reads only the indices; a scenario is read
//! by its index without touching the others, from many threads at once. The stored scenarios are
//! those of a reader, including inferred values, bit for bit: [`ReadOptions`] have no effect here.
//! This includes the ego's route, which is usually derived from its future: see
//! [`gump_scene::SceneState::unguided`].
//!
//! Start with [`write_shard`] and [`Cache::open`]; [`crate::open`] reads a cache like any format.
//!
//! Files are read at positions, not memory-mapped: truncation of a mapped file by another program
//! ends the process, which no check can prevent. The operating system caches hot pages either way,
//! and most of the time to read a scenario is spent on the indices of its map.

mod bytes;
mod log;
mod map;
mod shard;

use std::fs::File;
use std::io::Read as _;
use std::path::Path;
use std::sync::Arc;

use gump_scene::Scenario;

use crate::io::files;
use crate::source::{BoxedSource, Format, RecordSource};
use crate::{DataError, ReadOptions, ReadReport, ScenarioRecord};
use shard::{MAGIC, Shard};

pub(crate) use shard::ShardWriter;
pub use shard::write_shard;

pub(crate) const FORMAT: Format = Format {
    name: "gump cache",
    recognises: |head| head.starts_with(MAGIC),
    open,
};

/// An open cache. Holds the indices; every read opens its file anew.
pub struct Cache {
    shards: Vec<Shard>,
    /// The number of the first scenario after each shard.
    ends: Vec<usize>,
}

impl Cache {
    /// Opens a shard, or every shard of a directory and its subdirectories in order of their paths;
    /// files of other kinds are ignored.
    ///
    /// # Errors
    /// [`DataError::Cache`] for a file that is damaged, truncated, of another version or, given
    /// alone, not a shard; [`DataError::NoFiles`] for a directory without shards;
    /// [`DataError::Missing`], [`DataError::Io`].
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let mut files = files::list(path)?;
        let all = files.len();
        if path.is_dir() {
            files.retain(|file| is_shard(file));
        }
        if files.is_empty() {
            return Err(DataError::NoFiles {
                others: all,
                path: path.into(),
            });
        }
        let shards = files.iter().map(|file| Shard::open(file));
        let shards = shards.collect::<Result<Vec<_>, _>>()?;
        let mut end = 0;
        let ends = shards.iter().map(|shard| {
            end += shard.records.len();
            end
        });
        Ok(Self {
            ends: ends.collect(),
            shards,
        })
    }

    /// Number of scenarios.
    pub fn len(&self) -> usize {
        self.ends.last().copied().unwrap_or(0)
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The id of a scenario, without reading it; `None` beyond the last.
    pub fn id(&self, index: usize) -> Option<&str> {
        let (shard, record) = self.place(index)?;
        Some(&shard.records[record].id)
    }

    /// Reads one scenario; `None` beyond the last.
    ///
    /// # Errors
    /// [`DataError::Checksum`] and [`DataError::Cache`] for damage, [`DataError::Scenario`] for a
    /// record that is not a valid scenario, [`DataError::Io`].
    pub fn get(&self, index: usize) -> Result<Option<Scenario>, DataError> {
        self.place(index)
            .map(|(shard, record)| shard.read(record))
            .transpose()
    }

    fn place(&self, index: usize) -> Option<(&Shard, usize)> {
        let shard = self.ends.partition_point(|&end| end <= index);
        let start = shard.checked_sub(1).map_or(0, |before| self.ends[before]);
        Some((self.shards.get(shard)?, index - start))
    }
}

pub(crate) fn is_shard(file: &Path) -> bool {
    let mut head = [0; MAGIC.len()];
    // A file that cannot be read is no shard; opening it reports the reason.
    let read = File::open(file).and_then(|mut file| file.read_exact(&mut head));
    read.is_ok() && head == *MAGIC
}

fn open(path: &Path, _: ReadOptions) -> Result<BoxedSource, DataError> {
    Ok(Box::new(Records {
        shard: Shard::open(path)?,
        next: 0,
    }))
}

struct Records {
    shard: Shard,
    next: usize,
}

impl RecordSource for Records {
    fn skip(&mut self) -> Option<Result<(), DataError>> {
        let more = self.next < self.shard.records.len();
        self.next += usize::from(more);
        more.then_some(Ok(()))
    }

    fn next_wanted(
        &mut self,
        wanted: &mut dyn FnMut(&str) -> bool,
    ) -> Option<Result<ScenarioRecord, DataError>> {
        loop {
            let record = self.next;
            let entry = self.shard.records.get(record)?;
            self.next += 1;
            if !wanted(&entry.id) {
                continue;
            }
            return Some(self.shard.read(record).map(|scenario| ScenarioRecord {
                scenario,
                report: ReadReport::default(),
                offset: entry.offset,
                path: Arc::clone(&self.shard.path),
            }));
        }
    }
}
