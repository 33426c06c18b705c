//! Scenes that hold what was asked: made, imagined a little further, judged, and made again.

use std::ops::Range;
use std::sync::Arc;

use gump_rollout::{SimulateConfig, Start, simulate};
use gump_scene::{Rollout, Scenario, Seed};
use rayon::prelude::*;

use super::prompt::Cast;
use super::verdict::{Clause, verdict};
use super::{GenerateError, GenerateRequest, GeneratedScene, Placement};
use crate::ModelError;
use crate::world::TransformerWorld;

/// Seconds that are imagined to judge a prompt about what is beginning.
const JUDGED_S: f64 = 4.0;

/// What a factory makes.
#[derive(Clone, Debug)]
pub struct Order {
    /// What every scene is like.
    pub request: GenerateRequest,
    /// True lets each scene have its own place on the map, within 150 m of the request's; a prompt
    /// in guided placement may take that freedom too.
    pub roams: bool,
    /// Seconds to imagine of every scene; 0 for none.
    pub seconds: f64,
    /// Scenes made before one is given up that does not hold.
    pub attempts: usize,
}

/// A scene that was ordered.
#[derive(Clone, Debug)]
pub struct Made {
    /// The scene.
    pub scene: GeneratedScene,
    /// It and what was imagined of its future, at 10 Hz.
    pub scenario: Scenario,
    /// The verdict on it.
    pub clauses: Vec<Clause>,
    /// Scenes made until this one; it is the last, whether it holds or not.
    pub attempts: usize,
}

impl Made {
    /// True if no clause fails; what cannot be decided does not.
    pub fn holds(&self) -> bool {
        self.clauses
            .iter()
            .all(|clause| clause.holds != Some(false))
    }
}

/// Makes the scenes with these numbers; what each is depends on its number and the seed alone.
///
/// # Errors
/// What makes the order impossible.
pub fn make_many(
    world: &TransformerWorld,
    order: &Order,
    numbers: Range<u64>,
    seed: Seed,
) -> Result<Vec<Result<Made, GenerateError>>, GenerateError> {
    let request = &order.request;
    if order.roams || !request.prompts.is_empty() {
        let made = numbers.into_par_iter();
        return Ok(made
            .map(|number| make(world, order, number, seed))
            .collect());
    }
    // One place for all and nothing to convince of: they can be made together.
    let stream = |number: u64| seed.fork(number).fork(0);
    let seeds: Vec<Seed> = numbers.clone().map(|n| stream(n).fork(1)).collect();
    let scenes = world.generate(request, &seeds)?;
    let numbered: Vec<_> = numbers.zip(scenes).collect();
    let made = numbered.into_par_iter().map(|(number, scene)| {
        let scene = scene?;
        let seed = stream(number).fork(2);
        let scenario = imagined(world, order, request, &scene, number, seed)?;
        Ok(Made {
            clauses: verdict(&scenario, &[], request.counts.as_ref()),
            scene,
            scenario,
            attempts: 1,
        })
    });
    Ok(made.collect())
}

/// Makes scene number `number` of an order.
///
/// # Errors
/// What makes the order impossible, or the last attempt's failure if none gave a scene.
pub fn make(
    world: &TransformerWorld,
    order: &Order,
    number: u64,
    seed: Seed,
) -> Result<Made, GenerateError> {
    let seed = seed.fork(number);
    let request = &order.request;
    let is_guided = request.config.placement == Placement::Guided;
    let cast = Cast::of(&request.prompts);
    let mut failure = None;
    let mut last: Option<Made> = None;
    for attempt in 0..order.attempts.max(1) {
        let stream = seed.fork(attempt as u64);
        let mut request = request.clone();
        let searches = is_guided && !request.prompts.is_empty();
        // The place asked for goes first, if the prompt needs no other.
        if order.roams || (searches && attempt > 0) {
            let (map, lights) = (Arc::clone(&request.map), request.lights.clone());
            let (prompts, around) = (request.prompts.clone(), request.ego);
            request.ego = cast.start(&map, &lights, &prompts, around, stream.fork(0));
        }
        if searches {
            request.objects = cast.with(&request.objects);
            let map = Arc::clone(&request.map);
            cast.on_crosswalk(&map, request.ego.pose, &mut request.objects);
        }
        let made = world.generate(&request, &[stream.fork(1)]);
        let scene = match made.map(|mut scenes| scenes.remove(0)) {
            Ok(Ok(scene)) => scene,
            // Another place or another draw may do, but never for what contradicts itself.
            Ok(Err(error)) | Err(error) => match error {
                GenerateError::NoLane | GenerateError::NoPlace { .. } => {
                    failure = Some(error);
                    continue;
                }
                _ => return Err(error),
            },
        };
        let scenario = imagined(world, order, &request, &scene, number, stream.fork(2))?;
        let clauses = verdict(&scenario, &request.prompts, request.counts.as_ref());
        let made = Made {
            scene,
            scenario,
            clauses,
            attempts: attempt + 1,
        };
        if made.holds() {
            return Ok(made);
        }
        last = Some(made);
    }
    match (last, failure) {
        (Some(made), _) => Ok(made),
        (None, Some(error)) => Err(error),
        (None, None) => unreachable!("there is at least one attempt"),
    }
}

/// The scene with as much of its future as is asked for or needed to judge it.
fn imagined(
    world: &TransformerWorld,
    order: &Order,
    request: &GenerateRequest,
    scene: &GeneratedScene,
    number: u64,
    seed: Seed,
) -> Result<Scenario, GenerateError> {
    let mut scenario = scene.scenario(
        format!("generated-{number:06}"),
        &request.map,
        &request.prompts,
    );
    let judged = if request.prompts.is_empty() {
        0.0
    } else {
        JUDGED_S
    };
    let seconds = order.seconds.max(judged);
    if seconds > 0.0 {
        let start = Start {
            scene: scenario.present(),
            n_futures: 1,
            seed,
        };
        let config = SimulateConfig {
            seconds,
            ..SimulateConfig::default()
        };
        let rollouts = simulate(world, &[start], None, &config)
            .map_err(|error| ModelError::Scene(error.to_string()))?;
        let future = rollouts.first().map_or(&[][..], Rollout::imagined);
        scenario.log.extend_from_slice(future);
    }
    Ok(scenario)
}
