//! A planned drive of the ego that matches a prompt: along lanes or to an adjacent one, with a
//! speed profile, regardless of other agents.

use gump_geometry::{DVec2, Polyline, Pose, dvec2};
use gump_rollout::{BoxError, Command, Policy};
use gump_scene::{AgentState, Lane, LaneId, Light, LightState, MapGraph, Rng, SceneState};
use rand::Rng as _;

/// Horizon of a planned drive, seconds: tags look up to 4 s ahead, from a moment at most 1 s after
/// the start (`prompt_search::MOMENTS`).
pub(crate) const PLANNED_S: f64 = 5.0;
/// Duration of an acceleration, seconds: longer than tags need to see it (0.6 s). Chosen by hand.
const PULL_S: f64 = 2.0;
/// A jolt: start and end of the braking, seconds, and deceleration, metres per second squared. About
/// 10 m/s³ at the moment after 1 s, where the tag asks for 5.
const JOLT: ([f64; 2], f64) = ([1.0, 1.5], 6.0);
/// Distance of the axles from the centre, metres, half of a car's wheelbase; both are on the path.
const AXLE_M: f64 = 1.4;
/// Maximum length of a drive beyond the end of the road, metres: for rounding, where lanes are
/// joined.
const ENDS_M: f64 = 1.0;
/// A vehicle that moves less than this during the drive stands, metres: too little to run a light.
const STANDS_M: f64 = 1.0;
/// Maximum distance along the road between the starts of adjacent lanes, metres. Chosen by hand;
/// beyond it the other lane's path may end too early, and no drive is planned.
const BEGINS_M: f64 = 20.0;
/// Maximum number of lanes of a drive, against maps of endless short ones.
const MOST_LANES: usize = 24;
/// Lateral distance of adjacent lanes, metres: from narrow to very wide ones.
const BESIDE_M: [f64; 2] = [2.2, 5.5];

/// The manoeuvre, besides following lanes at a constant speed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Maneuver {
    /// Metres per second squared; acceleration ends after a while, braking when the ego stands.
    pub(crate) acceleration: f64,
    /// Brakes hard for a moment.
    pub(crate) jolts: bool,
    /// Changes lanes.
    pub(crate) change: Option<Change>,
}

/// A change of lanes that begins at once.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Change {
    /// True to the left, false to the right.
    pub(crate) is_left: bool,
    /// From one centre line to the other.
    pub(crate) seconds: f64,
}

impl Maneuver {
    /// Duration of steering the ego, seconds: that of the manoeuvre, or enough to show the ego's
    /// intention to the world.
    pub(crate) fn seconds(&self) -> f64 {
        if self.jolts || self.acceleration > 0.0 {
            PULL_S
        } else {
            // A change of lanes takes up to 3.4 s.
            4.0
        }
    }
}

/// A path to drive, with a start and a speed.
#[derive(Clone, Debug)]
pub(crate) struct PlannedDrive {
    path: Polyline,
    /// Metres along the path at which it begins.
    from: f64,
    /// At the beginning, metres per second.
    pub(crate) speed: f64,
    maneuver: Maneuver,
    /// The lanes it enters, with the metres along the path at which they begin.
    entered: Vec<(LaneId, f64)>,
    /// The neighbouring lane it changes to.
    pub(crate) neighbor: Option<LaneId>,
}

impl PlannedDrive {
    /// From `at` metres along a lane, `offset` metres left of its centre line, along a random path
    /// through junctions; `None` if the road ends before, or there is no lane to change to.
    pub(crate) fn along(
        map: &MapGraph,
        (lane, at): (&Lane, f64),
        offset: f64,
        speed: f64,
        maneuver: Maneuver,
        rng: &mut Rng,
    ) -> Option<Self> {
        let mut drive = Self {
            path: lane.centerline.clone(),
            from: at,
            speed,
            maneuver,
            entered: Vec::new(),
            neighbor: None,
        };
        let needed = at + drive.metres_after(PLANNED_S) + AXLE_M;
        let (mut points, entered) = way(map, lane, needed, rng);
        if let Some(change) = maneuver.change {
            let there = neighbor(map, lane, change.is_left)?;
            let own = Polyline::new(points)?;
            // The neighbour may begin before or after the lane itself.
            let (other, _) = way(map, there, needed + BEGINS_M, rng);
            points = changed(&own, &Polyline::new(other)?, at, speed * change.seconds)?;
            drive.neighbor = Some(there.id);
        }
        // The lights of the start lane represent those of the neighbour.
        drive.entered = entered;
        let path = Polyline::new(points).filter(|path| path.length() >= needed - ENDS_M)?;
        // Nearer than 5 cm the centre line does as well, without the offset's kinks.
        drive.path = if offset.abs() > 0.05 {
            let there = path.pose_at(at) * dvec2(0.0, offset);
            let beside = path.offset(offset);
            // In a bend that path is longer or shorter.
            drive.from = beside.project(there).arc_length;
            for (_, begins) in &mut drive.entered {
                *begins += drive.from - at;
            }
            beside
        } else {
            path
        };
        Some(drive)
    }

    /// The same way at another speed at the beginning, metres per second; `None` if it is too short
    /// for that.
    pub(crate) fn at_speed(&self, speed: f64) -> Option<Self> {
        let drive = Self {
            speed,
            ..self.clone()
        };
        let needed = drive.from + drive.metres_after(PLANNED_S) + AXLE_M;
        (drive.path.length() >= needed - ENDS_M).then_some(drive)
    }

    /// The state after so many seconds, box centre, world frame.
    pub(crate) fn state_after(&self, seconds: f64) -> AgentState {
        let pose = self.pose_ahead(self.metres_after(seconds));
        AgentState {
            pose,
            velocity: pose.direction() * self.speed_after(seconds),
        }
    }

    /// The pose so many metres further along the path.
    pub(crate) fn pose_ahead(&self, metres: f64) -> Pose {
        let at = |metres: f64| self.path.pose_at(self.from + metres).position;
        Pose {
            position: at(metres),
            heading: (at(metres + AXLE_M) - at(metres - AXLE_M)).to_angle(),
        }
    }

    /// Duration of steering the ego, seconds.
    pub(crate) fn seconds(&self) -> f64 {
        self.maneuver.seconds()
    }

    /// True if the ego's manoeuvre starts after the first moment.
    pub(crate) fn takes_time(&self) -> bool {
        self.maneuver.jolts || self.maneuver.change.is_some()
    }

    /// True if a vehicle of this length passes a red light on the path.
    pub(crate) fn runs_red(&self, lights: &[Light], length: f64) -> bool {
        let metres = self.metres_after(PLANNED_S);
        let end = self.from + length / 2.0 + metres;
        metres > STANDS_M
            && self.entered.iter().any(|(lane, start)| {
                let is_red = |light: &Light| light.lane == *lane && light.state == LightState::Red;
                (self.from..end).contains(start) && lights.iter().any(is_red)
            })
    }

    fn speed_after(&self, seconds: f64) -> f64 {
        let pull = self.maneuver.acceleration;
        let pulled = if pull > 0.0 {
            seconds.min(PULL_S)
        } else {
            seconds
        };
        let ([begins, ends], brake) = JOLT;
        let braked = if self.maneuver.jolts {
            brake * (seconds.clamp(begins, ends) - begins)
        } else {
            0.0
        };
        (self.speed + pull * pulled - braked).max(0.0)
    }

    fn metres_after(&self, seconds: f64) -> f64 {
        // Speeds are straight between tenths of a second, but for the one in which the ego stops.
        let n = (seconds * 10.0).round() as usize;
        let speed = |i: usize| self.speed_after(i as f64 / 10.0);
        (0..n).map(|i| (speed(i) + speed(i + 1)) / 20.0).sum()
    }
}

/// The policy of an ego with this drive.
pub(crate) struct Steered<'a> {
    drive: &'a PlannedDrive,
    seconds: f64,
}

impl<'a> Steered<'a> {
    pub(crate) fn new(drive: &'a PlannedDrive) -> Self {
        Self {
            drive,
            seconds: 0.0,
        }
    }
}

impl Policy for Steered<'_> {
    fn name(&self) -> &str {
        "steered"
    }

    fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError> {
        let dt = scenes.first().map_or(0.0, |scene| scene.dt);
        self.seconds += dt;
        let states = vec![self.drive.state_after(self.seconds)];
        Ok(vec![Command::Follow { dt, states }; scenes.len()])
    }
}

/// The nearest lane on a side, unless either is inside an intersection.
fn neighbor<'a>(map: &'a MapGraph, lane: &Lane, is_left: bool) -> Option<&'a Lane> {
    let beside = if is_left {
        &lane.left_neighbors
    } else {
        &lane.right_neighbors
    };
    let there = map.lane(*beside.first()?)?;
    (!lane.in_intersection && !there.in_intersection).then_some(there)
}

/// The points of a lane and its successors, along a random path through junctions, for this many
/// metres or up to the end of the road; and the start of each successor.
fn way(
    map: &MapGraph,
    lane: &Lane,
    metres: f64,
    rng: &mut Rng,
) -> (Vec<DVec2>, Vec<(LaneId, f64)>) {
    let (mut points, mut entered, mut last) = (Vec::new(), Vec::new(), lane);
    extend(&mut points, &lane.centerline);
    loop {
        let pairs = points.windows(2);
        let length: f64 = pairs.map(|pair| pair[0].distance(pair[1])).sum();
        let next: Vec<&Lane> = map.successors(last.id).collect();
        if length >= metres || next.is_empty() || entered.len() >= MOST_LANES {
            return (points, entered);
        }
        last = next[rng.random_range(0..next.len())];
        entered.push((last.id, length));
        extend(&mut points, &last.centerline);
    }
}

/// The points of one line up to `at` metres along it, and then a transition to an adjacent line
/// within this many metres; `None` if the lines are not adjacent there.
fn changed(own: &Polyline, other: &Polyline, at: f64, metres: f64) -> Option<Vec<DVec2>> {
    let end = at + metres;
    if metres < 1.0 || end > own.length() {
        return None;
    }
    let point = |i: usize| {
        let own = own.pose_at(i as f64).position;
        let share = ((i as f64 - at) / metres).clamp(0.0, 1.0);
        if share == 0.0 {
            return Some(own);
        }
        let along = other.project(own).arc_length;
        let there = other.pose_at(along).position;
        if !(BESIDE_M[0]..BESIDE_M[1]).contains(&own.distance(there)) {
            return None;
        }
        // The smoothest step: neither speed nor acceleration to the side at either end.
        let share = share.powi(3) * (10.0 - 15.0 * share + 6.0 * share * share);
        Some(own.lerp(there, share))
    };
    let mut points = (0..=end.floor() as usize)
        .map(point)
        .collect::<Option<Vec<DVec2>>>()?;
    let along = other.project(*points.last()?).arc_length + 1.0;
    extend(&mut points, &other.slice(along, other.length()));
    Some(points)
}

/// Adds a line's points, a metre apart.
fn extend(points: &mut Vec<DVec2>, line: &Polyline) {
    for point in line.resample(1.0).points() {
        if points.last().is_none_or(|last| last.distance(*point) > 0.2) {
            points.push(*point);
        }
    }
}

#[cfg(test)]
mod tests {
    use gump_scene::{Seed, fixture};

    use super::*;

    fn drive(at: f64, speed: f64, maneuver: Maneuver) -> Option<PlannedDrive> {
        let scenario = fixture::scenario(
            "lane 1: 0,0 60,0 next 3 left 2\nlane 2: 0,3.5 60,3.5 right 1\nlane 3: 60,0 60,40\n\
             light 3 red: 59,0\nego vehicle 0: 0,0",
        )
        .unwrap();
        let map = &scenario.map;
        let lane = &map.lanes()[0];
        let rng = &mut Seed(1).rng();
        PlannedDrive::along(map, (lane, at), 0.0, speed, maneuver, rng)
    }

    #[test]
    fn it_goes_on_through_the_next_lane() {
        let drive = drive(50.0, 6.0, Maneuver::default()).unwrap();
        let then = drive.state_after(4.0);
        assert!(
            (then.pose.position.x - 60.0).abs() < 0.1,
            "{:?}",
            then.pose.position
        );
        assert!((then.pose.position.y - 14.0).abs() < 0.1);
        assert!((then.pose.heading - std::f64::consts::FRAC_PI_2).abs() < 0.01);
        let red = [Light {
            lane: LaneId(3),
            state: LightState::Red,
            stop_point: None,
        }];
        assert!(drive.runs_red(&red, 4.8) && !drive.runs_red(&[], 4.8));
    }

    #[test]
    fn another_speed_needs_as_long_a_way() {
        let drive = drive(50.0, 6.0, Maneuver::default()).unwrap();
        assert_eq!(drive.at_speed(8.0).unwrap().speed, 8.0);
        // 50 m are left.
        assert!(drive.at_speed(11.0).is_none());
        let red = [Light {
            lane: LaneId(3),
            state: LightState::Red,
            stop_point: None,
        }];
        let passes = |speed| drive.at_speed(speed).unwrap().runs_red(&red, 4.8);
        assert!(passes(6.0) && !passes(1.0));
    }

    #[test]
    fn beside_the_middle_of_a_bend_it_begins_where_it_is() {
        // A quarter of a circle of 20 m, at whose end it is, on either side.
        let arc: Vec<DVec2> = (0..=90)
            .map(|i| DVec2::from_angle(std::f64::consts::FRAC_PI_2 * f64::from(i) / 90.0) * 20.0)
            .chain([dvec2(-60.0, 20.0)])
            .collect();
        let points: Vec<String> = arc.iter().map(|p| format!("{},{}", p.x, p.y)).collect();
        let text = format!("lane 1: {}\nego vehicle 0: 20,0", points.join(" "));
        let scenario = fixture::scenario(&text).unwrap();
        let map = &scenario.map;
        let lane = &map.lanes()[0];
        for offset in [-1.5, 1.5] {
            let rng = &mut Seed(1).rng();
            let start = (lane, 30.0);
            let drive =
                PlannedDrive::along(map, start, offset, 5.0, Maneuver::default(), rng).unwrap();
            let expected = lane.centerline.pose_at(30.0) * dvec2(0.0, offset);
            let found = drive.state_after(0.0).pose.position;
            // The path is made of pieces of a metre.
            assert!(
                found.distance(expected) < 0.1,
                "{found} instead of {expected}"
            );
        }
    }

    #[test]
    fn speeds_are_those_of_the_maneuver() {
        let of = |acceleration, jolts| Maneuver {
            acceleration,
            jolts,
            change: None,
        };
        let stops = drive(10.0, 3.0, of(-1.5, false)).unwrap();
        assert_eq!(stops.state_after(2.0).velocity.length(), 0.0);
        assert!((stops.state_after(4.0).pose.position.x - 13.0).abs() < 0.02);
        let pulls = drive(10.0, 1.0, of(1.5, false)).unwrap();
        assert!((pulls.state_after(4.0).velocity.length() - 4.0).abs() < 1e-9);
        assert!((pulls.state_after(2.0).pose.position.x - 15.0).abs() < 0.02);
        let jolts = drive(10.0, 8.0, of(0.0, true)).unwrap();
        assert_eq!(jolts.state_after(1.0).velocity.length(), 8.0);
        assert!((jolts.state_after(1.5).velocity.length() - 5.0).abs() < 1e-9);
    }

    #[test]
    fn lanes_are_changed_where_there_is_one() {
        let to = |is_left| Maneuver {
            change: Some(Change {
                is_left,
                seconds: 3.0,
            }),
            ..Maneuver::default()
        };
        let left = drive(5.0, 8.0, to(true)).unwrap();
        assert_eq!(left.neighbor, Some(LaneId(2)));
        let y = |seconds| left.state_after(seconds).pose.position.y;
        assert!(y(0.0).abs() < 0.01 && (y(1.5) - 1.75).abs() < 0.1 && (y(3.2) - 3.5).abs() < 0.01);
        assert!(drive(5.0, 8.0, to(false)).is_none());
        // The lane ends before the change does.
        assert!(drive(45.0, 8.0, to(true)).is_none());
    }
}
