//! Pairwise comparisons of planners in every world, their significance, the scenes that they come
//! from, and pairs on which worlds disagree.

use gump_eval::closed_loop::ScenarioDrives;
use gump_eval::results::Entry;
use gump_eval::worlds::WorldName;
use gump_planner::Comparison;
use gump_scene::Seed;
use serde_json::{Value, json};

use super::closed_loop::{COLUMNS, PlannerDrives};
use crate::run::Run;
use crate::table;

/// Scenes of a comparison that are named on either side of 0. Chosen by hand: as many films as
/// somebody looks at.
const N_SCENES_NAMED: usize = 5;

/// Difference of two scores, 0 to 1, that is not worth a look: a table shows less of it.
const LEAST_DIFFERENCE: f64 = 1e-6;

/// The tables of one world as text of so many columns, without what is the same in every row: scores
/// in percent, then what is no share.
pub(super) fn table_of(world: &WorldName, rows: &[Value], width: usize) -> String {
    let percent = |value: &Value| value.as_f64().map(|x| (x * 1e4).round() / 100.0);
    let scores = rows.iter().map(|row| {
        let mut shown = json!({ "planner": row["planner"] });
        let names = COLUMNS.iter().map(|(name, _)| *name);
        for name in ["score", "low", "high"].into_iter().chain(names) {
            shown[name] = json!(percent(&row[name]));
        }
        shown
    });
    let counts = rows.iter().map(|row| {
        json!({
            "planner": row["planner"],
            "scenarios": row["scenarios"],
            "failed": row["failed"],
            "milliseconds_per_step": row["milliseconds_per_step"],
        })
    });
    let (scores, counts): (Vec<Value>, Vec<Value>) = (scores.collect(), counts.collect());
    let tables = json!({ format!("among {world}, %"): scores, format!("among {world}"): counts });
    table::text(&tables, width)
}

/// Compares all pairs of planners in every world and warns where a pair changes places. Further
/// warnings are returned.
pub(super) fn report(
    run: &mut Run,
    worlds: &[(String, Vec<PlannerDrives<'_>>)],
) -> anyhow::Result<Option<String>> {
    let Some((_, planners)) = worlds.first().filter(|(_, drives)| drives.len() > 1) else {
        return Ok(None);
    };
    let (mut comparisons, mut changes) = (Vec::new(), Vec::new());
    let (mut extremes, mut unsure) = (Vec::new(), Vec::new());
    for a in 0..planners.len() {
        for b in a + 1..planners.len() {
            let mut found = Vec::new();
            for (world, drives) in worlds {
                let pair = Pair::of(world, &drives[a], &drives[b]);
                let compared = pair.compare(run.seed());
                comparisons.push(pair.row(compared.as_ref()));
                extremes.extend(pair.extremes());
                match compared {
                    Some(compared) => found.push((world, compared.difference, compared.is_sure())),
                    None => unsure.push(pair.without_interval()),
                }
            }
            changes.extend(changed(&planners[a].planner, &planners[b].planner, &found));
        }
    }
    run.result("comparisons", comparisons)?;
    run.result("wins_and_losses", extremes)?;
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
    run.result("ranking_changes", rows.collect::<Vec<_>>())?;
    Ok((!unsure.is_empty()).then(|| {
        format!(
            "differences without an interval, which takes at least 2 scenarios that both drove to \
             the end: {}",
            unsure.join(", ")
        )
    }))
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

/// Two planners in one world, in the scenarios that both drove to the end.
struct Pair<'a> {
    world: &'a str,
    planners: [&'a str; 2],
    /// With the scores of both.
    scenes: Vec<(&'a Entry<ScenarioDrives>, f64, f64)>,
}

impl<'a> Pair<'a> {
    fn of(world: &'a str, a: &'a PlannerDrives<'_>, b: &'a PlannerDrives<'_>) -> Self {
        let both = a.scenes().zip(b.scores());
        let scenes = both.filter_map(|((entry, a), b)| Some((entry, a?, b?)));
        Self {
            world,
            planners: [&a.planner, &b.planner],
            scenes: scenes.collect(),
        }
    }

    /// `None` for fewer than two scenarios.
    fn compare(&self, seed: Seed) -> Option<Comparison> {
        let scores = self.scenes.iter().map(|&(_, a, b)| (a, b));
        let (a, b): (Vec<f64>, Vec<f64>) = scores.unzip();
        Comparison::of_scenes(&a, &b, seed)
    }

    /// The row of a comparison; a single scenario has a difference as well.
    fn row(&self, compared: Option<&Comparison>) -> Value {
        let single = || self.scenes.first().map(|(_, a, b)| a - b);
        json!({
            "world": self.world,
            "planner": self.planners[0],
            "less": self.planners[1],
            "difference": compared.map(|compared| compared.difference).or_else(single),
            "low": compared.map(|compared| compared.interval.low),
            "high": compared.map(|compared| compared.interval.high),
            "scenarios_needed": compared.and_then(|compared| compared.scenes_needed(1)),
            "scenarios": self.scenes.len(),
        })
    }

    fn without_interval(&self) -> String {
        let [a, b] = self.planners;
        format!("{a} less {b} among {} ({})", self.world, self.scenes.len())
    }

    /// The scenes in which the first planner gains most over the second, from the largest gain, then
    /// those in which it loses most, from the largest loss.
    fn extremes(&self) -> Vec<Value> {
        let difference = |scene: &(&Entry<ScenarioDrives>, f64, f64)| scene.1 - scene.2;
        let mut wins: Vec<_> = self.scenes.iter().collect();
        // Equal ones in the order of the scenarios: the sorts are stable.
        let mut losses = wins.clone();
        wins.sort_by(|a, b| difference(b).total_cmp(&difference(a)));
        losses.sort_by(|a, b| difference(a).total_cmp(&difference(b)));
        wins.retain(|scene| difference(scene) > LEAST_DIFFERENCE);
        losses.retain(|scene| difference(scene) < -LEAST_DIFFERENCE);
        let named = [wins, losses].into_iter().flat_map(|side| {
            let rows = side.into_iter().take(N_SCENES_NAMED);
            rows.map(|scene| {
                let (entry, a, b) = scene;
                json!({
                    "world": self.world,
                    "planner": self.planners[0],
                    "less": self.planners[1],
                    "id": entry.id,
                    "difference": difference(scene),
                    "score": a,
                    "less_score": b,
                    "index": entry.index,
                    "log_name": entry.scores.log_name,
                })
            })
        });
        named.collect()
    }
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

    fn scene(index: usize) -> Entry<ScenarioDrives> {
        Entry {
            index,
            id: format!("s{index}"),
            scores: ScenarioDrives {
                log_name: "log".into(),
                scenario_type: "unknown".into(),
                outcomes: Vec::new(),
                unreadable: None,
            },
        }
    }

    fn pair(scenes: &[(Entry<ScenarioDrives>, f64, f64)]) -> Pair<'_> {
        Pair {
            world: "idm",
            planners: ["a", "b"],
            scenes: scenes.iter().map(|(entry, a, b)| (entry, *a, *b)).collect(),
        }
    }

    #[test]
    fn scenes_that_are_won_and_lost_are_named_from_the_largest() {
        // Differences of -0.7, -0.6 ... 0.7; one scene is equal.
        let scenes: Vec<_> = (0..15).map(|i| (scene(i), 0.1 * i as f64, 0.7)).collect();
        let rows = pair(&scenes).extremes();
        let ids: Vec<&str> = rows.iter().filter_map(|row| row["id"].as_str()).collect();
        let expected = [
            "s14", "s13", "s12", "s11", "s10", "s0", "s1", "s2", "s3", "s4",
        ];
        assert_eq!(ids, expected);
        for row in rows {
            let number = |key: &str| row[key].as_f64().unwrap();
            assert_eq!(number("difference"), number("score") - number("less_score"));
            assert_eq!(row["id"], format!("s{}", row["index"]));
        }
        // Sides are no longer than they are, ties in order of the scenes.
        let equal = [
            (scene(3), 0.2, 0.1),
            (scene(1), 0.2, 0.1),
            (scene(7), 0.5, 0.5),
            (scene(8), 0.5, 0.5 + 1e-9),
            (scene(9), 0.5 + 1e-9, 0.5),
        ];
        let rows = pair(&equal).extremes();
        let ids: Vec<&str> = rows.iter().filter_map(|row| row["id"].as_str()).collect();
        assert_eq!(ids, ["s3", "s1"]);
    }

    #[test]
    fn what_is_no_share_is_not_among_the_percent() {
        let row = json!({ "planner": "idm", "scenarios": 3, "failed": 1, "score": 0.5,
                          "milliseconds_per_step": 7.0 });
        let text = table_of(&WorldName::Idm, &[row], usize::MAX);
        let (scores, counts) = text.split_once("\namong idm\n").unwrap();
        assert!(
            scores.contains("among idm, %") && scores.contains("50.00"),
            "{text}"
        );
        assert!(
            !scores.contains("failed") && counts.contains("failed"),
            "{text}"
        );
        assert!(counts.contains("milliseconds_per_step"), "{text}");
    }

    #[test]
    fn a_single_scene_has_a_difference_without_an_interval() {
        let check = |n: usize, difference: Value, has_interval: bool| {
            let scenes: Vec<_> = (0..n).map(|i| (scene(i), 0.75, 0.25)).collect();
            let pair = pair(&scenes);
            let compared = pair.compare(Seed(0));
            assert_eq!(compared.is_some(), has_interval);
            let row = pair.row(compared.as_ref());
            assert_eq!(row["difference"], difference);
            assert_eq!(row["scenarios"], n);
            assert_eq!(row["low"].is_number(), has_interval, "{row}");
            assert_eq!(pair.without_interval(), format!("a less b among idm ({n})"));
        };
        check(0, Value::Null, false);
        check(1, 0.5.into(), false);
        check(2, 0.5.into(), true);
    }

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
