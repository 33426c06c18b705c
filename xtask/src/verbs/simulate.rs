//! `simulate`: futures of a recorded scene, or of several for the viewer, in any world.

mod scenes;

use std::collections::BTreeSet;
use std::num::NonZeroUsize;

use anyhow::Context as _;
use gump_data::{find, submission};
use gump_eval::digest;
use gump_eval::worlds::{World, WorldName};
use gump_metrics::{Part, Summary, summarize};
use gump_rollout::ProbeConfig;
use gump_scene::{AgentId, Frame, Rollout, Scenario};
use gump_viz::Viewer;
use serde::Serialize;
use serde_json::{Value, json};

use crate::cli::WrongArguments;
use crate::films::{self, FilmArgs};
use crate::imagine::{Imagined, imagine_probed};
use crate::run::{Common, Run};
use crate::sampling::Sampling;
use crate::{annotations, futures, notes, tables};

/// Arguments of `simulate`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// PATH, PATH#INDEX or PATH#SCENARIO_ID
    #[arg(long, value_name = "S")]
    scenario: String,
    /// Simulate the first N scenes of the file or folder, into one viewer with a scene list
    #[arg(long, value_name = "N")]
    scenes: Option<NonZeroUsize>,
    /// log, idm, constant-velocity or model:WEIGHTS
    #[arg(long, value_name = "W")]
    world: WorldName,
    /// Number of futures
    #[arg(long, value_name = "N", default_value = "32")]
    futures: NonZeroUsize,
    /// Simulated seconds
    #[arg(long, value_name = "S", default_value_t = 8.0)]
    seconds: f64,
    /// Also write the futures in these formats
    #[arg(long, value_enum, value_name = "F", value_delimiter = ',')]
    format: Vec<Format>,
    /// Show in the viewer the distributions the model sampled from, for the first N futures; these
    /// draws count in frames per second [default N: 1]
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "1")]
    heat: Option<NonZeroUsize>,
    #[command(flatten)]
    #[serde(flatten)]
    film: FilmArgs,
    #[command(flatten)]
    #[serde(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum Format {
    /// A `ScenarioRollouts` message of the Waymo Sim Agents Challenge, rollouts.binproto
    Waymo,
    /// Tables: futures.parquet, and every metric of every agent in agents.parquet
    Parquet,
    /// The film as an animated PNG, film.png
    Apng,
    /// A recording for the Rerun viewer, scene.rrd; in a build with the feature `rerun`
    Rerun,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        futures::check(self.futures.get(), self.seconds)?;
        if self.heat.is_some() && !matches!(self.world, WorldName::Model(_)) {
            let wrong = format!(
                "--heat: expected --world model:WEIGHTS, found {}",
                self.world
            );
            return Err(WrongArguments(wrong).into());
        }
        if self.format.contains(&Format::Rerun) && !cfg!(feature = "rerun") {
            let wrong = "--format rerun: expected a build with the feature rerun, found one without; \
                         use cargo run -p xtask --features rerun -- simulate";
            return Err(WrongArguments(wrong.into()).into());
        }
        self.film.check()?;
        match self.scenes {
            Some(n) => scenes::execute(self, n.get(), run),
            None => self.execute_one(run),
        }
    }

    /// The predictive samples of `--heat`.
    fn probe(&self) -> ProbeConfig {
        let n = self.heat.map_or(0, NonZeroUsize::get);
        annotations::probe(n.min(self.futures.get()))
    }

    /// One scene, and all that is written of it.
    fn execute_one(&self, run: &mut Run) -> anyhow::Result<()> {
        let decoding = self.sampling.decoding(&self.world)?;
        let config = decoding.frames(self.seconds);
        let scenario = run.phase("read", |_| Ok(find(&self.scenario)?))?;
        let world = run.phase("load", |run| {
            Ok(World::build(
                run.device(),
                &self.world,
                &scenario,
                &decoding.sampling,
            )?)
        })?;
        let mut imagined = run.phase("imagine", |run| {
            let n = self.futures.get();
            imagine_probed(run, &world, &scenario, n, &config, self.probe())
                .with_context(|| format!("cannot simulate {}", self.scenario))
        })?;
        let summary = run.phase("score", |run| {
            let _waiting = run.wait("scoring");
            Ok(summarize(&imagined.rollouts, Some(&scenario)))
        })?;
        let mut viewer = Viewer::new(&scenario);
        run.phase("look closer", |run| {
            let _waiting = run.wait("looking closer");
            annotations::plausibility(&mut viewer, &scenario, &imagined.rollouts);
            annotations::heat(&mut viewer, std::mem::take(&mut imagined.samples));
            Ok(())
        })?;
        run.phase("write", |run| {
            self.write(run, &scenario, &imagined.rollouts, viewer)
        })?;
        run.result("decoding", decoding.name)?;
        self.report(run, &scenario, &imagined, &summary)?;
        notes::report(run, &world.notes(&scenario), 1)?;
        run.print(&compared(&scenario, &imagined.rollouts));
        run.print(&format!("open {}", run.path("viewer.html").display()));
        Ok(())
    }

    fn write<'a>(
        &self,
        run: &Run,
        scenario: &Scenario,
        rollouts: &'a [Rollout],
        mut viewer: Viewer<'a>,
    ) -> anyhow::Result<()> {
        let every = futures::save_array(run.out(), scenario, rollouts)?;
        if every > 1 {
            let dt = scenario.dt * every as f64;
            run.print(&format!(
                "futures.npy has a step every {dt:.1} s: all would take over half a gigabyte"
            ));
        }
        let wanted = |format| self.format.contains(&format);
        if wanted(Format::Waymo) {
            submission::write_rollouts(&run.path("rollouts.binproto"), &scenario.id, rollouts)?;
        }
        if wanted(Format::Parquet) {
            let all = [(scenario.id.as_str(), rollouts)];
            gump_data::write_rollouts(&run.path("futures.parquet"), all)?;
            let world = self.world.to_string();
            tables::of_agents(scenario, &world, rollouts).write(&run.path("agents.parquet"))?;
        }
        let label = format!("{} in the world {}", scenario.id, self.world);
        futures::picture(scenario, rollouts, &label).save_png(&run.path("picture.png"))?;
        let apng = wanted(Format::Apng);
        let shown = films::first_few(rollouts);
        self.film.and(apng).write(run, scenario, &shown)?;
        viewer
            .note(format!(
                "{} simulated future{} in the world {}",
                rollouts.len(),
                if rollouts.len() == 1 { "" } else { "s" },
                self.world
            ))
            .futures(rollouts);
        viewer.save(&run.path("viewer.html"))?;
        #[cfg(feature = "rerun")]
        if wanted(Format::Rerun) {
            viewer.save_rerun(&run.path("scene.rrd"))?;
        }
        Ok(())
    }

    fn report(
        &self,
        run: &mut Run,
        scenario: &Scenario,
        imagined: &Imagined,
        summary: &Summary,
    ) -> anyhow::Result<()> {
        let total = summary.total();
        let rollouts = &imagined.rollouts;
        run.result("scenario", &scenario.id)?;
        run.result("world", &self.world)?;
        run.result("futures", rollouts.len())?;
        run.result("steps", rollouts.first().map_or(0, Rollout::steps))?;
        run.result("agents", scenario.present().now().agents().len())?;
        run.result("frames_per_second", imagined.frames_per_second())?;
        run.result("passes_per_frame", imagined.passes_per_frame)?;
        run.result("collision_rate", total.collision_rate())?;
        run.result("offroad_rate", total.offroad_rate())?;
        run.result("digest", digest::of_rollouts(rollouts))?;
        if self.sampling.draw.has_life() {
            let [arrivals, departures] = comings_and_goings(rollouts);
            run.result("arrivals_per_future", arrivals)?;
            run.result("departures_per_future", departures)?;
        }
        run.result("by_class", by_class(summary))
    }
}

/// What the distances of the table are, and over which part of the futures.
fn compared(scenario: &Scenario, rollouts: &[Rollout]) -> String {
    let steps = rollouts.first().map_or(0, Rollout::steps);
    match scenario.future().len().min(steps) {
        0 => "ade, fde, min_ade, min_fde: none, the log ends with the present".into(),
        n => format!(
            "ade, fde, min_ade, min_fde: metres from the log, over the {:.1} s that it goes on for",
            n as f64 * scenario.dt
        ),
    }
}

/// Agents that arrive and that leave, mean per future.
fn comings_and_goings(rollouts: &[Rollout]) -> [f64; 2] {
    let ids = |frame: &Frame| -> BTreeSet<AgentId> {
        frame.agents().iter().map(|agent| agent.id).collect()
    };
    let (mut arrivals, mut departures) = (0, 0);
    for rollout in rollouts {
        let mut before = ids(rollout.start());
        for frame in rollout.imagined() {
            let now = ids(frame);
            arrivals += now.difference(&before).count();
            departures += before.difference(&now).count();
            before = now;
        }
    }
    [arrivals, departures].map(|n| n as f64 / rollouts.len().max(1) as f64)
}

/// The rows of a summary, all classes together last.
pub(crate) fn by_class(summary: &Summary) -> Vec<Value> {
    let mut rows: Vec<_> = summary
        .by_kind
        .iter()
        .map(|(kind, part)| row(kind.name(), part, summary.futures))
        .collect();
    rows.push(row("all", &summary.total(), summary.futures));
    rows
}

fn row(class: &str, part: &Part, n_futures: usize) -> Value {
    json!({
        "class": class,
        "agents": part.agents / n_futures.max(1),
        "collision_rate": part.collision_rate(),
        "offroad_rate": part.offroad_rate(),
        "ade": part.ade(),
        "min_ade": part.min_ade(),
        "fde": part.fde(),
        "min_fde": part.min_fde(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(text: &str) -> Scenario {
        gump_scene::fixture::scenario(text).unwrap()
    }

    #[test]
    fn agents_that_come_and_go_are_counted() {
        let here = scene("ego vehicle 0: 0,0\nagent vehicle 1: 9,0\nhistory 0 future 0.2 dt 0.1");
        let there = scene("ego vehicle 0: 0,0\nagent vehicle 2: 9,0\nhistory 0 future 0.2 dt 0.1");
        let mut rollout = Rollout::begin(here.present());
        rollout.push(here.present().now().clone());
        let still = rollout.clone();
        rollout.push(there.present().now().clone());
        assert_eq!(comings_and_goings(&[still, rollout]), [0.5, 0.5]);
        assert_eq!(comings_and_goings(&[]), [0.0, 0.0]);
    }

    #[test]
    fn distances_say_what_they_are_of() {
        let scene = scene("ego vehicle 0: 0,0\nhistory 0 future 2 dt 0.1");
        let log = gump_metrics::logged(&scene);
        let said = compared(&scene, &[log]);
        assert!(
            said.contains("metres") && said.contains("over the 2.0 s"),
            "{said}"
        );
        assert!(compared(&scene, &[]).contains("none"));
    }
}
