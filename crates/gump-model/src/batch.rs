//! Token sequences as tensors: here padding is born, and nowhere else.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};
use gump_tokenizer::{Key, QuantizedState, Slot, TokenSequence};

use crate::embedding::{ROWS_PER_TOKEN, SineTables, Tables};
use crate::mct::TokenBatch;

/// A slot and where it stands in the presented window.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlacedSlot {
    pub(crate) slot: Slot,
    /// Index of the token, from 0 at the start of the window.
    pub(crate) position: usize,
    /// Index of its frame, from 0 at the oldest.
    pub(crate) frame: usize,
    /// The key before it, if it is a value.
    pub(crate) key: Option<Key>,
    /// What its object was last seen as in the window, if it is a key.
    pub(crate) last: Option<QuantizedState>,
}

/// The slots of a sequence with their places; prompts belong to frame 0.
pub(crate) fn place(sequence: &TokenSequence) -> Vec<PlacedSlot> {
    let mut frame = None;
    let mut key: Option<Key> = None;
    let mut seen: BTreeMap<u16, QuantizedState> = BTreeMap::new();
    let slots = sequence.slots().into_iter().enumerate();
    slots
        .map(|(position, slot)| {
            if matches!(slot, Slot::Begin) {
                frame = Some(frame.map_or(0, |frame: usize| frame + 1));
            }
            let before = key.take();
            let mut last = None;
            match (slot, before) {
                (Slot::Key(found), _) => {
                    key = Some(found);
                    last = seen.get(&found.id).copied();
                }
                (Slot::Value(state), Some(key)) => {
                    seen.insert(key.id, state);
                }
                _ => {}
            }
            PlacedSlot {
                slot,
                position,
                frame: frame.unwrap_or(0),
                key: before,
                last,
            }
        })
        .collect()
}

/// Packs sequences side by side; shorter ones are padded at the end, where causality hides it.
pub(crate) fn pack(
    sequences: &[&[PlacedSlot]],
    tables: Tables,
    sines: &SineTables,
    width: usize,
    device: &Device,
) -> candle_core::Result<TokenBatch> {
    let t = sequences
        .iter()
        .map(|sequence| sequence.len())
        .max()
        .unwrap_or(0);
    let b = sequences.len();
    let mut rows: Vec<u32> = Vec::with_capacity(b * t * ROWS_PER_TOKEN);
    let mut positions: Vec<u32> = Vec::new();
    let mut features: Vec<f32> = Vec::new();
    for (row, sequence) in sequences.iter().enumerate() {
        for (column, placed) in sequence.iter().enumerate() {
            rows.extend(tables.rows(placed));
            if sines.append(placed, &mut features) {
                positions.push((row * t + column) as u32);
            }
        }
        for position in sequence.len()..t {
            rows.extend(tables.rows(&PlacedSlot {
                slot: Slot::Pad,
                position,
                frame: 0,
                key: None,
                last: None,
            }));
        }
    }
    let n = positions.len();
    Ok(TokenBatch {
        rows: Tensor::from_vec(rows, (b * t, ROWS_PER_TOKEN), device)?,
        sine_positions: Tensor::from_vec(positions, n, device)?,
        sines: Tensor::from_vec(features, (n, width), device)?,
        shape: (b, t),
    })
}
