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

/// A check that cargo does: its name and the words after `cargo`.
const STEPS: [(&str, &str); 5] = [
    ("fmt", "fmt --all --check"),
    (
        "clippy",
        "clippy --workspace --all-targets --locked -- -D warnings",
    ),
    // What reads one format alone must build without the others.
    ("slim", "check -p gump-data --no-default-features --locked"),
    ("doc", "doc --workspace --no-deps --locked"),
    ("test", "test --workspace --locked"),
];

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        tidy::Args {
            common: self.common.clone(),
        }
        .execute(run)?;
        for (name, words) in STEPS {
            run.say(&format!("cargo {words}"));
            run.phase(name, |_| cargo(words))?;
        }
        run.result("steps", STEPS.map(|(name, _)| name))?;
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
