//! The road as an indexed graph; valid once built.
//!
//! The features themselves are in `map`. Queries never fail: an unknown id or a point off the map
//! yields no lanes.

use std::collections::BTreeMap;
use std::sync::OnceLock;

use gump_geometry::{BoxIndex, DVec2, PointIndex, Polygon, SegmentIndex, angle_difference, dvec2};

use crate::{
    Area, AreaKind, Lane, LaneId, MapError, MapParts, RoadEdge, RoadLine, Roadblock, RoadblockId,
    StopSign, Unstated,
};

/// Distance into a lane over which its direction is determined, metres. Chosen by hand.
const LOOK_M: f64 = 10.0;

/// An immutable, indexed map. Share it in an `Arc`, so that its indices are built only once.
#[derive(Clone, Debug, Default)]
pub struct MapGraph {
    parts: MapParts,
    by_id: BTreeMap<LaneId, usize>,
    roadblock_by_id: BTreeMap<RoadblockId, usize>,
    roadblock_lanes: BTreeMap<RoadblockId, Vec<usize>>,
    lane_areas: BTreeMap<LaneId, Vec<usize>>,
    places: Places,
}

/// Spatial indices, each built on first use: building all of them takes longer than reading a map,
/// and few callers need all.
#[derive(Clone, Debug, Default)]
struct Places {
    lane_segments: OnceLock<SegmentIndex<(usize, usize)>>,
    edge_segments: OnceLock<SegmentIndex<(usize, usize)>>,
    lane_boxes: OnceLock<BoxIndex<usize>>,
    roadblock_boxes: OnceLock<BoxIndex<usize>>,
    area_boxes: OnceLock<BoxIndex<usize>>,
    drivable_boxes: OnceLock<BoxIndex<usize>>,
    heights: OnceLock<(PointIndex, Vec<f64>)>,
}

impl MapGraph {
    /// Checks and indexes the parts. Links to lanes and roadblocks that are not in the map (cut off
    /// at its border) are dropped from the graph.
    ///
    /// # Errors
    /// [`MapError`] for duplicate ids, mismatched elevations and coordinates that are not finite.
    pub fn new(mut parts: MapParts) -> Result<Self, MapError> {
        let by_id = unique(parts.lanes.iter().map(|l| l.id), MapError::DuplicateLane)?;
        let roadblock_by_id = unique(
            parts.roadblocks.iter().map(|r| r.id),
            MapError::DuplicateRoadblock,
        )?;
        check(&parts)?;
        for lane in &mut parts.lanes {
            for links in [
                &mut lane.predecessors,
                &mut lane.successors,
                &mut lane.left_neighbors,
                &mut lane.right_neighbors,
            ] {
                links.retain(|id| by_id.contains_key(id));
            }
        }
        for block in &mut parts.roadblocks {
            for links in [&mut block.predecessors, &mut block.successors] {
                links.retain(|id| roadblock_by_id.contains_key(id));
            }
        }
        Ok(Self {
            by_id,
            roadblock_by_id,
            roadblock_lanes: grouped(parts.lanes.iter().map(|lane| lane.roadblock)),
            lane_areas: grouped(parts.areas.iter().map(|area| area.lanes.iter().copied())),
            places: Places::default(),
            parts,
        })
    }

    /// The parts that the map was built from, without dead links. To change a map, change a clone
    /// and build a new one.
    pub fn parts(&self) -> &MapParts {
        &self.parts
    }

    /// Information that the source of the map cannot express.
    pub fn unstated(&self) -> Unstated {
        self.parts.unstated
    }

    /// All lanes, in the order given.
    pub fn lanes(&self) -> &[Lane] {
        &self.parts.lanes
    }

    /// The lane with this id.
    pub fn lane(&self, id: LaneId) -> Option<&Lane> {
        self.by_id.get(&id).map(|&i| &self.parts.lanes[i])
    }

    /// The lanes that follow `id`, in the order stated; none if the lane is unknown.
    pub fn successors(&self, id: LaneId) -> impl Iterator<Item = &Lane> {
        self.lane(id)
            .into_iter()
            .flat_map(|lane| &lane.successors)
            .filter_map(|&next| self.lane(next))
    }

    /// The successor of `lane` that leads straightest on: whose direction 10 m from its start, or at
    /// its end if that is nearer, is nearest to the direction in which `lane` ends. Of equally
    /// straight ones the first stated; `None` where the road ends.
    pub fn straightest_successor(&self, lane: &Lane) -> Option<&Lane> {
        let end = lane.centerline.pose_at(lane.centerline.length()).heading;
        let turn = |next: &Lane| {
            let ahead = LOOK_M.min(next.centerline.length());
            let direction = next.centerline.pose_at(ahead).heading;
            angle_difference(direction, end).abs()
        };
        let next = self.successors(lane.id);
        next.min_by(|a, b| turn(a).total_cmp(&turn(b)))
    }

    /// The lanes that lead into `id`, in the order stated; none if the lane is unknown.
    pub fn predecessors(&self, id: LaneId) -> impl Iterator<Item = &Lane> {
        self.lane(id)
            .into_iter()
            .flat_map(|lane| &lane.predecessors)
            .filter_map(|&before| self.lane(before))
    }

    /// Lanes whose centre line passes within `radius` metres, nearest first, each once, with the
    /// distance.
    pub fn lanes_near(&self, point: DVec2, radius: f64) -> impl Iterator<Item = (&Lane, f64)> + '_ {
        let mut seen = Vec::new();
        self.lane_segments()
            .within(point, radius)
            .filter_map(move |((lane, _), distance)| {
                if seen.contains(&lane) {
                    return None;
                }
                seen.push(lane);
                Some((&self.parts.lanes[lane], distance))
            })
    }

    /// Lanes whose surface ([`Lane::surface`]) contains `point`, its border excluded, in the order
    /// of [`MapGraph::lanes`].
    pub fn lanes_containing(&self, point: DVec2) -> impl Iterator<Item = &Lane> {
        sorted(self.lane_boxes().intersecting(point, point))
            .map(|i| &self.parts.lanes[i])
            .filter(move |lane| lane.surface().is_some_and(|s| s.contains_strictly(point)))
    }

    /// Lanes whose surface shares a point with the axis-aligned square of side `2 * half` metres
    /// around `center`, in the order of [`MapGraph::lanes`].
    ///
    /// Source: the proximity query of nuPlan, which uses a square where others use a disc.
    pub fn lanes_in_square(&self, center: DVec2, half: f64) -> impl Iterator<Item = &Lane> {
        let square = square(center, half);
        sorted(self.lane_boxes().intersecting(center - half, center + half))
            .map(|i| &self.parts.lanes[i])
            .filter(move |lane| lane.surface().is_some_and(|s| s.intersects(&square)))
    }

    /// All roadblocks, in the order given; none in formats that have none.
    pub fn roadblocks(&self) -> &[Roadblock] {
        &self.parts.roadblocks
    }

    /// The roadblock with this id.
    pub fn roadblock(&self, id: RoadblockId) -> Option<&Roadblock> {
        let index = self.roadblock_by_id.get(&id);
        index.map(|&i| &self.parts.roadblocks[i])
    }

    /// The lanes of a roadblock, in the order of [`MapGraph::lanes`].
    pub fn roadblock_lanes(&self, id: RoadblockId) -> impl Iterator<Item = &Lane> {
        let lanes = self.roadblock_lanes.get(&id).map_or(&[][..], Vec::as_slice);
        lanes.iter().map(|&i| &self.parts.lanes[i])
    }

    /// Roadblocks whose outline contains `point`, its border excluded, in the order of
    /// [`MapGraph::roadblocks`].
    pub fn roadblocks_containing(&self, point: DVec2) -> impl Iterator<Item = &Roadblock> {
        sorted(self.roadblock_boxes().intersecting(point, point))
            .map(|i| &self.parts.roadblocks[i])
            .filter(move |block| block.outline.contains_strictly(point))
    }

    /// Roadblocks whose outline shares a point with the square of [`MapGraph::lanes_in_square`], in
    /// the order of [`MapGraph::roadblocks`].
    pub fn roadblocks_in_square(
        &self,
        center: DVec2,
        half: f64,
    ) -> impl Iterator<Item = &Roadblock> {
        let square = square(center, half);
        sorted(
            self.roadblock_boxes()
                .intersecting(center - half, center + half),
        )
        .map(|i| &self.parts.roadblocks[i])
        .filter(move |block| block.outline.intersects(&square))
    }

    /// Painted lines.
    pub fn road_lines(&self) -> &[RoadLine] {
        &self.parts.road_lines
    }

    /// Borders of the drivable surface.
    pub fn road_edges(&self) -> &[RoadEdge] {
        &self.parts.road_edges
    }

    /// Segments of road edges as (index into [`MapGraph::road_edges`], index of the segment,
    /// distance in metres), nearest first, lazily.
    pub fn nearest_road_edges(
        &self,
        point: DVec2,
    ) -> impl Iterator<Item = (usize, usize, f64)> + '_ {
        self.edge_segments()
            .nearest(point)
            .map(|((edge, segment), distance)| (edge, segment, distance))
    }

    /// Crosswalks, bumps, driveways, stop lines, intersections and the like.
    pub fn areas(&self) -> &[Area] {
        &self.parts.areas
    }

    /// Areas of one kind that contain `point`, their border excluded, in the order of
    /// [`MapGraph::areas`].
    pub fn areas_containing(&self, point: DVec2, kind: AreaKind) -> impl Iterator<Item = &Area> {
        sorted(self.area_boxes().intersecting(point, point))
            .map(|i| &self.parts.areas[i])
            .filter(move |area| area.kind == kind && area.polygon.contains_strictly(point))
    }

    /// Areas of one kind that share a point with the square of [`MapGraph::lanes_in_square`], in
    /// the order of [`MapGraph::areas`].
    pub fn areas_in_square(
        &self,
        center: DVec2,
        half: f64,
        kind: AreaKind,
    ) -> impl Iterator<Item = &Area> {
        let square = square(center, half);
        sorted(self.area_boxes().intersecting(center - half, center + half))
            .map(|i| &self.parts.areas[i])
            .filter(move |area| area.kind == kind && area.polygon.intersects(&square))
    }

    /// The stop lines at which traffic of lane `id` waits, in the order of [`MapGraph::areas`].
    pub fn stop_lines(&self, id: LaneId) -> impl Iterator<Item = &Area> {
        let areas = self.lane_areas.get(&id).map_or(&[][..], Vec::as_slice);
        areas
            .iter()
            .map(|&i| &self.parts.areas[i])
            .filter(|area| matches!(area.kind, AreaKind::StopLine | AreaKind::TurnStop))
    }

    /// Stop signs.
    pub fn stop_signs(&self) -> &[StopSign] {
        &self.parts.stop_signs
    }

    /// Stop signs that apply to a lane.
    pub fn stop_signs_of(&self, lane: LaneId) -> impl Iterator<Item = &StopSign> {
        let signs = self.stop_signs().iter();
        signs.filter(move |sign| sign.lanes.contains(&lane))
    }

    /// Surfaces a vehicle may be on.
    pub fn drivable(&self) -> &[Polygon] {
        &self.parts.drivable
    }

    /// True if `point` lies on a drivable surface. A map without any has no off-road: true.
    pub fn is_drivable(&self, point: DVec2) -> bool {
        self.parts.drivable.is_empty()
            || self
                .drivable_boxes()
                .intersecting(point, point)
                .any(|i| self.parts.drivable[i].contains(point))
    }

    /// Metres from `point` to the nearest drivable surface, 0 on one; `None` for a map without any.
    pub fn drivable_distance(&self, point: DVec2) -> Option<f64> {
        let mut best: Option<f64> = None;
        for (i, at_least) in self.drivable_boxes().nearest(point) {
            if best.is_some_and(|best| best <= at_least) {
                break;
            }
            let distance = self.parts.drivable[i].signed_distance(point).max(0.0);
            best = Some(best.map_or(distance, |best| best.min(distance)));
        }
        best
    }

    /// Mean z of the four map points nearest to `point`, metres; `None` for a map without points.
    ///
    /// Source: the elevation rule of the GUMP paper's Waymo evaluation.
    pub fn elevation_at(&self, point: DVec2) -> Option<f64> {
        let (points, heights) = self.places.heights.get_or_init(|| heights(&self.parts));
        let nearest = points.nearest(point, 4);
        let (sum, n) = nearest.fold((0.0, 0), |(sum, n), (i, _)| (sum + heights[i], n + 1));
        (n > 0).then(|| sum / f64::from(n))
    }
}

impl MapGraph {
    fn lane_segments(&self) -> &SegmentIndex<(usize, usize)> {
        let lanes = self.parts.lanes.iter();
        let build = || segments(lanes.map(|lane| lane.centerline.segments()));
        self.places.lane_segments.get_or_init(build)
    }

    fn edge_segments(&self) -> &SegmentIndex<(usize, usize)> {
        let edges = self.parts.road_edges.iter();
        let build = || segments(edges.map(|edge| edge.line.segments()));
        self.places.edge_segments.get_or_init(build)
    }

    fn lane_boxes(&self) -> &BoxIndex<usize> {
        let build = || boxes(self.parts.lanes.iter().map(lane_bounds));
        self.places.lane_boxes.get_or_init(build)
    }

    fn roadblock_boxes(&self) -> &BoxIndex<usize> {
        let blocks = self.parts.roadblocks.iter();
        let build = || boxes(blocks.map(|block| block.outline.bounds()));
        self.places.roadblock_boxes.get_or_init(build)
    }

    fn area_boxes(&self) -> &BoxIndex<usize> {
        let build = || boxes(self.parts.areas.iter().map(|area| area.polygon.bounds()));
        self.places.area_boxes.get_or_init(build)
    }

    fn drivable_boxes(&self) -> &BoxIndex<usize> {
        let build = || boxes(self.parts.drivable.iter().map(Polygon::bounds));
        self.places.drivable_boxes.get_or_init(build)
    }
}

fn unique<Id: Ord + Copy>(
    ids: impl Iterator<Item = Id>,
    duplicate: impl Fn(Id) -> MapError,
) -> Result<BTreeMap<Id, usize>, MapError> {
    let mut by_id = BTreeMap::new();
    for (i, id) in ids.enumerate() {
        if by_id.insert(id, i).is_some() {
            return Err(duplicate(id));
        }
    }
    Ok(by_id)
}

fn check(parts: &MapParts) -> Result<(), MapError> {
    for lane in &parts.lanes {
        check_feature(lane.id.0, lane.centerline.points(), &lane.elevation)?;
        if let Some(outline) = &lane.outline {
            check_outline(lane.id.0, outline)?;
        }
    }
    for block in &parts.roadblocks {
        check_outline(block.id.0, &block.outline)?;
    }
    for line in &parts.road_lines {
        check_feature(line.id, line.line.points(), &line.elevation)?;
    }
    for edge in &parts.road_edges {
        check_feature(edge.id, edge.line.points(), &edge.elevation)?;
    }
    for area in &parts.areas {
        check_feature(area.id, area.polygon.ring(), &area.elevation)?;
    }
    Ok(())
}

fn check_outline(id: i64, outline: &Polygon) -> Result<(), MapError> {
    let corners = outline
        .ring()
        .iter()
        .chain(outline.holes().iter().flatten());
    match corners.enumerate().find(|(_, p)| !p.is_finite()) {
        Some((point, _)) => Err(MapError::NotFinite { id, point }),
        None => Ok(()),
    }
}

fn check_feature(id: i64, points: &[DVec2], elevations: &[f64]) -> Result<(), MapError> {
    if points.len() != elevations.len() {
        return Err(MapError::ElevationCount {
            id,
            points: points.len(),
            elevations: elevations.len(),
        });
    }
    let finite = |(p, z): (&DVec2, &f64)| p.is_finite() && z.is_finite();
    match points.iter().zip(elevations).position(|pair| !finite(pair)) {
        Some(point) => Err(MapError::NotFinite { id, point }),
        None => Ok(()),
    }
}

/// Indices by what they belong to, in ascending order.
fn grouped<Id: Ord, Ids: IntoIterator<Item = Id>>(
    members: impl Iterator<Item = Ids>,
) -> BTreeMap<Id, Vec<usize>> {
    let mut groups: BTreeMap<Id, Vec<usize>> = BTreeMap::new();
    for (i, ids) in members.enumerate() {
        for id in ids {
            groups.entry(id).or_default().push(i);
        }
    }
    groups
}

/// The segments of many lines, each with (line, segment).
fn segments(
    lines: impl Iterator<Item = impl Iterator<Item = (DVec2, DVec2)>>,
) -> SegmentIndex<(usize, usize)> {
    let all = lines.enumerate().flat_map(|(line, segments)| {
        let numbered = segments.enumerate();
        numbered.map(move |(segment, (a, b))| (a, b, (line, segment)))
    });
    SegmentIndex::new(all)
}

fn boxes(bounds: impl Iterator<Item = (DVec2, DVec2)>) -> BoxIndex<usize> {
    let numbered = bounds.enumerate();
    BoxIndex::new(numbered.map(|(i, (min, max))| (min, max, i)))
}

/// A box around the lane's surface, without building the surface.
fn lane_bounds(lane: &Lane) -> (DVec2, DVec2) {
    if let Some(outline) = &lane.outline {
        return outline.bounds();
    }
    let points = lane.centerline.points();
    let fold = |f: fn(DVec2, DVec2) -> DVec2| points.iter().copied().fold(points[0], f);
    let half = lane.width.max(0.0) / 2.0;
    (fold(DVec2::min) - half, fold(DVec2::max) + half)
}

fn square(center: DVec2, half: f64) -> Polygon {
    let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
    let ring = corners.map(|(x, y)| center + dvec2(x, y) * half).to_vec();
    Polygon::new(ring).expect("a square has four corners")
}

/// An index in no promised order becomes the map's order.
fn sorted(found: impl Iterator<Item = usize>) -> impl Iterator<Item = usize> {
    let mut found: Vec<usize> = found.collect();
    found.sort_unstable();
    found.into_iter()
}

fn heights(parts: &MapParts) -> (PointIndex, Vec<f64>) {
    let lanes = parts.lanes.iter();
    let lanes = lanes.map(|lane| (lane.centerline.points(), &lane.elevation));
    let lines = parts.road_lines.iter();
    let lines = lines.map(|line| (line.line.points(), &line.elevation));
    let edges = parts.road_edges.iter();
    let edges = edges.map(|edge| (edge.line.points(), &edge.elevation));
    let all = lanes.chain(lines).chain(edges);
    let (points, elevations): (Vec<DVec2>, Vec<f64>) = all
        .flat_map(|(points, z)| points.iter().copied().zip(z.iter().copied()))
        .unzip();
    (PointIndex::new(points), elevations)
}

#[cfg(test)]
mod tests {
    use gump_geometry::Polyline;

    use super::*;

    fn line(points: &[(f64, f64)]) -> Polyline {
        Polyline::new(points.iter().map(|&(x, y)| dvec2(x, y)).collect()).unwrap()
    }

    fn rectangle(low: (f64, f64), high: (f64, f64)) -> Polygon {
        let corners = [low, (high.0, low.1), high, (low.0, high.1)];
        Polygon::new(corners.map(|(x, y)| dvec2(x, y)).to_vec()).unwrap()
    }

    /// Two lanes side by side in roadblock 7, the right one (2) without a stated outline, and a
    /// link (3) through roadblock 8 with a stop line.
    fn map() -> MapGraph {
        let lane = |id, points: &[(f64, f64)]| {
            let centerline = line(points);
            let elevation = vec![0.0; centerline.points().len()];
            Lane::new(LaneId(id), centerline, elevation)
        };
        let left = Lane {
            outline: Some(rectangle((0.0, 0.0), (20.0, 4.0))),
            roadblock: Some(RoadblockId(7)),
            ..lane(1, &[(0.0, 2.0), (20.0, 2.0)])
        };
        let right = Lane {
            width: 3.0,
            roadblock: Some(RoadblockId(7)),
            successors: vec![LaneId(3), LaneId(99)],
            ..lane(2, &[(0.0, -2.0), (20.0, -2.0)])
        };
        let link = Lane {
            in_intersection: true,
            roadblock: Some(RoadblockId(8)),
            predecessors: vec![LaneId(2)],
            ..lane(3, &[(20.0, -2.0), (30.0, -2.0)])
        };
        let block = |id, outline, successors| Roadblock {
            id: RoadblockId(id),
            outline,
            in_intersection: id == 8,
            predecessors: Vec::new(),
            successors,
        };
        let stop_line = Area {
            lanes: vec![LaneId(3)],
            ..Area::new(5, AreaKind::StopLine, rectangle((19.0, -4.0), (20.0, 0.0)))
        };
        MapGraph::new(MapParts {
            lanes: vec![left, right, link],
            roadblocks: vec![
                block(
                    7,
                    rectangle((0.0, -4.0), (20.0, 4.0)),
                    vec![RoadblockId(8), RoadblockId(9)],
                ),
                block(8, rectangle((20.0, -4.0), (30.0, 0.0)), Vec::new()),
            ],
            areas: vec![stop_line],
            drivable: vec![
                rectangle((0.0, -4.0), (20.0, 4.0)),
                rectangle((20.0, -4.0), (30.0, 0.0)),
            ],
            ..MapParts::default()
        })
        .unwrap()
    }

    fn ids<'a>(lanes: impl Iterator<Item = &'a Lane>) -> Vec<i64> {
        lanes.map(|lane| lane.id.0).collect()
    }

    #[test]
    fn lanes_contain_what_is_inside_their_surface() {
        let map = map();
        let at = |x, y| ids(map.lanes_containing(dvec2(x, y)));
        assert_eq!(at(5.0, 3.9), [1]);
        assert_eq!(at(5.0, 4.0), [0i64; 0], "the border is outside");
        assert_eq!(at(5.0, -0.6), [2], "1.4 m beside a lane of 3 m");
        assert_eq!(at(5.0, -0.4), [0i64; 0], "1.6 m beside a lane of 3 m");
        assert_eq!(at(25.0, -3.0), [3]);
    }

    #[test]
    fn squares_find_what_they_touch() {
        let map = map();
        let lanes = |x, y, half| ids(map.lanes_in_square(dvec2(x, y), half));
        assert_eq!(lanes(20.0, 0.0, 1.0), [1, 2, 3]);
        assert_eq!(lanes(10.0, 5.0, 1.0), [1]);
        let blocks = map.roadblocks_in_square(dvec2(25.0, 3.0), 3.0);
        assert_eq!(blocks.map(|block| block.id.0).collect::<Vec<_>>(), [8]);
        let stops = |half| map.areas_in_square(dvec2(17.0, -2.0), half, AreaKind::StopLine);
        assert_eq!((stops(1.9).count(), stops(2.0).count()), (0, 1));
    }

    #[test]
    fn roadblocks_know_their_lanes_and_their_neighbours() {
        let map = map();
        assert_eq!(ids(map.roadblock_lanes(RoadblockId(7))), [1, 2]);
        assert_eq!(ids(map.roadblock_lanes(RoadblockId(99))), [0i64; 0]);
        let block = map.roadblock(RoadblockId(7)).unwrap();
        assert_eq!(block.successors, [RoadblockId(8)], "9 is not in the map");
        let around = map.roadblocks_containing(dvec2(10.0, 0.0));
        assert_eq!(around.map(|b| b.id.0).collect::<Vec<_>>(), [7]);
        assert_eq!(ids(map.successors(LaneId(2))), [3]);
        assert_eq!(ids(map.predecessors(LaneId(3))), [2]);
        assert_eq!(map.stop_lines(LaneId(3)).count(), 1);
        assert_eq!(map.stop_lines(LaneId(2)).count(), 0);
    }

    #[test]
    fn the_distance_to_the_road_is_zero_on_it() {
        let map = map();
        assert_eq!(map.drivable_distance(dvec2(10.0, 0.0)), Some(0.0));
        assert_eq!(map.drivable_distance(dvec2(33.0, 4.0)), Some(5.0));
        assert_eq!(MapGraph::default().drivable_distance(DVec2::ZERO), None);
    }

    #[test]
    fn two_roadblocks_of_one_id_are_an_error() {
        let block = map().roadblocks()[0].clone();
        let parts = MapParts {
            roadblocks: vec![block.clone(), block],
            ..MapParts::default()
        };
        let error = MapGraph::new(parts).unwrap_err();
        assert_eq!(error, MapError::DuplicateRoadblock(RoadblockId(7)));
    }
}
