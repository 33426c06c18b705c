//! Constraints on one object of a scene: the bins its fields may take, and a check of the result.
//!
//! Fields are drawn one after another, so masks look ahead: a velocity is allowed if traffic moves
//! in its direction anywhere, a column if it has a valid cell. [`Rules::broken`] afterwards checks
//! what masks cannot (the exact box).

use std::f64::consts::PI;
use std::sync::{Arc, OnceLock};

use gump_geometry::{DVec2, OrientedBox, Pose, angle_difference, dvec2};
use gump_metrics::metres_off_road;
use gump_model::decoder::{Bins, STATE_STEPS, STEPS};
use gump_scene::{AgentKind, MapGraph, Seed};
use gump_tokenizer::{Field, QuantizedState};
use rand::Rng as _;

use crate::placement::network::PlacementScorer;
use crate::placement::object_spec::{Bounds, ObjectSpec};
use crate::placement::places::{CELL, NewVehicle, Place, PlaceKind, Places, Traffic};
use crate::placement::spawn_map::{CELLS, Cell, Entry, SLOW, SpawnMap, goes};
use crate::request::Guide;

/// Added to length and width where room for an object is sought, metres: half a step of the grid of
/// positions on each side.
const CLEARANCE: f64 = 0.2;
/// Minimum speed towards the ego of an agent that crosses the border of the window, metres per
/// second: two bins, so that rounding does not bring it in. Not tuned.
const CLOSING: f64 = 0.5;
/// Typical deviation of a vehicle on a lane from the lane's direction, radians: a bin of headings.
/// Chosen on scenes of Lankershim (result 12).
const LANE_KEEPING: f64 = 0.03;
/// An object this near to a lane's centre line is on it, metres: about the diagonal of a cell.
/// Chosen by hand.
const ON_LANE_M: f64 = 1.2;
/// Range of a vehicle's deviation from the centre line of its lane, metres. Chosen by hand.
const OFF_CENTRE: f64 = 0.5;
/// Range of a parked vehicle's deviation from the direction of its place, radians. Chosen by hand.
const ASKEW: f64 = 0.08;
/// Divides the scores of places. At 1 vehicles gather in few queues; at 2 first frames are nearer to
/// recorded ones in positions and headings, with queues that are a little shorter (result 58).
const PLACE_TEMPERATURE: f64 = 2.0;
/// Width of the columns in which places are drawn, metres: four times the distance of places on a
/// lane, so that a column has more than one. Chosen by hand.
const COLUMN: f64 = 4.0;
/// Distance of the centres of vehicles that are parked side by side, and its range, metres. Chosen
/// by hand.
const BAY: f64 = 2.8;
const BAY_RANGE: f64 = 0.3;
/// Gap between vehicles parked end to end, and its range, metres. Chosen by hand.
const KERB_GAP: f64 = 1.2;
/// Share of the vehicles parked along a lane that face against it. Chosen by hand.
const AGAINST: f64 = 0.1;
/// A gap in a row is met to this, metres: half a step of the grid along each axis and some turn.
const ROW_SLACK: f64 = 0.5;

/// Constraints of one object.
#[derive(Clone, Debug)]
pub struct Rules {
    /// Its class.
    pub kind: AgentKind,
    /// Its specification.
    pub spec: ObjectSpec,
    /// Its valid positions; `None` if it may be anywhere.
    pub ground: Option<Arc<SpawnMap>>,
    /// The row it belongs to: whether it is ahead of (true) or behind an object, the box of that
    /// object, and the gap in metres.
    pub rows: Vec<(bool, OrientedBox, f64)>,
    /// Boxes of the objects already placed, scene frame.
    pub taken: Vec<OrientedBox>,
    /// Position and velocity of the ego, for an agent that enters its window; scene frame, metres
    /// and metres per second.
    pub comes_to: Option<(DVec2, DVec2)>,
    /// Whether sizes and speeds stay within the usual range of the class.
    pub is_guided: bool,
    /// Differences of its draws from those of a rollout.
    pub manner: Manner,
    /// Its place is drawn from these, if they are there and one of them is valid, and not by the
    /// sequence network.
    pub places: Option<PlaceDraw>,
}

/// A draw by the placement network.
#[derive(Clone, Debug)]
pub struct PlaceDraw {
    /// The network.
    pub scorer: Arc<PlacementScorer>,
    /// The places of the scene.
    pub places: Arc<Places>,
    /// The places that are worth a score without other vehicles, by their index.
    pub likely: Arc<[bool]>,
    /// The vehicles already placed.
    pub traffic: Arc<Traffic>,
    /// Whether vehicles may park beyond the edges of the road.
    pub off_road: bool,
    /// Decides the draw.
    pub seed: Seed,
    /// The place and pose drawn for the size and velocity that were asked for first.
    drawn: OnceLock<Option<(Place, Pose)>>,
}

impl PlaceDraw {
    /// A draw that is still to be made.
    pub fn new(
        scorer: Arc<PlacementScorer>,
        (places, likely): (Arc<Places>, Arc<[bool]>),
        traffic: Arc<Traffic>,
        off_road: bool,
        seed: Seed,
    ) -> Self {
        Self {
            scorer,
            places,
            likely,
            traffic,
            off_road,
            seed,
            drawn: OnceLock::new(),
        }
    }

    /// Another draw of the same.
    pub fn again(&self, seed: Seed) -> Self {
        Self {
            seed,
            drawn: OnceLock::new(),
            ..self.clone()
        }
    }

    /// Whether place `i` is considered: if it is likely, or near a vehicle that stands.
    fn offers(&self, i: usize) -> bool {
        let place = &self.places.all()[i];
        (self.off_road || place.is_on_road())
            && (self.likely[i] || self.traffic.stands_near(place.pose.position))
    }
}

/// Adjustments to the draws of an object's fields.
#[derive(Clone, Debug)]
pub struct Manner {
    /// Multiplies the temperature of widths and lengths.
    pub size_boldness: f64,
    /// Multiplies the temperature of x and y.
    pub place_boldness: f64,
    /// Smoothing of the velocities' targets in training, bins, if it is to be removed.
    pub smoothing_bins: Option<f32>,
    /// Whether the targets of sizes were smoothed as widely.
    pub smoothed_sizes: bool,
    /// Random numbers for its fields, in place of its stream.
    pub numbers: Option<[f64; STATE_STEPS]>,
}

impl Default for Manner {
    /// No adjustments.
    fn default() -> Self {
        Self {
            size_boldness: 1.0,
            place_boldness: 1.0,
            smoothing_bins: None,
            smoothed_sizes: true,
            numbers: None,
        }
    }
}

impl Guide for Rules {
    fn weights(&self, step: usize, drawn: &[u16]) -> Option<Vec<f32>> {
        let field = *STEPS.get(step).filter(|_| step < STATE_STEPS)?;
        let value = |i: usize| STEPS[i].dequantize(drawn[i]);
        let weigh = |weight: &dyn Fn(f64) -> f32| -> Vec<f32> {
            let bins = 0..field.n_bins() as u16;
            bins.map(|bin| weight(field.dequantize(bin))).collect()
        };
        let bins = |open: &dyn Fn(f64) -> bool| weigh(&|value| f32::from(u8::from(open(value))));
        if matches!(field, Field::X | Field::Y | Field::Heading) {
            let size = dvec2(value(1), value(0));
            if let Some(pose) = self.drawn_place(size, dvec2(value(2), value(3))) {
                let drawn = match field {
                    Field::X => pose.position.x,
                    Field::Y => pose.position.y,
                    _ => pose.heading,
                };
                let mut only = vec![0.0; field.n_bins()];
                only[usize::from(field.quantize(drawn).bin)] = 1.0;
                return Some(only);
            }
        }
        let half = field.step() / 2.0 + 1e-6;
        match field {
            Field::Width | Field::Length => {
                let bounds = self.size(field)?;
                Some(bins(&|v| bounds.admit(v, half)))
            }
            Field::VelocityX => {
                let others: Vec<f64> = (0..field.n_bins() as u16)
                    .map(|bin| Field::VelocityY.dequantize(bin))
                    .collect();
                self.rules_velocity()
                    .then(|| bins(&|x| others.iter().any(|y| self.admits_velocity(dvec2(x, *y)))))
            }
            Field::VelocityY => self
                .rules_velocity()
                .then(|| bins(&|y| self.admits_velocity(dvec2(value(2), y)))),
            Field::X | Field::Y => self.place(field, &value),
            Field::Heading => {
                let velocity = dvec2(value(2), value(3));
                let at = dvec2(value(4), value(5));
                Some(weigh(&|heading| {
                    if self.admits_heading(heading, at, velocity) {
                        self.keeps_lane(heading, at)
                    } else {
                        0.0
                    }
                }))
            }
        }
    }

    fn boldness(&self, step: usize) -> f64 {
        match STEPS[step] {
            _ if step >= STATE_STEPS => 1.0,
            Field::Width | Field::Length => self.manner.size_boldness,
            Field::X | Field::Y => self.manner.place_boldness,
            _ => 1.0,
        }
    }

    fn smoothing(&self, step: usize) -> Option<f32> {
        // Bins of places and headings are so narrow that it does not show.
        let is_coarse = match STEPS[step] {
            _ if step >= STATE_STEPS => false,
            Field::Width | Field::Length => self.manner.smoothed_sizes,
            Field::VelocityX | Field::VelocityY => true,
            Field::X | Field::Y | Field::Heading => false,
        };
        self.manner.smoothing_bins.filter(|_| is_coarse)
    }

    fn number(&self, step: usize) -> Option<f64> {
        self.manner.numbers?.get(step).copied()
    }
}

impl Rules {
    /// The box of a state, scene frame. On lanes the grid of headings is too coarse: an object
    /// whose bin contains the lane's direction gets exactly that direction.
    pub fn outline(
        &self,
        state: &QuantizedState,
        map: &MapGraph,
        world_from_scene: Pose,
    ) -> OrientedBox {
        let mut own = box_of(state);
        let is_driving = self.kind != AgentKind::Pedestrian;
        if self.ground.is_none() || !is_driving || self.heading().is_some() {
            return own;
        }
        let pose = world_from_scene * own.pose;
        let off = |heading: f64| angle_difference(heading, pose.heading).abs();
        let nearest = map
            .lanes_near(pose.position, ON_LANE_M)
            .map(|(lane, _)| {
                let at = lane.centerline.project(pose.position).arc_length;
                lane.centerline.pose_at(at).heading
            })
            .min_by(|a, b| off(*a).total_cmp(&off(*b)));
        // The bin of the lane's direction and those beside it.
        if let Some(way) = nearest.filter(|way| off(*way) <= 1.5 * Field::Heading.step()) {
            own.pose.heading = (world_from_scene.inverse() * Pose::new(0.0, 0.0, way)).heading;
        }
        own
    }

    /// The first constraint that a drawn state and its box violate, as text.
    pub fn broken(
        &self,
        state: &QuantizedState,
        own: &OrientedBox,
        map: &MapGraph,
        world_from_scene: Pose,
    ) -> Option<String> {
        if own.length <= 0.0 || own.width <= 0.0 {
            return Some("a box needs an extent".into());
        }
        if let Some(clause) = self.broken_spec(state, own) {
            return Some(clause);
        }
        if self.taken.iter().any(|other| own.overlaps(other)) {
            return Some("no overlap with the others".into());
        }
        let is_off = |corner: DVec2| {
            let point = world_from_scene * corner;
            let z = map.elevation_at(point).unwrap_or(0.0);
            metres_off_road(map, point, z).is_some_and(|metres| metres > 0.0)
        };
        let may_be_off = self.places.as_ref().is_some_and(|draw| draw.off_road) && self.parks();
        let must = self.kind == AgentKind::Vehicle && !may_be_off;
        if must && own.corners().into_iter().any(is_off) {
            return Some("vehicles are on the road".into());
        }
        None
    }

    /// True for a state in which an agent may enter the window.
    pub(crate) fn enters(&self, state: &QuantizedState) -> bool {
        let at = state.pose().position;
        let cell = self.ground.as_ref().and_then(|ground| ground.cell(at));
        cell.is_some_and(|cell| cell.is_open && self.nears(at, cell, state.velocity()))
    }

    /// True if some cell is open to it, whatever its size and speed; without open cells every
    /// position is valid.
    pub fn has_place(&self) -> bool {
        let Some(ground) = &self.ground else {
            return true;
        };
        let mut columns = (0..CELLS).flat_map(|x| ground.column(x));
        columns.any(|(at, cell)| self.fits(at, cell, DVec2::ZERO, DVec2::ZERO))
    }

    /// The first part of its specification that a state does not satisfy.
    fn broken_spec(&self, state: &QuantizedState, own: &OrientedBox) -> Option<String> {
        let spec = &self.spec;
        let slack = |field: Field| field.step() / 2.0 + 1e-6;
        let place = own.pose.position;
        let numbers = [
            ("x", spec.x, place.x, slack(Field::X)),
            ("y", spec.y, place.y, slack(Field::Y)),
            // Two components, each off by half a step.
            ("speed", spec.speed, state.velocity().length(), 0.18),
            ("length", spec.length, own.length, slack(Field::Length)),
            ("width", spec.width, own.width, slack(Field::Width)),
        ];
        for (name, bounds, value, slack) in numbers {
            if let Some(bounds) = bounds.filter(|bounds| !bounds.admit(value, slack)) {
                let Bounds { low, high } = bounds;
                return Some(format!("{name} from {low} to {high}"));
            }
        }
        let turned = |b: &Bounds| !b.admit_angle(own.pose.heading, slack(Field::Heading));
        if let Some(Bounds { low, high }) = spec.heading.filter(turned) {
            return Some(format!("heading from {low} to {high}"));
        }
        if let Some(lane) = spec.lane {
            let cell = self.ground.as_ref().and_then(|ground| ground.cell(place));
            let fits = |heading| cell.is_some_and(|c| c.is_open && goes(&c.ways, heading, 0.3));
            if !fits(own.pose.heading) {
                return Some(format!("on lane {lane}"));
            }
        }
        for (is_ahead, other, metres) in &self.rows {
            let local = other.pose.inverse() * place;
            let gap = local.x.abs() - (own.length + other.length) / 2.0;
            let right_side = (local.x > 0.0) == *is_ahead;
            if !right_side || (gap - metres).abs() > ROW_SLACK || local.y.abs() > ROW_SLACK {
                let relation = if *is_ahead { "ahead of" } else { "behind" };
                return Some(format!("{relation} another by {metres} m"));
            }
        }
        None
    }

    fn size(&self, field: Field) -> Option<Bounds> {
        let (own, common) = match (field, self.kind) {
            // Cars to buses, a person, a bicycle, on grids of half a metre. Chosen by hand.
            (Field::Width, AgentKind::Vehicle) => (self.spec.width, Bounds::new(1.5, 3.0)),
            (Field::Width, _) => (self.spec.width, Bounds::new(0.5, 1.0)),
            (_, AgentKind::Vehicle) => (self.spec.length, Bounds::new(3.0, 14.5)),
            (_, AgentKind::Pedestrian) => (self.spec.length, Bounds::new(0.5, 1.0)),
            _ => (self.spec.length, Bounds::new(1.5, 2.0)),
        };
        own.or(self.is_guided.then_some(common))
    }

    fn speed(&self) -> Option<Bounds> {
        // Metres per second, in a city, of people up to a run. Chosen by hand.
        let common = match self.kind {
            AgentKind::Vehicle => 20.0,
            AgentKind::Bicycle => 8.0,
            _ => 2.2,
        };
        let guided = self.is_guided.then_some(Bounds::new(0.0, common));
        self.spec.speed.or(guided)
    }

    fn rules_velocity(&self) -> bool {
        self.speed().is_some() || self.ground.is_some() || self.heading().is_some()
    }

    /// The headings it may have wherever it is.
    fn heading(&self) -> Option<Bounds> {
        // Some 6 degrees: a row stays one on a lane that bends. Chosen by hand.
        let in_row = self.rows.first().map(|(_, other, _)| {
            let heading = other.pose.heading;
            Bounds::new(heading - 0.1, heading + 0.1)
        });
        self.spec.heading.or(in_row)
    }

    fn admits_velocity(&self, velocity: DVec2) -> bool {
        let speed = velocity.length();
        // Half a step along an axis.
        if self
            .speed()
            .is_some_and(|bounds| !bounds.admit(speed, 0.126))
        {
            return false;
        }
        if speed < SLOW {
            return true;
        }
        let way = velocity.to_angle();
        let turns = self.heading().is_some_and(|b| !b.admit_angle(way, 0.1));
        let goes = |ground: &Arc<SpawnMap>| ground.admits(velocity);
        !turns && (!self.rows.is_empty() || self.ground.as_ref().is_none_or(goes))
    }

    /// The pose that the placement network draws for a vehicle of this size and velocity; `None`
    /// without it, and if no place is valid.
    fn drawn_place(&self, size: DVec2, velocity: DVec2) -> Option<Pose> {
        let draw = self.places.as_ref()?;
        let drawn = draw
            .drawn
            .get_or_init(|| self.draw_place(draw, size, velocity));
        drawn.map(|(_, pose)| pose)
    }

    /// True if it parks beside lanes, where road edges do not matter.
    fn parks(&self) -> bool {
        let draw = self.places.as_ref().and_then(|draw| draw.drawn.get());
        draw.copied()
            .flatten()
            .is_some_and(|(place, _)| place.kind != PlaceKind::OnLane)
    }

    fn draw_place(&self, draw: &PlaceDraw, size: DVec2, velocity: DVec2) -> Option<(Place, Pose)> {
        let own = NewVehicle {
            velocity,
            length: size.x,
        };
        let all = draw.places.all();
        let valid = |i: &usize| {
            let place = &all[*i];
            own.suits(place) && draw.offers(*i) && self.admits_place(draw, place, size)
        };
        let which: Vec<usize> = (0..all.len()).filter(valid).collect();
        let scores = draw
            .scorer
            .scores(&draw.places, &draw.traffic, &own, &which);
        let peak = scores.iter().copied().reduce(f32::max)?;
        let weight = |score: &f32| (f64::from(score - peak) / PLACE_TEMPERATURE).exp();
        let weights: Vec<f64> = scores.iter().map(weight).collect();
        let mut rng = draw.seed.rng();
        let chosen = match self.manner.numbers {
            Some(numbers) => {
                let at = |k: usize| all[which[k]].pose.position;
                choose_evenly(&weights, at, [numbers[4], numbers[5]])
            }
            None => choose(0..weights.len(), &weights, rng.random()),
        };
        let place = &all[which[chosen]];
        let mut jitter = |scale: f64| (rng.random::<f64>() - 0.5) * scale;
        if place.kind == PlaceKind::OnLane {
            return Some((
                *place,
                place.pose * Pose::new(jitter(1.0), jitter(OFF_CENTRE), 0.0),
            ));
        }
        let moved = place.pose * Pose::new(jitter(CELL), jitter(CELL), jitter(ASKEW));
        let noise = [jitter(1.0), jitter(1.0)];
        let mut pose = self.in_row(moved, size, noise).unwrap_or(moved);
        let backwards = if place.kind == PlaceKind::Along {
            AGAINST
        } else {
            0.5
        };
        if rng.random_bool(backwards) {
            pose = pose * Pose::new(0.0, 0.0, PI);
        }
        Some((*place, pose))
    }

    /// The pose next to a parked vehicle, in a row with it, if one is near enough; two numbers in
    /// [-0.5, 0.5) vary it.
    fn in_row(&self, pose: Pose, size: DVec2, noise: [f64; 2]) -> Option<Pose> {
        let near = self.taken.iter().filter_map(|other| {
            let at = other.pose.inverse() * pose.position;
            let turn = angle_difference(pose.heading, other.pose.heading);
            if turn.cos().abs() < 0.9 {
                return None;
            }
            let bays = BAY + noise[0] * BAY_RANGE;
            let cars = (size.x + other.length) / 2.0 + KERB_GAP + noise[0] * KERB_GAP;
            let local = if at.x.abs() < 2.0 && (1.5..4.0).contains(&at.y.abs()) {
                dvec2(noise[1] * OFF_CENTRE, bays * at.y.signum())
            } else if at.y.abs() < 1.5 && (4.0..cars + 2.5).contains(&at.x.abs()) {
                dvec2(cars * at.x.signum(), noise[1] * OFF_CENTRE)
            } else {
                return None;
            };
            let flip = if turn.cos() < 0.0 { PI } else { 0.0 };
            let local = Pose::new(local.x, local.y, flip);
            Some((at.length(), other.pose * local))
        });
        near.min_by(|a, b| a.0.total_cmp(&b.0))
            .map(|(_, pose)| pose)
    }

    /// Whether a vehicle of this size may be at a place: in its bounds and clear of others.
    fn admits_place(&self, draw: &PlaceDraw, place: &Place, size: DVec2) -> bool {
        let pose = place.pose;
        let is_open = |bounds: Option<Bounds>, value: f64| {
            bounds.is_none_or(|bounds| bounds.admit(value, 0.0))
        };
        if !is_open(self.spec.x, pose.position.x) || !is_open(self.spec.y, pose.position.y) {
            return false;
        }
        let turned = self
            .heading()
            .is_some_and(|b| !b.admit_angle(pose.heading, 0.1));
        let elsewhere = self
            .spec
            .lane()
            .is_some_and(|lane| draw.places.lane(place) != Some(lane));
        if turned || elsewhere {
            return false;
        }
        let own = OrientedBox {
            pose,
            length: size.x + CLEARANCE,
            width: size.y + CLEARANCE,
        };
        let reach = own.length + own.width;
        !self.taken.iter().any(|other| {
            let apart = other.pose.position.distance(pose.position);
            2.0 * apart < reach + other.length + other.width && own.overlaps(other)
        })
    }

    /// Returns weights for the bins of `field`, by where the centre may be on that axis given the
    /// fields drawn before; `None` without constraints.
    fn place(&self, field: Field, value: &dyn Fn(usize) -> f64) -> Option<Vec<f32>> {
        let velocity = dvec2(value(2), value(3));
        let size = dvec2(value(1), value(0));
        let (given, axis) = match field {
            Field::X => (self.spec.x, DVec2::X),
            _ => (self.spec.y, DVec2::Y),
        };
        let in_row = self.rows.first().map(|(is_ahead, other, metres)| {
            let far = (other.length + size.x) / 2.0 + metres;
            let offset = if *is_ahead { far } else { -far };
            let at = (other.pose * dvec2(offset, 0.0)).dot(axis);
            Bounds::new(at, at)
        });
        let bounds = given.or(in_row);
        let ground = self.ground.as_ref().filter(|_| self.rows.is_empty());
        if bounds.is_none() && ground.is_none() {
            return None;
        }
        let open: Option<[f32; CELLS]> = ground.map(|ground| {
            let mut open = [0.0; CELLS];
            let fits = |(at, cell): &(DVec2, &Cell)| self.fits(*at, cell, size, velocity);
            if field == Field::X {
                for (x, open) in open.iter_mut().enumerate() {
                    let n = ground.column(x).filter(fits).count();
                    // Where y goes is drawn later; between one per column and one per cell, which
                    // would follow the network and the length of lanes.
                    *open = (n as f32).sqrt();
                }
            } else {
                let x = ((value(4) + 100.0).floor().max(0.0) as usize).min(CELLS - 1);
                for (at, _) in ground.column(x).filter(fits) {
                    open[(at.y + 100.0).floor() as usize] = 1.0;
                }
            }
            open
        });
        let half = field.step() / 2.0 + 1e-6;
        let admits = |bin: u16| {
            let at = field.dequantize(bin);
            let cell = ((at + 100.0).floor().max(0.0) as usize).min(CELLS - 1);
            let within = bounds.is_none_or(|bounds| bounds.admit(at, half));
            if within {
                open.map_or(1.0, |open| open[cell])
            } else {
                0.0
            }
        };
        Some((0..field.n_bins() as u16).map(admits).collect())
    }

    /// Whether the object fits on a cell: inside its bounds, moving in a direction of the cell,
    /// clear of others, and nearing the ego if it enters over the border of its window.
    fn fits(&self, at: DVec2, cell: &Cell, size: DVec2, velocity: DVec2) -> bool {
        let ways = &cell.ways;
        if !self.nears(at, cell, velocity) {
            return false;
        }
        let within = |bounds: Option<Bounds>, value: f64| {
            // Half a cell and half a step of the grid of positions.
            bounds.is_none_or(|bounds| bounds.admit(value, 0.6))
        };
        if !within(self.spec.x, at.x) || !within(self.spec.y, at.y) {
            return false;
        }
        let moves = velocity.length() >= SLOW;
        // Loose, as a velocity of a few bins is rounded; the heading is checked more closely.
        if moves && !goes(ways, velocity.to_angle(), 0.3) {
            return false;
        }
        let headings = self.heading();
        let mut way = ways.iter().map(|way| f64::from(*way));
        let turned = |way: f64| headings.is_none_or(|bounds| bounds.admit_angle(way, 0.15));
        if !(ways.is_empty() || way.any(turned)) {
            return false;
        }
        let heading = match (moves, ways.first()) {
            (true, _) => velocity.to_angle(),
            (false, Some(way)) => f64::from(*way),
            (false, None) => 0.0,
        };
        let own = OrientedBox {
            pose: Pose::new(at.x, at.y, heading),
            length: size.x + CLEARANCE,
            width: size.y + CLEARANCE,
        };
        !self.taken.iter().any(|other| own.overlaps(other))
    }

    /// False for an agent that enters over the border of the ego's window without nearing the ego.
    fn nears(&self, at: DVec2, cell: &Cell, velocity: DVec2) -> bool {
        let bordering = self.comes_to.filter(|_| cell.entry == Entry::Border);
        bordering.is_none_or(|(ego, moving)| {
            (ego - at).normalize_or_zero().dot(velocity - moving) >= CLOSING
        })
    }

    /// Returns the weight of a heading by its alignment with the lane, from 0 to 1; 1 without a
    /// lane.
    fn keeps_lane(&self, heading: f64, at: DVec2) -> f32 {
        let cell = self.ground.as_ref().and_then(|ground| ground.cell(at));
        let ways = cell.map_or(&[][..], |cell| &cell.ways).iter();
        let off = ways.map(|way| angle_difference(heading, f64::from(*way)).abs());
        off.reduce(f64::min).map_or(1.0, |off| {
            (-0.5 * (off / LANE_KEEPING).powi(2)).exp() as f32
        })
    }

    fn admits_heading(&self, heading: f64, at: DVec2, velocity: DVec2) -> bool {
        let half = Field::Heading.step() / 2.0 + 1e-6;
        if let Some(bounds) = self.heading() {
            return bounds.admit_angle(heading, half);
        }
        // Vehicles and bicycles move where they face, people roughly; chosen by hand.
        let slack = if self.kind == AgentKind::Pedestrian {
            0.4
        } else {
            0.12
        };
        let follows = || {
            let turn = angle_difference(heading, velocity.to_angle());
            velocity.length() < SLOW || turn.abs() <= slack
        };
        match &self.ground {
            Some(ground) => {
                let cell = ground.cell(at);
                follows() && cell.is_none_or(|cell| goes(&cell.ways, heading, 0.2))
            }
            None => true,
        }
    }
}

/// The first of some indices up to which they have more than this share of their weight.
fn choose(indices: impl Iterator<Item = usize> + Clone, weights: &[f64], share: f64) -> usize {
    let total: f64 = indices.clone().map(|k| weights[k]).sum();
    let (mut left, mut last) = (share * total, 0);
    for k in indices {
        (left, last) = (left - weights[k], k);
        if left < 0.0 {
            break;
        }
    }
    last
}

/// An index drawn by its weight: its column along x by the first number, its place in the column by
/// the second. Numbers from different strata then spread over the scene.
fn choose_evenly(weights: &[f64], at: impl Fn(usize) -> DVec2, numbers: [f64; 2]) -> usize {
    let mut order: Vec<usize> = (0..weights.len()).collect();
    let column = |k: usize| (at(k).x / COLUMN).floor();
    order.sort_by(|a, b| {
        let columns = column(*a).total_cmp(&column(*b));
        columns.then(at(*a).y.total_cmp(&at(*b).y))
    });
    let first = choose(order.iter().copied(), weights, numbers[0]);
    let same = order
        .iter()
        .copied()
        .filter(|k| column(*k) == column(first));
    choose(same, weights, numbers[1])
}

/// The state of an object's bins, for an object without a previous state, whose chunk is therefore
/// expressed in the scene's frame.
pub fn state_of(bins: &Bins) -> QuantizedState {
    let mut state = QuantizedState::default();
    for (field, bin) in STEPS.iter().zip(bins).take(7) {
        state.set(*field, *bin);
    }
    state
}

/// The box of a state, scene frame.
pub(crate) fn box_of(state: &QuantizedState) -> OrientedBox {
    OrientedBox {
        pose: state.pose(),
        length: Field::Length.dequantize(state.length),
        width: Field::Width.dequantize(state.width),
    }
}

#[cfg(test)]
mod tests {
    use gump_scene::fixture;

    use super::*;

    fn rules(spec: ObjectSpec) -> Rules {
        Rules {
            kind: AgentKind::Vehicle,
            spec,
            ground: None,
            rows: Vec::new(),
            taken: Vec::new(),
            comes_to: None,
            is_guided: false,
            manner: Manner::default(),
            places: None,
        }
    }

    fn open(rules: &Rules, step: usize, drawn: &[u16]) -> Vec<f64> {
        let weights = rules.weights(step, drawn).unwrap();
        let bins = (0..weights.len()).filter(|i| weights[*i] > 0.0);
        bins.map(|bin| STEPS[step].dequantize(bin as u16)).collect()
    }

    #[test]
    fn fixed_numbers_leave_the_nearest_bins() {
        let rules = rules(ObjectSpec {
            x: Some(Bounds::new(10.03, 10.03)),
            speed: Some(Bounds::new(0.0, 0.0)),
            ..ObjectSpec::default()
        });
        assert_eq!(open(&rules, 2, &[4, 9]), [0.0]);
        assert_eq!(open(&rules, 3, &[4, 9, 100]), [0.0]);
        assert!((open(&rules, 4, &[4, 9, 100, 100])[0] - 10.0).abs() < 1e-9);
        assert!(rules.weights(0, &[]).is_none() && rules.weights(9, &[0; 9]).is_none());
    }

    #[test]
    fn guided_vehicles_stay_on_lanes_and_go_their_way() {
        let scenario = fixture::scenario("lane 1: -50,10 50,10\nego vehicle 0: 0,0").unwrap();
        let ground = SpawnMap::of_class(&scenario.map, Pose::IDENTITY, AgentKind::Vehicle);
        let rules = Rules {
            ground: Some(Arc::new(ground)),
            comes_to: None,
            is_guided: true,
            ..rules(ObjectSpec::default())
        };
        // Along the lane, not across it, and not backwards.
        let x = open(&rules, 2, &[4, 9]);
        assert!(x.iter().all(|x| *x > -1.0) && x.contains(&8.0));
        let drawn = [4, 9, Field::VelocityX.quantize(8.0).bin, 100];
        assert!(open(&rules, 3, &drawn[..3]).iter().all(|y| y.abs() < 1.3));
        let x = open(&rules, 4, &drawn);
        assert!(x.iter().all(|x| (-51.0..=51.0).contains(x)));
        let y = open(&rules, 5, &[4, 9, drawn[2], 100, 600]);
        assert!(y.iter().all(|y| (9.9..11.1).contains(y)), "{y:?}");
        let heading = open(&rules, 6, &[4, 9, drawn[2], 100, 600, 550]);
        assert!(heading.iter().all(|h| h.abs() < 0.15));
    }

    #[test]
    fn who_keeps_to_a_lane_faces_its_way_exactly() {
        let scenario = fixture::scenario("lane 1: -50,0 50,1.3\nego vehicle 0: 0,0").unwrap();
        let way = 0.013_f64.atan();
        let ground = SpawnMap::of_class(&scenario.map, Pose::IDENTITY, AgentKind::Vehicle);
        let rules = Rules {
            ground: Some(Arc::new(ground)),
            is_guided: true,
            ..rules(ObjectSpec::default())
        };
        let facing = |heading: f64| {
            let state = QuantizedState {
                x: Field::X.quantize(10.0).bin,
                y: Field::Y.quantize(0.1).bin,
                heading: Field::Heading.quantize(heading).bin,
                ..QuantizedState::default()
            };
            let outline = rules.outline(&state, &scenario.map, Pose::IDENTITY);
            outline.pose.heading
        };
        assert!((facing(0.0) - way).abs() < 1e-9 && (facing(0.04) - way).abs() < 1e-9);
        assert!((facing(0.1) - 0.1).abs() < 0.02);
        // Standing, it is most likely drawn that way.
        let weights = rules.weights(6, &[4, 9, 100, 100, 550, 500]).unwrap();
        let best = (0..weights.len()).max_by(|a, b| weights[*a].total_cmp(&weights[*b]));
        assert_eq!(best, Some(usize::from(Field::Heading.quantize(way).bin)));
    }

    #[test]
    fn rows_keep_their_gap() {
        let ahead = OrientedBox {
            pose: Pose::IDENTITY,
            length: 4.0,
            width: 2.0,
        };
        let rules = Rules {
            rows: vec![(false, ahead, 6.0)],
            taken: vec![ahead],
            ..rules(ObjectSpec::default())
        };
        // Half of 4 m, 6 m of gap, half of 4.5 m.
        let x = open(&rules, 4, &[4, 9, 100, 100]);
        assert!(x.iter().all(|x| (x + 10.25).abs() < 0.11), "{x:?}");
        let state = |x: f64| QuantizedState {
            x: Field::X.quantize(x).bin,
            y: 500,
            heading: 100,
            velocity_x: 100,
            velocity_y: 100,
            width: 4,
            length: 9,
        };
        let map = fixture::scenario("ego vehicle 0: 0,0").unwrap().map;
        let broken = |x: f64| {
            let state = state(x);
            rules.broken(&state, &box_of(&state), &map, Pose::IDENTITY)
        };
        assert_eq!(broken(-10.2), None);
        assert_eq!(broken(-3.0).as_deref(), Some("behind another by 6 m"));
        let none = Rules {
            rows: Vec::new(),
            ..rules.clone()
        };
        let near = state(-3.0);
        let found = none.broken(&near, &box_of(&near), &map, Pose::IDENTITY);
        assert_eq!(found.as_deref(), Some("no overlap with the others"));
    }
}
