//! Slots of a token sequence and where they stand in the presented window.

use std::collections::BTreeMap;

use gump_geometry::Pose;
use gump_tokenizer::{Key, QuantizedState, Slot, TokenSequence};

use crate::exact::Exact;

/// A slot and where it stands in the presented window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlacedSlot {
    /// The slot.
    pub slot: Slot,
    /// Index of the token, from 0 at the start of the window.
    pub(crate) position: usize,
    /// Index of its frame, from 0 at the oldest.
    pub frame: usize,
    /// The key before it, if it is a value.
    pub(crate) key: Option<Key>,
    /// What its object was last seen as in the window, if it is a key.
    pub last: Option<QuantizedState>,
    /// The same, or what its object is, if it is a value, before it was rounded; `None` where only
    /// the token is known.
    pub exact: Option<Exact>,
}

impl PlacedSlot {
    /// Where the object of a key was last seen in the window: where it sees from, and in whose frame
    /// its chunk is said.
    pub fn last_pose(&self) -> Option<Pose> {
        let last = self.last?;
        Some(self.exact.map_or(last.pose(), |exact| exact.pose()))
    }
}

/// The slots of a sequence of which only the tokens are known.
pub fn place(sequence: &TokenSequence) -> Vec<PlacedSlot> {
    place_exactly(sequence, |_, _| None)
}

/// The slots of a sequence with their places; prompts belong to frame 0. `exact` tells what an object
/// was in a frame, by the index of the frame and the id.
pub fn place_exactly(
    sequence: &TokenSequence,
    exact: impl Fn(usize, u16) -> Option<Exact>,
) -> Vec<PlacedSlot> {
    let mut frame = None;
    let mut key: Option<Key> = None;
    let mut seen: BTreeMap<u16, (QuantizedState, Option<Exact>)> = BTreeMap::new();
    let slots = sequence.slots().into_iter().enumerate();
    slots
        .map(|(position, slot)| {
            if matches!(slot, Slot::Begin) {
                frame = Some(frame.map_or(0, |frame: usize| frame + 1));
            }
            let before = key.take();
            let (mut last, mut is) = (None, None);
            match (slot, before) {
                (Slot::Key(found), _) => {
                    key = Some(found);
                    (last, is) = match seen.get(&found.id) {
                        Some((state, exact)) => (Some(*state), *exact),
                        None => (None, None),
                    };
                }
                (Slot::Value(state), Some(key)) => {
                    is = exact(frame.unwrap_or(0), key.id);
                    seen.insert(key.id, (state, is));
                }
                _ => {}
            }
            PlacedSlot {
                slot,
                position,
                frame: frame.unwrap_or(0),
                key: before,
                last,
                exact: is,
            }
        })
        .collect()
}
