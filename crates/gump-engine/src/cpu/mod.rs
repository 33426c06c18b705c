//! The engine: the network's forward pass and decoder without gradients, for CPUs.
//!
//! It covers everything between slots and sampled bins, over weights that are packed once.
//! Sequences of any lengths are computed together, row by row, without padding; keys and values of
//! the map exist once per scene; each sequence may have a [`KvCache`], whose tokens are not
//! computed again. The reference implementation is `mct`, which other devices run and tests compare
//! with. Start with [`Engine::run`].
//!
//! The arithmetic of a row does not depend on other rows, so a future does not depend on other
//! futures, the number of threads, or the content of a cache.
//!
//! Shapes: `R` new tokens of all sequences one after another, `C` width.

mod decoder;
mod embed;
mod kv_cache;
mod successor;
#[cfg(test)]
mod tests;
mod weights;

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use self::decoder::Decoder;
use self::embed::{Embedder, Ground};
pub use self::kv_cache::KvCache;
use self::kv_cache::{AttentionRoom, Heads, Pages, attend};
pub use self::successor::Successor;
use gump_kernels::gelu::gelu_row;
use gump_kernels::panels::{Panels, Precision, Scratch};
use gump_kernels::wide;
use gump_model::ModelError;
use gump_model::Network;
use gump_model::decoder::{Bins, STATE_STEPS, STEPS};
use gump_model::local_context::{LaneMap, LocalContext};
use gump_model::mct::VisualMemory;
use gump_model::placed_slot::PlacedSlot;

use self::successor::Successors;
use self::weights::{Attention, Layer, Mlp, Norm, WeightReader, numbers};
use crate::draw::Candidates;
use crate::request::Request;
use crate::sampling::SamplingConfig;

/// Number of new tokens that go through the layers together. Bounds the memory of a pass: 12 MB
/// for 128 channels. Not tuned.
const WAVE: usize = 8 * 1024;

/// A network with packed weights, ready to simulate on a CPU.
#[derive(Debug)]
pub struct Engine {
    width: usize,
    heads: Heads,
    embedder: Embedder,
    layers: Vec<Layer>,
    norm: Norm,
    decoder: Decoder,
    successors: Successors,
    rooms: Pool,
    waves: Pool<Wave>,
}

/// Data shared by all futures of a scene: the map's keys and values, and the map under objects.
#[derive(Debug, Default)]
pub struct SceneMemory {
    /// Visual tokens.
    n: usize,
    cross: Vec<Pages>,
    ground: Ground,
    lane_map: Arc<LaneMap>,
}

/// One sequence in a pass.
#[derive(Debug)]
pub struct Job<'a> {
    /// The whole sequence, including cached tokens.
    pub slots: &'a [PlacedSlot],
    /// The positions of requested hidden vectors, ascending and not empty; everything after the
    /// last is ignored.
    pub wanted: Vec<usize>,
    /// The map of its scene.
    pub memory: &'a SceneMemory,
    /// The cache. Tokens of the sequence in it are not computed again. New ones are added if `keep`
    /// is set; otherwise it is cleared.
    pub kv_cache: &'a mut KvCache,
    /// Whether the tokens read are cached.
    pub keep: bool,
}

/// The location of a row: its job within the wave, its place in the job's sequence.
type JobPosition = (usize, usize);

impl Engine {
    /// Packs the weights of a network.
    ///
    /// # Errors
    /// Errors of the tensor library.
    pub(crate) fn new(network: &Network, precision: Precision) -> Result<Self, ModelError> {
        let config = network.config();
        let c = config.width;
        let weights = WeightReader { network, precision };
        Ok(Self {
            width: c,
            heads: Heads::new(config.heads, c / config.heads, precision),
            embedder: Embedder::new(&weights)?,
            layers: (0..config.layers)
                .map(|i| Layer::new(&weights, i, c))
                .collect::<Result<_, _>>()?,
            norm: weights.norm("mct.norm")?,
            decoder: Decoder::new(&weights)?,
            successors: Successors::new(&weights)?,
            rooms: Pool::default(),
            waves: Pool::default(),
        })
    }

    /// Numbers of a hidden vector.
    pub(crate) fn width(&self) -> usize {
        self.width
    }

    /// Bytes of the packed matrices of transformer and decoder.
    pub(crate) fn weight_bytes(&self) -> usize {
        let matrices = self.layers.iter().flat_map(Layer::matrices);
        let matrices = matrices.chain(self.decoder.matrices());
        matrices.map(Panels::bytes).sum()
    }

    /// Converts the memory of one scene to the engine's form.
    ///
    /// # Errors
    /// Errors of the tensor library.
    pub(crate) fn remember(&self, memory: &VisualMemory) -> Result<SceneMemory, ModelError> {
        let c = self.width;
        let pages = |(k, v): &(candle_core::Tensor, candle_core::Tensor)| {
            let (k, v) = (numbers(k)?, numbers(v)?);
            let mut pages = Pages::default();
            for (i, (k, v)) in k.chunks_exact(c).zip(v.chunks_exact(c)).enumerate() {
                pages.write(self.heads, i, &[k, v].concat());
            }
            Ok::<_, ModelError>(pages)
        };
        Ok(SceneMemory {
            n: memory.visual.dim(1)?,
            cross: memory
                .key_values
                .iter()
                .map(pages)
                .collect::<Result<_, _>>()?,
            ground: self.embedder.ground(&memory.visual)?,
            lane_map: memory.lane_maps.first().cloned().unwrap_or_default(),
        })
    }

    /// The hidden vectors requested by all jobs, one after another, `[wanted, C]`.
    pub fn run(&self, jobs: &mut [Job<'_>]) -> Vec<f32> {
        self.run_counted(jobs, &mut 0)
    }

    /// As [`Self::run`]; adds the number of multiplications.
    pub(crate) fn run_counted(&self, jobs: &mut [Job<'_>], products: &mut u64) -> Vec<f32> {
        let mut hidden = Vec::new();
        let mut rest = jobs;
        while !rest.is_empty() {
            let mut rows = 0;
            let n = rest.iter().take_while(|job| {
                let first = rows == 0;
                rows += job.slots.len();
                first || rows <= WAVE
            });
            let (wave, after) = rest.split_at_mut(n.count());
            hidden.extend(self.waves.with(|room| self.run_wave(wave, room, products)));
            rest = after;
        }
        hidden
    }

    /// One state per request; `hidden` `[K, C]` are the hidden vectors at the keys.
    pub(crate) fn sample(
        &self,
        hidden: &[f32],
        requests: &[&Request],
        config: &SamplingConfig,
    ) -> Vec<Bins> {
        // Widths and lengths are always given.
        self.decoder
            .sample(hidden, requests, config, STEPS.len(), &self.rooms)
    }

    /// Number of multiplications of [`Self::sample`] for `n` requests.
    pub(crate) fn products_of_samples(&self, n: usize) -> u64 {
        self.decoder.products(n, 2, STEPS.len())
    }

    /// As `Engine::sample`, but only the first state, including its size; later bins are 0.
    pub fn sample_state(
        &self,
        hidden: &[f32],
        requests: &[&Request],
        config: &SamplingConfig,
    ) -> Vec<Bins> {
        self.decoder
            .sample(hidden, requests, config, STATE_STEPS, &self.rooms)
    }

    /// Logits of the successors of the tokens whose hidden vectors `[N, C]` are given.
    pub fn successors(&self, hidden: &[f32]) -> Vec<Successor> {
        hidden
            .chunks_exact(self.width)
            .map(|hidden| self.successors.logits(hidden))
            .collect()
    }

    /// Number of multiplications of [`Self::successors`] for so many tokens.
    pub(crate) fn products_of_successors(&self, tokens: usize) -> u64 {
        self.successors.products(tokens)
    }

    fn run_wave(
        &self,
        jobs: &mut [Job<'_>],
        Wave { x, kv }: &mut Wave,
        products: &mut u64,
    ) -> Vec<f32> {
        let c = self.width;
        let mut rows: Vec<JobPosition> = Vec::new();
        let mut starts = Vec::with_capacity(jobs.len());
        for (i, job) in jobs.iter_mut().enumerate() {
            let end = job.wanted.last().map_or(0, |last| last + 1);
            job.slots = &job.slots[..end];
            let first = job.wanted.first().copied().unwrap_or(0);
            let start = job.kv_cache.reuse(job.slots, first);
            let n_layers = if job.keep || start > 0 {
                self.layers.len()
            } else {
                1
            };
            // What is not kept needs room for one layer at a time.
            job.kv_cache.layers.resize(n_layers, Pages::default());
            rows.extend((start..end).map(|place| (i, place)));
            starts.push(start);
        }
        let slots: Vec<&PlacedSlot> = rows.iter().map(|&(i, at)| &jobs[i].slots[at]).collect();
        let ground = |row: usize| &jobs[rows[row].0].memory.ground;
        *products += self.embedder.embed(&slots, ground, &self.rooms, x); // [R, C]
        *products += self.encode_local_context(jobs, &starts, x);
        kv.resize(2 * x.len(), 0.0); // [R, 2C]
        for (l, layer) in self.layers.iter().enumerate() {
            *products += layer.key_value.products(x.len() / c);
            self.keys_and_values(layer, x, kv);
            write_pages(self.heads, l, jobs, &starts, kv);
            if l + 1 == self.layers.len() {
                // Nothing after this reads but what is asked for.
                rows = self.keep_wanted(jobs, &starts, x);
            }
            *products += self.products_of_layer(layer, jobs, &rows);
            self.layer(l, layer, jobs, &rows, x);
        }
        for (job, start) in jobs.iter_mut().zip(starts) {
            if job.keep {
                job.kv_cache.slots.extend(&job.slots[start..]);
            } else {
                job.kv_cache.clear();
            }
        }
        let mut hidden = vec![0.0; rows.len() * c];
        self.norm.apply(x, &mut hidden);
        hidden
    }

    /// Adds the encoded local contexts to the rows of keys. Returns the number of multiplications.
    fn encode_local_context(&self, jobs: &[Job<'_>], starts: &[usize], x: &mut [f32]) -> u64 {
        let news = jobs
            .iter()
            .zip(starts)
            .map(|(job, start)| job.slots.len() - start);
        let firsts = news.scan(0, |next, n| Some(std::mem::replace(next, *next + n)));
        let firsts: Vec<usize> = firsts.collect();
        let seen = jobs
            .par_iter()
            .zip(starts)
            .zip(firsts)
            .map(|((job, &start), first)| {
                let rows = |(place, numbers)| (first + place - start, numbers);
                let seen = self
                    .embedder
                    .local_context(&job.memory.lane_map, job.slots, start);
                seen.into_iter().map(rows).collect::<Vec<_>>()
            });
        let seen: Vec<Vec<(usize, LocalContext)>> = seen.collect();
        self.embedder
            .add_local_context(&seen.concat(), &self.rooms, x)
    }

    /// Leaves of `x` only the rows that are asked for.
    fn keep_wanted(
        &self,
        jobs: &[Job<'_>],
        starts: &[usize],
        x: &mut Vec<f32>,
    ) -> Vec<JobPosition> {
        let (mut rows, mut first) = (Vec::new(), 0);
        for (i, (job, start)) in jobs.iter().zip(starts).enumerate() {
            for &place in &job.wanted {
                let row = (first + place - start) * self.width;
                // Rows only move to the front, so none is overwritten before it has moved.
                x.copy_within(row..row + self.width, rows.len() * self.width);
                rows.push((i, place));
            }
            first += job.slots.len() - start;
        }
        x.truncate(rows.len() * self.width);
        rows
    }

    fn keys_and_values(&self, layer: &Layer, x: &[f32], kv: &mut [f32]) {
        let c = self.width;
        let rows = x.len() / c;
        let step = chunk_rows(rows);
        x.par_chunks(step * c)
            .zip(kv.par_chunks_mut(2 * step * c))
            .for_each(|(x, kv)| {
                self.rooms.with(|room| {
                    let [normal, ..] = &mut room.buffers;
                    normal.resize(x.len(), 0.0);
                    layer.attention.norm.apply(x, normal);
                    layer.key_value.apply_to_few(normal, kv, &mut room.products);
                });
            });
    }

    /// Everything of a layer but its keys and values, in place; `x` holds `rows`.
    fn layer(
        &self,
        l: usize,
        layer: &Layer,
        jobs: &[Job<'_>],
        rows: &[JobPosition],
        x: &mut [f32],
    ) {
        let c = self.width;
        let own = |row: &JobPosition| {
            let kv_cache = &*jobs[row.0].kv_cache;
            let l = if kv_cache.layers.len() == 1 { 0 } else { l };
            (&kv_cache.layers[l], row.1 + 1)
        };
        let map = |row: &JobPosition| {
            let memory = jobs[row.0].memory;
            (&memory.cross[l / 3], memory.n)
        };
        let step = chunk_rows(rows.len());
        x.par_chunks_mut(step * c)
            .zip(rows.par_chunks(step))
            .for_each(|(x, rows)| {
                self.rooms.with(|room| {
                    self.attend(&layer.attention, rows, own, x, room);
                    mlp(&layer.mlp, c, x, room);
                    if let Some((attention, feed_forward)) = &layer.cross {
                        self.attend(attention, rows, map, x, room);
                        mlp(feed_forward, c, x, room);
                    }
                });
            });
    }

    /// Number of multiplications of [`Self::layer`].
    fn products_of_layer(&self, layer: &Layer, jobs: &[Job<'_>], rows: &[JobPosition]) -> u64 {
        let dense = layer.matrices().map(|panels| panels.products(rows.len()));
        let dense = dense.sum::<u64>() - layer.key_value.products(rows.len());
        let seen = |row: &JobPosition| {
            let map = layer.cross.as_ref().map_or(0, |_| jobs[row.0].memory.n);
            (row.1 + 1 + map) as u64
        };
        let attended = rows.iter().map(seen).sum::<u64>() * 2 * self.width as u64;
        dense + attended
    }

    /// `x += gate * out(attention(query(norm(x))))`, where `keys` returns the pages that a row
    /// attends to and the number of tokens it sees.
    fn attend<'a>(
        &self,
        attention: &Attention,
        rows: &[JobPosition],
        keys: impl Fn(&JobPosition) -> (&'a Pages, usize),
        x: &mut [f32],
        room: &mut Workspace,
    ) {
        let c = self.width;
        let [normal, q, attended, _] = &mut room.buffers;
        normal.resize(x.len(), 0.0);
        q.resize(x.len(), 0.0);
        attended.resize(x.len(), 0.0);
        attention.norm.apply(x, normal);
        attention.query.apply_to_few(normal, q, &mut room.products);
        let scale = 1.0 / (self.heads.channels() as f32).sqrt();
        q.iter_mut().for_each(|q| *q *= scale);
        let mut first = 0;
        for group in rows.chunk_by(|a, b| a.0 == b.0) {
            let (pages, _) = keys(&group[0]);
            let at = first * c..(first + group.len()) * c;
            let (q, out) = (&q[at.clone()], &mut attended[at]);
            let visible = |i: usize| keys(&group[i]).1;
            attend(self.heads, pages, q, visible, out, &mut room.attention);
            first += group.len();
        }
        attention
            .out
            .apply_to_few(attended, normal, &mut room.products);
        add_scaled(x, normal, attention.gate);
    }
}

/// `x += gate * contract(gelu(expand(norm(x))))`
fn mlp(mlp: &Mlp, c: usize, x: &mut [f32], room: &mut Workspace) {
    let [normal, hidden, ..] = &mut room.buffers;
    normal.resize(x.len(), 0.0);
    mlp.norm.apply(x, normal);
    hidden.resize(x.len() / c * mlp.expand.n_out(), 0.0);
    mlp.expand.apply_to_few(normal, hidden, &mut room.products);
    gelu_row(hidden);
    mlp.contract
        .apply_to_few(hidden, normal, &mut room.products);
    add_scaled(x, normal, mlp.gate);
}

fn add_scaled(x: &mut [f32], y: &[f32], scale: f32) {
    wide(
        #[inline(always)]
        || x.iter_mut().zip(y).for_each(|(x, y)| *x += scale * y),
    );
}

/// Hands every job its new keys and values in layer `l`.
fn write_pages(heads: Heads, l: usize, jobs: &mut [Job<'_>], starts: &[usize], kv: &[f32]) {
    let c = heads.width();
    let mut rest = kv;
    let mut parts = Vec::with_capacity(jobs.len());
    for (job, start) in jobs.iter_mut().zip(starts) {
        let (own, after) = rest.split_at((job.slots.len() - start) * 2 * c);
        rest = after;
        parts.push((&mut *job.kv_cache, *start, own));
    }
    parts.into_par_iter().for_each(|(kv_cache, start, kv)| {
        let l = if kv_cache.layers.len() == 1 { 0 } else { l };
        kv_cache.layers[l].write(heads, start, kv);
    });
}

/// Rows that one task takes through a layer: equal shares for all threads, as many as possible, for
/// every task reads all weights, but so few that what lies between two products stays in the
/// second-level cache.
fn chunk_rows(rows: usize) -> usize {
    const MOST: usize = 128;
    let each = rows.div_ceil(rayon::current_num_threads());
    let tasks = each.div_ceil(MOST).max(1);
    each.div_ceil(tasks).next_multiple_of(8).max(8)
}

/// Memory that one task works in.
#[derive(Debug, Default)]
pub(crate) struct Workspace {
    buffers: [Vec<f32>; 4],
    products: Scratch,
    attention: AttentionRoom,
    /// Candidates of a draw.
    draws: Candidates,
}

/// Memory that a wave works in: its vectors, `[R, C]`, and their keys and values, `[R, 2C]`.
#[derive(Debug, Default)]
struct Wave {
    x: Vec<f32>,
    kv: Vec<f32>,
}

/// Free workspaces; tasks return them, so that they are reused.
#[derive(Debug, Default)]
struct Pool<R = Workspace>(Mutex<Vec<R>>);

impl<R: Default> Pool<R> {
    fn with<T>(&self, work: impl FnOnce(&mut R) -> T) -> T {
        let free = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut room = free().pop().unwrap_or_default();
        let done = work(&mut room);
        free().push(room);
        done
    }
}
