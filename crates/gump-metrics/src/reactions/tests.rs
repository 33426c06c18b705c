//! Hand-made scenes whose answers are known.

use gump_geometry::dvec2;
use gump_scene::{AgentId, Frame, LightState, Rollout, Scenario, fixture};

use super::manoeuvre::Profile;
use super::{Attempt, Manoeuvre, Outcome, Reactions, Reason, Unfit};

const ROAD: &str = "lane 1: -200,0 400,0 left 2\nlane 2: -200,3.5 400,3.5 right 1\n";

fn scene(agents: &str) -> Scenario {
    fixture::scenario(&format!("{ROAD}{agents}")).unwrap()
}

fn why(scenario: &Scenario, manoeuvre: Manoeuvre) -> Option<Reason> {
    let reactions = Reactions::new(scenario, 8.0).unwrap();
    reactions.attempt(manoeuvre).err()
}

fn ids(outcome: &Outcome) -> Vec<i64> {
    outcome.run_into_ego.iter().map(|c| c.agent.0).collect()
}

/// A future of the attempt whose frames `moved` computes from the present and the time in seconds.
fn future(attempt: &Attempt<'_>, moved: impl Fn(&Frame, f64) -> Frame) -> Rollout {
    let scenario = attempt.scenario;
    let mut rollout = Rollout::begin(scenario.present());
    for k in 1..attempt.plan().len() {
        let seconds = k as f64 * scenario.dt;
        rollout.push(moved(&scenario.log[scenario.now], seconds));
    }
    rollout
}

#[test]
fn who_follows_runs_into_an_ego_that_stops_and_who_yields_does_not() {
    let scenario = scene("ego vehicle 0: 0,0 velocity 10,0\nagent vehicle 1: -20,0 velocity 10,0");
    let reactions = Reactions::new(&scenario, 8.0).unwrap();
    for (manoeuvre, metres) in [
        (Manoeuvre::Brake, 50.0 / 3.0),
        (Manoeuvre::Stop, 25.0 / 3.0),
    ] {
        let attempt = reactions.attempt(manoeuvre).unwrap();
        assert_eq!(attempt.near(), [AgentId(1)]);
        let end = attempt.plan().last().unwrap();
        assert!((end.pose.position.x - metres).abs() < 0.01, "{end:?}");
        let replayed = attempt.replayed();
        assert_eq!(ids(&replayed), [1]);
        // It gets there when 20 - 4.8 m and the braking distance are driven, to a frame.
        let at = (15.2 + metres) / 10.0;
        let found = replayed.run_into_ego[0].at_s;
        assert!((found - at).abs() <= 0.11, "{found} {at}");
        // The same future with a follower that stands after a second is free of contact.
        let yields = future(&attempt, |present, seconds| {
            let moved = present.agents().iter().map(|agent| {
                let mut state = agent.state;
                state.pose.position.x += 10.0 * seconds.min(0.9);
                agent.with_state(state)
            });
            Frame::new(moved.collect(), Vec::new())
        });
        assert_eq!(attempt.outcome(&yields), Outcome::default());
    }
}

#[test]
fn the_front_of_the_ego_is_its_own_fault() {
    // It would be the first to run into the one ahead: no driver speeds up there.
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 10,0
         agent vehicle 1: 20,0 velocity 10,0",
    );
    assert_eq!(why(&scenario, Manoeuvre::SpeedUp), Some(Reason::OwnFault));
    // In a future it is reported as such, and ends the future.
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 10,0
         agent vehicle 1: 60,0 velocity 10,0
         agent vehicle 2: -12,0 velocity 10,0",
    );
    let reactions = Reactions::new(&scenario, 8.0).unwrap();
    let attempt = reactions.attempt(Manoeuvre::Brake).unwrap();
    assert_eq!(ids(&attempt.replayed()), [2]);
    let halts = future(&attempt, |present, seconds| {
        let moved = present.agents().iter().map(|agent| {
            let mut state = agent.state;
            if agent.id == AgentId(1) {
                // Standing in the way at once.
                state.pose.position.x = 8.0;
                state.velocity = dvec2(0.0, 0.0);
            }
            state.pose.position.x += state.velocity.x * seconds;
            agent.with_state(state)
        });
        Frame::new(moved.collect(), Vec::new())
    });
    let outcome = attempt.outcome(&halts);
    assert_eq!(outcome.ego_runs_into.unwrap().agent, AgentId(1));
    assert_eq!(ids(&outcome), [], "what comes after does not count");
}

#[test]
fn into_the_side_of_an_ego_in_its_lane_is_the_fault_of_the_other() {
    // A car from the right, straight into the middle of an ego that brakes before where it crossed.
    let side = |velocity: &str| {
        scene(&format!(
            "ego vehicle 0: 0,0 velocity 10,0
             agent vehicle 1: 15,-30 velocity {velocity}"
        ))
    };
    let scenario = side("0,8");
    let reactions = Reactions::new(&scenario, 8.0).unwrap();
    let attempt = reactions.attempt(Manoeuvre::Brake).unwrap();
    assert_eq!(ids(&attempt.replayed()), [1]);
    // One that stops beside the lane does not.
    let stops = future(&attempt, |present, seconds| {
        let moved = present.agents().iter().map(|agent| {
            let mut state = agent.state;
            state.pose.position.y += state.velocity.y * seconds.min(3.0);
            agent.with_state(state)
        });
        Frame::new(moved.collect(), Vec::new())
    });
    assert_eq!(attempt.outcome(&stops), Outcome::default());
}

#[test]
fn who_changes_lane_is_to_blame_until_it_is_on_the_other() {
    // On the left lane, ahead of the required gap, and slower: the ego moves into its side.
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 12,0
         agent vehicle 1: 10,3.5 velocity 7,0",
    );
    assert_eq!(
        why(&scenario, Manoeuvre::ChangeLane),
        Some(Reason::OwnFault)
    );
    // Behind, and faster: it runs into an ego that by then is on its lane.
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 10,0
         agent vehicle 1: -40,3.5 velocity 16,0",
    );
    let reactions = Reactions::new(&scenario, 8.0).unwrap();
    let attempt = reactions.attempt(Manoeuvre::ChangeLane).unwrap();
    let replayed = attempt.replayed();
    assert_eq!(ids(&replayed), [1]);
    let at = (40.0 - 4.8) / 6.0;
    assert!((replayed.run_into_ego[0].at_s - at).abs() < 0.15);
    // No agent may be beside the ego.
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 10,0
         agent vehicle 1: -5,3.5 velocity 10,0",
    );
    assert_eq!(why(&scenario, Manoeuvre::ChangeLane), Some(Reason::NoRoom));
    // Nor be there before the change is over: 33 m behind, 36 m nearer after 3 s.
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 10,0
         agent vehicle 1: -33,3.5 velocity 22,0",
    );
    assert_eq!(why(&scenario, Manoeuvre::ChangeLane), Some(Reason::NoRoom));
    // Nor is a lane changed at a walking pace.
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 4.9,0
         agent vehicle 1: -40,3.5 velocity 10,0",
    );
    assert_eq!(why(&scenario, Manoeuvre::ChangeLane), Some(Reason::TooSlow));
}

#[test]
fn a_lane_change_is_smooth_and_agrees_with_itself() {
    let scenario =
        scene("ego vehicle 0: 0,0 velocity 10,0\nagent vehicle 1: -30,3.5 velocity 11,0");
    let reactions = Reactions::new(&scenario, 8.0).unwrap();
    let attempt = reactions.attempt(Manoeuvre::ChangeLane).unwrap();
    let plan = attempt.plan();
    let at = |s: f64| plan[(s * 10.0) as usize];
    assert_eq!(plan.len(), 81);
    assert_eq!(plan[0], reactions.logged[0]);
    assert!((at(1.5).pose.position.y - 1.75).abs() < 1e-9);
    assert!((at(3.0).pose.position.y - 3.5).abs() < 1e-9);
    assert!((at(8.0).pose.position - dvec2(80.0, 3.5)).length() < 1e-6);
    // The quintic is steepest in its middle: 15/8 of 3.5 m in 3 s.
    assert!((at(1.5).velocity.y - 2.1875).abs() < 0.02);
    assert!(at(0.1).velocity.y < 0.05 && at(2.9).velocity.y < 0.05);
    check_kinematics(plan, 0.1, 2.6);
}

/// Positions, headings and velocities agree, and nothing jumps.
fn check_kinematics(plan: &[gump_scene::AgentState], dt: f64, accelerates: f64) {
    for (k, pair) in plan.windows(2).enumerate() {
        let [a, b] = pair else { unreachable!() };
        let driven = (b.pose.position - a.pose.position) / dt;
        let mean = (a.velocity + b.velocity) / 2.0;
        assert!(driven.distance(mean) < 0.31, "frame {k}: {driven} {mean}");
        let change = a.velocity.distance(b.velocity) / dt;
        assert!(change < accelerates, "frame {k}: {change} m/s²");
        let (forward, speed) = (b.pose.direction(), b.speed());
        assert!(b.velocity.dot(forward) > 0.99 * speed - 0.05, "frame {k}");
    }
}

#[test]
fn profiles_are_those_of_even_acceleration() {
    let brake = Profile {
        from: 12.0,
        to: 0.0,
        rate: 3.0,
    };
    assert_eq!(brake.metres_after(0.0), 0.0);
    assert_eq!(brake.metres_after(2.0), 18.0);
    assert_eq!(brake.metres_after(4.0), 24.0);
    assert_eq!(brake.metres_after(9.0), 24.0);
    let gain = Profile {
        from: 10.0,
        to: 15.0,
        rate: 2.0,
    };
    assert_eq!(gain.metres_after(2.5), 31.25);
    assert_eq!(gain.metres_after(4.5), 61.25);
    let even = Profile {
        from: 8.0,
        to: 8.0,
        rate: 2.0,
    };
    assert_eq!(even.metres_after(3.0), 24.0);
}

#[test]
fn the_way_bends_with_the_log_and_goes_on_along_the_lanes() {
    // The log ends after 20 m; the lane bends to the left at x = 40.
    let scenario = fixture::scenario(
        "lane 1: -50,0 40,0 next 2
         lane 2: 40,0 45,2 48,6 50,12 50,120
         ego vehicle 0: 0,0 velocity 5,0
         agent vehicle 1: -12,0 velocity 5,0
         history 1.0 future 4.0 dt 0.1",
    )
    .unwrap();
    let reactions = Reactions::new(&scenario, 4.0).unwrap();
    let attempt = reactions.attempt(Manoeuvre::SpeedUp).unwrap();
    let end = attempt.plan().last().unwrap();
    // 5 m/s to 10 m/s in 2.5 s, 33.75 m in all, still on the straight part.
    assert!((end.pose.position - dvec2(33.75, 0.0)).length() < 1e-6);
    assert!((end.velocity.x - 10.0).abs() < 0.2);
    // With its present speed kept for longer it is on the bend, and turned.
    let fast = fixture::scenario(
        "lane 1: -50,0 40,0 next 2
         lane 2: 40,0 45,2 48,6 50,12 50,120
         ego vehicle 0: 0,0 velocity 12,0
         agent vehicle 1: -14,0 velocity 12,0
         history 1.0 future 4.0 dt 0.1",
    )
    .unwrap();
    let path =
        super::path::Path::of_log(&Reactions::new(&fast, 1.0).unwrap().logged, &fast.map, 70.0);
    let pose = path.unwrap().pose_at(70.0);
    assert!((pose.position.x - 50.0).abs() < 0.1, "{pose:?}");
    assert!((pose.heading - std::f64::consts::FRAC_PI_2).abs() < 0.05);
}

/// An ego that stands at a red light, and one that crosses at green.
fn crossing(light: &str, ego: &str) -> Scenario {
    fixture::scenario(&format!(
        "lane 1: -100,0 0,0 next 2
         lane 2: 0,0 20,0 next 3
         lane 3: 20,0 200,0
         lane 4: 10,-100 10,100
         light 2 {light}: 0,0
         ego vehicle 0: {ego}
         agent vehicle 1: 10,-44 velocity 0,10"
    ))
    .unwrap()
}

#[test]
fn the_light_is_run_only_where_it_is_red_and_the_log_stands() {
    let scenario = crossing("red", "-6,0");
    let reactions = Reactions::new(&scenario, 8.0).unwrap();
    let attempt = reactions.attempt(Manoeuvre::RunLight).unwrap();
    // From standing with 2 m/s² to 8 m/s: 16 m in 4 s, then 32 m in 4 s.
    let end = attempt.plan().last().unwrap().pose.position;
    assert!((end - dvec2(-6.0 + 48.0, 0.0)).length() < 1e-6, "{end}");
    assert_eq!(attempt.near(), [AgentId(1)]);
    assert_eq!(ids(&attempt.replayed()), [1], "into its side");
    let refused = |scenario: &Scenario| why(scenario, Manoeuvre::RunLight);
    assert_eq!(refused(&crossing("green", "-6,0")), Some(Reason::NoLight));
    assert_eq!(
        refused(&crossing("red", "-6,0 velocity 4,0")),
        Some(Reason::NoLight),
        "the log runs it itself"
    );
    // It turns green before the ego is there.
    let mut early = crossing("red", "-60,0");
    for frame in &mut early.log[15..] {
        let mut lights = frame.lights().to_vec();
        lights[0].state = LightState::Green;
        *frame = Frame::new(frame.agents().to_vec(), lights);
    }
    assert_eq!(refused(&early), Some(Reason::NoLight));
}

#[test]
fn manoeuvres_are_scored_only_where_they_apply() {
    let nobody = scene("ego vehicle 0: 0,0 velocity 10,0\nagent vehicle 1: 0,60 velocity 10,0");
    assert_eq!(why(&nobody, Manoeuvre::Brake), Some(Reason::Nobody));
    assert_eq!(why(&nobody, Manoeuvre::Log), Some(Reason::Nobody));
    let slow = scene("ego vehicle 0: 0,0 velocity 2,0\nagent vehicle 1: -12,0 velocity 2,0");
    for manoeuvre in [
        Manoeuvre::Brake,
        Manoeuvre::Stop,
        Manoeuvre::SpeedUp,
        Manoeuvre::ChangeLane,
    ] {
        assert_eq!(
            why(&slow, manoeuvre),
            Some(Reason::TooSlow),
            "{manoeuvre:?}"
        );
    }
    assert_eq!(why(&slow, Manoeuvre::RunLight), Some(Reason::NoLight));
    let alone = fixture::scenario(
        "lane 1: -200,0 400,0
         ego vehicle 0: 0,0 velocity 10,0
         agent vehicle 1: -12,0 velocity 10,0",
    )
    .unwrap();
    assert_eq!(why(&alone, Manoeuvre::ChangeLane), Some(Reason::NoLane));
    // Parked cars do not count, however near.
    let parked = scene("ego vehicle 0: 0,0 velocity 10,0\nagent vehicle 1: 12,-2.5");
    assert_eq!(why(&parked, Manoeuvre::Brake), Some(Reason::Nobody));
}

#[test]
fn who_stands_or_overlapped_before_runs_into_nobody() {
    // Two boxes overlap in the present; a third stands where the ego passes: neither is counted.
    let scenario = scene(
        "ego vehicle 0: 0,0 velocity 10,0
         agent vehicle 1: -4,0 velocity 10,0
         agent vehicle 2: -30,0 velocity 10,0",
    );
    let reactions = Reactions::new(&scenario, 8.0).unwrap();
    let attempt = reactions.attempt(Manoeuvre::Stop).unwrap();
    assert_eq!(attempt.near(), [AgentId(2)]);
    let outcome = attempt.replayed();
    assert_eq!((ids(&outcome), outcome.others.len()), (vec![2], 0));
}

#[test]
fn a_bridge_is_no_crossing() {
    let mut scenario =
        scene("ego vehicle 0: 0,0 velocity 10,0\nagent vehicle 1: -20,0 velocity 10,0");
    for frame in &mut scenario.log {
        let raised = frame.agents().iter().map(|agent| {
            let mut agent = *agent;
            agent.elevation = if agent.id == AgentId(1) { 5.0 } else { 0.0 };
            agent
        });
        *frame = Frame::new(raised.collect(), Vec::new());
    }
    let reactions = Reactions::new(&scenario, 8.0).unwrap();
    let attempt = reactions.attempt(Manoeuvre::Stop).unwrap();
    assert_eq!(attempt.replayed(), Outcome::default());
}

#[test]
fn a_log_that_is_too_short_says_so() {
    let scenario = scene("ego vehicle 0: 0,0 velocity 10,0");
    let error = Reactions::new(&scenario, 9.0).err().unwrap();
    assert_eq!(
        error.to_string(),
        "expected a log that goes on for 9 s, found 8.0 s"
    );
    let mut lost = scenario;
    lost.log[15] = Frame::default();
    assert_eq!(
        Reactions::new(&lost, 8.0).err(),
        Some(Unfit::EgoLost { at: 0.5 })
    );
}
