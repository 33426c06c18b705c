//! Whether an object leaves one behind it room to stop, and crosses nobody's way right before it.
//!
//! Objects are drawn one after another, each with a speed of its own. Without this check a vehicle at
//! 10 m/s appears a few metres behind one that stands, and of 108 scenes 24 had an overlap within the
//! first seconds (result 58).
//!
//! `has_headway` of `spawning.rs` in `gump-engine` asks the same of an agent that enters a running scene at
//! the border. That looks straight ahead, since whoever enters follows a road; here a place may be before a
//! bend or a fork, so the lanes are followed.

use gump_geometry::{DVec2, OrientedBox, Polyline};
use gump_scene::MapGraph;

use crate::reason::{lane_of, ways};

/// Time to what is ahead, seconds, and the braking that suffices to stop behind it, metres per second
/// squared: shorter and harder than drivers do, so that only what cannot go well is refused. Chosen by
/// hand.
const HEADWAY_S: f64 = 0.4;
const BRAKES: f64 = 3.0;
/// Nobody meets another within these times if both go straight on, seconds.
const SOON_S: [f64; 2] = [0.5, 1.0];
/// Space beside one that drives, metres: what is nearer to its way is ahead of it.
const BESIDE_M: f64 = 0.2;
/// Who is slower needs no room, metres per second: it stands.
const STANDS: f64 = 0.5;

/// A box and its velocity, world frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Moving {
    pub(crate) outline: OrientedBox,
    pub(crate) velocity: DVec2,
}

impl Moving {
    /// True if the two overlap soon, going straight on.
    pub(crate) fn meets(&self, other: &Self) -> bool {
        let after = |one: &Self, seconds: f64| {
            let mut outline = one.outline;
            outline.pose.position += one.velocity * seconds;
            outline
        };
        SOON_S
            .iter()
            .any(|&seconds| after(self, seconds).overlaps(&after(other, seconds)))
    }

    /// True if it is on a way on which it cannot stop before `other`: on all of them, if there are several.
    pub(crate) fn runs_into(&self, other: &Self, map: &MapGraph) -> bool {
        let speed = self.velocity.length();
        let (own, its) = (&self.outline, &other.outline);
        let apart = its.pose.position - own.pose.position;
        let reach = room(speed, -other.velocity.length()) + (own.length + its.length) / 2.0;
        let is_ahead = apart.dot(DVec2::from_angle(own.pose.heading)) > 0.0;
        if speed < STANDS || !is_ahead || apart.length() > reach {
            return false;
        }
        let is_short = |way: &Polyline| {
            let start = way.project(own.pose.position);
            let needed = |at: DVec2| {
                let foot = way.project(at);
                let gap = foot.arc_length - start.arc_length - own.length / 2.0;
                let along = DVec2::from_angle(way.pose_at(foot.arc_length).heading);
                let is_before = foot.arc_length > start.arc_length
                    && foot.distance < own.width / 2.0 + BESIDE_M;
                is_before && gap < room(speed, other.velocity.dot(along))
            };
            let mut points = its.corners().into_iter().chain([its.pose.position]);
            points.any(needed)
        };
        match lane_of(own.pose, map) {
            Some(lane) => {
                let from = lane.centerline.project(own.pose.position).arc_length;
                ways(map, lane, from).iter().all(|(_, way)| is_short(way))
            }
            None => {
                let ahead = DVec2::from_angle(own.pose.heading) * (reach + own.length);
                let way = vec![own.pose.position, own.pose.position + ahead];
                Polyline::new(way).is_some_and(|way| is_short(&way))
            }
        }
    }
}

/// The room before one with this speed towards one that moves so fast in the same direction, metres.
fn room(speed: f64, ahead: f64) -> f64 {
    let brakes = match ahead < 0.0 {
        true => speed.powi(2) + ahead.powi(2),
        false => (speed - ahead).max(0.0).powi(2),
    };
    HEADWAY_S * speed + brakes / (2.0 * BRAKES)
}

#[cfg(test)]
mod tests {
    use gump_geometry::Pose;
    use gump_scene::fixture;

    use super::*;

    fn moving(x: f64, y: f64, heading: f64, speed: f64) -> Moving {
        Moving {
            outline: OrientedBox {
                pose: Pose::new(x, y, heading),
                length: 4.0,
                width: 2.0,
            },
            velocity: DVec2::from_angle(heading) * speed,
        }
    }

    #[test]
    fn who_drives_can_stop_behind_who_is_ahead() {
        let text = "lane 1: 0,0 60,0 next 2,3\nlane 2: 60,0 120,0\nlane 3: 60,0 80,10 90,40\n\
                    ego vehicle 0: 0,0";
        let map = fixture::scenario(text).unwrap().map;
        let own = moving(10.0, 0.1, 0.0, 9.0);
        let meets = |other: Moving| own.runs_into(&other, &map);
        // 3.6 m of headway and 13.5 m to stop, from bumper to bumper.
        assert!(meets(moving(31.0, 0.0, 0.0, 0.0)) && !meets(moving(31.2, 0.0, 0.0, 0.0)));
        assert!(meets(moving(17.5, 0.0, 0.0, 9.0)) && !meets(moving(17.7, 0.0, 0.0, 9.0)));
        // Who is behind, beside or in the next lane is in nobody's way, nor before one that stands.
        assert!(!meets(moving(4.0, 0.0, 0.0, 0.0)) && !meets(moving(20.0, 3.0, 0.0, 0.0)));
        assert!(!moving(10.0, 0.0, 0.0, 0.0).runs_into(&moving(15.0, 0.0, 0.0, 0.0), &map));
        // Who comes towards it needs room, too, and who is across.
        assert!(meets(moving(40.0, 0.0, 3.1, 9.0)) && !meets(moving(50.0, 0.0, 3.1, 9.0)));
        assert!(meets(moving(25.0, 1.5, 1.6, 2.0)));
        // Who comes from the side is met after half a second or one, or passes behind.
        let crosses = |x: f64, y: f64| own.meets(&moving(x, y, 1.571, 9.0));
        assert!(crosses(16.0, -5.0) && crosses(19.0, -9.0));
        assert!(!crosses(16.0, 3.0) && !crosses(19.0, -20.0));
        assert!(!own.meets(&moving(10.0, 3.0, 0.0, 12.0)));
        // Where the road forks it takes the free way.
        let at_fork = moving(55.0, 0.0, 0.0, 9.0);
        assert!(!at_fork.runs_into(&moving(75.0, 0.0, 0.0, 0.0), &map));
        assert!(at_fork.runs_into(&moving(62.0, 0.0, 0.0, 0.0), &map));
        // Beside all lanes it goes straight on.
        let astray = moving(10.0, 30.0, 0.0, 9.0);
        assert!(astray.runs_into(&moving(25.0, 30.0, 0.0, 0.0), &map));
        assert!(!astray.runs_into(&moving(25.0, 34.0, 0.0, 0.0), &map));
    }
}
