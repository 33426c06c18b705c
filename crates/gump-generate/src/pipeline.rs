//! Generation of scenes that satisfy their prompts: choose a place, generate, simulate the next
//! seconds, check, and repeat.
//!
//! A prompt may come true in the world's own rollout of the scene, or in a drive of the ego that
//! matches the prompt (`drive`), to which the world's other agents react.

use std::ops::Range;

use gump_engine::TransformerWorld;
use gump_metrics::tags;
use gump_rollout::WorldModel;
use gump_scene::{Scenario, ScenarioTag, Seed};
use rayon::prelude::*;

use crate::check::{Clause, check_clauses, check_objects, through_time};
use crate::prompt::PromptSpec;
use crate::prompt_search::{Search, any_start};
use crate::site::Site;
use crate::{GenerateError, GenerateRequest, GeneratedScene, Placement, futures, generate};

/// Number of further attempts for a scene without a later overlap, once one satisfies the request:
/// 99 % of scenes are then free of them, for 20 % more attempts (result 12).
const FURTHER: usize = 3;

/// A job of the pipeline.
#[derive(Clone, Debug)]
pub struct GenerationJob {
    /// The request of every scene.
    pub request: GenerateRequest,
    /// Whether each scene may have its own place on the map, within 150 m of the request's; with a
    /// prompt in guided placement the place may be moved in any case.
    pub roams: bool,
    /// Seconds to simulate of every scene; 0 for none.
    pub seconds: f64,
    /// Maximum number of attempts per scene.
    pub attempts: usize,
}

/// A generated scene with its check.
#[derive(Clone, Debug)]
pub struct CheckedScene {
    /// The scene as generated.
    pub scene: GeneratedScene,
    /// Its simulated future, at 10 Hz. The present is the instant at which the prompts hold, at
    /// most two seconds later; up to a second before it is kept.
    pub scenario: Scenario,
    /// The check of the present, and of the constraints on single objects in the scene as generated.
    pub clauses: Vec<Clause>,
    /// The attempt that made this scene, from 1.
    pub attempts: usize,
    /// The first attempt that satisfied the request, from 1, and whether its ego was steered. A
    /// later one may have been taken because no agents overlap in it.
    pub first_satisfied: Option<(usize, bool)>,
    /// Whether the ego was steered to match the prompts, rather than driven by the world.
    pub is_steered: bool,
    /// Seconds from the generated scene to the present.
    pub moment_s: f64,
}

impl CheckedScene {
    /// True if no clause fails; undecidable clauses do not count.
    pub fn holds(&self) -> bool {
        self.clauses
            .iter()
            .all(|clause| clause.holds != Some(false))
    }
}

/// The worlds used for generation.
#[derive(Clone, Copy)]
pub struct GenerationWorlds<'a> {
    /// The network that places agents in a scene.
    pub scenes: &'a TransformerWorld,
    /// The world that simulates the scene; may be the same network.
    pub traffic: &'a dyn WorldModel,
}

impl<'a> GenerationWorlds<'a> {
    /// The same network for both.
    pub fn of(world: &'a TransformerWorld) -> Self {
        Self {
            scenes: world,
            traffic: world,
        }
    }
}

/// Generates the scenes with these indices; each depends only on its index and the seed.
///
/// # Errors
/// Reasons that make the whole job impossible.
pub fn make_many(
    worlds: GenerationWorlds<'_>,
    order: &GenerationJob,
    numbers: Range<u64>,
    seed: Seed,
) -> Result<Vec<Result<CheckedScene, GenerateError>>, GenerateError> {
    let request = &order.request;
    if order.roams || !request.prompts.is_empty() {
        let numbers = numbers.into_par_iter();
        return Ok(numbers
            .map(|number| make(worlds, order, number, seed))
            .collect());
    }
    // One place for all and nothing to convince of: they can be made together.
    let stream = |number: u64| seed.fork(number).fork(0);
    let seeds: Vec<Seed> = numbers.clone().map(|n| stream(n).fork(1)).collect();
    let scenes = generate(worlds.scenes, request, &seeds)?;
    let numbered: Vec<_> = numbers.zip(scenes).collect();
    let results = numbered.into_par_iter().map(|(number, scene)| {
        let scene = scene?;
        let mut scenario = scene.scenario(name(number), &request.map, &[]);
        let stream = stream(number).fork(2);
        futures::extend(worlds.traffic, &mut scenario, order.seconds, stream)?;
        let mut clauses = check_clauses(&scenario, &[], request.counts.as_ref());
        through_time(&mut clauses, &scenario, request.counts.as_ref());
        clauses.extend(check_objects(&scene, &request.map, &request.objects));
        Ok(CheckedScene {
            clauses,
            scene,
            scenario,
            attempts: 1,
            first_satisfied: None,
            is_steered: false,
            moment_s: 0.0,
        })
    });
    Ok(results.collect())
}

/// Whether a map admits the prompts of a request: somewhere within 150 m of the request's ego, an
/// ego that drives along the lanes, with only the agents that the prompts are about, satisfies
/// them.
///
/// This needs no network, and does not mean that a generated scene will satisfy them.
pub fn admits(request: &GenerateRequest, seed: Seed) -> bool {
    let search = Search {
        cast: &PromptSpec::of(&request.prompts),
        request,
        prompts: &request.prompts,
    };
    search.anywhere(seed).is_some()
}

/// Generates scene `number` of a job.
///
/// # Errors
/// Reasons that make the job impossible, or the error of the last attempt if none gave a scene.
pub fn make(
    worlds: GenerationWorlds<'_>,
    order: &GenerationJob,
    number: u64,
    seed: Seed,
) -> Result<CheckedScene, GenerateError> {
    let seed = seed.fork(number);
    let mut sites = SiteSampler::new(order);
    let mut failure = None;
    let (mut held, mut last): (Option<CheckedScene>, Option<CheckedScene>) = (None, None);
    let mut further = 0;
    for attempt in 0..order.attempts.max(1) {
        let stream = seed.fork(attempt as u64);
        let (request, site) = match sites.next(attempt, stream.fork(0)) {
            // What was possible at first is not called impossible afterwards.
            Err(_) if attempt > 0 => break,
            next => next?,
        };
        let generated = generate(worlds.scenes, &request, &[stream.fork(1)]);
        let scene = match generated.map(|mut scenes| scenes.remove(0)) {
            Ok(Ok(scene)) => scene,
            // Another place or another draw may do, but never for what contradicts itself.
            Ok(Err(error)) | Err(error) => {
                let is_of_place = match error {
                    GenerateError::NoLane | GenerateError::NoPlace { .. } => true,
                    // At this place no object may be where the prompt requires one.
                    GenerateError::Constraints(_) => site.is_some() || order.roams,
                    _ => false,
                };
                if !is_of_place {
                    return Err(error);
                }
                failure = Some(error);
                continue;
            }
        };
        let checked = CheckedScene {
            scenario: scene.scenario(name(number), &request.map, &request.prompts),
            scene,
            clauses: Vec::new(),
            attempts: attempt + 1,
            first_satisfied: None,
            is_steered: false,
            moment_s: 0.0,
        };
        let mut checked = judged(worlds.traffic, order, checked, site.as_ref(), stream)?;
        if !checked.holds() {
            last = Some(checked);
            continue;
        }
        let before = held.as_ref().and_then(|held| held.first_satisfied);
        checked.first_satisfied = before.or(Some((attempt + 1, checked.is_steered)));
        if futures::stays_clear(&checked.scenario) {
            return Ok(checked);
        }
        held.get_or_insert(checked);
        further += 1;
        if further > FURTHER {
            break;
        }
    }
    match (held.or(last), failure) {
        (Some(checked), _) => Ok(checked),
        (None, Some(error)) => Err(error),
        (None, None) => unreachable!("the first attempt makes a scene or fails"),
    }
}

/// Draws the sites for the scenes of a job, attempt by attempt.
struct SiteSampler<'a> {
    order: &'a GenerationJob,
    cast: PromptSpec,
    /// Whether places other than the requested one may be used.
    searches: bool,
}

impl<'a> SiteSampler<'a> {
    fn new(order: &'a GenerationJob) -> Self {
        Self {
            order,
            cast: PromptSpec::of(&order.request.prompts),
            searches: true,
        }
    }

    /// The request of an attempt, and its place if prompts need one.
    fn next(
        &mut self,
        attempt: usize,
        seed: Seed,
    ) -> Result<(GenerateRequest, Option<Site>), GenerateError> {
        let (request, roams) = (&self.order.request, self.order.roams);
        if request.prompts.is_empty() || request.config.placement != Placement::Guided {
            let mut request = request.clone();
            if roams {
                request.ego = any_start(&request.map, request.ego, seed);
            }
            return Ok((request, None));
        }
        let search = Search {
            cast: &self.cast,
            request,
            prompts: &request.prompts,
        };
        // The place asked for goes first if it will do, and alone if no other does.
        let here = || search.here(seed.fork(0)).filter(|_| !roams);
        let anywhere = || search.anywhere(seed.fork(1));
        let mut site = if attempt == 0 { here() } else { None };
        if site.is_none() && self.searches {
            site = anywhere();
            self.searches = site.is_some();
        }
        let site = site.or_else(here).ok_or_else(|| {
            let names: Vec<&str> = request.prompts.iter().map(|tag| tag.name()).collect();
            GenerateError::NoSite {
                prompts: names.join(" and "),
            }
        })?;
        Ok((site.direct(request), Some(site)))
    }
}

/// The scene with as much of its future as is requested or needed for the check, and the check.
fn judged(
    world: &dyn WorldModel,
    order: &GenerationJob,
    mut checked: CheckedScene,
    site: Option<&Site>,
    stream: Seed,
) -> Result<CheckedScene, GenerateError> {
    let (prompts, counts) = (&order.request.prompts, order.request.counts.as_ref());
    let is_tag = |scenario: &Scenario| {
        let fails = |tag: &ScenarioTag| tags::holds(*tag, scenario) == Some(false);
        !prompts.iter().any(fails)
    };
    let holds = |scenario: &Scenario| {
        let clauses = || check_clauses(scenario, &[], counts);
        is_tag(scenario) && clauses().iter().all(|clause| clause.holds != Some(false))
    };
    if !prompts.is_empty() {
        // One future shows the agents present; an event, or a future without overlaps, may take
        // several.
        let (mut found, mut first) = (None, None);
        for (n, i) in [(1, 0), (futures::FUTURES, 1)] {
            if found.is_none() {
                let futures = futures::free(world, &checked.scenario, n, stream.fork(2).fork(i))?;
                let is_good =
                    |scenario: &Scenario| holds(scenario) && futures::stays_clear(scenario);
                found = futures::moment(futures.clone(), is_good);
                first = first.or_else(|| futures::moment(futures, holds));
            }
        }
        let mut found = found.or(first);
        if let (None, Some(site), true) = (&found, site, order.request.config.steers) {
            let present = checked.scenario.present();
            let drive = site.drive_from(present.ego_now(), present.now().lights());
            if let Some(drive) = drive {
                let steered = futures::steered(world, &checked.scenario, &drive, stream.fork(3))?;
                found = futures::moment(steered, holds);
                checked.is_steered = found.is_some();
            }
        }
        if let Some((scenario, seconds)) = found {
            (checked.scenario, checked.moment_s) = (scenario, seconds);
        }
    }
    let seconds = if prompts.is_empty() {
        order.seconds
    } else {
        order.seconds.max(futures::JUDGED_S)
    };
    futures::extend(world, &mut checked.scenario, seconds, stream.fork(4))?;
    checked.clauses = check_clauses(&checked.scenario, prompts, counts);
    through_time(&mut checked.clauses, &checked.scenario, counts);
    let constraints = check_objects(&checked.scene, &order.request.map, &order.request.objects);
    checked.clauses.extend(constraints);
    Ok(checked)
}

fn name(number: u64) -> String {
    format!("generated-{number:06}")
}
