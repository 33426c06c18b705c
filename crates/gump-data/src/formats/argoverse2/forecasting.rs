//! Motion forecasting: 11 s of tracks at 10 Hz, the first 5 s observed.

use std::collections::{BTreeMap, btree_map::Entry};
use std::path::Path;

use gump_geometry::{dvec2, dvec3};
use gump_scene::{AgentKind, Scenario};

use super::map::{self, Map};
use super::{DT, beside};
use crate::complete::recording::{Recording, assemble};
use crate::complete::track::{State, Track, UNSTATED};
use crate::formats::document::{self, Document};
use crate::io::columns as table;
use crate::source::Format;
use crate::{DataError, Problem, ReadOptions, ReadReport};

pub(crate) const FORMAT: Format = Format {
    name: "Argoverse 2 motion forecasting (Parquet, map beside)",
    recognises,
    open: document::open::<File>,
};

/// The first bytes of a Parquet file; reading its columns shows whether it contains scenarios.
fn recognises(head: &[u8]) -> bool {
    head.starts_with(b"PAR1")
}

/// The ego's track id.
const EGO: &str = "AV";
/// Smallest value of the column `object_category` for which a track is scored.
const SCORED: i64 = 2;

/// The rows of a scenario and its map.
pub(crate) struct File {
    id: String,
    rows: Vec<Row>,
    map: Map,
}

struct Row {
    track: String,
    kind: String,
    category: i64,
    step: i64,
    observed_until: bool,
    state: [f64; 5],
}

impl Document for File {
    const WHAT: &'static str = "an Argoverse 2 forecasting scenario";

    fn read(path: &Path) -> Result<Self, DataError> {
        let table = table::parquet(path)?;
        let text = |name| table.texts(name, path);
        let number = |name| table.numbers(name, path);
        let (tracks, kinds) = (text("track_id")?, text("object_type")?);
        let ids = text("scenario_id")?;
        let categories = table.integers("object_category", path)?;
        let steps = table.integers("timestep", path)?;
        let observed = table.flags("observed", path)?;
        let [x, y, heading] = [
            number("position_x")?,
            number("position_y")?,
            number("heading")?,
        ];
        let [vx, vy] = [number("velocity_x")?, number("velocity_y")?];
        let rows = tracks
            .into_iter()
            .zip(kinds)
            .enumerate()
            .map(|(i, (track, kind))| Row {
                track,
                kind,
                category: categories[i],
                step: steps[i],
                observed_until: observed[i],
                state: [x[i], y[i], heading[i], vx[i], vy[i]],
            });
        let map = beside(path, "log_map_archive", ".json")?;
        Ok(Self {
            id: ids.into_iter().next().unwrap_or_default(),
            rows: rows.collect(),
            map: map::read(&map)?,
        })
    }

    fn id(&self, path: &Path) -> String {
        if self.id.is_empty() {
            document::stem(path)
        } else {
            self.id.clone()
        }
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
        let observed = self
            .rows
            .iter()
            .filter(|row| row.observed_until)
            .map(|row| row.step)
            .max();
        let now = observed
            .and_then(|step| usize::try_from(step).ok())
            .unwrap_or(0);
        let mut by_name: BTreeMap<String, usize> = BTreeMap::new();
        let (mut tracks, mut targets) = (Vec::<Track>::new(), Vec::new());
        let mut steps = 0;
        for row in self.rows {
            let Ok(step) = usize::try_from(row.step) else {
                report.drop("row without a time step", 1);
                continue;
            };
            let index = match by_name.entry(row.track) {
                Entry::Occupied(known) => *known.get(),
                Entry::Vacant(new) => {
                    let id = track_id(new.key(), tracks.len());
                    if row.category >= SCORED {
                        targets.push(id);
                    }
                    tracks.push(track(id, &row.kind));
                    *new.insert(tracks.len() - 1)
                }
            };
            steps = steps.max(step.saturating_add(1));
            let [x, y, heading, vx, vy] = row.state;
            tracks[index].states.push(State {
                step,
                position: dvec3(x, y, UNSTATED),
                heading,
                velocity: dvec2(vx, vy),
                size: [UNSTATED; 3],
            });
        }
        let ego = by_name.get(EGO).map(|&index| tracks[index].id);
        Recording {
            id,
            dt: DT,
            steps,
            now,
            ego,
            lights: Vec::new(),
            targets: Some(targets),
            objects_of_interest: Vec::new(),
            tags: Vec::new(),
            route: None,
            tracks,
        }
    }
}

/// Parses a track id, which is a number for all but the ego; other names get a unique negative id.
fn track_id(name: &str, index: usize) -> i64 {
    let number = name.parse().ok().filter(|id| *id >= 0);
    number.unwrap_or(-1 - index as i64)
}

fn track(id: i64, name: &str) -> Track {
    let (kind, usual_size) = kind(name);
    Track {
        id,
        kind,
        usual_size,
        states: Vec::new(),
    }
}

/// Returns the class of an object type, and its usual length, width and height, metres.
///
/// Source of sizes: the means of these classes in the Argoverse 2 sensor logs, to a decimetre.
pub(super) fn kind(name: &str) -> (AgentKind, [f64; 3]) {
    let usual = |kind: AgentKind| (kind, kind.usual_size());
    match name {
        "vehicle" => usual(AgentKind::Vehicle),
        "bus" => (AgentKind::Vehicle, [11.0, 2.9, 3.3]),
        "motorcyclist" => (AgentKind::Vehicle, [2.1, 0.9, 1.7]),
        "pedestrian" => usual(AgentKind::Pedestrian),
        "cyclist" => usual(AgentKind::Bicycle),
        "riderless_bicycle" => (AgentKind::Other, [1.7, 0.6, 1.1]),
        "construction" => usual(AgentKind::Barrier),
        _ => usual(AgentKind::Other),
    }
}
