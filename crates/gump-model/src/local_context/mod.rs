//! Local contexts: an object's view in its own frame, as numbers: its motion, the paths it may
//! follow, the lanes beside it, and its neighbours.
//!
//! In the paper the map is an image of the whole scene, and objects are given by their positions in
//! it. With little data and a small network it is much more effective to give every object its
//! surroundings in its own frame, independent of position and direction. The context at a key
//! contains what the window showed before it: the states of the previous frame and the lights of
//! the key's own frame.
//!
//! Lengths are divided by a typical one, so that numbers stay within a few units of zero; absent
//! items are zeros. Unknown values are not zeros: they have a default value, and with
//! `unknown_marks` a mark beside it.

mod edges;
mod lane_map;
#[cfg(test)]
#[cfg(feature = "tensors")]
mod tests;

use gump_geometry::{DVec2, Pose, angle_difference};
use gump_scene::{AgentKind, LightState, TYPICAL_SPEED_LIMIT};
use gump_tokenizer::{Field, Key, QuantizedState, Slot, TokenLight, class_index};

use self::lane_map::{LANE_STEP_M, N_PATHS, PATH_POINTS};
use crate::ModelConfig;
use crate::exact::Exact;
use crate::placed_slot::PlacedSlot;

pub use self::edges::{Edge, metres_across, metres_off};
pub use self::lane_map::LaneMap;

// Numbers of items and reaches were chosen by hand to keep a context short; none was varied by
// itself (result 16 has the effect of all). The weights fix them.

/// Points of a path, as indices: 0, 4, 8, 14, 22, 32 and 44 m ahead, dense where it bends first.
const SHOWN: [usize; 7] = [0, 2, 4, 7, 11, 16, 22];
/// Per path: whether it exists, four numbers per point, speed limit, light, stop sign, the object
/// ahead.
const PATH_NUMBERS: usize = 1 + 4 * SHOWN.len() + 1 + 4 + 2 + 3;
/// Number of neighbours, the nearest ones.
const N_NEIGHBOURS: usize = 8;
/// Per neighbour: whether it exists, position, direction, velocity, size, two marks of its class.
const NEIGHBOUR_NUMBERS: usize = 11;
/// Maximum distance of a neighbour, metres.
const NEIGHBOUR_REACH_M: f64 = 60.0;
/// Directions in which the distance to the nearest road edge is given: every 30 degrees.
const SECTORS: usize = 12;
/// Maximum distance of a road edge, metres.
const EDGE_REACH_M: f64 = 20.0;
/// Own motion: velocity, size, class, and the previous step.
const OWN_NUMBERS: usize = 11;
/// To the left and to the right: whether there is a lane, its distance and direction.
const BESIDE_NUMBERS: usize = 6;

/// Length of a local context without the marks.
const N_PLAIN: usize = OWN_NUMBERS
    + N_PATHS * PATH_NUMBERS
    + BESIDE_NUMBERS
    + SECTORS
    + N_NEIGHBOURS * NEIGHBOUR_NUMBERS;
/// Marks of unknown inputs, after all others: the limit of each path, stop signs, lights, the
/// object's own size and that of each neighbour.
const N_MARKS: usize = N_PATHS + 2 + 1 + N_NEIGHBOURS;

/// Length of a local context, including the marks.
pub type LocalContext = [f32; N_PLAIN + N_MARKS];

/// The length of the part of a local context that such a network uses.
pub fn n_numbers(config: &ModelConfig) -> usize {
    if config.unknown_marks {
        N_PLAIN + N_MARKS
    } else {
        N_PLAIN
    }
}

/// An object as the window shows it.
#[derive(Clone, Copy, Debug)]
pub struct ObservedObject {
    key: Key,
    pose: Pose,
    velocity: DVec2,
    length: f64,
    width: f64,
    has_size: bool,
}

impl ObservedObject {
    fn new(key: Key, state: QuantizedState, exact: Option<Exact>) -> Self {
        if let Some(exact) = exact {
            let [length, width] = exact.size();
            return Self {
                key,
                pose: exact.pose(),
                velocity: exact.velocity(),
                length,
                width,
                has_size: exact.has_size,
            };
        }
        let size = |field: Field| field.dequantize(state.get(field));
        Self {
            key,
            pose: state.pose(),
            velocity: state.velocity(),
            length: size(Field::Length),
            width: size(Field::Width),
            has_size: true,
        }
    }
}

/// The local contexts of the objects at the keys from slot `from` on, each with its slot; a key
/// whose object the window has not shown before has none.
pub fn encode_local_context(
    lane_map: &LaneMap,
    slots: &[PlacedSlot],
    from: usize,
) -> Vec<(usize, LocalContext)> {
    let mut seen = Vec::new();
    let mut frame = None;
    // The last frame that showed anybody before the present one, and the present one.
    let (mut others, mut now): (Vec<ObservedObject>, Vec<ObservedObject>) =
        (Vec::new(), Vec::new());
    let mut before: Vec<Option<Pose>> = Vec::new();
    let mut lights: Vec<TokenLight> = Vec::new();
    for (i, placed) in slots.iter().enumerate() {
        if frame != Some(placed.frame) {
            frame = Some(placed.frame);
            if !now.is_empty() {
                for seen in &others {
                    let id = usize::from(seen.key.id);
                    before.resize(before.len().max(id + 1), None);
                    before[id] = Some(seen.pose);
                }
                others = std::mem::take(&mut now);
            }
            lights.clear();
        }
        match (placed.slot, placed.key) {
            (Slot::Light(light), _) => lights.push(light),
            (Slot::Value(state), Some(key)) => {
                now.push(ObservedObject::new(key, state, placed.exact));
            }
            (Slot::Key(key), _) if i >= from => {
                if let Some(last) = placed.last {
                    let scene = Around {
                        lane_map,
                        others: &others,
                        lights: &lights,
                    };
                    let earlier = before.get(usize::from(key.id)).copied().flatten();
                    seen.push((
                        i,
                        scene.of(ObservedObject::new(key, last, placed.exact), earlier),
                    ));
                }
            }
            _ => {}
        }
    }
    seen
}

/// Surroundings of the objects of a frame.
struct Around<'a> {
    lane_map: &'a LaneMap,
    others: &'a [ObservedObject],
    lights: &'a [TokenLight],
}

impl Around<'_> {
    fn of(&self, own: ObservedObject, earlier: Option<Pose>) -> LocalContext {
        let mut all = [0.0; N_PLAIN + N_MARKS];
        let (numbers, marks) = all.split_at_mut(N_PLAIN);
        let mut writer = Writer(numbers);
        let own_from_scene = own.pose.inverse();
        own_motion(writer.next(OWN_NUMBERS), &own, earlier);
        // People on foot follow no lane.
        let paths = if own.key.kind == AgentKind::Pedestrian {
            Vec::new()
        } else {
            self.lane_map.paths(own.pose)
        };
        for i in 0..N_PATHS {
            let out = writer.next(PATH_NUMBERS);
            if let Some(path) = paths.get(i) {
                self.path(path, &own, own_from_scene, out);
            }
        }
        self.beside(
            &paths,
            own_from_scene,
            own.pose,
            writer.next(BESIDE_NUMBERS),
        );
        self.edges(own_from_scene, own.pose.position, writer.next(SECTORS));
        let near = self.nearest(&own);
        neighbours(&near, own_from_scene, &mut writer);
        self.mark(&own, &paths, &near, marks);
        all
    }

    /// Sets the marks of unknown inputs.
    fn mark(
        &self,
        own: &ObservedObject,
        paths: &[lane_map::Path],
        near: &[&ObservedObject],
        marks: &mut [f32],
    ) {
        let mark = |is_unknown: bool| f64::from(u8::from(is_unknown));
        let mut writer = Writer(marks);
        for i in 0..N_PATHS {
            let limit = paths.get(i).map(|path| self.lane_map.limit_at(path[0]));
            writer.put([mark(limit == Some(None))]);
        }
        let unstated = self.lane_map.unstated;
        writer.put([
            mark(unstated.stop_signs),
            mark(unstated.lights),
            mark(!own.has_size),
        ]);
        for i in 0..N_NEIGHBOURS {
            writer.put([mark(near.get(i).is_some_and(|other| !other.has_size))]);
        }
    }

    fn path(&self, path: &[u32], own: &ObservedObject, own_from_scene: Pose, out: &mut [f32]) {
        let mut writer = Writer(out);
        writer.put([1.0]);
        for shown in SHOWN {
            let out = writer.next(4);
            if let Some(&index) = path.get(shown) {
                let pose = own_from_scene * self.lane_map.point(index).pose;
                let direction = pose.direction();
                Writer(out).put([
                    pose.position.x / 20.0,
                    pose.position.y / 10.0,
                    direction.x,
                    direction.y,
                ]);
            }
        }
        let limit = self.lane_map.limit_at(path[0]);
        writer.put([limit.unwrap_or(TYPICAL_SPEED_LIMIT) / 15.0]);
        let away = |step: usize| step as f64 * LANE_STEP_M;
        let nearness = |metres: f64| 1.0 - metres / away(PATH_POINTS);
        let light = path.iter().enumerate().find_map(|(step, &index)| {
            let light = self
                .light_at(index)
                .filter(|_| step > 0 && self.lane_map.is_start(index))?;
            Some((away(step), light))
        });
        let out = writer.next(4);
        if let Some((away, state)) = light {
            let is = |wanted: LightState| f64::from(u8::from(state == wanted));
            Writer(out).put([
                nearness(away),
                is(LightState::Red),
                is(LightState::Yellow),
                is(LightState::Green),
            ]);
        }
        let sign = path.iter().position(|&index| self.lane_map.is_stop(index));
        let out = writer.next(2);
        if let Some(step) = sign {
            Writer(out).put([1.0, nearness(away(step))]);
        }
        let out = writer.next(3);
        if let Some((step, ahead)) = self.ahead_on(path, own) {
            let along = self.lane_map.point(path[step]).pose.direction();
            let gap = away(step) - (own.length + ahead.length) / 2.0;
            Writer(out).put([
                nearness(gap.max(0.0)),
                gap / 20.0,
                ahead.velocity.dot(along) / 10.0,
            ]);
        }
    }

    /// The colour of the light at the start of a lane.
    fn light_at(&self, index: u32) -> Option<LightState> {
        let start = self.lane_map.point(index).pose;
        let at_start = |light: &&TokenLight| {
            let place =
                gump_geometry::dvec2(Field::X.dequantize(light.x), Field::Y.dequantize(light.y));
            let turn = angle_difference(Field::Heading.dequantize(light.heading), start.heading);
            // Tokens are rounded to 0.1 m and 0.9 degrees; other lanes begin elsewhere or turned
            // away.
            place.distance(start.position) < 0.5 && turn.abs() < 0.3
        };
        Some(self.lights.iter().find(at_start)?.state)
    }

    /// The first object on a path, and the step of the path it is at.
    fn ahead_on(&self, path: &[u32], own: &ObservedObject) -> Option<(usize, &ObservedObject)> {
        let reach = PATH_POINTS as f64 * LANE_STEP_M + 10.0;
        let near = self.others.iter().filter(|other| {
            other.key.id != own.key.id && other.pose.position.distance(own.pose.position) < reach
        });
        let on_path = near.filter_map(|other| {
            // 0.3 m beside it is no room to pass.
            let clear = (own.width + other.width) / 2.0 + 0.3;
            let distance = |index: u32| {
                self.lane_map
                    .point(index)
                    .pose
                    .position
                    .distance_squared(other.pose.position)
            };
            let (step, &nearest) = path
                .iter()
                .enumerate()
                .min_by(|a, b| distance(*a.1).total_cmp(&distance(*b.1)))?;
            let local = self.lane_map.point(nearest).pose.inverse() * other.pose.position;
            let is_ahead = step > 0 && local.x.abs() < 0.5 * LANE_STEP_M + 0.5 * other.length;
            (is_ahead && local.y.abs() < clear).then_some((step, other))
        });
        on_path.min_by_key(|(step, other)| (*step, other.key.id))
    }

    /// The nearest lanes to the left and to the right that no path follows.
    fn beside(&self, paths: &[lane_map::Path], own_from_scene: Pose, own: Pose, out: &mut [f32]) {
        let mut nearest: [Option<(f64, f64)>; 2] = [None, None];
        let followed = |lane: u32| {
            paths
                .iter()
                .any(|path| self.lane_map.point(path[0]).lane == lane)
        };
        // The next lane, up to wide ones with a line in between.
        for index in self.lane_map.lanes_near(own.position, 6.0) {
            let point = self.lane_map.point(index);
            let local = own_from_scene * point.pose.position;
            if local.x.abs() > LANE_STEP_M || local.y.abs() > 6.0 || followed(point.lane) {
                continue;
            }
            let side = &mut nearest[usize::from(local.y < 0.0)];
            if side.is_none_or(|(y, _)| local.y.abs() < y.abs()) {
                *side = Some((
                    local.y,
                    angle_difference(point.pose.heading, own.heading).cos(),
                ));
            }
        }
        for (side, out) in nearest.into_iter().zip(out.chunks_exact_mut(3)) {
            if let Some((y, along)) = side {
                Writer(out).put([1.0, y / 5.0, along]);
            }
        }
    }

    /// Writes the proximity of road edges in each direction, 1 at the object and 0 out of reach.
    fn edges(&self, own_from_scene: Pose, position: DVec2, out: &mut [f32]) {
        let mut nearest = [EDGE_REACH_M * EDGE_REACH_M; SECTORS];
        for edge in self.lane_map.edges_near(position, EDGE_REACH_M) {
            let local = own_from_scene * edge.from;
            let away = local.length_squared();
            if away < EDGE_REACH_M * EDGE_REACH_M {
                let turns = local.y.atan2(local.x) / std::f64::consts::TAU;
                let sector = (turns * SECTORS as f64).round().rem_euclid(SECTORS as f64) as usize;
                nearest[sector] = nearest[sector].min(away);
            }
        }
        for (out, away) in out.iter_mut().zip(nearest) {
            *out = (1.0 - away.sqrt() / EDGE_REACH_M) as f32;
        }
    }

    /// The nearest of the others, the nearest first.
    fn nearest(&self, own: &ObservedObject) -> Vec<&ObservedObject> {
        let mut near: Vec<(f64, &ObservedObject)> = self
            .others
            .iter()
            .filter(|other| other.key.id != own.key.id)
            .map(|other| {
                (
                    other.pose.position.distance_squared(own.pose.position),
                    other,
                )
            })
            .filter(|(away, _)| *away < NEIGHBOUR_REACH_M * NEIGHBOUR_REACH_M)
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.key.id.cmp(&b.1.key.id)));
        let nearest = near.into_iter().take(N_NEIGHBOURS);
        nearest.map(|(_, other)| other).collect()
    }
}

fn neighbours(near: &[&ObservedObject], own_from_scene: Pose, writer: &mut Writer<'_>) {
    for other in near {
        let pose = own_from_scene * other.pose;
        let direction = pose.direction();
        let velocity = own_from_scene.rotate(other.velocity);
        let is = |kind: AgentKind| f64::from(u8::from(other.key.kind == kind));
        writer.put([
            1.0,
            pose.position.x / 20.0,
            pose.position.y / 20.0,
            direction.x,
            direction.y,
            velocity.x / 10.0,
            velocity.y / 10.0,
            other.length / 5.0,
            other.width / 2.0,
            is(AgentKind::Pedestrian),
            is(AgentKind::Bicycle),
        ]);
    }
}

fn own_motion(out: &mut [f32], own: &ObservedObject, earlier: Option<Pose>) {
    let mut writer = Writer(out);
    let own_from_scene = own.pose.inverse();
    let velocity = own_from_scene.rotate(own.velocity);
    let class = class_index(own.key.kind);
    let is = |index: usize| f64::from(u8::from(class == index));
    writer.put([
        velocity.x / 10.0,
        velocity.y / 5.0,
        own.length / 5.0,
        own.width / 2.0,
        is(0),
        is(1),
        is(2),
    ]);
    if let Some(earlier) = earlier {
        let came_from = own_from_scene * earlier;
        writer.put([
            1.0,
            came_from.position.x / 5.0,
            came_from.position.y,
            angle_difference(came_from.heading, 0.0) * 2.0,
        ]);
    }
}

/// Writes numbers one after another.
struct Writer<'a>(&'a mut [f32]);

impl<'a> Writer<'a> {
    fn next(&mut self, n: usize) -> &'a mut [f32] {
        let (out, rest) = std::mem::take(&mut self.0).split_at_mut(n);
        self.0 = rest;
        out
    }

    fn put<const N: usize>(&mut self, numbers: [f64; N]) {
        for (out, number) in self.next(N).iter_mut().zip(numbers) {
            // Far from everything typical, how far does not matter any more.
            *out = number.clamp(-6.0, 6.0) as f32;
        }
    }
}
