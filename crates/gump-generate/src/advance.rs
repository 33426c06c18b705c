//! Steps of scene generation for many scenes at once: one pass for the next keys of all, then draws
//! until each satisfies its constraints. Every scene has its own random stream, so scenes do not
//! affect each other.

use std::sync::Arc;

use gump_engine::cpu::{Engine, Job};
use gump_engine::placement::rules::{Rules, state_of};
use gump_engine::request::{Guide, Request};
use gump_engine::temporal_ensemble::ChunkBuffer;
use gump_engine::{EngineError, TransformerWorld};
use gump_geometry::{DVec2, OrientedBox};
use gump_model::decoder::{Bins, STATE_STEPS};
use gump_model::local_frame::LocalFrame;
use gump_model::placed_slot::PlacedSlot;
use gump_scene::{AgentKind, ScenarioTag, Seed};
use gump_tokenizer::{Key, QuantizedState};
use rayon::prelude::*;

use crate::headway::Moving;
use crate::partial_scene::PartialScene;
use crate::{GenerateError, Placement, latin_hypercube, reason};

/// Number of draws of an object made at once after the first: most objects need no more. Not tuned.
const VOLLEY: usize = 4;

/// Steps of the decoder that draw the size and the velocity; those of the place follow.
const SIZE_AND_VELOCITY: usize = 4;

/// Separates the draw of a place from those of the fields.
const PLACE: u64 = 1 << 32;
/// Separates the numbers of later attempts.
const NUMBERS: u64 = 1 << 33;

/// Gives every unfinished scene its next object; false once all are finished.
pub(crate) fn advance(
    world: &TransformerWorld,
    drafts: &mut [PartialScene<'_>],
) -> Result<bool, GenerateError> {
    let engine = world.engine().expect("preparing checked that there is one");
    let mut open: Vec<&mut PartialScene<'_>> = drafts
        .iter_mut()
        .filter(|partial| partial.outcome.is_none())
        .collect();
    if open.is_empty() {
        return Ok(false);
    }
    let asking: Vec<bool> = open.iter().map(|partial| partial.asks()).collect();
    let hidden = read(engine, &mut open, |i| asking[i].then_some(None))?;
    let mut successors = engine.successors(&hidden).into_iter();
    let mut keys = Vec::with_capacity(open.len());
    for (partial, asks) in open.iter_mut().zip(&asking) {
        let successor = if *asks { successors.next() } else { None };
        let key = partial.next_key(successor.as_ref());
        if key.is_none() {
            partial.outcome = Some(Ok(()));
        }
        keys.push(key);
    }
    let hidden = read(engine, &mut open, |i| keys[i].map(Some))?;
    let width = world.network().config().width;
    let mut rows = hidden.chunks_exact(width);
    let placed = open.into_iter().zip(keys).filter_map(|(partial, key)| {
        let hidden = rows_next(&mut rows, key)?;
        Some(Query {
            rules: Arc::new(partial.rules(key?)),
            key: key?,
            partial,
            hidden,
            first: None,
            broken: Vec::new(),
        })
    });
    let queries: Vec<Query<'_, '_>> = placed.collect();
    draw(engine, queries);
    Ok(true)
}

/// The next row if there is a key to ask for.
fn rows_next<'h>(
    rows: &mut std::slice::ChunksExact<'h, f32>,
    key: Option<Key>,
) -> Option<&'h [f32]> {
    key?;
    rows.next()
}

/// Hidden vectors at the last slot of every scene for which `last` returns it: the key of a further
/// agent, or the last value.
fn read(
    engine: &Engine,
    open: &mut [&mut PartialScene<'_>],
    last: impl Fn(usize) -> Option<Option<Key>>,
) -> Result<Vec<f32>, EngineError> {
    let slots = open.iter().enumerate().map(|(i, partial)| {
        let next = last(i);
        let slots = next.map(|next| partial.prepared.slots(&partial.agents, next));
        slots.transpose()
    });
    let slots: Vec<Option<Vec<PlacedSlot>>> = slots.collect::<Result<_, _>>()?;
    let members = open.iter_mut().zip(&slots);
    let mut jobs: Vec<Job<'_>> = members
        .filter_map(|(partial, slots)| {
            let slots = slots.as_ref()?;
            Some(Job {
                slots,
                wanted: vec![slots.len() - 1],
                memory: partial.prepared.memory(),
                kv_cache: &mut partial.kv_cache,
                keep: true,
            })
        })
        .collect();
    Ok(engine.run(&mut jobs))
}

/// An object to be drawn.
struct Query<'d, 'a> {
    partial: &'d mut PartialScene<'a>,
    key: Key,
    rules: Arc<Rules>,
    hidden: &'d [f32],
    /// The first draw of one without a given place, once it was rejected, and the numbers that decided it, if there were any.
    first: Option<(Bins, Option<[f64; STATE_STEPS]>)>,
    broken: Vec<String>,
}

/// Draws every object until it satisfies its constraints or its draws are used up.
fn draw(engine: &Engine, mut queries: Vec<Query<'_, '_>>) {
    let mut drawn = 0;
    while !queries.is_empty() {
        let tries = queries[0].partial.prepared.request.config.tries;
        let n = if drawn == 0 { 1 } else { VOLLEY }.min(tries - drawn);
        let rules: Vec<Arc<Rules>> = queries
            .iter()
            .flat_map(|query| (0..n).map(|i| rules(query, drawn + i)))
            .collect();
        let requests: Vec<Request> = queries
            .iter()
            .flat_map(|query| (0..n).map(move |i| (query, drawn + i)))
            .zip(&rules)
            .map(|((query, attempt), rules)| request(query, rules, attempt))
            .collect();
        let hidden: Vec<f32> = queries
            .iter()
            .flat_map(|query| query.hidden.repeat(n))
            .collect();
        let references: Vec<&Request> = requests.iter().collect();
        let sampling = &queries[0].partial.prepared.sampling;
        let bins = engine.sample_state(&hidden, &references, sampling);
        drawn += n;
        let is_last = drawn >= tries;
        // Where only a queue without a head is possible, it is accepted, and at last whatever there is.
        let asked = match (is_last, 2 * drawn > tries) {
            (true, _) => Asked::Nothing,
            (_, true) => Asked::Headway,
            _ => Asked::All,
        };
        let judged: Vec<Vec<Result<Found, String>>> = queries
            .par_iter()
            .zip(bins.par_chunks(n).zip(rules.par_chunks(n)))
            .map(|(query, (bins, rules))| {
                bins.iter()
                    .zip(rules)
                    .map(|(bins, rules)| judge(query, rules, bins, asked))
                    .collect()
            })
            .collect();
        let mut left = Vec::new();
        let bins = bins.chunks(n);
        for ((mut query, judged), bins) in queries.into_iter().zip(judged).zip(bins) {
            let mut kept = None;
            for result in judged {
                match result {
                    Ok(found) => {
                        kept = Some(found);
                        break;
                    }
                    Err(clause) => {
                        query.partial.redraws += 1;
                        query.broken.push(clause);
                    }
                }
            }
            match kept {
                Some((state, outline)) => query.partial.accept(query.key, state, outline),
                None if is_last => query.partial.fail(query.key, &query.broken),
                None => {
                    // The numbers of the first draw would give the same again.
                    let numbers = Arc::make_mut(&mut query.rules).manner.numbers.take();
                    // Where the place is given, only another velocity can help.
                    if !query.key.is_ego() && query.rules.rows.is_empty() {
                        query.first.get_or_insert((bins[0], numbers));
                    }
                    left.push(query);
                }
            }
        }
        queries = left;
    }
}

/// The seed of one attempt.
fn stream(query: &Query<'_, '_>, attempt: usize) -> Seed {
    let n_placed = query.partial.agents.len() as u64;
    query.partial.stream(2 * n_placed + 2).fork(attempt as u64)
}

/// Whether an attempt is among the first half, of which more is asked.
fn is_early(query: &Query<'_, '_>, attempt: usize) -> bool {
    2 * attempt < query.partial.prepared.request.config.tries
}

/// The constraints of one attempt, with a place of its own.
fn rules(query: &Query<'_, '_>, attempt: usize) -> Arc<Rules> {
    let mut rules = Arc::clone(&query.rules);
    let seed = stream(query, attempt);
    if let (Some((_, Some(first))), true) = (query.first, is_early(query, attempt)) {
        let tries = query.partial.prepared.request.config.tries;
        let spread = attempt as f64 / tries as f64;
        let is_place = |step| step >= SIZE_AND_VELOCITY;
        let numbers = latin_hypercube::near(&first, seed.fork(NUMBERS), spread, is_place);
        Arc::make_mut(&mut rules).manner.numbers = Some(numbers);
    }
    if let Some(draw) = &query.rules.places {
        Arc::make_mut(&mut rules).places = Some(draw.again(seed.fork(PLACE)));
    }
    rules
}

fn request(query: &Query<'_, '_>, rules: &Arc<Rules>, attempt: usize) -> Request {
    let guide: Arc<dyn Guide> = Arc::<Rules>::clone(rules);
    let mut forced = query.partial.given(query.key);
    // Another place is tried before another size and velocity: rejected draws would otherwise leave too
    // few vehicles that stand, long ones and fast ones.
    if let (Some((first, _)), true) = (query.first, is_early(query, attempt)) {
        let kept = forced.iter_mut().zip(first).take(SIZE_AND_VELOCITY);
        kept.for_each(|(bin, of_first)| *bin = bin.or(Some(of_first)));
    }
    Request {
        local_frame: LocalFrame::SCENE,
        forced,
        stream: stream(query, attempt),
        near: None,
        ring: ChunkBuffer::default(),
        limits: None,
        frame: 0,
        guide: Some(guide),
    }
}

/// What is asked of a draw so that traffic can go on.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Asked {
    All,
    /// That who drives can stop behind who is ahead.
    Headway,
    Nothing,
}

/// A state and its outline.
type Found = (QuantizedState, OrientedBox);

/// The drawn state, or the constraint it violates. The ego's box is given and therefore valid.
fn judge(query: &Query<'_, '_>, rules: &Rules, bins: &Bins, asked: Asked) -> Result<Found, String> {
    let state = state_of(bins);
    let prepared = query.partial.prepared;
    let (map, world_from_scene) = (&prepared.request.map, prepared.scene.world_from_scene);
    let outline = rules.outline(&state, map, world_from_scene);
    let broken = rules.broken(&state, &outline, map, world_from_scene);
    let holds_up = || holds_up_traffic(query, &state, &outline, asked);
    let broken = broken.or_else(holds_up);
    match broken {
        Some(clause) if !query.key.is_ego() || clause.starts_with("speed") => Err(clause),
        _ => Ok((state, outline)),
    }
}

/// Prompts that begin so ask for an ego that stands, or for a place where one does without a reason.
const STANDING: [&str; 6] = [
    "stationary",
    "waiting",
    "on_carpark",
    "on_pickup_dropoff",
    "low_magnitude_speed",
    "near_pedestrian_at_pickup_dropoff",
];

/// The reason for rejecting a vehicle that stands in a lane without cause, or that will meet another in
/// a junction, and an object before which another cannot stop, or the other way round. An ego whose
/// prompts ask for standing may stand.
fn holds_up_traffic(
    query: &Query<'_, '_>,
    state: &QuantizedState,
    outline: &OrientedBox,
    asked: Asked,
) -> Option<String> {
    let prepared = query.partial.prepared;
    let request = prepared.request;
    let stands = |tag: &ScenarioTag| STANDING.iter().any(|begin| tag.name().starts_with(begin));
    let is_told = request.ego.velocity.is_some() || request.prompts.iter().any(stands);
    let is_guided = request.config.placement == Placement::Guided;
    if !request.config.ready_to_drive || !is_guided || asked == Asked::Nothing {
        return None;
    }
    let may_stand = query.rules.spec.speed.is_some() || (query.key.is_ego() && is_told);
    let world = |own: &OrientedBox| OrientedBox {
        pose: prepared.scene.world_from_scene * own.pose,
        ..*own
    };
    let others: Vec<OrientedBox> = query.rules.taken.iter().map(world).collect();
    let (own, speed) = (world(outline), state.velocity().length());
    let (map, lights) = (&request.map, &request.lights);
    let in_world =
        |state: &QuantizedState| prepared.scene.world_from_scene.rotate(state.velocity());
    let is_on_foot = query.rules.kind == AgentKind::Pedestrian;
    let one = Moving {
        outline: own,
        velocity: in_world(state),
    };
    // Fixtures come after the agents, and stand.
    let agents = query.partial.agents.iter();
    let walks = agents
        .clone()
        .map(|agent| agent.key.kind == AgentKind::Pedestrian);
    let velocities = agents.map(|agent| in_world(&agent.state));
    let velocities = velocities.chain(std::iter::repeat(DVec2::ZERO));
    let walks = walks.chain(std::iter::repeat(false));
    let meets = |((outline, velocity), walks): ((&OrientedBox, DVec2), bool)| {
        let other = Moving {
            outline: *outline,
            velocity,
        };
        let runs_into = |one: &Moving, other: &Moving| one.runs_into(other, map);
        one.meets(&other)
            || !is_on_foot && runs_into(&one, &other)
            || !walks && runs_into(&other, &one)
    };
    // A gap that was asked for is kept.
    let is_free = query.rules.rows.is_empty();
    if is_free && others.iter().zip(velocities).zip(walks).any(meets) {
        return Some("speed: too fast to stop before another".into());
    }
    if is_on_foot || asked != Asked::All {
        return None;
    }
    if !may_stand && reason::stands_without(&own, speed, map, lights, &others) {
        return Some("speed: nothing holds it back".into());
    }
    reason::meets_in_junction(&own, map, &others)
        .then(|| "position: it meets another in a junction".into())
}
