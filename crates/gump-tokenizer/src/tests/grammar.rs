//! The grammar: what it refuses, and that mask, constructor and parser are of one mind.

use gump_scene::{LightState, ScenarioTag};

use super::*;
use crate::{
    AGENT_KEYS, BEGIN, EGO_KEY, FIRST_LIGHT, Grammar, LIGHTS_END, MAX_LIGHTS, N_CLASSES, N_PROMPTS,
    NEWBORN, PAD, TABLE_ROWS, TokenLight, VOCABULARY_SIZE, class_index, light_token,
};

fn light(index: u16, x: u16) -> TokenLight {
    TokenLight {
        index,
        x,
        y: 500,
        heading: 100,
        state: LightState::Red,
    }
}

/// A sequence as text, or the error, for frames given in a shorthand: ids of vehicles, `p`/`b`
/// before an id for other classes, `L` for a light, `|` for NEWBORN.
fn check(frames: &[&str], expected: Result<(), &str>) {
    let frames = frames.iter().map(|frame| shorthand(frame)).collect();
    let found = TokenSequence::new(Vec::new(), frames).map(|sequence| {
        assert_eq!(TokenSequence::parse(&sequence.slots()), Ok(sequence));
    });
    assert_eq!(
        found.map_err(|error| error.to_string()),
        expected.map_err(String::from)
    );
}

fn shorthand(text: &str) -> TokenFrame {
    let mut frame = TokenFrame::default();
    let mut newborn = false;
    for word in text.split_whitespace() {
        let id = || {
            word.trim_start_matches(|c: char| c.is_alphabetic())
                .parse()
                .unwrap()
        };
        let kind = match word.as_bytes()[0] {
            b'p' => AgentKind::Pedestrian,
            b'b' => AgentKind::Bicycle,
            b'o' => AgentKind::Other,
            _ => AgentKind::Vehicle,
        };
        match word {
            "|" => newborn = true,
            word if word.starts_with('L') => frame.lights.push(light(id(), 500 + id())),
            _ if newborn => frame.newborn.push(agent(id(), kind, 1.0)),
            _ => frame.tracked.push(agent(id(), kind, 1.0)),
        }
    }
    frame
}

#[test]
fn frames_obey_the_rules() {
    check(
        &["0 3 7 p1 b2", "L1 L5 L63 0 3 p1 | 8 p9", "L5 0 8 p9 | 7 b2"],
        Ok(()),
    );
    check(&["p0"], Ok(()));
    check(&["b0 1 p2", "b0 p2"], Ok(()));
    check(&[], Ok(()));
    let err = |frames: &[&str], expected: &str| check(frames, Err(expected));
    err(&[""], "slot 2: expected the ego's key, found NEWBORN");
    err(
        &["3 0"],
        "slot 2: expected the ego's key, found the key of 3(vehicle)",
    );
    err(
        &["0 0"],
        "slot 4: expected the key of 1(vehicle) or 959 others or NEWBORN, found the key of ego(vehicle)",
    );
    err(
        &["0 3 3"],
        "slot 6: expected the key of 4(vehicle) or 954 others or NEWBORN, found the key of 3(vehicle)",
    );
    err(
        &["0 3 p2 5"],
        "slot 8: expected the key of 4(pedestrian) or 634 others or NEWBORN, found the key of 5(vehicle)",
    );
    err(
        &["0 1 | 2"],
        "slot 7: expected BEGIN or PAD or the end, found the key of 2(vehicle)",
    );
    err(
        &["0 4", "0 5"],
        "slot 11: expected the key of 4(vehicle) or NEWBORN, found the key of 5(vehicle)",
    );
    err(
        &["0 4", "0 | 4"],
        "slot 12: expected the key of 1(vehicle) or 956 others or BEGIN or PAD or the end, \
         found the key of 4(vehicle)",
    );
    err(
        &["0 4", "0", "0 | p4"],
        "slot 17: expected the key of 1(vehicle) or 957 others or BEGIN or PAD or the end, \
         found the key of 4(pedestrian)",
    );
    err(
        &["0", "p0"],
        "slot 7: expected the ego's key, found the key of ego(pedestrian)",
    );
    err(
        &["o0"],
        "slot 2: expected the ego's key, found the key of ego(other)",
    );
    err(
        &["0 321"],
        "slot 4: expected the key of 1(vehicle) or 959 others or NEWBORN, found the key of 321(vehicle)",
    );
    err(
        &["L2 L2 0"],
        "slot 2: expected a light of 3..=63 or LIGHTS_END, \
         found light 2 red at 0.4,0.0 heading 0.000",
    );
    err(
        &["L63 L64 0"],
        "slot 2: expected LIGHTS_END, found light 64 red at 12.8,0.0 heading 0.000",
    );
}

/// Like [`check`], for slots.
fn check_slots(slots: &[Slot], expected: Result<usize, &str>) {
    let found = TokenSequence::parse(slots).map(|sequence| sequence.len());
    assert_eq!(
        found.map_err(|error| error.to_string()),
        expected.map_err(String::from)
    );
}

#[test]
fn slots_obey_the_rules() {
    let pair = |agent: TokenAgent| [Slot::Key(agent.key), Slot::Value(agent.state)];
    let [key, value] = pair(vehicle(0));
    let frame = [Slot::Begin, Slot::LightsEnd, key, value, Slot::Newborn];
    let with = |index: usize, slot: Slot| {
        let mut slots = frame;
        slots[index] = slot;
        slots
    };
    check_slots(&[&frame[..], &[Slot::Pad, Slot::Pad]].concat(), Ok(5));
    check_slots(
        &[&[Slot::Pad], &frame[..], &frame[..]].concat(),
        Err("slot 1: expected PAD or the end, found BEGIN"),
    );
    check_slots(
        &frame[..4],
        Err("slot 4: expected the key of 1(vehicle) or 959 others or NEWBORN, found the end"),
    );
    check_slots(&frame[..3], Err("slot 3: expected a value, found the end"));
    check_slots(
        &with(3, key),
        Err("slot 3: expected a value, found the key of ego(vehicle)"),
    );
    check_slots(
        &with(2, value),
        Err(
            "slot 2: expected the ego's key, found the value at 0.0,0.0 heading 0.000 velocity 0.00,0.00 size 4.5,2.0",
        ),
    );
    let Slot::Value(mut state) = value else {
        panic!("the second of a pair is a value")
    };
    state.x = 1000;
    check_slots(
        &with(3, Slot::Value(state)),
        Err(
            "slot 3: expected a value, found the value at 100.0,0.0 heading 0.000 velocity 0.00,0.00 size 4.5,2.0",
        ),
    );
    // A light does not move within a window.
    let lit = |x: u16| [&[Slot::Begin, Slot::Light(light(4, x))], &frame[1..]].concat();
    check_slots(&[lit(500), lit(500)].concat(), Ok(12));
    check_slots(
        &[lit(500), lit(501)].concat(),
        Err(
            "slot 7: expected a light of 1..=63 or LIGHTS_END, found light 4 red at 0.2,0.0 heading 0.000",
        ),
    );
    assert!(TokenSequence::parse(&lit(1000)).is_err());
}

#[test]
fn prompts_are_none_or_up_to_four_different_tags() {
    let tags: Vec<Option<ScenarioTag>> = ScenarioTag::all().map(Some).collect();
    let check = |prompts: &[Option<ScenarioTag>], expected: bool| {
        let sequence =
            TokenSequence::new(Vec::new(), vec![frame(vec![vehicle(0)], vec![])]).unwrap();
        let prompted = sequence.with_prompts(prompts.to_vec());
        assert_eq!(prompted.is_ok(), expected, "{prompts:?}");
        if let Ok(prompted) = prompted {
            assert_eq!(prompted.prompts(), prompts);
            assert_eq!(prompted.frame_starts(), [prompts.len()]);
        }
    };
    check(&[], true);
    check(&[None], true);
    check(&tags[20..24], true);
    check(&[tags[9], tags[3]], true);
    check(&tags[20..25], false);
    check(&[tags[3], tags[3]], false);
    check(&[None, None], false);
    check(&[None, tags[3]], false);
    check(&[tags[3], None], false);
}

/// Every key there is, two of each illegal sort included.
fn all_keys() -> impl Iterator<Item = Key> {
    let kinds = AgentKind::MOVING.into_iter().chain([AgentKind::Other]);
    kinds.flat_map(|kind| (0..=322).map(move |id| Key { id, kind }))
}

#[test]
fn the_mask_allows_what_the_reader_accepts_and_nothing_else() {
    let frames = ["L1 L3 0 3 7 p1 b2", "0 3 p1 | 8 p9", "L3 0 8 p9 | 7 b2"].map(shorthand);
    let sequence = TokenSequence::new(vec![None], frames.to_vec()).unwrap();
    let mut grammar = Grammar::default();
    for (position, slot) in sequence.slots().iter().enumerate() {
        assert_eq!(grammar.position(), position);
        check_mask(&grammar);
        grammar.advance(slot).unwrap();
    }
    check_mask(&grammar);
    check_mask(&sequence.grammar());
}

fn check_mask(grammar: &Grammar) {
    let allowed = grammar.allowed();
    let accepts = |slot: Slot| grammar.clone().advance(&slot).is_ok();
    let keys: Vec<Key> = all_keys().filter(|key| accepts(Slot::Key(*key))).collect();
    assert!(keys.is_sorted());
    assert_eq!(allowed.keys().collect::<Vec<_>>(), keys);
    let known = [
        light(1, 501),
        light(2, 0),
        light(3, 503),
        light(63, 0),
        light(64, 0),
    ];
    for light in known {
        assert_eq!(
            accepts(Slot::Light(light)),
            allowed.light_indices().contains(&light.index)
        );
    }
    let value = Slot::Value(QuantizedState::default());
    assert_eq!(accepts(value), allowed.value());
    assert_eq!(allowed.end(), grammar.finish().is_ok());
    // The token mask agrees for every slot that is one token.
    let marks = [Slot::Begin, Slot::LightsEnd, Slot::Newborn, Slot::Pad];
    let lights = known.into_iter().map(Slot::Light);
    let slots = all_keys().map(Slot::Key).chain(marks).chain(lights);
    let accepted = slots
        .filter(|slot| accepts(*slot))
        .filter_map(|slot| slot.token());
    let accepted: std::collections::BTreeSet<u32> = accepted.collect();
    for token in 0..TABLE_ROWS {
        let expected = match token {
            321..=324 => !allowed.light_indices().is_empty(),
            token => accepted.contains(&token),
        };
        assert_eq!(allowed.tokens().contains(&token), expected, "token {token}");
    }
    assert!(allowed.tokens().is_sorted());
    assert_eq!(allowed.tokens().is_empty(), allowed.value());
}

#[test]
fn a_missing_slot_breaks_the_sequence() {
    let frames = ["L1 L3 0 3 7 p1 b2", "0 3 p1 | 8 p9", "L3 0 8 p9 | 7 b2"].map(shorthand);
    let slots = TokenSequence::new(vec![None], frames.to_vec())
        .unwrap()
        .slots();
    for (position, slot) in slots.iter().enumerate() {
        let mut fewer = slots.clone();
        fewer.remove(position);
        let optional = matches!(slot, Slot::Prompt(_) | Slot::Light(_));
        assert_eq!(
            TokenSequence::parse(&fewer).is_ok(),
            optional,
            "without slot {position}"
        );
    }
}

#[test]
fn the_vocabulary_is_contiguous_and_as_large_as_the_paper_says() {
    let light_states = [
        LightState::Green,
        LightState::Yellow,
        LightState::Red,
        LightState::Unknown,
    ];
    let mut tokens = vec![EGO_KEY];
    tokens.extend(AGENT_KEYS);
    assert_eq!(tokens.last().unwrap() + 1, FIRST_LIGHT);
    tokens.extend(light_states.map(light_token));
    tokens.extend(Field::ALL.into_iter().flat_map(Field::tokens));
    tokens.extend([BEGIN, NEWBORN, LIGHTS_END]);
    assert_eq!(tokens, (0..2972).collect::<Vec<_>>());
    assert_eq!((VOCABULARY_SIZE, PAD, TABLE_ROWS), (2972, 2972, 2973));
    assert_eq!((N_CLASSES, N_PROMPTS, MAX_LIGHTS), (3, 74, 63));
    assert_eq!(AgentKind::MOVING.map(class_index), [0, 1, 2]);
}
