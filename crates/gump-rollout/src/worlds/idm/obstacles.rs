//! Agents in the path of a vehicle.

use gump_geometry::{DVec2, Pose};
use gump_scene::Agent;

use super::IdmConfig;
use super::law::{desired_gap, harmless_speed};
use super::path::Path;

/// An agent as others see it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Obstacle {
    pose: Pose,
    velocity: DVec2,
    half_length: f64,
    half_width: f64,
    radius: f64,
}

impl Obstacle {
    pub(super) fn new(agent: &Agent) -> Self {
        let (half_length, half_width) = (agent.length / 2.0, agent.width / 2.0);
        Self {
            pose: agent.state.pose,
            velocity: agent.state.velocity,
            half_length,
            half_width,
            radius: half_length.hypot(half_width),
        }
    }
}

/// The vehicle ahead as the car-following law sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lead {
    /// Clear distance, metres; negative when the boxes share a stretch of the path.
    pub(super) gap: f64,
    /// Along the path, metres per second.
    pub(super) speed: f64,
}

impl Lead {
    /// Strength of the restraint: the law brakes with the square of this.
    pub(super) fn pressure(&self, config: &IdmConfig, speed: f64) -> f64 {
        desired_gap(config, speed, self.speed) / self.gap.max(config.min_gap)
    }
}

/// The vehicle that looks ahead, on its path.
#[derive(Clone, Copy)]
pub(super) struct Observer<'a, Lateral> {
    pub(super) config: &'a IdmConfig,
    pub(super) path: &'a Path,
    /// Index of the vehicle itself among the obstacles.
    pub(super) own: usize,
    pub(super) s: f64,
    pub(super) speed: f64,
    /// Offset of the vehicle from the path when it will be at an arc length.
    pub(super) lateral: Lateral,
}

impl<Lateral: Fn(f64) -> f64> Observer<'_, Lateral> {
    /// The agent ahead that restrains the vehicle most; `None` on a free road.
    ///
    /// An agent is ahead when its centre is, and in the way when its box, turned into the frame of
    /// the path, reaches into the strip that the vehicle will sweep.
    pub(super) fn lead(&self, obstacles: &[Obstacle]) -> Option<Lead> {
        let me = &obstacles[self.own];
        let reach = me.half_length + self.reach();
        let mut worst: Option<(f64, Lead)> = None;
        for (i, other) in obstacles.iter().enumerate() {
            let limit = reach + other.radius;
            let apart = me.pose.position.distance_squared(other.pose.position);
            if i == self.own || apart > limit * limit {
                continue;
            }
            let Some(lead) = self.consider(me, other, reach) else {
                continue;
            };
            let pressure = lead.pressure(self.config, self.speed);
            if worst.is_none_or(|(most, _)| pressure > most) {
                worst = Some((pressure, lead));
            }
        }
        worst.map(|(_, lead)| lead)
    }

    /// Distance ahead within which agents are considered, metres: the distance of a comfortable
    /// stop, plus the same again as a margin, and 15 m for slow vehicles.
    fn reach(&self) -> f64 {
        let config = self.config;
        let stopping = self.speed * self.speed / (2.0 * config.max_deceleration);
        let margin = 15.0 + config.min_gap + self.speed * config.headway;
        (margin + 2.0 * stopping).min(config.look_ahead)
    }

    fn consider(&self, me: &Obstacle, other: &Obstacle, reach: f64) -> Option<Lead> {
        let foot = self
            .path
            .project(other.pose.position, self.s, self.s + reach + other.radius)?;
        if foot.s <= self.s {
            return None;
        }
        let offset = foot.lateral - (self.lateral)(foot.s);
        if offset.abs() >= me.half_width + other.radius {
            return None;
        }
        let (sin, cos) = (other.pose.heading - foot.heading).sin_cos();
        let across = (other.half_length * sin).abs() + (other.half_width * cos).abs();
        if offset.abs() >= me.half_width + across {
            return None;
        }
        let along = (other.half_length * cos).abs() + (other.half_width * sin).abs();
        let speed = other.velocity.dot(DVec2::from_angle(foot.heading));
        Some(Lead {
            gap: foot.s - along - self.s - me.half_length,
            speed: speed.min(harmless_speed(self.config, self.speed)),
        })
    }
}
