//! Content of the page: traffic to within a unit, any number of futures, any text.

use std::io::Read as _;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use flate2::read::DeflateDecoder;
use gump_geometry::{Pose, dvec2, wrap_angle};
use gump_scene::{Agent, AgentKind, AgentState, LightState, Seed, fixture};
use std::f64::consts::TAU;

use super::*;
use crate::theme::{Colours, Rgb};
use crate::{Theme, log_as_rollout};
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
    let mut viewer = Viewer::new(&scenario);
    viewer.futures(&futures);
    let alone = viewer.to_html().len() as f64 / 1e6;
    // And of one future what each of them might do at any of 16 steps, 128 draws each; of 32 agents
    // three metrics that never rest, in every future.
    for step in 0..16 {
        for agent in futures[0].imagined()[5 * step].agents() {
            let draw = |k: u64| {
                let noise = ((k * 2_654_435_761 + step as u64 * 977) % 1000) as f64 / 500.0 - 1.0;
                let mut draw = agent.state;
                let sideways = draw.pose.direction().perp() * noise.powi(3);
                draw.pose.position += draw.velocity * (0.5 + 0.2 * noise) + sideways;
                draw.pose.heading += 0.2 * noise * noise;
                draw.velocity *= 1.0 + 0.2 * noise;
                draw
            };
            viewer.heat(HeatMap {
                agent: agent.id,
                future: 0,
                from_s: 0.5 * step as f64,
                ahead_s: 0.5,
                draws: (0..128).map(draw).collect(),
            });
        }
    }
    for (k, future) in futures.iter().enumerate() {
        for (id, name) in (0..32).flat_map(|id| ["a, m", "b, m", "c, s"].map(|name| (id, name))) {
            let position = |frame: &Frame| Some(frame.agent(AgentId(id))?.state.pose.position);
            let frames = future.imagined().iter();
            viewer.metric(MetricTrack {
                name: name.into(),
                agent: AgentId(id),
                future: Some(k),
                first: 1,
                values: frames
                    .map(|frame| position(frame).map(|p| p.length()))
                    .collect(),
            });
        }
    }
    let html = viewer.to_html();
    let megabytes = html.len() as f64 / 1e6;
    eprintln!(
        "32 futures of 128 jittering agents over 80 steps: {alone:.2} MB, with heat maps and \
         metrics {megabytes:.2} MB"
    );
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
        parts: vec![(attack.into(), 1.0)],
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
        first: 1,
        values: vec![Some(1.23456), None, Some(-0.5)],
    });
    let html = viewer.to_html();
    let facts: Value = serde_json::from_str(element(&html, "facts")).unwrap();
    assert_eq!(facts["ego"], 0);
    assert_eq!(facts["takes"][0]["frames"], 91);
    assert_eq!(facts["takes"][0]["first"], -1.0);
    let take = json!({ "name": "as it was", "first": 0.0, "dt": 0.1, "frames": 81 });
    assert_eq!(facts["takes"][1], take);
    assert_eq!(facts["metrics"], json!(["time to collision, s"]));
    assert_eq!(facts["lights"], json!([[2000, 0]]));
    // Both lanes of the way, their two ribbons of the route and the crosswalk; lane 3 is far away.
    assert_eq!(facts["features"], 5);

    // The last things in the bytes: the light of the future, one stretch of red; one metric, of
    // agent 2 in take 1 from frame 1 on, two stretches of one value each; no heat map.
    let bytes = unpacked(&html);
    let red = pack::colour(LightState::Red);
    let mut tail = vec![1, red, 81];
    tail.extend([1, 0, 2, 1, 1, 2, 0, 1, 2 * 123, 1, 1, 2 * 50 - 1, 0]);
    let n_bytes = tail.len() + 1;
    let mut reader = Reader(&bytes[bytes.len() - n_bytes..]);
    let found: Vec<u64> = tail.iter().map(|_| reader.unsigned()).collect();
    assert_eq!(found, tail);
    assert!(reader.0.is_empty());
}

#[test]
fn a_gallery_holds_a_block_for_each_scene() {
    let (first, mut second) = (crossing(), crossing());
    second.id = "a & b".into();
    second.log.truncate(second.now + 1);
    let mut gallery = Gallery::default();
    assert!(gallery.is_empty() && gallery.to_html().contains("<title>0 scenes</title>"));
    gallery.add(&Viewer::new(&first)).add(&Viewer::new(&second));
    assert_eq!(gallery.len(), 2);
    let html = gallery.to_html();
    assert!(html.contains("<title>2 scenes</title>"));
    let facts: Value = serde_json::from_str(element(&html, "facts-2")).unwrap();
    assert_eq!(facts["id"], "a & b");
    assert_eq!(facts["takes"][0]["frames"], 11);
    // The first one is as it would be alone.
    let alone = Viewer::new(&first).to_html();
    for id in ["facts", "data"] {
        assert_eq!(element(&html, id), element(&alone, id));
    }
    assert!(html.len() < alone.len() + 4000, "the page is there once");
}

#[test]
fn scripts_and_pictures_have_the_same_colours() {
    let script = include_str!("../traffic.js");
    let (light, dark) = script.split_once("dark: {").unwrap();
    for (theme, text) in [(Theme::Light, light), (Theme::Dark, dark)] {
        let palette = text.split_once("};").map_or(text, |(palette, _)| palette);
        for (name, [r, g, b]) in named(theme.colours()) {
            let entry = format!("{name}: '#{r:02x}{g:02x}{b:02x}'");
            assert!(palette.contains(&entry), "{theme:?}: {entry}");
        }
    }
}

/// The colours by their names in scripts.
fn named(colours: &Colours) -> [(&'static str, Rgb); 19] {
    [
        ("ground", colours.ground),
        ("road", colours.road),
        ("route", colours.route),
        ("crosswalk", colours.crosswalk),
        ("direction", colours.direction),
        ("whiteLine", colours.white_line),
        ("yellowLine", colours.yellow_line),
        ("edge", colours.edge),
        ("text", colours.text),
        ("ego", colours.ego),
        ("vehicle", colours.vehicle),
        ("pedestrian", colours.pedestrian),
        ("bicycle", colours.bicycle),
        ("other", colours.other),
        ("outline", colours.outline),
        ("wedge", colours.wedge),
        ("red", colours.red),
        ("yellow", colours.yellow),
        ("green", colours.green),
    ]
}

#[test]
fn a_heat_map_keeps_how_many_draws_are_where() {
    let scenario = crossing();
    let log = log_as_rollout(&scenario);
    // Facing +y: three draws in one cell, one ahead and to the left of them; no draw turns.
    let draw = |x: f64, y: f64, speed: f64| AgentState {
        pose: Pose::new(x, y, TAU / 4.0),
        velocity: dvec2(0.0, speed),
    };
    let draws = vec![
        draw(40.16, 4.0, 4.0),
        draw(40.16, 4.0, 4.0),
        draw(40.16, 4.0, 4.2),
        draw(39.92, 5.0, 5.1),
    ];
    let mut viewer = Viewer::new(&scenario);
    let heat = HeatMap {
        agent: AgentId(7),
        future: 0,
        from_s: 0.5,
        ahead_s: 0.5,
        draws,
    };
    let elsewhere = HeatMap {
        agent: AgentId(77),
        ..heat.clone()
    };
    viewer.future("1", &log).heat(heat).heat(elsewhere);
    let bytes = unpacked(&viewer.to_html());
    // No metric, one heat map: agent 1, take 1, 500 ms, 500 ms, 4 draws; mean (30.1, 4.25) off the
    // ego, a quarter turn; two cells; speeds from bar 8 on; turns in bar 0.
    let zigzag = |n: i64| ((n << 1) ^ (n >> 63)) as u64;
    let mut tail = vec![0, 1, 1, 1, 500, 500, 4];
    tail.extend([zigzag(3010), zigzag(425), zigzag(2048), 2]);
    tail.extend([zigzag(-1), zigzag(-3), 3, zigzag(2), zigzag(10), 1]);
    tail.extend([zigzag(8), 3, 3, 0, 1, zigzag(0), 1, 4]);
    let n_bytes: usize = tail.iter().map(|&n| if n < 0x80 { 1 } else { 2 }).sum();
    let mut reader = Reader(&bytes[bytes.len() - n_bytes..]);
    let found: Vec<u64> = tail.iter().map(|_| reader.unsigned()).collect();
    assert_eq!(found, tail);
}
