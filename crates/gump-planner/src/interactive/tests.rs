//! Decisions in worlds with a law that is known.

use std::cell::Cell;
use std::sync::Mutex;

use approx::assert_abs_diff_eq;
use gump_geometry::DVec2;
use gump_nuplan::closed_loop::{Recording, derive_roadblocks};
use gump_rollout::worlds::{ConstantVelocity, Idm};
use gump_rollout::{RolloutError, Session, Start};
use gump_scene::{Agent, AgentId, AgentState, Frame, fixture};

use super::*;
use crate::closed_loop::plan_once;
use crate::{PdmClosed, Side};

const STREET: &str = "
    lane 1: -30,0 300,0 speed 12
    drivable: -30,-4 300,-4 300,4 -30,4
    route 1
";

/// The same without shoulders: a line beside the centre is off the road.
pub(super) const NARROW: &str = "
    lane 1: -30,0 300,0 speed 12
    drivable: -30,-1.75 300,-1.75 300,1.75 -30,1.75
    route 1
";

pub(super) fn recording(text: &str) -> Recording {
    recording_on(STREET, text)
}

pub(super) fn recording_on(street: &str, text: &str) -> Recording {
    let mut scenario = fixture::scenario(&format!("{street}{text}")).unwrap();
    derive_roadblocks(&mut scenario);
    Recording::of_boxes(scenario).unwrap()
}

fn decide(world: &dyn WorldModel, config: InteractiveDriverConfig, text: &str) -> Decision {
    decide_on(&recording(text), world, config)
}

fn decide_on(
    scene: &Recording,
    world: &dyn WorldModel,
    config: InteractiveDriverConfig,
) -> Decision {
    let mut driver = InteractiveDriver::new(world, config).unwrap();
    plan_once(scene, &mut driver).unwrap();
    driver.decision.unwrap()
}

/// Some speeds on some lines, no imitation.
pub(super) fn only(speeds: &[f64], offsets: &[f64]) -> InteractiveDriverConfig {
    InteractiveDriverConfig {
        proposals: PdmConfig {
            speed_fractions: speeds.to_vec(),
            lateral_offsets: offsets.to_vec(),
            ..PdmConfig::default()
        },
        imitation: false,
        driving_styles: false,
        hedge: 0.0,
        allocation: Allocation::Uniform,
        ..InteractiveDriverConfig::default()
    }
}

fn fraction(evaluation: &CandidateEvaluation) -> f64 {
    match evaluation.kind {
        ProposalKind::Idm { speed_fraction, .. } | ProposalKind::Brisk { speed_fraction } => {
            speed_fraction
        }
        other => panic!("{other} has no speed"),
    }
}

/// State of an agent other than the ego in half a second, from the agent now, the ego with its next
/// state, and a seed.
pub(super) type Law = fn(&Agent, &Agent, Seed) -> AgentState;

/// A world by a law, at 2 Hz; the ego goes straight on if it is not driven.
pub(super) struct ByLaw(pub(super) Law);

struct Futures {
    law: Law,
    now: Vec<(Frame, Seed, AgentId)>,
}

impl WorldModel for ByLaw {
    fn name(&self) -> &str {
        "law"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let futures = starts.iter().flat_map(|start| {
            let scene = start.scene;
            (0..start.n_futures as u64)
                .map(move |k| (scene.now().clone(), start.seed.fork(k), scene.ego))
        });
        Ok(Box::new(Futures {
            law: self.0,
            now: futures.collect(),
        }))
    }
}

impl Session for Futures {
    fn dt(&self) -> f64 {
        0.5
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        for (i, (frame, seed, id)) in self.now.iter_mut().enumerate() {
            let own = frame.agent(*id).unwrap();
            let own = own.with_state(ego.map_or_else(|| coasted(own), |states| states[i]));
            let next = frame.agents().iter().map(|agent| {
                if agent.id == *id {
                    own
                } else {
                    agent.with_state((self.law)(agent, &own, seed.fork(agent.id.0 as u64)))
                }
            });
            *frame = Frame::new(next.collect(), vec![]);
        }
        Ok(self.now.iter().map(|(frame, ..)| frame.clone()).collect())
    }

    fn replace(&mut self, _: usize, _: Start<'_>) -> Result<(), BoxError> {
        Err("no future is ever replaced".into())
    }
}

pub(super) fn coasted(agent: &Agent) -> AgentState {
    let mut state = agent.state;
    state.pose.position += state.velocity * 0.5;
    state
}

/// Stops at once if the ego approaches fast, else drives on.
fn yields_to_the_bold(agent: &Agent, ego: &Agent, _: Seed) -> AgentState {
    if ego.state.speed() > 3.5 {
        return AgentState {
            velocity: DVec2::ZERO,
            ..agent.state
        };
    }
    coasted(agent)
}

/// Keeps its direction at a speed drawn once per future.
pub(super) fn at_random_speed(agent: &Agent, _: &Agent, seed: Seed) -> AgentState {
    let factor = (seed.0 % 2000) as f64 / 1000.0;
    let mut state = agent.state;
    state.pose.position += agent.state.pose.direction() * (6.0 * factor * 0.5);
    state
}

/// A vehicle comes from the right and would be in the way in three to four seconds.
const CROSSING: &str = "ego vehicle 0: 2,0 velocity 3,0 size 5,2
    agent vehicle 1: 24,-22 velocity 0,6";

#[test]
fn who_moves_first_is_let_in_and_a_forecast_does_not_know_it() {
    let mut pdm = PdmClosed::default();
    plan_once(&recording(CROSSING), &mut pdm).unwrap();
    let waits = pdm.scores()[pdm.best()].progress_m;
    // All fast policies hit the other in the forecast ...
    assert_eq!(
        pdm.scores()[4].no_at_fault_collision,
        0.0,
        "{:#?}",
        pdm.scores()
    );
    assert!(waits < 16.0, "{waits}");
    // ... but not where the other answers.
    let trusting = || InteractiveDriverConfig {
        hedge: 0.0,
        ..InteractiveDriverConfig::default()
    };
    let world = ByLaw(yields_to_the_bold);
    let decision = decide(&world, trusting(), CROSSING);
    let chosen = &decision.candidates[decision.chosen];
    assert!(chosen.progress_m > waits + 5.0, "{}", chosen.progress_m);
    assert!(fraction(chosen) > 0.5 && chosen.collisions == 0);
    // With others that do not react it waits as well.
    let deaf = ByLaw(|agent, _, _| coasted(agent));
    let decision = decide(&deaf, trusting(), CROSSING);
    assert!(decision.candidates[decision.chosen].progress_m < waits + 2.0);
}

#[test]
fn a_hedge_keeps_from_relying_on_others() {
    let world = ByLaw(yields_to_the_bold);
    let with = |hedge: f64| {
        let config = InteractiveDriverConfig {
            hedge,
            ..InteractiveDriverConfig::default()
        };
        let decision = decide(&world, config, CROSSING);
        decision.candidates[decision.chosen].clone()
    };
    let (bold, careful) = (with(0.0), with(0.9));
    assert_eq!(bold.hedge, None);
    assert!(bold.progress_m > careful.progress_m + 5.0);
    // The careful candidate has no collision among agents that do not react, either.
    let hedge = careful.hedge.unwrap();
    assert!(hedge.total > 0.5, "{hedge:?}");
    let value = 0.1 * careful.score.mean + 0.9 * hedge.total;
    assert_abs_diff_eq!(careful.value, value, epsilon = 1e-12);
}

/// Two lanes, of which the right one ends after 70 m.
const MERGE: &str = "
    lane 1: -30,0 70,0 speed 12 left 2
    lane 2: -30,3.5 70,3.5 speed 12 right 1 next 3
    lane 3: 70,3.5 400,3.5 speed 12
    drivable: -30,-2 70,-2 70,1.5 400,1.5 400,5.5 -30,5.5
    route 1,2,3
    ego vehicle 0: 20,0 velocity 10,0";

fn merging(others: &str, config: InteractiveDriverConfig) -> Decision {
    let mut scenario = fixture::scenario(&format!("{MERGE}\n{others}")).unwrap();
    derive_roadblocks(&mut scenario);
    let recording = Recording::of_boxes(scenario).unwrap();
    let mut driver = InteractiveDriver::new(&ConstantVelocity, config).unwrap();
    plan_once(&recording, &mut driver).unwrap();
    driver.decision.unwrap()
}

#[test]
fn a_lane_that_ends_is_left() {
    let config = InteractiveDriverConfig {
        imitation: false,
        ..InteractiveDriverConfig::default()
    };
    let decision = merging("", config.clone());
    let chosen = &decision.candidates[decision.chosen];
    let left = ProposalKind::LaneChange {
        speed_fraction: 1.0,
        side: Side::Left,
    };
    assert_eq!(chosen.kind, left);
    let end = chosen.drives[0].last().unwrap().rear_axle;
    assert!((3.0..4.0).contains(&end.position.y), "{end:?}");
    // Not into a vehicle that drives beside it.
    let beside = merging("agent vehicle 1: 21,3.5 velocity 10,0", config.clone());
    let chosen = &beside.candidates[beside.chosen];
    assert_eq!(chosen.collisions, 0);
    assert!(chosen.score.mean > 0.0);
    // Without them there are as many candidates as on a road of one lane.
    let none = InteractiveDriverConfig {
        lane_changes: false,
        ..config
    };
    assert_eq!(
        merging("", none).candidates.len() + 2,
        decision.candidates.len()
    );
}

/// Speed and line of the chosen one.
fn fraction_and_offset(decision: &Decision) -> (f64, f64) {
    match decision.candidates[decision.chosen].kind {
        ProposalKind::Idm {
            speed_fraction,
            lateral_offset,
        } => (speed_fraction, lateral_offset),
        other => panic!("{other} was chosen"),
    }
}

/// All fifteen policies, no imitation.
pub(super) fn ruled() -> InteractiveDriverConfig {
    InteractiveDriverConfig {
        imitation: false,
        driving_styles: false,
        n_futures: 2,
        allocation: Allocation::Uniform,
        ..InteractiveDriverConfig::default()
    }
}

pub(super) const FREE: &str = "ego vehicle 0: 10,0 velocity 10,0";

#[test]
fn a_free_road_is_driven_fast_and_in_the_middle() {
    let decision = decide(&ConstantVelocity, ruled(), FREE);
    assert_eq!(fraction_and_offset(&decision), (1.0, 0.0));
}

#[test]
fn a_stopped_vehicle_is_stopped_for() {
    let text = format!("{FREE}\n agent vehicle 1: 45,0");
    let vehicle = *recording(&text).vehicle();
    for world in [&ConstantVelocity as &dyn WorldModel, &Idm::default()] {
        let decision = decide(world, ruled(), &text);
        let chosen = &decision.candidates[decision.chosen];
        // It brakes late, so after the four seconds that are imagined it may still roll; that it
        // comes to a stop is seen in the closed loop.
        for drive in &chosen.drives {
            let last = drive.last().unwrap().agent_state(&vehicle);
            assert!(
                last.speed() < 6.0 && last.pose.position.x < 45.0 - 4.8,
                "{last:?}"
            );
        }
        assert_eq!(chosen.collisions, 0);
        assert!(chosen.score.mean > 0.0 && !decision.brakes);
    }
}

#[test]
fn every_candidate_keeps_its_score() {
    let text = format!("{FREE}\n agent vehicle 1: 60,0 velocity 5,0");
    let decision = decide(&ConstantVelocity, ruled(), &text);
    assert_eq!(decision.candidates.len(), 15);
    let chosen = decision.candidates[decision.chosen].score.mean;
    for evaluation in &decision.candidates {
        let score = &evaluation.score;
        assert_eq!((score.futures.len(), evaluation.value), (2, score.mean));
        assert!(score.mean <= chosen + 1e-6);
        // The futures of this world are equal.
        assert_eq!(score.standard_error, Some(0.0));
        for future in &score.futures {
            let names = future.gates.iter().map(|gate| gate.name);
            assert_eq!(
                names.collect::<Vec<_>>(),
                [
                    "no_at_fault_collisions",
                    "drivable_area",
                    "driving_direction"
                ]
            );
            // Gates multiply, terms add with weights of 5, 5, 4 and 2 of 16.
            let gates: f64 = future.gates.iter().map(|gate| gate.factor).product();
            let terms = future.terms.iter().map(|term| term.value.unwrap());
            let weighted = terms
                .zip([5.0, 5.0, 4.0, 2.0])
                .map(|(value, w)| value * w / 16.0);
            assert_abs_diff_eq!(future.total, gates * weighted.sum::<f64>(), epsilon = 1e-12);
        }
    }
}

#[test]
fn progress_is_what_is_driven() {
    let decision = decide(&ConstantVelocity, ruled(), FREE);
    // The centred policy for 20 % of 12 m/s brakes from 10 m/s; the one for all of it goes farthest.
    let farthest = decision.candidates[4].progress_m;
    for evaluation in &decision.candidates[..5] {
        let drive = &evaluation.drives[0];
        let driven = drive[40].rear_axle.position.x - drive[0].rear_axle.position.x;
        assert_abs_diff_eq!(evaluation.progress_m, driven, epsilon = 1e-9);
        let parts = evaluation.score.parts();
        let (_, share) = parts.iter().find(|(name, _)| *name == "progress").unwrap();
        assert_abs_diff_eq!(*share, driven / farthest, epsilon = 1e-9);
    }
}

#[test]
fn plans_repeat_and_do_not_depend_on_earlier_plans() {
    let world = Idm::default();
    let a = recording(&format!("{FREE}\n agent vehicle 1: 50,0 velocity 6,0"));
    let b = recording(FREE);
    let result = |driver: &mut InteractiveDriver<'_>, recording: &Recording| {
        let plan = plan_once(recording, driver).unwrap();
        let decision = driver.decision().unwrap();
        let of = |p: &CandidateEvaluation| (p.kind, p.score.clone(), p.drives.clone());
        let evaluations: Vec<_> = decision.candidates.iter().map(of).collect();
        (plan, decision.chosen, evaluations)
    };
    let new = || InteractiveDriver::new(&world, ruled()).unwrap();
    let mut driver = new();
    let first = result(&mut driver, &a);
    result(&mut driver, &b);
    assert_eq!(result(&mut driver, &a), first);
    assert_eq!(result(&mut new(), &a), first);
}

#[test]
fn the_emergency_brake_is_the_last_resort() {
    let text = "ego vehicle 0: 10,0 velocity 4,0 size 5,2
        agent vehicle 1: 16.5,0 size 5,2 heading 1.5707963267948966";
    let mut driver = InteractiveDriver::new(&ConstantVelocity, ruled()).unwrap();
    let way = plan_once(&recording(text), &mut driver).unwrap();
    let decision = driver.decision().unwrap();
    assert!(decision.brakes);
    assert!(decision.candidates.iter().all(|p| p.score.is_hopeless()));
    let candidates = driver.candidates();
    let (brake, judged) = candidates.split_last().unwrap();
    assert_eq!((judged.len(), brake.name.as_str()), (15, "emergency brake"));
    assert!(brake.chosen && brake.score.is_none());
    assert!(judged.iter().all(|c| !c.chosen && c.score == Some(0.0)));
    // What is followed lies behind: the tracker brakes hard.
    let end = way.states()[80].rear_axle.position.x - way.states()[0].rear_axle.position.x;
    assert!(end < 0.0, "{end}");
}

/// A vehicle at the side pulls out in front of the ego; the rest is constant velocity.
pub(super) struct PullsOut {
    pub(super) starts: Mutex<Vec<(usize, Seed)>>,
}

struct PullingOut<'a>(Box<dyn Session + 'a>);

impl WorldModel for PullsOut {
    fn name(&self) -> &str {
        "pulls-out"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let new = starts.iter().map(|start| (start.n_futures, start.seed));
        self.starts.lock().unwrap().extend(new);
        Ok(Box::new(PullingOut(ConstantVelocity.open(starts)?)))
    }
}

impl Session for PullingOut<'_> {
    fn dt(&self) -> f64 {
        self.0.dt()
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        let frames = self.0.step(ego)?.into_iter().map(|frame| {
            let mut agents = frame.agents().to_vec();
            let intruder = agents.iter_mut().find(|agent| agent.id == AgentId(1));
            if let Some(intruder) = intruder {
                intruder.state.pose.position.y = 0.0;
            }
            Frame::new(agents, vec![])
        });
        Ok(frames.collect())
    }

    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
        self.0.replace(future, start)
    }
}

#[test]
fn what_the_world_imagines_decides() {
    let text = format!("{FREE}\n agent vehicle 1: 50,6");
    let (fast, _) = fraction_and_offset(&decide(&ConstantVelocity, ruled(), &text));
    let world = PullsOut {
        starts: Mutex::default(),
    };
    let decision = decide(&world, ruled(), &text);
    let progress = |decision: &Decision| decision.candidates[decision.chosen].progress_m;
    let free = progress(&decide(&ConstantVelocity, ruled(), &text));
    assert!(progress(&decision) < free, "{fast} is driven as far");
    // Common random numbers: one session, every candidate from the same seed.
    let seed = Seed(0).fork(0);
    assert_eq!(*world.starts.lock().unwrap(), [(2, seed); 15]);
}

#[test]
fn turning_the_world_turns_the_decision() {
    let plan = |text: &str| {
        let mut scenario = fixture::scenario(text).unwrap();
        derive_roadblocks(&mut scenario);
        let recording = Recording::of_boxes(scenario).unwrap();
        let mut driver = InteractiveDriver::new(&ConstantVelocity, ruled()).unwrap();
        plan_once(&recording, &mut driver).unwrap();
        driver.decision().unwrap().clone()
    };
    let straight = plan(
        "lane 1: 0,0 200,0 speed 10\n drivable: 0,-4 200,-4 200,4 0,4\n route 1
         ego vehicle 0: 10,0.5 velocity 6,0\n agent vehicle 1: 40,0 velocity 3,0",
    );
    let turned = plan(
        "lane 1: 0,0 0,200 speed 10\n drivable: 4,0 4,200 -4,200 -4,0\n route 1
         ego vehicle 0: -0.5,10 velocity 0,6\n agent vehicle 1: 0,40 velocity 0,3",
    );
    assert_eq!(straight.chosen, turned.chosen);
    for (a, b) in straight.candidates.iter().zip(&turned.candidates) {
        assert_abs_diff_eq!(a.value, b.value, epsilon = 1e-9);
        for (a, b) in a.drives[0].iter().zip(&b.drives[0]) {
            let there = a.rear_axle.position.perp();
            assert_abs_diff_eq!(there.distance(b.rear_axle.position), 0.0, epsilon = 1e-9);
        }
    }
}

#[test]
fn a_single_candidate_is_taken() {
    let config = only(&[0.6], &[0.0]);
    let decision = decide(&ConstantVelocity, config, "ego vehicle 0: 2,0 velocity 5,0");
    assert_eq!((decision.candidates.len(), decision.chosen), (1, 0));
    assert!(!decision.brakes && decision.horizon == 4.0);
}

#[test]
fn the_one_that_hits_something_is_left_whatever_the_seed() {
    let text = "ego vehicle 0: 2,0 velocity 8,0 size 5,2
        agent vehicle 1: 22,2.6 size 5,2
        agent vehicle 2: 60,0 velocity 6,0";
    let world = ByLaw(|agent, ego, seed| match agent.id {
        AgentId(1) => agent.state,
        _ => at_random_speed(agent, ego, seed),
    });
    for seed in 0..8 {
        let config = InteractiveDriverConfig {
            seed: Seed(seed),
            ..only(&[0.8], &[1.0, 0.0])
        };
        let decision = decide(&world, config, text);
        assert_eq!(decision.chosen, 1, "{:?}", decision.candidates[0].score);
    }
}

#[test]
fn values_follow_their_candidates() {
    let text = "ego vehicle 0: 2,0 velocity 6,0
        agent vehicle 1: 25,0 velocity 5,0";
    let world = ByLaw(at_random_speed);
    let speeds = [0.2, 0.5, 1.0];
    let forward = decide(&world, only(&speeds, &[0.0]), text);
    let reversed = decide(&world, only(&[1.0, 0.5, 0.2], &[0.0]), text);
    for (a, b) in forward
        .candidates
        .iter()
        .zip(reversed.candidates.iter().rev())
    {
        assert_eq!(a.score, b.score);
        assert_eq!(a.drives, b.drives);
    }
}

#[test]
fn the_world_is_told_exactly_where_the_ego_is() {
    let text = "ego vehicle 0: 2,0.4 velocity 6,0 size 5,2
        agent vehicle 1: 30,0 velocity 5,0";
    let recording = recording(text);
    for world in [&ByLaw(at_random_speed) as &dyn WorldModel, &Idm::default()] {
        let decision = decide(world, only(&[0.4, 1.0], &[0.0, -1.0]), text);
        let mut n_complete = 0;
        for evaluation in &decision.candidates {
            n_complete += usize::from(evaluation.futures[0].steps() == 8);
            for (future, drive) in evaluation.futures.iter().zip(&evaluation.drives) {
                // A lost future is dropped before its end.
                assert_eq!(drive.len(), 41);
                for (i, frame) in future.imagined().iter().enumerate() {
                    let expected = drive[5 * (i + 1)].agent_state(recording.vehicle());
                    assert_eq!(frame.agent(AgentId(0)).unwrap().state, expected);
                }
            }
        }
        assert!(n_complete > 0);
    }
}

#[test]
fn threads_change_nothing() {
    let text = "ego vehicle 0: 2,0 velocity 6,0
        agent vehicle 1: 25,0 velocity 5,0";
    let world = ByLaw(at_random_speed);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let run = || {
            let decision = decide(&world, InteractiveDriverConfig::default(), text);
            let frames = |future: &Rollout| future.imagined().to_vec();
            let summary = |p: &CandidateEvaluation| {
                let frames: Vec<_> = p.futures.iter().map(frames).collect();
                (p.score.clone(), p.drives.clone(), frames)
            };
            let all: Vec<_> = decision.candidates.iter().map(summary).collect();
            (decision.chosen, all)
        };
        pool.build().unwrap().install(run)
    };
    let one = with(1);
    assert_eq!(one, with(2));
    assert_eq!(one, with(4));
}

/// A vehicle ahead whose speed differs from future to future.
pub(super) const BEHIND: &str = "ego vehicle 0: 2,0 velocity 6,0
    agent vehicle 1: 25,0 velocity 5,0";

#[test]
fn halving_imagines_the_better_candidates_more_often() {
    let world = ByLaw(at_random_speed);
    let decision = decide(&world, InteractiveDriverConfig::default(), BEHIND);
    let of = |p: &CandidateEvaluation| (p.futures.len(), p.drives.len(), p.finalist);
    let counts: Vec<_> = decision.candidates.iter().map(of).collect();
    let count =
        |n: usize, finalist: bool| counts.iter().filter(|t| **t == (n, n, finalist)).count();
    // Of nineteen policies and imitation ten see a second future, five the third and fourth.
    assert_eq!(
        (count(1, false), count(2, false), count(4, true)),
        (10, 5, 5)
    );
    assert!(decision.candidates[decision.chosen].finalist);
    // What drops out was no better, in the futures it saw, than what stayed.
    let first = |p: &CandidateEvaluation| p.score.futures[0].total;
    let (seen, unseen): (Vec<&CandidateEvaluation>, _) = decision
        .candidates
        .iter()
        .partition(|p| p.futures.len() > 1);
    let worst = seen.iter().map(|p| first(p)).fold(f64::INFINITY, f64::min);
    assert!(unseen.iter().all(|p| first(p) <= worst + 1e-6));
}

#[test]
fn brisk_drivers_come_closer_and_those_who_yield_stay_back() {
    let config = InteractiveDriverConfig {
        driving_styles: true,
        ..ruled()
    };
    let decision = decide(
        &ConstantVelocity,
        config,
        "ego vehicle 0: 2,0 velocity 4,0\n agent vehicle 1: 25,0 velocity 5,0",
    );
    assert_eq!(decision.candidates.len(), 19);
    let of = |kind: ProposalKind| {
        let found = decision.candidates.iter().find(|p| p.kind == kind);
        found.unwrap_or_else(|| panic!("{kind} is no candidate"))
    };
    let usual = of(ProposalKind::Idm {
        speed_fraction: 1.0,
        lateral_offset: 0.0,
    });
    let brisk = of(ProposalKind::Brisk {
        speed_fraction: 1.0,
    });
    let yields = of(ProposalKind::Yielding {
        speed_fraction: 0.8,
    });
    let creeps = of(ProposalKind::Yielding {
        speed_fraction: 0.07,
    });
    assert!(brisk.progress_m > usual.progress_m + 0.5);
    assert!(usual.progress_m > yields.progress_m + 2.0);
    assert!(yields.progress_m > creeps.progress_m + 2.0);
    // None of them is uncomfortable by itself.
    assert!([usual, brisk, yields].iter().all(|p| p.collisions == 0));
}

#[test]
fn driving_too_fast_and_jolts_cost_what_nuplan_takes_off() {
    let text = "ego vehicle 0: 2,0 velocity 16,0 size 5,2";
    let decision = decide(&ConstantVelocity, only(&[1.0], &[0.0]), text);
    // From 16 m/s where 12 are allowed: PDM has no term for it, nuPlan has.
    let parts = decision.candidates[0].score.parts();
    let part = |name: &str| parts.iter().find(|(part, _)| *part == name).unwrap().1;
    let drive = &decision.candidates[0].drives[0];
    let excess = drive
        .iter()
        .map(|s| (s.speed() - 12.0).max(0.0))
        .sum::<f64>();
    let expected = (1.0 - excess / drive.len() as f64 / 2.23).max(0.0);
    assert_abs_diff_eq!(part("speed_limit"), expected, epsilon = 1e-12);
    assert!(expected < 0.9, "{expected}");
}

#[test]
fn where_futures_are_equal_halving_takes_what_uniform_takes() {
    for text in [FREE, BEHIND, CROSSING] {
        let with = |allocation| InteractiveDriverConfig {
            allocation,
            ..InteractiveDriverConfig::default()
        };
        let scene = recording_on(NARROW, text);
        let all = decide_on(&scene, &ConstantVelocity, with(Allocation::Uniform));
        let half = decide_on(&scene, &ConstantVelocity, with(Allocation::Halving));
        assert_eq!(all.chosen, half.chosen, "{text}");
        let value = |decision: &Decision| decision.candidates[decision.chosen].value;
        assert_abs_diff_eq!(value(&all), value(&half), epsilon = 1e-12);
    }
}

#[test]
fn the_worst_future_counts_if_it_is_asked_for() {
    let world = ByLaw(at_random_speed);
    let config = InteractiveDriverConfig {
        aggregate: Aggregate::Worst,
        ..only(&[0.4, 1.0], &[0.0])
    };
    let decision = decide(&world, config, BEHIND);
    for evaluation in &decision.candidates {
        let totals = evaluation.score.futures.iter().map(|score| score.total);
        assert_eq!(evaluation.value, totals.fold(f64::INFINITY, f64::min));
    }
    let means = decision.candidates.iter().map(|p| p.score.mean);
    assert!(
        decision
            .candidates
            .iter()
            .zip(means)
            .any(|(p, mean)| p.value < mean - 1e-3)
    );
}

#[test]
fn a_round_that_time_does_not_allow_does_not_count() {
    let time = Cell::new(0);
    let clock = || {
        time.set(time.get() + 1);
        Duration::from_millis(time.get())
    };
    // The first round reads the clock some thirty times, the second runs out of time.
    let mut config = InteractiveDriverConfig::default();
    config.budget.wall = Some(Duration::from_millis(45));
    let mut driver = InteractiveDriver::new(&ConstantVelocity, config)
        .unwrap()
        .with_clock(clock);
    plan_once(&recording(BEHIND), &mut driver).unwrap();
    let decision = driver.decision().unwrap();
    assert_eq!(decision.horizon, 4.0);
    assert!(decision.candidates.iter().all(|p| p.futures.len() == 1));
    assert!(decision.candidates[decision.chosen].finalist);
    for evaluation in &decision.candidates {
        assert!(evaluation.drives.iter().all(|drive| drive.len() == 41));
    }
}

#[test]
fn values_of_few_futures_are_those_of_many_on_average() {
    let text = "ego vehicle 0: 2,0 velocity 6,0
        agent vehicle 1: 25,0 velocity 5,0";
    let world = ByLaw(at_random_speed);
    // The slower one, whose progress is a share of what the other is let drive.
    let value = |seed: u64, n_futures: usize| {
        let config = InteractiveDriverConfig {
            n_futures,
            seed: Seed(seed),
            ..only(&[0.4, 1.0], &[0.0])
        };
        decide(&world, config, text).candidates[0].score.clone()
    };
    let few: Vec<f64> = (0..64).map(|seed| value(seed, 4).mean).collect();
    let mean = few.iter().sum::<f64>() / 64.0;
    let variance = few.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 63.0;
    let many = value(1000, 256);
    let error = (variance / 64.0 + many.standard_error.unwrap().powi(2)).sqrt();
    assert!(error > 1e-4, "chance must matter");
    assert!((mean - many.mean).abs() < 3.0 * error);
}

#[test]
fn out_of_time_all_are_judged_by_the_same_shorter_horizon() {
    let text = "ego vehicle 0: 2,0 velocity 6,0
        agent vehicle 1: 30,0 velocity 5,0";
    let time = Cell::new(0);
    let clock = || {
        time.set(time.get() + 1);
        Duration::from_millis(time.get())
    };
    let mut config = only(&[0.4, 1.0], &[0.0, 1.0]);
    config.budget.wall = Some(Duration::from_millis(10));
    let mut driver = InteractiveDriver::new(&ConstantVelocity, config)
        .unwrap()
        .with_clock(clock);
    plan_once(&recording(text), &mut driver).unwrap();
    let decision = driver.decision().unwrap();
    assert!(0.5 <= decision.horizon && decision.horizon < 4.0);
    assert!(decision.phases.total() > Duration::ZERO);
    let n = (decision.horizon * 10.0).round() as usize + 1;
    for evaluation in &decision.candidates {
        assert!(evaluation.drives.iter().all(|drive| drive.len() == n));
    }
}

#[test]
fn only_the_nearest_are_imagined() {
    let text = "ego vehicle 0: 2,0 velocity 6,0
        agent vehicle 1: 40,0 velocity 5,0
        agent vehicle 2: 20,3 velocity 5,0
        agent vehicle 3: 80,0 velocity 5,0";
    let mut config = only(&[0.4], &[0.0]);
    config.budget.nearest = 2;
    let decision = decide(&ConstantVelocity, config, text);
    let frame = decision.candidates[0].futures[0].last();
    let ids = frame.now().agents().iter().map(|agent| agent.id.0);
    assert_eq!(ids.collect::<Vec<_>>(), [0, 1, 2]);
}

#[test]
fn the_other_reading_of_the_return_agrees_where_nothing_happens() {
    let text = "ego vehicle 0: 2,0 velocity 6,0";
    let value = ValueEstimate::DiscountedStep { gamma: 0.95 };
    let config = |value| InteractiveDriverConfig {
        value,
        ..only(&[0.5], &[0.0])
    };
    let whole = decide(&ConstantVelocity, config(ValueEstimate::Rollout), text);
    let steps = decide(&ConstantVelocity, config(value), text);
    let [a, b] = [&whole, &steps].map(|d| d.candidates[0].score.mean);
    // A single candidate is the farthest in the whole and in every step.
    assert_abs_diff_eq!(a, b, epsilon = 1e-12);
    // One that collides at the end keeps what it earned before.
    let crash = "ego vehicle 0: 2,0 velocity 11,0 size 5,2
        agent vehicle 1: 36,-16 velocity 0,6";
    let both = |value| {
        let config = InteractiveDriverConfig {
            value,
            ..only(&[1.0], &[0.0])
        };
        decide(&ConstantVelocity, config, crash).candidates[0].clone()
    };
    let (whole, steps) = (both(ValueEstimate::Rollout), both(value));
    assert_eq!((whole.collisions, whole.score.mean), (4, 0.0));
    let earned = steps.score.mean;
    assert!(
        0.1 < earned && earned < 0.9,
        "{earned} {:?}",
        steps.score.futures[0]
    );
}

#[test]
fn where_all_collide_the_last_to_do_so_drives_or_brakes() {
    let check = |speed: f64, gap: f64, brakes: bool| {
        let text = format!(
            "ego vehicle 0: 2,0 velocity {speed},0 size 5,2
             agent vehicle 1: {},0 velocity -6,0 size 5,2",
            2.0 + 5.0 + gap
        );
        let decision = decide(&ConstantVelocity, only(&[0.2, 1.0], &[0.0]), &text);
        assert!(decision.candidates.iter().all(|p| p.value == 0.0));
        let soonest = decision.candidates.iter().map(|p| p.collision_s);
        let latest = soonest.fold(0.0, f64::max);
        let chosen = &decision.candidates[decision.chosen];
        assert_eq!(chosen.collision_s, latest);
        assert_eq!(decision.brakes, brakes, "{chosen:?}");
    };
    check(4.0, 6.0, true);
    check(9.0, 6.0, false);
}

#[test]
fn ties_are_broken_in_order() {
    let text = "ego vehicle 0: 2,0 velocity 6,0";
    let decision = decide(&ConstantVelocity, only(&[0.4, 0.5, 0.6], &[0.0]), text);
    let with = |values: [(f64, usize, f64); 3], previous, hysteresis| {
        let mut evaluations = decision.candidates.clone();
        for (evaluation, (value, collisions, progress_m)) in evaluations.iter_mut().zip(values) {
            (evaluation.value, evaluation.collisions) = (value, collisions);
            evaluation.progress_m = progress_m;
        }
        choose(&evaluations, previous, hysteresis)
    };
    assert_eq!(
        with([(0.5, 0, 1.0), (0.6, 1, 0.0), (0.5, 0, 9.0)], None, 0.0),
        1
    );
    assert_eq!(
        with(
            [(0.5, 1, 9.0), (0.5 + 1e-7, 1, 1.0), (0.5, 0, 1.0)],
            None,
            0.0
        ),
        2
    );
    assert_eq!(
        with([(0.5, 0, 1.0), (0.5, 0, 2.0), (0.5, 0, 1.0)], Some(0), 0.0),
        1
    );
    assert_eq!(
        with([(0.5, 0, 1.0), (0.5, 0, 1.0), (0.5, 0, 1.0)], Some(1), 0.0),
        1
    );
    assert_eq!(
        with([(0.5, 0, 1.0), (0.5, 0, 1.0), (0.5, 0, 1.0)], None, 0.0),
        0
    );
    assert_eq!(
        with(
            [(0.5, 0, 1.0), (0.505, 0, 1.0), (0.1, 0, 1.0)],
            Some(0),
            0.01
        ),
        0
    );
}

#[test]
fn imitation_is_a_candidate_like_any_other() {
    // The world's ego goes straight on; the road is free.
    let world = ByLaw(|agent, _, _| coasted(agent));
    let config = InteractiveDriverConfig {
        proposals: PdmConfig {
            speed_fractions: vec![0.2],
            lateral_offsets: vec![0.0],
            ..PdmConfig::default()
        },
        driving_styles: false,
        ..InteractiveDriverConfig::default()
    };
    let text = "ego vehicle 0: 2,0 velocity 9,0";
    let mut driver = InteractiveDriver::new(&world, config).unwrap();
    let way = plan_once(&recording(text), &mut driver).unwrap();
    let decision = driver.decision().unwrap();
    assert_eq!(decision.candidates[1].kind, ProposalKind::Imitation);
    assert_eq!(decision.chosen, 1);
    assert!((decision.candidates[1].progress_m - 36.0).abs() < 0.5);
    // The drive equals the imagined future, and continues past its end.
    let end = way.states()[80].rear_axle.position.x - way.states()[0].rear_axle.position.x;
    assert!((end - 72.0).abs() < 1.0, "{end}");
}

/// A world with invalid frames from the first step on.
struct Wrong(fn(&Frame) -> Vec<Frame>);

struct WrongSession(fn(&Frame) -> Vec<Frame>, Frame);

impl WorldModel for Wrong {
    fn name(&self) -> &str {
        "wrong"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        Ok(Box::new(WrongSession(
            self.0,
            starts[0].scene.now().clone(),
        )))
    }
}

impl Session for WrongSession {
    fn dt(&self) -> f64 {
        0.5
    }

    fn step(&mut self, _: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        Ok((self.0)(&self.1))
    }

    fn replace(&mut self, _: usize, _: Start<'_>) -> Result<(), BoxError> {
        Err(RolloutError::NoSuchFuture { future: 0, n: 0 }.into())
    }
}

#[test]
fn nothing_is_gained_by_creeping_up_to_who_stands() {
    // The world's ego rolls on at 1 m/s, 4 m in all.
    let world = ByLaw(|agent, _, _| coasted(agent));
    let config = InteractiveDriverConfig {
        imitation: true,
        ..only(&[0.2], &[0.0])
    };
    let imitation = |text: &str, value: ValueEstimate| {
        let config = InteractiveDriverConfig {
            value,
            ..config.clone()
        };
        let text = format!("ego vehicle 0: 2,0 velocity 1,0 size 4.8,2\n{text}");
        decide(&world, config, &text).candidates[1].clone()
    };
    let returns = [
        ValueEstimate::Rollout,
        ValueEstimate::DiscountedStep { gamma: 1.0 },
    ];
    for value in returns {
        let free = imitation("", value);
        assert_abs_diff_eq!(free.progress_m, 4.0, epsilon = 0.1);
        // 4.5 m before who stands: 3.5 m count. As much beside it, or before who drives, all does.
        let behind = imitation("agent vehicle 1: 11.3,0 size 4.8,2", value);
        assert_eq!(behind.collisions, 0);
        assert_abs_diff_eq!(behind.progress_m, 3.5, epsilon = 0.2);
        for other in ["11.3,2.6 size 4.8,2", "11.3,0 velocity 1,0 size 4.8,2"] {
            let other = imitation(&format!("agent vehicle 1: {other}"), value);
            assert_abs_diff_eq!(other.progress_m, free.progress_m, epsilon = 1e-9);
        }
    }
}

#[test]
fn what_a_world_does_wrong_is_named() {
    let check = |frames: fn(&Frame) -> Vec<Frame>, expected: &str| {
        let world = Wrong(frames);
        let config = InteractiveDriverConfig {
            n_futures: 1,
            imitation: true,
            ..only(&[0.5], &[0.0])
        };
        let mut driver = InteractiveDriver::new(&world, config).unwrap();
        let text = "ego vehicle 0: 2,0 velocity 6,0\n agent vehicle 1: 40,0";
        let error = plan_once(&recording(text), &mut driver).unwrap_err();
        let error = error.to_string();
        assert!(
            error.contains("\"wrong\"") && error.contains(expected),
            "{error}"
        );
    };
    check(|_| vec![], "0 answers for 1 futures");
    check(
        |frame| {
            let mut agents = frame.agents().to_vec();
            agents[1].state.velocity.x = f64::NAN;
            vec![Frame::new(agents, vec![])]
        },
        "not a finite number",
    );
    // A world that knows no ego cannot imitate it.
    check(
        |frame| vec![Frame::new(frame.agents()[1..].to_vec(), vec![])],
        "dropped the ego",
    );
}

struct Broken;

impl WorldModel for Broken {
    fn name(&self) -> &str {
        "broken"
    }

    fn open(&self, _: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        Err(RolloutError::Duration(0.0).into())
    }
}

#[test]
fn a_world_that_does_not_open_and_an_agent_that_is_nowhere_are_named() {
    let error = |world: &dyn WorldModel, recording: &Recording| {
        let mut driver = InteractiveDriver::new(world, ruled()).unwrap();
        let error = plan_once(recording, &mut driver).unwrap_err();
        *error.downcast::<PlanError>().unwrap()
    };
    let found = error(&Broken, &recording(FREE));
    assert!(matches!(found, PlanError::World { ref world, .. } if world == "broken"));
    let text = format!("{STREET}{FREE}\n agent vehicle 1: 50,0");
    let mut scenario = fixture::scenario(&text).unwrap();
    let frame = &scenario.log[scenario.now];
    let mut agents = frame.agents().to_vec();
    agents[1].state.velocity.x = f64::NAN;
    scenario.log[scenario.now] = Frame::new(agents, vec![]);
    derive_roadblocks(&mut scenario);
    let nowhere = Recording::of_boxes(scenario).unwrap();
    let found = error(&ConstantVelocity, &nowhere);
    assert!(matches!(found, PlanError::NotFinite { agent: AgentId(1) }));
    let error = plan_once(&nowhere, &mut PdmClosed::default()).unwrap_err();
    assert!(error.to_string().contains("agent 1 has a state"), "{error}");
}

#[test]
fn numbers_out_of_range_are_refused() {
    let check = |change: fn(&mut InteractiveDriverConfig), expected: &str| {
        let mut config = InteractiveDriverConfig::default();
        change(&mut config);
        let refused = InteractiveDriver::new(&ConstantVelocity, config)
            .err()
            .unwrap();
        assert!(refused.to_string().contains(expected), "{refused}");
    };
    check(|c| c.n_futures = 0, "n_futures");
    check(|c| c.replan_every = 0, "replan_every");
    check(|c| c.caution = f64::NAN, "caution");
    check(|c| c.hysteresis = -1.0, "hysteresis");
    check(|c| c.hedge = 1.5, "hedge");
    check(
        |c| c.value = ValueEstimate::DiscountedStep { gamma: 0.0 },
        "gamma",
    );
    check(|c| c.budget.horizon = 0.3, "horizon");
    check(|c| c.budget.horizon = 9.0, "horizon");
    check(
        |c| c.proposals.speed_fractions.clear(),
        "number of proposals",
    );
    check(
        |c| c.proposals.lateral_offsets.clear(),
        "number of proposals",
    );
    check(
        |c| c.proposals.lateral_offsets[0] = f64::INFINITY,
        "finite offset",
    );
    check(|c| c.proposals.speed_fractions[1] = -1.0, "speed_fraction");
    check(|c| c.proposals.fallback_speed = f64::NAN, "fallback_speed");
    check(|c| c.proposals.law.headway = 0.0, "headway");
}
