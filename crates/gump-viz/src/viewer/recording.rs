//! The same scene for Rerun (<https://rerun.io>), a viewer for one's own desk: an `.rrd` file.
//!
//! | entity | what |
//! |---|---|
//! | `map/...` | lanes, markings, edges, crosswalks; they stay |
//! | `log/agents`, `log/lights` | boxes and points, from the first recorded frame to the last |
//! | `futures/NAME/agents`, `futures/NAME/lights` | the same from the present on |
//!
//! Time is the timeline `sim_time`: seconds from the present, negative in the history. Places are
//! metres from where the ego is in the present, axes as in the world and z up, because Rerun keeps
//! 32-bit floats. Heights are nominal: scenes are flat.

use std::path::Path;

use gump_geometry::DVec2;
use gump_scene::{Agent, AgentKind, Frame, Light, LightState};
use re_sdk::log::ChunkBatcherConfig;
use re_sdk::time::Duration;
use re_sdk::{RecordingStream, RecordingStreamBuilder};
use re_sdk_types::archetypes::{
    AnnotationContext, Boxes3D, LineStrips3D, Points3D, ViewCoordinates,
};
use re_sdk_types::components::{Color, LineStrip3D};
use re_sdk_types::datatypes::{Quaternion, Rgba32};

use super::{ShownRollout, Viewer, class_of, meets, style, window};
use crate::files::write_whole;
use crate::theme::Rgb;
use crate::{Theme, VizError};

const TIMELINE: &str = "sim_time";

/// Class of the ego; those of agents follow, then those of lights.
const EGO: u16 = 1;
const KINDS: [AgentKind; 7] = {
    let ([a, b, c], [d, e, f, g]) = (AgentKind::MOVING, AgentKind::STATIC);
    [a, b, c, d, e, f, g]
};
const LIGHTS: [(LightState, &str); 4] = [
    (LightState::Green, "green"),
    (LightState::Yellow, "yellow"),
    (LightState::Red, "red"),
    (LightState::Unknown, "unknown light"),
];

/// Heights of lines and lights above the ground, metres: so that neither is hidden. Chosen by eye.
const LINE_Z: f32 = 0.02;
const LIGHT_Z: f32 = 0.5;

impl Viewer<'_> {
    /// Writes map, log, futures and lights as a recording that the Rerun viewer opens; the
    /// recording contains the time of writing, so two recordings of one scene differ in bytes.
    ///
    /// Available with the feature `rerun`.
    ///
    /// # Errors
    /// [`VizError::Rerun`] if the library refuses, [`VizError::Write`] with the path.
    pub fn save_rerun(&self, path: &Path) -> Result<(), VizError> {
        let bytes = self.to_rerun().map_err(VizError::Rerun)?;
        write_whole(path, &bytes)
    }

    fn to_rerun(&self) -> Result<Vec<u8>, Box<dyn std::error::Error + Send + Sync>> {
        // Neither the environment nor the clock decides what is in the file and in which pieces.
        let builder = RecordingStreamBuilder::new("gump").recording_id(self.scenario.id.as_str());
        let batches = ChunkBatcherConfig {
            flush_tick: std::time::Duration::MAX,
            ..ChunkBatcherConfig::DEFAULT
        };
        let (stream, storage) = builder.enabled(true).batcher_config(batches).memory()?;
        stream.send_recording_name(self.scenario.id.as_str())?;
        stream.log_static("/", &classes())?;
        stream.log_static("/", &ViewCoordinates::RIGHT_HAND_Z_UP())?;
        let takes = self.takes();
        self.log_map(&stream, &takes)?;
        for (i, take) in takes.iter().enumerate() {
            let root = match i {
                0 => take.name.to_owned(),
                _ => format!("futures/{}", take.name),
            };
            self.log_take(&stream, &root, take)?;
        }
        Ok(storage.drain_as_bytes()?)
    }

    /// A point of the world as Rerun gets it, `z` metres high.
    fn point(&self, point: DVec2, z: f32) -> [f32; 3] {
        let local = point - self.scenario.present().ego_now().state.pose.position;
        [local.x as f32, local.y as f32, z]
    }

    fn log_map(
        &self,
        stream: &RecordingStream,
        takes: &[ShownRollout<'_>],
    ) -> re_sdk::RecordingStreamResult<()> {
        let (map, colours) = (&self.scenario.map, Theme::Dark.colours());
        let window = window(takes);
        let lines = |path: &str, lines: Vec<&[DVec2]>, is_ring: bool, colour: Rgb, width: f32| {
            let near = lines.into_iter().filter(|points| meets(points, window));
            let strips = near.map(|points| {
                let ring = points.iter().take(usize::from(is_ring));
                let all = points.iter().chain(ring);
                LineStrip3D::from_iter(all.map(|point| self.point(*point, LINE_Z)))
            });
            let strips: Vec<LineStrip3D> = strips.collect();
            let strips = LineStrips3D::new(strips).with_colors([Color::from(Rgba32::from(colour))]);
            stream.log_static(format!("map/{path}"), &strips.with_radii([width / 2.0]))
        };
        let lanes = map.lanes().iter().map(|lane| lane.centerline.points());
        lines("lanes", lanes.collect(), false, colours.direction, 0.1)?;
        let edges = map.road_edges().iter().map(|edge| edge.line.points());
        lines("edges", edges.collect(), false, colours.edge, 0.2)?;
        for (name, colour) in [
            ("white", colours.white_line),
            ("yellow", colours.yellow_line),
        ] {
            let own = map.road_lines().iter();
            let own = own.filter(|line| style(line.kind).0 == (name == "yellow"));
            let own = own.map(|line| line.line.points()).collect();
            lines(&format!("lines/{name}"), own, false, colour, 0.15)?;
        }
        let areas = map.areas().iter();
        let areas = areas.filter(|area| class_of(area.kind).is_some());
        let areas = areas.map(|area| area.polygon.ring()).collect();
        lines("areas", areas, true, colours.crosswalk, 0.1)
    }

    fn log_take(
        &self,
        stream: &RecordingStream,
        root: &str,
        take: &ShownRollout<'_>,
    ) -> re_sdk::RecordingStreamResult<()> {
        let (agents, lights) = (format!("{root}/agents"), format!("{root}/lights"));
        let hidden = Boxes3D::update_fields().with_show_labels(false);
        stream.log_static(&*agents, &hidden)?;
        let hidden = Points3D::update_fields().with_show_labels(false);
        stream.log_static(&*lights, &hidden.with_radii([0.5]))?;
        let mut shown: &[Light] = &[];
        for (i, frame) in take.frames.iter().enumerate() {
            let time = take.first + i as f64 * take.dt;
            stream.set_time(TIMELINE, Duration::from_secs(time));
            stream.log(&*agents, &self.boxes(frame))?;
            // What does not change need not be said again.
            if frame.lights() != shown {
                shown = frame.lights();
                stream.log(&*lights, &self.lights(shown))?;
            }
        }
        stream.reset_time();
        Ok(())
    }

    fn boxes(&self, frame: &Frame) -> Boxes3D {
        let agents = || frame.agents().iter();
        let centre =
            |agent: &Agent| self.point(agent.state.pose.position, height(agent.kind) / 2.0);
        let half = |agent: &Agent| {
            let [length, width] = [agent.length, agent.width].map(|side| side as f32 / 2.0);
            [length, width, height(agent.kind) / 2.0]
        };
        let turn = |agent: &Agent| {
            let (sin, cos) = (agent.state.pose.heading / 2.0).sin_cos();
            Quaternion::from_xyzw([0.0, 0.0, sin as f32, cos as f32])
        };
        let class = |agent: &Agent| match agent.id == self.scenario.ego {
            true => EGO,
            false => class(agent.kind),
        };
        Boxes3D::from_centers_and_half_sizes(agents().map(centre), agents().map(half))
            .with_quaternions(agents().map(turn))
            .with_class_ids(agents().map(class))
    }

    fn lights(&self, lights: &[Light]) -> Points3D {
        let map = &self.scenario.map;
        let place = |light: &Light| {
            let start = || map.lane(light.lane).map(|lane| lane.centerline.points()[0]);
            light.stop_point.or_else(start)
        };
        let placed = || lights.iter().filter_map(|l| Some((place(l)?, l.state)));
        let points = placed().map(|(point, _)| self.point(point, LIGHT_Z));
        Points3D::new(points).with_class_ids(placed().map(|(_, state)| class_of_light(state)))
    }
}

/// Returns the names and colours of the class ids.
fn classes() -> AnnotationContext {
    let colours = Theme::Dark.colours();
    let kinds = KINDS.map(|kind| (class(kind), kind.name(), colours.kind(kind)));
    let lights = LIGHTS.map(|(state, name)| (class_of_light(state), name, colours.light(state)));
    let all = [(EGO, "ego", colours.ego)]
        .into_iter()
        .chain(kinds)
        .chain(lights);
    AnnotationContext::new(all.map(|(id, name, colour)| (id, name, Rgba32::from(colour))))
}

fn class(kind: AgentKind) -> u16 {
    let place = KINDS.iter().position(|known| *known == kind);
    EGO + 1 + place.expect("all kinds are listed") as u16
}

fn class_of_light(state: LightState) -> u16 {
    let place = LIGHTS.iter().position(|(known, _)| *known == state);
    EGO + 1 + KINDS.len() as u16 + place.expect("all states are listed") as u16
}

/// A common height, metres.
fn height(kind: AgentKind) -> f32 {
    match kind {
        AgentKind::Vehicle => 1.6,
        AgentKind::Pedestrian | AgentKind::Bicycle | AgentKind::Sign => 1.75,
        AgentKind::TrafficCone | AgentKind::Barrier | AgentKind::Other => 0.9,
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::io::BufReader;

    use re_sdk::external::re_log_encoding::DecoderApp;
    use re_sdk::log::{Chunk, LogMsg};

    use super::*;
    use crate::log_as_rollout;

    #[test]
    fn a_recording_reads_back_as_what_was_written() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 150,0
             lane 2: 9000,0 9100,0
             ego vehicle 0: 10,0 velocity 8,0
             agent pedestrian 7: 40,3 velocity 0,-1
             light 1 red: 38,0
             history 1 future 2 dt 0.1",
        )
        .unwrap();
        let future = log_as_rollout(&scenario);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.rrd");
        let mut viewer = Viewer::new(&scenario);
        viewer.future("1", &future).future("2", &future);
        viewer.save_rerun(&path).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);

        let file = BufReader::new(std::fs::File::open(&path).unwrap());
        let mut rows: BTreeMap<String, usize> = BTreeMap::new();
        let mut times: BTreeMap<String, (f64, f64)> = BTreeMap::new();
        for message in DecoderApp::decode_eager(file).unwrap() {
            let LogMsg::ArrowMsg(id, message) = message.unwrap() else {
                continue;
            };
            assert_eq!(id.recording_id().as_str(), scenario.id);
            let chunk = Chunk::from_arrow_msg(&message).unwrap();
            let path = chunk.entity_path().to_string();
            let column = chunk
                .timelines()
                .iter()
                .find(|(name, _)| name.as_str() == TIMELINE);
            if let Some((_, column)) = column {
                let range = column.time_range();
                let seconds = |time: re_sdk::time::TimeInt| time.as_i64() as f64 * 1e-9;
                let span = times.entry(path.clone()).or_insert((f64::MAX, f64::MIN));
                span.0 = span.0.min(seconds(range.min()));
                span.1 = span.1.max(seconds(range.max()));
                *rows.entry(path).or_default() += chunk.num_rows();
            } else {
                rows.entry(path).or_default();
            }
        }
        let n = scenario.log.len();
        assert_eq!(rows["/log/agents"], n);
        assert_eq!(times["/log/agents"], (-1.0, 2.0));
        for future in ["1", "2"] {
            assert_eq!(rows[&format!("/futures/{future}/agents")], n - scenario.now);
            assert_eq!(times[&format!("/futures/{future}/agents")], (0.0, 2.0));
            // Red throughout: said once.
            assert_eq!(rows[&format!("/futures/{future}/lights")], 1);
        }
        assert!(rows.contains_key("/map/lanes") && rows.contains_key("/map/edges"));
    }

    #[test]
    fn every_class_has_its_own_number() {
        let mut all: Vec<u16> = KINDS.map(class).to_vec();
        all.extend(LIGHTS.map(|(state, _)| class_of_light(state)));
        all.push(EGO);
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), KINDS.len() + LIGHTS.len() + 1);
    }
}
