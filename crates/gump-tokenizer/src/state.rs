//! An agent's state on the grid: seven bins, one per [`Field`].
//!
//! This is the only representation of states at the input and output of the model; its numbers are
//! always those of the bins.

use gump_geometry::{DVec2, Pose, dvec2};
use gump_scene::AgentState;

use crate::Field;

/// The bins of a value slot. Quantising the values of the bins gives the same bins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Hash)]
pub struct QuantizedState {
    /// Bin of [`Field::X`], below 1000.
    pub x: u16,
    /// Bin of [`Field::Y`], below 1000.
    pub y: u16,
    /// Bin of [`Field::Heading`], below 200.
    pub heading: u16,
    /// Bin of [`Field::VelocityX`], below 200.
    pub velocity_x: u16,
    /// Bin of [`Field::VelocityY`], below 200.
    pub velocity_y: u16,
    /// Bin of [`Field::Width`], below 14.
    pub width: u16,
    /// Bin of [`Field::Length`], below 30.
    pub length: u16,
}

impl QuantizedState {
    /// Quantises a state and a box; also names the fields whose value lay outside their range.
    ///
    /// Units: `state` in the scene frame; `length` and `width` in metres.
    pub fn new(state: &AgentState, length: f64, width: f64) -> (Self, Vec<Field>) {
        let values = [
            state.pose.position.x,
            state.pose.position.y,
            state.pose.heading,
            state.velocity.x,
            state.velocity.y,
            width,
            length,
        ];
        let mut quantized = Self::default();
        let mut clamped = Vec::new();
        for (field, value) in Field::ALL.into_iter().zip(values) {
            let found = field.quantize(value);
            quantized.set(field, found.bin);
            if found.clamped {
                clamped.push(field);
            }
        }
        (quantized, clamped)
    }

    /// The same box with the pose and velocity of `state`, scene frame; values beyond the range go
    /// into the outermost bins.
    pub fn with_motion(self, state: &AgentState) -> Self {
        let (moved, _) = Self::new(state, 1.0, 1.0);
        Self {
            width: self.width,
            length: self.length,
            ..moved
        }
    }

    /// The bin of a field.
    pub fn get(&self, field: Field) -> u16 {
        match field {
            Field::X => self.x,
            Field::Y => self.y,
            Field::Heading => self.heading,
            Field::VelocityX => self.velocity_x,
            Field::VelocityY => self.velocity_y,
            Field::Width => self.width,
            Field::Length => self.length,
        }
    }

    /// Sets the bin of a field.
    pub fn set(&mut self, field: Field, bin: u16) {
        *match field {
            Field::X => &mut self.x,
            Field::Y => &mut self.y,
            Field::Heading => &mut self.heading,
            Field::VelocityX => &mut self.velocity_x,
            Field::VelocityY => &mut self.velocity_y,
            Field::Width => &mut self.width,
            Field::Length => &mut self.length,
        } = bin;
    }

    /// The token of a field.
    pub fn token(&self, field: Field) -> u32 {
        field.token(self.get(field))
    }

    /// The values of the bins, in the order of [`Field::ALL`] and in its units.
    pub fn values(&self) -> [f64; 7] {
        Field::ALL.map(|field| field.dequantize(self.get(field)))
    }

    /// The pose, scene frame.
    pub fn pose(&self) -> Pose {
        let [x, y, heading, ..] = self.values();
        Pose::new(x, y, heading)
    }

    /// The velocity, scene frame, metres per second.
    pub fn velocity(&self) -> DVec2 {
        let [_, _, _, x, y, ..] = self.values();
        dvec2(x, y)
    }

    /// Pose and velocity, scene frame.
    pub fn to_agent_state(&self) -> AgentState {
        AgentState {
            pose: self.pose(),
            velocity: self.velocity(),
        }
    }

    /// True if every bin is valid, so that every token is in its field's sub-vocabulary.
    pub fn is_valid(&self) -> bool {
        Field::ALL
            .into_iter()
            .all(|field| usize::from(self.get(field)) < field.n_bins())
    }
}
