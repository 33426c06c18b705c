//! The page of one decision: every candidate's film, what it was worth and why, and what the
//! imagined others did.

use anyhow::Context as _;
use gump_geometry::DVec2;
use gump_metrics::overlapping;
use gump_planner::{Decision, Prospect};
use gump_scene::{Agent, Rollout, Scenario, VehicleParameters};
use gump_viz::{Camera, CandidatePath, Film, FilmSpec, Page, Viewer, overlay_film};
use serde_json::{Value, json};

use crate::run::Run;
use crate::table::decimal;

/// Agents told about, those nearest to the ego.
const OTHERS: usize = 8;

/// Writes `explain.html` and `viewer.html` for a decision made in the present of `scenario`, which
/// need not have a future.
///
/// Error: files that cannot be written.
pub(crate) fn write(
    run: &Run,
    scenario: &Scenario,
    vehicle: &VehicleParameters,
    decision: &Decision,
) -> anyhow::Result<()> {
    let mut page = Page::new(format!("Why the ego does that: {}", scenario.id));
    let chosen = &decision.prospects[decision.chosen];
    let n_futures = chosen.futures.len();
    page.section("The decision").prose(&format!(
        "{} candidates drove {:.1} s among others who react, the best {} of them in {n_futures} \
         futures, the others in fewer. {}",
        decision.prospects.len(),
        decision.horizon,
        decision.prospects.iter().filter(|p| p.finalist).count(),
        if decision.brakes {
            "Even the best of them hits something soon: the ego brakes.".to_owned()
        } else {
            format!("The ego drives \"{}\".", chosen.kind)
        }
    ));
    let order = ranked(decision);
    scores(&mut page, decision, &order);
    others(&mut page, decision, &order, scenario);
    let section = page.section("Films").prose(
        "Every candidate in all of its futures over one another; the chosen one first. The same can \
         be played and clicked into in viewer.html.",
    );
    for &i in &order {
        let prospect = &decision.prospects[i];
        section.film(&film(scenario, prospect)?, &caption(i, decision));
    }
    page.save(&run.path("explain.html"))?;
    viewer(scenario, vehicle, decision, &order)
        .save(&run.path("viewer.html"))
        .context("the viewer cannot be written")
}

/// The chosen one, then the others, best first.
pub(crate) fn ranked(decision: &Decision) -> Vec<usize> {
    let mut order: Vec<usize> = (0..decision.prospects.len()).collect();
    order.sort_by(|&a, &b| {
        let value = |i: usize| decision.prospects[i].value;
        // Values of fewer futures do not compare.
        let rank = |i: usize| (i == decision.chosen, decision.prospects[i].futures.len());
        rank(b).cmp(&rank(a)).then(value(b).total_cmp(&value(a)))
    });
    order
}

fn caption(i: usize, decision: &Decision) -> String {
    let prospect = &decision.prospects[i];
    let chosen = if i == decision.chosen { ", chosen" } else { "" };
    format!("{}: {}{chosen}", prospect.kind, decimal(prospect.value))
}

/// What every candidate is worth, part by part.
fn scores(page: &mut Page, decision: &Decision, order: &[usize]) {
    let parts = decision.prospects[0].score.parts();
    let mut columns = vec!["candidate", "value", "standard error"];
    columns.extend(parts.iter().map(|(name, _)| *name));
    columns.extend(["futures with a collision", "metres"]);
    let rows: Vec<Vec<String>> = order
        .iter()
        .map(|&i| {
            let prospect = &decision.prospects[i];
            let error = prospect.score.standard_error;
            let mut row = vec![
                prospect.kind.to_string(),
                decimal(prospect.value),
                error.map_or("-".into(), decimal),
            ];
            let parts = prospect.score.parts();
            row.extend(parts.iter().map(|(_, value)| decimal(*value)));
            row.push(prospect.collisions.to_string());
            row.push(decimal(prospect.progress_m));
            row
        })
        .collect();
    page.section("What each is worth")
        .prose(
            "Gates (collision, road, direction) multiply; progress, time to collision, \
             the speed limit and comfort add with weights of 5, 5, 4 and 2. All are means over the \
             futures that a candidate was imagined in.",
        )
        .table(&columns, &rows);
}

/// What those nearest to the ego do, with the chosen candidate and with the worst of the others.
fn others(page: &mut Page, decision: &Decision, order: &[usize], scenario: &Scenario) {
    let (first, last) = (order[0], order[order.len() - 1]);
    let shown = [&decision.prospects[first], &decision.prospects[last]];
    let scene = scenario.present();
    let ego = scene.ego_now().state.pose.position;
    let start = shown[0].futures[0].at(0);
    let mut near: Vec<&Agent> = start.now().agents().iter().collect();
    near.retain(|agent| agent.id != scene.ego);
    near.sort_by(|a, b| {
        let away = |agent: &Agent| agent.state.pose.position.distance(ego);
        away(a).total_cmp(&away(b)).then(a.id.cmp(&b.id))
    });
    let rows: Vec<Vec<String>> = near
        .iter()
        .take(OTHERS)
        .map(|agent| {
            let mut row = vec![
                format!("{} {}", agent.kind.name(), agent.id),
                decimal(agent.state.pose.position.distance(ego)),
                decimal(agent.state.speed()),
            ];
            for prospect in shown {
                let told = prospect.futures.iter().filter_map(|f| deed(f, agent));
                let told: Vec<Deed> = told.collect();
                let n = told.len().max(1) as f64;
                let mean = |part: fn(&Deed) -> f64| told.iter().map(part).sum::<f64>() / n;
                row.push(decimal(mean(|deed| deed.metres)));
                row.push(decimal(mean(|deed| deed.closest)));
                let hits = told.iter().filter(|deed| deed.hit).count();
                row.push(hits.to_string());
            }
            row
        })
        .collect();
    page.section("What the others did")
        .prose(&format!(
            "Means over the futures: with \"{}\", then with \"{}\". Who drives less far with the one \
             than with the other gives way to it.",
            shown[0].kind, shown[1].kind
        ))
        .table(
            &[
                "agent", "away, m", "speed, m/s", "drives, m", "closest, m", "hits", "drives, m",
                "closest, m", "hits",
            ],
            &rows,
        );
}

/// What an agent did in a future.
struct Deed {
    metres: f64,
    /// Least distance of the centres of it and the ego.
    closest: f64,
    hit: bool,
}

fn deed(future: &Rollout, agent: &Agent) -> Option<Deed> {
    let mut deed = Deed {
        metres: 0.0,
        closest: f64::INFINITY,
        hit: false,
    };
    let mut before: DVec2 = agent.state.pose.position;
    for step in 0..=future.steps() {
        let scene = future.at(step);
        let (own, ego) = (scene.now().agent(agent.id)?, scene.ego_now());
        let place = own.state.pose.position;
        deed.metres += place.distance(before);
        deed.closest = deed.closest.min(place.distance(ego.state.pose.position));
        deed.hit |= overlapping(scene.now(), own).any(|id| id == ego.id);
        before = place;
    }
    Some(deed)
}

fn film(scenario: &Scenario, prospect: &Prospect) -> anyhow::Result<Film> {
    let futures: Vec<&Rollout> = prospect.futures.iter().collect();
    let camera = Camera::on_ego(&scenario.present(), 90.0, 360, 270);
    let spec = FilmSpec {
        frame_s: 0.5,
        ..FilmSpec::new(camera)
    };
    Ok(overlay_film(&futures, &spec)?)
}

/// One future of every candidate to play, and its line.
fn viewer<'a>(
    scenario: &'a Scenario,
    vehicle: &VehicleParameters,
    decision: &'a Decision,
    order: &[usize],
) -> Viewer<'a> {
    let mut viewer = Viewer::new(scenario);
    viewer.note("The first imagined future of every candidate, the chosen one first.");
    for &i in order {
        let prospect = &decision.prospects[i];
        viewer.future(prospect.kind.to_string(), &prospect.futures[0]);
        viewer.candidate(path(vehicle, decision, i));
    }
    viewer
}

/// A candidate with its line in the first of its futures, as the viewer takes it.
pub(crate) fn path(vehicle: &VehicleParameters, decision: &Decision, i: usize) -> CandidatePath {
    let prospect = &decision.prospects[i];
    let (parts, states) = (prospect.score.parts(), prospect.drives[0].iter());
    CandidatePath {
        name: prospect.kind.to_string(),
        score: Some(prospect.value),
        parts: parts
            .into_iter()
            .map(|(name, value)| (name.to_owned(), value))
            .collect(),
        is_chosen: i == decision.chosen && !decision.brakes,
        path: states
            .map(|state| vehicle.center_of(state.rear_axle).position)
            .collect(),
    }
}

/// What `report.json` says of the decision.
pub(crate) fn summary(decision: &Decision) -> Value {
    let ms = |time: std::time::Duration| time.as_secs_f64() * 1e3;
    let phases = &decision.phases;
    json!({
        "chosen": decision.prospects[decision.chosen].kind.to_string(),
        "brakes": decision.brakes,
        "horizon_s": decision.horizon,
        "candidates": decision.prospects.len(),
        "futures": decision.prospects[decision.chosen].futures.len(),
        "milliseconds": {
            "open": ms(phases.open),
            "frames": ms(phases.frames),
            "policies": ms(phases.policies),
            "score": ms(phases.score),
            "total": ms(phases.total()),
        },
    })
}
