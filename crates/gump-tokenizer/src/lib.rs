//! Encoding of scenes as tokens, decoding, and the grammar of token sequences.
//!
//! A scene is a few frames half a second apart. Each frame consists of BEGIN, its traffic lights,
//! LIGHTS_END, a key (identity) and a value (state) for every agent that was also in the previous
//! frame, NEWBORN, and such pairs for the agents that were not. States are quantised to fixed grids
//! in the frame of one pose.
//!
//! Start with [`Tokenizer`], then [`TokenSequence`]. [`Field`] quantises numbers, and [`Grammar`]
//! is the only definition of valid sequences. The crate does not depend on tensors; embedding slots
//! and rendering the map belong to other crates.
//!
//! # Terms
//! * **slot**: one position of a sequence. **Token**: an index into the vocabulary; most slots are
//!   one token, a value slot is seven, one per **field**.
//! * **key**: the slot that identifies an agent by id and class; its **value** follows it.
//! * **tracked**: also present in the previous frame. **Newborn**: not present there, whether it
//!   appears for the first time or again. In the first frame all agents are tracked.
//! * **canonical order**: the ego, then by class, then by id.
//! * **scene frame**: the pose that all states of a window are relative to, usually the ego's now;
//!   x forward, y left. It stays fixed while the ego moves.
//!
//! ```
//! use gump_tokenizer::{Identities, Tokenizer, TokenizerConfig};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "ego vehicle 0: 10,0 velocity 8,0
//!      agent pedestrian 7: 30,4 velocity 0,-1",
//! ).unwrap();
//! let scene = scenario.present();
//! let frames = scene.strided_history(5, 3);
//! let world_from_scene = scene.ego_now().state.pose;
//! let identities = Identities::ranked(&frames, scene.ego, world_from_scene);
//! let tokenizer = Tokenizer::new(TokenizerConfig::default());
//! let encoded = tokenizer.encode(scene.map, &frames, scene.ego, world_from_scene, &identities);
//! assert_eq!(encoded.sequence.frames().len(), 3);
//! assert_eq!(encoded.sequence.len(), 3 * (3 + 2 * 2));
//! println!("{}", encoded.sequence);
//! ```

mod field;
mod frame;
mod grammar;
mod identity;
mod lights;
mod sequence;
mod state;
mod text;
mod tokenizer;
mod vocabulary;

#[cfg(test)]
mod tests;

pub use field::{Field, Quantized};
pub use frame::{Key, TokenAgent, TokenFrame, TokenLight};
pub use grammar::{Allowed, Grammar, GrammarError, MAX_PROMPTS};
pub use identity::Identities;
pub use sequence::{Overflow, Slot, TokenSequence};
pub use state::QuantizedState;
pub use tokenizer::{EncodeReport, Encoded, Tokenizer, TokenizerConfig};
pub use vocabulary::{
    AGENT_KEYS, BEGIN, EGO_KEY, FIRST_LIGHT, LIGHTS_END, MAX_LIGHTS, N_CLASSES, N_PROMPTS, NEWBORN,
    PAD, TABLE_ROWS, VOCABULARY_SIZE, class_index, light_token,
};
