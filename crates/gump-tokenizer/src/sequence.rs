//! A valid sequence of frames: building, parsing, truncating.
//!
//! `grammar` defines which sequences are valid; `tokenizer` converts scenes.

use gump_scene::ScenarioTag;

use crate::{
    BEGIN, Grammar, GrammarError, Key, LIGHTS_END, NEWBORN, PAD, QuantizedState, TokenAgent,
    TokenFrame, TokenLight, light_token,
};

/// One position of a sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Slot {
    /// A scenario tag; `None` is the prompt "none".
    Prompt(Option<ScenarioTag>),
    /// Begins a frame.
    Begin,
    /// A traffic light.
    Light(TokenLight),
    /// Ends the lights.
    LightsEnd,
    /// The agent whose state follows.
    Key(Key),
    /// The state.
    Value(QuantizedState),
    /// Begins the newborn agents.
    Newborn,
    /// Padding; never part of a [`TokenSequence`].
    Pad,
}

impl Slot {
    /// The slot's token: that of an id, a light state or a mark. `None` for prompts, which have
    /// their own table, and values, which have a token per field.
    pub fn token(&self) -> Option<u32> {
        match self {
            Self::Prompt(_) | Self::Value(_) => None,
            Self::Begin => Some(BEGIN),
            Self::Light(light) => Some(light_token(light.state)),
            Self::LightsEnd => Some(LIGHTS_END),
            Self::Key(key) => Some(u32::from(key.id)),
            Self::Newborn => Some(NEWBORN),
            Self::Pad => Some(PAD),
        }
    }
}

/// Prompts and frames that obey the [`Grammar`], oldest frame first.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct TokenSequence {
    prompts: Vec<Option<ScenarioTag>>,
    frames: Vec<TokenFrame>,
}

/// Frames, agents and lights that [`TokenSequence::fit`] left out.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Overflow {
    /// Oldest whole frames.
    pub frames: usize,
    /// Agents of the last frame, the farthest from the ego first.
    pub agents: Vec<Key>,
    /// Lights of the last frame, by index, the farthest from the centre first.
    pub lights: Vec<u16>,
}

impl TokenSequence {
    /// Checks prompts and frames against the grammar.
    ///
    /// # Errors
    /// [`GrammarError`] at the first slot that is not allowed.
    pub fn new(
        prompts: Vec<Option<ScenarioTag>>,
        frames: Vec<TokenFrame>,
    ) -> Result<Self, GrammarError> {
        let sequence = Self { prompts, frames };
        read(&sequence.slots())?.finish()?;
        Ok(sequence)
    }

    /// Reads slots back into frames; PAD may follow the last.
    ///
    /// # Errors
    /// [`GrammarError`] at the first slot that is not allowed.
    pub fn parse(slots: &[Slot]) -> Result<Self, GrammarError> {
        let mut grammar = Grammar::default();
        let mut sequence = Self::default();
        let mut key = None;
        let mut newborn = false;
        for slot in slots {
            grammar.advance(slot)?;
            match (*slot, sequence.frames.last_mut()) {
                (Slot::Prompt(prompt), _) => sequence.prompts.push(prompt),
                (Slot::Begin, _) => {
                    newborn = false;
                    sequence.frames.push(TokenFrame::default());
                }
                (Slot::Light(light), Some(frame)) => frame.lights.push(light),
                (Slot::Key(found), _) => key = Some(found),
                (Slot::Newborn, _) => newborn = true,
                (Slot::Value(state), Some(frame)) => {
                    let key = key.expect("the grammar puts a key before every value");
                    let agents = if newborn {
                        &mut frame.newborn
                    } else {
                        &mut frame.tracked
                    };
                    agents.push(TokenAgent { key, state });
                }
                _ => {}
            }
        }
        grammar.finish()?;
        Ok(sequence)
    }

    /// The same frames after other prompts.
    ///
    /// # Errors
    /// [`GrammarError`] if these prompts cannot be combined.
    pub fn with_prompts(self, prompts: Vec<Option<ScenarioTag>>) -> Result<Self, GrammarError> {
        Self::new(prompts, self.frames)
    }

    /// The frames, oldest first.
    pub fn frames(&self) -> &[TokenFrame] {
        &self.frames
    }

    /// The prompts.
    pub fn prompts(&self) -> &[Option<ScenarioTag>] {
        &self.prompts
    }

    /// The sequence position by position.
    pub fn slots(&self) -> Vec<Slot> {
        let pair = |agent: &TokenAgent| [Slot::Key(agent.key), Slot::Value(agent.state)];
        let mut slots = Vec::with_capacity(self.len());
        slots.extend(self.prompts.iter().copied().map(Slot::Prompt));
        for frame in &self.frames {
            slots.push(Slot::Begin);
            slots.extend(frame.lights.iter().copied().map(Slot::Light));
            slots.push(Slot::LightsEnd);
            slots.extend(frame.tracked.iter().flat_map(pair));
            slots.push(Slot::Newborn);
            slots.extend(frame.newborn.iter().flat_map(pair));
        }
        slots
    }

    /// Number of slots.
    pub fn len(&self) -> usize {
        let frames = self.frames.iter().map(TokenFrame::len_slots);
        self.prompts.len() + frames.sum::<usize>()
    }

    /// True if there is neither prompt nor frame.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Index of each frame's BEGIN.
    pub fn frame_starts(&self) -> Vec<usize> {
        let start = |next: &mut usize, frame: &TokenFrame| {
            let start = *next;
            *next += frame.len_slots();
            Some(start)
        };
        self.frames.iter().scan(self.prompts.len(), start).collect()
    }

    /// The grammar after the last slot, for continuing the sequence.
    pub fn grammar(&self) -> Grammar {
        read(&self.slots()).expect("a sequence in hand is grammatical")
    }

    /// The prompts and the last `n_frames` frames; newborn agents of the first of them become
    /// tracked.
    pub fn tail(&self, n_frames: usize) -> Self {
        let first = self.frames.len().saturating_sub(n_frames);
        let mut frames = self.frames[first..].to_vec();
        if let Some(first) = frames.first_mut() {
            *first = std::mem::take(first).into_first();
        }
        Self {
            prompts: self.prompts.clone(),
            frames,
        }
    }

    /// The longest part of the sequence that takes at most `block_size` slots, and what is left
    /// out.
    ///
    /// The oldest frames are dropped first, as a whole. If the last frame alone is too long, it
    /// loses the agents farthest from the ego, then its last lights; other frames are never cut.
    /// Prompts stay.
    ///
    /// # Panics
    /// If not even the prompts and a frame with only the ego (5 slots) fit.
    pub fn fit(&self, block_size: usize) -> (Self, Overflow) {
        let lengths: Vec<usize> = self.frames.iter().map(TokenFrame::len_slots).collect();
        let mut length = self.len();
        let mut overflow = Overflow::default();
        while block_size < length && overflow.frames + 1 < lengths.len() {
            length -= lengths[overflow.frames];
            overflow.frames += 1;
        }
        let mut fitted = self.tail(self.frames.len() - overflow.frames);
        let excess = fitted.len().saturating_sub(block_size);
        if excess > 0 {
            let last = fitted.frames.first_mut();
            (overflow.agents, overflow.lights) =
                last.map(|f| shorten(f, excess)).unwrap_or_default();
        }
        let length = fitted.len();
        assert!(
            length <= block_size,
            "a block of {block_size} cannot hold {length} slots"
        );
        (fitted, overflow)
    }
}

/// Reads slots from the start.
fn read(slots: &[Slot]) -> Result<Grammar, GrammarError> {
    let mut grammar = Grammar::default();
    slots.iter().try_for_each(|slot| grammar.advance(slot))?;
    Ok(grammar)
}

/// Takes agents, then lights, out of a lone frame until it is at least `excess` slots shorter.
fn shorten(frame: &mut TokenFrame, excess: usize) -> (Vec<Key>, Vec<u16>) {
    let position = |agent: &TokenAgent| agent.state.pose().position;
    let Some(ego) = frame.tracked.first().map(position) else {
        return Default::default();
    };
    let mut far: Vec<(f64, Key)> = frame.tracked[1..]
        .iter()
        .map(|agent| (position(agent).distance(ego), agent.key))
        .collect();
    far.sort_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)));
    let agents: Vec<Key> = far
        .into_iter()
        .take(excess.div_ceil(2))
        .map(|(_, key)| key)
        .collect();
    frame.tracked.retain(|agent| !agents.contains(&agent.key));
    let n_lights = excess.saturating_sub(2 * agents.len());
    let kept = frame.lights.len().saturating_sub(n_lights);
    let lights = frame.lights.split_off(kept);
    (
        agents,
        lights.iter().rev().map(|light| light.index).collect(),
    )
}
