//! Slots of a token sequence with their positions in the presented window.

use std::collections::BTreeMap;

use gump_geometry::Pose;
use gump_tokenizer::{Key, QuantizedState, Slot, TokenSequence};

use crate::exact::Exact;

/// A slot with its position in the presented window.
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
    /// The object's last state in the window, if it is a key.
    pub last: Option<QuantizedState>,
    /// The exact state: for a key the object's last one, for a value its own; `None` where only the
    /// token is known.
    pub exact: Option<Exact>,
}

impl PlacedSlot {
    /// The object's last pose in the window, for a key: the origin of its local context and its
    /// local frame.
    pub fn last_pose(&self) -> Option<Pose> {
        let last = self.last?;
        Some(self.exact.map_or(last.pose(), |exact| exact.pose()))
    }
}

/// The slots of a sequence without exact states.
pub fn place(sequence: &TokenSequence) -> Vec<PlacedSlot> {
    place_exactly(sequence, |_, _| None)
}

/// The slots of a sequence with their positions; prompts belong to frame 0. `exact` returns the
/// exact state of an object in a frame, by the index of the frame and the id.
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
