//! One frame in tokens, by part. The order of its slots is the business of `sequence`.

use std::cmp::Ordering;

use gump_scene::{AgentKind, LightState};

use crate::{Field, QuantizedState};

/// The address of an agent: who it is, and what.
///
/// Keys are ordered canonically: the ego first, then by class, then by id.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Key {
    /// 0 for the ego, 1..=320 for others; one agent's alone within a window.
    pub id: u16,
    /// Vehicle, pedestrian or bicycle: one of [`AgentKind::MOVING`].
    pub kind: AgentKind,
}

impl Key {
    /// True for the key of the ego.
    pub fn is_ego(self) -> bool {
        self.id == 0
    }

    /// What keys are ordered by: not the ego, class, id.
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
    /// Who.
    pub key: Key,
    /// In which state, scene frame.
    pub state: QuantizedState,
}

/// A traffic light: one slot, placed at the start of the lane it controls, scene frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TokenLight {
    /// 1..=63, by distance from the centre, fixed per scene; the raster paints the same number.
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
    /// Where the light is, without its colour.
    pub(crate) fn place(&self) -> [u16; 3] {
        [self.x, self.y, self.heading]
    }

    /// True if every bin exists.
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
    /// Agents that the frame before had too, in canonical order, the ego first.
    pub tracked: Vec<TokenAgent>,
    /// Agents that the frame before had not, in canonical order.
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
