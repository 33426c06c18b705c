//! Where a vehicle means to go: the lanes that it is about to follow.
//!
//! The network may be told, agent by agent. In training the lanes are those that the log follows; in
//! rollouts they are drawn (`gump_engine::relative`) and kept, so that a vehicle turns, or changes lane,
//! because it means to. A vehicle about to change lane follows the other lane: its route starts beside
//! it.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use gump_geometry::{Pose, angle_difference};
use gump_scene::{BendLimits, Lane, LaneId, MapGraph, Seed, bend_speed};
use rand::Rng as _;

use crate::relative::map::{PATH_M, VectorMap};
use crate::steps::TOKEN_DT;

// All were chosen by hand, with recorded lanes in mind, and not tuned.

/// A vehicle may be on a lane if its centre is within this distance of the lane's, metres, and it heads
/// along it within this angle, radians.
const ON_LANE_M: f64 = 2.0;
const ON_LANE: f64 = 0.6;
/// Weight of a radian, in metres, in choosing the lane.
const METRES_PER_RADIAN: f64 = 3.0;
/// A change of lane costs as much as being this far from a lane's centre at one frame, metres.
const CHANGE_M: f64 = 3.0;
/// Lanes that lead to each other over at most so many others within one frame.
const HOPS: usize = 4;
/// Frames of half a second before a change of lane from which on it is meant.
const FORESEEN: usize = 10;
/// Length of a route, metres: beyond what the network sees of it.
const AHEAD_M: f64 = 90.0;
/// Maximum number of lanes of a route; bounds the time where lanes are short.
const MOST_LANES: usize = 40;
/// A vehicle this far from all lanes of its route has lost it, metres; a radian counts as above. On the way
/// to the lane beside it the second number holds.
const LOST_M: f64 = 3.0;
const LOST_BESIDE_M: f64 = 5.5;
/// A vehicle that would have to brake harder than this for a turn of its route does not take it, m/s².
const HARDEST_MPS2: f64 = 4.0;
/// Where lanes part, directions are those of a place so far ahead, metres. The lane that leads straightest
/// on and those within this angle of it are the way on, radians, if they turn by no more than the second
/// angle.
const LEADS_M: f64 = 25.0;
const PARTS: f64 = 0.04;
const NOT_ON: f64 = 0.35;
/// Beyond this angle a way leads back, radians.
const BACKWARD: f64 = 1.9;
/// Relative frequency of another way than the one on, of one back, ...
const TO_A_SIDE: f64 = 0.2;
const BACK: f64 = 0.02;
/// ... and of one that the vehicle is too fast for.
const TOO_FAST: f64 = 0.01;
/// Who remains on the map takes no way on which it ends after less than this share of the longest one, of
/// which so many metres count: at 50 km/h half a minute.
pub const LONG_ENOUGH: f64 = 0.75;
const REMAINS_M: f64 = 400.0;
/// How drivers take bends.
const BENDS: BendLimits = BendLimits {
    lateral_mps2: 3.0,
    braking_mps2: 3.0,
    ahead_m: 30.0,
};

/// Lanes that a vehicle means to follow, in order. A [`gump_scene::Route`] is that of a scenario's ego,
/// stated by its file; this one is determined or drawn for any vehicle, and goes on with it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Route {
    lanes: Arc<[LaneId]>,
}

/// A vehicle for which a route is drawn: where it is, metres per second, and its own seed, which decides
/// where lanes part, for every lane separately.
#[derive(Clone, Copy, Debug)]
pub struct Traveller {
    /// Its pose.
    pub pose: Pose,
    /// Metres per second.
    pub speed: f64,
    /// Its seed.
    pub seed: Seed,
    /// Whether it takes none of the ways that soon end, where others go on.
    pub remains: bool,
}

/// A lane that a vehicle may be on.
struct On<'a> {
    lane: &'a Lane,
    /// Distance and difference of direction, metres.
    cost: f64,
}

fn cost(lane: &Lane, pose: Pose) -> f64 {
    let foot = lane.foot(pose);
    foot.lateral_m.abs() + METRES_PER_RADIAN * foot.turned
}

/// The lanes that a vehicle may be on.
fn lanes_at(map: &MapGraph, pose: Pose) -> Vec<On<'_>> {
    let near = map.lanes_near(pose.position, ON_LANE_M);
    let on = near.filter(|(lane, _)| lane.foot(pose).turned <= ON_LANE);
    on.map(|(lane, _)| {
        let cost = cost(lane, pose);
        On { lane, cost }
    })
    .collect()
}

impl Route {
    /// The lanes.
    pub fn lanes(&self) -> &[LaneId] {
        &self.lanes
    }

    /// The lane that follows one of its lanes.
    pub fn after(&self, lane: LaneId) -> Option<LaneId> {
        let at = self.lanes.iter().position(|id| *id == lane)?;
        self.lanes.get(at + 1).copied()
    }

    /// The route of a vehicle without one: the lane that it is on, and what follows; `None` if it is on
    /// none.
    pub fn from_here(map: &MapGraph, who: Traveller) -> Option<Self> {
        let on = lanes_at(map, who.pose).into_iter();
        let best = on.min_by(|a, b| a.cost.total_cmp(&b.cost))?;
        Some(Self::extended(map, vec![best.lane.id], who))
    }

    /// The route of a vehicle that means to turn into a driveway: a lane of
    /// [`Driveways`](crate::relative::driveway::Driveways).
    pub fn into_driveway(lane: LaneId) -> Self {
        Self {
            lanes: Arc::new([lane]),
        }
    }

    /// The route of a vehicle that means to change to `lane`, which is beside it.
    pub fn into_lane(map: &MapGraph, lane: LaneId, who: Traveller) -> Self {
        Self::extended(map, from_beside(map, lane, who.pose), who)
    }

    /// The same route from the lane on that the vehicle has come to, as long as before; `None` if it has
    /// lost it, from which one that changes lane is farther.
    pub fn from_there(&self, map: &MapGraph, who: Traveller, changes_lane: bool) -> Option<Self> {
        let lanes = self.lanes.iter().enumerate();
        let lanes = lanes.filter_map(|(i, id)| {
            let lane = map.lane(*id)?;
            Some((cost(lane, who.pose), i))
        });
        let (least, at) = lanes.min_by(|a, b| a.0.total_cmp(&b.0))?;
        let lost = if changes_lane { LOST_BESIDE_M } else { LOST_M };
        (least < lost).then(|| Self::extended(map, self.lanes[at..].to_vec(), who))
    }

    /// Whether a vehicle is too fast for a turn that it could have passed by.
    pub fn is_missed(&self, map: &MapGraph, who: Traveller) -> bool {
        let lanes: Vec<&Lane> = self.lanes.iter().filter_map(|id| map.lane(*id)).collect();
        let Some(first) = lanes.first() else {
            return false;
        };
        let at = first.centerline.project(who.pose.position).arc_length;
        let mut ahead = first.centerline.length() - at;
        for pair in lanes.windows(2) {
            if who.speed * who.speed <= 2.0 * HARDEST_MPS2 * ahead {
                return false;
            }
            if pair[0].successors.len() > 1 {
                let there = bend_speed(map, pair[1], 0.0, BENDS);
                let squared = there * there + 2.0 * HARDEST_MPS2 * ahead;
                if who.speed * who.speed > squared {
                    return true;
                }
            }
            ahead += pair[1].centerline.length();
        }
        false
    }

    /// How far a vehicle is from the route, metres; a difference of direction counts as well.
    pub fn offset_m(&self, map: &MapGraph, pose: Pose) -> f64 {
        let lanes = self.lanes.iter().filter_map(|id| map.lane(*id));
        let costs = lanes.map(|lane| cost(lane, pose));
        costs.fold(f64::INFINITY, f64::min)
    }

    /// Lanes with what follows them, long enough from the vehicle on.
    fn extended(map: &MapGraph, mut lanes: Vec<LaneId>, who: Traveller) -> Self {
        let length = |id: &LaneId| map.lane(*id).map_or(0.0, |lane| lane.centerline.length());
        let first = lanes.first().and_then(|id| map.lane(*id));
        let driven = first.map_or(0.0, |lane| {
            lane.centerline.project(who.pose.position).arc_length
        });
        let mut ahead = lanes.iter().map(length).sum::<f64>() - driven;
        while ahead < AHEAD_M && lanes.len() < MOST_LANES {
            let last = lanes.last().and_then(|id| map.lane(*id));
            let Some(next) = last.and_then(|last| following(map, last, ahead, who)) else {
                break;
            };
            ahead += next.centerline.length();
            lanes.push(next.id);
        }
        Self {
            lanes: lanes.into(),
        }
    }

    /// Its pieces ahead of a vehicle, with the metres from the vehicle to the middle of each.
    pub(super) fn path(&self, map: &VectorMap, from: Pose) -> Vec<(u32, f64)> {
        let pieces = self.lanes.iter().flat_map(|lane| map.pieces_of(*lane));
        let pieces: Vec<u32> = pieces.copied().collect();
        let distance = |i: &u32| map.pieces[*i as usize].offset(from.position).0;
        let nearest = pieces.iter().enumerate();
        let nearest = nearest.map(|(at, i)| (distance(i), at));
        let Some((_, start)) = nearest.min_by(|a, b| a.0.total_cmp(&b.0)) else {
            return Vec::new();
        };
        let mut away = -map.pieces[pieces[start] as usize].axes.see(from.position).x;
        let mut path = vec![(pieces[start], away)];
        for pair in pieces[start..].windows(2) {
            if away > PATH_M {
                break;
            }
            let length = |i: u32| map.pieces[i as usize].length;
            away += 0.5 * (length(pair[0]) + length(pair[1]));
            path.push((pair[1], away));
        }
        path
    }
}

/// The lane that a vehicle goes on to from the end of a lane, so many metres ahead, by the frequency of
/// turns.
fn following<'a>(map: &'a MapGraph, lane: &Lane, ahead: f64, who: Traveller) -> Option<&'a Lane> {
    let end = lane.centerline.pose_at(lane.centerline.length());
    let mut next: Vec<(&Lane, f64)> = map
        .successors(lane.id)
        .map(|next| (next, bearing(map, next, end)))
        .collect();
    if next.len() < 2 {
        return next.first().map(|(lane, _)| *lane);
    }
    let least = next.iter().map(|(_, bearing)| *bearing);
    let least = least.fold(f64::INFINITY, f64::min);
    for (next, weight) in &mut next {
        let bearing = *weight;
        let is_too_fast = || {
            let there = bend_speed(map, next, 0.0, BENDS);
            who.speed * who.speed > there * there + 2.0 * BENDS.braking_mps2 * ahead.max(0.0)
        };
        *weight = match bearing {
            _ if bearing > PARTS && is_too_fast() => TOO_FAST,
            _ if bearing > BACKWARD => BACK,
            _ if least > NOT_ON || bearing < least + PARTS => 1.0,
            _ => TO_A_SIDE,
        };
    }
    if who.remains {
        let lasting: Vec<f64> = next.iter().map(|(lane, _)| lasts_m(map, lane)).collect();
        // Those that it can take.
        let able = next
            .iter()
            .zip(&lasting)
            .filter(|((_, weight), _)| *weight > TOO_FAST);
        let longest = able.map(|(_, metres)| *metres).fold(0.0, f64::max);
        for ((_, weight), metres) in next.iter_mut().zip(&lasting) {
            if *metres < LONG_ENOUGH * longest {
                *weight = 0.0;
            }
        }
    }
    let total: f64 = next.iter().map(|(_, weight)| weight).sum();
    let stream = who.seed.fork(lane.id.0 as u64);
    let mut left = total * stream.rng().random::<f64>();
    let found = next.iter().find(|(_, weight)| {
        left -= weight;
        left < 0.0
    });
    found.or(next.last()).map(|(lane, _)| *lane)
}

/// How far one can drive from the start of a lane, metres, as far as counts for who remains on the map: to a
/// metre for each lane on the way, which bounds the time where lanes part and meet again.
pub fn lasts_m(map: &MapGraph, lane: &Lane) -> f64 {
    let mut farthest: BTreeMap<LaneId, f64> = BTreeMap::new();
    let mut open = vec![(lane, 0.0)];
    let mut longest: f64 = 0.0;
    while let Some((lane, driven)) = open.pop() {
        let before = farthest.entry(lane.id).or_insert(f64::NEG_INFINITY);
        if driven < *before + 1.0 {
            continue;
        }
        *before = driven;
        let driven = driven + lane.centerline.length();
        longest = longest.max(driven);
        if longest >= REMAINS_M {
            return REMAINS_M;
        }
        open.extend(map.successors(lane.id).map(|next| (next, driven)));
    }
    longest
}

/// The direction in which a lane leads from its start to [`LEADS_M`] on, along the straightest way,
/// radians from straight on.
fn bearing(map: &MapGraph, lane: &Lane, start: Pose) -> f64 {
    let (mut lane, mut left) = (lane, LEADS_M);
    for _ in 0..HOPS {
        let length = lane.centerline.length();
        let end = lane.centerline.pose_at(length).heading;
        let turn = |next: &Lane| {
            let line = &next.centerline;
            angle_difference(line.pose_at(line.length()).heading, end).abs()
        };
        let next = map.successors(lane.id);
        let straightest = next.min_by(|a, b| turn(a).total_cmp(&turn(b)));
        match straightest.filter(|_| length < left) {
            Some(next) => (lane, left) = (next, left - length),
            None => break,
        }
    }
    let point = lane.centerline.point_at(left.min(lane.centerline.length()));
    let there = start.inverse() * point;
    there.y.abs().atan2(there.x)
}

/// A lane, after those before it where a vehicle is not yet beside it.
fn from_beside(map: &MapGraph, lane: LaneId, pose: Pose) -> Vec<LaneId> {
    let mut lanes = VecDeque::from([lane]);
    for _ in 0..HOPS {
        let first = map.lane(lanes[0]);
        let at = first.map(|lane| lane.centerline.project(pose.position).arc_length);
        if at.is_none_or(|at| at > 0.1) {
            break;
        }
        let distance = |lane: &Lane| lane.centerline.project(pose.position).distance;
        let before = map.predecessors(lanes[0]);
        let before = before.min_by(|a, b| distance(a).total_cmp(&distance(b)));
        match before {
            Some(before) if !lanes.contains(&before.id) => lanes.push_front(before.id),
            _ => break,
        }
    }
    lanes.into()
}

/// The lanes between two lanes that lead to each other; `None` if they do not.
fn between(map: &MapGraph, from: LaneId, to: LaneId) -> Option<Vec<LaneId>> {
    let mut ways: VecDeque<Vec<LaneId>> = VecDeque::from([vec![from]]);
    while let Some(way) = ways.pop_front() {
        let last = way[way.len() - 1];
        if last == to {
            return Some(way[1..way.len().max(2) - 1].to_vec());
        }
        if way.len() <= HOPS {
            let next = map.successors(last).filter(|next| !way.contains(&next.id));
            ways.extend(next.map(|next| way.iter().copied().chain([next.id]).collect()));
        }
    }
    None
}

/// The routes that a vehicle follows in its log, by frame of half a second; `None` where it is on no
/// lane. Beyond the log and beyond a change of lane that is not yet foreseen, the seed decides.
pub fn of_log(map: &MapGraph, poses: &[Option<Pose>], seed: Seed) -> Vec<Option<Route>> {
    let on: Vec<Vec<On<'_>>> = poses
        .iter()
        .map(|pose| pose.map_or_else(Vec::new, |pose| lanes_at(map, pose)))
        .collect();
    let mut known: BTreeMap<(LaneId, LaneId), Option<Vec<LaneId>>> = BTreeMap::new();
    // The cheapest way on from each lane, from the last frame back.
    let n = poses.len();
    let mut best: Vec<Vec<(f64, usize)>> = vec![Vec::new(); n];
    for t in (0..n).rev() {
        let after = on.get(t + 1).map_or(&[][..], Vec::as_slice);
        let of_lane = |here: &On<'_>| {
            let ways = after
                .iter()
                .zip(best.get(t + 1).map_or(&[][..], Vec::as_slice));
            let ways = ways.enumerate().map(|(j, (there, (rest, _)))| {
                let ids = (here.lane.id, there.lane.id);
                let way = known.entry(ids);
                let way = way.or_insert_with(|| between(map, ids.0, ids.1));
                let change = if way.is_some() { 0.0 } else { CHANGE_M };
                (change + rest, j)
            });
            let least = ways.min_by(|a, b| a.0.total_cmp(&b.0));
            let (rest, next) = least.unwrap_or((0.0, usize::MAX));
            (here.cost + rest, next)
        };
        let of_lane: Vec<(f64, usize)> = on[t].iter().map(of_lane).collect();
        best[t] = of_lane;
    }
    let mut lanes: Vec<Option<LaneId>> = vec![None; n];
    let mut next = usize::MAX;
    for t in 0..n {
        let here = best[t].iter().enumerate();
        let cheapest = here.min_by(|a, b| a.1.0.total_cmp(&b.1.0)).map(|(i, _)| i);
        let here = if next < best[t].len() {
            Some(next)
        } else {
            cheapest
        };
        lanes[t] = here.map(|i| on[t][i].lane.id);
        next = here.map_or(usize::MAX, |i| best[t][i].1);
    }
    let route = |t: usize| {
        let pose = poses[t]?;
        lanes[t]?;
        let leads = |u: usize| match (lanes[u], lanes.get(u + 1).copied().flatten()) {
            (Some(a), Some(b)) => known.get(&(a, b)).cloned().flatten(),
            _ => None,
        };
        // The last frame from `from` on before a change of lane, or the end.
        let last = |from: usize| (from..n).find(|&u| leads(u).is_none()).unwrap_or(n - 1);
        let mut from = t;
        let end = last(t);
        let changes = lanes.get(end + 1).is_some_and(Option::is_some);
        let mut way = Vec::new();
        if changes && end + 1 - t <= FORESEEN {
            from = end + 1;
            way = from_beside(map, lanes[from]?, pose);
        } else {
            way.push(lanes[t]?);
        }
        for u in from..last(from) {
            let next = lanes[u + 1]?;
            if lanes[u] != Some(next) {
                way.extend(leads(u)?);
                way.push(next);
            }
        }
        let before = t.checked_sub(1).and_then(|before| poses[before]);
        let driven = before.map_or(0.0, |before| before.position.distance(pose.position));
        let speed = driven / TOKEN_DT;
        Some(Route::extended(
            map,
            way,
            Traveller {
                pose,
                speed,
                seed,
                remains: false,
            },
        ))
    };
    (0..n).map(route).collect()
}

#[cfg(test)]
mod tests {
    use gump_scene::Scenario;

    use super::*;

    /// Two lanes beside each other that go on, and a turn to the right from the right one.
    fn scenario() -> Scenario {
        gump_scene::fixture::scenario(
            "lane 1: 0,0 100,0 speed 15 next 3,4
             lane 2: 0,3.5 100,3.5 speed 15 next 5
             lane 3: 100,0 200,0
             lane 4: 100,0 108,-2 110,-10 110,-100
             lane 5: 100,3.5 200,3.5
             ego vehicle 0: 10,0 velocity 8,0",
        )
        .unwrap()
    }

    fn slow(pose: Pose, seed: u64) -> Traveller {
        Traveller {
            pose,
            speed: 3.0,
            seed: Seed(seed),
            remains: false,
        }
    }

    fn ids(route: &Option<Route>) -> Vec<u64> {
        let lanes = route.as_ref().map_or(&[][..], |route| route.lanes());
        lanes.iter().map(|lane| lane.0 as u64).collect()
    }

    #[test]
    fn the_log_says_who_turns_before_the_lanes_part() {
        let map = &scenario().map;
        let straight: Vec<_> = (0..18)
            .map(|t| Some(Pose::new(60.0 + 4.0 * f64::from(t), 0.1, 0.0)))
            .collect();
        let routes = of_log(map, &straight, Seed(1));
        assert_eq!(ids(&routes[0]), [1, 3]);
        assert_eq!(ids(&routes[17]), [3]);
        let mut turning = straight[..10].to_vec();
        turning.extend(
            [
                (104.0, -0.7, -0.3),
                (109.0, -5.0, -1.4),
                (110.0, -12.0, -1.57),
            ]
            .map(|(x, y, h)| Some(Pose::new(x, y, h))),
        );
        let routes = of_log(map, &turning, Seed(1));
        assert_eq!(ids(&routes[0]), [1, 4]);
        // Where it has not got, the seed decides: both occur.
        let drawn = |seed| ids(&of_log(map, &straight[..5], Seed(seed))[0]);
        let turns = (0..200).filter(|seed| drawn(*seed) == [1, 4]).count();
        assert!((15..60).contains(&turns), "{turns}");
        // Beside the road there is none.
        assert_eq!(
            of_log(map, &[Some(Pose::new(50.0, -6.0, 0.0)), None], Seed(1)),
            [None, None]
        );
    }

    #[test]
    fn who_remains_on_the_map_takes_the_way_that_goes_on() {
        // The turn leads into a ring, straight on the map ends.
        let scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 100,0 speed 15 next 3,4
             lane 3: 100,0 200,0
             lane 4: 100,0 108,-2 110,-10 110,-40 next 5
             lane 5: 110,-40 60,-90 next 6
             lane 6: 60,-90 110,-40 next 5
             ego vehicle 0: 10,0 velocity 8,0",
        )
        .unwrap();
        let map = &scenario.map;
        let ways = |speed: f64, remains: bool| {
            let way = |seed: u64| {
                let who = Traveller {
                    speed,
                    remains,
                    ..slow(Pose::new(90.0, 0.0, 0.0), seed)
                };
                Route::from_here(map, who).unwrap().after(LaneId(1))
            };
            let turns = |seed: &u64| way(*seed) == Some(LaneId(4));
            (0..100).filter(turns).count()
        };
        assert_eq!(ways(3.0, true), 100);
        assert!((5..40).contains(&ways(3.0, false)));
        assert!(ways(15.0, true) < 5, "too fast for the turn");
        let metres = |id: i64| lasts_m(map, map.lane(LaneId(id)).unwrap());
        assert_eq!(metres(3), 100.0);
        assert_eq!(metres(4), REMAINS_M);
    }

    #[test]
    fn a_change_of_lane_is_meant_five_seconds_before() {
        let map = &scenario().map;
        let side = |t: i32| (0.7 * f64::from((t - 12).clamp(0, 5))).min(3.5);
        let poses: Vec<_> = (0..20)
            .map(|t| Some(Pose::new(2.0 + 4.0 * f64::from(t), side(t), 0.05)))
            .collect();
        let routes = of_log(map, &poses, Seed(1));
        let changed = routes.iter().position(|route| ids(route)[0] == 2).unwrap();
        assert!((3..=7).contains(&changed), "{changed}");
        assert!(routes[changed..].iter().all(|route| ids(route) == [2, 5]));
        assert!(routes[..changed].iter().all(|route| ids(route)[0] == 1));
    }

    #[test]
    fn routes_are_kept_until_they_are_lost() {
        let map = &scenario().map;
        let here = Pose::new(40.0, 0.3, 0.0);
        let route = Route::from_here(map, slow(here, 3)).unwrap();
        assert_eq!(route.lanes()[0], LaneId(1));
        let later = Pose::new(99.0, 0.3, 0.0);
        // Another seed does not change what is decided.
        let kept = route.from_there(map, slow(later, 4), false).unwrap();
        assert_eq!(kept.lanes()[..2], route.lanes()[..2]);
        assert!(
            route
                .from_there(map, slow(Pose::new(60.0, 9.0, 0.0), 4), true)
                .is_none()
        );
        assert!(
            route
                .from_there(map, slow(Pose::new(60.0, 0.0, 3.1), 4), true)
                .is_none()
        );
        let beside = Route::into_lane(map, LaneId(2), slow(here, 3));
        assert!(beside.from_there(map, slow(here, 3), true).is_some());
        assert!(beside.from_there(map, slow(here, 3), false).is_none());
        assert_eq!(beside.lanes(), [LaneId(2), LaneId(5)]);
        assert!((beside.offset_m(map, here) - 3.2).abs() < 1e-9);
        let vector_map = VectorMap::new(map, here.position, 300.0, Default::default());
        let path = beside.path(&vector_map, here);
        let ends: Vec<f64> = path.iter().map(|(_, away)| *away).collect();
        assert!(
            ends[0].abs() <= 4.5 && *ends.last().unwrap() > PATH_M,
            "{ends:?}"
        );
        assert!(ends.windows(2).all(|pair| pair[0] < pair[1]));
    }

    #[test]
    fn who_comes_too_fast_misses_the_turn() {
        let map = &scenario().map;
        let here = Pose::new(40.0, 0.0, 0.0);
        let routes = (0..60).filter_map(|seed| Route::from_here(map, slow(here, seed)));
        let routes: Vec<Route> = routes.collect();
        let misses = |turns: bool, x: f64, speed: f64| {
            let turn = |route: &&Route| route.lanes().contains(&LaneId(4)) == turns;
            let route = routes.iter().find(turn).unwrap();
            let who = slow(Pose::new(x, 0.0, 0.0), 1);
            route.is_missed(map, Traveller { speed, ..who })
        };
        assert!(misses(true, 92.0, 14.0) && !misses(false, 92.0, 14.0));
        assert!(!misses(true, 92.0, 6.0) && !misses(true, 50.0, 14.0));
    }

    #[test]
    fn nobody_means_to_turn_who_is_too_fast_for_it() {
        let map = &scenario().map;
        let turns = |x: f64, speed: f64| {
            let drawn = (0..200).map(|seed| {
                let who = slow(Pose::new(x, 0.0, 0.0), seed);
                Route::from_here(map, Traveller { speed, ..who }).unwrap()
            });
            drawn
                .filter(|route| route.lanes().contains(&LaneId(4)))
                .count()
        };
        assert!(
            (15..60).contains(&turns(60.0, 14.0)),
            "{}",
            turns(60.0, 14.0)
        );
        assert!(turns(92.0, 14.0) < 8, "{}", turns(92.0, 14.0));
    }
}
