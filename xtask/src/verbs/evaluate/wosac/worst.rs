//! The agents to look at first: the score lost because of them, and their behaviour in the
//! rollouts.

use std::collections::BTreeMap;

use gump_metrics::behaviour::{Behaviour, Judged, judge};
use gump_scene::{AgentId, Scenario};
use gump_wosac::realism::{Attribution, Evaluation, Rollouts};
use serde_json::{Value, json};

use crate::run::Run;
use crate::tables;

/// Horizon of the challenge, seconds.
const HORIZON_S: u32 = 8;
/// Agents shown in the report: what a person reads. Chosen by hand.
const N_SHOWN: usize = 20;

/// Agents of all scenarios.
#[derive(Default)]
pub(super) struct Worst {
    rows: Vec<Row>,
}

struct Row {
    scenario: String,
    judged: Judged,
    /// Realism lost because of the agent, over all components.
    cost: f64,
}

impl Worst {
    /// Adds the agents of one scenario that are scored or do something that no driver would.
    pub(super) fn add(
        &mut self,
        scenario: &Scenario,
        rollouts: &Rollouts,
        evaluation: &Evaluation<'_>,
        attributions: &[Attribution],
    ) {
        let mut costs: BTreeMap<AgentId, f64> = BTreeMap::new();
        for attribution in attributions {
            *costs.entry(attribution.agent).or_default() += attribution.cost;
        }
        let conduct = Behaviour::new(scenario, HORIZON_S).conduct(&rollouts.in_scene(scenario));
        let realism = evaluation.realism();
        let realism = realism.iter().map(|one| (one.agent, one.realism));
        for judged in judge(realism, conduct) {
            if judged.realism.is_none() && judged.conduct.any == 0.0 {
                continue;
            }
            self.rows.push(Row {
                scenario: scenario.id.clone(),
                cost: costs.get(&judged.conduct.agent).copied().unwrap_or(0.0),
                judged,
            });
        }
    }

    /// Writes all as a table and the worst into the report.
    pub(super) fn report(mut self, run: &mut Run) -> anyhow::Result<()> {
        self.rows.sort_by(|a, b| {
            let order = a.judged.plausibility.total_cmp(&b.judged.plausibility);
            order.then(b.cost.total_cmp(&a.cost))
        });
        let rows: Vec<Value> = self.rows.iter().map(Row::to_json).collect();
        if !rows.is_empty() {
            tables::of_rows(&rows).write(&run.path("conduct.parquet"))?;
        }
        run.result("worst_agents", &rows[..rows.len().min(N_SHOWN)])
    }
}

impl Row {
    fn to_json(&self) -> Value {
        let Judged {
            conduct,
            realism,
            plausibility,
        } = &self.judged;
        let deeds = conduct.deeds.iter();
        let deeds = deeds.map(|(deed, share)| format!("{} {share:.2}", deed.name()));
        json!({
            "scenario": self.scenario,
            "agent": conduct.agent.0,
            "class": conduct.kind.name(),
            "plausibility": plausibility,
            "realism": realism,
            "cost": self.cost,
            "deeds": deeds.collect::<Vec<_>>().join(", "),
        })
    }
}
