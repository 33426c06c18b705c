//! Where vehicles mean to go in a rollout: drawn once, and kept.

use gump_model::relative::driveway::Driveways;
use gump_model::relative::graph::Shown;
use gump_model::relative::route::{LONG_ENOUGH, Route, Traveller, lasts_m};
use gump_model::steps::TOKEN_DT;
use gump_scene::{Agent, AgentKind, Lane, LaneId, MapGraph, Seed};

use crate::nucleus::uniform;
use crate::relative::turning_in::{TakesWay, decide};

// All were chosen by hand, but for the share of changes.

/// Share of the vehicles that decide to change lane while they are on a lane with another one beside it,
/// and the length that longer lanes count as, metres. In recordings and in SUMO's traffic the share that
/// changes hardly depends on the length of the lane: it is about half of this, and half of those who decide
/// get over (result 55).
const CHANGES: f64 = 0.34;
const LONG_LANE_M: f64 = 200.0;
/// Slower vehicles decide on none, metres per second, ...
const FAST_MPS: f64 = 3.0;
/// ... nor those with less of the lane ahead, metres: who is about to turn has chosen the lane.
const ROOM_M: f64 = 15.0;
/// The other lane is this far from a vehicle's centre, metres.
const BESIDE_M: (f64, f64) = (2.0, 5.0);
/// A change ends this near to the lane, metres, a radian counting as three, ...
const THERE_M: f64 = 0.6;
/// ... and is given up after so long, seconds: more than the five of training.
const GIVES_UP_S: f64 = 8.0;
/// Separates decisions to change lane from those where lanes part.
const CHANGE: u64 = 1 << 32;
/// ... and those to turn into a driveway.
const DRIVEWAYS: u64 = 1 << 33;

/// Where a vehicle means to go.
#[derive(Clone, Debug, Default)]
pub(super) struct Intent {
    route: Option<Route>,
    /// Time since it decided to change lane, seconds, until it is there.
    changing_s: Option<f64>,
    /// The way into a driveway that it takes.
    turns_in: Option<LaneId>,
}

impl Intent {
    /// The route that the network is told.
    pub(super) fn route(&self) -> Option<&Route> {
        self.route.as_ref()
    }

    /// The way into a driveway that it takes.
    pub(super) fn turns_in(&self) -> Option<LaneId> {
        self.turns_in
    }

    /// Decides to take a way into a driveway, keeps to it, or gives it up, half a second later; `seed` is
    /// the agent's own. Returns whether its route has changed.
    pub(super) fn turn_in<'a>(
        &mut self,
        driveways: &Driveways,
        now: &Shown,
        seed: Seed,
        others: &(impl Iterator<Item = &'a Agent> + Clone),
    ) -> bool {
        if let Some(way) = self.turns_in {
            let keeps = TakesWay::of(driveways, way).is_some_and(|way| !way.is_lost(now));
            if !keeps {
                *self = Self::default();
            }
            return !keeps;
        }
        self.turns_in = decide(driveways, now, seed.fork(DRIVEWAYS), others);
        if let Some(lane) = self.turns_in {
            self.route = Some(Route::into_driveway(lane));
            self.changing_s = None;
        }
        self.turns_in.is_some()
    }

    /// Half a second later. `seed` is the agent's own, `frame` the index of the frame; one that `remains`
    /// keeps to the map.
    pub(super) fn go_on(
        &mut self,
        map: &MapGraph,
        now: &Shown,
        (seed, remains): (Seed, bool),
        frame: usize,
    ) {
        if now.body.kind != AgentKind::Vehicle || self.turns_in.is_some() {
            return;
        }
        let who = Traveller {
            pose: now.pose,
            speed: now.velocity().length(),
            seed,
            remains,
        };
        let stands = who.speed == 0.0;
        if stands && self.route.is_some() {
            return;
        }
        let changes = self.changing_s.is_some();
        self.route = self
            .route
            .as_ref()
            .and_then(|route| route.from_there(map, who, changes))
            .filter(|route| !route.is_missed(map, who));
        if let (Some(route), Some(since)) = (&self.route, self.changing_s) {
            self.changing_s = match route.offset_m(map, now.pose) {
                offset if offset < THERE_M => None,
                _ if since > GIVES_UP_S => {
                    self.route = None;
                    None
                }
                _ => Some(since + TOKEN_DT),
            };
        }
        if self.route.is_none() {
            self.changing_s = None;
            self.route = Route::from_here(map, who);
        }
        if self.changing_s.is_none() {
            self.decide_on_a_change(map, who, frame);
        }
    }

    fn decide_on_a_change(&mut self, map: &MapGraph, who: Traveller, frame: usize) {
        if who.speed < FAST_MPS {
            return;
        }
        let here = self.route.as_ref().and_then(|route| route.lanes().first());
        let Some(here) = here.and_then(|id| map.lane(*id)) else {
            return;
        };
        let stream = who.seed.fork(CHANGE).fork(frame as u64);
        let wishes = uniform(stream) < share_of_changes(here, who.speed);
        if !(wishes || who.remains) {
            return;
        }
        let at = here.centerline.project(who.pose.position).arc_length;
        if here.in_intersection || here.centerline.length() - at < ROOM_M {
            return;
        }
        let is_beside = |lane: &&Lane| {
            let distance = lane.centerline.project(who.pose.position).distance;
            !lane.in_intersection && (BESIDE_M.0..BESIDE_M.1).contains(&distance)
        };
        let sides = [&here.left_neighbors, &here.right_neighbors];
        let beside = sides.map(|side| {
            let mut lanes = side.iter().filter_map(|id| map.lane(*id));
            lanes.find(is_beside)
        });
        let mut beside: Vec<&Lane> = beside.into_iter().flatten().collect();
        if who.remains {
            beside.retain(|lane| leads_on(map, here, lane, wishes));
        }
        if beside.is_empty() {
            return;
        }
        let n = beside.len();
        let which = (uniform(stream.fork(1)) * n as f64) as usize;
        let lane = beside[which.min(n - 1)].id;
        self.route = Some(Route::into_lane(map, lane, who));
        self.changing_s = Some(0.0);
    }
}

/// Share of the vehicles on a lane, with another one beside it, that decide to change within half a second.
fn share_of_changes(lane: &Lane, speed: f64) -> f64 {
    let length = lane.centerline.length().min(LONG_LANE_M);
    CHANGES * speed * TOKEN_DT / length.max(1.0)
}

/// Whether one that remains on the map may change from `here` to a lane beside it: to one that goes on where
/// this one ends, and, if it `wishes` to change anyway, to one that does not end sooner.
fn leads_on(map: &MapGraph, here: &Lane, beside: &Lane, wishes: bool) -> bool {
    let (own, metres) = (lasts_m(map, here), lasts_m(map, beside));
    own < LONG_ENOUGH * metres || wishes && metres >= LONG_ENOUGH * own
}

#[cfg(test)]
mod tests {
    use gump_geometry::{DVec2, Pose};
    use gump_model::relative::graph::Body;
    use gump_scene::Scenario;

    use super::*;

    fn scenario() -> Scenario {
        gump_scene::fixture::scenario(
            "lane 1: 0,0 3000,0 speed 15 left 2
             lane 2: 0,3.5 3000,3.5 speed 15 right 1
             ego vehicle 0: 10,0 velocity 8,0",
        )
        .unwrap()
    }

    fn car(pose: Pose, speed: f64) -> Shown {
        let body = Body {
            kind: AgentKind::Vehicle,
            length: 4.5,
            width: 1.9,
            sized: true,
        };
        Shown::first(body, pose, DVec2::new(speed, 0.0))
    }

    #[test]
    fn a_change_of_lane_is_decided_on_now_and_then_and_kept_until_it_is_done() {
        let map = &scenario().map;
        let (mut decided, mut driven) = (0, 0);
        for agent in 0..60 {
            let seed = Seed(agent);
            let mut intent = Intent::default();
            for frame in 0..120 {
                driven += 1;
                let mut x = 10.0 + 4.0 * f64::from(frame);
                intent.go_on(
                    map,
                    &car(Pose::new(x, 0.0, 0.0), 8.0),
                    (seed, false),
                    frame as usize,
                );
                if intent.changing_s.is_none() {
                    assert_eq!(intent.route().unwrap().lanes(), [LaneId(1)]);
                    continue;
                }
                decided += 1;
                assert_eq!(intent.route().unwrap().lanes(), [LaneId(2)]);
                // On the way over it stays decided, and there it is not any more.
                x += 4.0;
                intent.go_on(map, &car(Pose::new(x, 1.5, 0.1), 8.0), (seed, false), 200);
                assert!(intent.changing_s.is_some());
                // At a frame at which it does not decide to go back at once.
                let rate = CHANGES * 8.0 * TOKEN_DT / LONG_LANE_M;
                let decides = |frame: usize| uniform(seed.fork(CHANGE).fork(frame as u64)) < rate;
                let frame = (201..).find(|frame| !decides(*frame)).unwrap();
                intent.go_on(
                    map,
                    &car(Pose::new(x + 4.0, 3.4, 0.0), 8.0),
                    (seed, false),
                    frame,
                );
                assert!(intent.changing_s.is_none());
                assert_eq!(intent.route().unwrap().lanes(), [LaneId(2)]);
                break;
            }
        }
        // At 4 m a step.
        let share = f64::from(decided) / (f64::from(driven) * 4.0 / LONG_LANE_M);
        assert!((0.6..1.5).contains(&(share / CHANGES)), "{share}");
    }

    #[test]
    fn who_does_not_get_over_gives_up_and_who_stands_does_not_decide() {
        let map = &scenario().map;
        let here = Pose::new(50.0, 0.0, 0.0);
        let who = Traveller {
            pose: here,
            speed: 8.0,
            seed: Seed(1),
            remains: false,
        };
        let mut intent = Intent {
            route: Some(Route::into_lane(map, LaneId(2), who)),
            changing_s: Some(0.0),
            turns_in: None,
        };
        for frame in 0..18 {
            let x = 50.0 + 4.0 * f64::from(frame);
            intent.go_on(map, &car(Pose::new(x, 0.0, 0.0), 8.0), (Seed(1), false), 0);
        }
        assert!(intent.changing_s.is_none());
        assert_eq!(intent.route().unwrap().lanes(), [LaneId(1)]);
        for frame in 0..5000 {
            intent.go_on(map, &car(here, 0.0), (Seed(1), false), frame);
        }
        assert_eq!(intent.route().unwrap().lanes(), [LaneId(1)]);
    }

    #[test]
    fn who_remains_on_the_map_changes_to_the_lane_that_goes_on() {
        // The right lane ends, the left one leads on.
        let scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 100,0 speed 15 left 2
             lane 2: 0,3.5 100,3.5 speed 15 right 1 next 3
             lane 3: 100,3.5 900,3.5 speed 15
             ego vehicle 0: 10,0 velocity 8,0",
        )
        .unwrap();
        let changes = |y: f64, remains: bool| {
            let changes = |seed: &u64| {
                let mut intent = Intent::default();
                let who = (Seed(*seed), remains);
                intent.go_on(&scenario.map, &car(Pose::new(20.0, y, 0.0), 8.0), who, 30);
                intent.changing_s.is_some()
            };
            (0..200).filter(changes).count()
        };
        assert_eq!(changes(0.0, true), 200);
        assert_eq!(changes(3.5, true), 0);
        assert!((1..20).contains(&changes(0.0, false)) && (1..20).contains(&changes(3.5, false)));
    }
}
