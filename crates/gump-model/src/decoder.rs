//! The state decoder: a GRU that turns the hidden vector at a key into the agent's state, field by
//! field.
//!
//! The sequence is width, length, v_x, v_y, then four poses x, y, θ half a second apart, the first
//! of which belongs to the key's frame. Each step sees the tokens before it.
//!
//! Shapes: `K` keys, `C` width, `N` bins of a field.

use std::ops::Range;

use candle_core::{Device, Result, Tensor};
use gump_nn::layers::{Linear, TABLE_DEVIATION, gru};
use gump_nn::ops;
use gump_nn::parameters::{Init, Scope};
use gump_tokenizer::Field;

use crate::ModelError;
use crate::config::ModelConfig;

/// Poses in a chunk: the frame itself and three more, half a second apart.
pub const CHUNK: usize = 4;

/// Steps that decode the first state; poses of later instants follow.
pub const STATE_STEPS: usize = 7;

/// The field decoded in each step.
pub const STEPS: [Field; 4 + 3 * CHUNK] = [
    Field::Width,
    Field::Length,
    Field::VelocityX,
    Field::VelocityY,
    Field::X,
    Field::Y,
    Field::Heading,
    Field::X,
    Field::Y,
    Field::Heading,
    Field::X,
    Field::Y,
    Field::Heading,
    Field::X,
    Field::Y,
    Field::Heading,
];

/// The decoded output for one object: a bin per step, in the object's local frame.
pub type Bins = [u16; STEPS.len()];

/// A stacked GRU with one slot embedding per step and one output matrix for all fields.
#[derive(Debug)]
pub struct StateDecoder {
    layers: Vec<GruLayer>,
    slots: Tensor,
    head: Linear,
    smooth: Option<SmoothBins>,
    /// Separate input rows for the decoder's own tokens, where they differ in meaning from the
    /// transformer's.
    table: Option<Tensor>,
}

/// Added to the rows of a field's bins, at input and output: a learned map of the bin's sines.
#[derive(Debug)]
struct SmoothBins {
    /// Per field in vocabulary order, [bins, 2k].
    sines: Vec<Tensor>,
    input: Vec<Linear>,
    output: Vec<Linear>,
}

/// Fields in the order of their tokens, without gaps from the first x to the last length.
const VOCABULARY_ORDER: [Field; 7] = [
    Field::X,
    Field::Y,
    Field::Heading,
    Field::VelocityX,
    Field::VelocityY,
    Field::Width,
    Field::Length,
];

/// Rows of a table that belong to the fields' bins.
fn field_rows() -> Range<usize> {
    let first = VOCABULARY_ORDER[0].first_token() as usize;
    let n: usize = VOCABULARY_ORDER.iter().map(|field| field.n_bins()).sum();
    first..first + n
}

impl SmoothBins {
    fn new(
        mut scope: Scope<'_>,
        width: usize,
        device: &Device,
    ) -> std::result::Result<Self, ModelError> {
        let k = width / (2 * Field::ALL.len());
        let mut map = |name: String| {
            Linear::with(
                &mut scope,
                &name,
                2 * k,
                width,
                Init::Normal(TABLE_DEVIATION),
                None,
            )
        };
        let mut smooth = Self {
            sines: Vec::new(),
            input: Vec::new(),
            output: Vec::new(),
        };
        for (i, field) in VOCABULARY_ORDER.into_iter().enumerate() {
            let sines = crate::embedding::field_sines(field, k);
            smooth
                .sines
                .push(Tensor::from_vec(sines, (field.n_bins(), 2 * k), device)?);
            smooth.input.push(map(format!("input.{i}"))?);
            smooth.output.push(map(format!("output.{i}"))?);
        }
        Ok(smooth)
    }

    /// `table` [TABLE_ROWS, C] with the maps added to the fields' rows.
    fn raise(&self, table: &Tensor) -> Result<Tensor> {
        let (rows, width) = table.dims2()?;
        let flat = |rows: usize| Tensor::zeros((rows, width), table.dtype(), table.device());
        let fields = field_rows();
        let mut parts = vec![flat(fields.start)?];
        for (sines, map) in self.sines.iter().zip(&self.input) {
            parts.push(map.forward(sines)?);
        }
        parts.push(flat(rows - fields.end)?);
        table + Tensor::cat(&parts, 0)?
    }

    /// Added to the rows of the output matrix for all fields, [all bins, C].
    fn outputs(&self) -> Result<Tensor> {
        let maps = self.output.iter().zip(&self.sines);
        let parts = maps.map(|(map, sines)| map.forward(sines));
        Tensor::cat(&parts.collect::<Result<Vec<_>>>()?, 0)
    }

    /// Rows of the output matrix for a field, [bins, C].
    fn output(&self, rows: &Tensor, field: Field) -> Result<Tensor> {
        let i = VOCABULARY_ORDER
            .iter()
            .position(|&f| f == field)
            .expect("every field is in order");
        rows + self.output[i].forward(&self.sines[i])?
    }
}

#[derive(Debug)]
struct GruLayer {
    input: Linear,
    hidden: Linear,
}

impl GruLayer {
    /// The states after each step, [S, K, C], from its inputs alike and the state before.
    fn states(&self, inputs: &Tensor, before: &Tensor) -> Result<Tensor> {
        gru(inputs, before, [&self.input, &self.hidden])
    }
}

impl StateDecoder {
    pub(crate) fn new(
        mut scope: Scope<'_>,
        config: &ModelConfig,
        device: &Device,
    ) -> std::result::Result<Self, ModelError> {
        let c = config.width;
        let smooth = if config.smooth_bins {
            Some(SmoothBins::new(scope.part("smooth"), c, device)?)
        } else {
            None
        };
        let layer = |i: usize, scope: &mut Scope<'_>| {
            let mut scope = scope.part(format!("gru.{i}"));
            Ok::<_, ModelError>(GruLayer {
                input: Linear::with(
                    &mut scope,
                    "input",
                    c,
                    3 * c,
                    Init::FanIn(c),
                    Some(Init::FanIn(c)),
                )?,
                hidden: Linear::with(
                    &mut scope,
                    "hidden",
                    c,
                    3 * c,
                    Init::FanIn(c),
                    Some(Init::FanIn(c)),
                )?,
            })
        };
        let rows = (gump_tokenizer::TABLE_ROWS as usize, c);
        let table = config
            .local_frame
            .then(|| scope.get("table", rows, Init::Normal(TABLE_DEVIATION)))
            .transpose()?;
        Ok(Self {
            smooth,
            table,
            layers: (0..config.gru_layers)
                .map(|i| layer(i, &mut scope))
                .collect::<std::result::Result<_, _>>()?,
            slots: scope.get("slots", (STEPS.len(), c), Init::Normal(TABLE_DEVIATION))?,
            head: Linear::with(
                &mut scope,
                "head",
                c,
                gump_tokenizer::TABLE_ROWS as usize,
                Init::FanIn(c),
                None,
            )?,
        })
    }

    /// The rows by which tokens enter the decoder, [TABLE_ROWS, C], from those of the transformer
    /// unless it has its own.
    pub fn input_table(&self, table: &Tensor) -> Result<Tensor> {
        let table = self.table.as_ref().unwrap_or(table);
        match &self.smooth {
            Some(smooth) => smooth.raise(table),
            None => table.contiguous(),
        }
    }

    /// Outputs of all steps with the true tokens as input.
    ///
    /// `hidden` [K, C]; `tokens` [STEPS, K], the token of each step (PAD where missing).
    /// Returns [STEPS, K, C].
    pub fn teacher_forced(
        &self,
        table: &Tensor,
        hidden: &Tensor,
        tokens: &Tensor,
    ) -> Result<Tensor> {
        let (k, c) = hidden.dims2()?;
        let n = STEPS.len();
        let previous = tokens.narrow(0, 0, n - 1)?.contiguous()?; // [STEPS - 1, K]
        let embedded = ops::embedding_sum(table, &previous.reshape(((n - 1) * k, 1))?)?;
        let embedded = embedded.reshape((n - 1, k, c))?.pad_with_zeros(0, 1, 0)?; // [STEPS, K, C]
        let mut inputs = embedded.broadcast_add(&self.slots.reshape((n, 1, c))?)?;
        for layer in &self.layers {
            inputs = layer.states(&inputs, hidden)?;
        }
        Ok(inputs)
    }

    /// The state before the first step: the hidden vector in every layer.
    pub fn begin(&self, hidden: &Tensor) -> Vec<Tensor> {
        vec![hidden.clone(); self.layers.len()]
    }

    /// One step: `previous` `[K]` are the tokens of the step before, none at step 0. Returns the
    /// output, [K, C], for [`StateDecoder::logits`].
    pub fn step(
        &self,
        table: &Tensor,
        states: &mut [Tensor],
        step: usize,
        previous: Option<&Tensor>,
    ) -> Result<Tensor> {
        let (k, c) = states[0].dims2()?;
        let slot = self.slots.get(step)?.reshape((1, c))?;
        let mut input = match previous {
            Some(tokens) => table.index_select(tokens, 0)?.broadcast_add(&slot)?,
            None => slot.broadcast_as((k, c))?.contiguous()?,
        };
        for (layer, state) in self.layers.iter().zip(states) {
            *state = layer.states(&input.unsqueeze(0)?, state)?.squeeze(0)?;
            input = state.clone();
        }
        Ok(input)
    }

    /// Logits over the bins of one field: only its rows of the shared output matrix are multiplied,
    /// which is exact because no other bins may be sampled.
    pub fn logits(&self, output: &Tensor, field: Field) -> Result<Tensor> {
        ops::linear(output, &self.output_rows(field)?, None)
    }

    /// Rows of the output matrix for the bins of all fields, [all bins, C]; see
    /// [`StateDecoder::rows_of`].
    pub fn all_output_rows(&self) -> Result<Tensor> {
        let fields = field_rows();
        let rows = ops::table_rows(self.head.weight(), fields.start, fields.len())?;
        match &self.smooth {
            Some(smooth) => rows + smooth.outputs()?,
            None => Ok(rows),
        }
    }

    /// With smooth bins the sine features of every field's bins, in the order of their tokens;
    /// otherwise nothing.
    pub(crate) fn bin_sines(&self) -> &[Tensor] {
        self.smooth.as_ref().map_or(&[], |smooth| &smooth.sines)
    }

    /// Returns the rows of [`StateDecoder::all_output_rows`] that are the bins of a field.
    pub fn rows_of(field: Field) -> Range<usize> {
        let first = field.first_token() as usize - field_rows().start;
        first..first + field.n_bins()
    }

    /// Rows of the output matrix for the bins of a field, [bins, C].
    pub fn output_rows(&self, field: Field) -> Result<Tensor> {
        let rows = self
            .head
            .weight()
            .narrow(0, field.first_token() as usize, field.n_bins())?;
        match &self.smooth {
            Some(smooth) => smooth.output(&rows, field),
            None => Ok(rows),
        }
    }

    /// Logits over the successors of a control or value token: the 321 keys, then BEGIN, NEWBORN
    /// and LIGHTS_END; [N, 324].
    pub fn control_logits(&self, hidden: &Tensor) -> Result<Tensor> {
        let weight = self.head.weight();
        let keys = ops::table_rows(weight, 0, CONTROL_KEYS)?;
        let specials = ops::table_rows(weight, gump_tokenizer::BEGIN as usize, 3)?;
        ops::linear(hidden, &Tensor::cat(&[&keys, &specials], 0)?, None)
    }

    /// Logits over the state of the light that follows a BEGIN or a light, in the order of their
    /// tokens; [N, 4].
    pub fn light_logits(&self, hidden: &Tensor) -> Result<Tensor> {
        let first = gump_tokenizer::FIRST_LIGHT as usize;
        ops::linear(
            hidden,
            &ops::table_rows(self.head.weight(), first, N_LIGHT_STATES)?,
            None,
        )
    }
}

/// States of a light: green, yellow, red, unknown.
pub const N_LIGHT_STATES: usize = 4;

/// Keys in the control alphabet: the ego's and 320 agents'.
pub const CONTROL_KEYS: usize = 321;
