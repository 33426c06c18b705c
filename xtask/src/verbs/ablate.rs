//! `ablate`: the paper's ablations, one table and one picture each.

mod decoding;
mod features;
mod scaling;
mod train_variant;

use std::num::NonZeroUsize;

use gump_data::find;
use gump_engine::Mode;
use gump_eval::decoding::Decoding;
use gump_eval::digest;
use gump_metrics::{Part, summarize};
use gump_scene::{Rollout, Scenario};
use gump_viz::Picture;
use serde::Serialize;
use serde_json::{Map, Value, json};

pub(crate) use self::decoding::Sweep;
use gump_eval::worlds::{World, WorldName};

use crate::cli::WrongArguments;
use crate::imagine::{Imagined, imagine};
use crate::run::{Common, Run};
use crate::sampling::Draw;
use crate::{films, futures, shipped};

/// The ablations.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Decoding one agent after another (full-AR) against all at once (partial-AR)
    Nar(Args),
    /// Weights in 32, 16 and 8 bits
    Quantization(decoding::Args),
    /// Realism over the temperature of the draws
    Temperature(decoding::Args),
    /// Realism over the weight of earlier predictions
    Decay(decoding::Args),
    /// Realism over the frames of history that are seen
    History(decoding::Args),
    /// One pose at a time against chunks of four, without and with averaging
    Chunking(decoding::Args),
    /// Three sizes trained on the same samples: loss against tokens with a fitted law, and realism
    Scaling(scaling::Args),
    /// Each option of the network and of its training left out or put in: loss and realism
    #[command(alias = "switches")]
    Features(features::Args),
}

/// Arguments of `ablate nar`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// PATH, PATH#INDEX or PATH#SCENARIO_ID [default: a shipped one]
    #[arg(long, value_name = "S")]
    scenario: Option<String>,
    /// model:WEIGHTS [default: the shipped weights]
    #[arg(long, value_name = "W")]
    world: Option<WorldName>,
    /// Number of futures
    #[arg(long, value_name = "N", default_value = "8")]
    futures: NonZeroUsize,
    /// Simulated seconds
    #[arg(long, value_name = "S", default_value_t = 8.0)]
    seconds: f64,
    #[command(flatten)]
    #[serde(flatten)]
    draw: Draw,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        futures::check(self.futures.get(), self.seconds)?;
        let name = match &self.scenario {
            Some(name) => name.clone(),
            None => shipped::scenario(),
        };
        let scenario = run.phase("read", |_| Ok(find(&name)?))?;
        run.setting("scenario", &name)?;
        let world = self.world.clone().unwrap_or_else(shipped::sequence_world);
        if !matches!(world, WorldName::Model(_)) {
            let wrong = format!(
                "--world: expected model:WEIGHTS, since rules decode nothing, found {world}"
            );
            return Err(WrongArguments(wrong).into());
        }
        let mut rows = Vec::new();
        let (mut pairs, mut digests) = (Vec::new(), Vec::new());
        let fulls = self.draw.decodings(Mode::FullAr)?;
        let partials = self.draw.decodings(Mode::PartialAr)?;
        for (full, partial) in fulls.iter().zip(&partials) {
            let pair = [
                self.imagine(run, &scenario, &world, full, "full-AR")?,
                self.imagine(run, &scenario, &world, partial, "partial-AR")?,
            ];
            let parts = pair
                .each_ref()
                .map(|imagined| summarize(&imagined.rollouts, Some(&scenario)).total());
            for (mode, i) in [("full-AR", 0), ("partial-AR", 1)] {
                let (imagined, decoding) = (&pair[i], partial.name);
                rows.push(row(mode, decoding, imagined, &parts[i]));
                let digest = digest::of_rollouts(&imagined.rollouts);
                digests.push(json!({"mode": mode, "decoding": decoding, "digest": digest}));
            }
            pairs.push((pair, parts));
        }
        run.result("rows", rows)?;
        run.result("digests", digests)?;
        let ([full, partial], [full_part, partial_part]) = &pairs[0];
        let ratio = partial.frames_per_second() / full.frames_per_second();
        run.result("ratio", ratio)?;
        run.print("ratio: frames per second of partial-AR over those of full-AR");
        run.result("difference", difference(partial_part, full_part))?;
        let pictures = [
            ("full-AR", &full.rollouts),
            ("partial-AR", &partial.rollouts),
        ];
        run.phase("write", |run| {
            let picture = beside(
                &pictures.map(|(name, rollouts)| futures::picture(&scenario, rollouts, name)),
            );
            picture.save_png(&run.path("picture.png"))?;
            let firsts: Vec<(&str, &Rollout)> = pictures
                .iter()
                .filter_map(|(name, rollouts)| Some((*name, rollouts.first()?)))
                .collect();
            films::film(&scenario, &firsts)?.save(&run.path("film.gif"))?;
            Ok(())
        })
    }

    fn imagine(
        &self,
        run: &mut Run,
        scenario: &Scenario,
        world: &WorldName,
        decoding: &Decoding,
        mode: &str,
    ) -> anyhow::Result<Imagined> {
        let world = World::build(run.device(), world, scenario, &decoding.sampling)?;
        run.phase(&format!("{mode}, {}", decoding.name), |run| {
            let (n, seed) = (self.futures.get(), run.seed());
            let config = decoding.frames(self.seconds);
            imagine(run, &world, scenario, n, &config, seed)
        })
    }
}

type Rate = fn(&Part) -> Option<f64>;

/// Rates to compare.
const RATES: [(&str, Rate); 6] = [
    ("collision_rate", Part::collision_rate),
    ("offroad_rate", Part::offroad_rate),
    ("ade", Part::ade),
    ("min_ade", Part::min_ade),
    ("fde", Part::fde),
    ("min_fde", Part::min_fde),
];

fn row(mode: &str, decoding: &str, imagined: &Imagined, part: &Part) -> Value {
    let mut row = Map::new();
    row.insert("mode".into(), json!(mode));
    row.insert("decoding".into(), json!(decoding));
    row.insert(
        "frames_per_second".into(),
        json!(imagined.frames_per_second()),
    );
    row.insert("passes_per_frame".into(), json!(imagined.passes_per_frame));
    for (name, rate) in RATES {
        row.insert(name.into(), json!(rate(part)));
    }
    Value::Object(row)
}

/// Partial-AR less full-AR.
fn difference(partial: &Part, full: &Part) -> Value {
    let of = |rate: Rate| Some(rate(partial)? - rate(full)?);
    let differences = RATES.map(|(name, rate)| (name.to_owned(), json!(of(rate))));
    Value::Object(differences.into_iter().collect())
}

/// Two pictures of one size, side by side.
fn beside(pictures: &[Picture; 2]) -> Picture {
    let [left, right] = pictures;
    let row = |picture: &Picture, row: usize| {
        let bytes = picture.width * 4;
        picture.rgba[row * bytes..][..bytes].to_vec()
    };
    let rows = (0..left.height.min(right.height)).flat_map(|y| [row(left, y), row(right, y)]);
    Picture {
        width: left.width + right.width,
        height: left.height.min(right.height),
        rgba: rows.flatten().collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_stand_side_by_side() {
        let picture = |value: u8| Picture {
            width: 2,
            height: 3,
            rgba: vec![value; 24],
        };
        let both = beside(&[picture(1), picture(2)]);
        assert_eq!((both.width, both.height), (4, 3));
        let row: Vec<u8> = [vec![1; 8], vec![2; 8]].concat();
        assert_eq!(both.rgba, row.repeat(3));
    }
}
