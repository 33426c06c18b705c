//! A grammatical sequence of frames.

use std::fmt;

use gump_scene::ScenarioTag;

use crate::{
    Field, Grammar, GrammarError, Key, QuantizedState, TokenAgent, TokenFrame, TokenLight,
    class_index,
};

/// One position of a sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Slot {
    /// What kind of situation it is; `None` is the prompt "none".
    Prompt(Option<ScenarioTag>),
    /// Begins a frame.
    Begin,
    /// A traffic light.
    Light(TokenLight),
    /// Ends the lights.
    LightsEnd,
    /// Whose state follows.
    Key(Key),
    /// The state.
    Value(QuantizedState),
    /// Begins the newborn agents.
    Newborn,
    /// Nothing; never part of a [`TokenSequence`].
    Pad,
}

impl Slot {
    /// A word for messages.
    pub(crate) fn name(&self) -> String {
        match self {
            Self::Prompt(_) => "a prompt".into(),
            Self::Begin => "BEGIN".into(),
            Self::Light(light) => format!("light {}", light.index),
            Self::LightsEnd => "LIGHTS_END".into(),
            Self::Key(key) => format!("the key of {} {}", key.kind.name(), key.id),
            Self::Value(_) => "a value".into(),
            Self::Newborn => "NEWBORN".into(),
            Self::Pad => "PAD".into(),
        }
    }
}

/// Prompts and frames that obey the [`Grammar`].
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct TokenSequence {
    prompts: Vec<Option<ScenarioTag>>,
    frames: Vec<TokenFrame>,
}

impl TokenSequence {
    /// Checks prompts and frames against the grammar.
    ///
    /// # Errors
    /// [`GrammarError`] at the first slot that may not stand where it does.
    pub fn new(
        prompts: Vec<Option<ScenarioTag>>,
        frames: Vec<TokenFrame>,
    ) -> Result<Self, GrammarError> {
        let sequence = Self { prompts, frames };
        let mut grammar = Grammar::default();
        for slot in sequence.slots() {
            grammar.advance(&slot)?;
        }
        grammar.finish()?;
        Ok(sequence)
    }

    /// Reads slots back into frames.
    ///
    /// # Errors
    /// [`GrammarError`] at the first slot that may not stand where it does.
    pub fn parse(slots: &[Slot]) -> Result<Self, GrammarError> {
        let mut grammar = Grammar::default();
        let mut sequence = Self::default();
        let mut key = None;
        let mut newborn = false;
        for slot in slots {
            grammar.advance(slot)?;
            match (*slot, sequence.frames.last_mut()) {
                (Slot::Prompt(tag), _) => sequence.prompts.push(tag),
                (Slot::Begin, _) => {
                    sequence.frames.push(TokenFrame::default());
                    newborn = false;
                }
                (Slot::Light(light), Some(frame)) => frame.lights.push(light),
                (Slot::Key(found), _) => key = Some(found),
                (Slot::Newborn, _) => newborn = true,
                (Slot::Value(state), Some(frame)) => {
                    let key = key
                        .take()
                        .expect("the grammar puts a key before every value");
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
        let mut slots: Vec<Slot> = self.prompts.iter().copied().map(Slot::Prompt).collect();
        slots.reserve(self.len() - slots.len());
        let pair = |agent: &TokenAgent| [Slot::Key(agent.key), Slot::Value(agent.state)];
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
        self.prompts.len() + self.frames.iter().map(TokenFrame::len_slots).sum::<usize>()
    }

    /// True if there is neither prompt nor frame.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Index of each frame's BEGIN.
    pub fn frame_starts(&self) -> Vec<usize> {
        let mut start = self.prompts.len();
        let starts = self.frames.iter().map(|frame| {
            let this = start;
            start += frame.len_slots();
            this
        });
        starts.collect()
    }

    /// The last `n` frames; who was newborn in the first of them counts as tracked now.
    pub fn tail(&self, n: usize) -> Self {
        let mut frames = self.frames[self.frames.len().saturating_sub(n)..].to_vec();
        if let Some(first) = frames.first_mut() {
            let newborn = std::mem::take(&mut first.newborn);
            first.tracked.extend(newborn);
            first.tracked.sort_by_key(|agent| agent.key.order());
        }
        Self {
            prompts: self.prompts.clone(),
            frames,
        }
    }

    /// The longest run of last frames that takes at most `block_size` slots, and who had to be left
    /// out: if the last frame alone is too long, the agents farthest from the ego.
    pub fn fit(&self, block_size: usize) -> (Self, Vec<Key>) {
        for n in (1..=self.frames.len()).rev() {
            let tail = self.tail(n);
            if tail.len() <= block_size {
                return (tail, Vec::new());
            }
        }
        let mut tail = self.tail(1);
        let over = tail.len().saturating_sub(block_size).div_ceil(2);
        let Some(frame) = tail.frames.first_mut() else {
            return (tail, Vec::new());
        };
        let Some(ego) = frame.tracked.first().copied() else {
            return (tail, Vec::new());
        };
        let distance = |agent: &TokenAgent| {
            agent
                .state
                .pose()
                .position
                .distance(ego.state.pose().position)
        };
        let mut far: Vec<TokenAgent> = frame.tracked[1..].to_vec();
        far.sort_by(|a, b| {
            distance(b)
                .total_cmp(&distance(a))
                .then(a.key.id.cmp(&b.key.id))
        });
        let left_out: Vec<Key> = far.iter().take(over).map(|agent| agent.key).collect();
        frame.tracked.retain(|agent| !left_out.contains(&agent.key));
        (tail, left_out)
    }
}

/// Readable: one frame per line, values as numbers.
impl fmt::Display for TokenSequence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for prompt in &self.prompts {
            writeln!(f, "PROMPT {}", prompt.map_or("none", ScenarioTag::name))?;
        }
        for frame in &self.frames {
            write!(f, "BEGIN")?;
            for light in &frame.lights {
                let (x, y) = (Field::X.dequantize(light.x), Field::Y.dequantize(light.y));
                write!(f, " L{}({:?} {x:.1} {y:.1})", light.index, light.state)?;
            }
            write!(f, " LIGHTS_END")?;
            frame
                .tracked
                .iter()
                .try_for_each(|agent| write_agent(f, agent))?;
            write!(f, " NEWBORN")?;
            frame
                .newborn
                .iter()
                .try_for_each(|agent| write_agent(f, agent))?;
            writeln!(f)?;
        }
        Ok(())
    }
}

fn write_agent(f: &mut fmt::Formatter<'_>, agent: &TokenAgent) -> fmt::Result {
    let class = ['v', 'p', 'b'][class_index(agent.key.kind)];
    let [x, y, heading, vx, vy, width, length] = agent.state.values();
    write!(
        f,
        " {class}{}({x:.1} {y:.1} {heading:.2} {vx:.2} {vy:.2} {width:.1}x{length:.1})",
        agent.key.id
    )
}
