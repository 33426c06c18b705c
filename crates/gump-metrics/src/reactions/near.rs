//! The agents near a manoeuvre.

use gump_geometry::OrientedBox;
use gump_scene::{Agent, AgentId, AgentState, Scenario};

// Chosen by hand: whoever would have to react, and few besides; the same agents for every world.
/// An agent that moves less than this from its place in the log stands, metres.
const MOVES_M: f64 = 1.0;
/// Maximum distance, box to box, of an agent from a place that the ego occupies, metres.
const NEAR_M: f64 = 2.0;
/// Time window before and after the ego in which the agent may be there, seconds.
const BEFORE_S: f64 = 1.0;
const AFTER_S: f64 = 3.0;

/// Agents whose log comes near the ego's plan, by id; `plan` starts in the present.
pub(super) fn near(scenario: &Scenario, plan: &[AgentState]) -> Vec<AgentId> {
    let ahead = &scenario.log[scenario.now..];
    let present = &ahead[0];
    let Some(ego) = present.agent(scenario.ego) else {
        return Vec::new();
    };
    let own: Vec<OrientedBox> = plan
        .iter()
        .map(|state| ego.with_state(*state).oriented_box())
        .collect();
    let others = present.agents().iter().filter(|agent| {
        agent.id != ego.id
            && agent.kind.is_moving()
            && !agent.oriented_box().overlaps(&ego.oriented_box())
    });
    let concerned = others.filter(|agent| {
        let track: Vec<Option<&Agent>> = ahead
            .iter()
            .take(plan.len())
            .map(|frame| frame.agent(agent.id))
            .collect();
        moves(agent, &track) && comes_near(&own, agent, &track, scenario.dt)
    });
    concerned.map(|agent| agent.id).collect()
}

fn moves(agent: &Agent, track: &[Option<&Agent>]) -> bool {
    let from = agent.state.pose.position;
    let mut seen = track.iter().flatten();
    seen.any(|later| later.state.pose.position.distance(from) > MOVES_M)
}

/// True if the boxes of a track come near those of the ego at about the same time; with the extent
/// of the present, since a tracker's changes from frame to frame.
fn comes_near(own: &[OrientedBox], agent: &Agent, track: &[Option<&Agent>], dt: f64) -> bool {
    let steps = |seconds: f64| (seconds / dt).round() as usize;
    let reach = NEAR_M + (agent.length + agent.width + own[0].length + own[0].width) / 2.0;
    track.iter().enumerate().any(|(j, there)| {
        let Some(there) = there else {
            return false;
        };
        let its = agent.with_state(there.state).oriented_box();
        // An agent at frame j matters if the ego is there from 3 s before to 1 s after it.
        let from = j.saturating_sub(steps(AFTER_S));
        let until = (j + steps(BEFORE_S) + 1).min(own.len());
        own[from..until].iter().any(|own| {
            let centres = own.pose.position.distance_squared(its.pose.position);
            centres < reach * reach && own.signed_distance(&its) < NEAR_M
        })
    })
}
