//! The grammar of token sequences, shared by constructor, parser and sampler.
//!
//! ```text
//! sequence = prompt{0..4} frame* PAD*
//! frame    = BEGIN light* LIGHTS_END (key value)+ NEWBORN (key value)*
//! ```
//!
//! In addition:
//! * prompts are one "none" or different tags;
//! * the indices of a frame's lights ascend, and an index never denotes two places;
//! * each of the two lists of agents is in canonical order, and the ego is the first of the tracked
//!   ones;
//! * an agent of the previous frame is tracked or gone, any other is newborn; the first frame has
//!   no newborn agents;
//! * an id occurs once per frame and never denotes two classes;
//! * every bin lies in its field's sub-vocabulary.
//!
//! Source: the frame layout of the GUMP paper and its released code, which emits BEGIN once per
//! frame; order and identity rules are stricter than there.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::RangeInclusive;

use gump_scene::{AgentKind, ScenarioTag};

use crate::{
    AGENT_KEYS, BEGIN, FIRST_LIGHT, Key, LIGHTS_END, MAX_LIGHTS, NEWBORN, PAD, Slot, TokenLight,
};

/// Maximum number of prompts of a sequence. Our choice: the paper states none, and few tags hold
/// together.
pub const MAX_PROMPTS: usize = 4;

/// Why tokens are not a valid scene.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GrammarError {
    /// A slot is not allowed at its position.
    #[error("slot {position}: expected {expected}, found {found}")]
    Unexpected {
        /// Index of the slot in its sequence.
        position: usize,
        /// The slots that would have been allowed.
        expected: String,
        /// The slot found.
        found: String,
    },
    /// A key without an agent.
    #[error("id {0} denotes no agent of the scene")]
    UnknownId(u16),
    /// A light index without a lane.
    #[error("light {0} denotes no lane of the scene")]
    UnknownLight(u16),
}

/// Reads slots one by one and determines what may come next.
#[derive(Clone, Debug, Default)]
pub struct Grammar {
    part: SequencePart,
    position: usize,
    prompts: Vec<Option<ScenarioTag>>,
    n_frames: usize,
    last_light: u16,
    last_key: Option<Key>,
    present: BTreeSet<u16>,
    previous: BTreeSet<u16>,
    kinds: BTreeMap<u16, AgentKind>,
    lights: BTreeMap<u16, [u16; 3]>,
}

/// The part of a sequence that the next slot belongs to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum SequencePart {
    #[default]
    Prompts,
    Lights,
    Tracked,
    TrackedValue,
    Newborn,
    NewbornValue,
    Padding,
}

impl Grammar {
    /// The slots that may come next.
    pub fn allowed(&self) -> Allowed<'_> {
        Allowed { grammar: self }
    }

    /// Reads the next slot.
    ///
    /// # Errors
    /// [`GrammarError::Unexpected`] if it is not allowed; the grammar is then unchanged.
    pub fn advance(&mut self, slot: &Slot) -> Result<(), GrammarError> {
        if !self.allowed().slot(slot) {
            let found = match slot {
                Slot::Key(key) => format!("the key of {key}"),
                Slot::Value(state) => format!("the value {state}"),
                other => other.to_string(),
            };
            return Err(self.unexpected(found));
        }
        self.part = match *slot {
            Slot::Prompt(prompt) => {
                self.prompts.push(prompt);
                SequencePart::Prompts
            }
            Slot::Begin => {
                self.n_frames += 1;
                self.previous = std::mem::take(&mut self.present);
                (self.last_light, self.last_key) = (0, None);
                SequencePart::Lights
            }
            Slot::Light(light) => {
                self.last_light = light.index;
                self.lights.insert(light.index, light.place());
                SequencePart::Lights
            }
            Slot::LightsEnd => SequencePart::Tracked,
            Slot::Key(key) => {
                self.last_key = Some(key);
                self.present.insert(key.id);
                self.kinds.insert(key.id, key.kind);
                match self.part {
                    SequencePart::Tracked => SequencePart::TrackedValue,
                    _ => SequencePart::NewbornValue,
                }
            }
            Slot::Value(_) => match self.part {
                SequencePart::TrackedValue => SequencePart::Tracked,
                _ => SequencePart::Newborn,
            },
            Slot::Newborn => {
                self.last_key = None;
                SequencePart::Newborn
            }
            Slot::Pad => SequencePart::Padding,
        };
        self.position += 1;
        Ok(())
    }

    /// Ends the sequence.
    ///
    /// # Errors
    /// [`GrammarError::Unexpected`] if the last frame is not complete.
    pub fn finish(&self) -> Result<(), GrammarError> {
        if self.allowed().end() {
            Ok(())
        } else {
            Err(self.unexpected("the end".into()))
        }
    }

    /// Number of slots read.
    pub fn position(&self) -> usize {
        self.position
    }

    fn unexpected(&self, found: String) -> GrammarError {
        GrammarError::Unexpected {
            position: self.position,
            expected: self.allowed().to_string(),
            found,
        }
    }
}

/// The slots that may come next; the mask of a sampler.
#[derive(Clone, Copy, Debug)]
pub struct Allowed<'a> {
    grammar: &'a Grammar,
}

impl Allowed<'_> {
    /// True if exactly this slot may come next.
    pub fn slot(&self, slot: &Slot) -> bool {
        match slot {
            Slot::Prompt(prompt) => self.prompt(*prompt),
            Slot::Begin => self.begin(),
            Slot::Light(light) => self.light(light),
            Slot::LightsEnd => self.lights_end(),
            Slot::Key(key) => self.key(*key),
            Slot::Value(state) => self.value() && state.is_valid(),
            Slot::Newborn => self.newborn(),
            Slot::Pad => self.end(),
        }
    }

    /// True if this prompt may come next.
    pub fn prompt(&self, prompt: Option<ScenarioTag>) -> bool {
        let before = &self.grammar.prompts;
        let fits = match prompt {
            None => before.is_empty(),
            Some(_) => !before.contains(&None) && !before.contains(&prompt),
        };
        self.grammar.part == SequencePart::Prompts && before.len() < MAX_PROMPTS && fits
    }

    /// True if a frame may begin.
    pub fn begin(&self) -> bool {
        matches!(
            self.grammar.part,
            SequencePart::Prompts | SequencePart::Newborn
        )
    }

    /// The indices that the next light may have; empty where no light may come.
    pub fn light_indices(&self) -> RangeInclusive<u16> {
        let first = match self.grammar.part {
            SequencePart::Lights => self.grammar.last_light + 1,
            _ => MAX_LIGHTS as u16 + 1,
        };
        first..=MAX_LIGHTS as u16
    }

    /// True if this light may come next.
    pub fn light(&self, light: &TokenLight) -> bool {
        let known = self.grammar.lights.get(&light.index);
        self.light_indices().contains(&light.index)
            && light.is_valid()
            && known.is_none_or(|place| *place == light.place())
    }

    /// True if the lights may end.
    pub fn lights_end(&self) -> bool {
        self.grammar.part == SequencePart::Lights
    }

    /// True if this key may come next.
    pub fn key(&self, key: Key) -> bool {
        let grammar = self.grammar;
        let belongs = match grammar.part {
            SequencePart::Tracked if grammar.present.is_empty() => key.is_ego(),
            SequencePart::Tracked => grammar.n_frames == 1 || grammar.previous.contains(&key.id),
            SequencePart::Newborn => grammar.n_frames > 1 && !grammar.previous.contains(&key.id),
            _ => false,
        };
        let in_order = grammar.last_key.is_none_or(|last| last < key);
        let known = grammar.kinds.get(&key.id);
        belongs
            && in_order
            && !grammar.present.contains(&key.id)
            && (key.is_ego() || AGENT_KEYS.contains(&u32::from(key.id)))
            && known.map_or(key.kind.is_moving(), |kind| *kind == key.kind)
    }

    /// All keys that may come next, in canonical order.
    pub fn keys(&self) -> impl Iterator<Item = Key> + '_ {
        let of_kind = |kind| (0..=*AGENT_KEYS.end() as u16).map(move |id| Key { id, kind });
        let keys = AgentKind::MOVING.into_iter().flat_map(of_kind);
        keys.filter(|key| self.key(*key))
    }

    /// True if a value may come next; it then must.
    pub fn value(&self) -> bool {
        matches!(
            self.grammar.part,
            SequencePart::TrackedValue | SequencePart::NewbornValue
        )
    }

    /// True if the tracked agents may end.
    pub fn newborn(&self) -> bool {
        self.grammar.part == SequencePart::Tracked && !self.grammar.present.is_empty()
    }

    /// True if the sequence may end here, or be padded.
    pub fn end(&self) -> bool {
        self.begin() || self.grammar.part == SequencePart::Padding
    }

    /// The tokens of all single-token slots that may come next, ascending; none before a value,
    /// whose tokens are those of its fields. Prompts have a separate table.
    pub fn tokens(&self) -> Vec<u32> {
        let ids: BTreeSet<u16> = self.keys().map(|key| key.id).collect();
        let mut tokens: Vec<u32> = ids.into_iter().map(u32::from).collect();
        if !self.light_indices().is_empty() {
            tokens.extend(FIRST_LIGHT..FIRST_LIGHT + 4);
        }
        let marks = [
            (self.begin(), BEGIN),
            (self.newborn(), NEWBORN),
            (self.lights_end(), LIGHTS_END),
            (self.end(), PAD),
        ];
        tokens.extend(marks.into_iter().filter(|(may, _)| *may).map(|(_, t)| t));
        tokens
    }
}

/// A description of what may come next, for messages.
impl fmt::Display for Allowed<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut words: Vec<String> = Vec::new();
        if self.grammar.part == SequencePart::Prompts {
            words.push("a prompt".into());
        }
        let lights = self.light_indices();
        if !lights.is_empty() {
            words.push(format!("a light of {}..={}", lights.start(), lights.end()));
        }
        let mut keys = self.keys();
        match (keys.next(), keys.count()) {
            (None, _) => {}
            (Some(key), _) if key.is_ego() => words.push("the ego's key".into()),
            (Some(key), 0) => words.push(format!("the key of {key}")),
            (Some(key), more) => words.push(format!("the key of {key} or {more} others")),
        }
        for (may, word) in [
            (self.value(), "a value"),
            (self.lights_end(), "LIGHTS_END"),
            (self.newborn(), "NEWBORN"),
            (self.begin(), "BEGIN"),
            (self.end(), "PAD or the end"),
        ] {
            if may {
                words.push(word.into());
            }
        }
        f.write_str(&words.join(" or "))
    }
}
