//! Token embeddings: one sum of table rows per token, plus a sine embedding for tokens with
//! coordinates.
//!
//! All tables of the specification (tokens, classes, light indices, prompts, positions, frames)
//! are stacked into one, so that every token of every kind is the sum of a few of its rows; the
//! gather and its backward pass are one operation, in `ops`.

use crate::config::ModelConfig;
use crate::placed_slot::PlacedSlot;
use gump_tokenizer::{Field, N_CLASSES, N_PROMPTS, PAD, QuantizedState, Slot, TABLE_ROWS};

/// Rows of the frame table; frames beyond share the last row. A block of 2048 tokens holds as many
/// frames (32 s) of at most fourteen agents only.
const N_FRAMES: usize = 64;
/// Rows for light indices, 0 unused; the released code's.
const N_LIGHT_INDICES: usize = 64;
/// Maximum number of rows that a token sums: seven fields, id, class, the mark of a key, position,
/// frame.
pub(crate) const ROWS_PER_TOKEN: usize = 12;

/// First rows of the tables in the stack of tables.
#[derive(Clone, Copy, Debug)]
pub struct Tables {
    block_size: usize,
    pairs_share: bool,
}

impl Tables {
    /// First row of the classes.
    pub const CLASS: usize = TABLE_ROWS as usize;
    pub(crate) const LIGHT_INDEX: usize = Self::CLASS + N_CLASSES;
    pub(crate) const PROMPT: usize = Self::LIGHT_INDEX + N_LIGHT_INDICES;
    pub(crate) const FRAME: usize = Self::PROMPT + N_PROMPTS;
    pub(crate) const KEY_MARK: usize = Self::FRAME + N_FRAMES;
    pub(crate) const POSITION: usize = Self::KEY_MARK + 1;

    pub(crate) fn new(config: &ModelConfig) -> Self {
        Self {
            block_size: config.block_size,
            pairs_share: config.pairs_share,
        }
    }

    /// Rows of all tables together.
    pub(crate) fn n_rows(self) -> usize {
        Self::POSITION + self.block_size
    }

    /// The rows that a token sums; unused entries are `u32::MAX`.
    pub(crate) fn rows(self, placed: &PlacedSlot) -> [u32; ROWS_PER_TOKEN] {
        let mut rows = [u32::MAX; ROWS_PER_TOKEN];
        let mut n = 0;
        let mut add = |row: usize| {
            rows[n] = row as u32;
            n += 1;
        };
        match &placed.slot {
            Slot::Prompt(tag) => add(Self::PROMPT + tag.map_or(N_PROMPTS - 1, |tag| tag.index())),
            Slot::Begin => add(gump_tokenizer::BEGIN as usize),
            Slot::LightsEnd => add(gump_tokenizer::LIGHTS_END as usize),
            Slot::Newborn => add(gump_tokenizer::NEWBORN as usize),
            Slot::Pad => add(PAD as usize),
            Slot::Light(light) => {
                add(gump_tokenizer::light_token(light.state) as usize);
                add(Self::LIGHT_INDEX + usize::from(light.index).min(N_LIGHT_INDICES - 1));
            }
            Slot::Key(key) => {
                add(usize::from(key.id));
                add(Self::CLASS + gump_tokenizer::class_index(key.kind));
                if self.pairs_share {
                    add(Self::KEY_MARK);
                    if let Some(last) = placed.last {
                        for field in Field::ALL {
                            add(last.token(field) as usize);
                        }
                    }
                }
            }
            Slot::Value(state) => {
                for field in Field::ALL {
                    add(state.token(field) as usize);
                }
                if let Some(key) = placed.key.filter(|_| self.pairs_share) {
                    add(usize::from(key.id));
                    add(Self::CLASS + gump_tokenizer::class_index(key.kind));
                }
            }
        }
        add(Self::POSITION + placed.position.min(self.block_size - 1));
        add(Self::FRAME + placed.frame.min(N_FRAMES - 1));
        rows
    }
}

/// The key of the sine features of a token: the bins, and whether only the first three count, as
/// for a light.
pub type SineKey = (QuantizedState, bool);

/// Sine features of every bin of every field, computed once.
///
/// A token's features are seven blocks of `2k` entries, k = ⌊width / 14⌋, in the order of
/// [`Field::ALL`], then zeros. Lengths and speeds use wavelengths in geometric steps from four bins
/// to four times the field's range; headings use whole harmonics, so that θ and θ + 2π embed alike.
#[derive(Debug)]
pub(crate) struct SineTables {
    width: usize,
    pairs_share: bool,
    /// Per field, [bins, 2k].
    fields: Vec<Vec<f32>>,
}

impl SineTables {
    pub(crate) fn new(config: &ModelConfig) -> Self {
        let width = config.width;
        let k = width / (2 * Field::ALL.len());
        Self {
            width,
            pairs_share: config.pairs_share,
            fields: Field::ALL.map(|field| field_sines(field, k)).to_vec(),
        }
    }

    /// The key of a token's features, if it has coordinates.
    pub(crate) fn key(&self, placed: &PlacedSlot) -> Option<SineKey> {
        match &placed.slot {
            Slot::Value(state) => Some((*state, false)),
            Slot::Light(light) => {
                let place = QuantizedState {
                    x: light.x,
                    y: light.y,
                    heading: light.heading,
                    ..QuantizedState::default()
                };
                Some((place, true))
            }
            Slot::Key(_) if self.pairs_share => placed.last.map(|last| (last, false)),
            _ => None,
        }
    }

    /// Appends the features of a token to `out` if it has coordinates.
    pub(crate) fn append(&self, placed: &PlacedSlot, out: &mut Vec<f32>) -> bool {
        let Some((state, is_light)) = self.key(placed) else {
            return false;
        };
        let n_fields = if is_light { 3 } else { Field::ALL.len() };
        let end = out.len() + self.width;
        let block = 2 * (self.width / (2 * Field::ALL.len()));
        for (field, table) in Field::ALL.into_iter().zip(&self.fields).take(n_fields) {
            out.extend_from_slice(&table[usize::from(state.get(field)) * block..][..block]);
        }
        out.resize(end, 0.0);
        true
    }
}

/// Sine features of a point on the ground, as visual tokens use them.
pub(crate) fn sine_of_point(x: f64, y: f64, width: usize) -> Vec<f32> {
    let k = width / (2 * Field::ALL.len());
    let mut features = sines(Field::X, x, k);
    features.extend(sines(Field::Y, y, k));
    features.resize(width, 0.0);
    features
}

/// Sine features of all bins of a field, [bins, 2k].
pub(crate) fn field_sines(field: Field, k: usize) -> Vec<f32> {
    let bins = 0..field.n_bins() as u16;
    bins.flat_map(|bin| sines(field, field.dequantize(bin), k))
        .collect()
}

/// `k` sines, then `k` cosines.
fn sines(field: Field, value: f64, k: usize) -> Vec<f32> {
    let phase = |m: usize| value * frequency(field, m, k);
    (0..k)
        .map(|m| phase(m).sin() as f32)
        .chain((0..k).map(|m| phase(m).cos() as f32))
        .collect()
}

/// Radians per unit of `field` for the `m`-th of `k` frequencies.
fn frequency(field: Field, m: usize, k: usize) -> f64 {
    if field.is_circular() {
        return (m + 1) as f64;
    }
    // From four steps of the grid, which sines can still tell apart, to four times its range, over
    // which they are nearly straight; not tuned. The released code's shortest wave is 6.3 m.
    let shortest = 4.0 * field.step();
    let longest = 4.0 * (field.high() - field.low());
    let t = if k > 1 {
        m as f64 / (k - 1) as f64
    } else {
        0.0
    };
    std::f64::consts::TAU / (shortest * (longest / shortest).powf(t))
}
