//! Pairwise comparisons of planners in every world, their significance, and pairs on which worlds
//! disagree.

use gump_eval::worlds::WorldName;
use gump_planner::Comparison;
use gump_scene::Seed;
use serde_json::{Value, json};

use super::closed_loop::{COLUMNS, PlannerDrives};
use crate::run::Run;
use crate::table;

/// The table of one world as text of so many columns: percent, without what is the same in every row.
pub(super) fn table_of(world: &WorldName, rows: &[Value], width: usize) -> String {
    let percent = |value: &Value| value.as_f64().map(|x| (x * 1e4).round() / 100.0);
    let shown = rows.iter().map(|row| {
        let mut shown = json!({ "planner": row["planner"], "failed": row["failed"] });
        let names = COLUMNS.iter().map(|(name, _)| *name);
        for name in ["score", "low", "high"].into_iter().chain(names) {
            shown[name] = json!(percent(&row[name]));
        }
        shown["ms"] = row["milliseconds_per_step"].clone();
        shown
    });
    let shown: Vec<Value> = shown.collect();
    table::text(&json!({ format!("among {world}, %"): shown }), width)
}

/// Compares all pairs of planners in every world and warns where a pair changes places.
pub(super) fn report(
    run: &mut Run,
    worlds: &[(String, Vec<PlannerDrives<'_>>)],
) -> anyhow::Result<()> {
    let Some((_, planners)) = worlds.first().filter(|(_, drives)| drives.len() > 1) else {
        return Ok(());
    };
    let (mut comparisons, mut changes) = (Vec::new(), Vec::new());
    for a in 0..planners.len() {
        for b in a + 1..planners.len() {
            let mut found = Vec::new();
            for (world, drives) in worlds {
                let Some(compared) = compare(&drives[a], &drives[b], run.seed()) else {
                    continue;
                };
                comparisons.push(comparison_row(world, &drives[a], &drives[b], &compared));
                found.push((world, compared.difference, compared.is_sure()));
            }
            changes.extend(changed(&planners[a].planner, &planners[b].planner, &found));
        }
    }
    run.result("comparisons", comparisons)?;
    let (sure, noise): (Vec<&Change>, Vec<&Change>) = changes.iter().partition(|c| c.is_sure());
    for change in sure {
        run.print(&format!("warning: {}", change.sentence()));
    }
    if !noise.is_empty() {
        let n = noise.len();
        run.print(&format!(
            "warning: {n} more change of places may be chance, see ranking_changes"
        ));
    }
    let rows = changes.iter().map(Change::to_json);
    run.result("ranking_changes", rows.collect::<Vec<_>>())
}

/// Two planners whose order differs between two worlds.
#[derive(Clone, Debug, PartialEq)]
struct Change {
    planners: [String; 2],
    /// Worlds with what the first is better by, and whether that is sure.
    worlds: [(String, f64, bool); 2],
}

impl Change {
    fn is_sure(&self) -> bool {
        self.worlds.iter().any(|(_, _, sure)| *sure)
    }

    fn sentence(&self) -> String {
        let [a, b] = &self.planners;
        let worlds = self.worlds.clone().map(|(world, difference, sure)| {
            let chance = if sure { "" } else { ", perhaps by chance" };
            format!("{:+.2} points among {world}{chance}", 100.0 * difference)
        });
        format!("{a} and {b} change places: {}; {}", worlds[0], worlds[1])
    }

    fn to_json(&self) -> Value {
        let [(here, x, _), (there, y, _)] = &self.worlds;
        json!({
            "planner": self.planners[0],
            "less": self.planners[1],
            "world": here,
            "difference": x,
            "other_world": there,
            "other_difference": y,
            "sure": self.is_sure(),
        })
    }
}

/// Of the scenarios that both drove to the end.
fn compare(a: &PlannerDrives<'_>, b: &PlannerDrives<'_>, seed: Seed) -> Option<Comparison> {
    let pairs = a.scores().zip(b.scores());
    let (a, b): (Vec<f64>, Vec<f64>) = pairs.filter_map(|(a, b)| a.zip(b)).unzip();
    Comparison::of_scenes(&a, &b, seed)
}

fn comparison_row(
    world: &str,
    a: &PlannerDrives<'_>,
    b: &PlannerDrives<'_>,
    compared: &Comparison,
) -> Value {
    json!({
        "world": world,
        "planner": a.planner,
        "less": b.planner,
        "difference": compared.difference,
        "low": compared.interval.low,
        "high": compared.interval.high,
        "scenarios_needed": compared.scenes_needed(1),
    })
}

/// Every two worlds that disagree about two planners.
fn changed(a: &str, b: &str, found: &[(&String, f64, bool)]) -> Vec<Change> {
    let mut changes = Vec::new();
    for (i, (here, x, sure)) in found.iter().enumerate() {
        for (there, y, sure_too) in &found[i + 1..] {
            if x * y < 0.0 {
                let worlds = [
                    (here.to_string(), *x, *sure),
                    (there.to_string(), *y, *sure_too),
                ];
                let planners = [a.to_owned(), b.to_owned()];
                changes.push(Change { planners, worlds });
            }
        }
    }
    changes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_worlds_that_disagree_are_named() {
        let worlds = ["log", "idm", "model"].map(str::to_owned);
        let check = |differences: [(f64, bool); 3], expected: &[&str]| {
            let found: Vec<_> = worlds
                .iter()
                .zip(differences)
                .map(|(world, (x, sure))| (world, x, sure))
                .collect();
            let changes = changed("pdm", "idm", &found);
            let sentences: Vec<String> = changes.iter().map(Change::sentence).collect();
            assert_eq!(sentences, expected);
            assert!(changes.iter().all(Change::is_sure));
        };
        check([(0.1, true), (0.2, false), (0.0, false)], &[]);
        check(
            [(0.1, true), (0.2, true), (-0.05, false)],
            &[
                "pdm and idm change places: +10.00 points among log; -5.00 points among model, \
                 perhaps by chance",
                "pdm and idm change places: +20.00 points among idm; -5.00 points among model, \
                 perhaps by chance",
            ],
        );
    }
}
