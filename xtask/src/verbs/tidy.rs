//! `tidy`: the house rules, without the compiler.

use serde::Serialize;

use crate::checks::{layers, rust_version, tidy};
use crate::machine::repository;
use crate::run::{Common, Run};

/// Arguments of `tidy`.
#[derive(Debug, Serialize, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) common: Common,
}

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        let tidied = run.phase("files", |_| tidy::check(&repository()))?;
        let layers = run.phase("layers", |_| layers::problems(&repository()))?;
        let rust = run.phase("rust version", |_| rust_version::problems(&repository()))?;
        let problems = tidied.problems.into_iter().chain(layers).chain(rust);
        let problems: Vec<_> = problems.collect();
        for problem in &problems {
            run.print(problem);
        }
        run.result("files", tidied.files)?;
        run.result("problems", problems.len())?;
        let n = problems.len();
        anyhow::ensure!(n == 0, "expected a tidy repository, found {n} problems");
        Ok(())
    }
}
