//! Time to collision if all agents continued straight on.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, OrientedBox};
use gump_metrics::bearing::{is_ahead, is_behind};
use gump_metrics::encounter::speed;
use gump_scene::{Agent, AgentId};

use super::collision::Collisions;
use super::history::SimulationHistory;

/// A slower ego is never about to collide, metres per second.
///
/// Source: nuplan-devkit.
const STANDING: f64 = 0.005;

/// Horizon and threshold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeToCollisionConfig {
    /// Time step of the search, seconds.
    pub step: f64,
    /// Horizon, exclusive, seconds.
    pub horizon: f64,
    /// Every time must exceed this, seconds.
    pub least: f64,
}

impl Default for TimeToCollisionConfig {
    /// The values of nuPlan's challenges.
    fn default() -> Self {
        Self {
            step: 0.1,
            horizon: 3.0,
            least: 0.95,
        }
    }
}

/// The series, and whether it stayed above the threshold.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeToCollision {
    /// 1 if every value exceeds the threshold, else 0.
    pub score: f64,
    /// Per sample, seconds; infinite without a collision ahead, 0 where the ego collides at its own
    /// fault.
    pub series: Vec<f64>,
}

impl TimeToCollision {
    /// The smallest time, seconds.
    pub fn min(&self) -> f64 {
        self.series.iter().copied().fold(f64::INFINITY, f64::min)
    }
}

/// Where on the road the ego is, as far as times to collision depend on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RoadContext {
    /// Within one lane or within connected ones.
    pub in_one_lane: bool,
    /// The rear axle is in an intersection.
    pub in_intersection: bool,
}

/// Measures the times of a drive; one context per sample.
///
/// Agents ahead always count; those to the side only in intersections and when the ego is not
/// within one lane; those behind never, nor those the ego has already collided with.
///
/// Source: nuPlan's `time_to_collision_within_bound`: headings determine the directions of motion.
pub fn time_to_collision(
    drive: &SimulationHistory<'_>,
    contexts: &[RoadContext],
    collisions: &Collisions,
    config: &TimeToCollisionConfig,
) -> TimeToCollision {
    let hit_at: BTreeMap<AgentId, usize> = collisions
        .events
        .iter()
        .map(|event| (event.agent, event.sample))
        .collect();
    let series = drive.samples.iter().zip(contexts).enumerate();
    let series = series.map(|(i, (sample, context))| {
        if collisions.at_fault().any(|event| event.sample == i) {
            return 0.0;
        }
        let ego_speed = sample.ego.speed();
        if ego_speed <= STANDING {
            return f64::INFINITY;
        }
        let rear_axle = sample.ego.rear_axle;
        let looks_aside = !context.in_one_lane || context.in_intersection;
        let counts = |agent: &&Agent| {
            let at = agent.state.pose.position;
            let may_hit = hit_at.get(&agent.id).is_none_or(|&first| first > i);
            may_hit && (is_ahead(rear_axle, at) || (looks_aside && !is_behind(rear_axle, at)))
        };
        let footprint = drive.footprint(sample);
        let ego = Moving::new(footprint, ego_speed);
        let others = drive.others(sample).filter(counts);
        others
            .filter_map(|agent| {
                let other = Moving::new(agent.oriented_box(), speed(agent));
                first_instant(contact(&ego, &other)?, config)
            })
            .fold(f64::INFINITY, f64::min)
    });
    let series: Vec<f64> = series.collect();
    let holds = series.iter().all(|time| *time > config.least);
    TimeToCollision {
        score: f64::from(holds),
        series,
    }
}

/// A box that moves along its heading.
struct Moving {
    shape: OrientedBox,
    forward: DVec2,
    velocity: DVec2,
}

impl Moving {
    fn new(shape: OrientedBox, speed: f64) -> Self {
        let forward = shape.pose.direction();
        Self {
            shape,
            forward,
            velocity: forward * speed,
        }
    }

    /// Half the extent along a unit vector.
    fn reach(&self, axis: DVec2) -> f64 {
        let (along, across) = (self.forward.dot(axis), self.forward.perp().dot(axis));
        (self.shape.length * along.abs() + self.shape.width * across.abs()) / 2.0
    }
}

/// Tolerance for rounding at contact, metres.
const TOUCH: f64 = 1e-9;

/// The times in which two boxes intersect, if they do at any time from now on, seconds.
///
/// Along each of the four axes of the boxes the projections meet during one interval; the boxes
/// do while all four last.
fn contact(a: &Moving, b: &Moving) -> Option<(f64, f64)> {
    let offset = b.shape.pose.position - a.shape.pose.position;
    let velocity = b.velocity - a.velocity;
    let axes = [a.forward, a.forward.perp(), b.forward, b.forward.perp()];
    let mut span = (0.0f64, f64::INFINITY);
    for axis in axes {
        let reach = a.reach(axis) + b.reach(axis) + TOUCH;
        let (gap, closing) = (offset.dot(axis), velocity.dot(axis));
        if closing == 0.0 {
            if gap.abs() > reach {
                return None;
            }
            continue;
        }
        let (t0, t1) = ((-reach - gap) / closing, (reach - gap) / closing);
        span = (span.0.max(t0.min(t1)), span.1.min(t0.max(t1)));
        if span.0 > span.1 {
            return None;
        }
    }
    Some(span)
}

/// The first sampled instant within a time span.
fn first_instant((from, to): (f64, f64), config: &TimeToCollisionConfig) -> Option<f64> {
    let n = ((config.horizon - config.step) / config.step).ceil();
    let k = ((from - config.step) / config.step).ceil().max(0.0);
    // The division may round up past an instant that the span just includes.
    let candidates = [k - 1.0, k, k + 1.0].into_iter();
    candidates
        .filter(|k| 0.0 <= *k && *k < n)
        .map(|k| config.step + k * config.step)
        .find(|t| from <= *t && *t <= to)
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::Pose;

    fn moving(x: f64, y: f64, heading: f64, speed: f64) -> Moving {
        let shape = OrientedBox {
            pose: Pose::new(x, y, heading),
            length: 4.0,
            width: 2.0,
        };
        Moving::new(shape, speed)
    }

    /// The reference implementation: moves both boxes step by step.
    fn by_steps(a: &Moving, b: &Moving, config: &TimeToCollisionConfig) -> Option<f64> {
        let n = ((config.horizon - config.step) / config.step).ceil() as usize;
        let at = |moving: &Moving, t: f64| {
            let mut shape = moving.shape;
            shape.pose.position += moving.velocity * t;
            shape
        };
        (0..n)
            .map(|k| config.step + k as f64 * config.step)
            .find(|&t| at(a, t).touches(&at(b, t)))
    }

    #[test]
    fn the_closed_form_equals_stepping() {
        let config = TimeToCollisionConfig::default();
        let mut n_contacts = 0;
        for i in 0..2000 {
            let x = f64::from(i);
            let spread = |f: f64, scale: f64| ((x * f).sin() * 43_758.547).fract() * scale;
            let a = moving(0.0, 0.0, spread(1.3, 3.0), spread(2.9, 12.0).abs());
            let b = moving(
                spread(7.1, 25.0),
                spread(3.7, 25.0),
                spread(5.3, 3.1),
                spread(9.7, 12.0).abs(),
            );
            let fast = contact(&a, &b).and_then(|span| first_instant(span, &config));
            let slow = by_steps(&a, &b, &config);
            assert_eq!(fast, slow, "case {i}");
            n_contacts += usize::from(fast.is_some());
        }
        assert!(n_contacts > 100, "only {n_contacts} contacts");
    }

    #[test]
    fn contact_is_first_looked_for_after_a_step() {
        let config = TimeToCollisionConfig::default();
        let check = |gap: f64, expected: Option<f64>| {
            let span = contact(
                &moving(0.0, 0.0, 0.0, 10.0),
                &moving(4.0 + gap, 0.0, 0.0, 0.0),
            );
            let found = span.and_then(|span| first_instant(span, &config));
            match (found, expected) {
                (Some(found), Some(expected)) => assert!((found - expected).abs() < 1e-9),
                _ => assert_eq!(found, expected),
            }
        };
        check(-1.0, Some(0.1));
        check(4.95, Some(0.5));
        check(28.9, Some(2.9));
        check(29.5, None);
    }
}
