//! The memory of an agent during a rollout: its last frames and their keys and values.

use gump_geometry::{DVec2, Pose};
use gump_model::relative::graph::{Body, Lights, PAST, Shown, look, past_edge};
use gump_model::relative::map::VectorMap;
use gump_model::relative::route::Route;
use gump_scene::AgentKind;

use crate::relative::engine::{AgentMemory, KEPT, MapMemory, Present, RelativeEngine};

/// An agent with its observed frames.
#[derive(Clone, Debug)]
pub struct ObservedAgent {
    /// The last frames without a gap, the latest last; at least one, at most [`KEPT`].
    shown: Vec<Shown>,
    memory: AgentMemory,
    /// Where it means to go, if the network is told.
    route: Option<Route>,
    /// Whether a vehicle without a reason to slow down is shown without its past, though it is not late.
    hides_free_past: bool,
}

impl ObservedAgent {
    /// An agent in its first frame, with its stated velocity, world frame, metres per second.
    pub fn first(engine: &RelativeEngine, body: Body, pose: Pose, velocity: DVec2) -> Self {
        Self {
            shown: vec![Shown::first(body, pose, velocity)],
            memory: engine.blank(),
            route: None,
            hides_free_past: false,
        }
    }

    /// Its last state.
    pub fn now(&self) -> Shown {
        *self.shown.last().expect("an agent has been seen")
    }

    /// Limits the known standing time, seconds.
    pub fn has_stood_at_most(&mut self, seconds: f64) {
        if let Some(now) = self.shown.last_mut() {
            *now = now.stood_at_most(seconds);
        }
    }

    /// Forgets its past: it is shown as seen for the first time, at this speed, metres per second.
    pub fn restart(&mut self, engine: &RelativeEngine, speed: f64) {
        let now = self.now();
        let velocity = now.pose.direction() * speed;
        *self = Self {
            route: self.route.take(),
            ..Self::first(engine, now.body, now.pose, velocity)
        };
    }

    /// Turns it on the spot to this heading, radians.
    pub fn turn_to(&mut self, heading: f64) {
        if let Some(now) = self.shown.last_mut() {
            now.pose.heading = heading;
        }
    }

    /// Where it means to go, if the network is told.
    pub fn route(&self) -> Option<&Route> {
        self.route.as_ref()
    }

    /// Sets where it means to go, which the network is told from now on.
    pub fn head_for(&mut self, route: Option<Route>) {
        self.route = route;
    }

    /// Sets whether a vehicle is shown without its past where it has no reason to slow down, though it is
    /// not late: training shows in part of its frames what long rollouts show.
    pub fn hide_free_past(&mut self, hides: bool) {
        self.hides_free_past = hides;
    }

    /// Advances by half a second to this pose.
    pub fn push(&mut self, pose: Pose) {
        self.shown.push(self.now().then(pose));
        let n = self.shown.len();
        self.shown.drain(..n.saturating_sub(KEPT));
    }
}

/// A frame of a future.
#[derive(Clone, Copy, Debug)]
pub struct FrameIndex {
    /// Its index.
    pub t: usize,
    /// Whether the rollout is so long that vehicles without a reason to slow down are shown without
    /// their past.
    pub is_late: bool,
}

/// Adds the network's inputs for the agents of a frame.
///
/// An agent's past are its own draws: a vehicle that happened to slow down is expected to go on
/// slowing down, and stops on a free road. Without the past it returns to its speed (result 23).
pub fn add_presents<'a>(
    (map, memory): (&VectorMap, &'a MapMemory),
    lights: &Lights,
    seen: impl Iterator<Item = &'a mut ObservedAgent>,
    frame: FrameIndex,
    presents: &mut Vec<Present<'a>>,
) {
    let first = presents.len();
    let seen: Vec<&mut ObservedAgent> = seen.collect();
    let agents: Vec<Shown> = seen.iter().map(|seen| seen.now()).collect();
    presents.extend(seen.into_iter().enumerate().map(|(i, seen)| {
        let now = &agents[i];
        let mut view = look(map, lights, &agents, i, seen.route.as_ref());
        let is_vehicle = now.body.kind == AgentKind::Vehicle;
        let hides = frame.is_late || seen.hides_free_past;
        let past = match hides && is_vehicle && view.is_free(now) {
            true => 0,
            false => PAST,
        };
        let past = seen.shown.iter().rev().take(past + 1).enumerate();
        view.neighbours.iter_mut().for_each(|(j, _)| *j += first);
        Present {
            numbers: now.numbers(),
            past: past.map(|(ago, then)| past_edge(now, then, ago)).collect(),
            view,
            memory: &mut seen.memory,
            map: memory,
            t: frame.t,
        }
    }));
}
