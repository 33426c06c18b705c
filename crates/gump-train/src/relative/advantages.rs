//! From the worth of rollouts to the advantage of each of their moves.

use gump_metrics::behaviour::{Behaviour, Measure, Seen};
use gump_scene::{AgentId, AgentKind, Rollout, Scenario};
use gump_wosac::realism::{Component, Evaluation, LeaveOneOut};

use crate::relative::settings::{Advantage, RelativeRewards};

/// Advantages are clipped to this many standard deviations, so that rare ones do not outweigh a
/// batch. Chosen by hand.
const MOST: f64 = 3.0;
/// Seconds that are judged: as many as the metric scores.
const HORIZON_S: u32 = 8;
/// Differences of returns smaller than this are rounding and ignored, in units of the metametric.
const LEAST: f64 = 1e-9;

/// Numbers of the moves of each future, `[future][agent, move]`.
pub(super) type ByMove = Vec<Vec<f64>>;

/// The scored step at which each agent first commits a fault, `[future][agent]`; `None` where it never
/// does.
type Firsts = Vec<Vec<Option<usize>>>;

/// A fault, and where agents first commit it.
pub(super) struct Fault {
    /// By how many standard deviations it lowers the advantages of the moves before it.
    pub(super) weight: f64,
    pub(super) first: Firsts,
}

/// Faults that the metric knows, all of weight [`RelativeRewards::dense`].
const MEASURED: [Component; 3] = [
    Component::Collision,
    Component::Offroad,
    Component::TrafficLightViolation,
];

/// Faults of weight [`RelativeRewards::conduct`]. What an agent cannot know is none: whether who
/// stands will stand throughout the log.
const CONDUCT: [Measure; 3] = [
    Measure::FreeRoadStop,
    Measure::HardAcceleration,
    Measure::Slip,
];

/// The faults in the futures of the agents of an evaluation, without those that the same agent
/// commits in its log: driveways are behind the edge of the road. Collisions of people are left out as
/// well: recorded people walk side by side and close to vehicles, and with a penalty they stop before
/// these.
pub(super) fn faults(
    rewards: &RelativeRewards,
    evaluation: &Evaluation<'_>,
    agents: &[AgentId],
    scenario: &Scenario,
    futures: &[Rollout],
) -> Vec<Fault> {
    let mut faults = Vec::new();
    if rewards.dense > 0.0 {
        faults.extend(MEASURED.map(|component| Fault {
            weight: rewards.dense,
            first: measured(evaluation, component, agents, futures),
        }));
    }
    if rewards.conduct > 0.0 {
        faults.extend(conduct(scenario, agents, futures).map(|first| Fault {
            weight: rewards.conduct,
            first,
        }));
    }
    faults
}

fn measured(
    evaluation: &Evaluation<'_>,
    component: Component,
    agents: &[AgentId],
    futures: &[Rollout],
) -> Firsts {
    let (in_log, _) = evaluation.indications(component);
    let mut firsts = evaluation.first_indications(component);
    let collides = component == Component::Collision;
    for (own, future) in firsts.iter_mut().zip(futures) {
        for ((first, &in_log), &id) in own.iter_mut().zip(&in_log).zip(agents) {
            let is_none = in_log || collides && is_person(future, id);
            *first = first.filter(|_| !is_none);
        }
    }
    firsts
}

fn is_person(future: &Rollout, id: AgentId) -> bool {
    let first = future.imagined().first();
    let agent = first.and_then(|frame| frame.agent(id));
    agent.is_some_and(|agent| agent.kind == AgentKind::Pedestrian)
}

fn conduct(
    scenario: &Scenario,
    agents: &[AgentId],
    futures: &[Rollout],
) -> [Firsts; CONDUCT.len()] {
    let behaviour = Behaviour::new(scenario, HORIZON_S);
    let log = behaviour.log();
    let seen: Vec<Seen> = futures.iter().map(|future| behaviour.of(future)).collect();
    // Incidents are sorted by time.
    let first = |seen: &Seen, measure: Measure, id: AgentId| {
        let mut incidents = seen.incidents.iter();
        let found = incidents.find(|one| one.measure == measure && one.agent == id)?;
        // The first step is one `dt` after the present.
        Some(((found.at_s / scenario.dt).round() as usize).saturating_sub(1))
    };
    CONDUCT.map(|measure| {
        let of_future = |seen: &Seen| {
            let own = agents.iter().map(|&id| {
                let in_log = first(&log, measure, id).is_some();
                first(seen, measure, id).filter(|_| !in_log)
            });
            own.collect()
        };
        seen.iter().map(of_future).collect()
    })
}

/// The advantage of every move of the scored agents; `None` if all futures are equally good.
/// `realism` is the metametric of all futures, `per_move` the number of scored steps of a move.
///
/// The returns of the futures minus their mean, in standard deviations of the group; faults are
/// subtracted in that unit, less their own mean over the futures.
pub(super) fn advantages(
    rewards: &RelativeRewards,
    (realism, worth): (f64, &LeaveOneOut),
    faults: &[Fault],
    per_move: usize,
) -> Option<ByMove> {
    let n_moves = worth.n_steps / per_move;
    let returns = match rewards.advantage {
        Advantage::Agent => returns(worth, per_move),
        Advantage::Scene => {
            let n = worth.agents.len() * n_moves;
            let others = worth.metametric.iter();
            others.map(|others| vec![realism - others; n]).collect()
        }
    };
    let credited = standardized(returns);
    if faults.is_empty() {
        return Some(clipped(credited?));
    }
    let (n_futures, n_agents) = (worth.credit.len(), worth.agents.len());
    let penalties = (0..n_futures).map(|future| {
        let of_agent = |agent| penalties(faults, (future, agent), n_moves, per_move);
        (0..n_agents).flat_map(of_agent).collect()
    });
    let (mut penalties, differ) = centred(penalties.collect());
    if credited.is_none() && differ == 0.0 {
        return None;
    }
    for (i, own) in penalties.iter_mut().enumerate() {
        for (at, penalty) in own.iter_mut().enumerate() {
            *penalty += credited.as_ref().map_or(0.0, |credited| credited[i][at]);
        }
    }
    Some(clipped(penalties))
}

/// The return of each move: the parts of its agent from its own step on.
fn returns(worth: &LeaveOneOut, per_move: usize) -> ByMove {
    let of_future = |credit: &Vec<f64>| {
        let agents = credit.chunks(worth.n_steps);
        agents.flat_map(|own| to_go(own, per_move)).collect()
    };
    worth.credit.iter().map(of_future).collect()
}

/// The return of each move, given the reward at each step.
fn to_go(credit: &[f64], per_move: usize) -> Vec<f64> {
    let mut earned: Vec<f64> = credit
        .chunks_exact(per_move)
        .map(|steps| steps.iter().sum())
        .collect();
    for k in (1..earned.len()).rev() {
        earned[k - 1] += earned[k];
    }
    earned
}

/// For each move of an agent of a future minus the weight of each fault that it first commits in this
/// move or later.
fn penalties(
    faults: &[Fault],
    (future, agent): (usize, usize),
    n_moves: usize,
    per_move: usize,
) -> Vec<f64> {
    let mut rewards = vec![0.0; n_moves * per_move];
    for fault in faults {
        let first = fault.first[future][agent];
        // Steps after the last whole move belong to none.
        if let Some(reward) = first.and_then(|step| rewards.get_mut(step)) {
            *reward -= fault.weight;
        }
    }
    to_go(&rewards, per_move)
}

/// Less the mean over the futures; with the sum of squares that is left.
fn centred(mut all: ByMove) -> (ByMove, f64) {
    let n = all.len() as f64;
    let n_moves = all.first().map_or(0, Vec::len);
    let mut squares = 0.0;
    for at in 0..n_moves {
        let mean = all.iter().map(|earned| earned[at]).sum::<f64>() / n;
        for earned in &mut all {
            earned[at] -= mean;
            squares += earned[at] * earned[at];
        }
    }
    (all, squares)
}

/// Less the mean over the futures, in standard deviations of the group; `None` if the differences
/// are negligible.
fn standardized(all: ByMove) -> Option<ByMove> {
    let n = all.len() * all.first()?.len();
    let (mut all, squares) = centred(all);
    let spread = (squares / n as f64).sqrt();
    if spread.is_nan() || spread <= LEAST {
        return None;
    }
    all.iter_mut().flatten().for_each(|own| *own /= spread);
    Some(all)
}

fn clipped(mut all: ByMove) -> ByMove {
    let moves = all.iter_mut().flatten();
    moves.for_each(|own| *own = own.clamp(-MOST, MOST));
    all
}

#[cfg(test)]
mod tests {
    use gump_geometry::DVec2;
    use gump_wosac::realism::{Config, Log, Mode, Reference, Rollouts, Year};

    use super::*;

    /// Two agents with four steps, two moves each.
    fn worth() -> LeaveOneOut {
        LeaveOneOut {
            metametric: vec![0.5, 0.6, 0.55],
            agents: vec![AgentId(1), AgentId(2)],
            n_steps: 4,
            credit: vec![
                vec![0.0, 0.1, 0.2, 0.0, 0.0, 0.0, 0.1, 0.1],
                vec![0.1, 0.0, 0.0, -0.1, 0.2, 0.0, 0.0, 0.0],
                vec![0.0, 0.0, 0.1, 0.0, 0.0, 0.1, 0.0, 0.3],
            ],
        }
    }

    const REALISM: f64 = 0.58;

    /// Nobody's faults, of two kinds.
    fn nobody(weights: [f64; 2]) -> Vec<Fault> {
        let of = |weight| Fault {
            weight,
            first: vec![vec![None; 2]; 3],
        };
        weights.map(of).into()
    }

    fn found(rewards: &RelativeRewards, worth: &LeaveOneOut, faults: &[Fault]) -> Option<ByMove> {
        advantages(rewards, (REALISM, worth), faults, 2)
    }

    fn rewards(advantage: Advantage) -> RelativeRewards {
        RelativeRewards {
            advantage,
            ..RelativeRewards::default()
        }
    }

    fn close(found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-12, "{found} {expected}");
    }

    #[test]
    fn moves_of_an_agent_are_credited_with_what_follows() {
        let found = found(&rewards(Advantage::Agent), &worth(), &[]).unwrap();
        let returns = [
            [0.3, 0.2, 0.2, 0.2],
            [0.0, -0.1, 0.2, 0.0],
            [0.1, 0.1, 0.4, 0.3],
        ];
        let mean = |at: usize| returns.iter().map(|own| own[at]).sum::<f64>() / 3.0;
        let off = |i: usize, at: usize| returns[i][at] - mean(at);
        let places = || (0..3).flat_map(|i| (0..4).map(move |at| (i, at)));
        let squares: f64 = places().map(|(i, at)| off(i, at).powi(2)).sum();
        let spread = (squares / 12.0).sqrt();
        places().for_each(|(i, at)| close(found[i][at], off(i, at) / spread));
    }

    #[test]
    fn moves_of_a_future_are_credited_with_its_worth() {
        let found = found(&rewards(Advantage::Scene), &worth(), &[]).unwrap();
        // What each future adds, less the mean; the others are worth 0.5, 0.6 and 0.55.
        let off = [0.05, -0.05, 0.0];
        let spread = (2.0 * 0.05f64.powi(2) / 3.0).sqrt();
        for (own, off) in found.iter().zip(off) {
            assert_eq!(own.len(), 4);
            own.iter().for_each(|own| close(*own, off / spread));
        }
        let equal = LeaveOneOut {
            metametric: vec![0.5; 3],
            ..worth()
        };
        let scene = rewards(Advantage::Scene);
        assert!(self::found(&scene, &equal, &[]).is_none());
    }

    #[test]
    fn a_collision_lowers_the_advantages_of_the_moves_before_it() {
        // The second agent of the first future commits the first kind in its second move, the first
        // agents of the third and the second the other in their first and second.
        let mut faults = nobody([0.3, 0.6]);
        faults[0].first[0][1] = Some(2);
        faults[1].first[2][0] = Some(1);
        faults[1].first[1][0] = Some(3);
        for advantage in [Advantage::Agent, Advantage::Scene] {
            let plain = found(&rewards(advantage), &worth(), &[]).unwrap();
            let dense = found(&rewards(advantage), &worth(), &faults).unwrap();
            let change = |i: usize, at: usize| dense[i][at] - plain[i][at];
            // Two thirds of the weight less than before; the other futures share what it lost.
            for at in [2, 3] {
                close(change(0, at), -0.2);
                close(change(1, at), 0.1);
            }
            // Of the first two moves of the first agents: 0, -1, -1 and 0, -1, 0, less their means.
            close(change(0, 0), 0.4);
            close(change(1, 0), -0.2);
            close(change(2, 0), -0.2);
            close(change(0, 1), 0.2);
            close(change(1, 1), -0.4);
            close(change(2, 1), 0.2);
        }
        // It is enough on its own to compare futures that realism does not tell apart.
        let equal = LeaveOneOut {
            metametric: vec![0.5; 3],
            ..worth()
        };
        let scene = rewards(Advantage::Scene);
        let alone = found(&scene, &equal, &faults).unwrap();
        close(alone[0][3], -0.2);
        assert!(found(&scene, &equal, &nobody([0.3, 0.3])).is_none());
    }

    /// A person walks into a vehicle, and a vehicle into another.
    #[test]
    fn people_do_not_collide_and_vehicles_do() {
        let text = "lane 1: 0,0 200,0\nedge: 0,-3 200,-3\nego vehicle 0: 10,0 velocity 8,0
             agent vehicle 1: 100,0\nagent pedestrian 2: 95,6 velocity 0,0
             agent vehicle 3: 95,10";
        let scenario = gump_scene::fixture::scenario(text).unwrap();
        let future = |collides: bool| {
            let mut future = Rollout::begin(scenario.present());
            for (k, frame) in scenario.future().iter().enumerate() {
                let moved = frame.agents().iter().map(|agent| {
                    let mut agent = *agent;
                    let to = match agent.id.0 {
                        0 => DVec2::new(100.0, 0.0),
                        2 => DVec2::new(95.0, 10.0),
                        _ => agent.state.pose.position,
                    };
                    if collides && k >= 20 {
                        agent.state.pose.position = to;
                    }
                    agent
                });
                future.push(gump_scene::Frame::new(moved.collect(), Vec::new()));
            }
            future
        };
        let futures = [future(false), future(true)];
        let log = Log::of(&scenario).unwrap();
        let metric = Config::of(Year::Y2025);
        let reference = Reference::new(&log, &metric).unwrap();
        let rollouts = Rollouts::of(&scenario.id, &futures, Mode::SimAgents).unwrap();
        let evaluation = reference.evaluate(&rollouts).unwrap();
        let agents = evaluation.leave_one_out().unwrap().agents;
        let rewards = RelativeRewards {
            dense: 0.5,
            ..RelativeRewards::default()
        };
        let found = faults(&rewards, &evaluation, &agents, &scenario, &futures);
        // Collisions are first.
        let first = |future: usize, id: i64| {
            let at = agents.iter().position(|agent| *agent == AgentId(id));
            found[0].first[future][at.unwrap()]
        };
        assert_eq!((first(1, 0), first(1, 1)), (Some(20), Some(20)));
        assert_eq!((first(1, 2), first(1, 3)), (None, Some(20)));
        assert!([0, 1, 2, 3].iter().all(|id| first(0, *id).is_none()));
    }

    /// The ego slides to the left from the third second on, as another did in the log.
    #[test]
    fn who_slips_sideways_is_at_fault_unless_its_log_does() {
        let text = "lane 1: 0,0 200,0\nego vehicle 0: 10,0 velocity 8,0
             agent vehicle 1: 60,0 velocity 8,0\nagent vehicle 2: 100,0 velocity 8,0";
        let mut scenario = gump_scene::fixture::scenario(text).unwrap();
        let slide = |frame: &gump_scene::Frame, k: usize, who: &[i64]| {
            let moved = frame.agents().iter().map(|agent| {
                let mut agent = *agent;
                if who.contains(&agent.id.0) {
                    agent.state.pose.position.y += 0.2 * k.saturating_sub(30) as f64;
                }
                agent
            });
            gump_scene::Frame::new(moved.collect(), Vec::new())
        };
        let future = |who: &[i64]| {
            let mut future = Rollout::begin(scenario.present());
            let frames = scenario.future().iter().enumerate();
            frames.for_each(|(k, frame)| future.push(slide(frame, k, who)));
            future
        };
        let futures = [future(&[]), future(&[0, 1])];
        let agents = [0, 1, 2].map(AgentId);
        let [stops, hard, slips] = conduct(&scenario, &agents, &futures);
        assert_eq!(stops, [[None; 3]; 2]);
        assert_eq!(hard, [[None; 3]; 2]);
        assert_eq!(slips[0], [None; 3]);
        let [Some(one), Some(other), None] = slips[1][..] else {
            panic!("{slips:?}");
        };
        // Velocity is measured over half a second.
        assert!(one == other && (26..=31).contains(&one), "{one} {other}");
        let start = scenario.now + 1;
        for (k, frame) in scenario.log[start..].iter_mut().enumerate() {
            *frame = slide(frame, k, &[1]);
        }
        let [.., slips] = conduct(&scenario, &agents, &futures);
        assert_eq!(slips[1], [Some(one), None, None]);
    }

    #[test]
    fn advantages_are_clipped() {
        let mut faults = nobody([100.0, 0.0]);
        faults[0].first[0][1] = Some(2);
        let found = found(&rewards(Advantage::Agent), &worth(), &faults).unwrap();
        assert_eq!((found[0][2], found[1][2]), (-MOST, MOST));
    }
}
