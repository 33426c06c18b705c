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
const CONFINED: [(&str, &[&str], &str); 4] = [
    (
        "candle",
        &["gump-model", "gump-rl"],
        "tensors live in the network and the learners only",
    ),
    (
        "prost",
        &["gump-proto", "gump-data", "xtask"],
        "only messages, gump-data and the driver know a file layout",
    ),
    ("clap", &["xtask"], "only the driver reads a command line"),
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
    Ok(problems_in(&serde_json::from_slice(&output.stdout)?))
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
                "gump-raster depends on candle-core, but tensors live in the network and the \
                 learners only",
                "gump-new states no layer in its Cargo.toml",
            ]
        );
    }
}
