//! Driveways: where vehicles cross the sidewalk to a yard, with or without a parked vehicle.

use gump_geometry::{DVec2, Pose, wrap_angle};
use gump_scene::{AgentKind, AreaKind, Rng};
use rand::Rng as _;

use crate::curve::Track;
use crate::network::Network;
use crate::plan::Plan;
use crate::traffic::{Standing, draw_real_size};

// Distances and shares, here and in the functions below, were chosen by eye and not varied one by
// one (see the module above).
/// From the curb to the near end of a vehicle, metres: from the middle of the sidewalk on.
const PLACE: std::ops::Range<f64> = 3.0..7.5;
/// Share of vehicles that stand aslant, and by how much at most, radians.
const ASLANT: f64 = 0.2;
const MOST_ASLANT: f64 = 0.6;
/// Width of a driveway, metres, most near the lower end, and depth of its surface on the map.
/// Recorded ones have medians of 4.9 and 9.7.
const WIDTH: std::ops::Range<f64> = 3.2..10.0;
const SURFACE: std::ops::Range<f64> = 5.0..14.0;
/// Metres by which that surface begins on the road: the road edge runs through 97 % of recorded ones, whose
/// near sides are 3.1 m from the nearest centre of a lane (median).
const ON_ROAD: std::ops::Range<f64> = 0.2..1.3;
/// Metres of road without driveways at its ends.
const ENDS: f64 = 9.0;
/// Vehicles in yards stay away from every lane by this much, metres.
const FROM_LANES: f64 = 5.5;

/// A driveway.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Driveway {
    /// The middle of its mouth on the curb; +y points away from the road.
    pub(crate) curb: Pose,
    /// Metres along the curb.
    pub(crate) width: f64,
}

impl Driveway {
    /// True if a body parked along the curb would block it.
    pub(crate) fn is_blocked_by(&self, body: &Standing) -> bool {
        let local = self.curb.inverse() * body.pose.position;
        local.x.abs() < (self.width + body.size[0]) / 2.0 + 0.3 && (-3.5..0.5).contains(&local.y)
    }
}

/// Lays driveways along the streets, as areas of the map.
pub(crate) fn lay(
    network: &mut Network,
    plan: &Plan,
    trimmed: &[Track],
    rng: &mut Rng,
) -> Vec<Driveway> {
    let mut driveways = Vec::new();
    // Between town centres with hardly any and streets of houses with one each.
    let spacing = rng.random_range(9.0..32.0);
    for (road, track) in plan.roads.iter().zip(trimmed) {
        if road.freeway || road.ring || road.bays || !road.sidewalks {
            continue;
        }
        for left in [false, true] {
            let mut s = ENDS + rng.random_range(0.0..spacing);
            while s < track.length() - ENDS {
                let along = track.pose_at(s);
                let side = if left { 1.0 } else { -1.0 };
                let turned = if left { 0.0 } else { std::f64::consts::PI };
                let curb = Pose {
                    position: along * DVec2::new(0.0, side * road.half_width(!left)),
                    heading: wrap_angle(along.heading + turned),
                };
                let width = width(rng);
                let surface = surface(curb, width, rng);
                network.furniture.areas.push((AreaKind::Driveway, surface));
                driveways.push(Driveway { curb, width });
                s += spacing * rng.random_range(0.6..1.6) + width;
            }
        }
    }
    driveways
}

/// The width of a driveway, metres.
pub(crate) fn width(rng: &mut Rng) -> f64 {
    let spread = rng.random_range(0.0..1.0) * rng.random_range(0.0..1.0);
    WIDTH.start + (WIDTH.end - WIDTH.start) * spread
}

/// The surface of a driveway of this width. Recorded maps draw it from the edge of the road, or somewhat
/// inside it, to somewhere in the yard.
pub(crate) fn surface(curb: Pose, width: f64, rng: &mut Rng) -> Vec<DVec2> {
    let depth = rng.random_range(SURFACE);
    let half = width / 2.0;
    let near = -rng.random_range(ON_ROAD);
    let corners = [
        (-half, near),
        (half, near),
        (half - 0.4, depth),
        (0.4 - half, depth),
    ];
    corners.map(|(x, y)| curb * DVec2::new(x, y)).to_vec()
}

/// Parked vehicles in yards behind the driveways, of which a `share` is occupied.
pub(crate) fn parked(
    network: &Network,
    driveways: &[Driveway],
    share: f64,
    rng: &mut Rng,
) -> Vec<Standing> {
    let mut all = Vec::new();
    for driveway in driveways {
        if !rng.random_bool(share) {
            continue;
        }
        let n = if driveway.width > 5.2 { 2 } else { 1 };
        for k in 0..n {
            let mut size = draw_real_size(rng);
            size[0] = size[0].min(6.0);
            size[1] = size[1].min(2.2);
            let x = (f64::from(k) - f64::from(n - 1) / 2.0) * 2.7;
            let y = size[0] / 2.0 + rng.random_range(PLACE);
            let nose_in = if rng.random_bool(0.7) { 0.5 } else { -0.5 };
            let aslant = match rng.random_bool(ASLANT) {
                true => rng.random_range(-MOST_ASLANT..MOST_ASLANT),
                false => rng.random_range(-0.05..0.05),
            };
            let turn = nose_in * std::f64::consts::PI + aslant;
            let pose = driveway.curb * Pose::new(x + rng.random_range(-0.15..0.15), y, turn);
            let far = network.lanes.iter().all(|lane| {
                let foot = lane.track.pose_at(lane.track.project(pose.position));
                foot.position.distance(pose.position) > FROM_LANES
            });
            if far && rng.random_bool(0.8) {
                all.push(Standing {
                    kind: AgentKind::Vehicle,
                    size,
                    pose: Pose {
                        heading: wrap_angle(pose.heading),
                        ..pose
                    },
                });
            }
        }
    }
    all
}
