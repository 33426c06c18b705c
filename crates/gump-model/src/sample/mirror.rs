//! Left and right exchanged: a sample as it would be in a mirror.
//!
//! Everything a sample holds is expressed in the frame of the scene or of its objects, so the mirror
//! stands along their x axes: y, heading and v_y change their signs, the raster its columns. Traffic
//! then keeps to the other side of the road.

use std::sync::Arc;

use gump_raster::{Layer, Raster};
use gump_scene::Rng;
use gump_tokenizer::{Field, QuantizedState, Slot};
use rand::Rng as _;

use super::Sample;
use crate::decoder::STEPS;

/// Mirrors the sample with this probability. Its prompts are blanked, for a left turn would be
/// called a right one.
pub(super) fn mirror(sample: &mut Sample, probability: f64, rng: &mut Rng) {
    if !rng.random_bool(probability) {
        return;
    }
    for placed in &mut sample.slots {
        placed.last = placed.last.map(state);
        placed.slot = match placed.slot {
            Slot::Value(value) => Slot::Value(state(value)),
            Slot::Light(mut light) => {
                light.y = bin(Field::Y, light.y);
                light.heading = bin(Field::Heading, light.heading);
                Slot::Light(light)
            }
            Slot::Prompt(_) => Slot::Pad,
            slot => slot,
        };
    }
    for target in &mut sample.states {
        for (said, field) in target.bins.iter_mut().zip(STEPS) {
            *said = said.map(|said| bin(field, said));
        }
    }
    for target in &mut sample.trajectories {
        for [_, y, sin, _] in target.past.iter_mut().chain(&mut target.future).flatten() {
            *y = -*y;
            *sin = -*sin;
        }
    }
    columns(&mut sample.raster);
    sample.survey = Arc::new(sample.survey.mirrored());
}

fn state(state: QuantizedState) -> QuantizedState {
    QuantizedState {
        y: bin(Field::Y, state.y),
        heading: bin(Field::Heading, state.heading),
        velocity_y: bin(Field::VelocityY, state.velocity_y),
        ..state
    }
}

/// The bin of the mirrored value; the one at the low end of a range, which has no other end, goes
/// to the last.
fn bin(field: Field, bin: u16) -> u16 {
    match field {
        Field::Y | Field::Heading | Field::VelocityY => field.quantize(-field.dequantize(bin)).bin,
        Field::X | Field::VelocityX | Field::Width | Field::Length => bin,
    }
}

/// Columns in the other order; planes that say a y change its sign, too.
fn columns(raster: &mut Raster) {
    let pixels = raster.side_px * raster.side_px;
    for (layer, plane) in raster
        .layers
        .iter()
        .zip(raster.data.chunks_exact_mut(pixels))
    {
        let rows = plane.chunks_exact_mut(raster.side_px);
        rows.for_each(<[f32]>::reverse);
        if matches!(layer, Layer::LaneDirectionSin | Layer::CoordinateY) {
            plane.iter_mut().for_each(|value| *value = -*value);
        }
    }
}
