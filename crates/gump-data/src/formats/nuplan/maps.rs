//! Finding the map of a log, and caching maps.
//!
//! nuPlan keeps maps as `LOCATION/VERSION/map.gpkg` beside a list of versions. Start with
//! [`find_map`] for one log, or [`Maps`] for many.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;

use super::log::Log;
use super::map::{CityMap, read_map};
use crate::DataError;
use crate::io::stream::io_error;

/// The environment variable in which nuPlan's tools look for the folder of maps.
pub const MAPS_VARIABLE: &str = "NUPLAN_MAPS_ROOT";

/// The list of versions in a folder of maps.
const VERSION_LIST: &str = "nuplan-maps-v1.0.json";

/// Versions of the published maps by location.
///
/// Source: nuplan-devkit, which names them beside its list of locations.
const PUBLISHED: [(&str, &str); 4] = [
    ("sg-one-north", "9.17.1964"),
    ("us-ma-boston", "9.12.1817"),
    ("us-nv-las-vegas-strip", "9.15.1915"),
    ("us-pa-pittsburgh-hazelwood", "9.17.1937"),
];

/// Number of folders searched for maps, from that of the log upwards: nuPlan's own layout needs
/// four.
const MAX_LEVELS: usize = 6;

/// Finds the map of a log.
///
/// The search order: `map.gpkg` and `LOCATION.gpkg` beside the log; then in each folder above it
/// (six at most), in `maps` and `nuplan-maps-v1.0` in each, and in the folder given by the
/// environment variable `NUPLAN_MAPS_ROOT`: `LOCATION/VERSION/map.gpkg`. The version is that of the
/// list `nuplan-maps-v1.0.json` there, else the published one, else the only one there is.
///
/// # Errors
/// [`DataError::NoCompanion`] if there is none; [`DataError::Table`] if there are only other
/// versions; [`DataError::Json`] and [`DataError::Io`] for the list of versions.
pub fn find_map(log: &Path, location: &str) -> Result<PathBuf, DataError> {
    let folder = log.parent().unwrap_or(Path::new(""));
    for name in ["map.gpkg".to_owned(), format!("{location}.gpkg")] {
        let beside = folder.join(name);
        if beside.is_file() {
            return Ok(beside);
        }
    }
    for root in roots(folder) {
        if let Some(map) = map_in(&root, location)? {
            return Ok(map);
        }
    }
    Err(DataError::NoCompanion {
        expected: format!(
            "map.gpkg, or {location}/VERSION/map.gpkg in a folder maps above or in the folder that \
             {MAPS_VARIABLE} names,"
        ),
        path: log.into(),
    })
}

/// Folders that may hold maps.
fn roots(folder: &Path) -> Vec<PathBuf> {
    // Names like "x.db" have no folders above them until they are made absolute.
    let absolute = fs::canonicalize(folder).unwrap_or_else(|_| folder.into());
    let above = absolute.ancestors().take(MAX_LEVELS);
    let candidates = above.flat_map(|f| [f.join("maps"), f.join("nuplan-maps-v1.0"), f.into()]);
    let named = std::env::var_os(MAPS_VARIABLE).map(PathBuf::from);
    candidates.chain(named).filter(|f| f.is_dir()).collect()
}

/// The map of a location in a folder of maps; `None` if the folder does not know the location.
fn map_in(root: &Path, location: &str) -> Result<Option<PathBuf>, DataError> {
    let folder = root.join(location);
    if location.is_empty() || !folder.is_dir() {
        return Ok(None);
    }
    let found = versions(&folder)?;
    let published = PUBLISHED.iter().find(|(name, _)| *name == location);
    let wanted = match listed_version(root, location)? {
        Some(version) => Some(version),
        None => published.map(|(_, version)| (*version).to_owned()),
    };
    let version = match (wanted, found.as_slice()) {
        (Some(wanted), _) if found.contains(&wanted) => wanted,
        (None, [only]) => only.clone(),
        (_, []) => return Ok(None),
        (wanted, _) => {
            let version = wanted.map_or("one version".into(), |w| format!("version {w}"));
            return Err(DataError::Table {
                expected: format!("{version} of the map of {location}"),
                found: found.join(", "),
                path: folder,
            });
        }
    };
    Ok(Some(folder.join(version).join("map.gpkg")))
}

/// Versions that are there, sorted.
fn versions(folder: &Path) -> Result<Vec<String>, DataError> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).map_err(|e| io_error("list", e, folder))? {
        let entry = entry.map_err(|e| io_error("list", e, folder))?;
        if entry.path().join("map.gpkg").is_file() {
            found.push(entry.file_name().to_string_lossy().into_owned());
        }
    }
    found.sort();
    Ok(found)
}

#[derive(Deserialize)]
struct Listed {
    version: String,
}

/// The version that the folder's list names for a location, if it has a list that does.
fn listed_version(root: &Path, location: &str) -> Result<Option<String>, DataError> {
    let path = root.join(VERSION_LIST);
    if !path.is_file() {
        return Ok(None);
    }
    let text = fs::read_to_string(&path).map_err(|e| io_error("read", e, &path))?;
    let parsed: Result<BTreeMap<String, serde_json::Value>, _> = serde_json::from_str(&text);
    let what = "versions of maps by location";
    let list = parsed.map_err(|source| DataError::Json {
        what,
        source,
        path: path.clone(),
    })?;
    let Some(entry) = list.get(location) else {
        return Ok(None);
    };
    let listed = Listed::deserialize(entry);
    listed
        .map(|l| Some(l.version))
        .map_err(|source| DataError::Json {
            what,
            source,
            path: path.clone(),
        })
}

/// Maps by file, each read once.
#[derive(Debug, Default)]
pub struct Maps {
    read: BTreeMap<PathBuf, Arc<CityMap>>,
}

impl Maps {
    /// The map of a log, read or cached, and checked to cover the same place.
    ///
    /// # Errors
    /// Those of [`find_map`] and [`read_map`]; [`DataError::Table`] if map and log are in different
    /// projections or the log begins far from every lane.
    pub fn of(&mut self, log: &Log) -> Result<Arc<CityMap>, DataError> {
        let path = find_map(log.path(), log.map_name())?;
        let map = match self.read.get(&path) {
            Some(map) => Arc::clone(map),
            None => {
                let map = Arc::new(read_map(&path)?);
                self.read.insert(path.clone(), Arc::clone(&map));
                map
            }
        };
        check_place(log, &map, &path)?;
        Ok(map)
    }
}

/// A log further from every lane than this is elsewhere, metres: far less than cities are apart,
/// far more than a car park is from a road.
const MAX_DISTANCE: f64 = 2000.0;

fn check_place(log: &Log, map: &CityMap, path: &Path) -> Result<(), DataError> {
    let elsewhere = |expected, found| {
        Err(DataError::Table {
            expected,
            found,
            path: path.into(),
        })
    };
    let name = log.path().display();
    if let Some(epsg) = log.epsg()?.filter(|epsg| *epsg != map.epsg) {
        let expected = format!("a map in epsg:{epsg}, in which the log {name} is");
        return elsewhere(expected, format!("epsg:{}", map.epsg));
    }
    let first = log.after(i64::MIN, 1)?;
    let Some(ego) = first.first().map(|row| row.ego.rear_axle.position) else {
        return Ok(());
    };
    if map.graph.lanes_near(ego, MAX_DISTANCE).next().is_none() {
        let expected = format!("lanes within {MAX_DISTANCE} m of where the log {name} begins");
        return elsewhere(expected, "none".into());
    }
    Ok(())
}
