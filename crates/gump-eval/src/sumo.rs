//! Finds and runs the external simulator SUMO.
//!
//! [`Sumo`] has the programs, the folders, and one run from a seed to scenes. The demand of a run
//! comes from `gump_synthesis`; `gump_data::sumo` reads its output.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;

use gump_data::ReadOptions;
use gump_data::sumo::{CutOptions, Demand, Network, Roads, open_on};
use gump_metrics::overlapping;
use gump_scene::{Agent, AgentKind, Scenario, Seed};
use gump_synthesis::{SumoDemand, draw_sumo_demand, smooth_motion, steer};
use rand::Rng as _;

use crate::{EvalError, SumoError};

/// Simulated seconds before the first window, so that queues have formed. Chosen by hand.
const WARMUP_S: f64 = 60.0;
/// Default length of a scene after its present, seconds: the horizon of Waymo's challenges.
pub const FUTURE_S: f64 = 8.0;
/// Windows per run: they share the time that the run warms up. Chosen by hand.
const WINDOWS: usize = 6;
/// Seconds between two windows, so that scenes of one run differ. Chosen by hand.
const PAUSE_S: f64 = 5.0;
/// Seconds between frames, as in the Waymo Open Motion Dataset.
const STEP_S: f64 = 0.1;

/// Lateral acceleration at which curves of junctions are driven, metres per second squared.
/// SUMO's default of 5.5 makes the yaw rates of a race; see docs/results/0006-factory.md.
const TURN_ACCELERATION: f64 = 2.2;
/// Highest speed of a SUMO pedestrian, metres per second: none of them runs, so more is a jump.
const FASTEST_WALK: f64 = 4.0;
/// Points of a curve through a junction; SUMO's default of 5 leaves corners. Chosen by eye.
const CURVE_POINTS: u32 = 12;

/// The programs of a SUMO installation.
#[derive(Clone, Debug)]
pub struct Sumo {
    programs: PathBuf,
    home: Option<PathBuf>,
}

/// A network to simulate on.
pub struct SumoNetwork {
    /// Its name in scene ids.
    pub name: String,
    file: PathBuf,
    network: Network,
    roads: Arc<Roads>,
}

impl Sumo {
    /// Looks for SUMO in `SUMO_HOME`, on the path, and among the packages of Python.
    ///
    /// # Errors
    /// [`SumoError::NotInstalled`], which says how to install it.
    pub fn find() -> Result<Self, EvalError> {
        let has = |folder: &Path| folder.join("sumo").is_file();
        if let Some(home) = std::env::var_os("SUMO_HOME").map(PathBuf::from) {
            let programs = home.join("bin");
            if has(&programs) {
                let home = Some(home);
                return Ok(Self { programs, home });
            }
        }
        let path = std::env::var_os("PATH").unwrap_or_default();
        if let Some(programs) = std::env::split_paths(&path).find(|folder| has(folder)) {
            let home = None;
            return Ok(Self { programs, home });
        }
        if let Some(home) = home_of_python_package() {
            let programs = home.join("bin");
            if has(&programs) {
                let home = Some(home);
                return Ok(Self { programs, home });
            }
        }
        Err(SumoError::NotInstalled.into())
    }

    /// The first line of `sumo --version`.
    ///
    /// # Errors
    /// SUMO cannot be started.
    pub fn version(&self) -> Result<String, EvalError> {
        let output = self.command("sumo").arg("--version").output();
        let output = output.map_err(|cause| EvalError::io("start", Path::new("sumo"), cause))?;
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        Ok(text.lines().next().unwrap_or_default().trim().to_owned())
    }

    /// Makes a network from a seed: a grid, a spider's web, or something irregular.
    ///
    /// # Errors
    /// SUMO cannot be started or fails.
    pub fn generate(&self, seed: Seed, folder: &Path) -> Result<SumoNetwork, EvalError> {
        let mut rng = seed.rng();
        let shape = ["grid", "spider", "random"][rng.random_range(0..3)];
        // Blocks, lanes, limits and shares of what a town may have, chosen by hand.
        let length = rng.random_range(90..190).to_string();
        let arms = rng.random_range(4..7).to_string();
        let mut arguments: Vec<&str> = match shape {
            "grid" => vec!["--grid", "--grid.number", "4", "--grid.length", &length],
            "spider" => vec![
                "--spider",
                "--spider.arm-number",
                &arms,
                "--spider.circle-number",
                "3",
                "--spider.space-radius",
                &length,
            ],
            _ => vec![
                "--rand",
                "--rand.iterations",
                "60",
                "--rand.min-distance",
                "80",
                "--rand.max-distance",
                &length,
            ],
        };
        let lanes = rng.random_range(1..4).to_string();
        let speed = ["11.11", "13.89", "16.67"][rng.random_range(0..3)];
        let control = ["traffic_light", "traffic_light", "priority", "allway_stop"];
        let control = control[rng.random_range(0..control.len())];
        arguments.extend(["--default.lanenumber", &lanes, "--default.speed", speed]);
        arguments.extend(["--default.junctions.type", control]);
        arguments.extend(["--default.junctions.radius", "7"]);
        arguments.extend(["--sidewalks.guess", "--crossings.guess"]);
        arguments.extend(["--perturb-x", "5", "--perturb-y", "5"]);
        if rng.random_bool(0.4) {
            arguments.push("--bikelanes.guess");
        }
        if lanes != "1" && control == "traffic_light" && rng.random_bool(0.5) {
            arguments.extend(["--turn-lanes", "1", "--turn-lanes.length", "40"]);
        }
        let file = folder.join("made.net.xml");
        let seed = (seed.0 % (1 << 31)).to_string();
        let mut command = self.command("netgenerate");
        command.args(arguments).args(["--seed", &seed]);
        run(curves(&mut command).arg("-o").arg(&file))?;
        SumoNetwork::read(format!("made-{shape}"), file)
    }

    /// Prepares a network for simulation: finer and slower curves through junctions.
    ///
    /// # Errors
    /// SUMO cannot be started, or does not understand the network.
    pub fn prepare(&self, network: &Path, folder: &Path) -> Result<SumoNetwork, EvalError> {
        let name = name_of(network);
        let file = folder.join(format!("{name}.net.xml"));
        let mut command = self.command("netconvert");
        command.arg("-s").arg(network);
        run(curves(&mut command).arg("-o").arg(&file))?;
        SumoNetwork::read(name, file)
    }

    /// Simulates once on a network and cuts scenes out, each with `future_s` seconds after its
    /// present; the same for the same seed. Their ids begin with `id`; `folder` is for files of the
    /// run and is removed at its end.
    ///
    /// # Errors
    /// SUMO cannot be started or fails, or its files cannot be written or read.
    pub fn scenes(
        &self,
        place: &SumoNetwork,
        demand: &SumoDemand,
        future_s: f64,
        seed: Seed,
        id: &str,
        folder: &Path,
    ) -> Result<Vec<Scenario>, EvalError> {
        std::fs::create_dir_all(folder)
            .map_err(|cause| EvalError::io("create the folder", folder, cause))?;
        let cut = CutOptions {
            pause_s: PAUSE_S,
            future_s,
            without_overlaps: true,
            seed: seed.fork(1),
            ..CutOptions::standard()
        };
        let window_s = cut.history_s + cut.future_s + PAUSE_S;
        let until_s = WARMUP_S + WINDOWS as f64 * window_s;
        let demand = SumoDemand {
            until_s,
            ..demand.clone()
        };
        let routes = folder.join("demand.rou.xml");
        draw_sumo_demand(&place.network, &demand, seed).write(&routes)?;
        let orders = folder.join("signals.add.xml");
        let systems = place.network.signal_systems();
        // SUMO resolves the path relative to the folder of the orders.
        Demand::write_signal_log(&systems, "states.xml", &orders)?;
        let cars = folder.join(format!("{id}.fcd.xml"));
        let mut command = self.command("sumo");
        command
            .arg("-n")
            .arg(&place.file)
            .arg("-r")
            .arg(&routes)
            .arg("-a")
            .arg(&orders);
        command.arg("--fcd-output").arg(&cars);
        command.args([
            "--fcd-output.attributes",
            "x,y,angle,type",
            "--precision",
            "3",
        ]);
        command.args(["--step-length", &STEP_S.to_string()]);
        command.args(["--device.fcd.begin", &WARMUP_S.to_string()]);
        command.args(["--end", &until_s.to_string()]);
        command.args(["--seed", &(seed.0 % (1 << 31)).to_string()]);
        // Half lanes side by side: smooth lane changes, cars pass bicycles within a lane.
        command.args(["--lateral-resolution", "0.8", "--ignore-route-errors"]);
        command.args(["--time-to-teleport", "-1", "--collision.action", "none"]);
        command.args([
            "--no-step-log",
            "--no-warnings",
            "--xml-validation",
            "never",
        ]);
        run(&mut command)?;
        let mut scenes = Vec::new();
        for record in open_on(&cars, Arc::clone(&place.roads), cut, ReadOptions::ALL)? {
            let mut scene = record?.scenario;
            smooth_motion(&mut scene);
            if demand.steered {
                steer(&mut scene);
            }
            if is_odd(&scene) {
                continue;
            }
            scene.tags = gump_metrics::tags::extract_tags(&scene);
            scenes.push(scene);
        }
        std::fs::remove_dir_all(folder).map_err(|cause| EvalError::io("remove", folder, cause))?;
        Ok(scenes)
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(self.programs.join(program));
        if let Some(home) = &self.home {
            command.env("SUMO_HOME", home);
        }
        command.stdin(Stdio::null());
        command
    }
}

impl SumoNetwork {
    fn read(name: String, file: PathBuf) -> Result<Self, EvalError> {
        let network = Network::read(&file)?;
        let roads = Arc::new(Roads::new(&network));
        Ok(Self {
            name,
            file,
            network,
            roads,
        })
    }
}

/// Whether boxes overlap at the present or a pedestrian jumps, as SUMO's pedestrians sometimes do
/// where sidewalks end.
fn is_odd(scene: &Scenario) -> bool {
    let present = scene.present().now();
    let mut agents = present.agents().iter();
    let overlaps = agents.any(|agent| overlapping(present, agent).next().is_some());
    let jumps =
        |agent: &Agent| agent.kind == AgentKind::Pedestrian && agent.state.speed() > FASTEST_WALK;
    let mut log = scene.log.iter().flat_map(|frame| frame.agents());
    overlaps || log.any(jumps)
}

/// The networks of a file or folder, in the order of their paths.
///
/// # Errors
/// A folder that cannot be listed or holds no network.
pub fn networks(path: &Path) -> Result<Vec<PathBuf>, EvalError> {
    let mut found = Vec::new();
    if path.is_dir() {
        list(path, &mut found)?;
        found.sort();
    } else {
        if !path.is_file() {
            let path = path.to_owned();
            return Err(SumoError::NoNetwork { path }.into());
        }
        found.push(path.to_owned());
    }
    if found.is_empty() {
        let folder = path.to_owned();
        return Err(SumoError::NoNetworks { folder }.into());
    }
    Ok(found)
}

fn list(folder: &Path, found: &mut Vec<PathBuf>) -> Result<(), EvalError> {
    let cannot = |cause| EvalError::io("list", folder, cause);
    for entry in std::fs::read_dir(folder).map_err(cannot)? {
        let path = entry.map_err(cannot)?.path();
        let name = path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        if path.is_dir() {
            list(&path, found)?;
        } else if name.ends_with(".net.xml") || name.ends_with(".net.xml.gz") {
            found.push(path);
        }
    }
    Ok(())
}

/// Name of a network: that of its file, or of its folder if the file's name says nothing.
fn name_of(network: &Path) -> String {
    let stem = |path: &Path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.split('.').next().unwrap_or_default().replace('_', "-")
    };
    let name = stem(network);
    match network.parent() {
        Some(folder) if ["net", "network", "osm", "map"].contains(&name.as_str()) => stem(folder),
        _ => name,
    }
}

fn curves(command: &mut Command) -> &mut Command {
    command.args([
        "--junctions.limit-turn-speed",
        &TURN_ACCELERATION.to_string(),
    ]);
    command.args([
        "--junctions.internal-link-detail",
        &CURVE_POINTS.to_string(),
    ]);
    command.args(["--no-turnarounds.except-deadend", "--no-warnings"]);
    command.args(["--xml-validation", "never"])
}

/// Runs a program to its end.
///
/// Error: it cannot be started, or fails; then with the last line it wrote.
fn run(command: &mut Command) -> Result<(), EvalError> {
    let program = command.get_program().to_string_lossy().into_owned();
    let output = command
        .output()
        .map_err(|cause| EvalError::io("start", Path::new(&program), cause))?;
    if output.status.success() {
        return Ok(());
    }
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    let lines: Vec<_> = stderr
        .lines()
        .filter(|line| line.contains("rror"))
        .collect();
    Err(SumoError::Failed {
        program,
        status: output.status,
        stderr: lines.join(" "),
    }
    .into())
}

fn home_of_python_package() -> Option<PathBuf> {
    let output = Command::new("python3")
        .args(["-c", "import sumo; print(sumo.SUMO_HOME)"])
        .stdin(Stdio::null())
        .output()
        .ok()?;
    let home = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    (output.status.success() && !home.is_empty()).then(|| PathBuf::from(home))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn networks_are_named_after_what_tells_them_apart() {
        let check = |path: &str, expected| assert_eq!(name_of(Path::new(path)), expected);
        check("a/acosta_buslanes.net.xml.gz", "acosta-buslanes");
        check(
            "a/berlin_doerpfeldstr/net.net.xml.gz",
            "berlin-doerpfeldstr",
        );
        check("i80.net.xml", "i80");
    }

    #[test]
    fn a_folder_without_networks_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let error = networks(folder.path()).unwrap_err().to_string();
        assert!(error.contains("found none"), "{error}");
    }
}
