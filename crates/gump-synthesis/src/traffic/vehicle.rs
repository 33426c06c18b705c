//! One vehicle or bicycle: its position on its path and its motion along and across it.

use gump_geometry::{Pose, wrap_angle};
use gump_scene::{AgentKind, Rng};
use rand::Rng as _;

use super::Body;
use super::beside::Beside;
use super::driver::DriverParameters;
use super::wait_inside::Wait;
use crate::curve::{smooth_step, smooth_step_slope};
use crate::network::{LaneIdx, Network};

// Chosen by eye, for smooth paths.
/// Seconds in which drivers correct their place in the lane.
const STEERING_TIME: f64 = 0.75;
/// The same at low speed, metres.
const STEERING_LENGTH: f64 = 5.0;
/// Share of the usual wandering that is left beside parked vehicles.
const BESIDE: f64 = 0.4;
/// Steepest change of acceleration when accelerating or easing off, m/s³. Chosen by hand.
const JERK: f64 = 5.0;
/// Steepest change of acceleration when braking hard, m/s³: full braking within a quarter of a
/// second.
const BRAKING_JERK: f64 = 30.0;

/// Above this speed it is drawn anew how far short the vehicle stops next; below the second it stands, m/s.
const ROLLS_MPS: f64 = 3.0;
pub(super) const STANDS_MPS: f64 = 0.3;
/// Seconds for which it stands before it moves up, and how fast it does, m/s. Chosen by hand: recorded
/// vehicles are at 0.2 to 3 m/s for a quarter of the time for which they move, and one in eight of such
/// times begins and ends standing.
const MOVES_UP_S: std::ops::Range<f64> = 0.3..6.0;
const MOVES_UP_MPS: f64 = 0.7;

/// A lane change in progress.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LaneChange {
    /// The lane it came from.
    pub(crate) from: LaneIdx,
    /// Arc length on that lane minus arc length on the new one.
    pub(crate) arc_shift: f64,
    /// Metres left of the new lane where it began.
    pub(crate) offset: f64,
    /// Metres driven since.
    pub(crate) driven: f64,
    /// Metres the change takes.
    pub(crate) length: f64,
}

/// A vehicle or bicycle in motion.
#[derive(Clone, Debug)]
pub(crate) struct Vehicle {
    pub(crate) id: i64,
    pub(crate) kind: AgentKind,
    pub(crate) size: [f64; 3],
    pub(crate) driver: DriverParameters,
    /// Lanes to drive, driven ones included.
    pub(crate) path: Vec<LaneIdx>,
    /// Index into `path` of the lane that the centre is on.
    pub(crate) leg: usize,
    /// Arc length of the centre on that lane, metres.
    pub(crate) s: f64,
    pub(crate) speed: f64,
    pub(crate) acceleration: f64,
    /// Metres left of the lane centre (of the new lane during a change), without the change.
    pub(crate) lateral: f64,
    slope: f64,
    wander: f64,
    wander_left: f64,
    /// Preferred lateral position in its lane, without wandering, metres to the left.
    pub(crate) keep: f64,
    /// Added to `keep` while passing a bicycle.
    pub(crate) evade: f64,
    /// How it passes parked vehicles.
    pub(crate) beside: Beside,
    noise: f64,
    /// Connectors it may use.
    pub(crate) claims: Vec<LaneIdx>,
    /// How far it may go into a junction that it may not cross yet.
    pub(crate) wait: Option<Wait>,
    /// Time at which it came to rest at the line it waits at, seconds.
    pub(crate) waiting_since: Option<f64>,
    pub(crate) change: Option<LaneChange>,
    /// Seconds until it thinks of changing lanes again.
    pub(crate) patience: f64,
    /// Stays in place, like a vehicle that has stopped in the lane to load.
    pub(crate) is_held: bool,
    /// Stays in place until then, seconds of the simulation.
    pub(crate) starts: f64,
    /// Metres by which it stops short, and seconds for which it stands before it moves up.
    short: (f64, f64),
    /// Has not stood since `short` was drawn.
    is_short_new: bool,
}

impl Vehicle {
    /// A vehicle at arc length `s` of the first lane of `path`.
    pub(crate) fn new(
        id: i64,
        (kind, size, driver): (AgentKind, [f64; 3], DriverParameters),
        path: Vec<LaneIdx>,
        s: f64,
        speed: f64,
        rng: &mut Rng,
    ) -> Self {
        Self {
            id,
            kind,
            size,
            driver,
            path,
            leg: 0,
            s,
            speed,
            acceleration: 0.0,
            lateral: 0.0,
            slope: 0.0,
            wander: 0.0,
            wander_left: 0.0,
            keep: rng.random_range(-0.12..0.12),
            evade: 0.0,
            beside: Beside::NOTHING,
            noise: 0.0,
            claims: Vec::new(),
            wait: None,
            waiting_since: None,
            change: None,
            patience: rng.random_range(1.0..12.0),
            is_held: false,
            starts: 0.0,
            short: (0.0, 0.0),
            is_short_new: false,
        }
    }

    /// Puts it at its preferred place in the lane at once; for vehicles that appear.
    pub(crate) fn settle(&mut self, keep: f64) {
        self.keep = keep;
        self.lateral = keep;
    }

    pub(crate) fn length(&self) -> f64 {
        self.size[0]
    }

    pub(crate) fn width(&self) -> f64 {
        self.size[1]
    }

    /// The lane that the centre is on.
    pub(crate) fn lane(&self) -> LaneIdx {
        self.path[self.leg]
    }

    /// Arc length of the front on the present lane; may exceed the lane.
    pub(crate) fn front(&self) -> f64 {
        self.s + self.length() / 2.0
    }

    /// Metres from the front to the start of lane `path[leg]`; negative once past it.
    pub(crate) fn distance_to(&self, network: &Network, leg: usize) -> f64 {
        let length = |leg: usize| network.lanes[self.path[leg]].length();
        if leg >= self.leg {
            (self.leg..leg).map(length).sum::<f64>() - self.front()
        } else {
            -(leg..self.leg).map(length).sum::<f64>() - self.front()
        }
    }

    /// Arc length of the rear measured from the start of `lane`, which is on the path; before it
    /// negative, after it more than its length.
    pub(crate) fn rear_on(&self, network: &Network, lane: LaneIdx) -> Option<f64> {
        let leg = self.leg_on(lane)?;
        Some(-self.distance_to(network, leg) - self.length())
    }

    /// Where on the path a lane is, among those ahead and the last ones driven.
    pub(crate) fn leg_on(&self, lane: LaneIdx) -> Option<usize> {
        // The last lanes driven suffice: claims are given up soon after a junction.
        let mut nearby = self.leg.saturating_sub(3)..self.path.len();
        nearby.find(|&leg| self.path[leg] == lane)
    }

    /// The next connector at or ahead of the front, as an index into the path.
    pub(crate) fn next_connector(&self, network: &Network) -> Option<usize> {
        let is_connector = |leg: &usize| network.lanes[self.path[*leg]].connector.is_some();
        let leg = (self.leg + 1..self.path.len()).find(is_connector)?;
        (self.distance_to(network, leg) > 0.0).then_some(leg)
    }

    /// The speed that limit, bends and habit allow here, metres per second.
    pub(crate) fn allowed_speed(&self, network: &Network) -> f64 {
        let lane = &network.lanes[self.lane()];
        let bend = |lane: LaneIdx, s: f64| {
            let speeds = &network.lanes[lane].bend_speeds;
            let sample = (s / network.lanes[lane].track.step()) as usize;
            speeds[sample.min(speeds.len() - 1)] * self.driver.bend_factor
        };
        let mut allowed = (lane.speed_limit * self.driver.speed_factor)
            .min(self.driver.top_speed)
            .min(self.beside.speed)
            .min(bend(self.lane(), self.s))
            .min(self.slowed_by_bumps(&lane.bumps, -self.s));
        let mut ahead = lane.length() - self.s;
        for &next in &self.path[(self.leg + 1).min(self.path.len())..] {
            if ahead > 80.0 {
                break;
            }
            let limit = network.lanes[next].speed_limit * self.driver.speed_factor;
            let entry = bend(next, 0.0).min(limit);
            allowed = allowed
                .min((entry * entry + 2.0 * 1.2 * ahead).sqrt())
                .min(self.slowed_by_bumps(&network.lanes[next].bumps, ahead));
            ahead += network.lanes[next].length();
        }
        allowed
    }

    /// The speed that bumps of a lane allow which starts `ahead` metres from the centre.
    fn slowed_by_bumps(&self, bumps: &[f64], ahead: f64) -> f64 {
        let of_bump = |bump: &f64| {
            // Drivers speed up when the rear is over it.
            let left = ahead + bump - self.length() / 2.0;
            let over = left + self.length() < 0.0;
            let speed = self.driver.bump_speed;
            let allowed = (speed * speed + 2.0 * 1.2 * left.max(0.0)).sqrt();
            if over { f64::INFINITY } else { allowed }
        };
        bumps.iter().map(of_bump).fold(f64::INFINITY, f64::min)
    }

    /// Seconds in which it can be `way` metres on, accelerating as is comfortable.
    pub(crate) fn soonest(&self, way: f64) -> f64 {
        let (v, a) = (self.speed, self.driver.acceleration);
        ((v * v + 2.0 * a * way.max(0.0)).sqrt() - v) / a
    }

    /// Small random acceleration, none near standstill, m/s².
    pub(crate) fn noise(&self) -> f64 {
        self.noise * ((self.speed - 1.0) / 4.0).clamp(0.0, 1.0)
    }

    /// Moves on for `dt` seconds with the wanted acceleration, as far as jerk permits.
    pub(crate) fn advance(&mut self, network: &Network, wanted: f64, dt: f64, rng: &mut Rng) {
        // An Ornstein-Uhlenbeck process with a time constant of two seconds.
        let kick: f64 = rng.random_range(-1.0..1.0);
        self.noise += -self.noise * dt / 2.0 + 0.28 * self.driver.unrest * kick * dt.sqrt();
        let down = if wanted < -3.0 {
            BRAKING_JERK
        } else {
            2.0 * JERK
        };
        let (low, high) = (self.acceleration - down * dt, self.acceleration + JERK * dt);
        self.acceleration = wanted.clamp(low, high);
        let speed = (self.speed + self.acceleration * dt).max(0.0);
        if speed == 0.0 {
            self.acceleration = self.acceleration.max(0.0);
        }
        let driven = (self.speed + speed) / 2.0 * dt;
        self.speed = speed;
        self.patience -= dt;
        if self.driver.short > 0.0 {
            self.move_up(dt, rng);
        }
        self.drift(driven, rng);
        let curvature = network.lanes[self.lane()].track.curvature_at(self.s);
        // On the inside of a bend the lane centre passes faster than the vehicle drives.
        self.s += driven / (1.0 - curvature * self.offset()).max(0.3);
        while self.leg + 1 < self.path.len() && self.s >= network.lanes[self.lane()].length() {
            self.s -= network.lanes[self.lane()].length();
            self.leg += 1;
        }
    }

    /// Draws how far the vehicle stops short of where it will stand, and lets it move up there once it has
    /// stood for a while.
    fn move_up(&mut self, dt: f64, rng: &mut Rng) {
        if self.speed > ROLLS_MPS && !self.is_short_new {
            let part: f64 = rng.random_range(0.0..1.0);
            self.short = (self.driver.short * part, rng.random_range(MOVES_UP_S));
            self.is_short_new = true;
        } else if self.speed < STANDS_MPS {
            self.short.1 -= dt;
            self.is_short_new = false;
        }
        if self.short.1 <= 0.0 {
            self.short.0 = (self.short.0 - MOVES_UP_MPS * dt).max(0.0);
        }
    }

    /// Metres by which it stops short now of a vehicle that stands, or of a line.
    pub(super) fn short(&self) -> f64 {
        self.short.0
    }

    /// Sideways motion over `driven` metres: towards the preferred place, wandering a little.
    fn drift(&mut self, driven: f64, rng: &mut Rng) {
        self.wander_left -= driven;
        if self.wander_left <= 0.0 {
            // Steering is corrected every one to three seconds, on any road.
            self.wander_left = rng.random_range(0.8..2.5) * self.speed.max(5.0);
            self.wander = rng.random_range(-self.driver.wander..self.driver.wander);
        }
        let (aside, wander) = match self.beside.aside {
            0.0 => (self.evade, self.wander),
            aside => (self.evade.max(aside), BESIDE * self.wander),
        };
        let target = self.keep + aside + wander;
        let k = 1.0 / (STEERING_TIME * self.speed).max(STEERING_LENGTH);
        let pull = k * k * (target - self.lateral) - 2.0 * k * self.slope;
        self.slope += pull * driven;
        self.lateral += self.slope * driven;
        if let Some(change) = &mut self.change {
            change.driven += driven;
            if change.driven >= change.length {
                self.change = None;
            }
        }
    }

    /// Metres left of the centre of the present lane, lane change included.
    pub(crate) fn offset(&self) -> f64 {
        let change = self.change.map_or(0.0, |change| {
            change.offset * (1.0 - smooth_step(change.driven / change.length))
        });
        self.lateral + change
    }

    /// The present pose of the box.
    pub(crate) fn pose(&self, network: &Network) -> Pose {
        let on_lane = network.lanes[self.lane()].track.pose_at(self.s);
        let slope = self.slope
            - self.change.map_or(0.0, |change| {
                change.offset * smooth_step_slope(change.driven / change.length) / change.length
            });
        let left = on_lane.direction().perp();
        Pose {
            position: on_lane.position + left * self.offset(),
            heading: wrap_angle(on_lane.heading + slope.atan()),
        }
    }

    /// True once it has driven off its last lane.
    pub(crate) fn has_left(&self, network: &Network) -> bool {
        let lane = &network.lanes[self.lane()];
        lane.is_exit && self.s >= lane.length() - 0.5
    }

    pub(crate) fn body(&self, network: &Network) -> Body {
        Body {
            id: self.id,
            group: self.id,
            kind: self.kind,
            size: self.size,
            pose: self.pose(network),
            is_mobile: !self.is_held,
            place: Some((self.lane(), self.s)),
        }
    }
}
