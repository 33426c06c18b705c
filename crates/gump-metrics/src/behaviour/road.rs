//! Leaving the road.

use gump_scene::LaneKind;

use super::track::Track;
use super::{Class, Counter, MOVES, Measure, vehicles};
use crate::metres_off_road;

/// Interval at which the place of a vehicle is looked at, seconds: at 15 m/s it gets 7 m away.
/// Chosen by hand.
const LOOK_S: f64 = 0.5;
/// A vehicle has left the road when its centre is this far beyond the road's edge, metres: more than
/// half of it is beside the road. Less is a kerb or a map that is inaccurate. Chosen by hand.
const BEYOND_M: f64 = 0.5;
/// A vehicle this near to the centre of a lane that is not for bicycles is on the road, metres, wherever its edge is drawn: at the
/// ends of some networks of SUMO the edge leaves out the lanes that turn back. Chosen by hand.
const ON_LANE_M: f64 = 1.0;

impl Counter<'_> {
    /// Nothing is counted on maps without a border.
    pub(super) fn road_exits(&mut self) {
        for track in vehicles(self.tracks) {
            let (exits, n_moving) = self.exits_of(track);
            let per = n_moving as f64 * self.take.steps(LOOK_S) as f64;
            let minutes = per * self.take.dt / 60.0;
            self.add(
                Measure::RoadExit,
                Class::Vehicle,
                exits.len() as f64,
                minutes,
            );
            for k in exits {
                self.note(Measure::RoadExit, track.id, None, k);
            }
        }
    }

    /// Frames at which a vehicle is first seen off the road that it was on, and the number of looks
    /// at which it moves.
    fn exits_of(&self, track: &Track) -> (Vec<usize>, usize) {
        let (mut exits, mut n_moving) = (Vec::new(), 0);
        let mut was_on = false;
        for k in (self.take.now..self.take.frames.len()).step_by(self.take.steps(LOOK_S)) {
            let agent = self.take.frames[k].agent(track.id);
            let Some((agent, pose)) = agent.zip(track.pose(k)) else {
                continue;
            };
            let moves = track.pace(k).is_some_and(|pace| pace > MOVES);
            // Who stands has not left the road since the last look.
            if !moves && k > self.take.now {
                continue;
            }
            let z = agent.elevation - agent.height / 2.0;
            let Some(beyond) = metres_off_road(self.map, pose.position, z) else {
                return (exits, n_moving);
            };
            let mut lanes = self.map.lanes_near(pose.position, ON_LANE_M);
            let is_on_lane = lanes.any(|(lane, _)| lane.kind != LaneKind::BikeLane);
            let beyond = if is_on_lane { 0.0 } else { beyond };
            if k > self.take.now {
                n_moving += 1;
                if was_on && beyond > BEYOND_M {
                    exits.push(k);
                }
            }
            // Between the edge and `BEYOND_M` it stays what it was.
            was_on = beyond == 0.0 || was_on && beyond <= BEYOND_M;
        }
        (exits, n_moving)
    }
}
