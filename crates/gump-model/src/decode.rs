//! From windows to states: full and partial autoregression over groups of like futures.
//!
//! All futures of a session go through the transformer as one batch; the map is read from a memory
//! that futures of one scene share.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};

use candle_core::Tensor;
use gump_tokenizer::{Slot, TokenFrame, TokenSequence};

use crate::ModelError;
use crate::batch::{PlacedSlot, place};
use crate::mct::{Cache, VisualMemory};
use crate::network::Network;
use crate::sampling::{
    Bins, CacheMode, Mode, Request, SamplingConfig, sample_states, settled_state,
};

/// What is known of one future's next frame.
#[derive(Debug)]
pub(crate) struct Window {
    /// Index of its scene's memory.
    pub(crate) scene: usize,
    /// Final states, oldest first.
    pub(crate) history: Vec<TokenFrame>,
    /// The frame to decode, with provisional states; the order of its tracked agents is the order
    /// of decoding.
    pub(crate) next: TokenFrame,
    /// One per tracked agent of `next`.
    pub(crate) requests: Vec<Request>,
}

/// Everything a transformer pass needs.
pub(crate) struct Passes<'a> {
    network: &'a Network,
    sampling: &'a SamplingConfig,
    memories: &'a [&'a VisualMemory],
    count: &'a AtomicU64,
}

impl<'a> Passes<'a> {
    pub(crate) fn new(
        network: &'a Network,
        sampling: &'a SamplingConfig,
        memories: &'a [&'a VisualMemory],
        count: &'a AtomicU64,
    ) -> Self {
        Self {
            network,
            sampling,
            memories,
            count,
        }
    }

    /// Hidden vectors [B, T, C] of new slots, after those in the cache if there is one.
    fn run(
        &self,
        slots: &[&[PlacedSlot]],
        memory: &VisualMemory,
        cache: Option<&mut Cache>,
    ) -> Result<Tensor, ModelError> {
        self.count.fetch_add(1, Ordering::Relaxed);
        let network = self.network;
        let batch = network.pack(slots)?;
        Ok(network.mct.forward(&batch, memory, cache, None)?.hidden)
    }

    /// The memory of a batch: shared where consecutive futures share a scene evenly, else repeated.
    fn memory(&self, scenes: &[usize]) -> Result<VisualMemory, ModelError> {
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
) -> Result<Vec<Vec<Bins>>, ModelError> {
    let block_size = passes.network.config().block_size;
    let placed: Vec<Vec<PlacedSlot>> = windows
        .iter()
        .map(|window| presented(window, block_size))
        .collect::<Result<_, _>>()?;
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

/// The slots of a window, up to the last provisional value. The oldest frames give way, whole, if
/// all together would be longer than `block_size`.
fn presented(window: &Window, block_size: usize) -> Result<Vec<PlacedSlot>, ModelError> {
    let mut room = block_size.saturating_sub(window.next.len_slots());
    let newest = window.history.iter().rev();
    let n = newest
        .take_while(|frame| {
            let fits = frame.len_slots() <= room;
            room = room.saturating_sub(frame.len_slots());
            fits
        })
        .count();
    let mut frames = window.history[window.history.len() - n.max(1)..].to_vec();
    frames[0] = std::mem::take(&mut frames[0]).into_first();
    frames.push(window.next.clone());
    let sequence = TokenSequence::new(Vec::new(), frames)
        .map_err(|error| ModelError::Scene(error.to_string()))?;
    let mut slots = place(&sequence);
    // The last frame's NEWBORN decides nothing yet.
    slots.truncate(
        slots
            .iter()
            .rposition(|placed| matches!(placed.slot, Slot::Value(_)))
            .map_or(0, |i| i + 1),
    );
    Ok(slots)
}

/// Windows that go through the transformer together.
struct Group<'a> {
    windows: Vec<&'a Window>,
    slots: Vec<&'a [PlacedSlot]>,
    memory: VisualMemory,
}

impl Group<'_> {
    /// Partial autoregression: one pass with surrogates in place, then every key is decoded.
    fn all_at_once(&self, passes: &Passes<'_>) -> Result<Vec<Vec<Bins>>, ModelError> {
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
        Ok(counts
            .into_iter()
            .map(|n| bins.by_ref().take(n).collect())
            .collect())
    }

    /// Full autoregression: each object sees the final states of those before it.
    fn one_by_one(&self, passes: &Passes<'_>) -> Result<Vec<Vec<Bins>>, ModelError> {
        let n = self.windows[0].next.tracked.len();
        let first = self.slots[0].len() - 2 * n;
        let mut cache = match passes.sampling.cache {
            CacheMode::None => None,
            CacheMode::Window => Some(Cache::new(passes.network.config().layers)),
        };
        let mut rows: Vec<Vec<PlacedSlot>> =
            self.slots.iter().map(|slots| slots.to_vec()).collect();
        let mut decoded = vec![Vec::with_capacity(n); rows.len()];
        for i in 0..n {
            let key = first + 2 * i;
            let from = cache.as_ref().map_or(0, Cache::len);
            let presented: Vec<&[PlacedSlot]> =
                rows.iter().map(|slots| &slots[from..=key]).collect();
            let hidden = passes.run(&presented, &self.memory, cache.as_mut())?;
            let at_key = hidden.narrow(1, key - from, 1)?.squeeze(1)?.contiguous()?; // [B, C]
            let requests: Vec<Request> =
                self.windows.iter().map(|w| w.requests[i].clone()).collect();
            let bins = sample_states(passes.network, &at_key, &requests, passes.sampling)?;
            for (row, bins) in bins.into_iter().enumerate() {
                let pose = requests[row].settle(&bins, passes.sampling);
                rows[row][key + 1].slot = Slot::Value(settled_state(&bins, pose));
                decoded[row].push(bins);
            }
        }
        Ok(decoded)
    }
}
