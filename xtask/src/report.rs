//! `report.json`: the command, the machine, the times and the results of a run.

use std::collections::BTreeSet;
use std::io::Write as _;
use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use serde::Serialize;
use serde_json::{Map, Value};

use crate::machine::{self, Machine};
use crate::{table, tables};

/// The report of one run, in the order in which it is written.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    /// The verb, for instance "data inspect".
    pub(crate) verb: String,
    /// The command line as given.
    pub(crate) args: Vec<String>,
    /// Commit of the checkout.
    pub(crate) commit: String,
    /// Seed of all randomness.
    pub(crate) seed: u64,
    /// Every setting with its value, wherever it was set.
    pub(crate) config: Value,
    /// The machine that it ran on.
    pub(crate) machine: Machine,
    /// Wall seconds per phase in order, then the total.
    pub(crate) seconds: Map<String, Value>,
    /// Peak main memory, MB; null where the system does not report it.
    pub(crate) peak_rss_mb: Option<f64>,
    /// Results; the same for the same seed and machine, except for times.
    pub(crate) results: Map<String, Value>,
    /// Keys of results that the terminal does not show.
    #[serde(skip)]
    pub(crate) hidden: BTreeSet<String>,
    /// The error message, if it failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) error: Option<String>,
}

impl Report {
    /// An empty report on this machine and command line.
    pub(crate) fn begin(verb: &str, seed: u64, config: Value, device: &str) -> Self {
        let args = std::env::args_os().skip(1);
        Self {
            verb: verb.into(),
            args: args
                .map(|word| word.to_string_lossy().into_owned())
                .collect(),
            commit: machine::commit(),
            seed,
            config,
            machine: Machine::here(device),
            seconds: Map::new(),
            peak_rss_mb: None,
            results: Map::new(),
            hidden: BTreeSet::new(),
            error: None,
        }
    }

    /// Adds seconds to a phase.
    pub(crate) fn add_seconds(&mut self, phase: &str, elapsed: Duration) {
        let before = self.seconds.get(phase).and_then(Value::as_f64);
        let seconds = before.unwrap_or(0.0) + elapsed.as_secs_f64();
        self.seconds
            .insert(phase.into(), ((seconds * 1e4).round() / 1e4).into());
    }

    /// Writes it as `path`, whole or not at all.
    pub(crate) fn write(&mut self, path: &Path) -> anyhow::Result<()> {
        self.peak_rss_mb = machine::peak_rss_mb();
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        gump_data::write_atomically(path, |file| {
            file.write_all(text.as_bytes())
                .with_context(|| format!("cannot write {}", path.display()))
        })
    }

    /// Writes every list of objects among the results as `KEY.parquet` into `folder`.
    pub(crate) fn write_tables(&self, folder: &Path) -> anyhow::Result<()> {
        for (key, value) in &self.results {
            let rows = value.as_array().map_or(&[][..], Vec::as_slice);
            if !rows.is_empty() && rows.iter().all(Value::is_object) {
                tables::of_rows(rows).write(&folder.join(format!("{key}.parquet")))?;
            }
        }
        Ok(())
    }

    /// True if there is a result that the terminal shows.
    pub(crate) fn has_something_to_show(&self) -> bool {
        self.results.keys().any(|key| !self.hidden.contains(key))
    }

    /// The results and times as a terminal of so many columns shows them.
    pub(crate) fn text(&self, width: usize) -> String {
        let mut shown = self.results.clone();
        shown.retain(|key, _| !self.hidden.contains(key));
        let results = table::text(&Value::Object(shown), width);
        let seconds = self.seconds.iter().map(|(phase, seconds)| {
            let seconds = seconds.as_f64().unwrap_or_default();
            format!("{phase} {seconds:.2}")
        });
        let seconds: Vec<_> = seconds.collect();
        format!("{results}\nseconds: {}\n", seconds.join(", "))
    }
}
