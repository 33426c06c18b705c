//! Vehicles that turn off the road into a driveway.
//!
//! No lane leads there, so after the simulation the way of a vehicle that passes a driveway is changed:
//! it slows down, turns in and stops in the yard. Others do not react, so that it is left alone unless
//! it stays clear of them.

use std::f64::consts::FRAC_PI_2;
use std::ops::Range;

use gump_geometry::{DVec2, Pose, angle_difference, wrap_angle};
use gump_scene::{AgentKind, Rng};
use rand::Rng as _;
use rand::seq::SliceRandom as _;

use super::driveways::Driveway;
use super::manoeuvres::{is_clear, is_off_road};
use crate::curve::{Track, connect, line};
use crate::network::Network;
use crate::record::Recording;
use crate::steering::draw_along;

// Numbers are chosen by hand, so that as many vehicles with a driveway ahead turn in as in recordings: of
// 154 of `datasets/benchmarks/recorded.toml#train` on a lane, at 0.5 to 10 m/s and with a driveway within
// 40 m ahead, 3.9 % leave the road within eight seconds.
/// Vehicles of a scene that turn in, at most, and driveways tried for each.
const MOST: usize = 2;
const TRIED: usize = 8;
/// Longest such vehicle, metres.
const LONGEST: f64 = 6.2;
/// From the curb to the middle of the vehicle where it passes, metres: on its side of the road, and on the
/// other one.
const NEAR_M: Range<f64> = 1.2..4.6;
const FAR_M: Range<f64> = 4.6..9.0;
/// Metres before the driveway at which the turn begins.
const BEFORE_M: [Range<f64>; 2] = [6.0..9.5, 8.0..12.0];
/// Metres behind the curb at which the turn ends, and the farthest from the corner of its ways at which it
/// begins.
const MOUTH_M: f64 = 4.0;
const REACH_M: f64 = 8.0;
/// Speed in the turn, m/s, and deceleration before it, m/s².
const TURN_MPS: Range<f64> = 2.0..4.6;
const BRAKING: Range<f64> = 0.8..2.4;
/// Deceleration in the yard, m/s², and how far from the curb the vehicle comes to rest, metres.
const STOPS: f64 = 0.9;
const INSIDE_M: Range<f64> = 5.0..12.0;
/// Tightest turn, 1/m: a radius of 4.2 m of the middle of a car, of 5 m or more of its front wheels.
const CURVATURE: f64 = 0.24;
/// Distance kept to standing and to moving agents, metres: on the own side of the road, and across the
/// other one.
const ROOM_M: [[f64; 2]; 2] = [[0.1, 1.2], [0.1, 2.5]];
/// Metres from all lanes of roads at which it comes to rest.
const OFF_ROAD_M: f64 = 4.5;

/// Lets some vehicles turn into driveways.
pub(crate) fn add(
    recording: &mut Recording,
    network: &Network,
    driveways: &[Driveway],
    dt: f64,
    rng: &mut Rng,
) {
    if driveways.is_empty() {
        return;
    }
    let suits = |track: &&crate::record::Track| {
        let body = track.body;
        body.kind == AgentKind::Vehicle
            && body.is_mobile
            && body.size[0] < LONGEST
            && !track.places().is_empty()
            && track.is_complete()
            && track.distance_driven() > 10.0
    };
    let mut able: Vec<i64> = recording
        .tracks()
        .filter(suits)
        .map(|t| t.body.id)
        .collect();
    let wanted = rng.random_range(0..=MOST);
    able.shuffle(rng);
    let mut left = wanted;
    for id in able {
        if left == 0 {
            return;
        }
        let track = recording.track(id).expect("it is recorded");
        let body = track.body;
        let snapshots = 0..recording.n_snapshots();
        let recorded: Vec<Pose> = snapshots
            .filter_map(|i| track.pose_at_snapshot(i))
            .collect();
        let mut passed: Vec<&Driveway> = driveways
            .iter()
            .filter(|driveway| passes(&recorded, driveway).is_some())
            .collect();
        passed.shuffle(rng);
        for driveway in passed.into_iter().take(TRIED) {
            let Some((mut poses, end, room)) = way_in(&recorded, driveway, dt, rng) else {
                continue;
            };
            draw_along(&mut poses, body.size[0]);
            let poses: Vec<Option<Pose>> = poses.into_iter().map(Some).collect();
            let size = [body.size[0], body.size[1]];
            if is_off_road(network, end, OFF_ROAD_M)
                && is_clear(recording, body.group, size, room, &poses)
            {
                recording.turn_off(id, poses);
                left -= 1;
                break;
            }
        }
    }
}

/// The snapshot at which a vehicle is past a driveway, if it passes it on the road.
fn passes(poses: &[Pose], driveway: &Driveway) -> Option<usize> {
    let local = |pose: &Pose| driveway.curb.inverse() * pose.position;
    (1..poses.len()).find(|&i| {
        let (before, after) = (local(&poses[i - 1]), local(&poses[i]));
        let turn = angle_difference(poses[i].heading, driveway.curb.heading);
        (before.x < 0.0) != (after.x < 0.0)
            && turn.cos().abs() > 0.95
            && (NEAR_M.start..FAR_M.end).contains(&-after.y)
    })
}

/// The poses of a vehicle that turns into a driveway instead of passing it, where it comes to rest, now or
/// later, and the room it needs; `None` if
/// it does not pass, cannot slow down in time, or could not turn so tightly.
fn way_in(
    poses: &[Pose],
    driveway: &Driveway,
    dt: f64,
    rng: &mut Rng,
) -> Option<(Vec<Pose>, Pose, [f64; 2])> {
    let mut arc = vec![0.0];
    for pair in poses.windows(2) {
        let step = pair[1].position.distance(pair[0].position);
        arc.push(arc[arc.len() - 1] + step);
    }
    let passes = passes(poses, driveway)?;
    let aside = driveway.curb.inverse() * poses[passes].position;
    let side = usize::from(-aside.y > NEAR_M.end);
    let begins = arc[passes] - rng.random_range(BEFORE_M[side].clone());
    let (pace, braking) = (rng.random_range(TURN_MPS), rng.random_range(BRAKING));
    let depth = rng.random_range(INSIDE_M);
    // Where the turn begins: between two snapshots, after what it takes to slow down.
    let at = arc.iter().rposition(|&s| s <= begins)?;
    if at + 1 >= poses.len() || arc[at + 1] - arc[at] < 1e-3 {
        return None;
    }
    let part = (begins - arc[at]) / (arc[at + 1] - arc[at]);
    let bend = angle_difference(poses[at + 1].heading, poses[at].heading);
    let start = Pose {
        position: poses[at].position.lerp(poses[at + 1].position, part),
        heading: wrap_angle(poses[at].heading + part * bend),
    };
    let aside = rng.random_range(-0.25..0.25) * driveway.width.min(4.0) / 2.0;
    let mouth = driveway.curb * Pose::new(aside, MOUTH_M, FRAC_PI_2);
    let mut points = connect(start, mouth, [0.0; 2], REACH_M);
    let end = driveway.curb * DVec2::new(aside, depth);
    points.extend(line(mouth.position, end));
    let turn = Track::through(&points);
    if turn.curvatures().iter().any(|k| k.abs() > CURVATURE) {
        return None;
    }
    let allowed = |s: f64| {
        if s < begins {
            (pace * pace + 2.0 * braking * (begins - s)).sqrt()
        } else {
            let left = (turn.length() - (s - begins)).max(0.0);
            pace.min((2.0 * STOPS * left).sqrt())
        }
    };
    let recorded = |i: usize| (arc[(i + 1).min(arc.len() - 1)] - arc[i]) / dt;
    if recorded(0) > allowed(0.0) {
        return None;
    }
    // As recorded until it has to slow down.
    let slows =
        (0..poses.len() - 1).find(|&i| recorded(i) > allowed(arc[i]) || arc[i] >= begins)?;
    let mut way = poses[..=slows].to_vec();
    let (mut s, mut speed) = (arc[slows], recorded(slows.saturating_sub(1)));
    while way.len() < poses.len() {
        let change = allowed(s) - speed;
        speed = (speed + change.clamp(-3.5 * dt, 1.0 * dt)).max(0.0);
        s += speed * dt;
        let pose = if s < begins {
            let at = arc.iter().rposition(|&x| x <= s)?;
            let step = (arc[(at + 1).min(arc.len() - 1)] - arc[at]).max(1e-6);
            let next = poses[(at + 1).min(poses.len() - 1)];
            let part = ((s - arc[at]) / step).min(1.0);
            let bend = angle_difference(next.heading, poses[at].heading);
            Pose {
                position: poses[at].position.lerp(next.position, part),
                heading: wrap_angle(poses[at].heading + part * bend),
            }
        } else {
            turn.pose_at((s - begins).min(turn.length()))
        };
        way.push(pose);
    }
    // It has left the road, at least with its front.
    (s > begins + 3.0).then_some((way, turn.pose_at(turn.length()), ROOM_M[side]))
}

#[cfg(test)]
mod tests {
    use gump_scene::Seed;

    use super::*;

    const DT: f64 = 0.1;

    /// A vehicle at a constant speed along the x axis, and a driveway on its right, 60 m ahead.
    fn street(speed: f64) -> (Vec<Pose>, Driveway) {
        let poses = (0..93).map(|i| Pose::new(f64::from(i) * DT * speed, 0.0, 0.0));
        let driveway = Driveway {
            curb: Pose::new(60.0, -3.0, -std::f64::consts::PI),
            width: 5.0,
        };
        (poses.collect(), driveway)
    }

    #[test]
    fn a_vehicle_slows_down_and_turns_into_the_yard() {
        let (poses, driveway) = street(10.0);
        let mut n = 0;
        for seed in 0..100 {
            let mut rng = Seed(seed).rng();
            let Some((way, end, _)) = way_in(&poses, &driveway, DT, &mut rng) else {
                continue;
            };
            n += 1;
            assert_eq!(way.len(), poses.len());
            let inside = driveway.curb.inverse() * end.position;
            assert!(inside.y > 4.9 && inside.x.abs() < 1.0, "{inside}");
            let mut before = 10.0;
            for pair in way.windows(2) {
                let step = pair[1].position - pair[0].position;
                let speed = step.length() / DT;
                let (change, turn) = (
                    (speed - before) / DT,
                    angle_difference(pair[1].heading, pair[0].heading),
                );
                assert!((-4.5..1.5).contains(&change), "seed {seed}: {change} m/s²");
                assert!(turn.abs() < 0.3 * speed * DT + 0.02, "seed {seed}: {turn}");
                let aside = step.dot(pair[0].direction().perp()).abs();
                assert!(aside < 0.06, "seed {seed}: {aside} m aside");
                before = speed;
            }
            let last = driveway.curb.inverse() * way[way.len() - 1].position;
            assert!(last.y > -3.0 && last.x < 12.0, "{last}");
        }
        assert!(n > 30, "{n}");
    }

    #[test]
    fn who_is_too_fast_or_does_not_pass_goes_on() {
        let (poses, driveway) = street(24.0);
        let near = Driveway {
            curb: Pose::new(16.0, -3.0, -std::f64::consts::PI),
            ..driveway
        };
        let far = Driveway {
            curb: Pose::new(60.0, -30.0, -std::f64::consts::PI),
            ..driveway
        };
        for driveway in [near, far] {
            for seed in 0..20 {
                let mut rng = Seed(seed).rng();
                assert!(way_in(&poses, &driveway, DT, &mut rng).is_none());
            }
        }
    }
}
