//! Scenarios that are left out because the benchmark is not defined on them.

use crate::run::Run;

/// The reason for each of them.
#[derive(Default)]
pub(crate) struct LeftOut(Vec<String>);

impl LeftOut {
    /// Returns the result of a scenario; notes it as left out and returns `None` if its recording
    /// has another length or rate than the benchmark.
    ///
    /// Error: any other error of the scenario.
    pub(crate) fn sift<T>(
        &mut self,
        scored: anyhow::Result<T>,
        is_of_another_length: impl Fn(&anyhow::Error) -> bool,
    ) -> anyhow::Result<Option<T>> {
        match scored {
            Err(error) if is_of_another_length(&error) => {
                self.0.push(format!("{error:#}"));
                Ok(None)
            }
            scored => scored.map(Some),
        }
    }

    /// Adds the reasons, if there are any, to the report and prints their number.
    ///
    /// Error: all were left out.
    pub(crate) fn report(&self, run: &mut Run, n_scored: usize) -> anyhow::Result<()> {
        let n = self.0.len();
        if let Some(first) = self.0.first() {
            run.result("left_out", &self.0)?;
            anyhow::ensure!(
                n_scored > 0,
                "none of {n} scenarios has the length and the rate of the benchmark: {first}"
            );
            run.print(&format!("{n} scenarios are left out: {first}"));
        }
        Ok(())
    }
}
