//! What a vehicle comes to on its lane: lines at which it stops, and the lane itself.
//!
//! Used by the rules of sampling (`right_of_way`, `keep_clear`) and by training, which judges drives.

use std::f64::consts::FRAC_PI_6;

use gump_geometry::{Pose, angle_difference};
use gump_model::relative::graph::Shown;
use gump_model::steps::TOKEN_DT;
use gump_scene::{Lane, MapGraph};

// All were chosen by hand.

/// A vehicle is on a lane if its centre is within this distance of the lane's, and it heads along it
/// within this angle.
const IN_LANE_M: f64 = 1.0;
const IN_LANE: f64 = FRAC_PI_6;
/// Hardly a driver brakes harder than this without need, m/s².
pub const BRAKES_MPS2: f64 = 3.0;
/// One that would have to brake harder than this for a line drives on, m/s²: below the 8 of a dry road.
pub const HARDEST_MPS2: f64 = 6.0;
/// The distance that a vehicle's front may be over a line and it still waits, metres.
pub const OVER_M: f64 = 0.5;
/// Drivers roll past stop signs at this speed at most, metres per second: hardly a recorded one is faster
/// at the line.
pub const ROLLS_MPS: f64 = 2.5;

/// The greatest speed of a vehicle before a line that it crosses at `least` metres per second at most;
/// infinite if it is over the line, or too fast to get there.
pub fn before_line(now: &Shown, metres: f64, least: f64) -> f64 {
    let room = metres - now.body.length / 2.0;
    let squared = now.velocity().length_squared() - least * least;
    if room < -OVER_M || squared > 2.0 * HARDEST_MPS2 * (room + OVER_M) {
        return f64::INFINITY;
    }
    (least * least + 2.0 * BRAKES_MPS2 * room.max(0.0)).sqrt()
}

/// The greatest speed of the next step after which a vehicle can still cross a line at `least` metres per
/// second, or stop before it at 0; infinite as in [`before_line`].
pub fn slowing_before(now: &Shown, metres: f64, least: f64) -> f64 {
    if before_line(now, metres, least).is_infinite() {
        return f64::INFINITY;
    }
    let room = (metres - now.body.length / 2.0).max(0.0);
    let squared = (2.0 * room + least * least / BRAKES_MPS2) / BRAKES_MPS2;
    let speed = BRAKES_MPS2 * ((TOKEN_DT * TOKEN_DT + squared).sqrt() - TOKEN_DT);
    speed.max(least)
}

/// Whether a stop sign applies to a lane: at its start if it is in a junction, at its end otherwise.
pub fn has_sign(streets: &MapGraph, lane: &Lane) -> bool {
    streets.stop_signs_of(lane.id).next().is_some()
}

/// The lane that a vehicle is on, and its distance from the start, metres.
pub fn lane_under(streets: &MapGraph, pose: Pose) -> Option<(&Lane, f64)> {
    let on = lanes_under(streets, pose);
    let (lane, at, _) = on.min_by(|a, b| a.2.total_cmp(&b.2))?;
    Some((lane, at))
}

/// All lanes that it may be on, its distance from the start, and from the centre, metres.
pub fn lanes_under(streets: &MapGraph, pose: Pose) -> impl Iterator<Item = (&Lane, f64, f64)> {
    let lanes = streets.lanes_near(pose.position, IN_LANE_M);
    lanes.filter_map(move |(lane, distance)| {
        let at = lane.centerline.project(pose.position).arc_length;
        let way = lane.centerline.pose_at(at).heading;
        (angle_difference(way, pose.heading).abs() <= IN_LANE).then_some((lane, at, distance))
    })
}
