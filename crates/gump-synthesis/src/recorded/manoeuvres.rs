//! Vehicles that leave or enter a car park or a driveway: slowly, often in reverse, off lanes.
//!
//! Simulated traffic follows lanes, so these are added to the recording of it: a parked vehicle
//! gets a path out of its place, or the same path backwards in time, if the path stays clear of all
//! other agents. Others do not react, and the paths stay off the roads.

use gump_geometry::{DVec2, OrientedBox, Pose, wrap_angle};
use gump_scene::{AgentKind, Rng};
use rand::Rng as _;

use crate::network::Network;
use crate::plan::CAR_PARK_SPEED;
use crate::record::Recording;
use crate::steering::REAR_AXLE;
use crate::traffic::Body;

// Numbers are chosen by hand; no target measures how many vehicles park.
/// Maximum number of such vehicles in a scene.
const MOST: usize = 4;
/// Number of parked vehicles tried, and paths for each.
const TRIED: usize = 40;
const PATHS: usize = 5;
/// Only vehicles this near to the centre of the scene are tried, metres: the ego sees 79 m far.
const REACH_M: f64 = 70.0;
/// From the centre of a lane of a road, metres: half a lane, half a vehicle, and 0.4 m. Lanes of
/// car parks may be driven on.
const OFF_ROAD_M: f64 = 3.4;
/// Distance kept to standing and to moving agents, metres. Chosen by eye.
const ROOM_M: [f64; 2] = [0.15, 0.8];
/// Speed of the first part of a way out of a place, or the last one into it, in reverse as well, and
/// of the other part, m/s.
const NEAR_PLACE_MPS: std::ops::Range<f64> = 0.8..2.0;
const ON_WAY_MPS: std::ops::Range<f64> = 2.0..5.5;
/// Tightest turn, 1/m: a radius of 5 m, as passenger cars have.
const CURVATURE: f64 = 0.2;

/// Makes some parked vehicles leave or arrive.
pub(crate) fn add(recording: &mut Recording, network: &Network, dt: f64, rng: &mut Rng) {
    let wanted = (rng.random_range(0.0_f64..1.0).powi(2) * (MOST as f64 + 0.99)) as usize;
    if wanted == 0 {
        return;
    }
    let parked = recording.tracks().filter(|track| {
        let near = |pose: Pose| pose.position.length() < REACH_M;
        let body = &track.body;
        body.kind == AgentKind::Vehicle && !body.is_mobile && track.pose(0).is_some_and(near)
    });
    let mut parked: Vec<Body> = parked.map(|track| track.body).collect();
    let mut left = wanted;
    for _ in 0..TRIED.min(parked.len()) {
        let body = parked.swap_remove(rng.random_range(0..parked.len()));
        let (id, size) = (body.id, [body.size[0], body.size[1]]);
        for _ in 0..PATHS {
            let poses = path(body.pose, size[0], recording.n_snapshots(), dt, rng);
            let stays_off = poses
                .iter()
                .step_by(5)
                .all(|pose| is_off_road(network, *pose, OFF_ROAD_M));
            let poses: Vec<Option<Pose>> = poses.into_iter().map(Some).collect();
            if stays_off && is_clear(recording, id, size, ROOM_M, &poses) {
                recording.move_along(id, poses);
                left -= 1;
                break;
            }
        }
        if left == 0 {
            return;
        }
    }
}

/// Poses of a vehicle that leaves `parked`, or stops there, one per snapshot.
fn path(parked: Pose, length: f64, n: usize, dt: f64, rng: &mut Rng) -> Vec<Pose> {
    let axle = REAR_AXLE * length;
    let mut rear = parked * Pose::new(-axle, 0.0, 0.0);
    let centre = |rear: Pose| rear * Pose::new(axle, 0.0, 0.0);
    // An arrival is driven backwards in time, so its gears are the other ones here.
    let arrives = rng.random_bool(0.45);
    let backs_out = rng.random_bool(0.65);
    let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    // First out of the place, then on its way.
    let first_gear = if backs_out { -1.0 } else { 1.0 };
    let second_gear = if arrives { -1.0 } else { 1.0 };
    let changes_gear = backs_out != arrives;
    let first_metres = rng.random_range(4.0..8.5);
    let first_speed: f64 = rng.random_range(NEAR_PLACE_MPS);
    let straight = rng.random_range(0.5..3.0);
    let first_turn = side * rng.random_range(0.08..CURVATURE);
    // The other way: after a change of gear the vehicle turns on, else it straightens.
    let mut second_turn = -side * rng.random_range(-0.05..CURVATURE);
    let second_speed = rng.random_range(ON_WAY_MPS);
    let pause = rng.random_range(0.3..1.6);
    let haste = rng.random_range(0.5..1.3);
    let starts = rng.random_range(-0.6..0.85) * n as f64 * dt;
    let (mut driven, mut speed, mut paused, mut turn) = (0.0_f64, 0.0_f64, 0.0, 0.0_f64);
    let mut poses = Vec::with_capacity(n);
    let before = ((-starts).max(0.0) / dt) as usize;
    for step in 0..n + before {
        if step >= before {
            poses.push(centre(rear));
        }
        if (step as f64 - before as f64) * dt < starts {
            continue;
        }
        let leaving = driven < first_metres;
        let (gear, wanted, aim) = if leaving {
            let left = first_metres - driven;
            // It stops at the end of the first part if it has to change gear.
            let stops = if changes_gear {
                (1.6 * left).sqrt() + 0.05
            } else {
                f64::INFINITY
            };
            let aim = if driven < straight { 0.0 } else { first_turn };
            (first_gear, first_speed.min(stops), aim)
        } else {
            if changes_gear && paused < pause {
                (paused, speed) = (paused + dt, 0.0);
                continue;
            }
            second_turn *= 1.0 - 0.25 * dt;
            second_turn += rng.random_range(-0.06..0.06) * dt.sqrt();
            second_turn = second_turn.clamp(-CURVATURE, CURVATURE);
            (second_gear, second_speed, second_turn)
        };
        speed += (wanted - speed).clamp(-2.0 * dt, haste * dt);
        turn += (aim - turn).clamp(-0.15 * dt, 0.15 * dt);
        let metres = speed * dt;
        driven += metres;
        let bent = turn * gear * metres;
        let middle = rear.heading + bent / 2.0;
        rear = Pose {
            position: rear.position + DVec2::from_angle(middle) * (gear * metres),
            heading: wrap_angle(rear.heading + bent),
        };
    }
    if arrives {
        poses.reverse();
    }
    poses
}

/// True if a pose is this far from the centres of all lanes of roads, metres.
pub(super) fn is_off_road(network: &Network, pose: Pose, far: f64) -> bool {
    network.lanes.iter().all(|lane| {
        let is_road = lane.speed_limit >= CAR_PARK_SPEED;
        let foot = |p: DVec2| lane.track.pose_at(lane.track.project(p)).position;
        !is_road || foot(pose.position).distance(pose.position) > far
    })
}

/// True if a body of this length and width on this path, one pose per snapshot, keeps its distance
/// to all agents of other groups, standing and moving.
pub(super) fn is_clear(
    recording: &Recording,
    group: i64,
    [length, width]: [f64; 2],
    rooms: [f64; 2],
    poses: &[Option<Pose>],
) -> bool {
    let mut others = recording.tracks().filter(|track| track.body.group != group);
    others.all(|other| {
        let [l, w, _] = other.body.size;
        let room = rooms[usize::from(other.body.is_mobile)];
        let own = |pose: Pose| OrientedBox {
            pose,
            length: length + 2.0 * room,
            width: width + 2.0 * room,
        };
        let near = length.hypot(width) / 2.0 + 2.0 * room + l.hypot(w) / 2.0;
        poses.iter().enumerate().all(|(i, pose)| {
            let (Some(pose), Some(at)) = (*pose, other.pose_at_snapshot(i)) else {
                return true;
            };
            let theirs = OrientedBox {
                pose: at,
                length: l,
                width: w,
            };
            at.position.distance(pose.position) >= near || !own(pose).overlaps(&theirs)
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::Seed;

    #[test]
    fn nobody_reverses_fast() {
        let dt = 0.1;
        for seed in 0..200 {
            let mut rng = Seed(seed).rng();
            let poses = path(Pose::new(3.0, -2.0, 0.7), 4.7, 91, dt, &mut rng);
            for pair in poses.windows(2) {
                let step = pair[1].position - pair[0].position;
                let ahead = step.dot(pair[0].direction()) / dt;
                assert!((-2.05..5.6).contains(&ahead), "seed {seed}: {ahead} m/s");
            }
        }
    }
}
