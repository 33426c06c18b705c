//! Annotated sensor logs: boxes in the ego's frame ten times a second, ego poses in the city's.
//!
//! The recognised file is `annotations*.feather`; `city_SE3_egovehicle.feather` and the map must be
//! beside it. Boxes are those of the annotators; images and point clouds are not read.

use std::collections::{BTreeMap, btree_map::Entry};
use std::path::Path;

use gump_geometry::{DVec2, dvec3};
use gump_scene::{AgentKind, Scenario};

use super::map::{self, Map};
use super::{DT, beside};
use crate::complete::recording::{Recording, assemble};
use crate::complete::track::{self, State, Track, UNSTATED};
use crate::formats::document::{self, Document};
use crate::io::columns as table;
use crate::source::Format;
use crate::{DataError, Problem, ReadOptions, ReadReport};

pub(crate) const FORMAT: Format = Format {
    name: "Argoverse 2 sensor log (Feather annotations, map beside)",
    recognises,
    open: document::open::<File>,
};

/// Feather files start with this (version 2).
pub(crate) fn is_feather(head: &[u8]) -> bool {
    head.starts_with(b"ARROW1")
}

/// The schema, at the beginning of the file, names the columns.
fn recognises(head: &[u8]) -> bool {
    let names = |column: &[u8]| head.windows(column.len()).any(|w| w == column);
    is_feather(head) && names(b"track_uuid") && names(b"tx_m")
}

/// The ego's category where annotations include it.
const EGO: &str = "EGO_VEHICLE";
/// The ego's length, width and height, metres.
///
/// Source: the ego's box in the annotated logs of the scenario-mining sample.
const EGO_SIZE: [f64; 3] = [4.877, 2.0, 1.473];
/// Distance of the ego's box centre ahead of its origin, the middle of its rear axle, metres: half
/// the wheelbase of the Ford Fusion (2.85 m), assuming equal overhangs. The sample's own box
/// for the ego is centred on the origin, which contradicts where the format puts that.
const EGO_AHEAD: f64 = 1.425;

/// Boxes by time, ego poses by time, the map.
pub(crate) struct File {
    boxes: Vec<Annotation>,
    ego_poses: BTreeMap<i64, Placement>,
    map: Map,
}

struct Annotation {
    stamp: i64,
    track: String,
    category: String,
    size: [f64; 3],
    placement: Placement,
}

/// A rotation about the vertical, and a translation, metres.
#[derive(Clone, Copy)]
struct Placement {
    heading: f64,
    translation: [f64; 3],
}

impl Placement {
    fn after(self, outer: Self) -> Self {
        let [x, y, z] = self.translation;
        let turned = DVec2::from_angle(outer.heading).rotate(DVec2::new(x, y));
        let [ox, oy, oz] = outer.translation;
        Self {
            heading: self.heading + outer.heading,
            translation: [turned.x + ox, turned.y + oy, z + oz],
        }
    }
}

/// The placements of every row.
fn placements(table: &table::Table, path: &Path) -> Result<Vec<Placement>, DataError> {
    let column = |name| table.numbers(name, path);
    let [w, x, y, z] = [column("qw")?, column("qx")?, column("qy")?, column("qz")?];
    let [tx, ty, tz] = [column("tx_m")?, column("ty_m")?, column("tz_m")?];
    let yaw = |i: usize| {
        let sine = 2.0 * (w[i] * z[i] + x[i] * y[i]);
        sine.atan2(1.0 - 2.0 * (y[i] * y[i] + z[i] * z[i]))
    };
    let placement = |i| Placement {
        heading: yaw(i),
        translation: [tx[i], ty[i], tz[i]],
    };
    Ok((0..table.n_rows).map(placement).collect())
}

impl Document for File {
    const WHAT: &'static str = "an Argoverse 2 sensor log";

    fn read(path: &Path) -> Result<Self, DataError> {
        let table = table::feather(path)?;
        let number = |name| table.numbers(name, path);
        let [length, width, height] =
            [number("length_m")?, number("width_m")?, number("height_m")?];
        let stamps = table.integers("timestamp_ns", path)?;
        let tracks = table.texts("track_uuid", path)?;
        let categories = table.texts("category", path)?;
        let named = tracks
            .into_iter()
            .zip(categories)
            .zip(placements(&table, path)?);
        let boxes = named
            .enumerate()
            .map(|(i, ((track, category), placement))| Annotation {
                stamp: stamps[i],
                track,
                category,
                size: [length[i], width[i], height[i]],
                placement,
            });
        let boxes = boxes.collect();
        let poses_path = beside(path, "city_SE3_egovehicle", ".feather")?;
        let poses = table::feather(&poses_path)?;
        let stamps = poses.integers("timestamp_ns", &poses_path)?;
        let placements = placements(&poses, &poses_path)?;
        Ok(Self {
            boxes,
            ego_poses: stamps.into_iter().zip(placements).collect(),
            map: map::read(&beside(path, "log_map_archive", ".json")?)?,
        })
    }

    /// The log's folder is named by its id.
    fn id(&self, path: &Path) -> String {
        let folder = path.parent().and_then(Path::file_name);
        folder.map_or_else(
            || document::stem(path),
            |f| f.to_string_lossy().into_owned(),
        )
    }

    fn scenario(
        self,
        id: String,
        options: ReadOptions,
        report: &mut ReadReport,
    ) -> Result<Scenario, Problem> {
        let parts = map::parts(&self.map, report);
        if parts.lanes.is_empty() {
            return Err(Problem::NoMap);
        }
        let recording = self.recording(id, report);
        assemble(recording, parts, options, report)
    }
}

impl File {
    fn recording(self, id: String, report: &mut ReadReport) -> Recording {
        let first = self.boxes.iter().map(|b| b.stamp).min().unwrap_or(0);
        // Stamps are on lidar sweeps, a tenth of a second apart to within a few milliseconds.
        let step = |stamp: i64| {
            let seconds = stamp.saturating_sub(first) as f64 / 1e9;
            (seconds / DT).round() as usize
        };
        let mut by_name: BTreeMap<String, usize> = BTreeMap::new();
        let mut tracks = vec![Track {
            id: 0,
            kind: AgentKind::Vehicle,
            usual_size: EGO_SIZE,
            states: Vec::new(),
        }];
        let (mut stamps, mut without_pose) = (BTreeMap::new(), 0);
        for annotation in self.boxes {
            let step = step(annotation.stamp);
            let Some(&ego) = self.ego_poses.get(&annotation.stamp) else {
                without_pose += 1;
                continue;
            };
            stamps.insert(step, ego);
            if annotation.category == EGO {
                continue;
            }
            let index = match by_name.entry(annotation.track) {
                Entry::Occupied(known) => *known.get(),
                Entry::Vacant(new) => {
                    let (kind, usual_size) = kind(&annotation.category);
                    tracks.push(Track {
                        id: tracks.len() as i64,
                        kind,
                        usual_size,
                        states: Vec::new(),
                    });
                    *new.insert(tracks.len() - 1)
                }
            };
            tracks[index].states.push(state(
                step,
                annotation.placement.after(ego),
                annotation.size,
            ));
        }
        report.drop("box at a time without an ego pose", without_pose);
        report.infer("present one second in, or at the start", 1);
        let ahead = Placement {
            heading: 0.0,
            translation: [EGO_AHEAD, 0.0, EGO_SIZE[2] / 2.0],
        };
        let ego_states = stamps
            .iter()
            .map(|(&step, &ego)| state(step, ahead.after(ego), EGO_SIZE));
        tracks[0].states = ego_states.collect();
        let steps = stamps
            .keys()
            .next_back()
            .map_or(0, |last| last.saturating_add(1));
        Recording {
            id,
            dt: DT,
            steps,
            now: track::usual_present(steps, DT),
            ego: Some(0),
            lights: Vec::new(),
            targets: None,
            objects_of_interest: Vec::new(),
            tags: Vec::new(),
            route: None,
            tracks,
        }
    }
}

fn state(step: usize, placement: Placement, size: [f64; 3]) -> State {
    let [x, y, z] = placement.translation;
    State {
        step,
        position: dvec3(x, y, z),
        heading: placement.heading,
        velocity: DVec2::splat(UNSTATED),
        size,
    }
}

fn kind(category: &str) -> (AgentKind, [f64; 3]) {
    let kind = match category {
        "REGULAR_VEHICLE"
        | "LARGE_VEHICLE"
        | "BUS"
        | "BOX_TRUCK"
        | "TRUCK"
        | "TRUCK_CAB"
        | "VEHICULAR_TRAILER"
        | "SCHOOL_BUS"
        | "ARTICULATED_BUS"
        | "MOTORCYCLIST"
        | "MOTORCYCLE"
        | "RAILED_VEHICLE"
        | "MESSAGE_BOARD_TRAILER"
        | "TRAFFIC_LIGHT_TRAILER" => AgentKind::Vehicle,
        "PEDESTRIAN" | "OFFICIAL_SIGNALER" | "STROLLER" | "WHEELCHAIR" => AgentKind::Pedestrian,
        "BICYCLIST" | "WHEELED_RIDER" => AgentKind::Bicycle,
        "CONSTRUCTION_CONE" => AgentKind::TrafficCone,
        "CONSTRUCTION_BARREL" => AgentKind::Barrier,
        "SIGN" | "STOP_SIGN" | "MOBILE_PEDESTRIAN_CROSSING_SIGN" => AgentKind::Sign,
        _ => AgentKind::Other,
    };
    (kind, kind.usual_size())
}
