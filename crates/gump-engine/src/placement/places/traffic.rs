//! Vehicles already placed, as a place sees them.

use gump_geometry::{DVec2, OrientedBox, angle_difference};

use super::features::{N_TRAFFIC, Row};
use super::{LOOK, NewVehicle, Place, PlaceKind, Places};

/// Distance within which vehicles are seen regardless of lanes, metres.
const NEAR: f64 = 25.0;
/// A vehicle is on a lane within this distance of its centre, metres, ...
const ON_LANE: f64 = 1.75;
/// ... if it heads along it within this, radians.
const ALONG: f64 = 0.6;
/// Slower vehicles stand, metres per second.
const STANDS: f64 = 0.5;
/// A vehicle at this distance to the side is beside a place, metres: on the next lane or in the next
/// bay.
const BESIDE: [f64; 2] = [1.8, 5.5];
/// Distance to the next vehicles of a row, metres: one ahead, two beside.
const ROW: f64 = 8.0;

/// A vehicle that is already placed.
#[derive(Clone, Copy, Debug)]
pub struct PlacedVehicle {
    /// Its box, scene frame.
    pub outline: OrientedBox,
    /// Metres per second.
    pub speed: f64,
}

/// A vehicle ahead of the start of a lane.
#[derive(Clone, Copy, Debug)]
struct OnLane {
    /// Metres from the start of the lane along it and those after it; below 0 before it.
    along: f64,
    half_length: f64,
    speed: f64,
}

/// Vehicles already placed.
#[derive(Clone, Debug)]
pub struct Traffic {
    vehicles: Vec<PlacedVehicle>,
    on_lanes: Vec<Vec<OnLane>>,
}

impl Traffic {
    /// These vehicles among the places of a scene.
    pub fn new(places: &Places, vehicles: Vec<PlacedVehicle>) -> Self {
        let mut on_lanes = vec![Vec::new(); places.chains.len()];
        for vehicle in &vehicles {
            let pose = places.world_from_scene * vehicle.outline.pose;
            for (lane, _) in places.map.lanes_near(pose.position, ON_LANE) {
                let Some(&own) = places.index.get(&lane.id) else {
                    continue;
                };
                let foot = lane.foot(pose);
                if foot.turned > ALONG {
                    continue;
                }
                let seen = |along: f64| OnLane {
                    along,
                    half_length: vehicle.outline.length / 2.0,
                    speed: vehicle.speed,
                };
                for (chain, i) in places.chains.iter().zip(0..) {
                    if let Some((_, base)) = chain.ahead.iter().find(|(lane, _)| *lane == own) {
                        on_lanes[i].push(seen(base + foot.along_m));
                    }
                }
                for (lane, base) in &places.chains[own as usize].ahead {
                    if *lane != own {
                        on_lanes[*lane as usize].push(seen(foot.along_m - base));
                    }
                }
            }
        }
        Self { vehicles, on_lanes }
    }

    /// Whether a vehicle stands within [`ROW`] of a point, scene frame.
    pub(in crate::placement) fn stands_near(&self, point: DVec2) -> bool {
        let mut standing = self
            .vehicles
            .iter()
            .filter(|vehicle| vehicle.speed < STANDS);
        standing.any(|vehicle| vehicle.outline.pose.position.distance(point) < ROW)
    }

    /// What a place sees, into `[N_TRAFFIC]`.
    pub(super) fn write(&self, place: &Place, own: &NewVehicle, into: &mut [f32]) {
        let mut row = Row::new(&mut into[..N_TRAFFIC]);
        self.write_lane(place, own, &mut row);
        self.write_near(place, &mut row);
        row.finish();
    }

    /// The next vehicles ahead and behind on the lane.
    fn write_lane(&self, place: &Place, own: &NewVehicle, row: &mut Row<'_>) {
        let nothing = OnLane {
            along: f64::INFINITY,
            half_length: 0.0,
            speed: 0.0,
        };
        let (mut ahead, mut behind) = (nothing, nothing);
        // Vehicles ahead and behind, and those of them that stand.
        let mut counts = [[0.0; 2]; 2];
        if place.kind == PlaceKind::OnLane {
            for other in &self.on_lanes[place.lane as usize] {
                let metres = other.along - f64::from(place.along);
                if metres.abs() < LOOK {
                    let of_side = &mut counts[usize::from(metres < 0.0)];
                    of_side[0] += 1.0;
                    of_side[1] += f64::from(u8::from(other.speed < STANDS));
                }
                let side = if metres >= 0.0 {
                    &mut ahead
                } else {
                    &mut behind
                };
                if metres.abs() < side.along {
                    *side = OnLane {
                        along: metres.abs(),
                        ..*other
                    };
                }
            }
        }
        for count in counts.into_iter().flatten() {
            row.push(count / 4.0);
        }
        for other in [ahead, behind] {
            let gap = other.along - other.half_length - own.length / 2.0;
            row.distance(gap);
            let is_there = gap < LOOK;
            let speed = if is_there { other.speed } else { 0.0 };
            row.push(speed / 10.0);
            row.mark(is_there && speed < STANDS);
            // The time to reach it, or to be reached by it.
            row.push(if is_there {
                (gap / speed.max(1.0) / 4.0).min(2.0)
            } else {
                2.0
            });
        }
    }

    /// Vehicles around, wherever their lanes lead.
    fn write_near(&self, place: &Place, row: &mut Row<'_>) {
        let from_scene = place.pose.inverse();
        let (mut near, mut nearest) = ([0.0; 4], [(f64::INFINITY, 0.0, 0.0, 0.0, 0.0); 2]);
        let mut beside = [(f64::INFINITY, 0.0, false, false); 2];
        // Vehicles that stand in a row with the place: end to end, side by side.
        let mut rows = [0.0; 2];
        for vehicle in &self.vehicles {
            let at = from_scene * vehicle.outline.pose.position;
            let distance = at.length();
            if distance > NEAR {
                continue;
            }
            let turn = angle_difference(vehicle.outline.pose.heading, place.pose.heading);
            let stands = vehicle.speed < STANDS;
            near[0] += 1.0;
            near[1] += f64::from(u8::from(distance < 10.0));
            near[2] += f64::from(u8::from(stands));
            near[3] += f64::from(u8::from(turn.cos().abs() > 0.9));
            let seen = (distance, at.x, at.y, turn, vehicle.speed);
            if distance < nearest[0].0 {
                nearest = [seen, nearest[0]];
            } else if distance < nearest[1].0 {
                nearest[1] = seen;
            }
            if stands && turn.cos().abs() > 0.9 {
                rows[0] += f64::from(u8::from(at.y.abs() < 1.0));
                rows[1] += f64::from(u8::from(at.x.abs() < 1.5 && at.y.abs() < 12.0));
            }
            if (BESIDE[0]..BESIDE[1]).contains(&at.y.abs()) {
                let side = &mut beside[usize::from(at.y < 0.0)];
                if at.x.abs() < side.0.abs() {
                    *side = (at.x, vehicle.speed, turn.cos() > 0.9, stands);
                }
            }
        }
        for (count, scale) in near.into_iter().zip([10.0, 4.0, 10.0, 10.0]) {
            row.push(count / scale);
        }
        for count in rows {
            row.push(count / 3.0);
        }
        for (distance, x, y, turn, speed) in nearest {
            let is_there = distance.is_finite();
            let or_none = |value: f64| if is_there { value } else { 0.0 };
            row.mark(is_there);
            row.push(or_none((-distance / 4.0).exp()));
            row.push(or_none(x / 10.0));
            row.push(or_none(y / 10.0));
            // Vehicles that park are alike forwards and backwards.
            row.push(or_none((2.0 * turn).cos()));
            row.push(or_none((2.0 * turn).sin()));
            row.push(or_none(speed / 10.0));
        }
        for (x, speed, is_same_way, stands) in beside {
            let is_there = x.is_finite();
            row.push(if is_there {
                (-x.abs() / 4.0).exp()
            } else {
                0.0
            });
            row.push(if is_there { x / NEAR } else { 0.0 });
            row.push(speed / 10.0);
            row.mark(is_there && is_same_way);
            row.mark(is_there && stands);
        }
    }
}
