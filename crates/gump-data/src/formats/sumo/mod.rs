//! SUMO: a network, floating-car data and signal states in one folder.
//!
//! A recording is `fcd-output` beside its network (`net.xml`), and, where present, signal states
//! (`SaveTLSSwitchStates`) and vehicle types; all are recognised by content, plain or gzip.
//! [`crate::open`] takes the floating-car file or its folder and cuts scenarios of nine seconds;
//! [`open_recording`] has settings. [`Demand`] writes SUMO's inputs (demand, signal logging).
//!
//! Notes on the format: `x, y` is the front bumper, `angle` is clockwise from north, sizes are in
//! the vehicle types, pedestrians are separate elements. SUMO's shapes are flat: bridges cross like
//! streets.

mod demand;
mod floating_cars;
mod network;
mod roads;
mod scenes;
mod signals;
mod surfaces;
mod vehicle_types;
mod xml;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::complete::recording::{Recording, assemble};
use crate::io::stream::{self, io_error};
use crate::source::{BoxedSource, Format};
use crate::{DataError, ReadOptions, RecordLocation};
use floating_cars::FloatingCars;
use gump_scene::Scenario;
use signals::Signals;
use vehicle_types::VehicleTypes;

pub use demand::{Demand, Trip, TripKind, VehicleType};
pub use network::{Access, Connection, Edge, EdgeFunction, Junction, Network, NetworkLane};
pub use roads::Roads;
pub use scenes::{CutOptions, Scenes};

pub(crate) const FORMAT: Format = Format {
    name: "SUMO floating-car data (XML beside its network)",
    recognises: is_floating_cars,
    open,
};

/// The description of a network among the files without scenarios.
pub(crate) const NETWORK: &str = "SUMO network";

/// Number of bytes from the start of a file that identify its kind; SUMO writes its options first.
/// Chosen by hand.
const HEAD_BYTES: u64 = 16 * 1024;

/// Files of a folder by what they hold.
#[derive(Clone, Debug, Default, PartialEq)]
struct Folder {
    networks: Vec<PathBuf>,
    signals: Vec<PathBuf>,
    types: Vec<PathBuf>,
}

/// Opens a recording beside its network and cuts scenarios with these settings.
///
/// # Errors
/// [`DataError::NoNetwork`] where the folder holds no network, [`DataError::Xml`], and those of
/// opening files.
pub fn open_recording(
    path: &Path,
    cut: CutOptions,
    options: ReadOptions,
) -> Result<Scenes, DataError> {
    let parent = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty());
    let folder = parent.unwrap_or(Path::new("."));
    let network = network_beside(path, &Folder::of(folder)?)?;
    let roads = Roads::new(&Network::read(&network)?);
    open_on(path, Arc::new(roads), cut, options)
}

/// Opens a recording on a network that has been read already, for instance for many recordings.
///
/// # Errors
/// [`DataError::Xml`], and those of opening files.
pub fn open_on(
    path: &Path,
    roads: Arc<Roads>,
    cut: CutOptions,
    options: ReadOptions,
) -> Result<Scenes, DataError> {
    let parent = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty());
    let folder = Folder::of(parent.unwrap_or(Path::new(".")))?;
    let mut types = VehicleTypes::default();
    for file in &folder.types {
        types.read(file)?;
    }
    let mut signals = Signals::default();
    for file in matching(path, &folder.signals) {
        signals.read(file)?;
    }
    let cars = FloatingCars::open(path, types)?;
    Ok(Scenes::new(cars, roads, signals, cut, options))
}

fn open(path: &Path, options: ReadOptions) -> Result<BoxedSource, DataError> {
    Ok(Box::new(open_recording(
        path,
        CutOptions::standard(),
        options,
    )?))
}

fn is_floating_cars(head: &[u8]) -> bool {
    root(head).is_some_and(|root| root == "fcd-export")
}

/// A network as a scenario with only a parked ego, if `options` allow it.
///
/// Error: those of reading a network, and of one without lanes for vehicles.
pub(crate) fn map_alone(path: &Path, options: ReadOptions) -> Result<Scenario, DataError> {
    let roads = Roads::new(&Network::read(path)?);
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let id = name.split('.').next().unwrap_or_default().to_owned();
    let mut report = roads.report().clone();
    let nobody = Recording::of_nobody(id.clone());
    let scenario = assemble(nobody, roads.parts().clone(), options, &mut report);
    scenario.map_err(|problem| DataError::Scenario {
        id,
        problem,
        place: RecordLocation {
            record: 0,
            offset: 0,
            path: path.into(),
        },
    })
}

/// True for a network, which scenarios need beside them.
pub(crate) fn is_network(head: &[u8]) -> bool {
    root(head).is_some_and(|root| root == "net")
}

/// True for the other files of a SUMO simulation: demand, signals, detectors, configuration.
pub(crate) fn is_other(head: &[u8]) -> bool {
    const ROOTS: [&str; 10] = [
        "add",
        "additional",
        "configuration",
        "data",
        "edgedata",
        "meandata",
        "routes",
        "sumoConfiguration",
        "tlsStates",
        "turns",
    ];
    root(head).is_some_and(|root| ROOTS.contains(&root.as_str()))
}

/// The name of the first element, comments and declarations skipped.
fn root(head: &[u8]) -> Option<String> {
    let text = String::from_utf8_lossy(head);
    let mut rest = text.trim_start_matches('\u{feff}').trim_start();
    loop {
        let skip = if rest.starts_with("<!--") {
            "-->"
        } else if rest.starts_with("<?") || rest.starts_with("<!") {
            ">"
        } else {
            break;
        };
        let end = rest.find(skip)? + skip.len();
        rest = rest[end..].trim_start();
    }
    let name = rest.strip_prefix('<')?;
    let end = name.find(|c: char| c.is_whitespace() || c == '>' || c == '/')?;
    Some(name[..end].to_owned())
}

impl Folder {
    fn of(folder: &Path) -> Result<Self, DataError> {
        let mut files = Vec::new();
        for entry in fs::read_dir(folder).map_err(|e| io_error("list", e, folder))? {
            files.push(entry.map_err(|e| io_error("list", e, folder))?.path());
        }
        files.sort();
        let mut found = Self::default();
        for path in files {
            let name = path
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned();
            if !(name.ends_with(".xml") || name.ends_with(".xml.gz")) || !path.is_file() {
                continue;
            }
            // A file that cannot be read is none of these; opening it later reports the error.
            let head = stream::head(&path, HEAD_BYTES).unwrap_or_default();
            match root(&head).as_deref() {
                Some("net") => found.networks.push(path),
                Some("tlsStates") => found.signals.push(path),
                Some("additional" | "routes") => found.types.push(path),
                _ => {}
            }
        }
        Ok(found)
    }
}

/// The network a recording ran on: the one its header names, or the one whose name begins most
/// like its own. Whether it fits is seen from where the vehicles are.
fn network_beside(path: &Path, folder: &Folder) -> Result<PathBuf, DataError> {
    let head = stream::head(path, HEAD_BYTES)?;
    let head = String::from_utf8_lossy(&head);
    let stated = head
        .split_once("<net-file value=\"")
        .and_then(|(_, rest)| rest.split_once('"'))
        .and_then(|(file, _)| file.rsplit(['/', '\\']).next());
    let named = |file: &&PathBuf| {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        stated.is_some_and(|stated| name.trim_end_matches(".gz") == stated.trim_end_matches(".gz"))
    };
    if let Some(network) = folder.networks.iter().find(named) {
        return Ok(network.clone());
    }
    let best = matching(path, &folder.networks).into_iter().next();
    best.cloned()
        .ok_or_else(|| DataError::NoNetwork { path: path.into() })
}

/// Of several files of a kind, those whose names have the longest beginning in common with `path`.
fn matching<'a>(path: &Path, files: &'a [PathBuf]) -> Vec<&'a PathBuf> {
    let stem = |path: &Path| {
        path.file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    };
    let wanted = stem(path);
    let common = |file: &PathBuf| {
        let name = stem(file);
        name.chars()
            .zip(wanted.chars())
            .take_while(|(a, b)| a == b)
            .count()
    };
    let most = files.iter().map(common).max().unwrap_or(0);
    files.iter().filter(|file| common(file) == most).collect()
}
