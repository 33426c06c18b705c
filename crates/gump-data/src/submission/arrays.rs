//! Rollouts as arrays: NumPy's files, and the table of futures that `gump-data` writes.
//!
//! | file | what it holds |
//! |---|---|
//! | `.npz` | `scenario_id`, `agent_id` `[A]`, `states` `[R, A, T, 4]`: x, y, z, heading |
//! | `.npy` | one array of four axes, which `NAME.json` beside it explains: `scenario`, `axes`, `numbers`, `agents` |
//! | `.parquet` | [`crate::write_rollouts`] |
//!
//! An agent that is missing from some step on stays at its last position, as in the challenge; one
//! that is missing in the first step of a rollout is left out of it. Where heights are not stated
//! the column of heights is empty.
//!
//! Source: the `.npy` format of NumPy's documentation (versions 1 to 3), and the ZIP format as far as
//! NumPy writes it: no encryption, members stored or deflated.

use std::collections::BTreeMap;
use std::io::Read as _;
use std::path::Path;

use flate2::read::DeflateDecoder;
use serde::Deserialize;

use crate::DataError;
#[cfg(feature = "parquet")]
use crate::io::columns as table;
use crate::io::stream;
use gump_proto::{JointScene, ScenarioRollouts, SimulatedTrajectory};

/// The largest file that is read, and the most that a member of it may unpack to, bytes: what a
/// usual machine holds; damaged files may unpack to anything.
const MAX_BYTES: u64 = 4 << 30;
/// The first bytes of an `.npy` file.
const NPY: &[u8] = b"\x93NUMPY";
/// The first bytes of a ZIP file.
const ZIP: &[u8] = b"PK\x03\x04";
/// The first bytes of a Parquet file.
#[cfg(feature = "parquet")]
const PARQUET: &[u8] = b"PAR1";

/// The rollouts of a file of arrays; `None` for content of another kind.
///
/// Error: [`DataError::Table`] for arrays that do not match the table above, and those of reading.
pub(crate) fn read(path: &Path) -> Result<Option<Vec<ScenarioRollouts>>, DataError> {
    let head = stream::head(path, 8)?;
    #[cfg(feature = "parquet")]
    if head.starts_with(PARQUET) {
        return parquet(path).map(Some);
    }
    let is_npy = head.starts_with(NPY);
    if !is_npy && !head.starts_with(ZIP) {
        return Ok(None);
    }
    let bytes = stream::content(path, "an array", MAX_BYTES)?;
    let found = if is_npy {
        npy(&bytes, path)
    } else {
        npz(&bytes)
    };
    let message = found.map_err(|wrong| wrong.at(path))?;
    Ok(Some(vec![message]))
}

/// A mismatch between the expected and the actual content.
#[derive(Debug, PartialEq)]
struct Wrong {
    expected: String,
    found: String,
}

impl Wrong {
    fn new(expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self {
            expected: expected.into(),
            found: found.into(),
        }
    }

    fn at(self, path: &Path) -> DataError {
        DataError::Table {
            expected: self.expected,
            found: self.found,
            path: path.into(),
        }
    }
}

/// A NumPy array.
#[derive(Debug, PartialEq)]
struct NpyArray {
    shape: Vec<usize>,
    values: Values,
}

#[derive(Debug, PartialEq)]
enum Values {
    Numbers(Vec<f64>),
    Text(Vec<String>),
}

impl NpyArray {
    /// Reads an `.npy` file.
    fn parse(bytes: &[u8]) -> Result<Self, Wrong> {
        let cut = || Wrong::new("a whole array", "a file that ends early");
        let version = *bytes.get(NPY.len()).ok_or_else(cut)?;
        let (start, length) = if version == 1 {
            let length = bytes.get(8..10).and_then(|b| b.first_chunk());
            (10, u16::from_le_bytes(*length.ok_or_else(cut)?).into())
        } else {
            let length = bytes.get(8..12).and_then(|b| b.first_chunk());
            (12, u32::from_le_bytes(*length.ok_or_else(cut)?) as usize)
        };
        let header = bytes.get(start..start + length).ok_or_else(cut)?;
        let header = String::from_utf8_lossy(header);
        let (kind, shape) = described(&header)
            .ok_or_else(|| Wrong::new("the header of an array in C order", header.trim()))?;
        let n = shape
            .iter()
            .try_fold(1_usize, |n, &axis| n.checked_mul(axis));
        let data = &bytes[start + length..];
        let values = Values::parse(kind, n.ok_or_else(cut)?, data)?;
        Ok(Self { shape, values })
    }

    fn numbers(&self, name: &str) -> Result<&[f64], Wrong> {
        match &self.values {
            Values::Numbers(numbers) => Ok(numbers),
            Values::Text(_) => Err(Wrong::new(format!("numbers in {name}"), "text")),
        }
    }
}

/// The kind of the values and the lengths of the axes that a header states; `None` if it is none, or
/// of an array in Fortran's order.
fn described(header: &str) -> Option<(&str, Vec<usize>)> {
    let after = |key: &str| {
        let (_, rest) = header.split_once(key)?;
        Some(rest.trim_start_matches(['\'', '"', ':', ' ']))
    };
    let kind = after("descr")?.split(['\'', '"']).next()?;
    if !after("fortran_order")?.starts_with("False") {
        return None;
    }
    let (axes, _) = after("shape")?.strip_prefix('(')?.split_once(')')?;
    let axes = axes
        .split(',')
        .map(str::trim)
        .filter(|axis| !axis.is_empty());
    let axes = axes.map(|axis| axis.parse().ok());
    Some((kind, axes.collect::<Option<_>>()?))
}

impl Values {
    fn parse(kind: &str, n: usize, data: &[u8]) -> Result<Self, Wrong> {
        let numbers = |size: usize, of: fn(&[u8]) -> Option<f64>| {
            let found = data.chunks_exact(size).take(n).map_while(of);
            let found: Vec<f64> = found.collect();
            match found.len() == n {
                true => Ok(Self::Numbers(found)),
                false => Err(Wrong::new(
                    format!("{n} values"),
                    format!("{} before the end", found.len()),
                )),
            }
        };
        macro_rules! little_endian {
            ($kind:ty) => {
                numbers(size_of::<$kind>(), |bytes| {
                    Some(<$kind>::from_le_bytes(*bytes.first_chunk()?) as f64)
                })
            };
        }
        match kind {
            "<f8" => little_endian!(f64),
            "<f4" => little_endian!(f32),
            "<i8" => little_endian!(i64),
            "<i4" => little_endian!(i32),
            "<u8" => little_endian!(u64),
            "<u4" => little_endian!(u32),
            _ => match kind
                .strip_prefix("<U")
                .and_then(|n| n.parse::<usize>().ok())
            {
                Some(letters) if letters > 0 && data.len() / 4 / letters >= n => {
                    let words = data.chunks_exact(4 * letters).take(n);
                    Ok(Self::Text(words.map(word).collect()))
                }
                _ => Err(Wrong::new("values of 32 or 64 bits, or text", kind)),
            },
        }
    }
}

/// Text of four bytes a letter, filled up with zeros.
fn word(bytes: &[u8]) -> String {
    let codes = bytes
        .as_chunks::<4>()
        .0
        .iter()
        .copied()
        .map(u32::from_le_bytes);
    codes
        .take_while(|code| *code != 0)
        .filter_map(char::from_u32)
        .collect()
}

/// The members of a ZIP file by name.
fn members(bytes: &[u8]) -> Result<BTreeMap<String, Vec<u8>>, Wrong> {
    let damaged = || Wrong::new("a ZIP file", "damage");
    let number = |at: usize, n: usize| {
        let bytes = bytes.get(at..at.checked_add(n)?)?.iter().rev();
        Some(bytes.fold(0_usize, |number, byte| number << 8 | usize::from(*byte)))
    };
    // The directory is at the end, after which only a comment may come.
    let last = bytes.len().checked_sub(22).ok_or_else(damaged)?;
    let mut end = (last.saturating_sub(1 << 16)..=last).rev();
    let end = end.find(|&at| bytes[at..].starts_with(b"PK\x05\x06"));
    let end = end.ok_or_else(damaged)?;
    let n_members = number(end + 10, 2).ok_or_else(damaged)?;
    let mut at = number(end + 16, 4).ok_or_else(damaged)?;
    let mut members = BTreeMap::new();
    for _ in 0..n_members {
        let field = |offset: usize, n: usize| number(at + offset, n).ok_or_else(damaged);
        let (method, packed, unpacked) = (field(10, 2)?, field(20, 4)?, field(24, 4)?);
        let (n_name, n_extra, n_comment) = (field(28, 2)?, field(30, 2)?, field(32, 2)?);
        let local = field(42, 4)?;
        let name = bytes.get(at + 46..at + 46 + n_name).ok_or_else(damaged)?;
        let skip = |offset: usize| number(local + offset, 2).ok_or_else(damaged);
        let start = local + 30 + skip(26)? + skip(28)?;
        let content = bytes.get(start..start + packed).ok_or_else(damaged)?;
        let content = match method {
            0 => content.to_vec(),
            8 => {
                let mut out = Vec::new();
                let mut decoder = DeflateDecoder::new(content).take(unpacked as u64);
                decoder.read_to_end(&mut out).map_err(|_| damaged())?;
                out
            }
            found => {
                return Err(Wrong::new(
                    "members of a ZIP file that are stored or deflated",
                    format!("method {found}"),
                ));
            }
        };
        if content.len() != unpacked {
            return Err(damaged());
        }
        members.insert(String::from_utf8_lossy(name).into_owned(), content);
        at += 46 + n_name + n_extra + n_comment;
    }
    Ok(members)
}

fn npz(bytes: &[u8]) -> Result<ScenarioRollouts, Wrong> {
    let members = members(bytes)?;
    let array = |name: &str| {
        let member = members.get(&format!("{name}.npy"));
        let names = || members.keys().cloned().collect::<Vec<_>>().join(", ");
        let member = member.ok_or_else(|| {
            Wrong::new(format!("an array {name}"), format!("those of {}", names()))
        })?;
        NpyArray::parse(member)
    };
    let id = match array("scenario_id")?.values {
        Values::Text(words) => words.into_iter().next().unwrap_or_default(),
        Values::Numbers(_) => return Err(Wrong::new("text in scenario_id", "numbers")),
    };
    let agents = array("agent_id")?;
    let ids: Vec<i64> = agents
        .numbers("agent_id")?
        .iter()
        .map(|&id| id as i64)
        .collect();
    let states = array("states")?;
    let [n_futures, n_agents, n_steps, 4] = states.shape[..] else {
        return Err(Wrong::new(
            "states of shape [R, A, T, 4]",
            format!("{:?}", states.shape),
        ));
    };
    let axes = Axes {
        lengths: [n_futures, n_steps, n_agents],
        strides: [n_agents * n_steps * 4, 4, n_steps * 4],
        columns: [Some(0), Some(1), Some(2), Some(3)],
    };
    rollouts(id, &ids, states.numbers("states")?, &axes)
}

/// The JSON file that describes an `.npy` file, as far as [`crate::submission`] reads it.
#[derive(Deserialize)]
struct Explanation {
    scenario: String,
    axes: Vec<String>,
    numbers: Vec<String>,
    agents: Vec<ExplainedAgent>,
}

#[derive(Deserialize)]
struct ExplainedAgent {
    id: i64,
}

fn npy(bytes: &[u8], path: &Path) -> Result<ScenarioRollouts, Wrong> {
    let array = NpyArray::parse(bytes)?;
    let beside = path.with_extension("json");
    let name = beside.file_name().unwrap_or_default().to_string_lossy();
    let expected = format!("{name} beside it, with scenario, axes, numbers and agents");
    let text =
        std::fs::read(&beside).map_err(|error| Wrong::new(expected.clone(), error.to_string()))?;
    let explained: Explanation = serde_json::from_slice(&text)
        .map_err(|error| Wrong::new(expected.clone(), error.to_string()))?;
    let axis = |name: &str| {
        let place = explained.axes.iter().position(|axis| axis == name);
        place.filter(|_| explained.axes.len() == array.shape.len())
    };
    let wanted = ["future", "step", "agent", "number"].map(axis);
    let [Some(future), Some(step), Some(agent), Some(number)] = wanted else {
        return Err(Wrong::new(
            "the axes future, step, agent and number",
            format!(
                "{:?} of an array of shape {:?}",
                explained.axes, array.shape
            ),
        ));
    };
    let stride = |axis: usize| array.shape[axis + 1..].iter().product::<usize>();
    let column = |name: &str| explained.numbers.iter().position(|number| number == name);
    let columns = ["x", "y", "z", "heading"].map(column);
    let columns = columns.map(|column| Some(column? * stride(number)));
    let [Some(_), Some(_), _, Some(_)] = columns else {
        let found = format!("{:?}", explained.numbers);
        return Err(Wrong::new("the numbers x, y and heading", found));
    };
    if explained.numbers.len() != array.shape[number] {
        let expected = format!("{} numbers", explained.numbers.len());
        return Err(Wrong::new(expected, array.shape[number].to_string()));
    }
    let ids: Vec<i64> = explained.agents.iter().map(|agent| agent.id).collect();
    let axes = Axes {
        lengths: [future, step, agent].map(|axis| array.shape[axis]),
        strides: [future, step, agent].map(stride),
        columns,
    };
    rollouts(explained.scenario, &ids, array.numbers("it")?, &axes)
}

/// The layout of an array.
struct Axes {
    /// Futures, steps, agents.
    lengths: [usize; 3],
    strides: [usize; 3],
    /// Offsets of x, y, z and heading; `None` for heights that are not stated.
    columns: [Option<usize>; 4],
}

fn rollouts(
    scenario_id: String,
    ids: &[i64],
    numbers: &[f64],
    axes: &Axes,
) -> Result<ScenarioRollouts, Wrong> {
    let [n_futures, n_steps, n_agents] = axes.lengths;
    if ids.len() != n_agents {
        let expected = format!("ids of {n_agents} agents");
        return Err(Wrong::new(expected, ids.len().to_string()));
    }
    let mut joint_scenes = Vec::with_capacity(n_futures);
    for future in 0..n_futures {
        let mut scene = JointScene::default();
        for (agent, &id) in ids.iter().enumerate() {
            let start = future * axes.strides[0] + agent * axes.strides[2];
            let states = (0..n_steps).map(|step| {
                let start = start + step * axes.strides[1];
                axes.columns.map(|column| Some(numbers[start + column?]))
            });
            scene.simulated_trajectories.extend(trajectory(id, states)?);
        }
        joint_scenes.push(scene);
    }
    Ok(ScenarioRollouts {
        scenario_id: Some(scenario_id),
        joint_scenes,
    })
}

/// One agent's x, y, z (if stated) and heading; `None` if it is not there in the first step.
fn trajectory(
    id: i64,
    states: impl Iterator<Item = [Option<f64>; 4]>,
) -> Result<Option<SimulatedTrajectory>, Wrong> {
    let object_id = i32::try_from(id).map_err(|_| Wrong::new("ids of 32 bits", id.to_string()))?;
    let mut drive = SimulatedTrajectory {
        object_id: Some(object_id),
        ..SimulatedTrajectory::default()
    };
    let mut last = None;
    for state in states {
        if !state.iter().flatten().any(|number| number.is_nan()) {
            last = Some(state);
        }
        let Some([x, y, z, heading]) = last else {
            return Ok(None);
        };
        let columns = [
            (&mut drive.center_x, x),
            (&mut drive.center_y, y),
            (&mut drive.center_z, z),
            (&mut drive.heading, heading),
        ];
        for (column, number) in columns {
            column.extend(number.map(|number| number as f32));
        }
    }
    Ok(Some(drive))
}

/// The rollouts of a table of futures, which is sorted by scenario, rollout, track and step.
#[cfg(feature = "parquet")]
fn parquet(path: &Path) -> Result<Vec<ScenarioRollouts>, DataError> {
    let table = table::parquet(path)?;
    let scenarios = table.texts("scenario_id", path)?;
    let [futures, steps, tracks] =
        ["rollout", "step", "track_id"].map(|name| table.integers(name, path));
    let (futures, steps, tracks) = (futures?, steps?, tracks?);
    let [x, y, z, heading] = ["x", "y", "z", "heading"].map(|name| table.numbers(name, path));
    let columns = [x?, y?, z?, heading?];
    let rows: Vec<usize> = (0..table.n_rows).filter(|&row| steps[row] > 0).collect();
    let same = |a: &usize, b: &usize| {
        (&scenarios[*a], futures[*a], tracks[*a]) == (&scenarios[*b], futures[*b], tracks[*b])
    };
    let mut messages: Vec<ScenarioRollouts> = Vec::new();
    let mut last_future = -1;
    for own in rows.chunk_by(same) {
        let Some(&row) = own.first() else {
            continue;
        };
        let id = &scenarios[row];
        if messages.last().is_none_or(|m| m.scenario_id() != id) {
            messages.push(ScenarioRollouts {
                scenario_id: Some(id.clone()),
                joint_scenes: Vec::new(),
            });
            last_future = -1;
        }
        let states = own
            .iter()
            .map(|&row| columns.each_ref().map(|column| Some(column[row])));
        let drive = trajectory(tracks[row], states).map_err(|wrong| wrong.at(path))?;
        if let Some(message) = messages.last_mut() {
            if futures[row] != last_future {
                message.joint_scenes.push(JointScene::default());
                last_future = futures[row];
            }
            if let Some(scene) = message.joint_scenes.last_mut() {
                scene.simulated_trajectories.extend(drive);
            }
        }
    }
    Ok(messages)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An array of version 1 as NumPy writes it.
    fn written(kind: &str, shape: &str, data: &[u8]) -> Vec<u8> {
        let header =
            format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}\n");
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    fn numbers(values: &[f64]) -> Vec<u8> {
        values.iter().flat_map(|v| v.to_le_bytes()).collect()
    }

    #[test]
    fn arrays_of_every_kind_are_read() {
        let check = |kind: &str, data: &[u8], expected: Values| {
            let array = NpyArray::parse(&written(kind, "2,", data)).unwrap();
            assert_eq!((array.shape, array.values), (vec![2], expected), "{kind}");
        };
        let both = || Values::Numbers(vec![1.0, -2.0]);
        check("<f8", &numbers(&[1.0, -2.0]), both());
        let single: Vec<u8> = [1.0_f32, -2.0]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
        check("<f4", &single, both());
        let whole: Vec<u8> = [1_i64, -2].iter().flat_map(|v| v.to_le_bytes()).collect();
        check("<i8", &whole, both());
        let letters = ['a', 'b', 'c', '\0'].map(u32::from);
        let letters: Vec<u8> = letters.iter().flat_map(|v| v.to_le_bytes()).collect();
        check("<U2", &letters, Values::Text(vec!["ab".into(), "c".into()]));
    }

    #[test]
    fn what_is_no_array_is_refused() {
        let refused = |bytes: &[u8]| NpyArray::parse(bytes).unwrap_err().found;
        assert_eq!(refused(NPY), "a file that ends early");
        assert_eq!(refused(&written("<f8", "2,", &[0; 15])), "1 before the end");
        assert_eq!(refused(&written("|O", "1,", &[0; 8])), "|O");
        let huge = "18446744073709551615, 9,";
        assert_eq!(
            refused(&written("<f8", huge, &[])),
            "a file that ends early"
        );
        let fortran = String::from_utf8_lossy(&written("<f8", "1,", &[])).replace("False", "True ");
        assert!(described(&fortran).is_none());
    }

    #[test]
    fn the_absent_stay_where_they_were_and_the_late_are_left_out() {
        let nan = f64::NAN;
        // One future, two steps, three agents; x, y, z, heading.
        let there = [1.0, 2.0, 3.0, 0.5, 4.0, 5.0, 6.0, 0.25];
        let leaves = [1.0, 1.0, 1.0, 1.0, nan, nan, nan, nan];
        let late = [nan, nan, nan, nan, 1.0, 1.0, 1.0, 1.0];
        let axes = Axes {
            lengths: [1, 2, 3],
            strides: [24, 4, 8],
            columns: [Some(0), Some(1), Some(2), Some(3)],
        };
        let all = [there, leaves, late].concat();
        let found = rollouts("s".into(), &[7, 8, 9], &all, &axes).unwrap();
        let agents = &found.joint_scenes[0].simulated_trajectories;
        let ids: Vec<i32> = agents.iter().map(SimulatedTrajectory::object_id).collect();
        assert_eq!(ids, [7, 8]);
        assert_eq!(agents[0].center_y, [2.0, 5.0]);
        assert_eq!(agents[1].heading, [1.0, 1.0]);
        let few = rollouts("s".into(), &[7], &all, &axes).unwrap_err();
        assert_eq!(few, Wrong::new("ids of 3 agents", "1"));
    }

    #[test]
    fn an_array_is_explained_by_what_lies_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("futures.npy");
        let bytes = written(
            "<f8",
            "1, 2, 1, 3",
            &numbers(&[0.5, 1.0, 2.0, 0.25, 3.0, 4.0]),
        );
        std::fs::write(&path, bytes).unwrap();
        let refused = || read(&path).unwrap_err().to_string();
        assert!(
            refused().contains("futures.json beside it"),
            "{}",
            refused()
        );
        let explain = |numbers: &str| {
            let text = format!(
                r#"{{"scenario": "s", "axes": ["future", "step", "agent", "number"],
                "numbers": {numbers}, "agents": [{{"id": 5}}], "dt": 0.1}}"#
            );
            std::fs::write(folder.path().join("futures.json"), text).unwrap();
        };
        explain(r#"["heading", "x", "y"]"#);
        let found = read(&path).unwrap().unwrap();
        let agent = &found[0].joint_scenes[0].simulated_trajectories[0];
        assert_eq!((found[0].scenario_id(), agent.object_id()), ("s", 5));
        assert_eq!(
            (&agent.center_x[..], &agent.heading[..]),
            (&[1.0, 3.0][..], &[0.5, 0.25][..])
        );
        assert!(agent.center_z.is_empty());
        explain(r#"["x", "y"]"#);
        assert!(
            refused().contains("expected the numbers x, y and heading"),
            "{}",
            refused()
        );
    }

    #[test]
    fn a_damaged_zip_is_refused() {
        for n in [0, 4, 30, 200] {
            let mut bytes = ZIP.to_vec();
            bytes.extend(vec![0x50; n]);
            assert!(npz(&bytes).is_err(), "{n}");
        }
    }
}
