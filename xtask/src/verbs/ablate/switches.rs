//! `ablate switches`: what each option of the network and of its training is worth, by leaving it
//! out or putting it in.

use gump_model::ModelConfig;
use gump_train::TrainConfig;
use gump_viz::Bars;
use serde::Serialize;
use serde_json::{Value, json};

use super::train_variant::{TrainVariant, of_width};
use crate::charts;
use crate::run::{Common, Run};

/// Arguments of `ablate switches`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    #[serde(flatten)]
    train_variant: TrainVariant,
    /// Width of the networks, a multiple of 32 [tiny: 128]
    #[arg(long, value_name = "C", default_value_t = 64, value_parser = width)]
    width: usize,
    /// Only these switches, beside the recorded configuration
    #[arg(long, value_name = "NAME", value_delimiter = ',', value_parser = known())]
    only: Vec<String>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

fn width(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(width) if width > 0 && width % 32 == 0 => Ok(width),
        _ => Err("expected a multiple of 32".into()),
    }
}

type Turn = fn(&mut ModelConfig, &mut TrainConfig);

/// The recorded configuration, and what is changed of it.
const SWITCHES: [(&str, Turn); 9] = [
    ("recorded", |_, _| {}),
    ("no-surroundings", |model, _| model.surroundings = false),
    ("no-anchors", |model, _| model.anchored = false),
    ("no-local-map", |model, _| model.local_map = false),
    ("no-sharing-pairs", |model, _| {
        model.local_map = false;
        model.pairs_share = false;
    }),
    ("free-bins", |model, _| model.smooth_bins = false),
    ("sharp-targets", |_, train| train.loss.smoothing_bins = 0.0),
    ("no-perturbation", |_, train| {
        train.sample.lateral_perturbation = 0.0
    }),
    ("no-turns", |_, train| train.sample.augment = 0.0),
];

fn known() -> clap::builder::PossibleValuesParser {
    SWITCHES[1..].iter().map(|(name, _)| *name).into()
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let class = self.train_variant.begin(run)?;
        let is_requested = |name: &str| {
            name == SWITCHES[0].0 || self.only.is_empty() || self.only.iter().any(|o| o == name)
        };
        let mut rows = Vec::new();
        for (name, turn) in SWITCHES.into_iter().filter(|(name, _)| is_requested(name)) {
            let (mut model, mut train) = of_width(self.width)?;
            turn(&mut model, &mut train);
            let learned = class.teach(run, name, (model, train), &[self.train_variant.steps()])?;
            let mut row = learned.row()?;
            row["switch"] = json!(name);
            rows.push(row);
            run.result("rows", &rows)?;
            charts::save(run, "switches", &chart(&rows))?;
        }
        Ok(())
    }
}

fn chart(rows: &[Value]) -> Bars {
    let names = rows.iter().filter_map(|row| row["switch"].as_str());
    let label = "realism (2025), mean and 95 % interval";
    charts::bars(
        label,
        names.map(String::from).collect(),
        vec!["realism".into()],
        |i, _| charts::bar(&rows[i]["metametric"], &rows[i]["low"], &rows[i]["high"]),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_switch_changes_something_and_makes_a_network() {
        let recorded = of_width(64).unwrap();
        for (name, turn) in &SWITCHES[1..] {
            let mut changed = recorded.clone();
            turn(&mut changed.0, &mut changed.1);
            assert!(changed != recorded, "{name}");
            assert!(changed.0.validate().is_ok(), "{name}");
        }
        assert!(width("64").is_ok() && width("60").is_err() && width("0").is_err());
    }
}
