//! The recurrent decoder of states, for the engine: decodes a few objects at a time through all
//! steps.
//!
//! The input side of the first layer is one table lookup: its products with every token and every
//! step are computed when the engine is built. Each step multiplies only the output rows of its
//! field, which is exact because no other bins may be sampled.

use gump_kernels::gru::gru_row;
use gump_kernels::panels::{Panels, Scratch};
use gump_kernels::wide;
use gump_model::ModelError;
use gump_model::decoder::{Bins, STEPS};
use gump_tokenizer::{Field, TABLE_ROWS};
use rayon::prelude::*;

use super::weights::{WeightReader, numbers};
use super::{Pool, Workspace, chunk_rows};
use crate::draw::draw_field;
use crate::request::Request;
use crate::sampling::SamplingConfig;

/// The decoder's weights.
#[derive(Debug)]
pub(super) struct Decoder {
    width: usize,
    /// Input products of the first layer's gates for every token, `[TABLE_ROWS, 3C]`, and for every
    /// step, bias included, `[STEPS, 3C]`.
    token_gates: Vec<f32>,
    step_gates: Vec<f32>,
    /// The hidden side of every layer, and the input side of those after the first.
    hidden: Vec<Panels>,
    input: Vec<Panels>,
    /// Output rows by field, in the order of [`Field::ALL`].
    heads: Vec<Panels>,
}

impl Decoder {
    pub(super) fn new(weights: &WeightReader<'_>) -> Result<Self, ModelError> {
        let network = weights.network;
        let c = network.config().width;
        let layers = 0..network.config().gru_layers;
        // Multiplied out once, so in full precision.
        let exact = WeightReader {
            precision: gump_kernels::panels::Precision::F32,
            ..*weights
        };
        let first = exact.linear("decoder.gru.0.input", c)?;
        let weight = exact.get("decoder.gru.0.input.weight")?;
        let unbiased = Panels::new(&weight, c, None, exact.precision);
        let gates = |panels: &Panels, x: &[f32]| {
            let mut y = vec![0.0; 3 * x.len()];
            let step = 64 * c;
            let pairs = x.par_chunks(step).zip(y.par_chunks_mut(3 * step));
            pairs.for_each(|(x, y)| panels.apply(x, y, &mut Scratch::default()));
            y
        };
        let table = network.decoder.input_table(&network.mct.token_table()?)?;
        let head = |field: &Field| {
            let rows = numbers(&network.decoder.output_rows(*field)?)?;
            Ok::<_, ModelError>(Panels::new(&rows, c, None, weights.precision))
        };
        Ok(Self {
            width: c,
            token_gates: gates(&unbiased, &numbers(&table)?),
            step_gates: gates(&first, &weights.get("decoder.slots")?),
            hidden: layers
                .clone()
                .map(|i| weights.linear(&format!("decoder.gru.{i}.hidden"), c))
                .collect::<Result<_, _>>()?,
            input: layers
                .skip(1)
                .map(|i| weights.linear(&format!("decoder.gru.{i}.input"), c))
                .collect::<Result<_, _>>()?,
            heads: Field::ALL.iter().map(head).collect::<Result<_, _>>()?,
        })
    }

    /// All its matrices.
    pub(super) fn matrices(&self) -> impl Iterator<Item = &Panels> {
        self.hidden.iter().chain(&self.input).chain(&self.heads)
    }

    /// One state per request, the first `n_steps` of its bins; `hidden` `[K, C]` are the hidden
    /// vectors at the keys.
    pub(super) fn sample(
        &self,
        hidden: &[f32],
        requests: &[&Request],
        config: &SamplingConfig,
        n_steps: usize,
        rooms: &Pool,
    ) -> Vec<Bins> {
        let mut bins = vec![[0; STEPS.len()]; requests.len()];
        let step = chunk_rows(requests.len());
        bins.par_chunks_mut(step)
            .zip(requests.par_chunks(step))
            .zip(hidden.par_chunks(step * self.width))
            .for_each(|((bins, requests), hidden)| {
                rooms.with(|room| self.sample_few(hidden, requests, (config, n_steps), bins, room));
            });
        bins
    }

    /// Number of multiplications in the first `n_steps` of decoding `n` objects whose first `given`
    /// fields are forced.
    pub(super) fn products(&self, n: usize, given: usize, n_steps: usize) -> u64 {
        let recurrent = self.hidden.iter().chain(&self.input);
        let recurrent: u64 = recurrent.map(|panels| panels.products(n)).sum();
        let heads = STEPS.iter().take(n_steps).skip(given);
        let heads: u64 = heads.map(|field| self.head(*field).products(n)).sum();
        recurrent * n_steps as u64 + heads
    }

    fn head(&self, field: Field) -> &Panels {
        let i = Field::ALL.iter().position(|f| *f == field);
        &self.heads[i.expect("all fields are listed")]
    }

    fn sample_few(
        &self,
        hidden: &[f32],
        requests: &[&Request],
        (config, n_steps): (&SamplingConfig, usize),
        bins: &mut [Bins],
        room: &mut Workspace,
    ) {
        let (n, c) = (requests.len(), self.width);
        let Workspace {
            buffers: [states, gates, input, logits],
            products,
            draws,
            ..
        } = room;
        // The state before the first step is the hidden vector in every layer.
        states.clear();
        (0..self.hidden.len()).for_each(|_| states.extend_from_slice(hidden));
        gates.resize(3 * n * c, 0.0);
        for (step, field) in STEPS.into_iter().enumerate().take(n_steps) {
            self.first_inputs(step, bins, input);
            for (layer, panels) in self.hidden.iter().enumerate() {
                let (below, state) = states.split_at_mut(layer * n * c);
                if layer > 0 {
                    let below = &below[(layer - 1) * n * c..];
                    self.input[layer - 1].apply(below, input, products);
                }
                let state = &mut state[..n * c];
                panels.apply(state, gates, products);
                wide(
                    #[inline(always)]
                    || {
                        let gates = input.chunks_exact(3 * c).zip(gates.chunks_exact(3 * c));
                        for ((x, g), h) in gates.zip(state.chunks_exact_mut(c)) {
                            gru_row(x, g, h);
                        }
                    },
                );
            }
            let chosen = requests.iter().all(|r| r.forced[step].is_some());
            if !chosen {
                logits.resize(n * field.n_bins(), 0.0);
                let output = &states[states.len() - n * c..];
                self.head(field).apply(output, logits, products);
            }
            let all_logits = logits.chunks_exact(field.n_bins());
            for (i, (bins, request)) in bins.iter_mut().zip(requests).enumerate() {
                bins[step] = match request.forced[step] {
                    Some(bin) => bin,
                    None => {
                        let logits = all_logits.clone().nth(i).expect("a row per request");
                        draw_field(logits, step, &bins[..], request, config, draws)
                    }
                };
            }
        }
    }

    /// The input side of the first layer's gates, `[n, 3C]`: of the step, and of the token before.
    fn first_inputs(&self, step: usize, bins: &[Bins], input: &mut Vec<f32>) {
        let width = 3 * self.width;
        let of_step = &self.step_gates[step * width..][..width];
        input.clear();
        for bins in bins {
            match step.checked_sub(1) {
                None => input.extend_from_slice(of_step),
                Some(before) => {
                    let token = STEPS[before].token(bins[before]);
                    debug_assert!(token < TABLE_ROWS);
                    let of_token = &self.token_gates[token as usize * width..][..width];
                    input.extend(of_step.iter().zip(of_token).map(|(a, b)| a + b));
                }
            }
        }
    }
}
