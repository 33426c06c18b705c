//! Laws that hold for any value and any scene.

use std::f64::consts::{FRAC_PI_2, PI};

use gump_geometry::{dvec2, wrap_angle};
use gump_scene::{Agent, LaneId, Light, LightState};
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

use super::*;

/// The same cases in every run.
fn config() -> ProptestConfig {
    ProptestConfig {
        cases: 200,
        rng_seed: RngSeed::Fixed(7),
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

#[test]
fn spot_values() {
    let check = |field: Field, value: f64, bin: u16, clamped: bool| {
        let found = field.quantize(value);
        assert_eq!(
            (found.bin, found.clamped),
            (bin, clamped),
            "{field:?} {value}"
        );
        assert!(field.tokens().contains(&field.token(found.bin)));
    };
    for field in [Field::X, Field::Y] {
        check(field, 0.0, 500, false);
        check(field, -100.0, 0, false);
        check(field, 99.8, 999, false);
        check(field, 100.0, 999, false);
        check(field, 100.0 + 1e-6, 999, true);
        check(field, -100.0 - 1e-6, 0, true);
        check(field, -100.0 - 1e-9, 0, false);
        check(field, 1e300, 999, true);
        // Half a bin up goes to the even neighbour.
        check(
            field,
            0.5 * (field.dequantize(512) + field.dequantize(513)),
            512,
            false,
        );
    }
    check(Field::Heading, 0.0, 100, false);
    check(Field::Heading, PI, 0, false);
    check(Field::Heading, -PI, 0, false);
    check(Field::Heading, FRAC_PI_2, 150, false);
    check(Field::Heading, PI - 1e-9, 0, false);
    check(Field::Heading, -PI - 1e-9, 0, false);
    check(Field::Heading, 5.0 * PI + 0.1, 3, false);
    for field in [Field::VelocityX, Field::VelocityY] {
        check(field, 0.0, 100, false);
        check(field, -25.0, 0, false);
        check(field, 25.0, 199, false);
        check(field, 30.0, 199, true);
    }
    check(Field::Width, 2.297, 5, false);
    check(Field::Width, 7.0, 13, false);
    check(Field::Width, -0.1, 0, true);
    check(Field::Length, 5.176, 10, false);
    check(Field::Length, 15.0, 29, false);
    for field in Field::ALL {
        check(field, f64::NAN, 0, true);
        let infinite = field.quantize(f64::INFINITY);
        assert!(infinite.clamped && usize::from(infinite.bin) < field.n_bins());
    }
}

#[test]
fn quantising_what_a_bin_stands_for_gives_the_bin() {
    for field in Field::ALL {
        for bin in 0..field.n_bins() as u16 {
            let found = field.quantize(field.dequantize(bin));
            assert_eq!((found.bin, found.clamped), (bin, false), "{field:?}");
        }
    }
}

/// The bound of the round trip: half a step, a whole one at the upper end of what does not wrap.
fn check_round_trip(field: Field, value: f64, back: f64) {
    let inside = value.clamp(field.low(), field.high());
    let (error, bound) = if field.is_circular() {
        (wrap_angle(value - back).abs(), field.step() / 2.0)
    } else if inside <= field.high() - field.step() / 2.0 {
        ((inside - back).abs(), field.step() / 2.0)
    } else {
        ((inside - back).abs(), field.step())
    };
    assert!(
        error <= bound + 1e-9,
        "{field:?}: {value} came back as {back}"
    );
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn values_come_back_within_the_quantum(field in 0usize..7, t in -0.2f64..1.2) {
        let field = Field::ALL[field];
        let value = field.low() + t * (field.high() - field.low());
        let found = field.quantize(value);
        let out = !field.is_circular() && !(0.0..=1.0).contains(&t);
        prop_assert_eq!(found.clamped, out);
        check_round_trip(field, value, field.dequantize(found.bin));
    }

    #[test]
    fn parsing_the_slots_gives_the_sequence(scene in scenes()) {
        let sequence = scene.encode().sequence;
        let mut slots = sequence.slots();
        prop_assert_eq!(slots.len(), sequence.len());
        for (frame, start) in sequence.frame_starts().into_iter().enumerate() {
            prop_assert_eq!(slots[start], Slot::Begin, "frame {}", frame);
        }
        prop_assert!(value_slots(&slots).all(QuantizedState::is_valid));
        slots.push(Slot::Pad);
        prop_assert_eq!(TokenSequence::parse(&slots), Ok(sequence));
    }

    #[test]
    fn an_agent_is_tracked_if_the_frame_before_had_it(scene in scenes()) {
        let encoded = scene.encode();
        for pair in encoded.sequence.frames().windows(2) {
            let before: Vec<Key> = pair[0].agents().map(|agent| agent.key).collect();
            prop_assert!(pair[1].tracked.iter().all(|agent| before.contains(&agent.key)));
            prop_assert!(pair[1].newborn.iter().all(|agent| !before.contains(&agent.key)));
        }
    }

    #[test]
    fn decoding_gives_the_frames_back(scene in scenes()) {
        let frames: Vec<&Frame> = scene.frames.iter().collect();
        let identities = Identities::ranked(&frames, EGO, scene.centre);
        let encoded = scene.encode();
        let scene_from_world = scene.centre.inverse();
        for (token, frame) in encoded.sequence.frames().iter().zip(&scene.frames) {
            let back = Tokenizer::default()
                .decode(&scene.map, token, frame, scene.centre, &identities, &encoded.lights)
                .unwrap();
            let moving = frame.agents().iter().filter(|agent| agent.kind != AgentKind::Other);
            prop_assert_eq!(back.agents().len(), moving.clone().count());
            for agent in moving {
                let found = back.agent(agent.id).unwrap();
                prop_assert_eq!(found.with_state(agent.state), *agent);
                let values = |state: AgentState| {
                    let pose = scene_from_world * state.pose;
                    let velocity = scene_from_world.rotate(state.velocity);
                    [pose.position.x, pose.position.y, pose.heading, velocity.x, velocity.y]
                };
                let pairs = values(agent.state).into_iter().zip(values(found.state));
                for (field, (value, back)) in Field::ALL.into_iter().zip(pairs) {
                    check_round_trip(field, value, back);
                }
            }
            for light in back.lights() {
                let logged = frame.light(light.lane).map_or(LightState::Unknown, |l| l.state);
                prop_assert_eq!(light.state, logged);
            }
        }
    }

    #[test]
    fn encoding_what_was_decoded_gives_the_same_tokens(scene in scenes()) {
        let frames: Vec<&Frame> = scene.frames.iter().collect();
        let identities = Identities::ranked(&frames, EGO, scene.centre);
        let tokenizer = Tokenizer::default();
        let encoded = scene.encode();
        let decoded: Vec<Frame> = encoded.sequence.frames().iter().zip(&scene.frames)
            .map(|(token, frame)| {
                let back = tokenizer
                    .decode(&scene.map, token, frame, scene.centre, &identities, &encoded.lights)
                    .unwrap();
                // An unseen light comes back as unknown, and would then be numbered as seen.
                Frame::new(back.agents().to_vec(), frame.lights().to_vec())
            })
            .collect();
        let decoded: Vec<&Frame> = decoded.iter().collect();
        let again = tokenizer.encode(&scene.map, &decoded, EGO, scene.centre, &identities);
        prop_assert_eq!(again.sequence, encoded.sequence);
    }

    #[test]
    fn moving_and_turning_the_world_moves_no_token(
        scene in scenes(),
        x in -1e5f64..1e5,
        y in -1e5f64..1e5,
        turn in -PI..PI,
    ) {
        let moved = scene.moved(Pose::new(x, y, turn));
        let (here, there) = (scene.encode(), moved.encode());
        prop_assert_eq!(&here.report.out_of_range, &there.report.out_of_range);
        let (here, there) = (here.sequence.slots(), there.sequence.slots());
        prop_assert_eq!(here.len(), there.len());
        for (a, b) in here.iter().zip(&there) {
            check_within_a_bin(a, b);
        }
    }

    #[test]
    fn any_block_holds_whole_frames(scene in scenes(), block in 5usize..120) {
        let sequence = scene.encode().sequence;
        let (fitted, overflow) = sequence.fit(block);
        prop_assert!(fitted.len() <= block);
        prop_assert_eq!(fitted.frames().len() + overflow.frames, sequence.frames().len());
        let n_frames = fitted.frames().len();
        if overflow.agents.is_empty() && overflow.lights.is_empty() {
            prop_assert_eq!(&fitted, &sequence.tail(n_frames));
            let one_more = sequence.tail(n_frames + 1);
            prop_assert!(n_frames == sequence.frames().len() || one_more.len() > block);
        } else {
            prop_assert_eq!(n_frames, 1);
            prop_assert!(fitted.len() + 1 >= block, "no more is left out than needed");
        }
        prop_assert_eq!(TokenSequence::parse(&fitted.slots()), Ok(fitted));
    }
}

/// The same slot up to one bin per field.
fn check_within_a_bin(a: &Slot, b: &Slot) {
    match (a, b) {
        (Slot::Value(a), Slot::Value(b)) => {
            for field in Field::ALL {
                let apart = bins_apart(field, a.get(field), b.get(field));
                assert!(apart <= 1, "{field:?}: {a} and {b}");
            }
        }
        (Slot::Light(a), Slot::Light(b)) => {
            assert_eq!((a.index, a.state), (b.index, b.state));
            assert!(bins_apart(Field::X, a.x, b.x) <= 1 && bins_apart(Field::Y, a.y, b.y) <= 1);
            assert!(bins_apart(Field::Heading, a.heading, b.heading) <= 1);
        }
        (a, b) => assert_eq!(a, b),
    }
}

/// A map, frames in which the ego is always present, and the centre of the scene frame.
#[derive(Clone, Debug)]
struct Scene {
    map: std::sync::Arc<MapGraph>,
    frames: Vec<Frame>,
    centre: Pose,
}

impl Scene {
    fn encode(&self) -> Encoded {
        encode(
            &self.map,
            &self.frames.iter().collect::<Vec<_>>(),
            self.centre,
        )
    }

    /// The same scene elsewhere.
    fn moved(&self, there_from_here: Pose) -> Self {
        let frames = self.frames.iter().map(|frame| {
            let agents = frame.agents().iter().map(|agent| {
                agent.with_state(AgentState {
                    pose: there_from_here * agent.state.pose,
                    velocity: there_from_here.rotate(agent.state.velocity),
                })
            });
            Frame::new(agents.collect(), frame.lights().to_vec())
        });
        Self {
            map: signalled_map(there_from_here * self.centre),
            frames: frames.collect(),
            centre: there_from_here * self.centre,
        }
    }
}

/// Three lanes around the origin of the given frame.
fn signalled_map(world_from_here: Pose) -> std::sync::Arc<MapGraph> {
    let lanes = [(1, 5.0, 3.0), (2, -20.0, 7.0), (3, 11.0, -30.0)];
    let mut text = String::from("ego vehicle 0: 0,0\n");
    for (id, x, y) in lanes {
        let [a, b] = [dvec2(x, y), dvec2(x + 9.0, y - 4.0)].map(|point| world_from_here * point);
        text += &format!("lane {id}: {},{} {},{}\n", a.x, a.y, b.x, b.y);
    }
    fixture::scenario(&text).unwrap().map
}

type Track = (usize, f64, f64, Vec<Option<[f64; 5]>>);

/// A track over four frames within the window: kind, length, width, states in the scene frame.
fn track() -> impl Strategy<Value = Track> {
    let position = || -100f64..100.0;
    let state = (position(), position(), -PI..PI, -25f64..25.0, -25f64..25.0);
    let state = state.prop_map(|(x, y, heading, vx, vy)| [x, y, heading, vx, vy]);
    (
        0usize..4,
        0.3f64..15.0,
        0.3f64..7.0,
        vec(option::weighted(0.8, state), 4),
    )
}

fn scenes() -> impl Strategy<Value = Scene> {
    let light = option::weighted(0.7, 0usize..4);
    let centre = (-1e3f64..1e3, -1e3f64..1e3, -PI..PI);
    (
        1usize..=4,
        vec(track(), 1..10),
        vec(vec(light, 3), 4),
        centre,
    )
        .prop_map(|(n_frames, tracks, lights, (x, y, heading))| {
            let centre = Pose::new(x, y, heading);
            let frames = (0..n_frames).map(|i| {
                let agents = tracks.iter().enumerate();
                let agents = agents.filter_map(|(id, track)| at(id, track, i, centre));
                Frame::new(agents.collect(), lights_at(&lights[i]))
            });
            Scene {
                map: signalled_map(centre),
                frames: frames.collect(),
                centre,
            }
        })
}

/// The agent of a track in frame `i`; the first track is the ego, always there and never `Other`.
fn at(id: usize, (kind, length, width, states): &Track, i: usize, centre: Pose) -> Option<Agent> {
    let state = if id == 0 {
        states[i].or(Some([0.0; 5]))
    } else {
        states[i]
    };
    let [x, y, heading, vx, vy] = state?;
    let kinds = [
        AgentKind::Vehicle,
        AgentKind::Pedestrian,
        AgentKind::Bicycle,
        AgentKind::Other,
    ];
    Some(Agent {
        id: AgentId(id as i64),
        kind: if id == 0 {
            kinds[kind % 3]
        } else {
            kinds[*kind]
        },
        length: *length,
        width: *width,
        height: 1.7,
        elevation: 12.0,
        state: AgentState {
            pose: centre * Pose::new(x, y, heading),
            velocity: centre.rotate(dvec2(vx, vy)),
        },
    })
}

fn lights_at(states: &[Option<usize>]) -> Vec<Light> {
    let all = [
        LightState::Green,
        LightState::Yellow,
        LightState::Red,
        LightState::Unknown,
    ];
    let lights = states.iter().zip(1..).filter_map(|(state, lane)| {
        Some(Light {
            lane: LaneId(lane),
            state: all[(*state)?],
            stop_point: None,
        })
    });
    lights.collect()
}
