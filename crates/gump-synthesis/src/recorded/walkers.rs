//! Pedestrians among parked vehicles: between them, along aisles and the road, to and from a
//! vehicle.
//!
//! Like parking manoeuvres they are added to the recording of traffic, and only if they stay clear
//! of all other agents.

use std::f64::consts::PI;

use gump_geometry::{DVec2, OrientedBox, Pose, angle_difference, wrap_angle};
use gump_scene::{AgentKind, Rng};
use rand::Rng as _;

use super::manoeuvres::{is_clear, is_off_road};
use crate::network::Network;
use crate::record::Recording;
use crate::traffic::{Body, draw_beside, draw_person_size};

// The number of people was fitted by hand to the targets (see the module above). Distances, speeds
// and the coefficients of `way` were chosen by eye, so that people walk past vehicles and do not
// get stuck between them; they were not varied one by one.
/// Maximum number of such pedestrians, or pairs of them, in a scene.
const MOST: f64 = 20.0;
/// Number of paths tried for each.
const TRIED: usize = 8;
/// Scenes with fewer parked vehicles near the centre have none.
const LEAST_PARKED: usize = 6;
/// Only vehicles this near to the centre of the scene are walked to, metres: the ego sees 79 m far.
const REACH_M: f64 = 70.0;
/// Length of a walk between vehicles, and to elsewhere, metres.
const WAY_M: [std::ops::Range<f64>; 2] = [6.0..70.0, 15.0..80.0];
/// Distances from the centre of a lane of a road, metres: beyond the first people are off the road;
/// from the second they may stand, as at the door of a vehicle beside the lane.
const OFF_ROAD_M: f64 = 2.4;
const ASIDE_ROAD_M: f64 = 1.3;
/// Distance kept to standing and to moving agents, metres: off the road, and on it, where traffic
/// does not give way to them.
const ROOM_M: [[f64; 2]; 2] = [[0.05, 0.5], [0.05, 2.5]];
/// Within this of a vehicle people step aside, metres.
const ASIDE_M: f64 = 1.0;
/// Fastest turn, radians per second.
const TURN_RATE: f64 = 1.8;
/// Change of walking speed, m/s².
const CHANGE: f64 = 1.2;

/// Share of those that walk away from a vehicle that appear when they begin to, and of those that walk
/// to one that vanish when they are there.
const GETS_OUT: f64 = 0.85;
const GETS_IN: f64 = 0.9;
/// Share of standing people that take a few steps, how far, metres, and how fast, m/s. Of those that stand
/// in recordings at all a fifth do so within nine seconds, and stand again.
const STEPS: f64 = 0.55;
const STEPS_M: std::ops::Range<f64> = 0.5..2.5;
const STEPS_MPS: std::ops::Range<f64> = 0.4..0.9;

/// Lets some of the people that stand take a few steps, if there is room.
pub(crate) fn shift(recording: &mut Recording, dt: f64, rng: &mut Rng) {
    let stands = |body: &Body| body.kind == AgentKind::Pedestrian && !body.is_mobile;
    let bodies = recording.tracks().map(|track| track.body);
    let standing: Vec<Body> = bodies.filter(stands).collect();
    for body in standing {
        if !rng.random_bool(STEPS) {
            continue;
        }
        let poses = steps(body.pose, recording.n_snapshots(), dt, rng);
        let size = [body.size[0], body.size[1]];
        if is_clear(recording, body.group, size, ROOM_M[0], &poses) {
            recording.move_along(body.id, poses);
        }
    }
}

/// Poses of a person that stands, takes a few steps and stands again, one per snapshot.
fn steps(from: Pose, n: usize, dt: f64, rng: &mut Rng) -> Vec<Option<Pose>> {
    let to = DVec2::from_angle(rng.random_range(-PI..PI)) * rng.random_range(STEPS_M);
    let pace = rng.random_range(STEPS_MPS);
    let starts = rng.random_range(-2.0..n as f64 * dt);
    let (mut pose, mut speed) = (from, 0.0_f64);
    let before = ((-starts).max(0.0) / dt) as usize;
    let mut poses = Vec::with_capacity(n);
    for step in 0..n + before {
        if step >= before {
            poses.push(Some(pose));
        }
        if (step as f64 - before as f64) * dt < starts {
            continue;
        }
        let left = from.position + to - pose.position;
        let turn = angle_difference(left.to_angle(), pose.heading);
        // Who faces away turns before the first step.
        let wanted = pace
            .min((2.0 * CHANGE * left.length()).sqrt())
            .min(pace * turn.cos().max(0.0));
        speed += (wanted - speed).clamp(-2.0 * CHANGE * dt, CHANGE * dt);
        if left.length() > 0.1 {
            let most = TURN_RATE * dt;
            pose.heading = wrap_angle(pose.heading + (4.0 * dt * turn).clamp(-most, most));
            pose.position += pose.direction() * (speed * dt).min(left.length());
        }
    }
    poses
}

/// Adds pedestrians that walk between the parked vehicles of a scene.
pub(crate) fn add(recording: &mut Recording, network: &Network, dt: f64, rng: &mut Rng) {
    let stands = |body: &Body| body.kind == AgentKind::Vehicle && !body.is_mobile;
    let bodies = recording.tracks().map(|track| track.body);
    let parked: Vec<OrientedBox> = bodies
        .filter(|body| stands(body) && body.pose.position.length() < REACH_M)
        .map(|body| OrientedBox {
            pose: body.pose,
            length: body.size[0],
            width: body.size[1],
        })
        .collect();
    if parked.len() < LEAST_PARKED {
        return;
    }
    let wanted = rng.random_range(0.0_f64..1.0).powi(3) * MOST;
    for _ in 0..wanted.round() as usize {
        for _ in 0..TRIED {
            let size = draw_person_size(rng);
            let Some(poses) = way(&parked, recording.n_snapshots(), dt, rng) else {
                continue;
            };
            let id = recording.new_id();
            let shown: Vec<Pose> = poses.iter().flatten().copied().collect();
            let off = |pose: &Pose| is_off_road(network, *pose, OFF_ROAD_M);
            let aside = |pose: &Pose| is_off_road(network, *pose, ASIDE_ROAD_M);
            if !aside(&shown[0]) || !shown.last().is_some_and(aside) {
                continue;
            }
            let room = ROOM_M[usize::from(!shown.iter().step_by(5).all(off))];
            if !is_clear(recording, id, [size[0], size[1]], room, &poses) {
                continue;
            }
            recording.add(person((id, id), size, shown[0]), poses.clone());
            if rng.random_bool(0.35) {
                // A companion beside, if there is room.
                let beside = Pose::new(rng.random_range(-0.3..0.3), draw_beside(rng), 0.0);
                let poses: Vec<Option<Pose>> =
                    poses.iter().map(|pose| pose.map(|p| p * beside)).collect();
                let (other, size) = (recording.new_id(), draw_person_size(rng));
                if is_clear(recording, id, [size[0], size[1]], room, &poses) {
                    let first = *poses.iter().flatten().next().expect("somebody is shown");
                    recording.add(person((other, id), size, first), poses);
                }
            }
            break;
        }
    }
}

fn person((id, group): (i64, i64), size: [f64; 3], pose: Pose) -> Body {
    Body {
        id,
        group,
        kind: AgentKind::Pedestrian,
        size,
        pose,
        is_mobile: true,
        place: None,
    }
}

/// Poses of a pedestrian that walks from or to the side of a parked vehicle, one per snapshot while
/// present; `None` if the path is blocked.
fn way(parked: &[OrientedBox], n: usize, dt: f64, rng: &mut Rng) -> Option<Vec<Option<Pose>>> {
    let door = |rng: &mut Rng| {
        let vehicle = &parked[rng.random_range(0..parked.len())];
        let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
        let aside = side * (0.5 * vehicle.width + rng.random_range(0.5..0.75));
        let along = rng.random_range(-0.3..0.3) * vehicle.length;
        vehicle.pose * DVec2::new(along, aside)
    };
    let away = DVec2::from_angle(rng.random_range(-PI..PI)) * rng.random_range(WAY_M[1].clone());
    let from = door(rng);
    let to = if rng.random_bool(0.3) {
        door(rng)
    } else {
        from + away
    };
    if !WAY_M[0].contains(&from.distance(to)) && !WAY_M[1].contains(&from.distance(to)) {
        return None;
    }
    // To the vehicle as often as from it. Most people get out when they begin to walk.
    let (from, to, begins_inside, ends_inside) = match rng.random_bool(0.5) {
        true => (from, to, rng.random_bool(GETS_OUT), false),
        false => (to, from, false, rng.random_bool(GETS_IN)),
    };
    let near: Vec<&OrientedBox> = parked
        .iter()
        .filter(|vehicle| {
            let (a, b) = (vehicle.pose.position - from, to - from);
            let foot = b * (a.dot(b) / b.length_squared()).clamp(0.0, 1.0);
            a.distance(foot) < 12.0
        })
        .collect();
    let pace: f64 = rng.random_range(0.8..1.8);
    let starts: f64 = match begins_inside {
        true => rng.random_range(-20.0..8.0),
        false => rng.random_range(-25.0..0.0),
    };
    let mut pose = Pose {
        position: from,
        heading: wrap_angle((to - from).to_angle() + rng.random_range(-0.4..0.4)),
    };
    let (mut speed, mut turning) = (0.0_f64, 0.0_f64);
    let before = ((-starts).max(0.0) / dt) as usize;
    let mut poses = Vec::with_capacity(n);
    let (mut stuck, mut is_there) = (0.0, false);
    for step in 0..n + before {
        let is_inside = (step as f64 - before as f64) * dt < starts;
        if step >= before {
            let hidden = is_inside && begins_inside || is_there && ends_inside;
            poses.push((!hidden).then_some(pose));
        }
        if is_inside || is_there {
            continue;
        }
        let left = to - pose.position;
        is_there = left.length() < 0.4;
        let mut wish = left.normalize();
        for vehicle in &near {
            let local = vehicle.pose.inverse() * pose.position;
            let half = 0.5 * DVec2::new(vehicle.length, vehicle.width);
            let nearest = local.clamp(-half, half);
            let gap = vehicle.pose.rotate(local - nearest);
            let distance = gap.length();
            if distance < 1e-6 {
                return None;
            }
            // Past the vehicle rather than back.
            let push = 1.8 * (1.0 - (distance - 0.3) / ASIDE_M).clamp(0.0, 1.5);
            wish += gap / distance * push;
        }
        turning += rng.random_range(-1.0..1.0) * dt.sqrt() * 0.25 - turning * 0.5 * dt;
        let turn = angle_difference(wish.to_angle() + turning, pose.heading);
        let most = TURN_RATE * dt;
        pose.heading = wrap_angle(pose.heading + (4.0 * dt * turn).clamp(-most, most));
        let wanted = pace
            .min((2.0 * CHANGE * left.length()).sqrt())
            .min(pace * turn.cos().max(0.15));
        speed += (wanted - speed).clamp(-2.0 * CHANGE * dt, CHANGE * dt);
        let moved = pose.direction() * (speed * dt);
        stuck += if moved.dot(left) > 0.0 { -dt } else { dt };
        if stuck > 1.5 {
            return None;
        }
        stuck = f64::max(stuck, 0.0);
        pose.position += moved;
    }
    poses.iter().any(Option::is_some).then_some(poses)
}
