//! Scenes as text through the tokenizer: `scenes` by example, `grammar` by rule, `laws` by chance.

mod grammar;
mod identities;
mod laws;
mod scenes;

use gump_geometry::Pose;
use gump_scene::{AgentId, AgentKind, AgentState, Frame, MapGraph, Scenario, fixture};

use crate::{
    Encoded, Field, Identities, Key, QuantizedState, Slot, TokenAgent, TokenFrame, TokenSequence,
    Tokenizer, TokenizerConfig,
};

const EGO: AgentId = AgentId(0);

/// A scenario with the centre of its scene frame: the ego now.
fn scenario(text: &str) -> (Scenario, Pose) {
    let scenario = fixture::scenario(text).unwrap();
    let world_from_scene = scenario.present().ego_now().state.pose;
    (scenario, world_from_scene)
}

/// Encodes frames with ranked ids and the defaults.
fn encode(map: &MapGraph, frames: &[&Frame], world_from_scene: Pose) -> Encoded {
    let identities = Identities::ranked(frames, EGO, world_from_scene);
    let tokenizer = Tokenizer::new(TokenizerConfig::default());
    tokenizer.encode(map, frames, EGO, world_from_scene, &identities)
}

/// The last `n_frames` half-second frames of a scene as text.
fn encode_text(text: &str, n_frames: usize) -> Encoded {
    let (scenario, world_from_scene) = scenario(text);
    let frames = scenario.present().strided_history(5, n_frames);
    encode(&scenario.map, &frames, world_from_scene)
}

/// Compares a scene's tokens, as text, line by line and without indentation.
fn check(scene: &str, n_frames: usize, expected: &str) -> Encoded {
    let encoded = encode_text(scene, n_frames);
    check_text(&encoded.sequence, expected);
    encoded
}

fn check_text(sequence: &TokenSequence, expected: &str) {
    let lines = |text: &str| -> Vec<String> {
        let lines = text.lines().map(str::trim);
        lines
            .filter(|line| !line.is_empty())
            .map(String::from)
            .collect()
    };
    assert_eq!(
        lines(&sequence.to_string()),
        lines(expected),
        "\n{sequence}"
    );
}

/// A token agent at a place, standing still.
fn agent(id: u16, kind: AgentKind, x: f64) -> TokenAgent {
    let state = AgentState {
        pose: Pose::new(x, 0.0, 0.0),
        ..AgentState::default()
    };
    let (state, _) = QuantizedState::new(&state, 4.5, 2.0);
    TokenAgent {
        key: Key { id, kind },
        state,
    }
}

fn vehicle(id: u16) -> TokenAgent {
    agent(id, AgentKind::Vehicle, f64::from(id))
}

/// A frame without lights.
fn frame(tracked: Vec<TokenAgent>, newborn: Vec<TokenAgent>) -> TokenFrame {
    TokenFrame {
        lights: Vec::new(),
        tracked,
        newborn,
    }
}

/// The difference of two bins, the short way round for headings.
fn bins_apart(field: Field, a: u16, b: u16) -> usize {
    let apart = usize::from(a.abs_diff(b));
    if field.is_circular() {
        apart.min(field.n_bins() - apart)
    } else {
        apart
    }
}

fn value_slots(slots: &[Slot]) -> impl Iterator<Item = &QuantizedState> {
    slots.iter().filter_map(|slot| match slot {
        Slot::Value(state) => Some(state),
        _ => None,
    })
}
