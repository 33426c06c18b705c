//! The checksum of a scene: of the contents of its file, independent of the encoding.
//!
//! Taken of the stored message, before a reader infers anything, and of numbers rounded so far
//! that the last bits of another machine's sine do not count.

use gump_proto::{FeatureData, MapPoint, Scenario};
use sha2::{Digest, Sha256};

/// Numbers count to this part of a metre, a radian, a metre per second.
const PARTS: f64 = 1000.0;

/// The checksum of a scene: sixteen hexadecimal digits that change with anything a driver could see.
pub fn checksum(message: &Scenario) -> String {
    let mut sum = Sum(Sha256::new());
    sum.0.update(message.scenario_id());
    sum.whole(message.current_time_index());
    sum.whole(message.sdc_track_index());
    sum.numbers(&message.timestamps_seconds);
    for target in &message.tracks_to_predict {
        sum.whole(target.track_index());
    }
    for track in &message.tracks {
        sum.whole(track.id());
        sum.whole(track.object_type.unwrap_or_default());
        for state in &track.states {
            sum.whole(i32::from(state.valid()));
            if state.valid() {
                sum.numbers(&[state.center_x(), state.center_y(), state.center_z()]);
                let size = [state.length(), state.width(), state.height()];
                let motion = [state.heading(), state.velocity_x(), state.velocity_y()];
                sum.numbers(&size.map(f64::from));
                sum.numbers(&motion.map(f64::from));
            }
        }
    }
    for step in &message.dynamic_map_states {
        sum.whole(step.lane_states.len() as i64);
        for signal in &step.lane_states {
            sum.whole(signal.lane());
            sum.whole(signal.state.unwrap_or_default());
            sum.points(signal.stop_point.as_slice());
        }
    }
    for feature in &message.map_features {
        sum.whole(feature.id());
        if let Some(data) = &feature.feature_data {
            sum.feature(data);
        }
    }
    let digest = sum.0.finalize();
    digest[..8].iter().map(|b| format!("{b:02x}")).collect()
}

struct Sum(Sha256);

impl Sum {
    fn whole(&mut self, n: impl Into<i64>) {
        self.0.update(n.into().to_le_bytes());
    }

    fn numbers(&mut self, numbers: &[f64]) {
        for x in numbers {
            // Saturates; not-a-number counts as zero.
            self.whole((x * PARTS).round() as i64);
        }
    }

    fn points(&mut self, points: &[MapPoint]) {
        self.whole(points.len() as i64);
        for point in points {
            self.numbers(&[point.x(), point.y(), point.z()]);
        }
    }

    fn feature(&mut self, data: &FeatureData) {
        match data {
            FeatureData::Lane(lane) => {
                self.whole(lane.r#type.unwrap_or_default());
                self.numbers(lane.speed_limit_mph.as_slice());
                self.points(&lane.polyline);
                for links in [&lane.entry_lanes, &lane.exit_lanes] {
                    self.whole(links.len() as i64);
                    links.iter().for_each(|&lane| self.whole(lane));
                }
            }
            FeatureData::RoadLine(line) => {
                self.whole(100 + line.r#type.unwrap_or_default());
                self.points(&line.polyline);
            }
            FeatureData::RoadEdge(edge) => {
                self.whole(200 + edge.r#type.unwrap_or_default());
                self.points(&edge.polyline);
            }
            FeatureData::StopSign(sign) => {
                self.whole(300);
                sign.lane.iter().for_each(|&lane| self.whole(lane));
                self.points(sign.position.as_slice());
            }
            FeatureData::Crosswalk(outline) => self.outline(400, &outline.polygon),
            FeatureData::SpeedBump(outline) => self.outline(500, &outline.polygon),
            FeatureData::Driveway(outline) => self.outline(600, &outline.polygon),
        }
    }

    fn outline(&mut self, kind: i64, polygon: &[MapPoint]) {
        self.whole(kind);
        self.points(polygon);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_data::womd::scenario_to_proto;

    fn message() -> Scenario {
        let text = "lane 1: 0,0 99,0\nego vehicle 0: 0,0\nagent vehicle 1: 9,0";
        let scenario = gump_scene::fixture::scenario(text).unwrap();
        scenario_to_proto(&scenario).unwrap().0
    }

    #[test]
    fn what_can_be_seen_counts_and_the_last_bits_do_not() {
        let (message, plain) = (message(), checksum(&message()));
        assert_eq!(plain.len(), 16);
        let changed = |change: &dyn Fn(&mut Scenario)| {
            let mut other = message.clone();
            change(&mut other);
            checksum(&other)
        };
        let moved = |by: f64| {
            changed(&|m| {
                let state = &mut m.tracks[1].states[0];
                state.center_x = Some(state.center_x() + by);
            })
        };
        assert_eq!(moved(1e-9), plain);
        assert_ne!(moved(0.01), plain);
        assert_ne!(
            changed(&|m| m.tracks[1].states[0].valid = Some(false)),
            plain
        );
        assert_ne!(changed(&|m| m.sdc_track_index = Some(1)), plain);
        assert_ne!(changed(&|m| m.map_features.clear()), plain);
        assert_ne!(changed(&|m| m.scenario_id = Some("x".into())), plain);
    }
}
