//! Realism scores from the outside: bad input, explanations, scenes, laws.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use gump_metrics::logged;
use gump_scene::{AgentId, AgentKind, fixture};
use gump_wosac::realism::{
    Component, Config, Log, Mode, Reference, Rollouts, Scores, Signal, SignalLane, State, Track,
    Trajectory, WosacError, Year, score,
};

/// Two cars, one behind the other at 10 m/s, and a road of 8 m with a signal at 40 m.
fn log() -> Log {
    let car = |id: i64, ahead: f32| {
        let at = |step: usize| State::new([ahead + step as f32, 0.0, 0.0], 0.0, [4.8, 2.0, 1.5]);
        Track::new(AgentId(id), AgentKind::Vehicle, (0..91).map(at).collect())
    };
    let lane = SignalLane {
        id: 5,
        points: (-5..20).map(|i| [10.0 * i as f32, 0.0]).collect(),
    };
    let green = Signal {
        lane: 5,
        stop: false,
        // Not where a car is at a step: being exactly on the line is neither before nor past it.
        stop_point: [40.5, 0.0],
    };
    Log::new("two cars", vec![car(9, 20.0), car(3, 0.0)])
        .ego(AgentId(3))
        .unwrap()
        .targets(vec![AgentId(9)])
        .unwrap()
        .road_edges(vec![
            vec![[-50.0, -4.0, 0.0], [250.0, -4.0, 0.0]],
            vec![[250.0, 4.0, 0.0], [-50.0, 4.0, 0.0]],
        ])
        .signals(vec![lane], vec![vec![green]; 91])
}

/// Rollouts in which the cars drive at `speed`, in units of the log's.
fn rollouts(speeds: &[f32]) -> Rollouts {
    let drive = |id: i64, now: f32, speed: f32| {
        let x = (1..=80).map(|k| now + speed * k as f32).collect();
        Trajectory::new(AgentId(id), x, vec![0.0; 80], vec![0.0; 80], vec![0.0; 80])
    };
    let future = |&speed: &f32| vec![drive(3, 10.0, speed), drive(9, 30.0, speed)];
    Rollouts::new("two cars", speeds.iter().map(future).collect())
}

fn year(year: Year) -> Config {
    Config::of(year)
}

#[test]
fn what_happened_is_more_likely_than_what_did_not() {
    let log = log();
    for y in Year::ALL {
        if y == Year::Y2025Generation {
            continue;
        }
        let config = year(y);
        let of = |rollouts| score(&log, &rollouts, &config).unwrap();
        let (oracle, fast) = (of(log.oracle(32, false)), of(rollouts(&[1.5; 32])));
        assert!(oracle.metametric > fast.metametric + 0.02, "{y:?}");
        assert_eq!((oracle.ade, oracle.min_ade), (0.0, 0.0));
        // Half a metre more each tenth of a second: 20.25 m on average over 80 of 91 steps.
        assert!(
            (fast.ade - 20.25 * 80.0 / 91.0).abs() < 1e-4,
            "{}",
            fast.ade
        );
    }
}

#[test]
fn the_best_rollout_is_the_least_far_one() {
    let scores = score(&log(), &rollouts(&[1.0, 1.5]), &year(Year::Y2025)).unwrap();
    assert_eq!(scores.min_ade, 0.0);
    assert!(scores.ade > 5.0);
}

#[test]
fn the_order_of_agents_and_threads_changes_nothing() {
    let log = log();
    let config = year(Year::Y2025);
    let ordered = rollouts(&[0.9, 1.0, 1.1, 1.3]);
    let mut mixed = ordered.clone();
    mixed.futures[1].reverse();
    let of = |rollouts| score(&log, rollouts, &config).unwrap();
    assert_eq!(of(&ordered), of(&mixed));
    let one = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    assert_eq!(one.install(|| of(&ordered)), of(&ordered));
}

#[test]
fn who_runs_a_red_light_is_found() {
    let mut log = log();
    for signals in &mut log.signals {
        signals[0].stop = true;
    }
    let config = year(Year::Y2025);
    let reference = Reference::new(&log, &config).unwrap();
    let evaluation = reference.evaluate(&rollouts(&[1.0, 0.1])).unwrap();
    let (logged, imagined) = evaluation.indications(Component::TrafficLightViolation);
    // At a tenth of the speed no car reaches the stop line, which the front car has 10 m ahead.
    assert_eq!(logged, [true, true]);
    assert_eq!(imagined, [[true, true], [false, false]]);
    assert_eq!(evaluation.scores.traffic_light_violation_rate, Some(0.5));
}

#[test]
fn the_largest_penalty_names_agent_and_step() {
    let log = log();
    let config = year(Year::Y2025);
    let reference = Reference::new(&log, &config).unwrap();
    let mut crash = rollouts(&[1.0; 32]);
    for future in &mut crash.futures {
        // The car behind runs into the one ahead after 2 s in every rollout.
        for k in 20..80 {
            future[0].x[k] = future[1].x[k] - 3.0;
        }
    }
    // In the last one a step later.
    crash.futures[31][0].x[20] = rollouts(&[1.0]).futures[0][0].x[20];
    let evaluation = reference.evaluate(&crash).unwrap();
    let first = evaluation.first_indications(Component::Collision);
    assert_eq!(first[..31], vec![vec![Some(20); 2]; 31]);
    assert_eq!(first[31], [Some(21); 2]);
    let (_, ever) = evaluation.indications(Component::Offroad);
    for (first, ever) in evaluation
        .first_indications(Component::Offroad)
        .iter()
        .zip(ever)
    {
        assert_eq!(first.iter().map(Option::is_some).collect::<Vec<_>>(), ever);
    }
    assert!(evaluation.first_indications(Component::LinearSpeed)[0].is_empty());
    let attributions = evaluation.explain();
    assert!(
        attributions
            .windows(2)
            .all(|pair| pair[0].cost >= pair[1].cost)
    );
    let collisions: Vec<_> = attributions
        .iter()
        .filter(|attribution| attribution.component == Component::Collision)
        .collect();
    assert_eq!(collisions.len(), 2);
    for attribution in collisions {
        assert_eq!(
            (attribution.step, attribution.logged, attribution.imagined),
            (Some(20), 0.0, 1.0)
        );
        // 0 of 32 rollouts agree with the log.
        assert!((attribution.likelihood.ln() + 10.3736).abs() < 1e-3);
        // Two agents share a quarter of the meta metric.
        assert!((attribution.cost - 0.125).abs() < 1e-4);
    }
    let costs: f64 = attributions
        .iter()
        .map(|attribution| attribution.cost)
        .sum();
    assert!((costs - (1.0 - evaluation.scores.metametric)).abs() < 1e-6);
    let oracle = log.oracle(32, false);
    let oracle = reference.evaluate(&oracle).unwrap().explain();
    assert!(oracle[0].cost < 0.03, "{:?}", oracle[0]);
}

#[test]
fn an_agent_that_keeps_to_the_log_is_more_realistic() {
    let log = log();
    let config = year(Year::Y2025);
    let reference = Reference::new(&log, &config).unwrap();
    let mut futures = rollouts(&[1.0; 32]);
    for future in &mut futures.futures {
        // From 4 s on the one ahead slides sideways in every rollout.
        for k in 40..80 {
            future[1].y[k] += 0.4 * (k - 40) as f32;
        }
    }
    let evaluation = reference.evaluate(&futures).unwrap();
    let found = evaluation.realism();
    let ids: Vec<_> = found.iter().map(|agent| agent.agent).collect();
    assert_eq!(ids, reference.features().agents);
    assert!(found[1].realism < found[0].realism - 0.1, "{found:?}");
    let mean = |steps: &[Option<f64>]| {
        let values: Vec<f64> = steps.iter().copied().flatten().collect();
        assert!(values.iter().all(|v| (0.0..=1.0).contains(v)));
        values.iter().sum::<f64>() / values.len() as f64
    };
    // The year pools all steps into one histogram: a step is as likely as what was logged then.
    assert_eq!(found[1].steps.len(), 80);
    assert!(mean(&found[1].steps) < mean(&found[0].steps), "{found:?}");
}

#[test]
fn averages_are_of_every_field() {
    let log = log();
    let config = year(Year::Y2025);
    let of = |speed| score(&log, &rollouts(&[speed; 4]), &config).unwrap();
    let (a, b) = (of(1.0), of(1.4));
    let mean = Scores::mean(&[a.clone(), b.clone()]).unwrap();
    assert_eq!(mean.metametric, (a.metametric + b.metametric) / 2.0);
    for component in Component::ALL {
        let expected = (a.components[&component] + b.components[&component]) / 2.0;
        assert_eq!(mean.components[&component], expected);
    }
    assert_eq!(Scores::mean(&[]), None);
}

#[test]
fn scenes_score_as_arrays_do() {
    let text = "edge: -50,-4 250,-4
        lane 1: -50,0 250,0
        ego vehicle 3: 10,0 velocity 10,0
        agent pedestrian 4: 40,3 velocity 0,1
        history 1.0 future 8.0 dt 0.1";
    let scenario = fixture::scenario(text).unwrap();
    let log = Log::of(&scenario).unwrap();
    assert_eq!(log.tracks.len(), 2);
    let rollouts = Rollouts::of(&scenario.id, &[logged(&scenario)], Mode::SimAgents).unwrap();
    assert_eq!(rollouts.futures, log.oracle(1, false).futures);
    let config = year(Year::Y2025);
    assert!(score(&log, &rollouts, &config).unwrap().metametric > 0.5);
    let whole = Rollouts::of(&scenario.id, &[logged(&scenario)], Mode::Generation).unwrap();
    assert_eq!(whole.futures, log.oracle(1, true).futures);
    let config = year(Year::Y2025Generation);
    assert!(score(&log, &whole, &config).unwrap().metametric > 0.5);
}

#[test]
fn scenes_of_another_clock_are_refused() {
    let text = "ego vehicle 3: 10,0\nhistory 5 future 40 dt 0.5";
    let error = Log::of(&fixture::scenario(text).unwrap()).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("expected steps of 0.1 s, found 0.5 s")
    );
    let text = "ego vehicle 3: 10,0\nhistory 11 future 3 dt 0.1";
    let scenario = fixture::scenario(text).unwrap();
    assert!(matches!(
        Log::of(&scenario),
        Ok(_) | Err(WosacError::Clock { .. })
    ));
}

/// Scores a good input after `change` and checks the parts of the error message.
#[track_caller]
fn fails(change: impl Fn(&mut Log, &mut Rollouts), parts: &[&str]) {
    let (mut log, mut rollouts) = (log(), rollouts(&[1.0, 1.1]));
    change(&mut log, &mut rollouts);
    let error = score(&log, &rollouts, &year(Year::Y2025))
        .unwrap_err()
        .to_string();
    for part in parts {
        assert!(error.contains(part), "expected {part} in: {error}");
    }
}

#[test]
fn rollouts_that_do_not_fit_are_refused() {
    fails(|_, r| r.scenario = "x".into(), &["two cars", "those of x"]);
    fails(
        |_, r| r.futures.clear(),
        &["two cars", "at least one rollout"],
    );
    fails(
        |_, r| drop(r.futures[1].pop()),
        &["two cars", "rollout 1", "agent 9 is missing"],
    );
    fails(
        |_, r| r.futures[1][0].id = AgentId(4),
        &["rollout 1", "agent 4", "not valid"],
    );
    fails(
        |_, r| r.futures[0][0].id = AgentId(9),
        &["rollout 0", "agent 9", "twice"],
    );
    fails(
        |_, r| r.futures[0][1].heading.truncate(79),
        &["rollout 0", "80 steps in heading of agent 9", "found 79"],
    );
    fails(
        |_, r| r.futures[0][1].z[7] = f32::NAN,
        &["rollout 0", "z of agent 9 at step 7", "NaN"],
    );
}

#[test]
fn logs_that_the_metric_is_not_defined_on_are_refused() {
    fails(|l, _| l.road_edges.clear(), &["two cars", "road edge"]);
    fails(
        |l, _| l.road_edges[1][0][2] = f32::NAN,
        &["two cars", "a road edge", "NaN"],
    );
    fails(
        |l, _| l.tracks[0].states.truncate(90),
        &["91 logged steps of agent 9", "found 90"],
    );
    fails(
        |l, _| l.tracks[0].id = AgentId(3),
        &["agent once", "3 twice"],
    );
    fails(|l, _| l.ego = None, &["an ego"]);
    fails(
        |l, _| l.ego = Some(AgentId(8)),
        &["the ego 8", "found none"],
    );
    fails(
        |l, _| l.targets[0] = AgentId(8),
        &["target 8", "found none"],
    );
    fails(
        |l, _| l.tracks[0].states[10].valid = false,
        &["agent 9", "present step"],
    );
    fails(
        |l, _| l.tracks[0].states[40].heading = f32::INFINITY,
        &["heading of agent 9", "step 40", "inf"],
    );
    fails(
        |l, _| drop(l.signals.pop()),
        &["signals of 91 steps", "90 steps"],
    );
    let error = log().ego(AgentId(77)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "scenario two cars: expected a track of the ego 77, found none"
    );
}

#[test]
fn an_agent_never_valid_again_is_not_scored_and_nothing_at_all_is_nan() {
    let (mut log, rollouts) = (log(), rollouts(&[1.0, 1.1]));
    let config = year(Year::Y2025);
    for state in &mut log.tracks[0].states[11..] {
        state.valid = false;
    }
    let scores = score(&log, &rollouts, &config).unwrap();
    assert!(scores.metametric > 0.0);
    for state in &mut log.tracks[1].states[11..] {
        state.valid = false;
    }
    // As the reference has it: the mean of no likelihoods.
    let scores = score(&log, &rollouts, &config).unwrap();
    assert!(scores.metametric.is_nan());
    assert!(scores.components[&Component::LinearSpeed].is_nan());
}

#[test]
fn what_a_rollout_is_worth_is_the_score_less_that_of_the_others() {
    let log = log();
    for y in Year::ALL {
        if y == Year::Y2025Generation {
            continue;
        }
        let config = year(y);
        let reference = Reference::new(&log, &config).unwrap();
        let speeds = [0.9, 1.0, 1.1, 0.2, 1.0];
        let all = reference.evaluate(&rollouts(&speeds)).unwrap();
        let worth = all.leave_one_out().unwrap();
        for i in 0..speeds.len() {
            let mut others = speeds.to_vec();
            others.remove(i);
            let plain = reference.evaluate(&rollouts(&others)).unwrap();
            let (plain, found) = (plain.scores.metametric, worth.metametric[i]);
            assert!((found - plain).abs() < 1e-9, "{y:?} {i}: {found} {plain}");
            // The parts are worth about the whole.
            let parts: f64 = worth.credit[i].iter().sum();
            let whole = all.scores.metametric - plain;
            assert!(
                (parts - whole).abs() < 0.3 * whole.abs() + 1e-3,
                "{y:?} {i}: {parts} of {whole}"
            );
        }
        assert_eq!(worth.agents, [AgentId(3), AgentId(9)]);
        // Keeping to the log scores higher than standing nearly still.
        let total = |i: usize| worth.credit[i].iter().sum::<f64>();
        assert!(total(1) > total(3), "{y:?}");
        let one = reference.evaluate(&rollouts(&[1.0])).unwrap();
        assert!(one.leave_one_out().is_none());
    }
}
