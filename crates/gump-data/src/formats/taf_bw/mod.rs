//! Recordings of the Test Area Autonomous Driving Baden-Württemberg (TAF-BW): tracks as CSV, the
//! road as a Lanelet2 map.
//!
//! `recorded_trackfiles/PLACE/vehicle_tracks_000.csv` goes with `meta_data.csv` in its folder, which
//! has rate and origin, and with `maps/PLACE.osm` two folders up (or beside it). `road` reads the
//! map, `traffic` the tracks. Signals are linked to lanes by a drawing (KML) that is not read.
//!
//! Source: the data set's own description, checked on its 27 recordings of three places.

mod road;
mod traffic;

use std::path::{Path, PathBuf};

use gump_scene::LaneKind;

use crate::complete::recording::assemble;
use crate::formats::document::{self, Document};
use crate::io::stream;
use crate::io::xml::{self, Element};
use crate::source::{Companion, Format};
use crate::{DataError, Problem, ReadOptions, ReadReport};

pub(crate) const FORMAT: Format = Format {
    name: "TAF-BW tracks (CSV beside a Lanelet2 map)",
    recognises: traffic::is_table,
    open: document::open::<File>,
};

pub(crate) const MAP: Companion = Companion {
    what: "Lanelet2 or OpenStreetMap map",
    recognises: is_map,
};

fn is_map(head: &[u8]) -> bool {
    let text = String::from_utf8_lossy(&head[..head.len().min(1024)]);
    text.trim_start_matches('\u{feff}')
        .trim_start()
        .starts_with('<')
        && text.contains("<osm ")
}

/// The most bytes of a table that are read; the longest recording known has 2 MB.
const MAX_BYTES: u64 = 64 << 20;

/// A recording with what lies beside it.
pub(crate) struct File {
    tracks: String,
    map: Element,
    meta: Meta,
    /// The folder's name.
    place: String,
}

/// The content of `meta_data.csv`.
struct Meta {
    rate_hz: f64,
    /// Latitude and longitude, degrees.
    origin: [f64; 2],
    speed_limit_kmh: f64,
}

impl Document for File {
    const WHAT: &'static str = "tracks of TAF-BW as CSV";

    fn read(path: &Path) -> Result<Self, DataError> {
        let folder = path.parent().unwrap_or(Path::new(""));
        let place = std::path::absolute(folder).ok();
        let place = place.and_then(|folder| Some(folder.file_name()?.to_string_lossy().into()));
        let place: String = place.unwrap_or_default();
        let tracks = text(path, Self::WHAT)?;
        let number = number(path);
        let meta = meta(&companion(path, &[folder.join("meta_data.csv")])?, &number)?;
        let name = format!("{place}.osm");
        let above = folder.parent().and_then(Path::parent);
        let above = above.map(|folder| folder.join("maps").join(&name));
        let beside = Some(folder.join(&name));
        let places: Vec<PathBuf> = above.into_iter().chain(beside).collect();
        let map = xml::read(&companion(path, &places)?, "a Lanelet2 map as XML")?;
        Ok(Self {
            tracks,
            map,
            meta,
            place,
        })
    }

    fn id(&self, path: &Path) -> String {
        format!("{}-{}", self.place, number(path))
    }

    fn scenario(
        self,
        id: String,
        options: ReadOptions,
        report: &mut ReadReport,
    ) -> Result<gump_scene::Scenario, Problem> {
        let recording = traffic::recording(&self.tracks, id, self.meta.rate_hz, report)?;
        let mut parts = road::parts(&self.map, &self.meta, report);
        if parts.lanes.is_empty() {
            return Err(Problem::NoMap);
        }
        if options.infer_drivable {
            let streets = parts.lanes.iter().filter(|l| l.kind != LaneKind::BikeLane);
            parts.drivable = streets.filter_map(|lane| lane.outline.clone()).collect();
            report.infer("drivable surface of a lane", parts.drivable.len());
        }
        assemble(recording, parts, options, report)
    }
}

/// The number at the end of a recording's name.
fn number(path: &Path) -> String {
    let stem = document::stem(path);
    stem.rsplit('_').next().unwrap_or_default().to_owned()
}

/// The first of these files that is there.
fn companion(path: &Path, places: &[PathBuf]) -> Result<PathBuf, DataError> {
    let found = places.iter().find(|place| place.is_file());
    let names = places.iter().map(|place| place.display().to_string());
    found.cloned().ok_or_else(|| DataError::NoCompanion {
        expected: names.collect::<Vec<_>>().join(" or "),
        path: path.into(),
    })
}

fn text(path: &Path, what: &'static str) -> Result<String, DataError> {
    let bytes = stream::content(path, what, MAX_BYTES)?;
    String::from_utf8(bytes).map_err(|error| DataError::Table {
        expected: what.into(),
        found: format!(
            "bytes that are not UTF-8 at byte {}",
            error.utf8_error().valid_up_to()
        ),
        path: path.into(),
    })
}

/// The row of a recording.
fn meta(path: &Path, number: &str) -> Result<Meta, DataError> {
    let text = text(path, "what TAF-BW tells of its recordings as CSV")?;
    let wrong = |expected: &str, found: &str| DataError::Table {
        expected: expected.into(),
        found: found.into(),
        path: path.into(),
    };
    let mut lines = text.lines();
    let columns: Vec<&str> = lines.next().unwrap_or_default().split(',').collect();
    let row = lines.find(|line| line.split(',').next() == Some(number));
    let row: Vec<&str> = row
        .ok_or_else(|| wrong(&format!("a row of recording {number}"), "none"))?
        .split(',')
        .collect();
    let value = |name: &str| {
        let column = columns.iter().position(|column| column.trim() == name);
        let value = column.and_then(|column| row.get(column)?.trim().parse::<f64>().ok());
        value.unwrap_or(f64::NAN)
    };
    let meta = Meta {
        rate_hz: value("frameRate_hz"),
        origin: [value("originLat"), value("originLon")],
        speed_limit_kmh: value("speedLimit_kmh"),
    };
    if !(0.1..=1000.0).contains(&meta.rate_hz) {
        return Err(wrong("frameRate_hz between 0.1 and 1000", &row.join(",")));
    }
    let [latitude, longitude] = meta.origin;
    if !(latitude.abs() < 85.0 && longitude.abs() <= 180.0) {
        return Err(wrong("originLat and originLon in degrees", &row.join(",")));
    }
    Ok(meta)
}
