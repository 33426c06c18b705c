//! Futures in every world, their metrics, and a plan.

use anyhow::Context as _;
use gump_eval::decoding::Decoding;
use gump_eval::recordings;
use gump_eval::worlds::{World, WorldName};
use gump_metrics::summarize;
use gump_planner::closed_loop::plan_once;
use gump_planner::{Explain as _, InteractiveDriver, InteractiveDriverConfig, ProposalKind};
use gump_scene::{Rollout, Scenario};
use gump_viz::{Camera, CandidatePath, FilmSpec, PictureSpec, draw_candidates, overlay_film};
use gump_wosac::realism::{Config, Log, Rollouts, Year, score};
use serde_json::{Value, json};

use super::Demo;
use crate::imagine::imagine;
use crate::run::Run;
use crate::table::decimal;
use crate::verbs::explain;
use crate::{films, futures, shipped};

/// Futures per world: as many as the challenge asks for.
const FUTURES: usize = 32;
/// Length of the futures, seconds: the horizon of the challenge.
pub(super) const SECONDS: f64 = 8.0;
/// Futures per proposal of the planner: half of the paper's, so that the demo stays short.
const PLANNED: usize = 2;
/// Candidates of the planner on the page; the viewer has all. Chosen by eye.
const LISTED: usize = 5;

pub(super) fn worlds(demo: &mut Demo, run: &mut Run) -> anyhow::Result<Value> {
    let scenario = &demo.scenario;
    let ruled = Decoding::of(demo.sampling.clone());
    let raw = ruled.without_rules();
    let worlds = [
        ("learned", shipped::world(), FUTURES, &ruled),
        ("learned (raw)", shipped::world(), FUTURES, &raw),
        ("idm", WorldName::Idm, FUTURES, &ruled),
        (
            "constant-velocity",
            WorldName::ConstantVelocity,
            FUTURES,
            &ruled,
        ),
        ("log", WorldName::Log, 1, &ruled),
    ];
    let (mut rows, mut table, mut learned) = (Vec::new(), Vec::new(), Vec::new());
    for (name, world, n_futures, decoding) in worlds {
        if world == WorldName::Log && scenario.future().is_empty() {
            continue;
        }
        let world = World::build(run.device(), &world, scenario, &decoding.sampling)?;
        let config = decoding.frames(SECONDS);
        let imagined = imagine(run, &world, scenario, n_futures, &config, run.seed())?;
        let total = summarize(&imagined.rollouts, Some(scenario)).total();
        let realism = realism(scenario, &imagined.rollouts);
        rows.push(json!({
            "world": name,
            "futures": n_futures,
            "frames_per_second": imagined.frames_per_second(),
            "realism": realism,
            "collision_rate": total.collision_rate(),
            "offroad_rate": total.offroad_rate(),
            "ade": total.ade(),
            "min_ade": total.min_ade(),
        }));
        let number = |value: Option<f64>| value.map_or("-".to_owned(), decimal);
        table.push(vec![
            name.to_owned(),
            n_futures.to_string(),
            number(realism),
            number(total.collision_rate()),
            number(total.offroad_rate()),
            number(total.ade()),
            number(total.min_ade()),
            decimal(imagined.frames_per_second()),
        ]);
        if name == "learned" {
            learned = imagined.rollouts;
        }
    }
    show(demo, run, &learned)?;
    demo.futures = learned;
    demo.page
        .section("Metrics of the futures")
        .prose(
            "One scene says little; the benchmarks in the README use hundreds. The scene is \
             synthetic, and rules close to those of idm drove its recording, which helps idm here.",
        )
        .table(
            &[
                "world",
                "futures",
                "realism",
                "collisions",
                "off-road",
                "ADE",
                "min ADE",
                "frames/s",
            ],
            &table,
        )
        .key_values(&columns());
    Ok(json!({ "rows": rows }))
}

/// Explanations of the worlds and of the columns of the table.
fn columns() -> Vec<(String, String)> {
    let texts = [
        (
            "learned",
            "the shipped network, with rejection of collisions and off-road samples, and kinematic \
             limits",
        ),
        ("learned (raw)", "the same network alone"),
        (
            "idm",
            "every agent follows its lane and its leader, and yields",
        ),
        ("constant-velocity", "every agent keeps its velocity"),
        (
            "log",
            "the recording itself: what a perfect world would score",
        ),
        (
            "realism",
            "how likely the recording is under the futures, 0 to 1: the meta metric of the Waymo \
             Sim Agents Challenge of 2025",
        ),
        ("collisions, off-road", "shares of agents, over all futures"),
        (
            "ADE, min ADE",
            "metres from what was recorded, of the average future and of the best one",
        ),
        (
            "frames/s",
            "simulated frames of 0.1 s per second of this machine, all futures together",
        ),
    ];
    texts
        .map(|(name, what)| (name.to_owned(), what.to_owned()))
        .into()
}

/// The meta metric of the Waymo Sim Agents Challenge of 2025; `None` where it is not defined.
///
/// The metric requires the same number of futures everywhere, so fewer futures are repeated.
fn realism(scenario: &Scenario, futures: &[Rollout]) -> Option<f64> {
    let config = Config::of(Year::Y2025);
    let log = Log::of(scenario).ok()?;
    let rollouts = Rollouts::of(&scenario.id, futures, config.mode).ok()?;
    let rollouts = rollouts.repeated(FUTURES / futures.len().max(1));
    let scores = score(&log, &rollouts, &config).ok()?;
    Some(scores.metametric).filter(|realism| realism.is_finite())
}

fn show(demo: &mut Demo, run: &Run, rollouts: &[Rollout]) -> anyhow::Result<()> {
    let scenario = &demo.scenario;
    futures::save_array(run.out(), scenario, rollouts)?;
    let label = format!("{} futures", rollouts.len());
    let picture = futures::picture(scenario, rollouts, &label);
    picture.save_png(&run.path("picture.png"))?;
    let film = films::film(scenario, &films::first_few(rollouts))?;
    film.save(&run.path("film.gif"))?;
    let all: Vec<_> = rollouts.iter().collect();
    let overlay = overlay_film(&all, &FilmSpec::of_rollouts(&all, (640, 640)))?;
    overlay.save(&run.path("overlay.gif"))?;
    demo.page
        .section("Futures")
        .prose(
            "From the present on, the shipped network drives all agents, the ego too. Beside the \
             recording, three of its futures:",
        )
        .film(
            &film,
            "Top left the recording, then three simulated futures.",
        )
        .link("viewer.html", "Play all of them in the viewer")
        .link("overlay.gif", "Overlay all futures");
    Ok(())
}

pub(super) fn plan(demo: &mut Demo, run: &mut Run) -> anyhow::Result<Value> {
    if demo.scenario.route.is_none() {
        demo.page
            .section("A plan")
            .prose("There is none: the planner follows a route, and this scenario has no route.");
        return Ok(json!({ "candidates": 0, "chosen": null, "score": null }));
    }
    let world = World::without_log(run.device(), &shipped::world(), &demo.sampling)?;
    let config = InteractiveDriverConfig {
        n_futures: PLANNED,
        seed: run.seed(),
        ..InteractiveDriverConfig::default()
    };
    let case = recordings::of_boxes(demo.scenario.clone())?;
    let mut planner = InteractiveDriver::new(world.model(), config)?;
    plan_once(&case.recording, &mut planner).map_err(anyhow::Error::from_boxed)?;
    let decision = planner
        .decision()
        .context("the planner planned and so decided")?;
    let order = explain::ranked(decision);
    let paths = order.iter();
    demo.candidates = paths
        .map(|&i| explain::path(case.recording.vehicle(), decision, i))
        .collect();
    let row = |candidate: &CandidatePath| {
        let score = candidate.score.map_or("-".into(), decimal);
        vec![candidate.name.clone(), score]
    };
    let table: Vec<_> = demo.candidates.iter().take(LISTED).map(row).collect();
    let scene = demo.scenario.present();
    let points = demo.candidates.iter().flat_map(|c| c.path.iter().copied());
    let heading = scene.ego_now().state.pose.heading;
    let spec = PictureSpec {
        legend: true,
        ..PictureSpec::new(Camera::framing(points, heading, 80.0, (960, 640)))
    };
    let picture = draw_candidates(&scene, &demo.candidates, &spec);
    picture.save_png(&run.path("plan.png"))?;
    demo.page
        .section("A plan")
        .prose(&format!(
            "What should the ego do? {} candidates were driven in up to {PLANNED} futures of the \
             learned world, in which the others react, and scored as nuPlan scores a drive. The best \
             {} of them, the chosen one first:",
            decision.candidates.len(),
            table.len(),
        ))
        .table(&["candidate", "mean score"], &table)
        .picture(
            &picture,
            "All candidates, the chosen one in the ego's colour; a dot where each ends after four \
             seconds.",
        )?;
    let choice = &decision.candidates[decision.chosen];
    let (kind, score) = if decision.brakes {
        (ProposalKind::EmergencyBrake, None)
    } else {
        (choice.kind, Some(choice.value))
    };
    Ok(json!({
        "candidates": decision.candidates.len(),
        "chosen": kind.to_string(),
        "score": score,
    }))
}
