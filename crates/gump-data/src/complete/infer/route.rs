//! The ego's route, from its logged path.
//!
//! The log is matched to the lane graph as a whole: every few metres the ego is assigned to one of
//! the lanes near it, and the sequence of lanes with the lowest cost wins. Distance, difference in
//! heading and lane changes have costs, and leaving the graph has a high one.
//!
//! Source: map matching by a hidden Markov model after Newson and Krumm 2009, solved by Viterbi's
//! algorithm; the costs are ours.

use gump_geometry::{DVec2, Polyline, Pose, SegmentIndex, angle_difference};
use gump_scene::{Lane, LaneId, MapGraph, Route, Scenario};

// Chosen by hand. What matters is the order of costs: a sample half a lane beside the centre costs
// less than a change of lane, and that far less than a gap in the graph.
/// Metres the ego moves between two samples.
const SPACING: f64 = 2.0;
/// Lanes further away than this are not driven on, metres.
const MAX_DISTANCE: f64 = 4.0;
/// Nor are lanes in another direction, radians.
const MAX_TURN: f64 = 1.2;
/// Cost of one radian beside the lane's direction, in square metres beside its centre.
const TURN_COST: f64 = 8.0;
/// Cost of one lane change.
const CHANGE_COST: f64 = 6.0;
/// Cost of going on in a lane the graph does not lead to.
const JUMP_COST: f64 = 200.0;
/// Maximum number of links between two samples: short lanes can fall between them.
const MAX_LINKS: usize = 3;
/// Metres over which the path moves from one lane to its neighbour, centred on the change.
const CHANGE_LENGTH: f64 = 20.0;

/// The lanes the ego drives in the log, to the end of the last; `None` if it drives on none.
pub(super) fn infer(scenario: &Scenario) -> Option<Route> {
    let map = &scenario.map;
    let (samples, present) = samples(scenario)?;
    let matched = match_lanes(map, &samples)?;
    let mut legs = legs(map, &matched, present)?;
    bridge(map, &mut legs);
    let path = path(map, &legs, &samples)?;
    let lanes = legs.iter().map(|leg| leg.lane).collect();
    Some(Route {
        lanes,
        roadblocks: Vec::new(),
        path,
    })
}

/// Poses every [`SPACING`] metres along the ego's log, and which of them is at the present.
fn samples(scenario: &Scenario) -> Option<(Vec<Pose>, usize)> {
    let mut poses: Vec<Pose> = Vec::new();
    let mut present = None;
    for (i, frame) in scenario.log.iter().enumerate() {
        let Some(ego) = frame.agent(scenario.ego) else {
            continue;
        };
        let pose = ego.state.pose;
        let far = |last: &Pose| last.position.distance(pose.position) >= SPACING;
        if poses.last().is_none_or(far) {
            poses.push(pose);
        }
        if i == scenario.now {
            present = Some(poses.len() - 1);
        }
    }
    Some((poses, present?))
}

/// The lane of each sample, `None` where no lane is near; `None` as a whole if none ever is.
fn match_lanes(map: &MapGraph, samples: &[Pose]) -> Option<Vec<Option<LaneId>>> {
    let along = Along::new(map, samples);
    let mut steps: Vec<Vec<Candidate<'_>>> = Vec::with_capacity(samples.len());
    let mut last: usize = 0;
    for &pose in samples {
        let mut candidates = along.candidates(pose);
        let before = steps.get(last).map_or(&[][..], Vec::as_slice);
        for candidate in &mut candidates {
            let arrive = |b: &Candidate<'_>| b.cost + transition(map, b.lane, candidate.lane);
            let best = before.iter().map(arrive).enumerate();
            if let Some((from, cost)) = best.min_by(|a, b| a.1.total_cmp(&b.1)) {
                candidate.cost += cost;
                candidate.from = Some((last, from));
            }
        }
        if !candidates.is_empty() {
            last = steps.len();
        }
        steps.push(candidates);
    }
    let final_costs = steps[last].iter().enumerate();
    let (best, _) = final_costs.min_by(|a, b| a.1.cost.total_cmp(&b.1.cost))?;
    let mut matched = vec![None; samples.len()];
    let mut at = Some((last, best));
    while let Some((step, k)) = at {
        matched[step] = Some(steps[step][k].lane.id);
        at = steps[step][k].from;
    }
    Some(matched)
}

struct Candidate<'a> {
    lane: &'a Lane,
    /// Cost of the best sequence that ends here.
    cost: f64,
    /// Step and index of the candidate before it in that sequence.
    from: Option<(usize, usize)>,
}

/// The lanes near the ego's path. An index of the whole map would take longer to build than all
/// other inference.
struct Along<'a> {
    lanes: &'a [Lane],
    segments: SegmentIndex<usize>,
}

impl<'a> Along<'a> {
    fn new(map: &'a MapGraph, samples: &[Pose]) -> Self {
        let places = || samples.iter().map(|pose| pose.position);
        let low = places().fold(DVec2::INFINITY, DVec2::min) - MAX_DISTANCE;
        let high = places().fold(DVec2::NEG_INFINITY, DVec2::max) + MAX_DISTANCE;
        let is_near = |a: DVec2, b: DVec2| a.min(b).cmple(high).all() && a.max(b).cmpge(low).all();
        let mut segments = Vec::new();
        for (i, lane) in map.lanes().iter().enumerate() {
            let near = lane.centerline.segments().filter(|&(a, b)| is_near(a, b));
            segments.extend(near.map(|(a, b)| (a, b, i)));
        }
        Self {
            lanes: map.lanes(),
            segments: SegmentIndex::new(segments),
        }
    }

    /// Lanes near a pose that lead its way.
    fn candidates(&self, pose: Pose) -> Vec<Candidate<'a>> {
        let mut seen: Vec<usize> = Vec::new();
        let mut found = Vec::new();
        for (i, distance) in self.segments.within(pose.position, MAX_DISTANCE) {
            if seen.contains(&i) {
                continue;
            }
            seen.push(i);
            let lane = &self.lanes[i];
            let foot = lane.centerline.project(pose.position).arc_length;
            let direction = lane.centerline.pose_at(foot).heading;
            let turn = angle_difference(pose.heading, direction).abs();
            if turn <= MAX_TURN {
                found.push(Candidate {
                    lane,
                    cost: distance * distance + TURN_COST * turn * turn,
                    from: None,
                });
            }
        }
        found
    }
}

fn transition(map: &MapGraph, from: &Lane, to: &Lane) -> f64 {
    if from.id == to.id || chain(map, from.id, to.id).is_some() {
        0.0
    } else if is_neighbor(from, to.id) {
        CHANGE_COST
    } else if changes_into(map, from, to).is_some() {
        2.0 * CHANGE_COST
    } else {
        JUMP_COST
    }
}

fn is_neighbor(lane: &Lane, other: LaneId) -> bool {
    lane.left_neighbors.contains(&other) || lane.right_neighbors.contains(&other)
}

/// A neighbour of `from` that leads to `to`, or a successor of `from` beside `to`.
fn changes_into(map: &MapGraph, from: &Lane, to: &Lane) -> Option<LaneId> {
    let beside = from.left_neighbors.iter().chain(&from.right_neighbors);
    let leads = beside.copied().find(|&id| chain(map, id, to.id).is_some());
    let next = map
        .successors(from.id)
        .find(|next| is_neighbor(next, to.id));
    leads.or_else(|| next.map(|lane| lane.id))
}

/// The lanes strictly between two lanes along the shortest chain of links of at most
/// [`MAX_LINKS`]; `None` if there is no such chain.
fn chain(map: &MapGraph, from: LaneId, to: LaneId) -> Option<Vec<LaneId>> {
    let mut seen = vec![(from, from)];
    let mut level = 0..1;
    for _ in 0..MAX_LINKS {
        for i in level.clone() {
            let lane = seen[i].0;
            for next in map.successors(lane) {
                if next.id == to {
                    return Some(way_back(&seen, from, lane));
                }
                if seen.iter().all(|(id, _)| *id != next.id) {
                    seen.push((next.id, lane));
                }
            }
        }
        level = level.end..seen.len();
    }
    None
}

/// The lanes after `from` up to and including `last`, given every lane's predecessor.
fn way_back(seen: &[(LaneId, LaneId)], from: LaneId, last: LaneId) -> Vec<LaneId> {
    let mut way = Vec::new();
    let mut lane = last;
    while lane != from {
        way.push(lane);
        let before = seen.iter().find(|(id, _)| *id == lane);
        lane = before.map_or(from, |(_, before)| *before);
    }
    way.reverse();
    way
}

/// A lane of the route and where it is entered: at its start, or beside the sample where the
/// ego changed into it.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Leg {
    lane: LaneId,
    change_at: Option<usize>,
}

/// One leg per lane driven, cut to the connected stretch around the present.
fn legs(map: &MapGraph, matched: &[Option<LaneId>], present: usize) -> Option<Vec<Leg>> {
    let driven = matched
        .iter()
        .enumerate()
        .filter_map(|(i, lane)| Some((i, (*lane)?)));
    let mut legs: Vec<Leg> = Vec::new();
    for (sample, lane) in driven {
        let Some(last) = legs.last() else {
            legs.push(Leg {
                lane,
                change_at: None,
            });
            continue;
        };
        if last.lane == lane {
            continue;
        }
        let (from, to) = (map.lane(last.lane)?, map.lane(lane)?);
        let linked = chain(map, from.id, to.id).is_some();
        let jump = transition(map, from, to) >= JUMP_COST;
        if jump && sample <= present {
            legs.clear();
        } else if jump {
            break;
        }
        let change_at = (!linked && !legs.is_empty()).then_some(sample);
        legs.push(Leg { lane, change_at });
    }
    (!legs.is_empty()).then_some(legs)
}

/// Inserts the lanes that fell between two samples.
fn bridge(map: &MapGraph, legs: &mut Vec<Leg>) {
    let mut bridged: Vec<Leg> = Vec::with_capacity(legs.len());
    for &leg in legs.iter() {
        let Some(last) = bridged.last().map(|last| last.lane) else {
            bridged.push(leg);
            continue;
        };
        match (leg.change_at, map.lane(last), map.lane(leg.lane)) {
            (None, ..) => {
                let between = chain(map, last, leg.lane).unwrap_or_default();
                bridged.extend(between.into_iter().map(|lane| Leg {
                    lane,
                    change_at: None,
                }));
                bridged.push(leg);
            }
            (Some(sample), Some(from), Some(to)) if !is_neighbor(from, to.id) => {
                let via = changes_into(map, from, to).unwrap_or(to.id);
                let beside = is_neighbor(from, via);
                bridged.push(Leg {
                    lane: via,
                    change_at: beside.then_some(sample),
                });
                let between = if beside { chain(map, via, to.id) } else { None };
                let links = between.unwrap_or_default();
                bridged.extend(links.into_iter().map(|lane| Leg {
                    lane,
                    change_at: None,
                }));
                bridged.push(Leg {
                    lane: leg.lane,
                    change_at: (!beside).then_some(sample),
                });
            }
            _ => bridged.push(leg),
        }
    }
    *legs = bridged;
}

/// The centre lines of the legs one after another, moving over gently where lanes change.
fn path(map: &MapGraph, legs: &[Leg], samples: &[Pose]) -> Option<Polyline> {
    let mut points = Vec::new();
    let mut entered = 0.0;
    for (i, leg) in legs.iter().enumerate() {
        let line = &map.lane(leg.lane)?.centerline;
        let change = |leg: &Leg| {
            leg.change_at
                .map(|k| line.project(samples[k].position).arc_length)
        };
        let exit = legs
            .get(i + 1)
            .and_then(change)
            .map(|s| s - CHANGE_LENGTH / 2.0);
        if let Some(s) = change(leg) {
            entered = (s + CHANGE_LENGTH / 2.0).min(line.length());
        }
        let exit = exit.unwrap_or(line.length()).max(entered);
        points.extend_from_slice(line.slice(entered, exit).points());
        entered = 0.0;
    }
    points.dedup_by(|b, a| a.distance(*b) < 1e-6);
    Polyline::new(points)
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec2;

    fn check(text: &str, expected: &[i64]) -> Route {
        let mut scenario = gump_scene::fixture::scenario(text).unwrap();
        scenario.route = None;
        let route = infer(&scenario).unwrap();
        let ids: Vec<_> = route.lanes.iter().map(|id| id.0).collect();
        assert_eq!(ids, expected);
        let ego = scenario.present().ego_now().state.pose.position;
        assert!(route.path.project(ego).arc_length > 0.0);
        route
    }

    #[test]
    fn the_ego_s_lanes_are_followed_through_forks_to_the_end_of_the_last() {
        let route = check(
            "lane 1: 0,0 20,0 next 2,3
             lane 2: 20,0 60,20
             lane 3: 20,0 60,0 next 4
             lane 4: 60,0 200,0
             lane 5: 0,3 200,3
             ego vehicle 0: 10,0.3 velocity 10,0",
            &[1, 3, 4],
        );
        assert_eq!(route.path.length(), 200.0);
    }

    #[test]
    fn lanes_too_short_to_be_seen_are_bridged() {
        check(
            "lane 1: 0,0 20.5,0 next 2
             lane 2: 20.5,0 21.4,0 next 3
             lane 3: 21.4,0 200,0
             ego vehicle 0: 11,0 velocity 10,0",
            &[1, 2, 3],
        );
    }

    #[test]
    fn a_lane_change_is_part_of_the_route() {
        let route = check(
            "lane 1: 0,0 200,0 left 2
             lane 2: 0,3.5 200,3.5 right 1
             ego vehicle 0: 20,0.5 heading 0.05 velocity 9.98,0.5",
            &[1, 2],
        );
        assert_eq!(*route.path.points().first().unwrap(), dvec2(0.0, 0.0));
        assert_eq!(*route.path.points().last().unwrap(), dvec2(200.0, 3.5));
        // No step sideways: the move takes about CHANGE_LENGTH metres.
        let turns = route.path.segments().map(|(a, b)| (b - a).to_angle().abs());
        assert!(turns.fold(0.0, f64::max) < 0.2);
    }

    #[test]
    fn lanes_of_the_other_direction_do_not_count() {
        check(
            "lane 1: 0,1 200,1\nlane 2: 200,0 0,0\nego vehicle 0: 20,0.4 velocity 10,0",
            &[1],
        );
    }

    #[test]
    fn off_the_lanes_there_is_no_route() {
        let text = "lane 1: 0,50 90,50\nego vehicle 0: 20,0 velocity 5,0";
        assert!(infer(&gump_scene::fixture::scenario(text).unwrap()).is_none());
    }

    #[test]
    fn a_gap_in_the_graph_ends_the_route() {
        check(
            "lane 1: 0,0 50,0\nlane 2: 50,0 200,0\nego vehicle 0: 20,0 velocity 9,0",
            &[1],
        );
    }

    #[test]
    fn a_change_across_the_end_of_a_lane_goes_by_way_of_its_neighbour() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 20,0 next 3 left 2
             lane 2: 0,3.5 20,3.5 next 4 right 1
             lane 3: 20,0 90,0
             lane 4: 20,3.5 90,3.5
             ego vehicle 0: 10,0 velocity 5,0",
        )
        .unwrap();
        let leg = |lane, change_at| Leg {
            lane: LaneId(lane),
            change_at,
        };
        let mut legs = vec![leg(1, None), leg(4, Some(7))];
        bridge(&scenario.map, &mut legs);
        assert_eq!(legs, [leg(1, None), leg(2, Some(7)), leg(4, None)]);
    }
}
