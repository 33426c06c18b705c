//! Prediction targets, in formats without them.

use std::collections::BTreeMap;

use gump_scene::{AgentId, Frame};

/// Maximum number of targets, as in Waymo's benchmark.
const MAX_TARGETS: usize = 8;
/// Maximum distance of targets from the ego, metres. Chosen by hand.
const RANGE: f64 = 60.0;

/// The moving agents nearest to the ego that are present for at least half of the future, including
/// the ego, sorted by id.
pub(crate) fn choose(log: &[Frame], now: usize, ego: AgentId) -> Vec<AgentId> {
    let mut stays: BTreeMap<AgentId, usize> = BTreeMap::new();
    for agent in log[now..].iter().flat_map(|frame| frame.agents()) {
        *stays.entry(agent.id).or_default() += 1;
    }
    let Some(here) = log[now].agent(ego).map(|ego| ego.state.pose.position) else {
        return Vec::new();
    };
    let mut near: Vec<(f64, AgentId)> = log[now]
        .agents()
        .iter()
        .filter(|agent| agent.kind.is_moving())
        .map(|agent| (agent.state.pose.position.distance(here), agent.id))
        .filter(|(distance, id)| *distance < RANGE && 2 * stays[id] >= log.len() - now)
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut ids: Vec<_> = near.iter().take(MAX_TARGETS).map(|(_, id)| *id).collect();
    ids.sort_unstable();
    ids
}
