//! Decoding of windows with the operations of the tensor library: used on devices other than a CPU,
//! and as the reference for tests of the engine.
//!
//! All windows of a session go through the transformer as one padded batch; futures of one scene
//! share the memory of its map. Keys and values are cached within a frame only: a growing window is
//! computed again, with the same result.

use std::collections::BTreeMap;

use candle_core::Tensor;
use gump_model::Network;
use gump_model::decoder::{Bins, STEPS};
use gump_model::mct::{Cache, VisualMemory};
use gump_model::placed_slot::PlacedSlot;
use gump_tokenizer::Slot;
use rayon::prelude::*;

use crate::EngineError;
use crate::draw::draw_field;
use crate::partial_ar::Window;
use crate::redraw::RejectionSampler;
use crate::request::Request;
use crate::sampling::{CacheMode, Mode, SamplingConfig};

/// The inputs of a transformer pass.
pub(crate) struct Passes<'a> {
    network: &'a Network,
    sampling: &'a SamplingConfig,
    memories: &'a [&'a VisualMemory],
    count: std::cell::Cell<u64>,
}

impl<'a> Passes<'a> {
    pub(crate) fn new(
        network: &'a Network,
        sampling: &'a SamplingConfig,
        memories: &'a [&'a VisualMemory],
    ) -> Self {
        Self {
            network,
            sampling,
            memories,
            count: 0.into(),
        }
    }

    /// Number of passes.
    pub(crate) fn count(&self) -> u64 {
        self.count.get()
    }

    /// Hidden vectors [B, T, C] of the slots that the cache, if there is one, does not hold.
    fn run(
        &self,
        slots: &[&[PlacedSlot]],
        memory: &VisualMemory,
        cache: Option<&mut Cache>,
    ) -> Result<Tensor, EngineError> {
        self.count.set(self.count.get() + 1);
        let network = self.network;
        let from = cache.as_ref().map_or(0, |cache| cache.len());
        let batch = network.pack(slots, from, memory)?;
        Ok(network.mct.forward(&batch, memory, cache, None)?.hidden)
    }

    /// The memory of a batch: shared where consecutive futures share a scene evenly, else repeated.
    fn memory(&self, scenes: &[usize]) -> Result<VisualMemory, EngineError> {
        let mut distinct: Vec<usize> = scenes.to_vec();
        distinct.dedup();
        let each = scenes.len() / distinct.len();
        let even = scenes.len().is_multiple_of(distinct.len())
            && scenes
                .chunks(each)
                .zip(&distinct)
                .all(|(chunk, scene)| chunk.iter().all(|s| s == scene));
        let order = if even { distinct } else { scenes.to_vec() };
        let parts: Vec<&VisualMemory> = order.iter().map(|&scene| self.memories[scene]).collect();
        Ok(VisualMemory::join(&parts)?)
    }
}

/// Decodes the next frame of every window: one chunk of bins per tracked agent.
pub(crate) fn decode(
    passes: &Passes<'_>,
    windows: &[Window],
    placed: &[Vec<PlacedSlot>],
) -> Result<Vec<Vec<Bins>>, EngineError> {
    // One pass for all: shorter windows are padded at their end. One by one, the end grows, so only
    // windows of one layout may go together.
    let mut groups: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
    for (i, (slots, window)) in placed.iter().zip(windows).enumerate() {
        let layout = match passes.sampling.mode {
            Mode::PartialAr => (0, 0),
            Mode::FullAr => (slots.len(), window.next.tracked.len()),
        };
        groups.entry(layout).or_default().push(i);
    }
    let mut decoded = vec![Vec::new(); windows.len()];
    for members in groups.into_values() {
        let group = Group {
            windows: members.iter().map(|&i| &windows[i]).collect(),
            slots: members.iter().map(|&i| placed[i].as_slice()).collect(),
            memory: passes.memory(
                &members
                    .iter()
                    .map(|&i| windows[i].scene)
                    .collect::<Vec<_>>(),
            )?,
        };
        let bins = match passes.sampling.mode {
            Mode::PartialAr => group.all_at_once(passes)?,
            Mode::FullAr => group.one_by_one(passes)?,
        };
        for (i, bins) in members.into_iter().zip(bins) {
            decoded[i] = bins;
        }
    }
    Ok(decoded)
}

/// Windows that go through the transformer together.
struct Group<'a> {
    windows: Vec<&'a Window>,
    slots: Vec<&'a [PlacedSlot]>,
    memory: VisualMemory,
}

impl Group<'_> {
    /// Partial autoregression: one pass with surrogates in place, then every key is decoded.
    fn all_at_once(&self, passes: &Passes<'_>) -> Result<Vec<Vec<Bins>>, EngineError> {
        let hidden = passes.run(&self.slots, &self.memory, None)?; // [B, T, C]
        let (b, t, c) = hidden.dims3()?;
        let counts: Vec<usize> = self.windows.iter().map(|w| w.next.tracked.len()).collect();
        let rows = self.slots.iter().zip(&counts).enumerate();
        let keys: Vec<u32> = rows
            .flat_map(|(row, (slots, &n))| {
                let first = row * t + slots.len() - 2 * n;
                (0..n).map(move |i| (first + 2 * i) as u32)
            })
            .collect();
        let flat = hidden.reshape((b * t, c))?;
        let keys = flat.index_select(&Tensor::new(keys, flat.device())?, 0)?; // [objects, C]
        let requests: Vec<Request> = self
            .windows
            .iter()
            .flat_map(|w| w.requests.iter().cloned())
            .collect();
        let mut bins =
            sample_states(passes.network, &keys, &requests, passes.sampling)?.into_iter();
        let mut decoded: Vec<Vec<Bins>> = counts
            .iter()
            .map(|&n| bins.by_ref().take(n).collect())
            .collect();
        let firsts: Vec<usize> = counts
            .iter()
            .scan(0, |next, n| Some(std::mem::replace(next, *next + n)))
            .collect();
        let mut rejection_sampler = RejectionSampler::new(&self.windows, passes.sampling);
        rejection_sampler.resolve(&mut decoded, |who, requests| {
            let rows = who.iter().map(|(w, i)| (firsts[*w] + i) as u32);
            let rows = Tensor::from_iter(rows, keys.device())?;
            let keys = keys.index_select(&rows, 0)?;
            sample_states(passes.network, &keys, requests, passes.sampling)
        })?;
        Ok(decoded)
    }

    /// Full autoregression: each object sees the final states of those before it.
    fn one_by_one(&self, passes: &Passes<'_>) -> Result<Vec<Vec<Bins>>, EngineError> {
        let n = self.windows[0].next.tracked.len();
        let first = self.slots[0].len() - 2 * n;
        let mut cache = match passes.sampling.cache {
            CacheMode::None => None,
            CacheMode::Window | CacheMode::Growing => {
                Some(Cache::new(passes.network.config().layers))
            }
        };
        let mut rows: Vec<Vec<PlacedSlot>> =
            self.slots.iter().map(|slots| slots.to_vec()).collect();
        let mut decoded = vec![Vec::with_capacity(n); rows.len()];
        let mut rejection_sampler = RejectionSampler::new(&self.windows, passes.sampling);
        for i in 0..n {
            let key = first + 2 * i;
            let from = cache.as_ref().map_or(0, Cache::len);
            let presented: Vec<&[PlacedSlot]> = rows.iter().map(|slots| &slots[..=key]).collect();
            let hidden = passes.run(&presented, &self.memory, cache.as_mut())?;
            let at_key = hidden.narrow(1, key - from, 1)?.squeeze(1)?.contiguous()?; // [B, C]
            let requests: Vec<Request> =
                self.windows.iter().map(|w| w.requests[i].clone()).collect();
            let bins = sample_states(passes.network, &at_key, &requests, passes.sampling)?;
            for (decoded, bins) in decoded.iter_mut().zip(bins) {
                decoded.push(bins);
            }
            rejection_sampler.resolve(&mut decoded, |who, requests| {
                let rows = who.iter().map(|(row, _)| *row as u32);
                let rows = Tensor::from_iter(rows, at_key.device())?;
                let at_key = at_key.index_select(&rows, 0)?;
                sample_states(passes.network, &at_key, requests, passes.sampling)
            })?;
            for ((row, decoded), request) in rows.iter_mut().zip(&decoded).zip(&requests) {
                let settled = request.resolve(&decoded[i], passes.sampling);
                row[key + 1].slot = Slot::Value(request.settled_state(&decoded[i], settled));
                row[key + 1].exact = row[key].exact.map(|like| like.with_state(settled));
            }
        }
        Ok(decoded)
    }
}

/// Decodes one state per request; `hidden` [K, C] are the hidden vectors at the keys.
pub(crate) fn sample_states(
    network: &Network,
    hidden: &Tensor,
    requests: &[Request],
    config: &SamplingConfig,
) -> Result<Vec<Bins>, EngineError> {
    let table = network.decoder.input_table(&network.mct.token_table()?)?;
    let mut states = network.decoder.begin(hidden);
    let mut bins = vec![[0; STEPS.len()]; requests.len()];
    let mut previous: Option<Tensor> = None;
    for (step, field) in STEPS.into_iter().enumerate() {
        let forced = requests
            .iter()
            .all(|request| request.forced[step].is_some());
        let output = network
            .decoder
            .step(&table, &mut states, step, previous.as_ref())?;
        if forced {
            bins.iter_mut()
                .zip(requests)
                .for_each(|(b, r)| b[step] = r.forced[step].unwrap_or_default());
        } else {
            let n = field.n_bins();
            let logits = network
                .decoder
                .logits(&output, field)?
                .flatten_all()?
                .to_vec1::<f32>()?;
            bins.par_iter_mut()
                .zip(requests)
                .zip(logits.par_chunks(n))
                .for_each_init(Vec::new, |room, ((bins, request), logits)| {
                    bins[step] = request.forced[step].unwrap_or_else(|| {
                        draw_field(logits, step, &bins[..], request, config, room)
                    });
                });
        }
        let tokens: Vec<u32> = bins.iter().map(|bins| field.token(bins[step])).collect();
        previous = Some(Tensor::from_vec(tokens, requests.len(), network.device())?);
    }
    Ok(bins)
}
