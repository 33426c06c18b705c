//! `data inspect`: what is in a file, as numbers and as a picture.

use std::path::Path;

use anyhow::Context as _;
use gump_data::{ReadOptions, ScenarioRecord, Summary, find, find_record, inspect_with};
use gump_scene::Scenario;
use gump_viz::{Camera, Picture, PictureSpec, draw_futures};
use serde::Serialize;

use crate::run::{Common, Run};

/// Arguments of `data inspect`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// PATH, PATH#INDEX or PATH#SCENARIO_ID; a path without # means everything in it
    #[arg(value_name = "S")]
    scenario: String,
    /// Draw the scenario (the first one of a file) to picture.png
    #[arg(long)]
    picture: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let whole = Path::new(&self.scenario);
        let one = self.scenario.contains('#') && !whole.exists();
        let (summary, shown) = run.phase("inspect", |_| {
            if one {
                let mut record = find_record(&self.scenario)?;
                add_tags(&mut record.scenario);
                Ok((summary_of(&record)?, Some(record.scenario)))
            } else {
                let summary = inspect_with(whole, ReadOptions::ALL, add_tags)?;
                anyhow::Ok((summary, None))
            }
        })?;
        let n_unreadable = summary.unreadable.len();
        let first_problem = summary.unreadable.first().cloned();
        if summary.scenarios == 0
            && let Some(problem) = first_problem
        {
            // Zero counts would only hide the reason.
            run.result_hidden("unreadable", &summary.unreadable)?;
            anyhow::bail!(match n_unreadable {
                1 => format!("the only record cannot be read: {problem}"),
                n => format!("none of {n} records can be read, the first because: {problem}"),
            });
        }
        if let serde_json::Value::Object(fields) = serde_json::to_value(&summary)? {
            for (key, value) in fields {
                run.result(&key, value)?;
            }
        }
        if self.picture {
            run.phase("picture", |run| {
                let scenario = match shown {
                    Some(scenario) => scenario,
                    None => find(&format!("{}#0", self.scenario))?,
                };
                let path = run.path("picture.png");
                picture(&scenario)
                    .save_png(&path)
                    .with_context(|| format!("cannot draw scenario {}", scenario.id))?;
                run.print(&format!("picture: {}", path.display()));
                Ok(())
            })?;
        }
        Ok(())
    }
}

/// The scene now with what is past and what is to come.
pub(crate) fn picture(scenario: &Scenario) -> Picture {
    let scene = scenario.present();
    let camera = Camera::on_ego(&scene, 120.0, 1200, 1200);
    let spec = PictureSpec {
        legend: true,
        ..PictureSpec::new(camera).with_label(scenario.id.as_str())
    };
    draw_futures(&scene, &[scenario.future()], &spec)
}

/// Mines the tags of a scenario whose format states none.
fn add_tags(scenario: &mut Scenario) {
    if scenario.tags.is_empty() {
        scenario.tags = gump_metrics::tags::extract_tags(scenario);
    }
}

fn summary_of(record: &ScenarioRecord) -> anyhow::Result<Summary> {
    let mut summary = Summary {
        format: gump_data::open(&record.path)?.format().into(),
        ..Summary::default()
    };
    summary.add(&record.scenario, &record.report);
    Ok(summary)
}
