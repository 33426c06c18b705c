//! Untrusted bytes for each reader: the file they go to, the files needed beside it, the checksums.
//!
//! Shared by the fuzz targets (`fuzz/`) and the replay in the tests. Checksums are put right here,
//! since no fuzzer guesses them and readers must survive damage behind them.

#![allow(dead_code, reason = "each user uses a part of this")]
#![allow(clippy::unwrap_used, reason = "what is committed can be read")]

use std::fs;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

/// A reader under attack.
pub(crate) struct Target {
    /// Its name, and that of the folder with its seeds.
    pub(crate) name: &'static str,
    /// The file that the bytes go to.
    file: &'static str,
    /// Puts framing and checksums around the bytes.
    seal: fn(&[u8]) -> Vec<u8>,
    /// The file to open, if it is not the one with the bytes.
    opened: Option<&'static str>,
    /// Files needed beside it: a name, and a path from the tests' folder.
    beside: &'static [(&'static str, &'static str)],
}

const fn alone(name: &'static str, file: &'static str) -> Target {
    Target {
        name,
        file,
        seal: <[u8]>::to_vec,
        opened: None,
        beside: &[],
    }
}

const AV2_MAP: (&str, &str) = (
    "log_map_archive_some.json",
    "hostile/argoverse2_map/seed.json",
);
const AV2_ROWS: (&str, &str) = ("some.parquet", "hostile/argoverse2/seed.parquet");
const AV2_POSES: (&str, &str) = (
    "city_SE3_egovehicle.feather",
    "hostile/argoverse2_log/city_SE3_egovehicle.feather",
);
const NETWORK: (&str, &str) = ("some.net.xml", "hostile/sumo_network/seed.net.xml");
const CARS: (&str, &str) = ("some.fcd.xml", "hostile/sumo/seed-coarse.fcd.xml");
const LOG: (&str, &str) = ("log.db", "hostile/nuplan/seed.db");
const TAF_TRACKS: (&str, &str) = (
    "recorded_trackfiles/here/vehicle_tracks_000.csv",
    "hostile/taf_bw/seed.csv",
);
const TAF_META: (&str, &str) = (
    "recorded_trackfiles/here/meta_data.csv",
    "data/taf_bw/recorded_trackfiles/here/meta_data.csv",
);
const TAF_MAP: (&str, &str) = ("maps/here.osm", "hostile/taf_bw_map/seed.osm");
const MAP: (&str, &str) = ("map.gpkg", "hostile/nuplan_map/seed.gpkg");

/// Every reader, and every part of one that has a separate file or checksum.
pub(crate) static TARGETS: [Target; 16] = [
    alone("womd", "some.tfrecord"),
    Target {
        seal: tfrecord,
        ..alone("womd_message", "some.tfrecord")
    },
    alone("gpudrive", "some.json"),
    alone("scenario_json", "some.json"),
    alone("commonroad", "some.xml"),
    Target {
        beside: &[AV2_MAP],
        ..alone("argoverse2", AV2_ROWS.0)
    },
    Target {
        beside: &[AV2_MAP, AV2_POSES],
        ..alone("argoverse2_log", "annotations.feather")
    },
    Target {
        opened: Some(AV2_ROWS.0),
        beside: &[AV2_ROWS],
        ..alone("argoverse2_map", AV2_MAP.0)
    },
    Target {
        beside: &[NETWORK],
        ..alone("sumo", CARS.0)
    },
    Target {
        opened: Some(CARS.0),
        beside: &[CARS],
        ..alone("sumo_network", NETWORK.0)
    },
    Target {
        beside: &[MAP],
        ..alone("nuplan", LOG.0)
    },
    Target {
        opened: Some(LOG.0),
        beside: &[LOG],
        ..alone("nuplan_map", MAP.0)
    },
    Target {
        beside: &[TAF_META, TAF_MAP],
        ..alone("taf_bw", TAF_TRACKS.0)
    },
    Target {
        opened: Some(TAF_TRACKS.0),
        beside: &[TAF_META, TAF_TRACKS],
        ..alone("taf_bw_map", TAF_MAP.0)
    },
    Target {
        seal: shard_of_one,
        ..alone("cache", "some.cache")
    },
    Target {
        seal: shard_with_index,
        ..alone("cache_index", "some.cache")
    },
];

/// The tests' folder, which the including file defines.
fn tests() -> &'static Path {
    Path::new(super::TESTS)
}

/// The target of this name.
pub(crate) fn target(name: &str) -> &'static Target {
    let found = TARGETS.iter().find(|target| target.name == name);
    found.expect("every fuzz target is in the table")
}

impl Target {
    /// A folder with what must lie beside.
    pub(crate) fn folder(&self) -> TempDir {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        for (name, _) in self.beside.iter().chain([&(self.file, "")]) {
            fs::create_dir_all(place(name).parent().unwrap()).unwrap();
        }
        for (name, from) in self.beside {
            fs::copy(tests().join(from), place(name)).unwrap();
        }
        folder
    }

    /// Reads these bytes to the end; how many scenarios came out.
    pub(crate) fn read(&self, folder: &TempDir, bytes: &[u8]) -> usize {
        let place = |name: &str| folder.path().join(name);
        // A file cut short and written again may be flushed to the disk at once (ext4), which takes ten
        // times as long as reading it.
        let _ = fs::remove_file(place(self.file));
        fs::write(place(self.file), (self.seal)(bytes)).unwrap();
        let reader = gump_data::open(&place(self.opened.unwrap_or(self.file)));
        reader.map_or(0, |reader| reader.filter(Result::is_ok).count())
    }

    /// Seeds and what once broke a reader, in order of their names.
    pub(crate) fn corpus(&self) -> Vec<(PathBuf, Vec<u8>)> {
        let folder = tests().join("hostile").join(self.name);
        let entries = fs::read_dir(folder).unwrap();
        let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
        files.sort();
        let read = |file: PathBuf| (file.clone(), fs::read(&file).unwrap());
        files.into_iter().map(read).collect()
    }
}

fn tfrecord(message: &[u8]) -> Vec<u8> {
    let mut file = Vec::new();
    gump_data::tfrecord::write_record(&mut file, message).unwrap();
    file
}

const SHARD_START: &[u8] = b"GUMPDATA\x01\0\0\0";

/// A shard of the cache whose only record these are.
fn shard_of_one(record: &[u8]) -> Vec<u8> {
    let mut index = vec![1, 2, b'i', b'd'];
    // Lengths have seven bits a byte, the lowest first.
    let mut rest = record.len();
    while rest > 0x7f {
        index.push((rest & 0x7f) as u8 | 0x80);
        rest >>= 7;
    }
    index.push(rest as u8);
    index.extend(crc32c::crc32c(record).to_le_bytes());
    shard(record, &index)
}

/// A shard without records whose index these are.
fn shard_with_index(index: &[u8]) -> Vec<u8> {
    shard(&[], index)
}

fn shard(records: &[u8], index: &[u8]) -> Vec<u8> {
    let mut trailer = Vec::new();
    trailer.extend(((SHARD_START.len() + records.len()) as u64).to_le_bytes());
    trailer.extend((index.len() as u64).to_le_bytes());
    trailer.extend(crc32c::crc32c(index).to_le_bytes());
    trailer.extend(crc32c::crc32c(&trailer).to_le_bytes());
    [SHARD_START, records, index, &trailer].concat()
}
