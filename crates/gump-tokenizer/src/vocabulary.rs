//! The vocabulary: the meaning of tokens. The tokens of state fields are in [`Field`].
//!
//! 1 ego key, 320 agent keys, 4 light states, 2874 field values and 3 marks make 2972 tokens, the
//! size stated in the GUMP paper; PAD is additional. Classes and prompts have separate tables.
//!
//! [`Field`]: crate::Field

use std::ops::RangeInclusive;

use gump_scene::{AgentKind, LightState, ScenarioTag};

/// Key of the ego.
pub const EGO_KEY: u32 = 0;
/// Keys of all other agents.
pub const AGENT_KEYS: RangeInclusive<u32> = 1..=320;
/// First of the four light states: green, yellow, red, unknown.
pub const FIRST_LIGHT: u32 = 321;
/// Begins a frame; the paper's BOS.
pub const BEGIN: u32 = 2969;
/// Begins the newborn agents of a frame.
pub const NEWBORN: u32 = 2970;
/// Ends the lights of a frame.
pub const LIGHTS_END: u32 = 2971;
/// Padding of tensors.
pub const PAD: u32 = 2972;
/// Tokens without PAD.
pub const VOCABULARY_SIZE: u32 = 2972;
/// Rows of a token table, including PAD.
pub const TABLE_ROWS: u32 = 2973;
/// Classes of agents, in a separate table.
pub const N_CLASSES: usize = AgentKind::MOVING.len();
/// Maximum number of lights of a frame; light indices run from 1 to this.
pub const MAX_LIGHTS: usize = gump_scene::MAX_LIGHTS;
/// Prompts, in a separate table: the scenario tags, then "none".
pub const N_PROMPTS: usize = ScenarioTag::COUNT + 1;

/// Row of a kind in the class table: vehicle 0, pedestrian 1, bicycle 2.
///
/// # Panics
/// For the kinds of [`AgentKind::STATIC`], which are drawn but never tokenized.
pub fn class_index(kind: AgentKind) -> usize {
    AgentKind::MOVING
        .iter()
        .position(|&moving| moving == kind)
        .expect("only moving kinds are tokenized")
}

/// Token of a light's state.
///
/// Source: the order of nuPlan's enumeration, which the released code follows.
pub fn light_token(state: LightState) -> u32 {
    FIRST_LIGHT
        + match state {
            LightState::Green => 0,
            LightState::Yellow => 1,
            LightState::Red => 2,
            LightState::Unknown => 3,
        }
}
