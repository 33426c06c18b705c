//! Scenes by example: agents with tokens, their order, counts, and decoding.

use gump_geometry::dvec2;
use gump_scene::{Agent, LaneId, Light, LightState};

use super::*;
use crate::{EncodeReport, GrammarError, Overflow};

const CROSSING: &str = "
    lane 1: 20,0 60,0
    lane 2: 40,20 40,-20
    light 1 green: 38,0
    light 2 red: 40,18
    ego vehicle 0: 10,0 velocity 8,0 size 5.176,2.297
    agent vehicle 9: 30,3.4 velocity 5,0
    agent bicycle 4: 25,-3 velocity 4,0
    agent pedestrian 7: 40,8 velocity 0,-1.5
    agent vehicle 5: 40,30 velocity 0,-10
    agent other 6: 20,5";

#[test]
fn a_scene_reads_as_text() {
    let encoded = check(
        CROSSING,
        2,
        "BEGIN
           light 1 green at 10.0,0.0 heading 0.000
           light 2 red at 30.0,20.0 heading -1.571
         LIGHTS_END
           ego(vehicle) at -4.0,0.0 heading 0.000 velocity 8.00,0.00 size 5.0,2.5
           1(vehicle) at 17.6,3.4 heading 0.000 velocity 5.00,0.00 size 5.0,2.0
           2(vehicle) at 30.0,35.0 heading -1.571 velocity 0.00,-10.00 size 5.0,2.0
           3(pedestrian) at 30.0,8.8 heading -1.571 velocity 0.00,-1.50 size 1.0,1.0
           4(bicycle) at 13.0,-3.0 heading 0.000 velocity 4.00,0.00 size 2.0,0.5
         NEWBORN
         BEGIN
           light 1 green at 10.0,0.0 heading 0.000
           light 2 red at 30.0,20.0 heading -1.571
         LIGHTS_END
           ego(vehicle) at 0.0,0.0 heading 0.000 velocity 8.00,0.00 size 5.0,2.5
           1(vehicle) at 20.0,3.4 heading 0.000 velocity 5.00,0.00 size 5.0,2.0
           2(vehicle) at 30.0,30.0 heading -1.571 velocity 0.00,-10.00 size 5.0,2.0
           3(pedestrian) at 30.0,8.0 heading -1.571 velocity 0.00,-1.50 size 1.0,1.0
           4(bicycle) at 15.0,-3.0 heading 0.000 velocity 4.00,0.00 size 2.0,0.5
         NEWBORN",
    );
    assert_eq!(encoded.lights, [LaneId(1), LaneId(2)]);
    let nothing_lost = EncodeReport {
        frames: 0..2,
        ..EncodeReport::default()
    };
    assert_eq!(encoded.report, nothing_lost);
    assert_eq!(encoded.sequence.len(), 2 * (3 + 2 + 2 * 5));
    assert_eq!(encoded.sequence.frame_starts(), [0, 15]);
}

#[test]
fn who_comes_into_range_is_newborn_under_its_own_id() {
    let encoded = check(
        "ego vehicle 0: 0,0
         agent vehicle 1: 99,0 velocity -4,0
         agent pedestrian 2: 0,-99.8 velocity 0,-1",
        2,
        "BEGIN
         LIGHTS_END
           ego(vehicle) at 0.0,0.0 heading 0.000 velocity 0.00,0.00 size 5.0,2.0
           2(pedestrian) at 0.0,-99.2 heading -1.571 velocity 0.00,-1.00 size 1.0,1.0
         NEWBORN
         BEGIN
         LIGHTS_END
           ego(vehicle) at 0.0,0.0 heading 0.000 velocity 0.00,0.00 size 5.0,2.0
           2(pedestrian) at 0.0,-99.8 heading -1.571 velocity 0.00,-1.00 size 1.0,1.0
         NEWBORN
           1(vehicle) at 99.0,0.0 heading -3.142 velocity -4.00,0.00 size 5.0,2.0",
    );
    assert_eq!(encoded.report.out_of_range, 1);
}

#[test]
fn pedestrians_may_have_a_range_of_their_own() {
    let text = "ego vehicle 0: 0,0
                agent pedestrian 1: 40,0
                agent pedestrian 2: 0,40.1
                agent vehicle 3: 60,0";
    let (scenario, pose) = scenario(text);
    let frames = scenario.present().strided_history(5, 1);
    let identities = Identities::ranked(&frames, EGO, pose);
    let compat = TokenizerConfig {
        pedestrian_range_m: 40.0,
        ..TokenizerConfig::default()
    };
    let encoded = Tokenizer::new(compat).encode(&scenario.map, &frames, EGO, pose, &identities);
    let ids = encoded.sequence.frames()[0]
        .agents()
        .map(|agent| agent.key.id);
    assert_eq!(ids.collect::<Vec<_>>(), [0, 1, 2]);
    assert_eq!(encoded.report.out_of_range, 1);
}

#[test]
fn the_ego_stays_and_what_it_loses_is_counted() {
    let text = "ego vehicle 0: 0,0 velocity 31,0 size 15.5,7.5
                history 4.0 future 1.0 dt 0.5";
    let (scenario, pose) = scenario(text);
    let frames: Vec<&Frame> = scenario.log[..9].iter().collect();
    let encoded = encode(&scenario.map, &frames, pose);
    let first = &encoded.sequence.frames()[0].tracked[0];
    assert_eq!(first.state.x, 0, "124 m behind is the last bin behind");
    let counts: Vec<(Field, usize)> = encoded.report.clamped.into_iter().collect();
    let expected = [
        (Field::X, 2),
        (Field::VelocityX, 9),
        (Field::Width, 9),
        (Field::Length, 9),
    ];
    assert_eq!(counts, expected);
}

#[test]
fn frames_before_a_gap_in_the_egos_track_are_left_out() {
    let (scenario, pose) = scenario("ego vehicle 0: 0,0\nagent vehicle 1: 9,0");
    let without = |id: i64| {
        let agents = scenario.log[0]
            .agents()
            .iter()
            .filter(|agent| agent.id.0 != id);
        Frame::new(agents.copied().collect(), Vec::new())
    };
    let (whole, gap) = (&scenario.log[0], &without(0));
    let encoded = encode(&scenario.map, &[whole, gap, whole, whole, gap], pose);
    assert_eq!(encoded.report.frames, 2..4);
    assert_eq!(encoded.sequence.frames().len(), 2);
    let encoded = encode(&scenario.map, &[gap], pose);
    assert!(encoded.sequence.is_empty());

    // A track that is away for one frame keeps its id and is newborn again.
    let encoded = encode(&scenario.map, &[whole, &without(1), whole], pose);
    let last = &encoded.sequence.frames()[2];
    assert_eq!(
        last.newborn.iter().map(|a| a.key.id).collect::<Vec<_>>(),
        [1]
    );
}

#[test]
fn broken_states_and_changing_kinds_are_no_tokens() {
    let (scenario, pose) =
        scenario("ego vehicle 0: 0,0\nagent vehicle 1: 9,0\nagent vehicle 2: 5,0");
    let change = |id: i64, change: &dyn Fn(&mut Agent)| {
        let mut agents = scenario.log[0].agents().to_vec();
        agents
            .iter_mut()
            .filter(|agent| agent.id.0 == id)
            .for_each(change);
        Frame::new(agents, Vec::new())
    };
    let nan = change(1, &|agent| agent.state.velocity.x = f64::NAN);
    let bicycle = change(2, &|agent| agent.kind = AgentKind::Bicycle);
    let cone = change(2, &|agent| agent.kind = AgentKind::Other);
    let encoded = encode(
        &scenario.map,
        &[&scenario.log[0], &nan, &bicycle, &cone],
        pose,
    );
    assert_eq!(encoded.report.not_finite, 1);
    let kinds = |frame: usize| -> Vec<(u16, AgentKind)> {
        let agents = encoded.sequence.frames()[frame].agents();
        agents.map(|agent| (agent.key.id, agent.key.kind)).collect()
    };
    let [ego, near, far] = [0, 1, 2].map(|id| (id, AgentKind::Vehicle));
    assert_eq!(kinds(0), [ego, near, far]);
    assert_eq!(
        kinds(1),
        [ego, near],
        "a state that is not a number is no state"
    );
    assert_eq!(kinds(2), [ego, near, far], "an agent keeps its first kind");
    assert_eq!(kinds(3), [ego, far], "a thing is no token");
}

#[test]
fn too_many_agents_lose_their_farthest() {
    let (scenario, pose) = scenario(CROSSING);
    let frames = scenario.present().strided_history(5, 2);
    let identities = Identities::ranked(&frames, EGO, pose);
    let config = TokenizerConfig {
        max_agents: 2,
        ..TokenizerConfig::default()
    };
    let encoded = Tokenizer::new(config).encode(&scenario.map, &frames, EGO, pose, &identities);
    let last = encoded.sequence.frames()[1]
        .agents()
        .map(|agent| agent.key.id);
    assert_eq!(last.collect::<Vec<_>>(), [0, 1, 4]);
    assert_eq!(encoded.report.over_capacity, 4);
}

#[test]
fn lights_are_numbered_as_now_and_unknown_where_unseen() {
    use LightState::{Green, Red, Unknown, Yellow};
    let (scenario, pose) = scenario(
        "lane 1: 99,0 120,0
         lane 2: 20,0 60,0
         lane 3: 10,0 60,0
         lane 4: 101,0 120,0
         ego vehicle 0: 0,0",
    );
    let with = |lights: &[(i64, LightState)]| {
        let lights = lights.iter().map(|&(lane, state)| Light {
            lane: LaneId(lane),
            state,
            stop_point: None,
        });
        Frame::new(scenario.log[0].agents().to_vec(), lights.collect())
    };
    let before = with(&[(3, Red), (1, Red), (4, Red)]);
    let now = with(&[(2, Green), (1, Yellow), (8, Red)]);
    let encoded = encode(&scenario.map, &[&before, &now], pose);
    // Lane 4 is too far, lane 8 is not in the map; lane 3 is near but not seen now.
    assert_eq!(encoded.lights, [2, 1, 3].map(LaneId));
    let states = |frame: usize| -> Vec<(u16, LightState)> {
        let lights = encoded.sequence.frames()[frame].lights.iter();
        lights.map(|light| (light.index, light.state)).collect()
    };
    assert_eq!(states(0), [(1, Unknown), (2, Red), (3, Red)]);
    assert_eq!(states(1), [(1, Green), (2, Yellow), (3, Unknown)]);
    let shared = gump_scene::light_indices_of(&scenario.map, &now, pose.position, 100.0);
    for (index, light) in shared {
        assert_eq!(
            encoded.lights[index - 1],
            light.lane,
            "the raster paints the same number"
        );
    }
}

#[test]
fn lights_beyond_the_most_are_counted() {
    let mut text = String::from("ego vehicle 0: 0,0\n");
    for lane in 1..=70 {
        text += &format!(
            "lane {lane}: {},3 45,9\nlight {lane} red: 1,1\n",
            f64::from(lane) / 2.0
        );
    }
    let encoded = encode_text(&text, 3);
    assert_eq!(encoded.report.lights_over_capacity, 7);
    let lights = &encoded.sequence.frames()[0].lights;
    assert_eq!(lights.len(), 63);
    assert_eq!(
        (lights[62].index, lights[62].x),
        (63, Field::X.quantize(31.5).bin)
    );
}

#[test]
fn decoding_keeps_what_tokens_do_not_say() {
    let (scenario, pose) = scenario(CROSSING);
    let frames = scenario.present().strided_history(5, 2);
    let identities = Identities::ranked(&frames, EGO, pose);
    let tokenizer = Tokenizer::default();
    let encoded = tokenizer.encode(&scenario.map, &frames, EGO, pose, &identities);
    let mut token = encoded.sequence.frames()[1].clone();
    let decode = |token: &TokenFrame, identities: &Identities| {
        let lights = &encoded.lights;
        tokenizer.decode(&scenario.map, token, frames[0], pose, identities, lights)
    };
    let back = decode(&token, &identities).unwrap();
    let ids: Vec<i64> = back.agents().iter().map(|agent| agent.id.0).collect();
    assert_eq!(ids, [0, 4, 5, 7, 9], "what has no token is not made up");
    assert_eq!(back.lights(), frames[1].lights());
    let ego = back.agent(EGO).unwrap();
    assert_eq!((ego.length, ego.width, ego.height), (5.176, 2.297, 1.6));
    let walker = back.agent(AgentId(7)).unwrap();
    assert!(walker.state.pose.position.distance(dvec2(40.0, 8.0)) < 1e-9);

    // A newborn agent is known by its tokens alone.
    let mut with_newborn = identities.clone();
    let (id, fresh) = with_newborn.newborn().unwrap();
    assert_eq!((id, fresh), (5, AgentId(10)));
    let mut newborn = agent(id, AgentKind::Pedestrian, 3.0);
    (newborn.state.width, newborn.state.length) = (0, 1);
    token.newborn.push(newborn);
    let back = decode(&token, &with_newborn).unwrap();
    let born = back.agent(fresh).unwrap();
    assert_eq!(
        (born.kind, born.width, born.length),
        (AgentKind::Pedestrian, 0.25, 0.5)
    );
    assert!(born.state.pose.position.distance(dvec2(13.0, 0.0)) < 1e-9);

    assert_eq!(decode(&token, &identities), Err(GrammarError::UnknownId(5)));
    token.newborn.clear();
    token.lights[1].index = 3;
    assert_eq!(
        decode(&token, &identities),
        Err(GrammarError::UnknownLight(3))
    );
}

#[test]
fn fitting_drops_whole_old_frames_then_far_agents_then_lights() {
    let encoded = encode_text(CROSSING, 3).sequence;
    let other = encode_text("ego vehicle 0: 0,0\nagent vehicle 1: 9,0", 3).sequence;
    let check = |block: usize, frames: usize, ids: &[u16], lights: usize, expected: Overflow| {
        let (fitted, overflow) = encoded.fit(block);
        assert!(
            fitted.len() <= block,
            "{} in a block of {block}",
            fitted.len()
        );
        assert_eq!(overflow, expected);
        assert_eq!(fitted.frames().len(), frames);
        let last = fitted.frames().last().unwrap();
        assert_eq!(
            last.agents().map(|agent| agent.key.id).collect::<Vec<_>>(),
            ids
        );
        assert_eq!(last.lights.len(), lights);
        assert_eq!(TokenSequence::parse(&fitted.slots()), Ok(fitted));
        assert_eq!(
            other.fit(64).0,
            other,
            "trimming one scene does not touch another"
        );
    };
    let key = |id, kind| Key { id, kind };
    let (far, walker) = (key(2, AgentKind::Vehicle), key(3, AgentKind::Pedestrian));
    let (car, bicycle) = (key(1, AgentKind::Vehicle), key(4, AgentKind::Bicycle));
    let old = |frames| Overflow {
        frames,
        ..Overflow::default()
    };
    check(45, 3, &[0, 1, 2, 3, 4], 2, old(0));
    check(44, 2, &[0, 1, 2, 3, 4], 2, old(1));
    check(29, 1, &[0, 1, 2, 3, 4], 2, old(2));
    check(
        14,
        1,
        &[0, 1, 3, 4],
        2,
        Overflow {
            agents: vec![far],
            ..old(2)
        },
    );
    check(
        12,
        1,
        &[0, 1, 4],
        2,
        Overflow {
            agents: vec![far, walker],
            ..old(2)
        },
    );
    let all = vec![far, walker, car, bicycle];
    check(
        6,
        1,
        &[0],
        1,
        Overflow {
            agents: all.clone(),
            lights: vec![2],
            ..old(2)
        },
    );
    check(
        5,
        1,
        &[0],
        0,
        Overflow {
            agents: all,
            lights: vec![2, 1],
            ..old(2)
        },
    );
}

#[test]
#[should_panic(expected = "a block of 4 cannot hold 5 slots")]
fn a_block_without_room_for_the_ego_is_refused() {
    encode_text("ego vehicle 0: 0,0", 1).sequence.fit(4);
}

#[test]
fn in_the_first_frame_of_a_tail_everyone_is_tracked() {
    let frames = vec![
        frame(vec![vehicle(0), vehicle(5)], vec![]),
        frame(
            vec![vehicle(0)],
            vec![vehicle(2), agent(9, AgentKind::Bicycle, 1.0)],
        ),
        frame(vec![vehicle(0), vehicle(2)], vec![vehicle(5)]),
    ];
    let tag = "behind_bike".parse().unwrap();
    let sequence = TokenSequence::new(vec![Some(tag)], frames).unwrap();
    let tail = sequence.tail(2);
    let ids = |agents: &[TokenAgent]| agents.iter().map(|a| a.key.id).collect::<Vec<_>>();
    assert_eq!(ids(&tail.frames()[0].tracked), [0, 2, 9]);
    assert_eq!(ids(&tail.frames()[0].newborn), []);
    assert_eq!(ids(&tail.frames()[1].newborn), [5]);
    assert_eq!(tail.prompts(), [Some(tag)]);
    assert_eq!(TokenSequence::parse(&tail.slots()), Ok(tail));
    assert_eq!(sequence.tail(7), sequence);
    assert_eq!(sequence.tail(0).frames().len(), 0);
    assert_eq!(sequence.frame_starts(), [1, 8, 17]);
}
