//! What the page holds: traffic to within a unit, any number of futures, any text.

use std::io::Read as _;

use flate2::read::DeflateDecoder;
use gump_geometry::{Pose, dvec2, wrap_angle};
use gump_scene::{Agent, AgentKind, AgentState, LightState, Seed, fixture};
use std::f64::consts::TAU;

use super::*;
use crate::log_as_rollout;
use pack::tests::Reader;

fn crossing() -> Scenario {
    fixture::scenario(
        "lane 1: -80,0 80,0 next 2
         lane 2: 80,0 2000,0
         lane 3: 900,500 950,500
         light 1 red: 30,0
         crosswalk: 34,-2 38,-2 38,2 34,2
         route 1,2
         ego vehicle 0: 10,0 velocity 8,0
         agent pedestrian 7: 40,3 velocity 0,-1
         agent vehicle 9: 60,3.5 heading 3.14 velocity -9,0.1
         history 1 future 8 dt 0.1",
    )
    .unwrap()
}

/// The text of the element with this id.
fn element<'h>(html: &'h str, id: &str) -> &'h str {
    let (_, rest) = html.split_once(&format!("id=\"{id}\">")).unwrap();
    rest.split_once("</script>").unwrap().0
}

fn unpacked(html: &str) -> Vec<u8> {
    let packed = BASE64.decode(element(html, "data")).unwrap();
    let mut bytes = Vec::new();
    let read = DeflateDecoder::new(&packed[..]).read_to_end(&mut bytes);
    read.unwrap();
    bytes
}

/// Agents that jitter and turn at random, so that nothing about them compresses well; some come
/// late, some leave for a while.
fn crowd(n_agents: i64, steps: usize, seed: Seed) -> Rollout {
    let mut scenario = crossing();
    scenario.log.truncate(scenario.now + 1);
    let mut rollout = Rollout::begin(scenario.present());
    // A linear congruence is enough of a dice for this.
    let mut dice = (seed.0 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let mut random = move || {
        dice = dice.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (dice >> 33) as f64 / f64::from(1u32 << 31) - 0.5
    };
    let mut states: Vec<_> = (0..n_agents)
        .map(|i| {
            (
                dvec2(i as f64, -(i as f64)),
                random() * TAU,
                10.0 + random(),
            )
        })
        .collect();
    for step in 0..steps {
        let mut agents = Vec::new();
        for (id, (position, heading, speed)) in (0..).zip(&mut states) {
            *heading = wrap_angle(*heading + 0.05 * random());
            *speed += 0.3 * random();
            let velocity = DVec2::from_angle(*heading) * *speed;
            *position += velocity * 0.1 + 0.1 * dvec2(random(), random());
            if (id % 5 == 1 && step < 7) || (id % 5 == 2 && (20..24).contains(&step)) {
                continue;
            }
            agents.push(Agent {
                id: AgentId(id),
                kind: AgentKind::Vehicle,
                length: 4.5,
                width: 2.0,
                height: 1.5,
                elevation: 0.0,
                state: AgentState {
                    pose: Pose {
                        position: *position,
                        heading: *heading,
                    },
                    velocity,
                },
            });
        }
        rollout.push(Frame::new(agents, Vec::new()));
    }
    rollout
}

#[test]
fn what_is_packed_comes_back_to_within_half_a_unit() {
    let rollout = crowd(12, 60, Seed(3));
    let origin = dvec2(-300.0, 500.0);
    let frames: Vec<&Frame> = rollout.imagined().iter().collect();
    let mut packer = Packer::new(origin);
    for id in 0..12 {
        packer.track(AgentId(id), &frames);
    }
    let bytes = packer.into_bytes();
    let mut reader = Reader(&bytes);
    let half = CENTI / 2.0 + 1e-9;
    for id in 0..12 {
        let states = reader.track(frames.len());
        for (state, frame) in states.iter().zip(&frames) {
            let agent = frame.agent(AgentId(id));
            assert_eq!(state.is_some(), agent.is_some());
            let (Some([x, y, heading, speed]), Some(agent)) = (state, agent) else {
                continue;
            };
            let error = dvec2(*x, *y) + origin - agent.state.pose.position;
            assert!(error.abs().max_element() <= half, "{error}");
            assert!((speed - agent.state.speed()).abs() <= half);
            let turn = wrap_angle(heading - agent.state.pose.heading);
            assert!(turn.abs() <= TAU / HEADINGS as f64 / 2.0 + 1e-9, "{turn}");
        }
    }
    assert!(reader.0.is_empty());
}

#[test]
fn thirty_two_futures_of_a_crowd_stay_under_five_megabytes() {
    let scenario = crossing();
    let futures: Vec<_> = (0..32).map(|k| crowd(128, 80, Seed(k))).collect();
    let html = Viewer::new(&scenario).futures(&futures).to_html();
    let megabytes = html.len() as f64 / 1e6;
    eprintln!("32 futures of 128 jittering agents over 80 steps: {megabytes:.2} MB");
    assert!(megabytes < 5.0, "{megabytes} MB");
    // It is all there: nothing of that size is small.
    assert!(unpacked(&html).len() > 32 * 80 * 100 * 4);
}

#[test]
fn no_text_breaks_out_of_its_place() {
    let mut scenario = crossing();
    let attack = "</script><script>alert(1)</script><!--\"'&@@data@@";
    scenario.id = attack.into();
    let mut viewer = Viewer::new(&scenario);
    viewer.note(attack).candidate(CandidatePath {
        name: attack.into(),
        score: Some(f64::NAN),
        is_chosen: true,
        path: vec![dvec2(10.0, 0.0), dvec2(20.0, 0.0)],
    });
    let harmless = crossing();
    let count = |html: &str, what: &str| html.matches(what).count();
    let (html, plain) = (viewer.to_html(), Viewer::new(&harmless).to_html());
    for what in ["<script", "</script", "<!--", "alert(1)</"] {
        assert_eq!(count(&html, what), count(&plain, what), "{what}");
    }
    let facts: Value = serde_json::from_str(element(&html, "facts")).unwrap();
    assert_eq!(facts["id"], attack);
    assert_eq!(facts["candidates"][0]["name"], attack);
    assert_eq!(facts["candidates"][0]["score"], Value::Null);
    assert_eq!(facts["candidates"][0]["path"][1], json!([1000, 0]));
    assert!(!html.contains("src=") && !html.contains("http"));
}

#[test]
fn the_page_knows_takes_lights_metrics_and_the_road_nearby() {
    let scenario = crossing();
    let log = log_as_rollout(&scenario);
    let mut viewer = Viewer::new(&scenario);
    viewer.future("as it was", &log).metric(MetricTrack {
        name: "time to collision, s".into(),
        agent: AgentId(9),
        future: Some(0),
        values: vec![Some(1.23456), None],
    });
    let html = viewer.to_html();
    let facts: Value = serde_json::from_str(element(&html, "facts")).unwrap();
    assert_eq!(facts["ego"], 0);
    assert_eq!(facts["takes"][0]["frames"], 91);
    assert_eq!(facts["takes"][0]["first"], -1.0);
    let take = json!({ "name": "as it was", "first": 0.0, "dt": 0.1, "frames": 81 });
    assert_eq!(facts["takes"][1], take);
    let metric = json!({
        "name": "time to collision, s", "agent": 2, "take": 1, "values": [1.235, null],
    });
    assert_eq!(facts["metrics"][0], metric);
    assert_eq!(facts["lights"], json!([[2000, 0]]));
    // Both lanes of the way, their two ribbons of the route and the crosswalk; lane 3 is far away.
    assert_eq!(facts["features"], 5);

    // The last thing in the bytes is the light of the future: one stretch of red.
    let bytes = unpacked(&html);
    let mut reader = Reader(&bytes[bytes.len() - 3..]);
    let red = pack::colour(LightState::Red);
    assert_eq!([(); 3].map(|()| reader.unsigned()), [1, red, 81]);
}
