//! Spawning: departures, arrivals and lights in futures of any length, decided by the network.
//!
//! All three use the network's logits. Before the agents of a frame are decoded, its lights are
//! drawn one after another (`lights`), and agents at the end of the map are drawn as present or
//! gone; after decoding, new agents are added as long as the network continues the list. Agents
//! that leave the window are removed.
//!
//! Agents do not appear or vanish in view: they enter over the border of the window, towards the
//! ego, or where a lane begins at the end of the map, and leave likewise, away from the ego. An
//! uncertain network assigns arrivals and departures to all agents, and training samples contain
//! false ones where they leave agents out. [`RateScale`](crate::RateScale) scales the rates of
//! arrivals and of changes of lights. `SamplingConfig::spawn` switches spawning on; benchmarks with
//! given agents leave it off.

mod lights;

use std::collections::BTreeSet;
use std::sync::Arc;

use gump_geometry::OrientedBox;
use gump_scene::{Agent, AgentId, AgentKind, AgentState, Frame, Light, Seed};
use gump_tokenizer::{Key, QuantizedState, TokenAgent, TokenFrame};

pub(crate) use crate::spawning::lights::Phases;
use gump_model::config::KEEP_RANGE_M;
use gump_model::decoder::STEPS;
use gump_model::local_frame::LocalFrame;
use gump_model::placed_slot::{PlacedSlot, place_exactly};

use crate::EngineError;
use crate::counters::CountedEngine;
use crate::cpu::{Job, KvCache};
use crate::nucleus::uniform;
use crate::partial_ar::{Window, present_all};
use crate::placement::births::{BEGIN_AT, next_key, stays};
use crate::placement::object_spec::{ObjectSpec, agent_of};
use crate::placement::rules::{Manner, Rules, box_of, state_of};
use crate::request::Request;
use crate::rollout_state::{RolloutState, stream};
use crate::scene::{SceneContext, sequence};
use crate::session::TransformerSession;
use crate::temporal_ensemble::ChunkBuffer;

/// Maximum number of agents that enter in one frame of a future. Each costs a pass; the log of
/// simulated scenes has one in two seconds (result 12), so this bounds runaways only.
const MOST_BIRTHS: usize = 4;
/// Number of draws of a new agent before it is dropped; drawn in one product, so that more cost
/// little. Not tuned.
const TRIES: u64 = 6;
/// No agent enters or leaves nearer to the ego than this, metres: half of the window, so that it
/// does not happen in view. Not tuned.
const SEEN_M: f64 = 50.0;

/// Gaps ahead and behind that a new vehicle or bicycle needs, metres, and what is left of a gap
/// where both stop; those of `gump_traffic::Arrivals`.
const LEAST_GAP_M: f64 = 7.0;
const LEAST_REAR_M: f64 = 10.0;
const LEFT_M: f64 = 2.0;
/// Braking with which a new agent and who is behind it can stop, m/s², and their headway, seconds.
const GENTLE_MPS2: f64 = 1.5;
const HEADWAY_S: f64 = 1.0;
/// Who is this near to the side of a new agent's way is in it, metres. Chosen by hand.
const BESIDE_M: f64 = 0.5;

/// The purpose of a decision, as the part of a seed; beyond the indices that other seeds are forked
/// by.
#[derive(Clone, Copy)]
enum About {
    Lights = 1001,
    Leaving = 1002,
    Coming = 1003,
}

impl TransformerSession<'_> {
    /// Draws the lights of the next frames and removes agents that have left.
    pub(crate) fn before_decoding(&mut self, windows: &mut [Window]) -> Result<(), EngineError> {
        let Some(engine) = &self.world.counted_engine(&self.counters) else {
            let what = "traffic lives";
            return Err(EngineError::NotOnCpu { what });
        };
        let block_size = self.world.network().config().block_size;
        let mut placed = present_all(windows, block_size)?;
        let mut kv_caches: Vec<KvCache> = self.futures.iter().map(|f| f.kv_cache.clone()).collect();
        self.draw_lights(engine, windows, &mut placed, &mut kv_caches);
        self.despawn(engine, windows, &placed, &mut kv_caches);
        Ok(())
    }

    /// Decides for every tracked agent except the ego whether it is still present; agents in view
    /// always are.
    fn despawn(
        &self,
        engine: &CountedEngine<'_>,
        windows: &mut [Window],
        placed: &[Vec<PlacedSlot>],
        kv_caches: &mut [KvCache],
    ) {
        let members: Vec<usize> = (0..windows.len())
            .filter(|w| windows[*w].next.tracked.len() > 1)
            .collect();
        let wanted: Vec<Vec<usize>> = members
            .iter()
            .map(|&w| {
                let n = windows[w].next.tracked.len();
                let first = placed[w].len() - 2 * n;
                (1..n).map(|i| first + 2 * i - 1).collect()
            })
            .collect();
        let hidden = self.run(engine, windows, placed, kv_caches, &members, &wanted);
        let mut successors = engine.successors(&hidden).into_iter();
        for &w in &members {
            let window = &mut windows[w];
            let scene = &self.scenes[window.scene];
            let ids: Vec<u16> = window.next.tracked.iter().map(|a| a.key.id).collect();
            let seed = self.futures[w].decision(About::Leaving);
            let places = window.next.tracked.iter();
            let places: Vec<_> = places
                .map(|a| (a.state.pose().position, a.key.kind))
                .collect();
            let mut kept = vec![true];
            for (i, &id) in ids.iter().enumerate().skip(1) {
                let successor = successors.next().expect("one word per tracked agent");
                let stay = stays(&successor, id, &ids[i + 1..]);
                let (place, kind) = places[i];
                let is_far = place.distance(places[0].0) >= SEEN_M;
                let may_leave = is_far && scene.ground(kind).ends_at(place);
                kept.push(!may_leave || uniform(seed.fork(u64::from(id))) < stay);
            }
            let mut of_agents = kept.iter();
            let mut of_requests = kept.iter();
            let keep = |next: Option<&bool>| next.copied().unwrap_or(true);
            window.next.tracked.retain(|_| keep(of_agents.next()));
            window.requests.retain(|_| keep(of_requests.next()));
        }
    }

    /// Hidden vectors of some windows at some slots, one pass for all.
    fn run(
        &self,
        engine: &CountedEngine<'_>,
        windows: &[Window],
        placed: &[Vec<PlacedSlot>],
        kv_caches: &mut [KvCache],
        members: &[usize],
        wanted: &[Vec<usize>],
    ) -> Vec<f32> {
        let of_members = kv_caches.iter_mut().enumerate();
        let mut wanted = members.iter().zip(wanted).peekable();
        let mut jobs = Vec::with_capacity(members.len());
        for (w, kv_cache) in of_members {
            let Some((_, wanted)) = wanted.next_if(|(member, _)| **member == w) else {
                continue;
            };
            let scene = &self.scenes[windows[w].scene];
            jobs.push(Job {
                slots: &placed[w],
                wanted: wanted.clone(),
                memory: scene
                    .memory
                    .packed()
                    .expect("with an engine the memory is the engine's"),
                kv_cache,
                keep: true,
            });
        }
        engine.run(&mut jobs)
    }

    /// Removes agents that left the window, sets the lights, and adds new agents; `frames` are
    /// those just committed.
    pub(crate) fn after_decoding(&mut self, frames: &mut [Frame]) -> Result<(), EngineError> {
        for (future, frame) in self.futures.iter_mut().zip(frames.iter_mut()) {
            let scene = &self.scenes[future.scene];
            *frame = future.without_the_gone(frame, scene);
        }
        let engine = self.world.counted_engine(&self.counters);
        let engine = &engine.expect("checked before decoding");
        let arrivals = self.world.sampling().spawn_rates.arrivals;
        let mut open: Vec<usize> = (0..self.futures.len()).collect();
        let mut kv_caches: Vec<KvCache> = self.futures.iter().map(|f| f.kv_cache.clone()).collect();
        for birth in 0..MOST_BIRTHS {
            let before = open.clone();
            let slots: Vec<Vec<PlacedSlot>> = before
                .iter()
                .map(|&f| self.futures[f].slots_to_end(&self.scenes[self.futures[f].scene]))
                .collect::<Result<_, _>>()?;
            let hidden = self.read(engine, &mut kv_caches, &before, &slots);
            let mut coming = Vec::new();
            for (&f, successor) in before.iter().zip(engine.successors(&hidden)) {
                let future = &mut self.futures[f];
                let longest = self.world.longest_frame();
                let seed = future.decision(About::Coming).fork(birth as u64);
                let last = future.frames.last().expect("a future has a present");
                let has_room = last.len_slots() + 2 <= longest;
                let used: BTreeSet<u16> = future.identities.iter().map(|(id, _)| id).collect();
                let before = last.newborn.last().map(|agent| agent.key);
                let key = next_key(&successor, BEGIN_AT, &used, before, seed, arrivals);
                match key.filter(|_| has_room) {
                    Some(key) => coming.push((f, key.kind, seed)),
                    None => open.retain(|open| *open != f),
                }
            }
            self.spawn(engine, &mut kv_caches, &mut open, coming, frames)?;
            if open.is_empty() {
                break;
            }
        }
        Ok(())
    }

    /// Hidden vectors at the last slot of some futures.
    fn read(
        &self,
        engine: &CountedEngine<'_>,
        kv_caches: &mut [KvCache],
        members: &[usize],
        slots: &[Vec<PlacedSlot>],
    ) -> Vec<f32> {
        let mut of_members = members.iter().zip(slots).peekable();
        let mut jobs = Vec::with_capacity(members.len());
        for (f, kv_cache) in kv_caches.iter_mut().enumerate() {
            let Some((_, slots)) = of_members.next_if(|(member, _)| **member == f) else {
                continue;
            };
            let memory = self.scenes[self.futures[f].scene].memory.packed();
            jobs.push(Job {
                slots,
                wanted: vec![slots.len() - 1],
                memory: memory.expect("with an engine the memory is the engine's"),
                kv_cache,
                keep: true,
            });
        }
        engine.run(&mut jobs)
    }

    /// Draws the states of new agents; an agent without a valid position is dropped, and no other
    /// enters in that frame.
    fn spawn(
        &mut self,
        engine: &CountedEngine<'_>,
        kv_caches: &mut [KvCache],
        open: &mut Vec<usize>,
        coming: Vec<(usize, AgentKind, Seed)>,
        frames: &mut [Frame],
    ) -> Result<(), EngineError> {
        let mut arriving = Vec::new();
        for (f, kind, seed) in coming {
            let future = &mut self.futures[f];
            let may_come = !self.scenes[future.scene].entries(kind).is_closed();
            // Agents that drifted in are in the list already, perhaps with higher ids than free.
            let newborn = future.frames.last().and_then(|now| now.newborn.last());
            let last = newborn.filter(|last| last.key.kind == kind);
            let last = last.map_or(0, |last| last.key.id);
            let newborn = may_come.then(|| future.identities.newborn_after(last));
            if let Some((id, agent)) = newborn.flatten() {
                arriving.push((f, Key { id, kind }, agent, seed));
            } else {
                open.retain(|open| *open != f);
            }
        }
        let members: Vec<usize> = arriving.iter().map(|(f, ..)| *f).collect();
        let slots: Vec<Vec<PlacedSlot>> = arriving
            .iter()
            .map(|(f, key, ..)| {
                let future = &self.futures[*f];
                future.slots_to_key(*key, &self.scenes[future.scene])
            })
            .collect::<Result<_, _>>()?;
        let hidden = self.read(engine, kv_caches, &members, &slots);
        let width = self.world.network().config().width;
        for ((f, key, agent, seed), hidden) in arriving.into_iter().zip(hidden.chunks(width)) {
            let future = &mut self.futures[f];
            let scene = &self.scenes[future.scene];
            let rules = Arc::new(future.rules(key.kind, scene));
            let requests: Vec<Request> = (0..TRIES)
                .map(|i| Request {
                    local_frame: LocalFrame::SCENE,
                    forced: [None; STEPS.len()],
                    stream: seed.fork(3).fork(i),
                    near: None,
                    ring: ChunkBuffer::default(),
                    limits: None,
                    frame: future.index,
                    guide: Some(Arc::clone(&rules) as _),
                })
                .collect();
            let requests: Vec<&Request> = requests.iter().collect();
            let bins = engine.sample(
                &hidden.repeat(TRIES as usize),
                &requests,
                self.world.sampling(),
            );
            let kept = bins.into_iter().find(|bins| {
                let state = state_of(bins);
                let ego = future.last_frame().and_then(|frame| frame.tracked.first());
                let ego = ego.map_or_else(Default::default, |ego| ego.state.pose().position);
                let is_far = state.pose().position.distance(ego) >= SEEN_M;
                let newborn = placed((agent, key.kind), &state, scene);
                is_far
                    && has_headway(&newborn, &frames[f])
                    && rules.enters(&state)
                    && rules
                        .broken(&state, &box_of(&state), &scene.map, scene.world_from_scene)
                        .is_none()
            });
            let Some(bins) = kept else {
                future.identities.retain(|id| id != key.id);
                open.retain(|open| *open != f);
                continue;
            };
            let state = state_of(&bins);
            let token = TokenAgent { key, state };
            future
                .rings
                .entry(key.id)
                .or_default()
                .push(future.index, LocalFrame::SCENE.poses(&bins));
            let now = future.frames.last_mut().expect("a future has a present");
            let now = Arc::make_mut(now);
            now.newborn.push(token);
            now.newborn.sort_by_key(|agent| agent.key);
            let mut agents = frames[f].agents().to_vec();
            agents.push(placed((agent, key.kind), &state, scene));
            frames[f] = Frame::new(agents, frames[f].lights().to_vec());
            if let Some(now) = future.recent.last_mut() {
                *now = frames[f].clone();
            }
        }
        Ok(())
    }
}

/// A new agent in the world.
fn placed((id, kind): (AgentId, AgentKind), state: &QuantizedState, scene: &SceneContext) -> Agent {
    let own = box_of(state);
    let state = AgentState {
        pose: scene.world_from_scene * state.pose(),
        velocity: scene.world_from_scene.rotate(state.velocity()),
    };
    agent_of(id, kind, [own.length, own.width], state, &scene.map)
}

/// Whether a new vehicle or bicycle has room to stop before whatever is ahead of it, and who moves
/// behind it has room to stop as well.
fn has_headway(newborn: &Agent, frame: &Frame) -> bool {
    let speed = newborn.state.speed();
    // That a gap is enough from one speed behind another.
    let suffices = |gap: f64, behind: f64, ahead: f64| {
        let room = (gap - LEFT_M).max(0.0);
        behind * HEADWAY_S <= room && behind * behind <= ahead * ahead + 2.0 * GENTLE_MPS2 * room
    };
    let has_room = |other: &Agent| {
        let local = newborn.state.pose.inverse() * other.state.pose.position;
        let beside = (newborn.width + other.width) / 2.0 + BESIDE_M;
        if local.y.abs() > beside {
            return true;
        }
        let gap = local.x.abs() - (newborn.length + other.length) / 2.0;
        let along = other.state.velocity.dot(newborn.state.pose.direction());
        let along = along.max(0.0);
        if local.x > 0.0 {
            gap >= LEAST_GAP_M && suffices(gap, speed, along)
        } else {
            !other.kind.is_moving() || gap >= LEAST_REAR_M && suffices(gap, along, speed)
        }
    };
    newborn.kind == AgentKind::Pedestrian || frame.agents().iter().all(has_room)
}

/// Index of BEGIN of a window's next frame; its lights follow.
fn first_slot(window: &Window, slots: &[PlacedSlot]) -> usize {
    // BEGIN, lights, LIGHTS_END, then two slots per tracked agent.
    slots.len() - 2 * window.next.tracked.len() - window.next.lights.len() - 2
}

impl RolloutState {
    /// Seed of the decisions of one kind in the frame in progress.
    fn decision(&self, about: About) -> Seed {
        stream(self.seed, self.index, 0).fork(about as u64)
    }

    /// The frame without the agents whose tokens were removed and those that move away outside the
    /// window, with its lights as drawn; their ids are free once no frame of the window has them.
    fn without_the_gone(&mut self, frame: &Frame, scene: &SceneContext) -> Frame {
        let n = self.frames.len();
        let ids = |frame: Option<&TokenFrame>| -> BTreeSet<u16> {
            let agents = frame.into_iter().flat_map(TokenFrame::agents);
            agents.map(|agent| agent.key.id).collect()
        };
        let (before, now) = (
            ids(n.checked_sub(2).map(|i| &*self.frames[i])),
            ids(self.last_frame()),
        );
        let gone = |id: &u16| before.contains(id) && !now.contains(id);
        let ego = frame.agent(scene.ego).map(|ego| scene.local(ego.state));
        let ego = ego.unwrap_or_default().pose.position;
        // A change of scenes leaves agents behind without a token, and they would drift on for ever.
        let drifts_off = |agent: &Agent| {
            let local = scene.local(agent.state);
            let at = local.pose.position;
            let is_beyond = at.abs().max_element() >= KEEP_RANGE_M;
            is_beyond && local.velocity.dot(at - ego) > 0.0
        };
        let stays = |agent: &&Agent| {
            let id = self.identities.key(agent.id);
            let has_token = id.is_some_and(|id| now.contains(&id));
            id == Some(0)
                || has_token
                || !agent.kind.is_moving()
                || !id.is_some_and(|id| gone(&id)) && !drifts_off(agent)
        };
        let agents = frame.agents().iter().filter(stays).copied().collect();
        let tokens = self.last_frame().map_or(&[][..], |frame| &frame.lights);
        let lights = frame.lights().iter().map(|light| {
            let index = scene.lights.iter().position(|lane| *lane == light.lane);
            let token = tokens
                .iter()
                .find(|token| index.is_some_and(|index| usize::from(token.index) == index + 1));
            Light {
                state: token.map_or(light.state, |token| token.state),
                ..*light
            }
        });
        let frame = Frame::new(agents, lights.collect());
        if let Some(now) = self.recent.last_mut() {
            *now = frame.clone();
        }
        let mut held: BTreeSet<u16> = self.frames.iter().flat_map(|f| ids(Some(f))).collect();
        let present = frame.agents().iter();
        held.extend(present.filter_map(|agent| self.identities.key(agent.id)));
        self.identities.retain(|id| held.contains(&id));
        frame
    }

    /// All slots of the window, the present frame included, up to where a new agent may come.
    fn slots_to_end(&self, scene: &SceneContext) -> Result<Vec<PlacedSlot>, EngineError> {
        let sequence = sequence(&self.frames)?;
        let exact = self.exact(scene);
        Ok(place_exactly(&sequence, |frame, id| exact.of(frame, id)))
    }

    /// The same with the key of a new agent after them.
    fn slots_to_key(&self, key: Key, scene: &SceneContext) -> Result<Vec<PlacedSlot>, EngineError> {
        let mut frames = self.frames.clone();
        let now = frames.last_mut().expect("a future has a present");
        Arc::make_mut(now).newborn.push(TokenAgent {
            key,
            state: Default::default(),
        });
        let sequence = sequence(&frames)?;
        let exact = self.exact(scene);
        let mut slots = place_exactly(&sequence, |frame, id| exact.of(frame, id));
        slots.pop();
        Ok(slots)
    }

    /// The constraints of a new agent: positions where lanes or walkways enter the window, clear of
    /// all agents and things of the present, with tokens or without.
    pub(crate) fn rules(&self, kind: AgentKind, scene: &SceneContext) -> Rules {
        let scene_from_world = scene.world_from_scene.inverse();
        let local = |agent: &Agent| {
            let own = agent.oriented_box();
            OrientedBox {
                pose: scene_from_world * own.pose,
                ..own
            }
        };
        let now = self.recent.last().map_or(&[][..], Frame::agents);
        let taken: Vec<OrientedBox> = now.iter().map(local).collect();
        let ego = self.last_frame().and_then(|frame| frame.tracked.first());
        let ego = ego.map(|ego| (ego.state.pose().position, ego.state.velocity()));
        Rules {
            kind,
            spec: ObjectSpec::default(),
            ground: Some(scene.entries(kind)),
            rows: Vec::new(),
            taken,
            comes_to: ego,
            is_guided: true,
            manner: Manner::default(),
            places: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use gump_scene::fixture;

    use super::*;

    /// Whether vehicle 1 may enter where it is, at 10 m/s, with another object of the scene.
    fn may_enter(other: &str) -> bool {
        let text =
            format!("ego vehicle 0: 0,0\nagent vehicle 1: -90,0 velocity 10,0 size 4,2\n{other}");
        let scenario = fixture::scenario(&text).unwrap();
        let now = scenario.present().now();
        let newborn = now.agent(AgentId(1)).unwrap();
        let others = now.agents().iter().filter(|agent| agent.id.0 > 1);
        has_headway(newborn, &Frame::new(others.copied().collect(), Vec::new()))
    }

    #[test]
    fn who_enters_has_room_ahead_and_behind() {
        // 10 m/s take 33 m to stop, and 2 m are left.
        assert!(!may_enter("agent cone 2: -60,0") && may_enter("agent cone 2: -50,0"));
        assert!(may_enter("agent cone 2: -60,2.2") && may_enter("agent cone 2: -95,0"));
        // Behind one that goes as fast a second is enough.
        assert!(may_enter("agent vehicle 2: -73,0 velocity 10,0 size 4,2"));
        assert!(!may_enter("agent vehicle 2: -76,0 velocity 10,0 size 4,2"));
        // One that comes from behind.
        assert!(!may_enter("agent vehicle 2: -110,0 velocity 15,0 size 4,2"));
        assert!(may_enter("agent vehicle 2: -150,0 velocity 15,0 size 4,2"));
        assert!(!may_enter("agent vehicle 2: -102,0 size 4,2"));
    }
}
