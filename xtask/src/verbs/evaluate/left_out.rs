//! Scenarios that a benchmark is not defined on: named, counted, left out.

use crate::run::Run;

/// Why each of them is left out.
#[derive(Default)]
pub(crate) struct LeftOut(Vec<String>);

impl LeftOut {
    /// What came of a scenario; `None` where a recording of another length or rate is the reason
    /// that nothing did.
    ///
    /// Error: any other.
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

    /// Puts the reasons, if there are any, into the report and says how many they are.
    ///
    /// Error: all were left out.
    pub(crate) fn tell(&self, run: &mut Run, n_scored: usize) -> anyhow::Result<()> {
        let n = self.0.len();
        if let Some(first) = self.0.first() {
            run.result("left_out", &self.0)?;
            anyhow::ensure!(
                n_scored > 0,
                "none of {n} scenarios has the length and the rate of the benchmark: {first}"
            );
            run.say(&format!("{n} scenarios are left out: {first}"));
        }
        Ok(())
    }
}
