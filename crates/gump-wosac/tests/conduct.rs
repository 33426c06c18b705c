//! Realism scores compared with implausible conduct that a driver would notice.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use gump_geometry::Pose;
use gump_metrics::behaviour::{Behaviour, Class, Deed, Measure, judge};
use gump_metrics::logged;
use gump_scene::{Agent, AgentId, Frame, Rollout, Scenario, fixture};
use gump_wosac::realism::{Config, Log, Mode, Reference, Rollouts, Year};

const ROAD: &str = "lane 1: -100,0 500,0\nego vehicle 0: 0,0 velocity 10,0\n";

fn scenario(text: &str) -> Scenario {
    fixture::scenario(text).unwrap()
}

/// A future of 8 s in which every agent is at the place that `drive` returns for the time in
/// seconds.
fn future(scenario: &Scenario, drive: impl Fn(&Agent, f64) -> Pose) -> Rollout {
    let present = scenario.present();
    let mut rollout = Rollout::begin(present);
    for step in 1..=80 {
        let agents = present.now().agents().iter().map(|agent| {
            let mut agent = *agent;
            agent.state.pose = drive(&agent, f64::from(step) * 0.1);
            agent
        });
        let frame = Frame::new(agents.collect(), present.now().lights().to_vec());
        rollout.push(frame);
    }
    rollout
}

fn ahead(pose: Pose, metres: f64) -> Pose {
    pose * Pose::new(metres, 0.0, 0.0)
}

#[test]
fn the_parked_car_that_pulls_out_in_every_future_is_the_worst() {
    let text = format!(
        "{ROAD}edge: -150,-9 600,-9
         agent vehicle 1: 30,-5
         agent vehicle 2: 60,0 velocity 10,0
         agent pedestrian 3: 40,8 velocity 1,0
         history 1 future 8 dt 0.1"
    );
    let scenario = scenario(&text);
    // Agent 2 slows down a little, never as logged; agent 1 pulls out, each time elsewhere.
    let futures: Vec<Rollout> = (0..8)
        .map(|i| {
            future(&scenario, |agent, t| {
                let (pose, speed) = (agent.state.pose, agent.state.velocity.length());
                match agent.id.0 {
                    1 => ahead(pose, 0.4 * (t - 0.5 * f64::from(i)).max(0.0).powi(2)),
                    2 => ahead(pose, (speed - 2.0 - 0.1 * f64::from(i)) * t),
                    _ => ahead(pose, speed * t),
                }
            })
        })
        .collect();
    let config = Config::of(Year::Y2025);
    let log = Log::of(&scenario).unwrap();
    let reference = Reference::new(&log, &config).unwrap();
    let imagined = Rollouts::of(&scenario.id, &futures, config.mode).unwrap();
    let realism = reference.evaluate(&imagined).unwrap().realism();
    let own = |id| realism.iter().find(|agent| agent.agent == AgentId(id));
    let (parked, slow) = (own(1).unwrap().realism, own(2).unwrap().realism);
    // What this is about: the log alone finds the parked car fine.
    assert!(parked > 0.5 && parked > slow - 0.2, "{parked} {slow}");
    let conduct = Behaviour::new(&scenario, 8).conduct(&futures);
    let judged = judge(realism.iter().map(|one| (one.agent, one.realism)), conduct);
    assert_eq!(judged[0].conduct.agent, AgentId(1), "{judged:?}");
    let worst = &judged[0];
    assert_eq!((worst.plausibility, worst.conduct.any), (0.0, 1.0));
    let deed = Deed::Measured(Measure::ParkedMove);
    assert_eq!(worst.conduct.deeds[0], (deed, 1.0));
    assert!(
        judged[1..].iter().all(|agent| agent.plausibility > 0.3),
        "{judged:?}"
    );
}

#[test]
fn paths_show_what_their_rollouts_show() {
    let text = "lane 1: -100,0 500,0\nego vehicle 0: 0,0 velocity 5,0\n\
                agent vehicle 1: 30,0\nagent pedestrian 2: 9,9 velocity 1,0";
    let scenario = fixture::scenario(text).unwrap();
    let log = logged(&scenario);
    let paths = Rollouts::of("fixture", std::slice::from_ref(&log), Mode::SimAgents).unwrap();
    let found = paths.in_scene(&scenario);
    assert_eq!(found.len(), 1);
    let behaviour = Behaviour::new(&scenario, 8);
    let tally = behaviour.of(&found[0]).tally;
    assert_eq!(tally.count(Measure::NewOverlap, Class::All, 8).events, 1.0);
    assert_eq!(tally, behaviour.of(&log).tally);
}
