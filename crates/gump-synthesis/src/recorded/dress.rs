//! Additions to a plan besides its main roads: side roads, car parks, and where parking is allowed.

use std::collections::BTreeMap;
use std::f64::consts::FRAC_PI_2;
use std::ops::Range;

use gump_geometry::{DVec2, Pose, angle_difference, wrap_angle};
use gump_scene::Rng;
use rand::Rng as _;

use crate::curve::{Track, bend};
use crate::layout::street;
use crate::plan::{Control, NodePlan, Plan, RoadPlan};

// Shares and counts, here and in the functions below, were fitted by hand to the targets (see the
// module above). Lengths, widths and angles were chosen by eye and not varied one by one: no target
// measures them.
/// Shortest road that is left on either side of a new junction, metres.
const SHORTEST: f64 = 34.0;
/// Metres between the sidewalks of a new road and those of the others.
const CLEARANCE: f64 = 9.0;
/// Roads of one lane each way with a limit below this may get all-way stops, m/s.
const STREET: f64 = 13.0;
/// Metres of a new road beside its own junction, where it is near the road it leaves.
const OWN_JUNCTION: f64 = 26.0;
/// Length of a driveway between the road and the first bay, metres: of one aisle alone, and of
/// several side by side.
const DRIVEWAY: [f64; 2] = [16.0, 11.0];
/// Share of car parks and yards with a stop sign at the exit, and of junctions of side roads with
/// crosswalks. Adjusted by hand to recorded numbers of both (result 17).
const SIGNED_EXITS: f64 = 0.5;
const WALKED: f64 = 0.4;
/// Metres that are seen of a yard, from the curb.
const YARD: Range<f64> = 11.0..24.0;
/// Share of scenes with a car park of several aisles, as in front of shops.
const WIDE_CAR_PARKS: f64 = 0.4;
/// Share of the kinds of streets with parking on which vehicles park within the lanes, how wide these
/// are then, metres, and the highest limit before drivers hurry, m/s. Recorded lanes beside parked
/// vehicles lie 5 m apart (median), and they are passed at 3 to 9 m/s.
const IN_LANE: f64 = 0.8;
const WIDE_LANES: Range<f64> = 4.6..7.2;
const STREET_SPEED: f64 = 10.0;
/// Factors on the limits of plain plans, and the share of arterials that get nothing beside the road.
/// Fitted to how vehicles of each speed go on (result 49): who drives at 16 to 22 m/s in a recording has
/// lost 0.2 m/s after 4 s (median), and a tenth has lost more than 2.5 m/s.
const FREEWAYS: Range<f64> = 1.1..1.7;
const WIDE_ROADS: Range<f64> = 0.75..1.05;
const STREETS: Range<f64> = 0.7..1.1;
const OPEN: f64 = 0.65;
const OPEN_ROADS: Range<f64> = 1.0..1.4;
/// Share of freeways whose other carriageway is there, too, and metres between the two.
const BOTH_WAYS: f64 = 0.75;
const CENTRAL_RESERVE: Range<f64> = 2.5..12.0;
/// Aisles leave their road within this of a right angle, radians.
const SLANT: f64 = 0.3;

/// Adds side roads and car parks, then decides along which roads vehicles park.
pub(crate) fn dress(plan: &mut Plan, extent: f64, rng: &mut Rng) {
    if plan.roads[0].freeway && rng.random_bool(BOTH_WAYS) {
        add_other_carriageway(plan, rng);
    }
    let is_arterial = |plan: &Plan| plan.nodes.is_empty() && plan.roads[0].forward > 1;
    if is_arterial(plan) && rng.random_bool(OPEN) {
        allow_parking(plan, rng);
        change_limits(plan, [OPEN_ROADS, OPEN_ROADS, OPEN_ROADS], rng);
        return;
    }
    // First what needs most room.
    if rng.random_bool(WIDE_CAR_PARKS) {
        add_some(plan, extent, 1, add_wide_car_park, rng);
    }
    let n_side = rng.random_range(0..=4);
    add_some(plan, extent, n_side, add_side_road, rng);
    let n_parks = rng.random_range(1..=6);
    add_some(plan, extent, n_parks, add_car_park, rng);
    let n_yards = rng.random_range(0..=4);
    add_some(plan, extent, n_yards, add_yard, rng);
    allow_parking(plan, rng);
    change_limits(plan, [FREEWAYS, WIDE_ROADS, STREETS], rng);
}

/// Multiplies the limits of roads by random numbers, one for all freeways of the plan, one for its other
/// roads with several lanes each way, and one for the rest.
fn change_limits(plan: &mut Plan, factors: [Range<f64>; 3], rng: &mut Rng) {
    let [freeways, wide, streets] = factors.map(|factors| rng.random_range(factors));
    for road in plan.roads.iter_mut().filter(|road| road.speed_limit > 7.0) {
        road.speed_limit *= match road.forward {
            _ if road.freeway => freeways,
            1 => streets,
            _ => wide,
        };
    }
}

/// Adds the carriageway in the other direction, on the left of a freeway with one ramp.
fn add_other_carriageway(plan: &mut Plan, rng: &mut Rng) {
    let apart = rng.random_range(CENTRAL_RESERVE);
    let main = plan.roads.iter().filter(|road| road.freeway && road.major);
    let beside = main.flat_map(|road| {
        let track = &road.reference;
        let n = (track.length() / 5.0) as usize;
        (0..n).map(|i| track.pose_at(5.0 * i as f64) * DVec2::new(0.0, apart))
    });
    let mut points: Vec<DVec2> = beside.collect();
    points.reverse();
    plan.roads.push(RoadPlan {
        reference: Track::through(&points),
        ends: [None, None],
        ..plan.roads[0].clone()
    });
}

type Adds = fn(&mut Plan, (usize, f64, bool), f64, &mut Rng) -> bool;

/// Tries a few places for each of `n` roads.
fn add_some(plan: &mut Plan, extent: f64, n: usize, add: Adds, rng: &mut Rng) {
    let mut left = n;
    for _ in 0..8 * n {
        if left == 0 {
            return;
        }
        let road = rng.random_range(0..plan.roads.len());
        let is_left = rng.random_bool(0.5);
        let part = rng.random_range(0.0..1.0);
        let r = &plan.roads[road];
        let room = r.reference.length() - 2.0 * SHORTEST;
        if r.freeway || r.ring || r.bays || !r.sidewalks && r.speed_limit < 7.0 || room <= 0.0 {
            continue;
        }
        let s = SHORTEST + part * room;
        left -= usize::from(add(plan, (road, s, is_left), extent, rng));
    }
}

/// A minor road that leaves another one, in many cases without any sign.
fn add_side_road(plan: &mut Plan, at: (usize, f64, bool), extent: f64, rng: &mut Rng) -> bool {
    let style = RoadPlan {
        speed_limit: rng.random_range(8.0..12.0),
        ..street(1, false, rng)
    };
    let start = start(plan, at, rng.random_range(-0.2..0.2));
    let whole = (1.2 * extent - start.position.length()).max(95.0);
    let sharpest = rng.random_range(-0.4..0.4);
    let bends = [(45.0, 25.0, sharpest)];
    let of_length = |length| Track::through(&bend(start, length, &bends));
    let clear = |road: &Track| is_clear(plan, at.0, road, style.half_width(true));
    let Some(reference) = [whole, 80.0].map(of_length).into_iter().find(clear) else {
        return false;
    };
    let through = &plan.roads[at.0];
    let is_street = through.forward == 1 && through.speed_limit < STREET;
    let control = match rng.random_range(0.0..1.0) {
        0.0..0.4 if is_street => Control::AllWayStop,
        0.0..0.9 => Control::MinorStop,
        _ => Control::MinorYield,
    };
    let corners = (rng.random_bool(WALKED), rng.random_range(3.5..7.0));
    let node = split(plan, at, control, corners);
    plan.roads.push(RoadPlan {
        reference,
        ends: [Some(node), None],
        ..style
    });
    true
}

/// A driveway and, behind it, an aisle between two rows of bays.
fn add_car_park(plan: &mut Plan, at: (usize, f64, bool), extent: f64, rng: &mut Rng) -> bool {
    let style = aisle(rng);
    let start = start(plan, at, rng.random_range(-0.06..0.06));
    let driveway = plan.roads[at.0].half_width(!at.2) + DRIVEWAY[0];
    let length = rng
        .random_range(45.0..85.0_f64)
        .min(1.4 * extent - start.position.length());
    if length < 35.0 {
        return false;
    }
    let whole = Track::through(&bend(start, driveway + length, &[]));
    if !is_clear(plan, at.0, &whole, style.half_width(true)) {
        return false;
    }
    let radius = rng.random_range(3.5..7.0);
    let node = split(plan, at, exit(rng), (false, radius));
    add_aisle(plan, node, &whole, driveway, &style);
    true
}

/// What holds vehicles that leave a car park or yard.
fn exit(rng: &mut Rng) -> Control {
    match rng.random_bool(SIGNED_EXITS) {
        true => Control::MinorStop,
        false => Control::MinorYield,
    }
}

/// Adds a short way into a yard, where vehicles come from and park.
fn add_yard(plan: &mut Plan, at: (usize, f64, bool), extent: f64, rng: &mut Rng) -> bool {
    let style = RoadPlan {
        bays: false,
        parking: false,
        ..aisle(rng)
    };
    let start = start(plan, at, rng.random_range(-0.15..0.15));
    let length = plan.roads[at.0].half_width(!at.2) + rng.random_range(YARD);
    let whole = Track::through(&bend(start, length, &[]));
    let is_in = start.position.length() < extent;
    if !is_in || !is_clear(plan, at.0, &whole, style.half_width(true)) {
        return false;
    }
    let radius = rng.random_range(1.5..4.0);
    let node = split(plan, at, exit(rng), (false, radius));
    plan.roads.push(RoadPlan {
        reference: whole,
        ends: [Some(node), None],
        ..style
    });
    true
}

/// Several aisles side by side off one road, whose rows of bays lie back to back.
fn add_wide_car_park(plan: &mut Plan, at: (usize, f64, bool), extent: f64, rng: &mut Rng) -> bool {
    let (road, first, left) = at;
    let style = aisle(rng);
    let pitch = style.half_width(true) + style.half_width(false) + rng.random_range(0.0..1.5);
    let wanted = rng.random_range(3..=7);
    let slant = rng.random_range(-SLANT..SLANT);
    let driveway = plan.roads[road].half_width(!left) + DRIVEWAY[1];
    let length = rng.random_range(45.0..100.0_f64);
    let reference = &plan.roads[road].reference;
    let heading = start(plan, (road, first, left), slant).heading;
    // Places along the road whose aisles lie a pitch apart.
    let mut starts: Vec<(f64, Pose)> = Vec::new();
    let mut s = first;
    while s < reference.length() - SHORTEST && starts.len() < wanted {
        let along = start(plan, (road, s, left), 0.0);
        let pose = Pose { heading, ..along };
        let is_apart = |(_, last): &(f64, Pose)| (last.inverse() * pose.position).y.abs() >= pitch;
        if starts.last().is_none_or(is_apart) {
            let is_square = angle_difference(along.heading, heading).abs() <= SLANT;
            let whole = Track::through(&bend(pose, driveway + length, &[]));
            let is_in = pose.position.length() + length < 1.6 * extent;
            if !is_square || !is_in || !is_clear(plan, road, &whole, style.half_width(true)) {
                break;
            }
            starts.push((s, pose));
        }
        s += 0.5;
    }
    if starts.len() < 2 {
        return false;
    }
    // The farthest first: what is left of the road keeps its place in the plan.
    for (s, pose) in starts.into_iter().rev() {
        let radius = rng.random_range(1.5..3.0);
        let node = split(plan, (road, s, left), exit(rng), (false, radius));
        let length = length * rng.random_range(0.85..1.0);
        let whole = Track::through(&bend(pose, driveway + length, &[]));
        add_aisle(plan, node, &whole, driveway, &style);
    }
    true
}

/// The cross-section of an aisle between two rows of bays.
fn aisle(rng: &mut Rng) -> RoadPlan {
    RoadPlan {
        lane_width: rng.random_range(2.9..3.2),
        median: 0.0,
        bike_lanes: false,
        parking: true,
        bays: true,
        sidewalks: false,
        speed_limit: rng.random_range(2.6..5.5),
        ..street(1, false, rng)
    }
}

/// Adds a driveway and its aisle, which begins after `driveway` metres of `whole`.
fn add_aisle(plan: &mut Plan, node: usize, whole: &Track, driveway: f64, style: &RoadPlan) {
    let inner = plan.nodes.len();
    plan.nodes.push(NodePlan {
        control: Control::Free,
        crosswalks: false,
        corner_radius: 1.0,
        min_setback: 3.0,
    });
    plan.roads.push(RoadPlan {
        reference: whole.slice(0.0, driveway),
        ends: [Some(node), Some(inner)],
        parking: false,
        bays: false,
        ..style.clone()
    });
    plan.roads.push(RoadPlan {
        reference: whole.slice(driveway, whole.length()),
        ends: [Some(inner), None],
        ..style.clone()
    });
}

/// The pose on the reference of a road from which a new one sets out, to its left or right.
fn start(plan: &Plan, (road, s, left): (usize, f64, bool), skew: f64) -> Pose {
    let along = plan.roads[road].reference.pose_at(s);
    let turn = if left { FRAC_PI_2 } else { -FRAC_PI_2 };
    Pose {
        heading: wrap_angle(along.heading + turn + skew),
        ..along
    }
}

/// Cuts a road in two at a new junction, of which it gives the index; with crosswalks or not, and
/// curbs of this radius.
fn split(
    plan: &mut Plan,
    (road, s, _): (usize, f64, bool),
    control: Control,
    (crosswalks, corner_radius): (bool, f64),
) -> usize {
    let node = plan.nodes.len();
    plan.nodes.push(NodePlan {
        control,
        crosswalks,
        corner_radius,
        min_setback: 5.0,
    });
    let whole = plan.roads[road].clone();
    let length = whole.reference.length();
    plan.roads[road].reference = whole.reference.slice(0.0, s);
    plan.roads[road].ends[1] = Some(node);
    plan.roads[road].major = true;
    plan.roads.push(RoadPlan {
        reference: whole.reference.slice(s, length),
        ends: [Some(node), whole.ends[1]],
        major: true,
        ..whole
    });
    node
}

/// True if a new road stays away from all others, the one it leaves apart near its start.
fn is_clear(plan: &Plan, from: usize, reference: &Track, half_width: f64) -> bool {
    plan.roads.iter().enumerate().all(|(i, other)| {
        let theirs = other.half_width(true).max(other.half_width(false));
        let apart = half_width + theirs + CLEARANCE;
        let skipped = if i == from {
            OWN_JUNCTION + theirs
        } else {
            0.0
        };
        let far = |point: &DVec2| {
            let foot = other.reference.project(*point);
            other.reference.pose_at(foot).position.distance(*point) > apart
        };
        let points = reference.points().iter();
        points.skip(skipped as usize).step_by(4).all(far)
    })
}

/// Decides for every kind of road in the plan whether vehicles park along it, and how.
fn allow_parking(plan: &mut Plan, rng: &mut Rng) {
    // Roads of one kind share the width of their lanes, which was drawn for the kind.
    let mut decided: BTreeMap<u64, (bool, bool, Option<f64>)> = BTreeMap::new();
    for road in &mut plan.roads {
        if road.freeway || road.ring || road.bays || road.speed_limit < 7.0 {
            continue;
        }
        let n = road.forward.max(road.backward);
        let (parking, bays, wide) =
            *decided.entry(road.lane_width.to_bits()).or_insert_with(|| {
                let share = match n {
                    1 => 0.85,
                    2 => 0.6,
                    _ => 0.3,
                };
                let bays = n == 1 && !road.bike_lanes && rng.random_bool(0.08);
                let parking = rng.random_bool(share);
                let in_lane = parking && n == 1 && !bays && !road.bike_lanes;
                let wide = in_lane && rng.random_bool(IN_LANE);
                let wide = wide.then(|| rng.random_range(WIDE_LANES));
                (parking, bays, wide)
            });
        (road.parking, road.bays) = (parking, parking && bays);
        if let Some(width) = wide {
            road.lane_width = width;
            road.parks_in_lane = true;
            road.speed_limit = road.speed_limit.min(STREET_SPEED);
        }
    }
}
