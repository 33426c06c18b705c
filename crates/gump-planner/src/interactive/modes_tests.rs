//! Decisions with modes, in a world whose ego is drawn.

use std::cell::Cell;

use gump_nuplan::closed_loop::Recording;
use gump_rollout::{Session, Start};
use gump_scene::{AgentId, AgentState, Frame};

use super::tests::{ByLaw, at_random_speed, coasted, only, recording};
use super::*;

/// The ego drives straight on at a speed that is drawn once per future, 4, 8 or 12 m/s, the others
/// at another one.
struct Drawn;

struct Futures<'a> {
    others: Box<dyn Session + 'a>,
    egos: Vec<(AgentState, f64)>,
}

const OTHERS: ByLaw = ByLaw(at_random_speed);

impl WorldModel for Drawn {
    fn name(&self) -> &str {
        "drawn"
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        let egos = starts.iter().flat_map(|start| {
            (0..start.n_futures as u64).map(move |k| {
                let speed = [4.0, 8.0, 12.0][(start.seed.fork(k).0 % 3) as usize];
                (start.scene.ego_now().state, speed)
            })
        });
        Ok(Box::new(Futures {
            egos: egos.collect(),
            others: OTHERS.open(starts)?,
        }))
    }
}

impl Session for Futures<'_> {
    fn dt(&self) -> f64 {
        0.5
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        for (i, (state, speed)) in self.egos.iter_mut().enumerate() {
            match ego {
                Some(driven) => *state = driven[i],
                None => {
                    state.velocity = state.pose.direction() * *speed;
                    state.pose.position += state.velocity * 0.5;
                }
            }
        }
        let states: Vec<AgentState> = self.egos.iter().map(|(state, _)| *state).collect();
        self.others.step(Some(&states))
    }

    fn replace(&mut self, _: usize, _: Start<'_>) -> Result<(), BoxError> {
        Err("no future is ever replaced".into())
    }
}

const STREET: &str = "ego vehicle 0: 2,0 velocity 8,0 size 5,2
    agent vehicle 1: 90,0 velocity 7,0";

/// One slow policy, modes, imitation.
fn with(network_modes: usize) -> InteractiveDriverConfig {
    InteractiveDriverConfig {
        network_modes,
        imitation: true,
        allocation: Allocation::Halving,
        ..only(&[0.2], &[0.0])
    }
}

fn started<'w>(
    world: &'w dyn WorldModel,
    config: InteractiveDriverConfig,
    scene: &Recording,
) -> InteractiveDriver<'w> {
    let mut driver = InteractiveDriver::new(world, config).unwrap();
    crate::closed_loop::plan_once(scene, &mut driver).unwrap();
    driver
}

fn modes(decision: &Decision) -> Vec<&CandidateEvaluation> {
    let all = decision.candidates.iter();
    let is_mode = |c: &&CandidateEvaluation| matches!(c.kind, ProposalKind::NetworkMode { .. });
    all.filter(is_mode).collect()
}

fn end_of(drive: &[EgoState]) -> f64 {
    drive[drive.len() - 1].rear_axle.position.x
}

#[test]
fn a_mode_is_one_drive_among_others_that_differ() {
    let scene = recording(STREET);
    let driver = started(&Drawn, with(6), &scene);
    let decision = driver.decision().unwrap();
    let modes = modes(decision);
    // Twelve draws of three speeds.
    assert_eq!(modes.len(), 3);
    for (i, mode) in modes.iter().enumerate() {
        assert_eq!(mode.kind, ProposalKind::NetworkMode { index: i + 1 });
        for (future, drive) in mode.futures.iter().zip(&mode.drives) {
            assert_eq!(*drive, mode.drives[0]);
            // The world is told where the ego is.
            for (step, frame) in future.imagined().iter().enumerate() {
                let expected = drive[5 * (step + 1)].agent_state(scene.vehicle());
                assert_eq!(frame.agent(AgentId(0)).unwrap().state, expected);
            }
        }
        assert!(mode.hedge.is_none());
    }
    let mut ends: Vec<f64> = modes.iter().map(|mode| end_of(&mode.drives[0])).collect();
    ends.sort_by(f64::total_cmp);
    assert!(
        ends[0] + 10.0 < ends[1] && ends[1] + 10.0 < ends[2],
        "{ends:?}"
    );
    let finalist = modes.iter().find(|mode| mode.futures.len() > 1).unwrap();
    let other = |i: usize| {
        let last = finalist.futures[i].last();
        last.now().agent(AgentId(1)).unwrap().state
    };
    assert_ne!(other(0), other(1));
    // They have names of their own; imitation is the last.
    let names: Vec<String> = driver.candidates().into_iter().map(|c| c.name).collect();
    let expected = [
        "network mode 1",
        "network mode 2",
        "network mode 3",
        "imitation",
    ];
    assert_eq!(names[1..], expected);
}

#[test]
fn modes_are_hedged_by_the_same_drive() {
    let config = InteractiveDriverConfig {
        hedge: 0.5,
        ..with(4)
    };
    // The others stand in the way in the forecast alone: they leave the road at once.
    let world = ByLaw(|agent, _, _| {
        let mut state = coasted(agent);
        state.pose.position.y = 40.0;
        state
    });
    let scene = recording("ego vehicle 0: 2,0 velocity 8,0 size 5,2\n agent vehicle 1: 25,0");
    let driver = started(&world, config, &scene);
    let modes = modes(driver.decision().unwrap());
    // All draws of this world are alike.
    assert_eq!(modes.len(), 1);
    assert_eq!(modes[0].hedge.as_ref().unwrap().total, 0.0);
    assert!(modes[0].score.mean > 0.5);
}

#[test]
fn none_or_one_is_imitation_alone() {
    let scene = recording(STREET);
    let summary = |n: usize| {
        let driver = started(&Drawn, with(n), &scene);
        let decision = driver.decision().unwrap();
        let of = |c: &CandidateEvaluation| (c.kind, c.score.clone(), c.drives.clone());
        let all: Vec<_> = decision.candidates.iter().map(of).collect();
        (decision.chosen, all)
    };
    assert_eq!(summary(0), summary(1));
    assert_eq!(summary(1).1.len(), 2);
    assert_eq!(summary(4), summary(4));
}

#[test]
fn a_mode_is_followed_and_stays_a_candidate_for_half_of_its_length() {
    let config = InteractiveDriverConfig {
        imitation: false,
        ..with(4)
    };
    let scene = recording(STREET);
    let mut driver = InteractiveDriver::new(&Drawn, config).unwrap();
    driver.start(&scene.initialization()).unwrap();
    let begun = *scene.ego_at(0);
    let mut ego = begun;
    let mut plan: Option<Trajectory> = None;
    let mut first: Option<(ProposalKind, f64)> = None;
    for i in 0..6 {
        let text = format!(
            "ego vehicle 0: {},0 velocity {},0 size 5,2\n agent vehicle 1: 200,0 velocity 7,0",
            ego.agent_state(scene.vehicle()).pose.position.x,
            ego.velocity.x
        );
        let now = recording(&text);
        let input = PlannerInput {
            iteration: 5 * i,
            scene: now.scenario().present(),
            ego: &ego,
            past: now.past(),
        };
        let next = driver.drive(&input).unwrap();
        let decision = driver.decision().unwrap();
        let chosen = &decision.candidates[decision.chosen];
        assert!(matches!(chosen.kind, ProposalKind::NetworkMode { .. }));
        let end = end_of(&chosen.drives[0]);
        if let (Some(plan), Some((kind, end_before))) = (&plan, first) {
            let numbers: Vec<ProposalKind> = modes(decision).iter().map(|c| c.kind).collect();
            let mut unique = numbers.clone();
            unique.dedup();
            assert_eq!(numbers, unique, "every number once");
            if i <= 4 {
                // The drive itself is followed on, half a second per decision later.
                let same = decision.candidates.iter().find(|c| c.kind == kind).unwrap();
                let ahead = end_of(&same.drives[0]) - end_before;
                assert!((ahead - 4.0 * i as f64).abs() < 1.0, "{ahead}");
                assert_eq!(chosen.kind, kind);
                assert_eq!(next, *plan);
            } else {
                assert_ne!(next, *plan, "it is too old");
            }
        } else {
            first = Some((chosen.kind, end));
        }
        plan.get_or_insert(next.clone());
        // Trajectories of poses have no velocity.
        ego = next.at(ego.time_us + 500_000).unwrap();
        ego.velocity = begun.velocity;
    }
}

#[test]
fn without_time_for_draws_there_are_no_modes() {
    let calls = Cell::new(0u32);
    let clock = || {
        calls.set(calls.get() + 1);
        Duration::from_secs(u64::from(calls.get() > 1))
    };
    let mut config = with(4);
    config.budget.wall = Some(Duration::from_millis(500));
    let mut driver = InteractiveDriver::new(&Drawn, config)
        .unwrap()
        .with_clock(clock);
    crate::closed_loop::plan_once(&recording(STREET), &mut driver).unwrap();
    let decision = driver.decision().unwrap();
    assert!(modes(decision).is_empty());
    assert_eq!((decision.candidates.len(), decision.horizon), (2, 0.5));
}
