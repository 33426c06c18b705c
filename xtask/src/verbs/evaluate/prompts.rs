//! The prompts part of `evaluate generation`: how often scenes are what their prompt says.

use gump_metrics::tags::{self, rules};
use gump_model::generation::factory::{Order, make};
use gump_model::generation::{Counts, GenerateRequest};
use gump_model::world::TransformerWorld;
use gump_scene::{Scenario, ScenarioTag};
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::run::Run;
use crate::verbs::generate;

/// Objects of the scenes that prompts are judged on.
const PROMPTED: Counts = Counts {
    vehicles: 10,
    pedestrians: 4,
    bicycles: 3,
};
/// Seconds imagined of unprompted scenes to see which tags hold.
const JUDGED_S: f64 = 4.0;

/// Every decidable tag on some maps, against how often it holds without being asked for.
pub(super) fn satisfaction(
    run: &Run,
    world: &TransformerWorld,
    scenarios: &[Scenario],
    prompt_maps: usize,
    most_attempts: usize,
) -> anyhow::Result<Prompts> {
    let seed = run.seed();
    let maps: Vec<&Scenario> = scenarios.iter().take(prompt_maps).collect();
    if maps.is_empty() {
        return Ok(Prompts::default());
    }
    let tags: Vec<ScenarioTag> = rules()
        .iter()
        .filter(|rule| rule.is_decidable())
        .map(|rule| rule.tag())
        .collect();
    let order = |recorded: &Scenario, tag: Option<ScenarioTag>| Order {
        request: GenerateRequest {
            prompts: tag.into_iter().collect(),
            counts: Some(PROMPTED),
            ..generate::request(recorded)
        },
        roams: tag.is_none(),
        seconds: JUDGED_S,
        attempts: if tag.is_none() { 1 } else { most_attempts },
    };
    let progress = run.progress("prompts", (tags.len() * maps.len()) as u64, "scenes");
    let cases: Vec<(usize, usize)> = (0..tags.len())
        .flat_map(|tag| (0..maps.len()).map(move |map| (tag, map)))
        .collect();
    let asked: Vec<(usize, bool, usize)> = cases
        .par_iter()
        .map(|&(tag, map)| {
            let order = order(maps[map], Some(tags[tag]));
            let number = (tag * maps.len() + map) as u64;
            let made = make(world, &order, number, seed.fork(7));
            progress.advance(1);
            made.map_or((tag, false, most_attempts), |made| {
                let holds = tags::holds(tags[tag], &made.scenario) == Some(true);
                (tag, holds, made.attempts)
            })
        })
        .collect();
    // As many unprompted scenes as there are prompted ones per two tags, at least eight.
    let n = maps.len().max(1) * 8;
    let unasked: Vec<Vec<ScenarioTag>> = (0..n as u64)
        .into_par_iter()
        .filter_map(|i| {
            let order = order(maps[i as usize % maps.len()], None);
            let made = make(world, &order, i, seed.fork(8)).ok()?;
            Some(tags::mine(&made.scenario))
        })
        .collect();
    let logged: Vec<Vec<ScenarioTag>> = scenarios.par_iter().map(tags::mine).collect();
    Ok(Prompts::new(&tags, &asked, &unasked, &logged))
}

/// How often tags hold.
#[derive(Default)]
pub(super) struct Prompts {
    pub(super) satisfaction: Option<f64>,
    pub(super) unconditional: Option<f64>,
    pub(super) logged: Option<f64>,
    pub(super) rows: Vec<Value>,
}

impl Prompts {
    fn new(
        tags: &[ScenarioTag],
        asked: &[(usize, bool, usize)],
        unasked: &[Vec<ScenarioTag>],
        logged: &[Vec<ScenarioTag>],
    ) -> Self {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let share = |all: &[Vec<ScenarioTag>], tag: &ScenarioTag| {
            let n = all.iter().filter(|tags| tags.contains(tag)).count();
            n as f64 / all.len().max(1) as f64
        };
        let (mut held, mut free, mut log, mut rows) = (vec![], vec![], vec![], vec![]);
        for (i, tag) in tags.iter().enumerate() {
            let own: Vec<_> = asked.iter().filter(|(tag, ..)| *tag == i).collect();
            let holding = own.iter().filter(|(_, holds, _)| *holds).count();
            let attempts: usize = own.iter().map(|(.., attempts)| attempts).sum();
            held.push(holding as f64 / own.len().max(1) as f64);
            free.push(share(unasked, tag));
            log.push(share(logged, tag));
            rows.push(json!({
                "tag": tag.name(),
                "satisfaction": held[i],
                "attempts": attempts as f64 / own.len().max(1) as f64,
                "unconditional": free[i],
                "log": log[i],
            }));
        }
        Self {
            satisfaction: Some(mean(&held)),
            unconditional: Some(mean(&free)),
            logged: Some(mean(&log)),
            rows,
        }
    }
}
