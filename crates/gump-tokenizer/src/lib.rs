//! A scene as tokens and back, with its grammar.
//!
//! A frame is BEGIN, its lights, LIGHTS_END, then pairs of key (who) and value (in which state) for
//! the agents that were there before, NEWBORN, and pairs for those that were not. States are
//! quantised by [`Field`]; [`Tokenizer`] encodes, [`Grammar`] says what may follow what,
//! [`TokenSequence`] is grammatical once built.
//!
//! # Terms
//! * **slot**: one position of a sequence. **token**: an index of the vocabulary; a value slot is
//!   the sum of seven tokens, one per field.
//! * **scene frame**: the pose everything is expressed in, fixed for a window, usually the ego's.

mod field;
mod frame;
mod grammar;
mod identity;
mod sequence;
mod state;
mod tokenizer;
mod vocabulary;

pub use field::{Field, Quantized};
pub use frame::{Key, TokenAgent, TokenFrame, TokenLight};
pub use grammar::{Allowed, Grammar, GrammarError};
pub use identity::Identities;
pub use sequence::{Slot, TokenSequence};
pub use state::QuantizedState;
pub use tokenizer::{EncodeReport, Encoded, Tokenizer, TokenizerConfig};
pub use vocabulary::{
    AGENT_KEYS, BEGIN, EGO_KEY, FIRST_LIGHT, LIGHTS_END, MAX_LIGHTS, N_CLASSES, N_PROMPTS, NEWBORN,
    PAD, TABLE_ROWS, VOCABULARY_SIZE, class_index, light_token,
};
