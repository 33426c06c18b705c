//! `generate`: scenes out of nothing, on the map of any scenario.

use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use gump_data::find_map;
use gump_engine::placement::object_spec::ObjectSpec;
use gump_engine::{LightSource, SamplingConfig, TransformerWorld};
use gump_eval::Notes;
use gump_eval::worlds::{self, World, WorldName};
use gump_generate::check::{off_road, overlaps};
use gump_generate::constraint::parse_constraints;
use gump_generate::pipeline::{CheckedScene, GenerationJob, GenerationWorlds, make_many};
use gump_generate::{Counts, GenerateConfig, GenerateError, GenerateRequest, Placement};
use gump_model::{Device, checkpoint, relative};
use gump_scene::{AgentKind, Scenario, ScenarioTag};
use gump_viz::{Camera, PictureSpec, Viewer, draw_scene, log_as_rollout};
use serde::Serialize;
use serde_json::{Value, json};

use crate::choices::{LIGHTS, PLACEMENTS, one_of};
use crate::cli::WrongArguments;
use crate::films::FilmArgs;
use crate::run::{Common, Run, stop_if_interrupted};
use crate::{notes, shipped};

/// Scenes made together, by all threads, before progress is shown and an interrupt looked for.
/// Chosen by hand.
const BATCH: u64 = 32;

/// Maximum number of prompts of a scene: as many as a sequence of the tokenizer holds.
const MOST_PROMPTS: usize = 4;

/// Slower is standing, metres per second, as in `data stats`: for the report alone.
const STANDS: f64 = 0.5;

/// Arguments of `generate`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// The scenario whose map and lights are taken, or a map without agents (a SUMO network too):
    /// PATH, PATH#INDEX or PATH#SCENARIO_ID
    #[arg(long, value_name = "S")]
    map: String,
    /// Kind of situation: one of nuPlan's 73 scenario tags, may be given up to four times; the
    /// guide lists them (docs/guide/src/scenario-tags.md)
    #[arg(long, value_name = "TAG")]
    prompt: Vec<String>,
    /// Vehicles besides the ego; with no number given the model decides
    #[arg(long, value_name = "N")]
    vehicles: Option<usize>,
    /// Bicycles
    #[arg(long, value_name = "N")]
    bicycles: Option<usize>,
    /// Pedestrians
    #[arg(long, value_name = "N")]
    pedestrians: Option<usize>,
    /// Constraints on single objects
    #[arg(long, value_name = "FILE.toml")]
    fix: Option<PathBuf>,
    /// Number of scenes
    #[arg(long, value_name = "N", default_value = "1")]
    count: NonZeroUsize,
    /// Simulated seconds of every scene's future
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    simulate: f64,
    /// Spawn and remove agents at the scene's boundary, as many as at the start
    #[arg(long = "spawn", alias = "life")]
    life: bool,
    /// Traffic model of the simulated future
    #[arg(long, value_name = "WORLD", default_value_t = shipped::world())]
    world: WorldName,
    /// Traffic lights after the present
    #[arg(long, value_parser = one_of(LIGHTS), default_value_t = LightSource::Model)]
    lights: LightSource,
    /// Start of the ego
    #[arg(long, value_enum, default_value_t = StartName::Recorded)]
    start: StartName,
    /// Placement of objects
    #[arg(long, value_parser = one_of(PLACEMENTS), default_value_t = Placement::Guided)]
    placement: Placement,
    /// Draw the places of vehicles from the sequence network: evenly along lanes, without queues
    #[arg(long)]
    no_placement_network: bool,
    /// Park vehicles beyond the edges of the road as well
    #[arg(long, conflicts_with = "no_placement_network")]
    parks_off_road: bool,
    /// Weights of the model [default: the shipped ones]
    #[arg(long, value_name = "FILE", value_parser = worlds::weights)]
    weights: Option<PathBuf>,
    /// Divides the logits; above 1 is more diverse [default: 1, with --paper 1.25]
    #[arg(long, value_name = "X")]
    temperature: Option<f64>,
    /// Top-k sampling: bins per field that may be sampled [default: all, with --paper 400]
    #[arg(long, value_name = "N")]
    top_k: Option<NonZeroUsize>,
    /// Sample as the paper does: every field from the network's unmodified distribution, every
    /// object independently
    #[arg(long)]
    paper: bool,
    /// Attempts before a scene that misses the prompt is written
    #[arg(long, value_name = "N", default_value = "20")]
    attempts: NonZeroUsize,
    #[command(flatten)]
    #[serde(flatten)]
    film: FilmArgs,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum StartName {
    /// Position of the recorded ego
    Recorded,
    /// Any lane around it
    Anywhere,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let prompts = tags(&self.prompt)?;
        self.check_numbers()?;
        self.film.check()?;
        let objects = self.objects()?;
        let recorded = run.phase("read", |_| Ok(find_map(&self.map)?))?;
        let world = run.phase("load", |run| {
            world(run.device(), self.weights.as_ref(), self.life)
        })?;
        let traffic = run.phase("load", |run| {
            let sampling = SamplingConfig {
                spawn: self.life,
                lights: self.lights,
                ..SamplingConfig::default()
            };
            Ok(World::without_log(run.device(), &self.world, &sampling)?)
        })?;
        let worlds = GenerationWorlds {
            scenes: &world,
            traffic: traffic.model(),
        };
        let order = GenerationJob {
            request: GenerateRequest {
                prompts,
                counts: self.counts(),
                objects,
                config: self.config(),
                ..GenerateRequest::in_place_of(&recorded)
            },
            roams: self.start == StartName::Anywhere,
            seconds: self.simulate,
            attempts: self.attempts.get(),
        };
        let (checked, elapsed) = run.phase("generate", |run| self.make(run, worlds, &order))?;
        run.phase("write", |run| write(run, &checked, &self.film))?;
        report(run, &checked, elapsed)?;
        let mut noted = Notes::default();
        let simulated = checked.iter().map(|checked| &checked.scenario);
        for scenario in simulated.filter(|scenario| !scenario.future().is_empty()) {
            noted.merge(&traffic.notes(scenario));
        }
        notes::report(run, &noted, checked.len())
    }

    fn check_numbers(&self) -> anyhow::Result<()> {
        let absurd = |t: &f64| !(*t > 0.0 && t.is_finite());
        let wrong = if let Some(t) = self.temperature.filter(absurd) {
            format!("--temperature: expected a number above 0, found {t}")
        } else if !(0.0..=3600.0).contains(&self.simulate) {
            format!(
                "--simulate: expected a number from 0 to 3600, found {}",
                self.simulate
            )
        } else if self.parks_off_road && (self.placement != Placement::Guided || self.paper) {
            let found = match self.paper {
                true => "--paper".into(),
                false => format!("--placement {}", self.placement),
            };
            format!("--parks-off-road: expected guided placement, found {found}")
        } else {
            return Ok(());
        };
        Err(WrongArguments(wrong).into())
    }

    fn objects(&self) -> anyhow::Result<Vec<ObjectSpec>> {
        let Some(path) = &self.fix else {
            return Ok(Vec::new());
        };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        parse_constraints(&text).map_err(|error| self.wrong_request(error))
    }

    fn counts(&self) -> Option<Counts> {
        let given = [self.vehicles, self.pedestrians, self.bicycles];
        given.iter().any(Option::is_some).then(|| Counts {
            vehicles: self.vehicles.unwrap_or(0),
            pedestrians: self.pedestrians.unwrap_or(0),
            bicycles: self.bicycles.unwrap_or(0),
        })
    }

    fn config(&self) -> GenerateConfig {
        let manner = match self.paper {
            true => GenerateConfig::paper(),
            false => GenerateConfig::default(),
        };
        GenerateConfig {
            temperature: self.temperature.unwrap_or(manner.temperature),
            top_k: self.top_k.map_or(manner.top_k, NonZeroUsize::get),
            placement: self.placement,
            placement_network: manner.placement_network && !self.no_placement_network,
            parks_off_road: self.parks_off_road,
            ..manner
        }
    }

    /// All scenes, or the first failure; also the wall time of making them.
    fn make(
        &self,
        run: &Run,
        worlds: GenerationWorlds<'_>,
        order: &GenerationJob,
    ) -> anyhow::Result<(Vec<CheckedScene>, Duration)> {
        let n = self.count.get() as u64;
        let progress = run.progress("generating", n, "scenes");
        let began = Instant::now();
        let mut all = Vec::new();
        // With a prompt every scene is made on its own, and Ctrl-C need not wait for many.
        let batch = match order.request.prompts.is_empty() && !order.roams {
            true => BATCH,
            false => rayon::current_num_threads() as u64,
        };
        for first in (0..n).step_by(batch as usize) {
            stop_if_interrupted()?;
            let numbers = first..(first + batch).min(n);
            let wrong = |error| self.wrong_request(error);
            for checked in make_many(worlds, order, numbers, run.seed()).map_err(wrong)? {
                all.push(checked.map_err(wrong)?);
                progress.advance(1);
            }
        }
        Ok((all, began.elapsed()))
    }

    /// Turns a request that no scene can meet into [`WrongArguments`]: contradictory constraints, or
    /// more objects than a scene can hold.
    fn wrong_request(&self, error: GenerateError) -> anyhow::Error {
        let wrong = match error {
            GenerateError::TooMany { requested, max } => format!(
                "--vehicles, --bicycles, --pedestrians: expected at most {max} objects with the ego \
                 and what stands on the map, found {requested}"
            ),
            GenerateError::Constraints(why) => match &self.fix {
                Some(path) => format!("--fix {}: {why}", path.display()),
                None => format!("constraints: {why}"),
            },
            other => return other.into(),
        };
        WrongArguments(wrong).into()
    }
}

/// The tags with these names.
///
/// Error: [`WrongArguments`] with the nearest name there is, or for more than four.
pub(crate) fn tags(names: &[String]) -> anyhow::Result<Vec<ScenarioTag>> {
    if names.len() > MOST_PROMPTS {
        let n = names.len();
        let wrong = format!("--prompt: expected at most {MOST_PROMPTS}, found {n}");
        return Err(WrongArguments(wrong).into());
    }
    let tag = |name: &String| {
        name.parse::<ScenarioTag>().map_err(|why| {
            // A word in common says more than letters in common.
            let shared = |tag: &ScenarioTag| {
                let words: Vec<&str> = tag.name().split('_').collect();
                let parts = name.split(['_', ' ', '-']);
                parts.filter(|word| words.contains(word)).count() as f64
            };
            let nearness =
                |tag: &ScenarioTag| strsim::jaro_winkler(tag.name(), name) + 0.5 * shared(tag);
            let nearest = ScenarioTag::all()
                .max_by(|a, b| nearness(a).total_cmp(&nearness(b)))
                .expect("there are tags");
            WrongArguments(format!("--prompt: {why}; did you mean \"{nearest}\"?")).into()
        })
    };
    names.iter().map(tag).collect()
}

/// The world that generates.
///
/// Error: weights that cannot be read.
pub(crate) fn world(
    device: &Device,
    weights: Option<&PathBuf>,
    spawn: bool,
) -> anyhow::Result<TransformerWorld> {
    let path = match weights {
        Some(path) => path.clone(),
        None => {
            shipped::check_weights()?;
            shipped::weights()
        }
    };
    if relative::is_relative(&path)? {
        let wrong = format!(
            "--weights: expected weights of the sequence network, which places agents, such as {}; \
             found those of the relative network: {}",
            shipped::weights().display(),
            path.display()
        );
        return Err(WrongArguments(wrong).into());
    }
    let network = checkpoint::load(&path, device)?;
    let sampling = SamplingConfig {
        spawn,
        ..SamplingConfig::default()
    };
    Ok(TransformerWorld::new(network, sampling))
}

/// All scenes as Waymo records, the first as JSON, as a picture, and as a film if it moves.
fn write(run: &Run, checked: &[CheckedScene], film: &FilmArgs) -> anyhow::Result<()> {
    let scenarios: Vec<&Scenario> = checked.iter().map(|checked| &checked.scenario).collect();
    gump_data::womd::write_scenarios(&run.path("scenes.tfrecord"), scenarios.iter().copied())?;
    let Some(&first) = scenarios.first() else {
        return Ok(());
    };
    gump_data::scenario_json::write_scenario(&run.path("scenario.json"), first)?;
    let present = first.present();
    let spec = PictureSpec {
        legend: true,
        ..PictureSpec::new(Camera::on_ego(&present, 140.0, 1000, 1000)).with_label(&first.id)
    };
    draw_scene(&present, &spec).save_png(&run.path("picture.png"))?;
    if first.log.len() > 1 {
        let rollout = log_as_rollout(first);
        let alone = Scenario {
            log: first.log[..=first.now].to_vec(),
            ..first.clone()
        };
        film.write(run, &alone, &[("generated", &rollout)])?;
        let mut viewer = Viewer::new(&alone);
        viewer
            .note("a generated scene and its simulated future")
            .future("generated", &rollout);
        viewer.save(&run.path("viewer.html"))?;
    }
    Ok(())
}

fn report(run: &mut Run, checked: &[CheckedScene], elapsed: Duration) -> anyhow::Result<()> {
    let n = checked.len() as f64;
    let agents: usize = checked.iter().map(agents).sum();
    let vehicles: usize = checked
        .iter()
        .map(|checked| count(checked, |kind| kind == AgentKind::Vehicle))
        .sum();
    let sum = |of: fn(&Scenario) -> usize| checked.iter().map(|m| of(&m.scenario)).sum::<usize>();
    let (overlapping, off) = (sum(overlaps), sum(off_road));
    run.result("scenes", checked.len())?;
    run.result("agents", agents)?;
    run.result("agents_per_scene", agents as f64 / n)?;
    run.result("overlaps", overlapping)?;
    run.result("offroad", off)?;
    run.result("overlap_rate", overlapping as f64 / agents.max(1) as f64)?;
    run.result("offroad_rate", off as f64 / vehicles.max(1) as f64)?;
    let holding = checked.iter().filter(|checked| checked.holds()).count();
    run.result("holding", holding as f64 / n)?;
    run.result(
        "attempts",
        checked.iter().map(|m| m.attempts).sum::<usize>(),
    )?;
    let steered = checked.iter().filter(|checked| checked.is_steered).count();
    run.result("steered", steered as f64 / n)?;
    let redraws: usize = checked.iter().map(|checked| checked.scene.redraws).sum();
    run.result("redraws", redraws)?;
    let restarts: usize = checked.iter().map(|checked| checked.scene.restarts).sum();
    run.result("restarts", restarts)?;
    if let Some(share) = standing_at_end(checked) {
        run.result("standing_at_end", share)?;
    }
    run.result("clauses", clauses(checked))?;
    run.result("scenes_per_second", n / elapsed.as_secs_f64().max(1e-9))
}

/// Share of vehicles at standstill in the last frames of the simulated futures; `None` without any.
fn standing_at_end(checked: &[CheckedScene]) -> Option<f64> {
    let imagined = checked
        .iter()
        .filter(|checked| !checked.scenario.future().is_empty());
    let last = imagined.filter_map(|checked| checked.scenario.log.last());
    let speeds: Vec<f64> = last
        .flat_map(|frame| frame.agents())
        .filter(|agent| agent.kind == AgentKind::Vehicle)
        .map(|agent| agent.state.speed())
        .collect();
    let standing = speeds.iter().filter(|speed| **speed < STANDS).count();
    (!speeds.is_empty()).then(|| standing as f64 / speeds.len() as f64)
}

fn agents(checked: &CheckedScene) -> usize {
    count(checked, AgentKind::is_moving)
}

fn count(checked: &CheckedScene, wanted: impl Fn(AgentKind) -> bool) -> usize {
    let present = checked.scenario.present();
    let agents = present.now().agents().iter();
    agents.filter(|agent| wanted(agent.kind)).count()
}

/// Mean over scenes of the share of their simulated time in which clause `i` holds; `None` if one is
/// not simulated or the clause cannot be decided.
fn share_of_time(checked: &[CheckedScene], i: usize) -> Option<f64> {
    let shares = checked.iter().map(|m| m.clauses[i].share_of_time);
    let shares: Vec<f64> = shares.collect::<Option<_>>()?;
    (!shares.is_empty()).then(|| shares.iter().sum::<f64>() / shares.len() as f64)
}

/// Per clause whether it holds; of several scenes, in all of them, with the share in which it does.
fn clauses(checked: &[CheckedScene]) -> Vec<Value> {
    let first = checked.first().map_or(&[][..], |checked| &checked.clauses);
    let row = |(i, clause): (usize, &gump_generate::check::Clause)| {
        let verdicts: Vec<Option<bool>> = checked
            .iter()
            .map(|checked| checked.clauses[i].holds)
            .collect();
        let holding = verdicts
            .iter()
            .filter(|holds| **holds == Some(true))
            .count();
        let failing = verdicts.contains(&Some(false));
        let later: Vec<Option<bool>> = checked
            .iter()
            .map(|m| m.clauses[i].holds_throughout)
            .collect();
        let is_told = later.iter().all(Option::is_some);
        json!({
            "clause": clause.clause,
            "holds": if failing { Some(false) } else { clause.holds },
            "share": holding as f64 / checked.len() as f64,
            "holds_throughout": is_told.then(|| !later.contains(&Some(false))),
            "share_of_time": share_of_time(checked, i),
        })
    };
    first.iter().enumerate().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_tag_gets_its_nearest() {
        let names = ["behind_bike".to_owned(), "behnd_bike".to_owned()];
        assert_eq!(tags(&names[..1]).unwrap()[0].name(), "behind_bike");
        let error = tags(&names).unwrap_err().to_string();
        assert!(error.contains("did you mean \"behind_bike\"?"), "{error}");
    }
}
