//! Numbers as Parquet tables, for pandas, polars and their like; `docs/tables.md` says what every
//! column is.

use gump_data::Table;
use gump_metrics::{ALL, average_displacement, over_rollout};
use gump_nuplan::metrics::{AggregateRow, MetricScores, ScenarioScores, Scoring};
use gump_scene::{Agent, AgentId, Rollout, Scenario};
use rayon::prelude::*;
use serde_json::Value;

use crate::table::flattened;

/// A list of objects as a table: nested keys with dots, columns in order of first appearance.
/// Columns of whole numbers are integers, those of numbers numbers; what is mixed is text.
pub(crate) fn of_rows(rows: &[Value]) -> Table {
    let (names, cells) = flattened(rows);
    names
        .iter()
        .enumerate()
        .fold(Table::default(), |table, (i, name)| {
            let column = || cells.iter().map(|row| row[i]);
            let all = |is: fn(&Value) -> bool| column().flatten().all(|v| v.is_null() || is(v));
            if all(|_| false) || all(Value::is_f64) {
                table.number(name, column().map(|v| v.and_then(Value::as_f64)))
            } else if all(Value::is_boolean) {
                table.truth(name, column().map(|v| v.and_then(Value::as_bool)))
            } else if all(Value::is_i64) {
                table.integer(name, column().map(|v| v.and_then(Value::as_i64)))
            } else if all(Value::is_number) {
                table.number(name, column().map(|v| v.and_then(Value::as_f64)))
            } else {
                let text = |value: &Value| match value {
                    Value::Null => None,
                    Value::String(text) => Some(text.clone()),
                    other => Some(other.to_string()),
                };
                table.text(name, column().map(|v| v.and_then(text)))
            }
        })
}

/// Every metric of every agent of the present in every rollout, over the whole of it.
pub(crate) fn of_agents(scenario: &Scenario, world: &str, rollouts: &[Rollout]) -> Table {
    let present = scenario.present().now().agents().iter();
    let agents: Vec<&Agent> = present.filter(|agent| agent.kind.is_moving()).collect();
    let ids: Vec<AgentId> = agents.iter().map(|agent| agent.id).collect();
    // Agent by agent, for the road of one rollout is soon looked up.
    let rows: Vec<(usize, &Agent, Vec<Option<f64>>)> = rollouts
        .par_iter()
        .enumerate()
        .flat_map_iter(|(k, rollout)| {
            let off = average_displacement(std::slice::from_ref(rollout), scenario, &ids);
            agents.iter().map(move |agent| {
                let own = off.iter().find(|off| off.agent == agent.id);
                let metrics = ALL.iter().map(|m| over_rollout(*m, rollout, agent.id));
                let off = [own.map(|off| off.ade), own.map(|off| off.fde)];
                (k, *agent, metrics.chain(off).collect())
            })
        })
        .collect();
    let table = Table::default()
        .text("scenario_id", rows.iter().map(|_| Some(&scenario.id)))
        .text("world", rows.iter().map(|_| Some(world)))
        .integer("rollout", rows.iter().map(|(k, ..)| Some(*k as i64)))
        .integer("track_id", rows.iter().map(|(_, a, _)| Some(a.id.0)))
        .text("class", rows.iter().map(|(_, a, _)| Some(a.kind.name())))
        .truth(
            "is_ego",
            rows.iter().map(|(_, a, _)| Some(a.id == scenario.ego)),
        );
    let names = ALL.iter().map(|metric| metric.name());
    let names = names.chain(["ade_m", "fde_m"]).enumerate();
    names.fold(table, |table, (i, name)| {
        table.number(name, rows.iter().map(|(.., values)| values[i]))
    })
}

/// A scenario driven by a planner, as nuPlan names it.
pub(crate) struct Driven<'a> {
    pub(crate) scenario: &'a str,
    pub(crate) log_name: &'a str,
    pub(crate) scenario_type: &'a str,
    pub(crate) score: f64,
    pub(crate) metrics: &'a MetricScores,
}

/// Rows of nuPlan's table of an aggregator, `world` beside its columns.
#[derive(Default)]
pub(crate) struct NuPlan {
    rows: Vec<NuPlanRow>,
}

struct NuPlanRow {
    scenario: String,
    log_name: Option<String>,
    scenario_type: String,
    num_scenarios: Option<i64>,
    planner_name: String,
    world: String,
    score: f64,
    metrics: MetricScores,
}

impl NuPlan {
    /// Adds a planner's scenarios, a row for each of their types, and one for all.
    pub(crate) fn add(&mut self, planner: &str, world: &str, driven: &[Driven<'_>]) {
        let scores = driven.iter().map(|driven| ScenarioScores {
            kind: driven.scenario_type.into(),
            scores: driven.metrics.clone(),
        });
        let aggregate = Scoring::closed_loop().aggregate(&scores.collect::<Vec<_>>());
        let scenarios = driven.iter().map(|d| NuPlanRow {
            scenario: d.scenario.into(),
            log_name: Some(d.log_name.into()),
            scenario_type: d.scenario_type.into(),
            num_scenarios: None,
            planner_name: planner.into(),
            world: world.into(),
            score: d.score,
            metrics: d.metrics.clone(),
        });
        let summed = |name: &str, row: &AggregateRow| NuPlanRow {
            scenario: name.into(),
            log_name: None,
            scenario_type: name.into(),
            num_scenarios: Some(row.n as i64),
            planner_name: planner.into(),
            world: world.into(),
            score: row.score,
            metrics: row.metrics.clone(),
        };
        let kinds = aggregate.kinds.iter().map(|(kind, row)| summed(kind, row));
        self.rows.extend(scenarios.chain(kinds));
        self.rows.push(summed("final_score", &aggregate.total));
    }

    /// The table; a metric's columns is there if any row has it.
    pub(crate) fn table(&self) -> Table {
        let rows = &self.rows;
        let text = |of: fn(&NuPlanRow) -> &str| rows.iter().map(move |row| Some(of(row)));
        let table = Table::default()
            .text("scenario", text(|row| row.scenario.as_str()))
            .text("log_name", rows.iter().map(|row| row.log_name.as_ref()))
            .text("scenario_type", text(|row| row.scenario_type.as_str()))
            .integer("num_scenarios", rows.iter().map(|row| row.num_scenarios))
            .text("planner_name", text(|row| row.planner_name.as_str()))
            .text("aggregator_type", text(|_| "weighted_average"))
            .text("world", text(|row| row.world.as_str()));
        let names = rows.iter().flat_map(|row| row.metrics.keys());
        let names: std::collections::BTreeSet<&String> = names.collect();
        let table = names.into_iter().fold(table, |table, name| {
            let of = |row: &NuPlanRow| row.metrics.get(name).copied().flatten();
            table.number(name, rows.iter().map(of))
        });
        table.number("score", rows.iter().map(|row| Some(row.score)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// Names of the columns that `docs/tables.md` explains.
    fn explained() -> Vec<String> {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/tables.md");
        let text = std::fs::read_to_string(path).unwrap();
        let cells = text.lines().filter_map(|line| line.strip_prefix("| "));
        let cells = cells.filter_map(|line| line.split(" | ").next());
        let names = cells.flat_map(|cell| cell.split('`').skip(1).step_by(2));
        names.map(String::from).collect()
    }

    fn scenario() -> Scenario {
        gump_scene::fixture::scenario(
            "lane 1: 0,0 200,0
             edge: 0,-4 200,-4
             ego vehicle 0: 10,0 velocity 5,0
             agent pedestrian 7: 40,3 velocity 0,-1
             agent other 8: 60,3
             history 1 future 2 dt 0.1",
        )
        .unwrap()
    }

    #[test]
    fn every_agent_that_moves_has_a_row_per_rollout() {
        let scenario = scenario();
        let rollouts = vec![gump_metrics::logged(&scenario); 3];
        let table = of_agents(&scenario, "log", &rollouts);
        let explained = explained();
        for name in table.names() {
            assert!(
                explained.iter().any(|e| e == name),
                "{name} is not explained"
            );
        }
        assert_eq!(table.n_rows(), 3 * 2);
        assert_eq!(table.names().count(), 6 + ALL.len() + 2);
    }

    #[test]
    fn rows_of_a_report_keep_their_kinds() {
        let rows = [
            json!({"name": "a", "n": 3, "x": 0.5, "is": true, "parts": {"p": 1}, "mixed": 1}),
            json!({"name": "b", "n": 4, "x": 2, "is": null, "mixed": "one", "more": [1, 2]}),
        ];
        let table = of_rows(&rows);
        let columns: Vec<_> = table.names().zip(table.kinds()).collect();
        let expected = [
            ("name", "text"),
            ("n", "integer"),
            ("x", "number"),
            ("is", "truth"),
            ("parts.p", "integer"),
            ("mixed", "text"),
            ("more", "text"),
        ];
        assert_eq!(columns, expected);
        assert_eq!(table.n_rows(), 2);
    }

    #[test]
    fn nuplans_table_has_scenarios_types_and_the_final_score() {
        let metrics = |progress: f64| {
            MetricScores::from([
                ("no_ego_at_fault_collisions".to_owned(), Some(1.0)),
                ("ego_progress_along_expert_route".to_owned(), Some(progress)),
                ("ego_is_comfortable".to_owned(), None),
            ])
        };
        let each = [0.5, 1.0, 0.2].map(metrics);
        let kinds = ["near_pedestrian", "unknown", "unknown"];
        let scores = each.each_ref().map(|m| Scoring::closed_loop().score(m));
        let driven: Vec<Driven<'_>> = (0..3)
            .map(|i| Driven {
                scenario: ["a", "b", "c"][i],
                log_name: "log",
                scenario_type: kinds[i],
                score: scores[i],
                metrics: &each[i],
            })
            .collect();
        let mut nuplan = NuPlan::default();
        nuplan.add("idm", "log", &driven);
        let table = nuplan.table();
        let explained = explained();
        for name in table.names() {
            assert!(
                explained.iter().any(|e| e == name),
                "{name} is not explained"
            );
        }
        assert_eq!(table.n_rows(), 3 + 2 + 1);
        let last = nuplan.rows.last().unwrap();
        assert_eq!(
            (last.scenario.as_str(), last.num_scenarios),
            ("final_score", Some(3))
        );
        let mean = scores.iter().sum::<f64>() / 3.0;
        assert!((last.score - mean).abs() < 1e-12);
    }
}
