//! What comes of it: futures in every world, their metrics, and a plan.

use gump_metrics::summarize;
use gump_planner::{Interactive, InteractiveConfig, Plan, Planner as _};
use gump_scene::{Rollout, SceneState};
use gump_viz::{Camera, CandidatePath, FilmSpec, overlay_film};
use serde_json::{Value, json};

use super::Demo;
use crate::decoding::Decoding;
use crate::futures;
use crate::imagine::imagine;
use crate::run::Run;
use crate::shipped;
use crate::table::decimal;
use crate::verbs::explain::named;
use crate::worlds::{World, WorldName};

/// Futures per world.
const FUTURES: usize = 32;
/// How far, seconds.
pub(super) const SECONDS: f64 = 8.0;
/// Futures per proposal of the planner.
const PLANNED: usize = 2;

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
        rows.push(json!({
            "world": name,
            "futures": n_futures,
            "frames_per_second": imagined.frames_per_second(),
            "collision_rate": total.collision_rate(),
            "offroad_rate": total.offroad_rate(),
            "ade": total.ade(),
            "min_ade": total.min_ade(),
        }));
        let number = |value: Option<f64>| value.map_or("-".to_owned(), decimal);
        table.push(vec![
            name.to_owned(),
            n_futures.to_string(),
            decimal(imagined.frames_per_second()),
            number(total.collision_rate()),
            number(total.offroad_rate()),
            number(total.ade()),
            number(total.min_ade()),
        ]);
        if name == "learned" {
            learned = imagined.rollouts;
        }
    }
    show(demo, run, &learned)?;
    demo.futures = learned;
    demo.page
        .section("How good they are")
        .prose(
            "Collisions and off-road driving as shares of agents; displacement from what was recorded, \
             in metres, of the average and of the best future. The log is the recording; \
             raw is the network alone, without the rules that hold its draws back.",
        )
        .table(
            &[
                "world",
                "futures",
                "frames/s",
                "collisions",
                "off-road",
                "ADE",
                "min ADE",
            ],
            &table,
        );
    Ok(json!({ "rows": rows }))
}

fn show(demo: &mut Demo, run: &Run, rollouts: &[Rollout]) -> anyhow::Result<()> {
    let scenario = &demo.scenario;
    futures::save_array(run.out(), scenario, rollouts)?;
    let label = format!("{} futures", rollouts.len());
    let picture = futures::picture(scenario, rollouts, &label);
    picture.save_png(&run.path("picture.png"))?;
    let film = futures::film(scenario, &futures::first_few(rollouts))?;
    film.save(&run.path("film.gif"))?;
    let spec = FilmSpec::new(Camera::on_ego(&scenario.present(), 90.0, 640, 640));
    let all: Vec<_> = rollouts.iter().collect();
    let overlay = overlay_film(&all, &spec)?;
    overlay.save(&run.path("overlay.gif"))?;
    demo.page
        .section("Futures")
        .prose("From the present on, the shipped network drives everyone, the ego too.")
        .link("viewer.html", "Play them all in the viewer")
        .film(
            &film,
            "What was recorded, and three of the simulated futures.",
        )
        .film(
            &overlay,
            "All futures over one another: what they agree on is solid.",
        )
        .picture(&picture, "Where everyone goes in all of them.")?;
    Ok(())
}

pub(super) fn plan(demo: &mut Demo, run: &mut Run) -> anyhow::Result<Value> {
    let world = World::without_log(run.device(), &shipped::world(), &demo.sampling)?;
    let config = InteractiveConfig {
        n_futures: PLANNED,
        seed: run.seed(),
        ..InteractiveConfig::default()
    };
    let plan = Interactive::new(world.model(), config)?.plan(&demo.scenario.present())?;
    demo.candidates = candidates(&plan, &demo.scenario.present());
    let table: Vec<_> = ranked(&plan)
        .into_iter()
        .map(|(i, mean)| {
            let chosen = if i == plan.chosen { "chosen" } else { "" };
            let name = plan.candidates[i].proposal.kind.to_string();
            vec![name, mean.map_or("-".into(), decimal), chosen.to_owned()]
        })
        .collect();
    demo.page
        .section("A plan")
        .prose(&format!(
            "What should the ego do? Each proposal was driven in {PLANNED} imagined futures, in \
             which the others react, and scored."
        ))
        .table(&["proposal", "mean score", ""], &table);
    let choice = plan.choice();
    Ok(json!({
        "candidates": plan.candidates.len(),
        "chosen": choice.proposal.kind.to_string(),
        "score": choice.score.as_ref().map(|score| score.mean),
    }))
}

/// Candidates with their mean scores, best first.
fn ranked(plan: &Plan) -> Vec<(usize, Option<f64>)> {
    let score = |i: usize| plan.candidates[i].score.as_ref().map(|score| score.mean);
    let mut order: Vec<_> = (0..plan.candidates.len()).map(|i| (i, score(i))).collect();
    let key = |score: Option<f64>| score.unwrap_or(f64::NEG_INFINITY);
    order.sort_by(|a, b| key(b.1).total_cmp(&key(a.1)));
    order
}

/// The candidates as lines from where the ego is.
fn candidates(plan: &Plan, scene: &SceneState<'_>) -> Vec<CandidatePath> {
    let start = scene.ego_now().state.pose.position;
    let candidates = plan.candidates.iter().enumerate();
    candidates
        .map(|(i, candidate)| {
            let states = &candidate.proposal.states;
            CandidatePath {
                name: candidate.proposal.kind.to_string(),
                score: candidate.score.as_ref().map(|score| score.mean),
                parts: candidate
                    .score
                    .as_ref()
                    .map_or_else(Vec::new, |score| named(&score.parts())),
                is_chosen: i == plan.chosen,
                path: std::iter::once(start)
                    .chain(states.iter().map(|state| state.pose.position))
                    .collect(),
            }
        })
        .collect()
}
