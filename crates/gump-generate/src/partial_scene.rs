//! A scene during generation: objects already placed, and those to come.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use gump_engine::cpu::{KvCache, Successor};
use gump_engine::placement::births;
use gump_engine::placement::births::NEWBORN_AT;
use gump_engine::placement::network::PlacementScorer;
use gump_engine::placement::object_spec::{Bounds, ObjectSpec, agent_of};
use gump_engine::placement::places::{PlacedVehicle, Places, Traffic};
use gump_engine::placement::rules::{PlaceDraw, Rules};
use gump_geometry::{DVec2, OrientedBox, Pose};
use gump_model::decoder::{STATE_STEPS, STEPS};
use gump_scene::{Agent, AgentId, AgentKind, Frame, Seed};
use gump_tokenizer::{AGENT_KEYS, Field, Key, QuantizedState, TokenAgent, class_index};
use rand::seq::SliceRandom;

use crate::constraint::EGO;
use crate::prepared::Prepared;
use crate::{GenerateError, GeneratedScene, latin_hypercube};

/// A velocity within bounds of the speed. Vehicles and bicycles move where they face: the grid of
/// velocities is too coarse for the direction of slow ones.
fn bounded(velocity: DVec2, bounds: Bounds, kind: AgentKind, pose: Pose) -> DVec2 {
    let speed = velocity.length().clamp(bounds.low, bounds.high);
    let walks = kind == AgentKind::Pedestrian;
    let way = velocity.try_normalize().filter(|_| walks);
    way.unwrap_or_else(|| pose.direction()) * speed
}

/// One scene during generation.
pub(crate) struct PartialScene<'a> {
    pub(super) prepared: &'a Prepared<'a>,
    seed: Seed,
    restart: usize,
    pub(super) redraws: usize,
    pub(super) agents: Vec<TokenAgent>,
    boxes: Vec<OrientedBox>,
    named: BTreeMap<String, usize>,
    /// Keys still to come, where their number is given.
    keys: VecDeque<Key>,
    /// Objects with constraints still to come, in canonical order.
    wished: VecDeque<&'a ObjectSpec>,
    pub(super) kv_cache: KvCache,
    pub(super) outcome: Option<Result<(), GenerateError>>,
}

impl<'a> PartialScene<'a> {
    pub(crate) fn new(prepared: &'a Prepared<'a>, seed: Seed) -> Self {
        let mut partial = Self {
            prepared,
            seed,
            restart: 0,
            redraws: 0,
            agents: Vec::new(),
            boxes: Vec::new(),
            named: BTreeMap::new(),
            keys: VecDeque::new(),
            wished: VecDeque::new(),
            kv_cache: KvCache::default(),
            outcome: None,
        };
        partial.begin();
        partial
    }

    /// Clears the scene for another start.
    fn begin(&mut self) {
        self.agents.clear();
        self.boxes.clear();
        self.named.clear();
        let mut wished: Vec<&ObjectSpec> = self.prepared.objects.iter().collect();
        wished.retain(|object| object.id != EGO);
        wished.sort_by_key(|object| object.class.kind());
        self.wished = wished.into();
        self.keys.clear();
        if let Some(counts) = &self.prepared.request.counts {
            // In training ids are drawn at random, so they are here.
            let mut ids: Vec<u16> = AGENT_KEYS.map(|id| id as u16).collect();
            ids.shuffle(&mut self.stream(0).rng());
            let mut ids = ids.into_iter();
            for kind in AgentKind::MOVING {
                let mut own: Vec<u16> = ids.by_ref().take(counts.of(kind)).collect();
                own.sort_unstable();
                self.keys.extend(own.into_iter().map(|id| Key { id, kind }));
            }
        }
    }

    /// Seed of one decision of this scene.
    pub(super) fn stream(&self, what: u64) -> Seed {
        self.seed.fork(self.restart as u64).fork(what)
    }

    /// The network's decision on the next object, unless it is given; `None` ends the scene.
    pub(super) fn next_key(&mut self, successor: Option<&Successor>) -> Option<Key> {
        if self.agents.is_empty() {
            let kind = AgentKind::Vehicle;
            return Some(Key { id: 0, kind });
        }
        let Some(successor) = successor else {
            return self.keys.pop_front();
        };
        let due = self.wished.front().map(|object| object.class.kind());
        // What was asked for comes all the same.
        let is_full = self.agents.len() > self.prepared.request.config.max_agents;
        if is_full && due.is_none() {
            return None;
        }
        let used: BTreeSet<u16> = self.agents.iter().map(|agent| agent.key.id).collect();
        // The ego heads the list but does not bound the ids after it.
        let last = self.agents.last().map(|agent| agent.key);
        let last = last.filter(|key| !key.is_ego());
        let seed = self.stream(2 * self.agents.len() as u64 + 1);
        let drawn = births::next_key(successor, NEWBORN_AT, &used, last, seed, 1.0);
        let Some(due) = due else {
            return drawn;
        };
        // A requested object comes first in its class, or at the latest then.
        if !is_full && drawn.is_some_and(|key| key.kind < due) {
            return drawn;
        }
        let after = last
            .filter(|last| last.kind == due)
            .map_or(1, |last| last.id + 1);
        let free = (after..=*AGENT_KEYS.end() as u16).find(|id| !used.contains(id));
        free.map(|id| Key { id, kind: due })
    }

    /// Whether the network decides which object comes next.
    pub(super) fn asks(&self) -> bool {
        self.prepared.request.counts.is_none() && !self.agents.is_empty()
    }

    /// The constraints of the object with this key, which is next.
    pub(super) fn rules(&self, key: Key) -> Rules {
        let none = ObjectSpec::default();
        let spec = if key.is_ego() {
            let objects = &self.prepared.objects;
            objects.iter().find(|object| object.id == EGO)
        } else {
            let front = self.wished.front().copied();
            front.filter(|object| object.class.kind() == key.kind)
        };
        let mut spec = spec.unwrap_or(&none).clone();
        if key.is_ego() {
            // It defines the frame of reference, so no object can be there before it.
            let zero = Bounds::new(0.0, 0.0);
            (spec.x, spec.y, spec.heading) = (Some(zero), Some(zero), Some(zero));
            (spec.behind, spec.ahead_of) = (None, None);
        }
        let mut taken = self.boxes.clone();
        if !key.is_ego() {
            taken.extend_from_slice(&self.prepared.fixtures);
        }
        let mut rules = self.prepared.rules(key.kind, &spec, &taken, &self.named);
        rules.manner.numbers = self.numbers(key);
        let drawn = !key.is_ego() && rules.kind == AgentKind::Vehicle && rules.rows.is_empty();
        if let Some((places, likely)) = self.prepared.places.as_ref().filter(|_| drawn) {
            rules.places = rules.ground.as_ref().map(|_| {
                let traffic = Arc::new(self.traffic(places));
                PlaceDraw::new(
                    PlacementScorer::shipped(),
                    (Arc::clone(places), Arc::clone(likely)),
                    traffic,
                    self.prepared.request.config.parks_off_road,
                    self.stream(2 * self.agents.len() as u64 + 2),
                )
            });
        }
        rules
    }

    /// The vehicles that are already placed.
    fn traffic(&self, places: &Places) -> Traffic {
        let placed = self.agents.iter().zip(&self.boxes);
        let vehicles = placed.filter(|(agent, _)| agent.key.kind == AgentKind::Vehicle);
        let vehicles = vehicles.map(|(agent, outline)| PlacedVehicle {
            outline: *outline,
            speed: agent.state.velocity().length(),
        });
        Traffic::new(places, vehicles.collect())
    }

    /// The stratified numbers for the first draw of the object with this key, which is next.
    fn numbers(&self, key: Key) -> Option<[f64; STATE_STEPS]> {
        let request = self.prepared.request;
        let n = request.counts.as_ref()?.of(key.kind);
        let others = self.agents.iter().map(|agent| agent.key);
        let before = others.filter(|other| !other.is_ego() && other.kind == key.kind);
        let i = before.count();
        // The scene's own stream 0 has drawn the ids.
        let seed = self.stream(0).fork(1 + class_index(key.kind) as u64);
        let evenly = request.config.even && !key.is_ego() && i < n;
        evenly.then(|| latin_hypercube::numbers(seed, i, n))
    }

    /// The given values of the ego, per step of the decoder.
    pub(super) fn given(&self, key: Key) -> [Option<u16>; STEPS.len()] {
        let mut forced = [None; STEPS.len()];
        if key.is_ego() {
            let ego = self.prepared.scene.history[0].tracked[0].state;
            let moves = self.prepared.request.ego.velocity.is_some();
            for (step, field) in STEPS.iter().enumerate().take(7) {
                let is_motion = step == 2 || step == 3;
                forced[step] = (!is_motion || moves).then(|| ego.get(*field));
            }
        }
        forced
    }

    /// Adds an object, with its box as [`Rules::outline`] computes it.
    pub(super) fn accept(&mut self, key: Key, mut state: QuantizedState, outline: OrientedBox) {
        if !key.is_ego()
            && self
                .wished
                .front()
                .is_some_and(|o| o.class.kind() == key.kind)
        {
            let object = self.wished.pop_front().expect("there is a front");
            self.named.insert(object.id.clone(), self.agents.len());
        } else if key.is_ego() {
            self.named.insert(EGO.to_owned(), 0);
        }
        // Later objects see the velocity that the scene will have.
        let is_given = key.is_ego() && self.prepared.request.ego.velocity.is_some();
        if let Some(bounds) = self.speed(self.agents.len()).filter(|_| !is_given) {
            let velocity = bounded(state.velocity(), bounds, key.kind, outline.pose);
            for (field, value) in [
                (Field::VelocityX, velocity.x),
                (Field::VelocityY, velocity.y),
            ] {
                state.set(field, field.quantize(value).bin);
            }
        }
        self.agents.push(TokenAgent { key, state });
        self.boxes.push(outline);
    }

    /// The speed that is asked of the object at an index.
    fn speed(&self, i: usize) -> Option<Bounds> {
        let is_named = |object: &&ObjectSpec| self.named.get(&object.id) == Some(&i);
        self.prepared.objects.iter().find(is_named)?.speed
    }

    /// Starts again, or gives up with the most frequent violation.
    pub(super) fn fail(&mut self, key: Key, broken: &[String]) {
        let config = &self.prepared.request.config;
        if self.restart < config.restarts {
            self.restart += 1;
            self.begin();
            return;
        }
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        for clause in broken {
            *counts.entry(clause).or_default() += 1;
        }
        let worst = counts.into_iter().max_by_key(|(_, n)| *n);
        let wished = self.wished.front().filter(|o| o.class.kind() == key.kind);
        self.outcome = Some(Err(GenerateError::NoPlace {
            object: match wished {
                _ if key.is_ego() => "the ego".into(),
                Some(object) => format!("\"{}\"", object.id),
                None => format!("a {}", key.kind.name()),
            },
            scenes: self.restart + 1,
            tries: config.tries,
            clause: worst.map_or(String::new(), |(clause, _)| clause.to_owned()),
        }));
    }

    pub(crate) fn finish(mut self) -> Result<GeneratedScene, GenerateError> {
        self.outcome.take().unwrap_or(Ok(()))?;
        let Prepared { request, scene, .. } = self.prepared;
        let world_from_scene = scene.world_from_scene;
        let to_world = |(i, token): (usize, &TokenAgent)| {
            let mut state = token.state.to_agent_state();
            let own = self.boxes[i];
            state.pose = world_from_scene * own.pose;
            state.velocity = world_from_scene.rotate(state.velocity);
            let mut size = [own.length, own.width];
            // What is given is kept exactly, not to the grid.
            if i == 0 {
                size = [request.ego.length, request.ego.width];
                state.pose = request.ego.pose;
            }
            if let Some(bounds) = self.speed(i) {
                state.velocity = bounded(state.velocity, bounds, token.key.kind, state.pose);
            }
            if i == 0 {
                state.velocity = request.ego.velocity.unwrap_or(state.velocity);
            }
            agent_of(AgentId(i as i64), token.key.kind, size, state, &request.map)
        };
        let mut agents: Vec<Agent> = self.agents.iter().enumerate().map(to_world).collect();
        let next = agents.len() as i64;
        let fixtures = request.fixtures.iter().zip(next..);
        agents.extend(fixtures.map(|(agent, id)| Agent {
            id: AgentId(id),
            ..*agent
        }));
        Ok(GeneratedScene {
            frame: Frame::new(agents, request.lights.clone()),
            ego: AgentId(0),
            names: self
                .named
                .into_iter()
                .map(|(name, i)| (name, AgentId(i as i64)))
                .collect(),
            redraws: self.redraws,
            restarts: self.restart,
        })
    }
}
