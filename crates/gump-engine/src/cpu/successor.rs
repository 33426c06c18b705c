//! Logits of the successor of a token: the next key or control token, the class of a new agent, the
//! state of a light.
//!
//! They use rows of existing matrices of the network, applied at control and value tokens;
//! `spawning` and `gump-generate` use the results.

use gump_kernels::panels::{Panels, Precision, Scratch};
use gump_model::ModelError;
use gump_model::decoder::{CONTROL_KEYS, N_LIGHT_STATES};
use gump_model::embedding::Tables;
use gump_tokenizer::{BEGIN, FIRST_LIGHT, N_CLASSES};

use super::weights::WeightReader;

/// Logits over the successors of one token.
#[derive(Clone, Debug)]
pub struct Successor {
    /// Of the keys, then BEGIN, NEWBORN and LIGHTS_END.
    pub(crate) control: Vec<f32>,
    /// Of the states of a light, in the order of their tokens.
    pub(crate) lights: [f32; N_LIGHT_STATES],
    /// Of the classes of an agent not seen before.
    pub(crate) classes: [f32; N_CLASSES],
}

/// The rows, in this order.
#[derive(Debug)]
pub(super) struct Successors(Panels);

impl Successors {
    pub(super) fn new(weights: &WeightReader<'_>) -> Result<Self, ModelError> {
        let c = weights.network.config().width;
        let head = weights.get("decoder.head.weight")?;
        let tables = weights.get("mct.tables")?;
        let rows = |of: &[f32], first: usize, n: usize| of[first * c..(first + n) * c].to_vec();
        let all = [
            rows(&head, 0, CONTROL_KEYS),
            rows(&head, BEGIN as usize, 3),
            rows(&head, FIRST_LIGHT as usize, N_LIGHT_STATES),
            rows(&tables, Tables::CLASS, N_CLASSES),
        ];
        // Few rows that decide who exists: in full precision.
        let panels = Panels::new(&all.concat(), c, None, Precision::F32);
        Ok(Self(panels))
    }

    pub(super) fn products(&self, rows: usize) -> u64 {
        self.0.products(rows)
    }

    pub(super) fn logits(&self, hidden: &[f32]) -> Successor {
        let mut all = vec![0.0; self.0.n_out()];
        self.0
            .apply_to_few(hidden, &mut all, &mut Scratch::default());
        let (control, rest) = all.split_at(CONTROL_KEYS + 3);
        Successor {
            control: control.to_vec(),
            lights: std::array::from_fn(|i| rest[i]),
            classes: std::array::from_fn(|i| rest[N_LIGHT_STATES + i]),
        }
    }
}
