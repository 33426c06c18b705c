//! The same work in PyTorch, in a separate process, for comparison.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::Context as _;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use crate::cli::WrongArguments;
use crate::machine::repository;

/// The oldest release with a fused AdamW on the CPU.
const OLDEST: (u32, u32) = (2, 4);

/// Python with PyTorch.
#[derive(Debug)]
pub(super) struct Torch {
    python: PathBuf,
    pub(super) version: String,
}

/// Output of a script of `python/bench`.
#[derive(Debug, Deserialize)]
pub(super) struct Timed {
    pub(super) seconds: f64,
    pub(super) cpu_seconds: f64,
    /// Loss, for comparison with ours.
    #[serde(default)]
    pub(super) loss: f64,
    pub(super) parameters: usize,
    /// Instructions that PyTorch uses, `AVX512` for instance.
    pub(super) capability: String,
    /// Floating-point operations, by PyTorch's own counter.
    #[serde(default)]
    pub(super) operations: f64,
}

impl Torch {
    /// The interpreter at this path, or of this name.
    ///
    /// Error: [`WrongArguments`] if it does not run, or has no PyTorch or too old a one.
    pub(super) fn find(python: &Path) -> anyhow::Result<Self> {
        let wrong = |what: String| WrongArguments(format!("--torch {}: {what}", python.display()));
        let script = "import torch; print(torch.__version__)";
        let output = Command::new(python).args(["-c", script]).output();
        let output = output.map_err(|error| wrong(format!("cannot be run, {error}")))?;
        if !output.status.success() {
            let stderr = String::from_utf8_lossy(&output.stderr);
            let why = stderr.lines().last().unwrap_or("it failed").to_owned();
            return Err(wrong(why).into());
        }
        let version = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        let mut numbers = version.split('.').map(|part| part.parse::<u32>().ok());
        let found = (numbers.next().flatten(), numbers.next().flatten());
        if found < (Some(OLDEST.0), Some(OLDEST.1)) {
            let (major, minor) = OLDEST;
            let what = format!("expected PyTorch {major}.{minor} or newer, found {version}");
            return Err(wrong(what).into());
        }
        Ok(Self {
            python: python.to_owned(),
            version,
        })
    }

    /// Runs a script of `python/bench` with this many threads.
    ///
    /// Error: a script that fails, with the last line that it printed.
    pub(super) fn time<T: DeserializeOwned>(
        &self,
        script: &str,
        threads: usize,
        arguments: &[&str],
    ) -> anyhow::Result<T> {
        let path = repository().join("python/bench").join(script);
        if !path.is_file() {
            anyhow::bail!(
                "{} not found: --torch needs a checkout of gump",
                path.display()
            );
        }
        let output = Command::new(&self.python)
            .arg(&path)
            .args(arguments)
            .args(["--threads", &threads.to_string()])
            .env("OMP_NUM_THREADS", threads.to_string())
            .output()
            .with_context(|| format!("cannot run {}", self.python.display()))?;
        if !output.status.success() {
            let stderr = String::from_utf8_lossy(&output.stderr);
            let why = stderr
                .lines()
                .last()
                .unwrap_or("it said nothing")
                .to_owned();
            anyhow::bail!("{} failed: {why}", path.display());
        }
        serde_json::from_slice(&output.stdout)
            .with_context(|| format!("{} printed no result", path.display()))
    }
}
