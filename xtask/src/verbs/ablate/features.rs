//! `ablate features`: what each option of the network and of its training is worth, by leaving it
//! out or putting it in.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use gump_model::ModelConfig;
use gump_train::TrainConfig;
use gump_viz::Bars;
use serde::Serialize;
use serde_json::{Value, json};

use super::train_variant::{TrainVariant, of_width};
use crate::charts;
use crate::run::{Common, Run};

/// Arguments of `ablate features`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    #[serde(flatten)]
    train_variant: TrainVariant,
    /// Width of the networks, a multiple of 32 [tiny: 128]
    #[arg(long, value_name = "C", default_value_t = 64, value_parser = width)]
    width: usize,
    /// Only these features, beside the recorded configuration
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
const FEATURES: [(&str, Turn); 9] = [
    ("recorded", |_, _| {}),
    ("no-local-context", |model, _| model.local_context = false),
    ("no-local-frame", |model, _| model.local_frame = false),
    ("no-local-map", |model, _| model.local_map = false),
    ("no-sharing-pairs", |model, _| {
        model.local_map = false;
        model.pairs_share = false;
    }),
    ("free-bins", |model, _| model.smooth_bins = false),
    ("sharp-targets", |_, train| train.loss.smoothing_bins = 0.0),
    ("no-perturbation", |_, train| {
        train.sample.lateral_perturbation = 0.0;
    }),
    ("no-turns", |_, train| train.sample.augment = 0.0),
];

/// Features under their former names, which `--only` still takes, and under their present ones.
const FORMER: [(&str, &str); 3] = [
    ("no-surroundings", "no-local-context"),
    ("no-anchors", "no-local-frame"),
    ("no-sway", "no-perturbation"),
];

fn known() -> impl TypedValueParser<Value = String> {
    let value = |&(name, _): &(&'static str, Turn)| {
        let former = FORMER.iter().filter(move |(_, present)| *present == name);
        PossibleValue::new(name).aliases(former.map(|(former, _)| *former))
    };
    PossibleValuesParser::new(FEATURES[1..].iter().map(value)).map(|name| {
        let former = FORMER.iter().find(|(former, _)| *former == name);
        former.map_or(name, |(_, present)| (*present).to_owned())
    })
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let held_out = self.train_variant.begin(run)?;
        let is_requested = |name: &str| {
            name == FEATURES[0].0 || self.only.is_empty() || self.only.iter().any(|o| o == name)
        };
        let mut rows = Vec::new();
        for (name, turn) in FEATURES.into_iter().filter(|(name, _)| is_requested(name)) {
            let (mut model, mut train) = of_width(self.width)?;
            turn(&mut model, &mut train);
            let learned =
                held_out.teach(run, name, (model, train), &[self.train_variant.steps()])?;
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
    fn every_feature_changes_something_and_makes_a_network() {
        let recorded = of_width(64).unwrap();
        for (name, turn) in &FEATURES[1..] {
            let mut changed = recorded.clone();
            turn(&mut changed.0, &mut changed.1);
            assert!(changed != recorded, "{name}");
            assert!(changed.0.validate().is_ok(), "{name}");
        }
        assert!(width("64").is_ok() && width("60").is_err() && width("0").is_err());
    }
}
