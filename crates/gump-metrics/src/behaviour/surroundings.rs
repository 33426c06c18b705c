//! Where the ego is, and how many agents are around it.

use gump_scene::LaneKind;

use super::{Class, Count, Counter, Key, MOMENTS, Measure};

/// Agents nearer to the ego than this are counted, metres. SUMO's files show agents within 120 m of
/// the ego, and a world's agents enter some metres farther in.
const NEAR_M: f64 = 100.0;
/// An ego within this distance of the centre of a lane is on the map, metres: a lane's width and a
/// half, so that who turns within a junction or stands at a kerb is.
const ON_MAP_M: f64 = 5.0;

impl Counter<'_> {
    /// Counts the agents near the ego, and whether it is on a lane. Without newcomers the number of
    /// agents says where those of the present have gone, not how dense traffic is.
    pub(super) fn surroundings(&mut self) {
        if !self.behaviour.newcomers {
            return;
        }
        let ego = self.behaviour.scenario.ego;
        let has_lanes = !self.map.lanes().is_empty();
        for seconds in MOMENTS {
            if seconds > self.behaviour.horizon_s {
                break;
            }
            let k = self.take.now + self.take.steps(seconds.into());
            let pose = |track: &super::Track| track.pose(k).map(|pose| pose.position);
            let Some(place) = self.tracks.iter().find(|t| t.id == ego).and_then(pose) else {
                continue;
            };
            let mut add = |measure, class, events| {
                let key = Key {
                    measure,
                    class,
                    seconds,
                };
                self.seen.tally.add(key, Count { events, of: 1.0 });
            };
            for class in [Class::Vehicle, Class::Pedestrian, Class::Bicycle] {
                let others = self.tracks.iter().filter(|track| track.id != ego);
                let near = others
                    .filter(|track| Class::of(track.kind) == class)
                    .filter_map(pose)
                    .filter(|other| other.distance(place) < NEAR_M);
                add(Measure::NearEgo, class, near.count() as f64);
            }
            if has_lanes {
                let mut near = self.map.lanes_near(place, ON_MAP_M);
                let is_on = near.any(|(lane, _)| lane.kind != LaneKind::BikeLane);
                add(
                    Measure::EgoOnLane,
                    Class::Vehicle,
                    f64::from(u8::from(is_on)),
                );
            }
        }
    }
}
