//! `demo`: the whole pipeline on shipped data and weights, and a page that shows it.
//!
//! The stages are in [`imagine`] (futures and a plan), [`make`] (a scene from a prompt), [`learn`]
//! (the network and its training) and [`look`] (the scenario); this file runs them in order.

mod imagine;
mod learn;
mod look;
mod make;

use gump_data::find;
use gump_engine::SamplingConfig;
use gump_eval::decoding::Decoding;
use gump_eval::worlds::World;
use gump_scene::{Rollout, Scenario};
use gump_viz::{CandidatePath, Page, Viewer};
use serde::Serialize;
use serde_json::Value;

use crate::imagine::imagine_probed;
use crate::run::{Common, Run};
use crate::{annotations, machine, shipped};

/// Arguments of `demo`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// PATH, PATH#INDEX or PATH#SCENARIO_ID [default: a shipped one]
    #[arg(long, value_name = "S")]
    scenario: Option<String>,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// State shared by the stages.
struct Demo {
    scenario: Scenario,
    sampling: SamplingConfig,
    page: Page,
    /// Futures of the learned world.
    futures: Vec<Rollout>,
    /// Candidates of the planner in the learned world.
    candidates: Vec<CandidatePath>,
}

/// A stage: its name in the report, what it is doing, and the doing.
type Stage = (
    &'static str,
    &'static str,
    fn(&mut Demo, &mut Run) -> anyhow::Result<Value>,
);

/// In the order in which the page shows their results.
const STAGES: [Stage; 10] = [
    ("read", "reading the scenario", look::read),
    (
        "imagine",
        "simulating futures in every world",
        imagine::worlds,
    ),
    ("plan", "planning inside the learned world", imagine::plan),
    ("generate", "generating a scene from a prompt", make::scene),
    (
        "train",
        "training a new network for a few steps",
        learn::train,
    ),
    ("picture", "drawing the scenario", look::picture),
    ("raster", "drawing what the network sees", look::raster),
    ("tokens", "writing it as tokens", look::tokens),
    ("network", "opening the shipped network", learn::network),
    ("page", "writing the page", page),
];

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        shipped::check_weights()?;
        let name = match &self.scenario {
            Some(name) => name.clone(),
            None => shipped::demo(),
        };
        run.setting("scenario", &name)?;
        let mut demo = Demo {
            scenario: find(&name)?,
            sampling: SamplingConfig::default(),
            page: Page::new("gump: one scene, many futures"),
            futures: Vec::new(),
            candidates: Vec::new(),
        };
        demo.page.lede(format!(
            "What a generative world model does with one traffic scene: simulate it, plan in it, make \
             others like it. Everything below was made from {name} by one command, offline, with \
             weights trained on synthetic scenes alone."
        ));
        for (number, (name, doing, stage)) in STAGES.into_iter().enumerate() {
            run.print(&format!("{} of {}: {doing}", number + 1, STAGES.len()));
            let block = run.phase(name, |run| stage(&mut demo, run))?;
            run.result(name, block)?;
        }
        Ok(())
    }
}

fn page(demo: &mut Demo, run: &mut Run) -> anyhow::Result<Value> {
    let path = run.path("index.html");
    view(demo, run)?;
    demo.page.footer(format!(
        "cargo xtask demo, seed {}, commit {}, on {}.",
        run.seed().0,
        machine::commit(),
        machine::Machine::here("cpu").cpu,
    ));
    demo.page.save(&path)?;
    run.print(&format!("open {}", path.display()));
    Ok(serde_json::json!({ "file": path }))
}

/// Writes the viewer of the futures and the plan beside the page.
fn view(demo: &Demo, run: &Run) -> anyhow::Result<()> {
    let mut viewer = Viewer::new(&demo.scenario);
    viewer
        .note(format!(
            "{} futures in the learned world",
            demo.futures.len()
        ))
        .futures(&demo.futures);
    annotations::plausibility(&mut viewer, &demo.scenario, &demo.futures);
    let world = World::build(
        run.device(),
        &shipped::world(),
        &demo.scenario,
        &demo.sampling,
    )?;
    let config = Decoding::of(demo.sampling.clone()).frames(imagine::SECONDS);
    // By itself, so that the frames per second of the table are those of futures alone.
    let probe = annotations::probe(1);
    let probed = imagine_probed(run, &world, &demo.scenario, 1, &config, probe)?;
    annotations::heat(&mut viewer, probed.samples);
    for candidate in &demo.candidates {
        viewer.candidate(candidate.clone());
    }
    Ok(viewer.save(&run.path("viewer.html"))?)
}
