//! One frame in tokens.

use gump_scene::{AgentKind, LightState};

use crate::{QuantizedState, class_index};

/// The address of an agent: who and what it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Key {
    /// 0 for the ego, 1..=320 for others; unique within a window.
    pub id: u16,
    /// Vehicle, pedestrian or bicycle, never [`AgentKind::Other`].
    pub kind: AgentKind,
}

impl Key {
    /// The canonical order of a frame: the ego first, then by class, then by id.
    pub fn order(&self) -> (bool, usize, u16) {
        (self.id != 0, class_index(self.kind), self.id)
    }
}

/// A key with its value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TokenAgent {
    /// Who.
    pub key: Key,
    /// In which state.
    pub state: QuantizedState,
}

/// A traffic light: one token.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TokenLight {
    /// 1..=63, by distance from the centre, fixed per scene; shared with the raster.
    pub index: u16,
    /// Bin of the controlled lane's start along x.
    pub x: u16,
    /// Bin of the controlled lane's start along y.
    pub y: u16,
    /// Bin of the controlled lane's direction at its start.
    pub heading: u16,
    /// Its colour.
    pub state: LightState,
}

/// All tokens of one frame, by part.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct TokenFrame {
    /// Lights by index.
    pub lights: Vec<TokenLight>,
    /// Agents that the frame before had too, the ego first.
    pub tracked: Vec<TokenAgent>,
    /// Agents that were not there before.
    pub newborn: Vec<TokenAgent>,
}

impl TokenFrame {
    /// Tracked agents, then newborn ones.
    pub fn agents(&self) -> impl Iterator<Item = &TokenAgent> {
        self.tracked.iter().chain(&self.newborn)
    }

    /// Slots the frame takes: BEGIN, lights, LIGHTS_END, pairs, NEWBORN, pairs.
    pub fn len_slots(&self) -> usize {
        3 + self.lights.len() + 2 * (self.tracked.len() + self.newborn.len())
    }
}
