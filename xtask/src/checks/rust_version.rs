//! Checks that no external crate requires a newer Rust than the workspace promises.
//!
//! Cargo compares the version that a crate requires with the installed compiler, which is mostly
//! newer than the promise. Newer functions of the standard library are left to clippy
//! (`incompatible_msrv`).

use std::path::Path;
use std::process::Command;

use anyhow::Context as _;
use serde::Deserialize;

/// A sentence for every crate that requires more; empty if there is none.
///
/// Error: `cargo metadata` cannot be run or read.
pub(crate) fn problems(repository: &Path) -> anyhow::Result<Vec<String>> {
    // Other platforms need other crates, which may not be on this machine.
    if cfg!(not(all(target_os = "linux", target_arch = "x86_64"))) {
        return Ok(Vec::new());
    }
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let words = "metadata --quiet --offline --locked --format-version=1 \
                 --filter-platform x86_64-unknown-linux-gnu";
    let output = Command::new(cargo)
        .args(words.split_whitespace())
        .current_dir(repository)
        .output()
        .context("cannot run cargo metadata")?;
    anyhow::ensure!(
        output.status.success(),
        "cargo metadata failed: {}",
        String::from_utf8_lossy(&output.stderr).trim()
    );
    problems_in(&serde_json::from_slice(&output.stdout)?)
}

#[derive(Deserialize)]
struct Metadata {
    packages: Vec<Package>,
}

#[derive(Deserialize)]
struct Package {
    name: String,
    /// Source of the crate; `None` for a crate of the workspace.
    source: Option<String>,
    rust_version: Option<String>,
}

fn problems_in(workspace: &Metadata) -> anyhow::Result<Vec<String>> {
    // All crates of the workspace promise the same.
    let mut ours = workspace.packages.iter().filter(|p| p.source.is_none());
    let promised = ours.find_map(|p| p.rust_version.as_deref());
    let promised = promised.context("expected a rust-version in the workspace, found none")?;
    let mut problems = Vec::new();
    for package in &workspace.packages {
        let required = package.rust_version.as_deref().unwrap_or("1");
        if package.source.is_some() && numbers(required) > numbers(promised) {
            problems.push(format!(
                "{} asks for Rust {required}, expected at most {promised}",
                package.name
            ));
        }
    }
    Ok(problems)
}

/// Major, minor and patch; what is left out is 0.
fn numbers(version: &str) -> [u32; 3] {
    let mut parts = version.split('.').map(|part| part.parse().unwrap_or(0));
    std::array::from_fn(|_| parts.next().unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_workspace_builds_with_what_it_promises() {
        let found = problems(&crate::machine::repository()).unwrap();
        assert!(found.is_empty(), "{}", found.join("\n"));
    }

    #[test]
    fn a_crate_that_asks_for_more_is_found() {
        let package = |name: &str, source: Option<&str>, rust_version: Option<&str>| json!({"name": name, "source": source, "rust_version": rust_version});
        let workspace = json!({"packages": [
            package("gump-scene", None, Some("1.91")),
            package("old", Some("registry"), None),
            package("same", Some("registry"), Some("1.91.0")),
            package("older", Some("registry"), Some("1.9.2")),
            package("newer", Some("registry"), Some("1.91.1")),
        ]});
        let found = problems_in(&serde_json::from_value(workspace).unwrap()).unwrap();
        assert_eq!(found, ["newer asks for Rust 1.91.1, expected at most 1.91"]);
    }
}
