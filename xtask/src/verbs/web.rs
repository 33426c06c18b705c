//! `web`: the page that lets one drive inside the learned world, as static files.
//!
//! The output is in `docs/live` and is committed, so that it can be served as it is. The page's
//! sources are `crates/gump-web/page` and a script of the viewer of `gump-viz`, copied unchanged; a
//! test of `gump-web` compares them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::Context as _;
use gump_data::womd;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::machine::repository;
use crate::run::{Common, Run};

/// Target that the engine of the page is compiled for.
const TARGET: &str = "wasm32-unknown-unknown";
/// The version of `wasm-bindgen` in the workspace; the command must have the same.
const BINDGEN: &str = "0.2.130";
/// Maximum size of the page, bytes: the goal of docs/results/0022-live-page.md.
const MOST: u64 = 12_000_000;
/// Script that draws roads and agents, shared with the pages of `gump-viz`.
const DRAWING: &str = "crates/gump-viz/src/traffic.js";
/// The list of scenes; the page gets its contents through the manifest.
const SCENES: &str = "scenes.json";

/// Arguments of `web`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    /// Keep the existing engine; copy only the page, the weights and the scenes.
    #[arg(long)]
    keep_engine: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// A scene of the page.
#[derive(Deserialize)]
struct Scene {
    id: String,
    /// A file of `datasets/mini`.
    file: String,
    /// Index of the scene in the file.
    index: usize,
    title: String,
    /// Source of the scene; by default the notice of its file.
    notice: Option<String>,
}

/// The parts of the mini set's manifest that the page passes on.
#[derive(Deserialize)]
struct Mini {
    file: Vec<MiniFile>,
}

#[derive(Deserialize)]
struct MiniFile {
    path: String,
    licence: Option<String>,
    notice: Option<String>,
}

/// `manifest.json` of the page.
#[derive(Serialize)]
struct Manifest {
    weights: Listed,
    scenes: Vec<ListedScene>,
}

#[derive(Serialize)]
struct Listed {
    file: String,
    bytes: u64,
    sha256: String,
}

#[derive(Serialize)]
struct ListedScene {
    id: String,
    title: String,
    licence: String,
    notice: String,
    #[serde(flatten)]
    listed: Listed,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let root = repository();
        let live = root.join("docs/live");
        let engine = live.join("engine");
        if self.keep_engine {
            anyhow::ensure!(
                engine.join("gump_web_bg.wasm").is_file(),
                "expected an engine to keep in {}, found none: run `cargo xtask web`",
                engine.display()
            );
        } else {
            run.phase("engine", |_| build(&root, &engine))?;
        }
        run.phase("page", |_| copy_page(&root, &live))?;
        let manifest = run.phase("scenes", |_| scenes(&root, &live))?;
        let text = serde_json::to_string_pretty(&manifest)? + "\n";
        write(&live.join("manifest.json"), text.as_bytes())?;
        let bytes = weigh(&live)?;
        run.print(&format!(
            "{}: {:.1} MB, {} scenes; serve it with any server, `python3 -m http.server -d docs/live` say",
            live.display(),
            bytes as f64 / 1e6,
            manifest.scenes.len()
        ));
        run.result("bytes", bytes)?;
        run.result("engine_bytes", weigh(&engine)?)?;
        run.result("scenes", manifest.scenes.len())?;
        anyhow::ensure!(
            bytes <= MOST,
            "expected a page of at most {} MB, found {:.1} MB",
            MOST / 1_000_000,
            bytes as f64 / 1e6
        );
        Ok(())
    }
}

/// Compiles the engine for browsers and binds it to JavaScript.
fn build(root: &Path, engine: &Path) -> anyhow::Result<()> {
    check_tools()?;
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    command
        .args([
            "build",
            "--locked",
            "-p",
            "gump-web",
            "--lib",
            "--release",
            "--target",
            TARGET,
        ])
        .current_dir(root)
        .env("RUSTFLAGS", "-C target-feature=+simd128");
    finish(&mut command, "cargo build")?;
    let target = std::env::var_os("CARGO_TARGET_DIR");
    let target = target.map_or_else(|| root.join("target"), PathBuf::from);
    let program = target.join(TARGET).join("release/gump_web.wasm");
    make_empty(engine)?;
    let mut command = Command::new("wasm-bindgen");
    command
        .args(["--target", "web", "--no-typescript", "--out-dir"])
        .arg(engine)
        .arg(program);
    finish(&mut command, "wasm-bindgen")
}

/// Checks for the required tools before anything is compiled; the error says how to install what is
/// missing.
fn check_tools() -> anyhow::Result<()> {
    let libraries = Command::new("rustc")
        .args(["--print", "target-libdir", "--target", TARGET])
        .output();
    let libraries = libraries.context("cannot run rustc")?.stdout;
    let libraries = String::from_utf8_lossy(&libraries);
    anyhow::ensure!(
        Path::new(libraries.trim()).is_dir(),
        "expected Rust's libraries for {TARGET}, found none: \
         `rustup target add {TARGET}` installs them"
    );
    let version = Command::new("wasm-bindgen").arg("--version").output();
    let found = version.map_or_else(
        |_| "none".into(),
        |output| String::from_utf8_lossy(&output.stdout).trim().to_owned(),
    );
    anyhow::ensure!(
        found.split(' ').any(|word| word == BINDGEN),
        "expected wasm-bindgen {BINDGEN}, found {found}: \
         `cargo install wasm-bindgen-cli --version {BINDGEN}` installs it"
    );
    Ok(())
}

fn finish(command: &mut Command, name: &str) -> anyhow::Result<()> {
    let status = command.status();
    let status = status.with_context(|| format!("cannot run {name}"))?;
    anyhow::ensure!(status.success(), "{name} failed: {status}");
    Ok(())
}

/// Copies the page's sources except the list of scenes, and removes all other files beside them.
fn copy_page(root: &Path, live: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(live).with_context(|| format!("cannot make {}", live.display()))?;
    for path in files_of(live)? {
        if path.is_file() {
            fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
        }
    }
    let mut sources = files_of(&root.join("crates/gump-web/page"))?;
    sources.push(root.join(DRAWING));
    for path in sources {
        let name = path.file_name().unwrap_or_default();
        if name != SCENES {
            write(&live.join(name), &read(&path)?)?;
        }
    }
    Ok(())
}

/// Writes weights, scenes and the licences that go with them.
fn scenes(root: &Path, live: &Path) -> anyhow::Result<Manifest> {
    let (scenes, licences) = (live.join("scenes"), live.join("licences"));
    make_empty(&scenes)?;
    make_empty(&licences)?;
    let list = read(&root.join("crates/gump-web/page").join(SCENES))?;
    let list: Vec<Scene> = serde_json::from_slice(&list).context("page/scenes.json")?;
    let mini = root.join("datasets/mini");
    let manifest = fs::read_to_string(mini.join("manifest.toml")).context("datasets/mini")?;
    let manifest: Mini = toml::from_str(&manifest).context("datasets/mini/manifest.toml")?;
    let mut listed = Vec::new();
    for scene in list {
        let entry = manifest.file.iter().find(|file| file.path == scene.file);
        let entry = entry.with_context(|| format!("datasets/mini has no {}", scene.file))?;
        let name = format!("{}#{}", mini.join(&scene.file).display(), scene.index);
        let scenario = gump_data::find(&name)?;
        let file = format!("scenes/{}.tfrecord.gz", scene.id);
        womd::write_scenarios(&live.join(&file), [&scenario])?;
        let notice = scene.notice.or_else(|| entry.notice.clone());
        listed.push(ListedScene {
            id: scene.id,
            title: scene.title,
            licence: entry.licence.clone().unwrap_or_else(|| "Apache-2.0".into()),
            notice: notice.unwrap_or_default(),
            listed: listed_file(live, file)?,
        });
    }
    for path in files_of(&mini.join("notices"))? {
        let name = path.file_name().unwrap_or_default();
        // Of the networks that are here; see the manifest of the mini set.
        if name.to_string_lossy().ends_with("EPL-2.0") {
            write(&licences.join(name), &read(&path)?)?;
        }
    }
    let weights = "gump-relative.safetensors";
    let bytes = read(&root.join("datasets/weights").join(weights))?;
    write(&live.join(weights), &bytes)?;
    Ok(Manifest {
        weights: listed_file(live, weights.into())?,
        scenes: listed,
    })
}

fn listed_file(live: &Path, file: String) -> anyhow::Result<Listed> {
    let bytes = read(&live.join(&file))?;
    let digest = Sha256::digest(&bytes);
    Ok(Listed {
        file,
        bytes: bytes.len() as u64,
        sha256: digest.iter().map(|byte| format!("{byte:02x}")).collect(),
    })
}

/// Bytes of all files of a folder and its folders.
fn weigh(folder: &Path) -> anyhow::Result<u64> {
    let mut bytes = 0;
    for path in files_of(folder)? {
        bytes += if path.is_dir() {
            weigh(&path)?
        } else {
            path.metadata()?.len()
        };
    }
    Ok(bytes)
}

fn files_of(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = fs::read_dir(folder);
    let entries = entries.with_context(|| format!("cannot list {}", folder.display()))?;
    let mut paths = Vec::new();
    for entry in entries {
        paths.push(entry?.path());
    }
    paths.sort();
    Ok(paths)
}

fn make_empty(folder: &Path) -> anyhow::Result<()> {
    if folder.exists() {
        fs::remove_dir_all(folder).with_context(|| format!("cannot empty {}", folder.display()))?;
    }
    fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))
}

fn read(path: &Path) -> anyhow::Result<Vec<u8>> {
    fs::read(path).with_context(|| format!("cannot read {}", path.display()))
}

fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}
