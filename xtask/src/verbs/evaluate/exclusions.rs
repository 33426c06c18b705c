//! Reports of the scenarios that are left out because the benchmark is not defined on them.

use gump_eval::Exclusions;

use crate::run::Run;

/// Adds the reasons, if there are any, to the report and prints their number.
///
/// Error: all were left out.
pub(crate) fn report(
    run: &mut Run,
    exclusions: &Exclusions,
    n_scored: usize,
) -> anyhow::Result<()> {
    let reasons = exclusions.reasons();
    let n = reasons.len();
    if let Some(first) = reasons.first() {
        run.result("left_out", reasons)?;
        anyhow::ensure!(
            n_scored > 0,
            "none of {n} scenarios has the length and the rate of the benchmark: {first}"
        );
        run.print(&format!("{n} scenarios are left out: {first}"));
    }
    Ok(())
}
