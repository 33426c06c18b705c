//! The share of generated scenes that satisfy their prompt.
//!
//! A tag is requested on maps that admit it, which is determined without the network; a tag that
//! none of the maps admits (a car park, an all-way stop) is listed and does not count.

use gump_generate::check::{Clause, NOBODY_OVERLAPS, VEHICLES_ON_ROAD};
use gump_generate::pipeline::{GenerationJob, GenerationWorlds, admits, make};
use gump_generate::{Counts, GenerateConfig, GenerateRequest};
use gump_metrics::tags::{self, rules};
use gump_scene::{Scenario, ScenarioTag, Seed};
use rand::seq::SliceRandom as _;
use rayon::prelude::*;
use serde::Serialize;

use crate::{EvalError, Monitor};

/// Objects of the scenes that prompts are judged on: a street with some of each. Chosen by hand.
const PROMPTED: Counts = Counts {
    vehicles: 10,
    pedestrians: 4,
    bicycles: 3,
};
/// Seconds simulated of every scene, to see which tags hold, for how long, and whether it stays free
/// of overlaps and on the road: the horizon of Waymo's challenges.
const JUDGED_S: f64 = 8.0;
/// Unprompted scenes per map on which a tag is requested. Chosen by hand.
const UNPROMPTED: usize = 16;

/// Settings of the prompted scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PromptConfig {
    /// Maps per tag, among those that admit it; 0 prompts no scene.
    pub maps: usize,
    /// Attempts per scene; the last one counts.
    pub attempts: usize,
    /// Whether the ego may be steered.
    pub steers: bool,
    /// Whether the network reads the prompt.
    pub tokens: bool,
}

/// Share of scenes in which tags hold, mean over the tags that some map admits.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PromptSatisfaction {
    /// In scenes that are prompted with the tag, with every other clause of the prompt.
    pub satisfaction: Option<f64>,
    /// In unprompted scenes of the model.
    pub unconditional: Option<f64>,
    /// In recorded scenes.
    pub logged: Option<f64>,
    /// One per tag.
    pub rows: Vec<PromptRow>,
    /// Means over all prompted scenes, whatever their tag; `None` without any.
    pub scenes: Option<PromptMeans>,
}

/// Means over prompted scenes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PromptMeans {
    /// Number of scenes.
    pub scenes: usize,
    /// Share of scenes in which the tag holds with every other clause.
    pub satisfaction: f64,
    /// Share of scenes in which the tag holds.
    pub tag_alone: f64,
    /// Share of scenes that satisfy their prompt at the first attempt.
    pub first_attempt: f64,
    /// Share of scenes that satisfy it at the first attempt without steering.
    pub first_unsteered: f64,
    /// Share of scenes in which no agents overlap in the 8 s after the present.
    pub clear_throughout: f64,
    /// Share of scenes in which no vehicle is off the road in the 8 s after the present.
    pub on_road_throughout: f64,
    /// Mean share of the instants of these 8 s at which the tag holds, two a second and the present.
    /// Tags about what begins hold for a moment only.
    pub tag_share_of_time: f64,
    /// Mean number of attempts.
    pub attempts: f64,
    /// Share of scenes whose agents were steered.
    pub steered: f64,
    /// Mean seconds from the generated scene to its present.
    pub moment_s: f64,
}

impl PromptMeans {
    fn of(all: &[&PromptedScene]) -> Option<Self> {
        let mean = |value: &dyn Fn(&PromptedScene) -> f64| {
            let sum: f64 = all.iter().map(|prompted| value(prompted)).sum();
            sum / all.len() as f64
        };
        let share = |is: &dyn Fn(&PromptedScene) -> bool| mean(&|prompted| f64::from(is(prompted)));
        (!all.is_empty()).then(|| Self {
            scenes: all.len(),
            satisfaction: share(&|prompted| prompted.holds),
            tag_alone: share(&|prompted| prompted.is_tag),
            first_attempt: share(&|prompted| {
                prompted.first.is_some_and(|(attempt, _)| attempt == 1)
            }),
            first_unsteered: share(&|prompted| prompted.first == Some((1, false))),
            clear_throughout: share(&|prompted| prompted.is_clear),
            on_road_throughout: share(&|prompted| prompted.is_on_road),
            tag_share_of_time: mean(&|prompted| prompted.tag_share),
            attempts: mean(&|prompted| prompted.attempts as f64),
            steered: share(&|prompted| prompted.is_steered),
            moment_s: mean(&|prompted| prompted.moment_s),
        })
    }
}

/// The results of one tag; `None` where no map admits it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PromptRow {
    /// Name of the tag.
    pub tag: &'static str,
    /// Number of maps on which it was requested.
    pub maps: usize,
    /// Number of maps searched to find them.
    pub looked_at: usize,
    /// Share of scenes in which it holds with every other clause.
    pub satisfaction: Option<f64>,
    /// Share of scenes in which the tag holds.
    pub tag_alone: Option<f64>,
    /// Share of scenes that satisfy their prompt at the first attempt.
    pub first_attempt: Option<f64>,
    /// Share of scenes that satisfy it at the first attempt without steering.
    pub first_unsteered: Option<f64>,
    /// Share of scenes in which no agents overlap in the 8 s after the present.
    pub clear_throughout: Option<f64>,
    /// Share of scenes in which no vehicle is off the road in the 8 s after the present.
    pub on_road_throughout: Option<f64>,
    /// Mean share of the instants of these 8 s at which the tag holds.
    pub tag_share_of_time: Option<f64>,
    /// Mean number of attempts.
    pub attempts: Option<f64>,
    /// Share of scenes whose agents were steered.
    pub steered: Option<f64>,
    /// Mean seconds from the generated scene to its present.
    pub moment_s: Option<f64>,
    /// Share of unprompted scenes in which it holds.
    pub unconditional: f64,
    /// Share of recorded scenes in which it holds.
    pub log: f64,
}

struct PromptedScene {
    tag: usize,
    holds: bool,
    is_tag: bool,
    is_clear: bool,
    is_on_road: bool,
    /// Share of the instants at which the tag holds.
    tag_share: f64,
    /// The first attempt that satisfied it, and whether the ego was steered then.
    first: Option<(usize, bool)>,
    attempts: usize,
    is_steered: bool,
    moment_s: f64,
}

/// Prompts for every decidable tag on maps that admit it, and counts how often it holds in
/// unprompted scenes. The monitor gets a part that counts scenes.
///
/// # Errors
/// [`EvalError::Stopped`]. A scene that cannot be generated counts as one that does not satisfy its
/// prompt.
pub fn prompt_satisfaction(
    worlds: GenerationWorlds<'_>,
    scenarios: &[Scenario],
    config: PromptConfig,
    seed: Seed,
    monitor: &dyn Monitor,
) -> Result<PromptSatisfaction, EvalError> {
    let n_maps = config.maps;
    if n_maps == 0 {
        return Ok(PromptSatisfaction::default());
    }
    let decidable = rules().iter().filter(|rule| rule.is_decidable());
    let tags: Vec<ScenarioTag> = decidable.map(|rule| rule.tag()).collect();
    let mut shuffled: Vec<&Scenario> = scenarios.iter().collect();
    shuffled.shuffle(&mut seed.fork(9).rng());
    let places: Vec<Places<'_>> = tags
        .par_iter()
        .map(|tag| admitting(&shuffled, *tag, n_maps, seed.fork(10)))
        .collect();
    monitor.check()?;
    let cases: Vec<(usize, &Scenario)> = (0..tags.len())
        .flat_map(|tag| places[tag].found.iter().map(move |place| (tag, *place)))
        .collect();
    let progress = monitor.part("prompts", cases.len() as u64, "scenes");
    let prompted: Vec<PromptedScene> = (0..cases.len())
        .into_par_iter()
        .map(|number| {
            let (tag, recorded) = cases[number];
            let order = order(recorded, Some(tags[tag]), config);
            let prompted = make_prompted(worlds, &order, tag, number as u64, seed.fork(7));
            progress.advance(1);
            prompted
        })
        .collect();
    let unprompted: Vec<Vec<ScenarioTag>> = (0..n_maps * UNPROMPTED)
        .into_par_iter()
        .filter_map(|i| {
            let order = order(shuffled[i % shuffled.len()], None, once(config));
            let checked = make(worlds, &order, i as u64, seed.fork(8)).ok()?;
            Some(tags::extract_tags(&checked.scenario))
        })
        .collect();
    let logged: Vec<Vec<ScenarioTag>> = scenarios.par_iter().map(tags::extract_tags).collect();
    Ok(summed(&tags, &places, &prompted, &unprompted, &logged))
}

/// Settings for the search for places, in which nothing is generated.
const ANY: PromptConfig = PromptConfig {
    maps: 1,
    attempts: 1,
    steers: true,
    tokens: true,
};

/// The same with one attempt.
fn once(config: PromptConfig) -> PromptConfig {
    PromptConfig {
        attempts: 1,
        ..config
    }
}

/// The first scenes whose maps admit a tag, and how many were looked at until then.
#[derive(Default)]
struct Places<'a> {
    found: Vec<&'a Scenario>,
    looked_at: usize,
}

fn admitting<'a>(scenarios: &[&'a Scenario], tag: ScenarioTag, n: usize, seed: Seed) -> Places<'a> {
    let mut places = Places::default();
    for &recorded in scenarios {
        if places.found.len() == n {
            break;
        }
        places.looked_at += 1;
        if admits(&order(recorded, Some(tag), ANY).request, seed) {
            places.found.push(recorded);
        }
    }
    places
}

fn order(recorded: &Scenario, tag: Option<ScenarioTag>, config: PromptConfig) -> GenerationJob {
    let plain = GenerateRequest::in_place_of(recorded);
    GenerationJob {
        request: GenerateRequest {
            prompts: tag.into_iter().collect(),
            counts: Some(PROMPTED),
            config: GenerateConfig {
                steers: config.steers,
                prompt_tokens: config.tokens,
                ..plain.config.clone()
            },
            ..plain
        },
        roams: tag.is_none(),
        seconds: JUDGED_S,
        attempts: config.attempts,
    }
}

fn make_prompted(
    worlds: GenerationWorlds<'_>,
    order: &GenerationJob,
    tag: usize,
    number: u64,
    seed: Seed,
) -> PromptedScene {
    let prompt = order.request.prompts[0];
    match make(worlds, order, number, seed) {
        Ok(checked) => PromptedScene {
            tag,
            holds: checked.holds(),
            is_tag: tags::holds(prompt, &checked.scenario) == Some(true),
            is_clear: holds_throughout(&checked.clauses, NOBODY_OVERLAPS),
            is_on_road: holds_throughout(&checked.clauses, VEHICLES_ON_ROAD),
            tag_share: find(&checked.clauses, prompt.name())
                .and_then(|clause| clause.share_of_time)
                .unwrap_or(0.0),
            first: checked.first_satisfied,
            attempts: checked.attempts,
            is_steered: checked.is_steered,
            moment_s: checked.moment_s,
        },
        Err(_) => PromptedScene {
            tag,
            holds: false,
            is_tag: false,
            is_clear: false,
            is_on_road: false,
            tag_share: 0.0,
            first: None,
            attempts: order.attempts,
            is_steered: false,
            moment_s: 0.0,
        },
    }
}

fn find<'a>(clauses: &'a [Clause], name: &str) -> Option<&'a Clause> {
    clauses.iter().find(|clause| clause.clause == name)
}

/// Whether a clause holds from the present on.
fn holds_throughout(clauses: &[Clause], name: &str) -> bool {
    find(clauses, name).and_then(|clause| clause.holds_throughout) == Some(true)
}

fn summed(
    tags: &[ScenarioTag],
    places: &[Places<'_>],
    prompted: &[PromptedScene],
    unprompted: &[Vec<ScenarioTag>],
    logged: &[Vec<ScenarioTag>],
) -> PromptSatisfaction {
    let share = |all: &[Vec<ScenarioTag>], tag: &ScenarioTag| {
        let n = all.iter().filter(|tags| tags.contains(tag)).count();
        n as f64 / all.len().max(1) as f64
    };
    let (mut held, mut free, mut log, mut rows) = (vec![], vec![], vec![], vec![]);
    for (i, tag) in tags.iter().enumerate() {
        let own: Vec<&PromptedScene> = prompted
            .iter()
            .filter(|prompted| prompted.tag == i)
            .collect();
        let means = PromptMeans::of(&own);
        if let Some(means) = means {
            held.push(means.satisfaction);
            free.push(share(unprompted, tag));
            log.push(share(logged, tag));
        }
        rows.push(PromptRow {
            tag: tag.name(),
            maps: own.len(),
            looked_at: places[i].looked_at,
            satisfaction: means.map(|means| means.satisfaction),
            tag_alone: means.map(|means| means.tag_alone),
            first_attempt: means.map(|means| means.first_attempt),
            first_unsteered: means.map(|means| means.first_unsteered),
            clear_throughout: means.map(|means| means.clear_throughout),
            on_road_throughout: means.map(|means| means.on_road_throughout),
            tag_share_of_time: means.map(|means| means.tag_share_of_time),
            attempts: means.map(|means| means.attempts),
            steered: means.map(|means| means.steered),
            moment_s: means.map(|means| means.moment_s),
            unconditional: share(unprompted, tag),
            log: share(logged, tag),
        });
    }
    let mean = |values: &[f64]| {
        let sum: f64 = values.iter().sum();
        (!values.is_empty()).then(|| sum / values.len() as f64)
    };
    PromptSatisfaction {
        satisfaction: mean(&held),
        unconditional: mean(&free),
        logged: mean(&log),
        rows,
        scenes: PromptMeans::of(&prompted.iter().collect::<Vec<_>>()),
    }
}

#[cfg(test)]
mod tests {
    use gump_generate::check::{check_clauses, through_time};

    use super::*;

    #[test]
    fn tags_that_no_map_admits_do_not_count() {
        let tags: Vec<ScenarioTag> = ScenarioTag::all().take(3).collect();
        let prompted = |tag, holds| PromptedScene {
            tag,
            holds,
            is_tag: true,
            is_clear: !holds,
            is_on_road: holds,
            tag_share: if holds { 0.25 } else { 0.0 },
            first: holds.then_some((1, holds)),
            attempts: 3,
            is_steered: holds,
            moment_s: 0.5,
        };
        let prompted = [prompted(0, true), prompted(0, false), prompted(2, true)];
        let unprompted = [vec![tags[0], tags[1]], vec![tags[0]]];
        let places: Vec<_> = tags.iter().map(|_| Places::default()).collect();
        let prompts = summed(&tags, &places, &prompted, &unprompted, &[]);
        assert_eq!(prompts.satisfaction, Some(0.75));
        assert_eq!(prompts.unconditional, Some(0.5));
        assert_eq!(prompts.rows[0].satisfaction, Some(0.5));
        assert_eq!(prompts.rows[0].tag_alone, Some(1.0));
        assert_eq!(prompts.rows[0].first_attempt, Some(0.5));
        assert_eq!(prompts.rows[0].first_unsteered, Some(0.0));
        assert_eq!(prompts.rows[0].clear_throughout, Some(0.5));
        assert_eq!(prompts.rows[0].on_road_throughout, Some(0.5));
        assert_eq!(prompts.rows[0].tag_share_of_time, Some(0.125));
        // Over scenes, not over tags.
        let all = prompts.scenes.unwrap();
        assert_eq!((all.scenes, all.satisfaction), (3, 2.0 / 3.0));
        assert_eq!((all.clear_throughout, all.steered), (1.0 / 3.0, 2.0 / 3.0));
        assert_eq!(
            (all.on_road_throughout, all.tag_share_of_time),
            (2.0 / 3.0, 0.5 / 3.0)
        );
        let unadmitted = &prompts.rows[1];
        assert_eq!((unadmitted.maps, unadmitted.satisfaction), (0, None));
        assert_eq!(summed(&tags, &places, &[], &[], &[]).satisfaction, None);
        assert_eq!(summed(&tags, &places, &[], &[], &[]).scenes, None);
    }

    #[test]
    fn clauses_are_found_by_their_names() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 90,0\nego vehicle 0: 0,0 velocity 10,0\nagent vehicle 1: 44,0",
        )
        .unwrap();
        let tag: ScenarioTag = "high_magnitude_speed".parse().unwrap();
        let mut clauses = check_clauses(&scenario, &[tag], None);
        through_time(&mut clauses, &scenario, None);
        assert!(holds_throughout(&clauses, VEHICLES_ON_ROAD));
        assert!(!holds_throughout(&clauses, NOBODY_OVERLAPS));
        let prompt = find(&clauses, tag.name()).unwrap();
        assert_eq!(prompt.share_of_time, Some(1.0));
    }
}
