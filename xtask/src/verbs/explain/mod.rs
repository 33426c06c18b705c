//! The page of one decision: what was chosen over what and why, what every candidate is worth, and
//! what the imagined others did.

mod reasons;

use anyhow::Context as _;
use gump_geometry::DVec2;
use gump_metrics::overlapping;
use gump_planner::{CandidateEvaluation, Decision};
use gump_scene::{Agent, Rollout, Scenario, VehicleParameters};
use gump_viz::{
    Camera, CandidatePath, Film, FilmSpec, LabelledRollout, Page, Picture, PictureSpec, Viewer,
    draw_candidates, grid_film,
};
use serde_json::{Value, json};

pub(crate) use self::reasons::weight;
use crate::run::Run;

/// Number of agents to describe, those nearest to the ego. Chosen by hand: what fits a page.
const OTHERS: usize = 8;

/// A decision made in the present of a scenario, which need not have a future.
pub(crate) struct Explained<'a> {
    pub(crate) scenario: &'a Scenario,
    pub(crate) vehicle: &'a VehicleParameters,
    pub(crate) decision: &'a Decision,
    /// Seconds since the drive began.
    pub(crate) time: f64,
}

impl Explained<'_> {
    /// Writes `explain.html` and `viewer.html`.
    ///
    /// Error: files that cannot be written.
    pub(crate) fn write(&self, run: &Run) -> anyhow::Result<()> {
        let title = format!("Why this candidate: {}", self.scenario.id);
        let mut page = Page::new(title);
        self.choice(&mut page)?;
        let order = ranked(self.decision);
        scores(&mut page, self.decision, &order);
        others(&mut page, self.decision, &order, self.scenario);
        page.save(&run.path("explain.html"))?;
        viewer(self.scenario, self.vehicle, self.decision, &order)
            .save(&run.path("viewer.html"))
            .context("the viewer cannot be written")
    }

    /// Writes the choice and its best alternatives in words, as a picture and as a film.
    fn choice(&self, page: &mut Page) -> anyhow::Result<()> {
        let decision = self.decision;
        let chosen = &decision.candidates[decision.chosen];
        let alternative = reasons::best_alternative(decision);
        page.lede(format!(
            "{:.1} s after the start, {} candidates drove {:.1} s among others who react: the best {} \
             of them in {} futures, the others in fewer.{} {}",
            self.time,
            decision.candidates.iter().filter(|p| p.rests == 0).count(),
            decision.horizon,
            decision.candidates.iter().filter(|p| p.finalist).count(),
            chosen.futures.len(),
            match decision.candidates.iter().filter(|p| p.rests > 0).count() {
                0 => String::new(),
                n => format!(
                    " {n} more rest, because they were clearly worse before and are among others who \
                     keep their velocity."
                ),
            },
            match decision.brakes {
                true => "Even the best of them hits something soon: the ego brakes.".to_owned(),
                false => format!("The ego drives \"{}\".", chosen.kind),
            }
        ));
        let near = near(decision, self.scenario);
        let near: Vec<&Agent> = near.iter().collect();
        let section = page.section("The decision");
        let mut compared = Vec::new();
        let ordinary = reasons::ordinary(decision);
        for (what, other) in [
            ("the best alternative with another path", alternative),
            ("IDM at the speed limit, without rollouts", ordinary),
        ] {
            let Some(i) = other.filter(|&i| i != decision.chosen && !compared.contains(&i)) else {
                continue;
            };
            compared.push(i);
            let other = &decision.candidates[i];
            section.prose(&format!(
                "\"{}\" scores {}; \"{}\", {what}, {}. {}",
                chosen.kind,
                rounded(chosen.value),
                other.kind,
                rounded(other.value),
                reasons::between(chosen, other, &near).join(" ")
            ));
        }
        section.picture(
            &self.picture(&compared),
            "Where the ego goes: the chosen candidate in the ego's colour, those it is compared with \
             in dark; a dot at the end of each.",
        )?;
        if let Some(i) = alternative {
            let caption = "The first future of the chosen candidate and of the best alternative with \
                           another path. All can be played and clicked into in viewer.html.";
            let film = film(self.scenario, [chosen, &decision.candidates[i]])?;
            section.film(&film, caption);
        }
        section.link("viewer.html", "Play every candidate in the viewer");
        Ok(())
    }

    /// The scene with the lines of the chosen candidate and of some others.
    fn picture(&self, others: &[usize]) -> Picture {
        let shown = std::iter::once(self.decision.chosen).chain(others.iter().copied());
        let paths: Vec<CandidatePath> = shown
            .map(|i| path(self.vehicle, self.decision, i))
            .collect();
        let scene = self.scenario.present();
        let points = paths.iter().flat_map(|path| path.path.iter().copied());
        let heading = scene.ego_now().state.pose.heading;
        let camera = Camera::framing(points, heading, 60.0, (960, 640));
        let spec = PictureSpec {
            legend: true,
            ..PictureSpec::new(camera)
        };
        draw_candidates(&scene, &paths, &spec)
    }
}

/// A score as the page shows it.
fn rounded(score: f64) -> String {
    format!("{score:.3}")
}

/// Agents nearest to the ego at the decision, the nearest first.
fn near(decision: &Decision, scenario: &Scenario) -> Vec<Agent> {
    let scene = scenario.present();
    let ego = scene.ego_now().state.pose.position;
    let Some(future) = decision.candidates[decision.chosen].futures.first() else {
        return Vec::new();
    };
    let start = future.at(0);
    let mut near: Vec<Agent> = start.now().agents().to_vec();
    near.retain(|agent| agent.id != scene.ego);
    near.sort_by(|a, b| {
        let away = |agent: &Agent| agent.state.pose.position.distance(ego);
        away(a).total_cmp(&away(b)).then(a.id.cmp(&b.id))
    });
    near.truncate(OTHERS);
    near
}

/// The chosen one, then the others, best first.
pub(crate) fn ranked(decision: &Decision) -> Vec<usize> {
    let mut order: Vec<usize> = (0..decision.candidates.len()).collect();
    order.sort_by(|&a, &b| {
        let value = |i: usize| decision.candidates[i].value;
        // Values of fewer futures do not compare.
        let rank = |i: usize| (i == decision.chosen, decision.candidates[i].futures.len());
        rank(b).cmp(&rank(a)).then(value(b).total_cmp(&value(a)))
    });
    order
}

/// Writes the value of every candidate by its parts; parts that are equal for all become one
/// sentence.
fn scores(page: &mut Page, decision: &Decision, order: &[usize]) {
    let parts = |i: usize| decision.candidates[i].parts();
    let names: Vec<&str> = parts(order[0]).iter().map(|(name, _)| *name).collect();
    let value = |i: usize, part: usize| parts(i).get(part).map_or(0.0, |(_, value)| *value);
    let (equal, telling): (Vec<usize>, Vec<usize>) = (0..names.len()).partition(|&part| {
        let first = value(order[0], part);
        order.iter().all(|&i| (value(i, part) - first).abs() < 5e-4)
    });
    let words: Vec<String> = telling
        .iter()
        .map(|&part| reasons::short(names[part]))
        .collect();
    let mut columns = vec!["candidate", "score", "futures"];
    columns.extend(words.iter().map(String::as_str));
    columns.push("metres");
    let rows: Vec<Vec<String>> = order
        .iter()
        .map(|&i| {
            let evaluation = &decision.candidates[i];
            let mut row = vec![
                evaluation.kind.to_string(),
                format!("{:.3}", evaluation.value),
                match evaluation.rests {
                    0 => evaluation.futures.len().to_string(),
                    _ => "rests".to_owned(),
                },
            ];
            row.extend(telling.iter().map(|&part| format!("{:.2}", value(i, part))));
            row.push(format!("{:.1}", evaluation.progress_m));
            row
        })
        .collect();
    let all_alike: Vec<String> = equal
        .iter()
        .map(|&part| {
            format!(
                "{} ({:.2})",
                reasons::words(names[part]),
                value(order[0], part)
            )
        })
        .collect();
    let alike = match all_alike.is_empty() {
        true => String::new(),
        false => format!(" Equal for all: {}.", all_alike.join(", ")),
    };
    let hedged = match decision.candidates[order[0]].hedge {
        Some(_) => {
            " The hedge is the same score where the others keep their velocity; it is a part of the \
             total."
        }
        None => "",
    };
    page.section("Scores")
        .prose(&format!(
            "Means over a candidate's futures. Gates (collision, road, \
             direction) multiply; progress, time to collision, the speed limit and comfort add with \
             weights of 5, 5, 4 and 2.{hedged}{alike}"
        ))
        .table(&columns, &rows);
}

/// Writes the behaviour of the agents nearest to the ego, with the chosen candidate and with the
/// best alternative with another path.
fn others(page: &mut Page, decision: &Decision, order: &[usize], scenario: &Scenario) {
    let last = order[order.len() - 1];
    let other = reasons::best_alternative(decision).unwrap_or(last);
    let shown = [decision.chosen, other].map(|i| &decision.candidates[i]);
    let scene = scenario.present();
    let ego = scene.ego_now().state.pose.position;
    let rows: Vec<Vec<String>> = near(decision, scenario)
        .iter()
        .map(|agent| {
            let mut row = vec![
                format!("{} {}", agent.kind.name(), agent.id),
                format!("{:.1}", agent.state.pose.position.distance(ego)),
                format!("{:.1}", agent.state.speed()),
            ];
            for evaluation in shown {
                let deeds: Vec<Deed> = evaluation
                    .futures
                    .iter()
                    .filter_map(|future| deed(future, agent))
                    .collect();
                let n = deeds.len().max(1) as f64;
                let mean = |part: fn(&Deed) -> f64| deeds.iter().map(part).sum::<f64>() / n;
                row.push(format!("{:.1}", mean(|deed| deed.metres)));
                row.push(format!("{:.1}", mean(|deed| deed.closest)));
                let hits = deeds.iter().filter(|deed| deed.hit).count();
                row.push(hits.to_string());
            }
            row
        })
        .collect();
    page.section("What the others did")
        .prose(&format!(
            "Means over the futures, with the chosen candidate (\"{}\") and with the best alternative \
             with another path (\"{}\"). An agent that drives less far with one of them yields to it.",
            shown[0].kind, shown[1].kind
        ))
        .table(
            &[
                "agent",
                "away, m",
                "speed, m/s",
                "chosen: drives, m",
                "closest, m",
                "hits",
                "alternative: drives, m",
                "closest, m",
                "hits",
            ],
            &rows,
        );
}

/// Behaviour of an agent in a future.
struct Deed {
    metres: f64,
    /// Smallest distance between its centre and the ego's.
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

/// The first future of each, side by side.
fn film(scenario: &Scenario, shown: [&CandidateEvaluation; 2]) -> anyhow::Result<Film> {
    let takes: Vec<LabelledRollout<'_>> = shown
        .iter()
        .map(|evaluation| LabelledRollout {
            rollout: &evaluation.futures[0],
            label: evaluation.kind.to_string(),
        })
        .collect();
    let camera = Camera::on_ego(&scenario.present(), 70.0, 480, 400);
    let spec = FilmSpec {
        // Simulated futures have a frame every half second.
        frame_s: 0.5,
        ..FilmSpec::new(camera)
    };
    Ok(grid_film(&takes, &spec)?)
}

/// One future of every candidate to play, and its line.
fn viewer<'a>(
    scenario: &'a Scenario,
    vehicle: &VehicleParameters,
    decision: &'a Decision,
    order: &[usize],
) -> Viewer<'a> {
    let mut viewer = Viewer::new(scenario);
    viewer.note("The first simulated future of every candidate, the chosen one first.");
    for &i in order {
        let evaluation = &decision.candidates[i];
        viewer.future(evaluation.kind.to_string(), &evaluation.futures[0]);
        viewer.candidate(path(vehicle, decision, i));
    }
    viewer
}

/// A candidate with its line in the first of its futures, as the viewer takes it.
pub(crate) fn path(vehicle: &VehicleParameters, decision: &Decision, i: usize) -> CandidatePath {
    let evaluation = &decision.candidates[i];
    let (parts, states) = (evaluation.parts(), evaluation.drives[0].iter());
    CandidatePath {
        name: evaluation.kind.to_string(),
        score: Some(evaluation.value),
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

/// The decision as a value for `report.json`.
pub(crate) fn summary(decision: &Decision) -> Value {
    let ms = |time: std::time::Duration| time.as_secs_f64() * 1e3;
    let phases = &decision.phases;
    json!({
        "chosen": decision.candidates[decision.chosen].kind.to_string(),
        "brakes": decision.brakes,
        "horizon_s": decision.horizon,
        "candidates": decision.candidates.len(),
        "futures": decision.candidates[decision.chosen].futures.len(),
        "milliseconds": {
            "open": ms(phases.open),
            "frames": ms(phases.frames),
            "policies": ms(phases.policies),
            "score": ms(phases.score),
            "total": ms(phases.total()),
        },
    })
}
