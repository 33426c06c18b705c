//! The vocabulary: which token means what (model.md 2.2, the paper's grid).

use std::ops::RangeInclusive;

use gump_scene::{AgentKind, LightState, ScenarioTag};

/// Key of the ego.
pub const EGO_KEY: u32 = 0;
/// Keys of all other agents.
pub const AGENT_KEYS: RangeInclusive<u32> = 1..=320;
/// First of the four light states: green, yellow, red, unknown.
pub const FIRST_LIGHT: u32 = 321;
/// Begins a frame.
pub const BEGIN: u32 = 2969;
/// Begins the newborn agents of a frame.
pub const NEWBORN: u32 = 2970;
/// Ends the lights of a frame.
pub const LIGHTS_END: u32 = 2971;
/// Fills what a tensor has too much of.
pub const PAD: u32 = 2972;
/// Tokens without PAD.
pub const VOCABULARY_SIZE: u32 = 2972;
/// Rows of a token table.
pub const TABLE_ROWS: u32 = 2973;
/// Classes of agents, in a table of their own.
pub const N_CLASSES: usize = 3;
/// Most lights of a frame.
pub const MAX_LIGHTS: usize = gump_scene::MAX_LIGHTS;
/// Prompts, in a table of their own: the tags and "none".
pub const N_PROMPTS: usize = ScenarioTag::COUNT + 1;

/// Row of a kind in the class table.
///
/// # Panics
/// For [`AgentKind::Other`], which is drawn but never tokenized.
pub fn class_index(kind: AgentKind) -> usize {
    AgentKind::MOVING
        .iter()
        .position(|&moving| moving == kind)
        .expect("only moving kinds are tokenized")
}

/// Token of a light's state.
pub fn light_token(state: LightState) -> u32 {
    FIRST_LIGHT
        + match state {
            LightState::Green => 0,
            LightState::Yellow => 1,
            LightState::Red => 2,
            LightState::Unknown => 3,
        }
}
