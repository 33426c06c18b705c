//! A dependency goes down, never sideways, never up.
//!
//! Every package states its layer in its own manifest (`[package.metadata] layer = 2`); there is
//! no second list to keep in step. Dev-dependencies count, so that tests cannot invert the layers;
//! but tests may use any outside crate, to read reference values in the form they come in.

use std::path::Path;
use std::process::Command;

use anyhow::Context as _;
use serde::Deserialize;

/// Outside crates (by the start of their names) that only some packages may use, and why.
const CONFINED: [(&str, &[&str], &str); 5] = [
    (
        "candle",
        &["gump-nn", "gump-model", "gump-engine", "gump-train"],
        "tensors live in the networks and the learners only",
    ),
    (
        "prost",
        &["gump-proto", "gump-data", "gump-grpc"],
        "only messages, gump-data and planners in other processes know a layout of bytes",
    ),
    ("clap", &["xtask"], "only the driver reads a command line"),
    (
        "wasm-bindgen",
        &["gump-web"],
        "only the page's bindings know JavaScript",
    ),
    (
        "anyhow",
        &["xtask", "examples"],
        "a library names its errors",
    ),
];

/// Every edge that breaks a rule, as a sentence; empty if all is well.
///
/// Error: `cargo metadata` cannot be run or read.
pub(crate) fn problems(repository: &Path) -> anyhow::Result<Vec<String>> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .args(["metadata", "--no-deps", "--offline", "--format-version=1"])
        .current_dir(repository)
        .output()
        .context("cannot run cargo metadata")?;
    anyhow::ensure!(
        output.status.success(),
        "cargo metadata failed: {}",
        String::from_utf8_lossy(&output.stderr).trim()
    );
    let workspace: Metadata = serde_json::from_slice(&output.stdout)?;
    let path = repository.join("ARCHITECTURE.md");
    let page = std::fs::read_to_string(&path)
        .with_context(|| format!("cannot read {}", path.display()))?;
    let mut problems = problems_in(&workspace);
    problems.extend(problems_of_the_page(&workspace, &page));
    // The number of compiled crates differs by platform; the page states those of one.
    if cfg!(all(target_os = "linux", target_arch = "x86_64")) {
        problems.extend(problems_of_counts(repository, &workspace, &page)?);
    }
    Ok(problems)
}

/// Rows of the table in ARCHITECTURE.md whose number of crates to compile is wrong.
fn problems_of_counts(
    repository: &Path,
    workspace: &Metadata,
    page: &str,
) -> anyhow::Result<Vec<String>> {
    let mut problems = Vec::new();
    for package in &workspace.packages {
        let name = package.name.as_str();
        let row = page
            .lines()
            .find(|line| line.starts_with(&format!("| `{name}` |")));
        let stated = row.and_then(|row| row.trim_end_matches(" |").rsplit(' ').next());
        let counted = n_compiled(repository, name)?;
        if stated.and_then(|stated| stated.parse().ok()) != Some(counted) {
            problems.push(format!(
                "ARCHITECTURE.md says that {name} compiles {} crates, cargo tree says {counted}",
                stated.unwrap_or("no")
            ));
        }
    }
    Ok(problems)
}

/// Number of crates that building a package compiles, itself included.
fn n_compiled(repository: &Path, package: &str) -> anyhow::Result<usize> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let words = "tree --quiet --offline --locked --edges normal,build --prefix none --format {p}";
    let output = Command::new(cargo)
        .args(words.split(' '))
        .args(["--package", package])
        .current_dir(repository)
        .output()
        .context("cannot run cargo tree")?;
    anyhow::ensure!(
        output.status.success(),
        "cargo tree failed: {}",
        String::from_utf8_lossy(&output.stderr).trim()
    );
    let text = String::from_utf8_lossy(&output.stdout);
    let names = text
        .lines()
        .map(|line| line.trim_end_matches(" (*)").trim());
    let names: std::collections::BTreeSet<&str> = names.filter(|line| !line.is_empty()).collect();
    Ok(names.len())
}

#[derive(Deserialize)]
struct Metadata {
    packages: Vec<Package>,
}

#[derive(Deserialize)]
struct Package {
    name: String,
    metadata: Option<PackageMetadata>,
    dependencies: Vec<Dependency>,
    #[serde(default)]
    features: std::collections::BTreeMap<String, Vec<String>>,
}

#[derive(Deserialize)]
struct PackageMetadata {
    layer: Option<u32>,
}

#[derive(Deserialize)]
struct Dependency {
    name: String,
    /// `dev`, `build`, or nothing for an ordinary one.
    kind: Option<String>,
}

impl Package {
    fn layer(&self) -> Option<u32> {
        self.metadata.as_ref()?.layer
    }
}

fn problems_in(workspace: &Metadata) -> Vec<String> {
    let mut problems = Vec::new();
    for package in &workspace.packages {
        let name = &package.name;
        let Some(layer) = package.layer() else {
            problems.push(format!("{name} states no layer in its Cargo.toml"));
            continue;
        };
        for dependency in &package.dependencies {
            let other = &dependency.name;
            let inside = workspace.packages.iter().find(|p| &p.name == other);
            if let Some(below) = inside.and_then(Package::layer)
                && below >= layer
            {
                problems.push(format!(
                    "{name} (layer {layer}) depends on {other} (layer {below}), \
                     expected a lower layer"
                ));
            }
            let confined = CONFINED.iter().find(|(start, ..)| other.starts_with(start));
            if let Some((_, allowed, why)) = confined
                && dependency.kind.as_deref() != Some("dev")
                && !allowed.contains(&name.as_str())
            {
                problems.push(format!("{name} depends on {other}, but {why}"));
            }
        }
    }
    problems
}

/// Contradictions between ARCHITECTURE.md and the manifests: in its picture of the layers, and in
/// the external crates of its table.
fn problems_of_the_page(workspace: &Metadata, page: &str) -> Vec<String> {
    let mut problems = Vec::new();
    let layers = page.lines().filter_map(|line| {
        let (layer, names) = line.trim().split_once(' ')?;
        Some((layer.parse::<u32>().ok()?, names))
    });
    let layers: Vec<(u32, &str)> = layers.collect();
    for package in &workspace.packages {
        let name = package.name.as_str();
        let says = |names: &str| names.split_whitespace().any(|word| word == name);
        let drawn = layers.iter().find(|(_, names)| says(names));
        if drawn.map(|(layer, _)| *layer) != package.layer() {
            let (own, drawn) = (package.layer(), drawn.map(|(layer, _)| *layer));
            problems.push(format!(
                "ARCHITECTURE.md draws {name} on layer {drawn:?}, its Cargo.toml states {own:?}"
            ));
        }
        let row = page
            .lines()
            .find(|line| line.starts_with(&format!("| `{name}` |")));
        let Some(row) = row else {
            problems.push(format!("ARCHITECTURE.md has no row for {name}"));
            continue;
        };
        let outside = row.split(" | ").nth(2).unwrap_or_default();
        for word in outside.split('`').skip(1).step_by(2) {
            let is_known = package.dependencies.iter().any(|d| d.name == word);
            // A word may also name a feature.
            if !is_known && !package.features.contains_key(word) {
                problems.push(format!(
                    "ARCHITECTURE.md gives {name} the crate {word}, on which it does not depend"
                ));
            }
        }
    }
    problems
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_workspace_keeps_its_layers() {
        let found = problems(&crate::machine::repository()).unwrap();
        assert!(found.is_empty(), "{}", found.join("\n"));
    }

    #[test]
    fn breaches_are_found() {
        let package = |name: &str, layer: Option<u32>, dependencies: &[&str]| {
            let dependencies: Vec<_> = dependencies.iter().map(|d| json!({"name": d})).collect();
            let metadata = layer.map(|layer| json!({"layer": layer}));
            json!({"name": name, "metadata": metadata, "dependencies": dependencies})
        };
        let workspace = json!({"packages": [
            package("gump-scene", Some(1), &["thiserror"]),
            package("gump-data", Some(2), &["gump-scene", "prost"]),
            package("gump-raster", Some(2), &["gump-data", "candle-core"]),
            package("gump-new", None, &[]),
        ]});
        let found = problems_in(&serde_json::from_value(workspace).unwrap());
        assert_eq!(
            found,
            [
                "gump-raster (layer 2) depends on gump-data (layer 2), expected a lower layer",
                "gump-raster depends on candle-core, but tensors live in the networks and the \
                 learners only",
                "gump-new states no layer in its Cargo.toml",
            ]
        );
    }

    #[test]
    fn a_page_that_says_otherwise_is_found() {
        let workspace = json!({"packages": [
            {"name": "gump-scene", "metadata": {"layer": 1}, "dependencies": [{"name": "glam"}]},
            {"name": "gump-data", "metadata": {"layer": 2}, "dependencies": []},
        ]});
        let page = " 2   gump-scene\n| `gump-scene` | Words. | `glam`, `prost` | 9 |\n";
        let found = problems_of_the_page(&serde_json::from_value(workspace).unwrap(), page);
        assert_eq!(
            found,
            [
                "ARCHITECTURE.md draws gump-scene on layer Some(2), its Cargo.toml states Some(1)",
                "ARCHITECTURE.md gives gump-scene the crate prost, on which it does not depend",
                "ARCHITECTURE.md draws gump-data on layer None, its Cargo.toml states Some(2)",
                "ARCHITECTURE.md has no row for gump-data",
            ]
        );
    }
}
