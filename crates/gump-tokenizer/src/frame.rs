//! One frame in tokens, by part. `sequence` defines the order of its slots.

use std::cmp::Ordering;

use gump_scene::{AgentKind, LightState};

use crate::{Field, QuantizedState};

/// The key of an agent: its identity and class.
///
/// Keys are ordered canonically: the ego first, then by class, then by id.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Key {
    /// 0 for the ego, 1..=320 for others; unique to one agent within a window.
    pub id: u16,
    /// Vehicle, pedestrian or bicycle: one of [`AgentKind::MOVING`].
    pub kind: AgentKind,
}

impl Key {
    /// True for the key of the ego.
    pub fn is_ego(self) -> bool {
        self.id == 0
    }

    /// The sort order of keys: the ego first, then class, then id.
    pub fn order(self) -> (bool, AgentKind, u16) {
        (!self.is_ego(), self.kind, self.id)
    }
}

impl Ord for Key {
    fn cmp(&self, other: &Self) -> Ordering {
        self.order().cmp(&other.order())
    }
}

impl PartialOrd for Key {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// A key with its value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TokenAgent {
    /// The identity.
    pub key: Key,
    /// The state, scene frame.
    pub state: QuantizedState,
}

/// A traffic light: one slot, placed at the start of the lane it controls, scene frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TokenLight {
    /// 1..=63, by distance from the centre, fixed per scene; the raster uses the same number.
    pub index: u16,
    /// Bin of [`Field::X`] of the lane's first point.
    pub x: u16,
    /// Bin of [`Field::Y`] of the lane's first point.
    pub y: u16,
    /// Bin of [`Field::Heading`] of the lane's first segment.
    pub heading: u16,
    /// Its colour in this frame.
    pub state: LightState,
}

impl TokenLight {
    /// The position of the light, without its colour.
    pub(crate) fn place(&self) -> [u16; 3] {
        [self.x, self.y, self.heading]
    }

    /// True if every bin is valid.
    pub(crate) fn is_valid(&self) -> bool {
        let fields = [Field::X, Field::Y, Field::Heading];
        let mut bins = fields.into_iter().zip(self.place());
        bins.all(|(field, bin)| usize::from(bin) < field.n_bins())
    }
}

/// All tokens of one frame.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct TokenFrame {
    /// Lights, by index.
    pub lights: Vec<TokenLight>,
    /// Agents that are also in the previous frame, in canonical order, the ego first.
    pub tracked: Vec<TokenAgent>,
    /// Agents that are not in the previous frame, in canonical order.
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

    /// The same frame as the first of a sequence, where everything counts as tracked.
    pub fn into_first(mut self) -> Self {
        self.tracked.append(&mut self.newborn);
        self.tracked.sort_by_key(|agent| agent.key);
        self
    }
}
