//! An agent's state in bins.

use gump_geometry::{DVec2, Pose, dvec2};
use gump_scene::AgentState;

use crate::Field;

/// The bins of the seven fields of a value token.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Hash)]
#[allow(
    missing_docs,
    reason = "each field is the bin of the Field it is named after"
)]
pub struct QuantizedState {
    pub x: u16,
    pub y: u16,
    pub heading: u16,
    pub velocity_x: u16,
    pub velocity_y: u16,
    pub width: u16,
    pub length: u16,
}

impl QuantizedState {
    /// Quantises a state given in the scene frame, with the box size in metres; also counts the
    /// fields that had to be clamped.
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

    /// What the bins stand for, in the order of [`Field::ALL`].
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
}
