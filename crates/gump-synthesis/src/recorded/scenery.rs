//! Standing agents and crossing places: parked vehicles, waiting pedestrians, loading vehicles,
//! places where pedestrians cross.

use std::f64::consts::PI;
use std::ops::Range;

use gump_geometry::{DVec2, Pose, wrap_angle};
use gump_scene::{AgentKind, LaneKind, Rng};
use rand::Rng as _;

use super::driveways::{self, Driveway};
use super::islands::Island;
use crate::SynthesisConfig;
use crate::curve::{Track, connect, line};
use crate::network::{LaneIdx, Network, draw_slant};
use crate::traffic::{Jaywalk, Scenery, Span, Standing, draw_person_size, draw_real_size};

/// From the middle of a parking strip to the curb, metres: half of the strip and the gutter of
/// [`crate::plan`].
const STRIP_TO_CURB: f64 = 1.6;
/// Widest vehicle that parks along a curb, and in a bay, metres: what fits into a strip of 2.4 m,
/// and leaves 0.6 m to the next in bays of 2.75 m.
const WIDEST: [f64; 2] = [2.3, 2.15];
/// Longest vehicle that parks along a curb, and in a bay, metres: a van, and what fits into 5.8 m.
const LONGEST: [f64; 2] = [7.5, 5.5];
/// Metres of curb without parked vehicles beside a way across the road. Chosen by eye.
const JAYWALK_ROOM: f64 = 4.0;
/// From the middle of a sidewalk to the curb, metres: as `network/sidewalk.rs` lays them.
const WALK_TO_CURB: f64 = 2.2;
/// From the middle of a sidewalk to people who stand beside it, metres: out of the way of those who
/// walk. Chosen by eye.
const BESIDE_WALK: Range<f64> = 2.2..3.3;
/// Metres along the sidewalk to a place where people cross, and on from there.
const APPROACH: Range<f64> = 6.0..28.0;
/// Metres before that place at which they turn to the curb, and the reach of the turn, metres. Chosen by eye.
const BEFORE_CORNER: f64 = 2.5;
const CORNER: f64 = 1.2;
/// Metres from the end of a road, where sidewalks turn, that are not walked on such a way.
const ROAD_END: f64 = 8.0;
/// Nobody crosses away from crosswalks where the limit is higher, m/s. Chosen by hand.
const CROSSED_MPS: f64 = 15.0;
/// How fast they walk, m/s. Chosen by hand.
const PACE: Range<f64> = 0.9..1.9;
/// Share of scenes in which a vehicle has stopped in its lane. Chosen by hand.
const HELD: f64 = 0.12;
/// Parked vehicles of a scene, at most, before density. Fitted by hand.
const MOST_PARKED: f64 = 215.0;

/// Draws standing agents and crossing places; `bustle` from 0 to 1 sets the activity of the scene.
pub(crate) fn draw(
    network: &Network,
    config: &SynthesisConfig,
    (driveways, islands, bustle): (&[Driveway], &[Island], f64),
    rng: &mut Rng,
) -> Scenery {
    let jaywalks = draw_jaywalks(network, rng);
    let crossers = (0..jaywalks.len())
        .filter(|_| rng.random_bool(0.35 + 0.6 * bustle))
        .collect::<Vec<_>>();
    let times = -8.0..config.history_s + config.future_s;
    let crossers = crossers.into_iter().map(|way: usize| {
        let pace = rng.random_range(PACE);
        let crosses = rng.random_range(times.clone());
        let sets_off = crosses - jaywalks[way].curbs.0 / pace;
        // Nobody waits for the time to come: all are on their way when the recording begins.
        (way, pace, config.warmup_s + sets_off.min(-1.0))
    });
    let crossers = crossers.collect();
    let mut standing = parked(network, rng);
    standing.retain(|body| {
        let at = body.pose.position;
        let off = |way: &Jaywalk| {
            let foot = way.track.project(at).clamp(way.curbs.0, way.curbs.1);
            let foot = way.track.pose_at(foot).position;
            foot.distance(at) > JAYWALK_ROOM
        };
        jaywalks.iter().all(off)
            && !driveways.iter().any(|d| d.is_blocked_by(body))
            && !islands.iter().any(|island| island.is_under(at))
    });
    let share = rng.random_range(0.0..0.9);
    standing.extend(driveways::parked(network, driveways, share, rng));
    // The farthest are left out: they are not visible from the centre.
    standing.sort_by(|a, b| {
        let far = |body: &Standing| body.pose.position.length();
        far(a).total_cmp(&far(b))
    });
    standing.truncate((MOST_PARKED * config.density) as usize);
    standing.extend(waiting_people(network, bustle * config.density, rng));
    Scenery {
        is_real: true,
        standing,
        held: draw_held(network, rng),
        jaywalks,
        crossers,
    }
}

/// Vehicles along the curbs, in bays and in lots, row by row.
fn parked(network: &Network, rng: &mut Rng) -> Vec<Standing> {
    let mut all = Vec::new();
    for strip in &network.parking {
        park_along(strip, rng, &mut all);
    }
    for strip in &network.bays {
        let fill = draw_fill(rng);
        let slant = draw_slant(rng);
        let spacing = rng.random_range(2.75..3.0) / f64::cos(slant);
        let n = ((strip.length() - 4.0) / spacing).max(0.0) as usize;
        for k in 0..n {
            if rng.random_bool(fill) {
                let middle = strip.pose_at(2.0 + (k as f64 + 0.5) * spacing);
                all.push(in_bay(middle * Pose::new(0.0, 0.0, slant), rng));
            }
        }
    }
    let fill = draw_fill(rng);
    for place in &network.lot_places {
        if rng.random_bool(fill) {
            let turned = Pose {
                heading: wrap_angle(place.heading + std::f64::consts::FRAC_PI_2),
                ..*place
            };
            all.push(in_bay(turned, rng));
        }
    }
    all
}

/// The share of places that are taken; rows are mostly nearly full, or nearly empty.
fn draw_fill(rng: &mut Rng) -> f64 {
    let part: f64 = rng.random_range(0.0_f64..1.0).powf(0.4);
    0.1 + 0.88 * (0.55 - (PI * part).cos() / 2.0).clamp(0.0, 1.0)
}

fn park_along(strip: &Track, rng: &mut Rng, all: &mut Vec<Standing>) {
    let fill = draw_fill(rng);
    let mut s = rng.random_range(5.0..9.0);
    let end = strip.length() - rng.random_range(5.0..9.0);
    loop {
        let mut size = draw_real_size(rng);
        size[0] = size[0].min(LONGEST[0]);
        size[1] = size[1].min(WIDEST[0]);
        if s + size[0] > end {
            return;
        }
        if !rng.random_bool(fill) {
            s += rng.random_range(5.0..7.0);
            continue;
        }
        let from_curb = rng.random_range(0.1..0.45);
        let local = Pose::new(
            0.0,
            size[1] / 2.0 + from_curb - STRIP_TO_CURB,
            rng.random_range(-0.03..0.03),
        );
        let on_strip = strip.pose_at(s + size[0] / 2.0);
        let against = if rng.random_bool(0.06) { PI } else { 0.0 };
        let pose = on_strip * local;
        all.push(Standing {
            kind: AgentKind::Vehicle,
            size,
            pose: Pose {
                heading: wrap_angle(pose.heading + against),
                ..pose
            },
        });
        s += size[0] + rng.random_range(0.6..1.0) + rng.random_range(0.0_f64..1.0).powi(3) * 2.5;
    }
}

/// A vehicle in the bay around the middle of a strip, at right angles to it.
fn in_bay(middle: Pose, rng: &mut Rng) -> Standing {
    let mut size = draw_real_size(rng);
    size[0] = size[0].min(LONGEST[1]);
    size[1] = size[1].min(WIDEST[1]);
    let nose_in = if rng.random_bool(0.75) { -0.5 } else { 0.5 };
    let turn = nose_in * PI + rng.random_range(-0.04..0.04);
    let local = Pose::new(
        rng.random_range(-0.12..0.12),
        rng.random_range(-0.25..0.15),
        turn,
    );
    let pose = middle * local;
    Standing {
        kind: AgentKind::Vehicle,
        size,
        pose: Pose {
            heading: wrap_angle(pose.heading),
            ..pose
        },
    }
}

/// Pedestrians that stand beside a sidewalk, alone or in groups.
fn waiting_people(network: &Network, bustle: f64, rng: &mut Rng) -> Vec<Standing> {
    let walks: Vec<&Track> = network
        .walks
        .iter()
        .filter(|walk| walk.crosswalk.is_none() && walk.track.length() > 20.0)
        .map(|walk| &walk.track)
        .collect();
    let mut people: Vec<Standing> = Vec::new();
    if walks.is_empty() {
        return people;
    }
    let n_groups = rng.random_range(0.0..2.0 + 4.5 * bustle) as usize;
    for _ in 0..n_groups {
        let walk = walks[rng.random_range(0..walks.len())];
        let s = rng.random_range(4.0..walk.length() - 4.0);
        let n = if rng.random_bool(0.5) {
            1
        } else {
            rng.random_range(2..=5)
        };
        let side = away_from_road(network, walk, s);
        for _ in 0..n {
            let along = walk.pose_at(s + rng.random_range(-1.8..1.8));
            let aside = rng.random_range(BESIDE_WALK) * side;
            let position = along * DVec2::new(0.0, aside);
            let crowded = |other: &Standing| other.pose.position.distance(position) < 1.15;
            if people.iter().any(crowded) {
                continue;
            }
            people.push(Standing {
                kind: AgentKind::Pedestrian,
                size: draw_person_size(rng),
                pose: Pose {
                    position,
                    heading: rng.random_range(-PI..PI),
                },
            });
        }
    }
    people
}

/// 1 if the road is on the right of the walk, -1 if it is on its left.
fn away_from_road(network: &Network, walk: &Track, s: f64) -> f64 {
    let pose = walk.pose_at(s);
    let nearest = |side: f64| {
        let point = pose * DVec2::new(0.0, 6.0 * side);
        let lanes = network.lanes.iter();
        lanes
            .map(|lane| {
                let foot = lane.track.project(point);
                lane.track.pose_at(foot).position.distance(point)
            })
            .fold(f64::INFINITY, f64::min)
    };
    if nearest(1.0) > nearest(-1.0) {
        1.0
    } else {
        -1.0
    }
}

/// Vehicles that have stopped in the outer lane of a road with another one beside it.
fn draw_held(network: &Network, rng: &mut Rng) -> Vec<(LaneIdx, f64)> {
    let suits = |&lane: &LaneIdx| {
        let l = &network.lanes[lane];
        l.connector.is_none()
            && l.kind == LaneKind::SurfaceStreet
            && l.right.is_none()
            && l.left.is_some()
            && l.length() > 70.0
    };
    let lanes: Vec<LaneIdx> = (0..network.lanes.len()).filter(suits).collect();
    if lanes.is_empty() || !rng.random_bool(HELD) {
        return Vec::new();
    }
    let lane = lanes[rng.random_range(0..lanes.len())];
    vec![(
        lane,
        rng.random_range(30.0..network.lanes[lane].length() - 30.0),
    )]
}

/// Ways straight across roads, between the sidewalks on both sides.
fn draw_jaywalks(network: &Network, rng: &mut Rng) -> Vec<Jaywalk> {
    let mut ways: Vec<Jaywalk> = Vec::new();
    let lanes: Vec<LaneIdx> = (0..network.lanes.len())
        .filter(|&lane| {
            let l = &network.lanes[lane];
            let is_street = l.kind == LaneKind::SurfaceStreet && l.speed_limit < CROSSED_MPS;
            l.connector.is_none() && is_street && l.length() > 40.0
        })
        .collect();
    if lanes.is_empty() {
        return ways;
    }
    let wanted = rng.random_range(0..=6);
    for _ in 0..6 * wanted {
        if ways.len() == wanted {
            break;
        }
        let lane = lanes[rng.random_range(0..lanes.len())];
        let s = rng.random_range(15.0..network.lanes[lane].length() - 15.0);
        let mirrored = rng.random_bool(0.5);
        let apart = |way: &Jaywalk| {
            let here = network.lanes[lane].track.pose_at(s).position;
            let (from, to) = way.curbs;
            let across = [0.0, 0.5, 1.0].map(|k| way.track.pose_at(from + k * (to - from)));
            across.iter().all(|pose| pose.position.distance(here) > 8.0)
        };
        if ways.iter().all(apart)
            && let Some(way) = way_across(network, (lane, s), mirrored, rng)
        {
            ways.push(way);
        }
    }
    ways
}

/// The way across at a place on a lane, from one sidewalk to the other; `None` without both.
fn way_across(
    network: &Network,
    (lane, s): (LaneIdx, f64),
    mirrored: bool,
    rng: &mut Rng,
) -> Option<Jaywalk> {
    let road = &network.lanes[lane].track;
    let pose = road.pose_at(s);
    // Distances to the left at which something runs along the road here.
    let abeam = |track: &Track| {
        let foot = track.project(pose.position);
        let local = pose.inverse() * track.pose_at(foot).position;
        let inside = foot > 1.0 && foot < track.length() - 1.0;
        (inside && local.x.abs() < 1.0).then_some((local.y, foot))
    };
    let walks = network.walks.iter().filter(|walk| walk.crosswalk.is_none());
    let walks: Vec<f64> = walks
        .filter_map(|walk| abeam(&walk.track))
        .map(|(y, _)| y)
        .filter(|y| y.abs() < 40.0)
        .collect();
    let nearest = |sign: f64| {
        let side = walks.iter().filter(|y| **y * sign > 0.0).map(|y| y * sign);
        side.reduce(f64::min).map(|y| y * sign)
    };
    let (left, right) = (nearest(1.0)?, nearest(-1.0)?);
    let sidewalks = if mirrored {
        (left, right)
    } else {
        (right, left)
    };
    let curb = |walk: f64| walk - (WALK_TO_CURB - 0.5) * walk.signum();
    let (from, to) = (curb(sidewalks.0), curb(sidewalks.1));
    let sign = (to - from).signum();
    let spans = network.lanes.iter().enumerate().filter_map(|(other, l)| {
        let (y, at) = abeam(&l.track)?;
        let across = (y - from) * sign;
        let half = l.width / 2.0;
        let between = across > 0.0 && across < (to - from).abs();
        between.then_some(Span {
            lane: other,
            at,
            across: (across - half, across + half),
        })
    });
    let spans: Vec<Span> = spans.collect();
    let ahead = (pose.direction().perp() * sign).to_angle();
    let ends = [(from, ahead), (to, wrap_angle(ahead + PI))].map(|(y, heading)| Pose {
        position: pose * DVec2::new(0.0, y),
        heading,
    });
    let mut points = approach(road, (s, sidewalks.0), ends[0], rng);
    points.extend(line(ends[0].position, ends[1].position));
    points.extend(
        approach(road, (s, sidewalks.1), ends[1], rng)
            .into_iter()
            .rev(),
    );
    let track = Track::through(&points);
    let curbs = ends.map(|end| track.project(end.position));
    let span = |span: Span| Span {
        across: (span.across.0 + curbs[0], span.across.1 + curbs[0]),
        ..span
    };
    Some(Jaywalk {
        curbs: (curbs[0], curbs[1]),
        spans: spans.into_iter().map(span).collect(),
        track,
    })
}

/// Points along a sidewalk, `s` metres along the road and `y` to its left, to a curb and the direction
/// across.
fn approach(road: &Track, (s, y): (f64, f64), curb: Pose, rng: &mut Rng) -> Vec<DVec2> {
    let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let room = if side > 0.0 { road.length() - s } else { s };
    let far = rng.random_range(APPROACH).min(room - ROAD_END);
    if far < BEFORE_CORNER + 1.0 {
        return Vec::new();
    }
    let n = ((far - BEFORE_CORNER) / 0.5).ceil() as usize;
    let at = |k: usize| {
        let back = BEFORE_CORNER + (far - BEFORE_CORNER) * (n - k) as f64 / n as f64;
        let along = road.pose_at(s + side * back);
        along * Pose::new(0.0, y, if side > 0.0 { PI } else { 0.0 })
    };
    let mut points: Vec<DVec2> = (0..=n).map(|k| at(k).position).collect();
    points.extend(connect(at(n), curb, [0.0; 2], CORNER));
    points
}

#[cfg(test)]
mod tests {
    use gump_geometry::angle_difference;
    use gump_scene::Seed;

    use super::*;
    use crate::RoadFamily;
    use crate::layout::{Winding, draw_plan};

    #[test]
    fn ways_across_lead_along_sidewalks_and_straight_from_curb_to_curb() {
        let mut n = 0;
        for seed in 0..8 {
            let mut rng = Seed(seed).rng();
            let plan = draw_plan(RoadFamily::CurvedRoad, 150.0, Winding::Slight, &mut rng);
            let network = Network::new(&plan, &mut rng);
            for way in draw_jaywalks(&network, &mut rng) {
                n += 1;
                let (from, to) = way.curbs;
                assert!(0.0 <= from && from < to && to <= way.track.length());
                let points = way.track.points();
                let steps = points.windows(2).map(|p| p[0].distance(p[1]));
                let longest = steps.fold(0.0, f64::max);
                assert!(longest < 1.1, "{longest} m");
                // Straight across: the directions at both curbs agree.
                let turn = angle_difference(
                    way.track.pose_at(from + 1.0).heading,
                    way.track.pose_at(to - 1.0).heading,
                );
                assert!(turn.abs() < 0.1, "{turn}");
                let across = |span: &Span| from - 0.1 < span.across.0 && span.across.1 < to + 0.1;
                assert!(!way.spans.is_empty() && way.spans.iter().all(across));
                // Nobody walks on a lane before the curb or after it.
                for s in [0.0, from / 2.0, from - 0.5, to + 0.5, way.track.length()] {
                    if (from..to).contains(&s) || s < 0.0 {
                        continue;
                    }
                    let at = way.track.pose_at(s).position;
                    let lanes = network.lanes.iter().filter(|lane| lane.connector.is_none());
                    let mut feet = lanes.map(|lane| {
                        let foot = lane.track.pose_at(lane.track.project(at)).position;
                        (foot.distance(at), lane.width)
                    });
                    assert!(
                        feet.all(|(far, width)| far > width / 2.0),
                        "{s} of {from} to {to}"
                    );
                }
            }
        }
        assert!(n > 8, "{n}");
    }
}
