//! `ci`: everything CI runs, the cheapest check first.

use std::process::Command;

use anyhow::Context as _;
use serde::Serialize;

use super::tidy;
use crate::machine::repository;
use crate::run::{Common, Run};

/// Arguments of `ci`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

/// The list that `.ci/run` reads too: a name and the words after `cargo` a line.
const CHECKS: &str = include_str!("../../../.ci/checks");

/// What is checked by other tools than cargo's own, or takes long: outside crates, spelling, unused
/// dependencies, rare features, the oldest Rust. It says what it skips.
const POLICIES: &str = ".ci/policies";

/// A target that checks named `wasm...` build for.
const WASM: &str = "wasm32-unknown-unknown";

/// The checks: names and words after `cargo`.
fn checks() -> impl Iterator<Item = (&'static str, &'static str)> {
    let is_check = |line: &&str| !line.is_empty() && !line.starts_with('#');
    let lines = CHECKS.lines().filter(is_check);
    lines.filter_map(|line| line.split_once(": "))
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        tidy::Args {
            common: self.common.clone(),
        }
        .execute(run)?;
        let has_wasm = has_target(WASM);
        let mut done = Vec::new();
        for (name, words) in checks() {
            if name.starts_with("wasm") && !has_wasm {
                run.print(&format!(
                    "skipped: {name} (run `rustup target add {WASM}` for it)"
                ));
                continue;
            }
            run.print(&format!("cargo {words}"));
            run.phase(name, |_| cargo(words))?;
            done.push(name);
        }
        run.print(POLICIES);
        run.phase("policies", |_| policies())?;
        done.push("policies");
        run.result("steps", done)?;
        Ok(())
    }
}

fn cargo(words: &str) -> anyhow::Result<()> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    command
        .args(words.split(' '))
        .current_dir(repository())
        .env("RUSTDOCFLAGS", "-D warnings");
    // Tests on recorded data must not skip where the data is.
    if repository().join("../shared").is_dir() {
        command.env("REQUIRE_SHARED", "1");
    }
    let status = command.status().context("cannot run cargo")?;
    anyhow::ensure!(status.success(), "cargo {words} failed: {status}");
    Ok(())
}

fn policies() -> anyhow::Result<()> {
    let mut command = Command::new(repository().join(POLICIES));
    let status = command.status().context("cannot run .ci/policies")?;
    anyhow::ensure!(status.success(), "{POLICIES} failed: {status}");
    Ok(())
}

/// Whether the compiler has the standard library of a target.
fn has_target(target: &str) -> bool {
    let sysroot = Command::new("rustc").args(["--print", "sysroot"]).output();
    sysroot.is_ok_and(|output| {
        let sysroot = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        std::path::Path::new(&sysroot)
            .join("lib/rustlib")
            .join(target)
            .is_dir()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_of_checks_is_read_whole() {
        let names: Vec<_> = checks().map(|(name, _)| name).collect();
        assert_eq!(names.first(), Some(&"fmt"));
        assert!(names.contains(&"test"));
        let written = CHECKS
            .lines()
            .filter(|l| !l.is_empty() && !l.starts_with('#'));
        assert_eq!(names.len(), written.count());
    }
}
