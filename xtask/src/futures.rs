//! Futures as files, an array for analysis and a picture; and how many can be meant.

use std::io::Write as _;
use std::path::Path;

use anyhow::Context as _;
use gump_eval::digest::numbers;
use gump_scene::{Agent, AgentId, Rollout, Scenario};
use gump_viz::{Camera, Picture, PictureSpec, draw_futures};
use serde_json::json;

use crate::cli::WrongArguments;
use crate::machine;

/// The most futures of a scene: the challenges ask for 32.
const MOST_FUTURES: usize = 65_536;
/// Bytes of a future per step and agent: 512 futures of 8 s of 47 agents take 344 MB.
const BYTES_PER_STATE: f64 = 180.0;

/// Refuses numbers of futures and of seconds that cannot be meant.
///
/// Error: [`WrongArguments`].
pub(crate) fn check(n_futures: usize, seconds: f64) -> Result<(), WrongArguments> {
    // A step of a recording at least, and at most an hour.
    if !(0.1..=3600.0).contains(&seconds) {
        return Err(WrongArguments(format!(
            "--seconds: expected a number from 0.1 to 3600, found {seconds}"
        )));
    }
    check_number("--futures", n_futures)
}

/// Refuses numbers of futures that cannot be meant.
///
/// Error: [`WrongArguments`].
pub(crate) fn check_number(flag: &str, n_futures: usize) -> Result<(), WrongArguments> {
    match n_futures > MOST_FUTURES {
        true => Err(WrongArguments(format!(
            "{flag}: expected at most {MOST_FUTURES}, found {n_futures}"
        ))),
        false => Ok(()),
    }
}

/// Refuses more futures of a scene than the memory of the machine holds; they are in memory until they
/// are written.
///
/// Error: [`WrongArguments`].
pub(crate) fn check_memory(
    scenario: &Scenario,
    n_futures: usize,
    seconds: f64,
) -> Result<(), WrongArguments> {
    match machine::memory_bytes() {
        Some(memory) => check_fits(scenario, n_futures, seconds, memory),
        None => Ok(()),
    }
}

fn check_fits(
    scenario: &Scenario,
    n_futures: usize,
    seconds: f64,
    memory: f64,
) -> Result<(), WrongArguments> {
    let n_agents = scenario.present().now().agents().len();
    let steps = (seconds / scenario.dt).round().max(1.0);
    let bytes = BYTES_PER_STATE * n_agents as f64 * steps;
    let most = (memory / bytes.max(1.0)).floor();
    if n_futures as f64 <= most {
        return Ok(());
    }
    Err(WrongArguments(format!(
        "--futures: expected at most {most}, which the {:.0} GB of this machine hold of {seconds} s \
         of {n_agents} agents, found {n_futures}",
        memory / 1e9
    )))
}

/// Most numbers of an array: half a gigabyte. Agents that come and leave have a column each, so that an
/// hour of traffic at 10 Hz would be four.
const MOST_NUMBERS: usize = 1 << 26;

/// Writes `futures.npy`, shape [future, step, agent, number], and `futures.json`, which says what
/// the rows are. Of long futures with many agents it has every k-th step only, and k is returned.
///
/// Numbers are x, y, heading, vx, vy in the world frame as f64; an absent agent is NaN.
pub(crate) fn save_array(
    folder: &Path,
    scenario: &Scenario,
    rollouts: &[Rollout],
) -> anyhow::Result<usize> {
    save_thinned(folder, scenario, rollouts, MOST_NUMBERS)
}

fn save_thinned(
    folder: &Path,
    scenario: &Scenario,
    rollouts: &[Rollout],
    most: usize,
) -> anyhow::Result<usize> {
    let agents = agents(rollouts);
    let steps = rollouts.first().map_or(0, Rollout::steps);
    let whole = rollouts.len() * steps * agents.len() * 5;
    let every = whole.div_ceil(most).max(1);
    let shape = [rollouts.len(), steps / every, agents.len(), 5];
    let path = folder.join("futures.npy");
    gump_data::write_atomically(&path, |file| {
        let mut write = |bytes: &[u8]| {
            file.write_all(bytes)
                .with_context(|| format!("cannot write {}", path.display()))
        };
        write(&npy_header(shape))?;
        let kept = |rollout| Rollout::imagined(rollout).chunks_exact(every);
        for frame in rollouts.iter().flat_map(kept).filter_map(<[_]>::last) {
            for agent in &agents {
                let numbers = frame.agent(agent.id).map_or([f64::NAN; 5], numbers);
                for number in numbers {
                    write(&number.to_le_bytes())?;
                }
            }
        }
        anyhow::Ok(())
    })?;
    let index = json!({
        "scenario": scenario.id,
        "axes": ["future", "step", "agent", "number"],
        "shape": shape,
        "numbers": ["x", "y", "heading", "vx", "vy"],
        "dt": scenario.dt * every as f64,
        "ego": scenario.ego.0,
        "agents": agents.iter().map(|agent| json!({
            "id": agent.id.0,
            "class": agent.kind.name(),
            "length": agent.length,
            "width": agent.width,
        })).collect::<Vec<_>>(),
    });
    let path = folder.join("futures.json");
    gump_data::write_atomically(&path, |file| {
        serde_json::to_writer_pretty(file, &index)
            .with_context(|| format!("cannot write {}", path.display()))
    })?;
    Ok(every)
}

/// Every agent of any frame, by id, as it is first seen.
fn agents(rollouts: &[Rollout]) -> Vec<Agent> {
    let frames = rollouts
        .iter()
        .flat_map(|rollout| std::iter::once(rollout.start()).chain(rollout.imagined()));
    let mut agents: std::collections::BTreeMap<AgentId, Agent> = std::collections::BTreeMap::new();
    for agent in frames.flat_map(|frame| frame.agents()) {
        agents.entry(agent.id).or_insert(*agent);
    }
    agents.into_values().collect()
}

/// Version 1.0 of NumPy's format: magic, version, length, a Python dictionary, padding to 64.
fn npy_header(shape: [usize; 4]) -> Vec<u8> {
    let [a, b, c, d] = shape;
    let mut text =
        format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({a}, {b}, {c}, {d}), }}");
    let unpadded = 10 + text.len() + 1;
    text.push_str(&" ".repeat(unpadded.next_multiple_of(64) - unpadded));
    text.push('\n');
    let mut header = b"\x93NUMPY\x01\x00".to_vec();
    header.extend((text.len() as u16).to_le_bytes());
    header.extend(text.as_bytes());
    header
}

/// The scene now, with a trail for every agent and future.
pub(crate) fn picture(scenario: &Scenario, rollouts: &[Rollout], label: &str) -> Picture {
    let scene = scenario.present();
    let spec = PictureSpec {
        legend: true,
        ..PictureSpec::new(Camera::on_ego(&scene, 120.0, 1000, 1000)).with_label(label)
    };
    let futures: Vec<_> = rollouts.iter().map(Rollout::imagined).collect();
    draw_futures(&scene, &futures, &spec)
}

#[cfg(test)]
mod tests {
    use gump_viz::log_as_rollout;

    use super::*;

    fn rollouts() -> (Scenario, Vec<Rollout>) {
        let scenario = gump_scene::fixture::scenario(
            "ego vehicle 0: 0,0 velocity 5,0\nagent pedestrian 3: 9,9\nhistory 1 future 2 dt 0.1",
        )
        .unwrap();
        let log = log_as_rollout(&scenario);
        (scenario, vec![log; 2])
    }

    #[test]
    fn futures_beyond_the_memory_of_a_machine_are_refused() {
        let (scenario, _) = rollouts();
        // Two agents for two seconds: 7,200 bytes a future.
        assert!(check_fits(&scenario, 100, 2.0, 1e6).is_ok());
        let error = check_fits(&scenario, 200, 2.0, 1e6)
            .unwrap_err()
            .to_string();
        assert!(
            error.starts_with("--futures: expected at most 138, "),
            "{error}"
        );
        assert!(error.ends_with("of 2 s of 2 agents, found 200"), "{error}");
        assert!(check(MOST_FUTURES, 8.0).is_ok() && check(1, 0.0).is_err());
        assert!(check(MOST_FUTURES + 1, 8.0).is_err() && check(1, f64::NAN).is_err());
    }

    #[test]
    fn the_array_has_the_shape_it_states() {
        let (scenario, rollouts) = rollouts();
        let folder = tempfile::tempdir().unwrap();
        save_array(folder.path(), &scenario, &rollouts).unwrap();
        let bytes = std::fs::read(folder.path().join("futures.npy")).unwrap();
        let header = npy_header([2, 20, 2, 5]);
        assert_eq!(header.len() % 64, 0);
        assert!(bytes.starts_with(&header));
        assert_eq!(bytes.len(), header.len() + 2 * 20 * 2 * 5 * 8);
        // The ego after one step of 0.1 s at 5 m/s.
        let x = f64::from_le_bytes(bytes[header.len()..][..8].try_into().unwrap());
        assert!((x - 0.5).abs() < 1e-9, "{x}");

        // 400 numbers, at most 150: every third of twenty steps.
        let every = save_thinned(folder.path(), &scenario, &rollouts, 150).unwrap();
        let bytes = std::fs::read(folder.path().join("futures.npy")).unwrap();
        let header = npy_header([2, 6, 2, 5]);
        assert!(every == 3 && bytes.starts_with(&header));
        assert_eq!(bytes.len(), header.len() + 2 * 6 * 2 * 5 * 8);
        let x = f64::from_le_bytes(bytes[header.len()..][..8].try_into().unwrap());
        assert!((x - 1.5).abs() < 1e-9, "{x}");
        let index = std::fs::read_to_string(folder.path().join("futures.json")).unwrap();
        let index: serde_json::Value = serde_json::from_str(&index).unwrap();
        assert!((index["dt"].as_f64().unwrap() - 0.3).abs() < 1e-9);
    }
}
