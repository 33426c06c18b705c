//! Ways into driveways.
//!
//! Recorded maps show driveways as areas beside the road, without lanes that lead into them, and one
//! in fifty vehicles that pass one turns in. Here such lanes are added. They are out of view, except
//! for vehicles whose route is one of them: a lane seen by all would be taken by all.

use gump_geometry::{DVec2, Polygon, Polyline, angle_difference};
use gump_scene::{Area, AreaKind, Lane, LaneId, LaneKind, MapGraph, MapParts};

use crate::local_context::LaneMap;

// All were chosen by hand, with recorded maps in mind.

/// The mouth of a driveway is this far from the centre of the lane, metres: across oncoming lanes too.
const AWAY_M: (f64, f64) = (1.0, 12.0);
/// Points of an outline are this far apart, metres; those at most this much farther from the lane than
/// the nearest one belong to the mouth, metres.
const OUTLINE_M: f64 = 0.5;
const MOUTH_M: f64 = 0.8;
/// Minimum width of a mouth and depth of a driveway, and maximum length of the way inside, metres.
const WIDTH_M: f64 = 2.5;
const DEPTH_M: f64 = 3.5;
const INSIDE_M: f64 = 14.0;
/// A driveway that leads away at less than this angle from the lane is driven into square to it: cosine
/// of the angle from there.
const SQUARE: f64 = 0.75;
/// Radius of the turn, metres.
const RADIUS_M: f64 = 6.0;
/// Length of a cubic curve's handles for a quarter of a circle of radius 1.
const HANDLE: f64 = 0.5523;
/// Number of straight pieces of a turn.
const TURN_PIECES: usize = 8;
/// Metres of the street before the turn.
const APPROACH_M: f64 = 16.0;
/// A lane this near to the way across the street, metres, with less than this angle to the lane that it
/// leaves, radians, lies between: vehicles turn in from the outer lane.
const BETWEEN_M: f64 = 0.7;
const SAME_WAY: f64 = 1.0;

/// A way into a driveway.
#[derive(Clone, Debug)]
pub struct WayIn {
    /// The lane that was added: along the street, and into the driveway.
    pub lane: LaneId,
    /// Distance along it at which it leaves the street, metres.
    pub turns_off_m: f64,
    /// The place there.
    pub turns_off: DVec2,
}

/// The ways into the driveways of a map.
#[derive(Clone, Debug, Default)]
pub struct Driveways {
    /// The ways, by lane.
    pub ways: Vec<WayIn>,
    /// Their lanes, which lead nowhere.
    pub map: MapGraph,
}

impl Driveways {
    /// Those of a map within `reach` metres of one of these places, `curbs` being its edges there.
    pub fn around(map: &MapGraph, curbs: &LaneMap, centres: &[DVec2], reach: f64) -> Self {
        let ids = map.lanes().iter().map(|lane| lane.id.0);
        let last = ids.max().unwrap_or(0);
        let (mut ways, mut lanes) = (Vec::new(), Vec::new());
        for (area, i) in map.areas().iter().zip(0i64..) {
            // A way keeps its id when the map is laid out around another place.
            let Some(id) = last.checked_add(2 * i + 2) else {
                break;
            };
            let is_near = |centre: &DVec2| area.polygon.ring()[0].distance(*centre) < reach;
            if area.kind != AreaKind::Driveway || !centres.iter().any(is_near) {
                continue;
            }
            for (mut lane, turns_off_m, side) in ways_into(map, curbs, area) {
                lane.id = LaneId(id - 1 + side as i64);
                ways.push(WayIn {
                    lane: lane.id,
                    turns_off_m,
                    turns_off: lane.centerline.point_at(turns_off_m),
                });
                lanes.push(lane);
            }
        }
        let parts = MapParts {
            lanes,
            ..MapParts::default()
        };
        match MapGraph::new(parts) {
            Ok(map) => Self { ways, map },
            // A lane with coordinates that are not numbers.
            Err(_) => Self::default(),
        }
    }

    /// The way with this lane.
    pub fn way(&self, lane: LaneId) -> Option<&WayIn> {
        let at = self.ways.binary_search_by_key(&lane, |way| way.lane);
        Some(&self.ways[at.ok()?])
    }
}

/// The ways into an area: one from each side of the street, if there is one.
fn ways_into(map: &MapGraph, curbs: &LaneMap, area: &Area) -> Vec<(Lane, f64, usize)> {
    let outline = outline(&area.polygon);
    let n = outline.len().max(1) as f64;
    let centre = outline.iter().copied().sum::<DVec2>() / n;
    let far = outline.iter().map(|point| point.distance(centre));
    let reach = far.fold(0.0, f64::max) + AWAY_M.1;
    // The nearest lane from which it is on the right, and on the left.
    let mut best: [Option<(f64, Lane, f64)>; 2] = [None, None];
    for (lane, _) in map.lanes_near(centre, reach) {
        if lane.kind == LaneKind::BikeLane || lane.in_intersection {
            continue;
        }
        let distances = outline
            .iter()
            .map(|point| lane.centerline.project(*point).distance);
        let distances: Vec<f64> = distances.collect();
        let away = distances.iter().copied().fold(f64::INFINITY, f64::min);
        if !(AWAY_M.0..AWAY_M.1).contains(&away) {
            continue;
        }
        let mouth = outline.iter().zip(&distances);
        let mouth = mouth.filter(|(_, distance)| **distance < away + MOUTH_M);
        let mouth: Vec<DVec2> = mouth.map(|(point, _)| *point).collect();
        let Some((way, turns_off_m, side)) = way_in(map, curbs, lane, &mouth, (&outline, centre))
        else {
            continue;
        };
        let best = &mut best[side];
        if best.as_ref().is_none_or(|best| away < best.0) {
            *best = Some((away, way, turns_off_m));
        }
    }
    let found = best.into_iter().zip(0..);
    found
        .filter_map(|(best, side)| best.map(|(_, lane, off)| (lane, off, side)))
        .collect()
}

/// The way from a lane through a mouth into a driveway, where it leaves the lane, metres from its start,
/// and whether it turns left (1) or right (0).
fn way_in(
    map: &MapGraph,
    curbs: &LaneMap,
    lane: &Lane,
    mouth: &[DVec2],
    (outline, centre): (&[DVec2], DVec2),
) -> Option<(Lane, f64, usize)> {
    let line = &lane.centerline;
    let middle = mouth.iter().copied().sum::<DVec2>() / mouth.len() as f64;
    let beside = line.pose_at(line.project(middle).arc_length);
    let along = mouth.iter().map(|point| (beside.inverse() * *point).x);
    let (low, high) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| {
        (low.min(x), high.max(x))
    });
    let away = (beside.inverse() * middle).y;
    if high - low < WIDTH_M || away.abs() < AWAY_M.0 {
        return None;
    }
    let square = beside.rotate(DVec2::new(0.0, away.signum()));
    let straight = (centre - middle).normalize_or_zero();
    let inward = match straight.dot(square) > SQUARE {
        true => straight,
        false => square,
    };
    let depth = outline.iter().map(|point| (*point - middle).dot(inward));
    let depth = depth.fold(0.0, f64::max).min(INSIDE_M);
    // Where the way would leave the lane at an angle.
    let corner = middle - inward * (away.abs() / inward.dot(square));
    let at = line.project(corner).arc_length;
    if depth < DEPTH_M
        || middle.distance(corner) + depth < RADIUS_M + 1.0
        || !(0.5..line.length() - 0.5).contains(&at)
        || is_barred(map, curbs, lane, (corner, middle + inward))
    {
        return None;
    }
    let street = street_before(map, lane, at, APPROACH_M + RADIUS_M)?;
    let turns_off_m = street.length() - RADIUS_M;
    if turns_off_m < 1.0 {
        return None;
    }
    let off = street.pose_at(turns_off_m);
    let (from, to) = (off.position, corner + inward * RADIUS_M);
    let handle = RADIUS_M * HANDLE;
    let (a, b) = (from + off.direction() * handle, to - inward * handle);
    let mut points = street.slice(0.0, turns_off_m).points().to_vec();
    for k in 1..=TURN_PIECES {
        let t = k as f64 / TURN_PIECES as f64;
        let u = 1.0 - t;
        points.push(
            from * (u * u * u) + a * (3.0 * u * u * t) + b * (3.0 * u * t * t) + to * (t * t * t),
        );
    }
    points.push(middle + inward * depth);
    let heights = vec![0.0; points.len()];
    let way = Lane {
        kind: lane.kind,
        speed_limit: lane.speed_limit,
        width: lane.width,
        ..Lane::new(LaneId(0), Polyline::new(points)?, heights)
    };
    Some((way, turns_off_m, usize::from(away > 0.0)))
}

/// Points along an outline.
fn outline(polygon: &Polygon) -> Vec<DVec2> {
    let side = |(from, to): (DVec2, DVec2)| {
        let n = (from.distance(to) / OUTLINE_M).ceil().max(1.0) as usize;
        (0..n).map(move |k| from.lerp(to, k as f64 / n as f64))
    };
    polygon.edges().flat_map(side).collect()
}

/// Whether a curb, or another lane of the same direction, lies across a way over the street.
fn is_barred(map: &MapGraph, curbs: &LaneMap, lane: &Lane, (from, to): (DVec2, DVec2)) -> bool {
    let middle = from.midpoint(to);
    let reach = 0.5 * from.distance(to) + 2.0;
    if curbs
        .edges_near(middle, reach)
        .any(|edge| edge.crosses(from, to))
    {
        return true;
    }
    let heading = {
        let line = &lane.centerline;
        line.pose_at(line.project(from).arc_length).heading
    };
    let n = from.distance(to).ceil().max(1.0) as usize;
    (1..n).any(|k| {
        let point = from.lerp(to, k as f64 / n as f64);
        let mut near = map.lanes_near(point, BETWEEN_M);
        near.any(|(other, _)| {
            let line = &other.centerline;
            let way = line.pose_at(line.project(point).arc_length).heading;
            let follows =
                lane.successors.contains(&other.id) || lane.predecessors.contains(&other.id);
            let is_other = other.id != lane.id && other.kind != LaneKind::BikeLane && !follows;
            is_other && angle_difference(way, heading).abs() < SAME_WAY
        })
    })
}

/// The last `metres` of the street before a place on a lane, over the straightest lanes before it; shorter
/// where it begins.
fn street_before(map: &MapGraph, lane: &Lane, at: f64, metres: f64) -> Option<Polyline> {
    let mut points = lane
        .centerline
        .slice((at - metres).max(0.0), at)
        .points()
        .to_vec();
    let mut left = metres - at;
    let mut first = lane;
    while left > 0.5 {
        let start = first.centerline.pose_at(0.0).heading;
        let turn = |lane: &&Lane| {
            let end = lane.centerline.pose_at(lane.centerline.length()).heading;
            angle_difference(end, start).abs()
        };
        let before = map.predecessors(first.id);
        let before = before.filter(|before| before.id != lane.id);
        let Some(before) = before.min_by(|a, b| turn(a).total_cmp(&turn(b))) else {
            break;
        };
        let length = before.centerline.length();
        let part = before.centerline.slice((length - left).max(0.0), length);
        let mut all = part.points().to_vec();
        all.append(&mut points);
        points = all;
        if length < 0.1 {
            break;
        }
        (first, left) = (before, left - length);
    }
    points.dedup_by(|a, b| a.distance(*b) < 1e-6);
    Polyline::new(points)
}

#[cfg(test)]
mod tests {
    use gump_scene::fixture;

    use super::*;

    /// A street of two lanes with a driveway to the south of it, and more.
    fn driveways(rest: &str) -> (MapGraph, Driveways) {
        let street = "lane 1: 0,0 50,0 speed 13 next 3
             lane 3: 50,0 200,0 speed 13
             lane 2: 200,3.5 0,3.5 speed 13
             edge: 0,-2 200,-2
             driveway: 58,-2.4 63,-2.4 63,-11 58,-11
             ego vehicle 0: 10,0 velocity 8,0";
        let scenario = fixture::scenario(&format!("{street}\n{rest}")).unwrap();
        let map = MapGraph::clone(&scenario.map);
        let curbs = LaneMap::of_curbs(&map, &[DVec2::ZERO], 300.0);
        let found = Driveways::around(&map, &curbs, &[DVec2::ZERO], 300.0);
        (map, found)
    }

    #[test]
    fn ways_lead_from_both_lanes_into_the_driveway() {
        let (map, found) = driveways("");
        assert_eq!(found.ways.len(), 2);
        for (way, (y, heading)) in found
            .ways
            .iter()
            .zip([(0.0, 0.0), (3.5, std::f64::consts::PI)])
        {
            assert!(map.lane(way.lane).is_none(), "its id is its own");
            assert_eq!(found.way(way.lane).map(|way| way.lane), Some(way.lane));
            let line = &found.map.lane(way.lane).unwrap().centerline;
            // Along the street up to the turn, over the lane before.
            let off = line.pose_at(way.turns_off_m);
            assert!((way.turns_off_m - APPROACH_M).abs() < 0.1, "{way:?}");
            assert!((off.position.y - y).abs() < 1e-6 && line.points()[0].y == y);
            assert!(angle_difference(line.pose_at(5.0).heading, heading).abs() < 1e-6);
            assert!((off.position.x - 60.5).abs() - RADIUS_M < 0.3, "{off:?}");
            // Square through the mouth, to the end of the driveway.
            let end = line.pose_at(line.length());
            assert!(angle_difference(end.heading, -std::f64::consts::FRAC_PI_2).abs() < 0.05);
            assert!(
                end.position.distance(DVec2::new(60.5, -11.0)) < 0.3,
                "{end:?}"
            );
            let bends = (1..line.length() as usize).map(|s| {
                let heading = |s: f64| line.pose_at(s).heading;
                angle_difference(heading(s as f64), heading(s as f64 - 1.0)).abs()
            });
            assert!(bends.fold(0.0, f64::max) < 0.4, "no corner");
        }
    }

    #[test]
    fn a_curb_or_a_lane_between_bars_the_way() {
        let lanes = |rest: &str| {
            let (_, found) = driveways(rest);
            let start = |way: &WayIn| found.map.lane(way.lane).unwrap().centerline.points()[0].y;
            found.ways.iter().map(start).collect::<Vec<_>>()
        };
        assert_eq!(lanes(""), [0.0, 3.5]);
        assert_eq!(lanes("edge: 0,1.75 200,1.75"), [0.0]);
        // From the outer one of two lanes.
        assert_eq!(lanes("lane 4: 200,7 0,7"), [0.0, 3.5]);
        assert_eq!(lanes("lane 4: 0,-1.1 200,-1.1"), [-1.1, 3.5]);
        // The rest is too narrow, too far away, or too near to the end of the street.
        let around = |driveway: &str| lanes(&format!("driveway: {driveway}")).len();
        assert_eq!(around("80,-2.4 82,-2.4 82,-11 80,-11"), 2);
        assert_eq!(around("80,-14 85,-14 85,-24 80,-24"), 2);
        assert_eq!(around("80,-2.4 85,-2.4 85,-5 80,-5"), 2);
        assert_eq!(around("80,-2.4 85,-2.4 85,-11 80,-11"), 4);
    }

    #[test]
    fn ids_do_not_depend_on_where_the_map_is_laid_out() {
        let (map, all) = driveways("driveway: 150,-2.4 155,-2.4 155,-11 150,-11");
        let far = DVec2::new(180.0, 0.0);
        let curbs = LaneMap::of_curbs(&map, &[far], 60.0);
        let there = Driveways::around(&map, &curbs, &[far], 60.0);
        let ids = |found: &Driveways| found.ways.iter().map(|way| way.lane).collect::<Vec<_>>();
        assert_eq!(ids(&all)[2..], ids(&there)[..]);
        assert_eq!(there.ways.len(), 2);
    }

    #[test]
    fn only_those_who_take_a_way_see_it() {
        let (map, found) = driveways("");
        let mut pieces =
            crate::relative::map::VectorMap::new(&map, DVec2::ZERO, 300.0, Default::default());
        let before = pieces.pieces.len();
        pieces.add_driveways(&found, &[DVec2::ZERO], 300.0);
        assert!(pieces.pieces.len() > before + 6);
        let at = DVec2::new(52.0, 0.0);
        assert!(pieces.near(at, 60.0).all(|i| (i as usize) < before));
        let pose = gump_geometry::Pose::new(52.0, 0.0, 0.0);
        let paths = pieces.paths(pose);
        assert!(paths.iter().flatten().all(|(i, _)| (*i as usize) < before));
        let way = &found.ways[0];
        let route = crate::relative::route::Route::into_driveway(way.lane);
        let path = route.path(&pieces, pose);
        assert!(path.len() >= 3 && path.iter().all(|(i, _)| *i as usize >= before));
        let (last, away) = path[path.len() - 1];
        assert!(pieces.pieces[last as usize].pose.position.y < -5.0 && away > 10.0);
    }
}
