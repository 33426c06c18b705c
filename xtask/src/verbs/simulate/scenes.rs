//! `simulate --scenes N`: the first scenes of a file or folder, each simulated as it would be alone,
//! in one viewer with a list of them.

use std::path::Path;

use anyhow::Context as _;
use gump_eval::Notes;
use gump_eval::decoding::Decoding;
use gump_eval::digest;
use gump_eval::worlds::World;
use gump_metrics::{Part, Summary, summarize};
use gump_rollout::SimulateConfig;
use gump_scene::{Rollout, Scenario};
use gump_viz::{Gallery, Viewer};
use serde::Serialize;

use super::{Args, by_class};
use crate::cli::WrongArguments;
use crate::imagine::{Imagined, imagine_probed};
use crate::run::Run;
use crate::{annotations, notes};

/// A scene in the report.
#[derive(Serialize)]
struct Row {
    scenario: String,
    agents: usize,
    collision_rate: Option<f64>,
    offroad_rate: Option<f64>,
    digest: String,
}

/// Totals over all scenes.
#[derive(Default)]
struct Total {
    rows: Vec<Row>,
    summary: Summary,
    steps: usize,
    frames: usize,
    seconds: f64,
    /// Passes per frame, weighted with the frames.
    passes: f64,
    notes: Notes,
}

/// Simulates up to `n` scenes and writes their viewer.
///
/// Error: arguments for a single scene only, or a scene that cannot be read or simulated.
pub(super) fn execute(args: &Args, n: usize, run: &mut Run) -> anyhow::Result<()> {
    check(args)?;
    let decoding = args.sampling.decoding(&args.world)?;
    let config = decoding.frames(args.seconds);
    let records = run.phase("read", |_| Ok(gump_data::open(Path::new(&args.scenario))?))?;
    let (mut gallery, mut total) = (Gallery::default(), Total::default());
    for record in records.take(n) {
        let scenario = record?.scenario;
        let one = |run: &mut Run| add(args, run, &decoding, &config, &scenario, &mut gallery);
        let (imagined, summary, notes) = run.phase("simulate", one)?;
        total.add(&scenario, &imagined, &summary);
        total.notes.merge(&notes);
    }
    anyhow::ensure!(
        !gallery.is_empty(),
        "{}: expected a scenario, found none",
        args.scenario
    );
    run.phase("write", |run| Ok(gallery.save(&run.path("viewer.html"))?))?;
    run.result("decoding", decoding.name)?;
    total.report(args, run)
}

fn check(args: &Args) -> Result<(), WrongArguments> {
    if !args.format.is_empty() {
        let wrong = "--scenes: expected no --format, which writes one scene, found one";
        return Err(WrongArguments(wrong.into()));
    }
    if args.scenario.contains('#') && !Path::new(&args.scenario).exists() {
        return Err(WrongArguments(format!(
            "--scenes: expected --scenario to name a file or folder, found one scene of it, {}",
            args.scenario
        )));
    }
    Ok(())
}

/// Simulates a scene and adds it to the viewer; also returns what the scene lacks.
fn add(
    args: &Args,
    run: &Run,
    decoding: &Decoding,
    config: &SimulateConfig,
    scenario: &Scenario,
    gallery: &mut Gallery,
) -> anyhow::Result<(Imagined, Summary, Notes)> {
    let world = World::build(run.device(), &args.world, scenario, &decoding.sampling)?;
    let n = args.futures.get();
    let mut imagined = imagine_probed(run, &world, scenario, n, config, args.probe())
        .with_context(|| format!("cannot simulate {}", scenario.id))?;
    let summary = summarize(&imagined.rollouts, Some(scenario));
    let mut viewer = Viewer::new(scenario);
    viewer.note(note(args, &summary.total()));
    viewer.futures(&imagined.rollouts);
    annotations::plausibility(&mut viewer, scenario, &imagined.rollouts);
    annotations::heat(&mut viewer, std::mem::take(&mut imagined.samples));
    gallery.add(&viewer);
    Ok((imagined, summary, world.notes(scenario)))
}

/// The note beside a scene in the list, which makes the scenes worth a look stand out.
fn note(args: &Args, total: &Part) -> String {
    let mut note = match args.futures.get() {
        1 => format!("1 simulated future in the world {}", args.world),
        n => format!("{n} simulated futures in the world {}", args.world),
    };
    for (what, rate) in [
        ("collide", total.collision_rate()),
        ("leave the road", total.offroad_rate()),
    ] {
        if let Some(rate) = rate {
            note += &format!(", {:.1} % {what}", 100.0 * rate);
        }
    }
    note
}

impl Total {
    fn add(&mut self, scenario: &Scenario, imagined: &Imagined, summary: &Summary) {
        let part = summary.total();
        self.rows.push(Row {
            scenario: scenario.id.clone(),
            agents: scenario.present().now().agents().len(),
            collision_rate: part.collision_rate(),
            offroad_rate: part.offroad_rate(),
            digest: digest::of_rollouts(&imagined.rollouts),
        });
        self.summary.merge(summary);
        self.steps = self
            .steps
            .max(imagined.rollouts.first().map_or(0, Rollout::steps));
        self.frames += imagined.frames;
        self.seconds += imagined.elapsed.as_secs_f64();
        self.passes += imagined.passes_per_frame * imagined.frames as f64;
    }

    fn report(&self, args: &Args, run: &mut Run) -> anyhow::Result<()> {
        let total = self.summary.total();
        run.result("world", &args.world)?;
        run.result("scenes", self.rows.len())?;
        run.result("futures", args.futures)?;
        run.result("steps", self.steps)?;
        let agents = self.rows.iter().map(|row| row.agents);
        run.result("agents", agents.sum::<usize>())?;
        run.result(
            "frames_per_second",
            self.frames as f64 / self.seconds.max(1e-9),
        )?;
        run.result("passes_per_frame", self.passes / self.frames.max(1) as f64)?;
        run.result("collision_rate", total.collision_rate())?;
        run.result("offroad_rate", total.offroad_rate())?;
        let digests = self.rows.iter().map(|row| row.digest.as_str());
        run.result("digest", digest::of_digests(digests))?;
        run.result("rows", &self.rows)?;
        // A part counts its agents once in each future.
        let by_class = by_class(&Summary {
            futures: args.futures.get(),
            ..self.summary.clone()
        });
        run.result("by_class", by_class)?;
        notes::report(run, &self.notes, self.rows.len())?;
        run.print(
            "ade, fde, min_ade, min_fde: metres from the log, over as much of the futures as it has",
        );
        run.print(&format!("open {}", run.path("viewer.html").display()));
        Ok(())
    }
}
