//! Partial autoregression: all objects of a frame are decoded in one pass, against provisional
//! states from earlier chunks. Full autoregression, one pass per object, is here as well.
//!
//! This module defines windows, their token sequences, and the order in which objects are decoded.
//! The arithmetic is in `cpu`, and in `reference` for other devices; `rollout_state` processes the
//! decoded states.

use std::convert::Infallible;
use std::sync::Arc;

use gump_model::decoder::Bins;
use gump_model::exact::ExactFrames;
use gump_model::local_context::LaneMap;
use gump_model::placed_slot::{PlacedSlot, place_exactly};
use gump_rollout::ProbeConfig;
use gump_tokenizer::{Slot, TokenFrame, TokenSequence};
use rayon::prelude::*;

use crate::EngineError;
use crate::counters::CountedEngine;
use crate::cpu::{Job, KvCache, SceneMemory};
use crate::predictive_samples::{ObjectDraws, requests};
use crate::redraw::RejectionSampler;
use crate::request::Request;
use crate::sampling::{CacheMode, Mode, SamplingConfig};

/// The known part of one future's next frame.
#[derive(Debug)]
pub(crate) struct Window {
    /// Index of its scene's memory.
    pub(crate) scene: usize,
    /// Final states, oldest first; the same frames as those of the future.
    pub(crate) history: Vec<Arc<TokenFrame>>,
    /// The same, not rounded.
    pub(crate) exact: ExactFrames,
    /// The frame to decode, with provisional states; the order of its tracked agents is the order
    /// of decoding.
    pub(crate) next: TokenFrame,
    /// Prediction of each tracked agent of `next`, before decoding.
    pub(crate) requests: Vec<Request>,
    /// The road of its scene.
    pub(crate) lane_map: Arc<LaneMap>,
}

/// The slots of a window, up to the last provisional value. If the window would be longer than
/// `block_size`, its oldest frames are dropped as a whole.
pub(crate) fn presented(
    window: &Window,
    block_size: usize,
) -> Result<Vec<PlacedSlot>, EngineError> {
    let mut room = block_size.saturating_sub(window.next.len_slots());
    let newest = window.history.iter().rev();
    let n = newest
        .take_while(|frame| {
            let fits = frame.len_slots() <= room;
            room = room.saturating_sub(frame.len_slots());
            fits
        })
        .count();
    let first = window.history.len() - n.max(1);
    let shown = window.history[first..].iter();
    let mut frames: Vec<TokenFrame> = shown.map(|frame| TokenFrame::clone(frame)).collect();
    frames[0] = std::mem::take(&mut frames[0]).into_first();
    frames.push(window.next.clone());
    let sequence = TokenSequence::new(Vec::new(), frames).map_err(EngineError::Grammar)?;
    let mut slots = place_exactly(&sequence, |frame, id| window.exact.of(first + frame, id));
    // The last frame's NEWBORN decides nothing yet.
    slots.truncate(
        slots
            .iter()
            .rposition(|placed| matches!(placed.slot, Slot::Value(_)))
            .map_or(0, |i| i + 1),
    );
    Ok(slots)
}

/// The windows of one step, in the engine.
pub(crate) struct Step<'a> {
    pub(crate) engine: &'a CountedEngine<'a>,
    pub(crate) sampling: &'a SamplingConfig,
    /// By scene.
    pub(crate) memories: &'a [&'a SceneMemory],
    pub(crate) windows: &'a [Window],
    /// Their slots, as [`presented`].
    pub(crate) placed: Vec<Vec<PlacedSlot>>,
    /// Settings of predictive samples.
    pub(crate) probe: ProbeConfig,
}

/// The decoded next frame of every window.
pub(crate) struct Decoded {
    /// One chunk of bins per tracked agent of every window.
    pub(crate) bins: Vec<Vec<Bins>>,
    /// Predictive samples, as far as requested.
    pub(crate) seen: Vec<ObjectDraws>,
}

impl Step<'_> {
    /// Decodes the next frame of every window; `kv_caches` are those of the windows.
    pub(crate) fn decode(self, kv_caches: &mut [&mut KvCache]) -> Decoded {
        match self.sampling.mode {
            Mode::PartialAr => self.all_at_once(kv_caches),
            Mode::FullAr => self.one_by_one(kv_caches),
        }
    }

    /// Draws predictive samples of an object, as many as requested; `hidden` is the vector at its
    /// key. They use separate streams, so the simulated draws do not change.
    fn look(&self, window: usize, place: usize, hidden: &[f32]) -> Option<ObjectDraws> {
        let request = &self.windows[window].requests[place];
        if window >= self.probe.futures || request.is_driven() {
            return None;
        }
        let requests: Vec<Request> = requests(self.probe, request).collect();
        let requests: Vec<&Request> = requests.iter().collect();
        let rows = hidden.repeat(requests.len());
        Some(ObjectDraws {
            window,
            place,
            bins: self.engine.sample(&rows, &requests, self.sampling),
        })
    }

    /// Partial autoregression: one pass with surrogates in place, then every key is decoded.
    fn all_at_once(&self, kv_caches: &mut [&mut KvCache]) -> Decoded {
        let keep = self.sampling.cache == CacheMode::Growing;
        let of_windows = self.windows.iter().zip(&self.placed).zip(kv_caches);
        let mut jobs: Vec<Job<'_>> = of_windows
            .map(|((window, slots), kv_cache)| {
                if self.sampling.cache == CacheMode::None {
                    kv_cache.clear();
                }
                let n = window.next.tracked.len();
                let first = slots.len() - 2 * n;
                Job {
                    slots,
                    wanted: (0..n).map(|i| first + 2 * i).collect(),
                    memory: self.memories[window.scene],
                    kv_cache,
                    keep,
                }
            })
            .collect();
        let hidden = self.engine.run(&mut jobs);
        let requests: Vec<&Request> = self.windows.iter().flat_map(|w| &w.requests).collect();
        let bins = self.engine.sample(&hidden, &requests, self.sampling);
        let mut bins = bins.into_iter();
        let each = self.windows.iter().map(|w| w.next.tracked.len());
        let mut decoded: Vec<Vec<Bins>> = each
            .clone()
            .map(|n| bins.by_ref().take(n).collect())
            .collect();
        let c = self.engine.width();
        let firsts: Vec<usize> = each
            .scan(0, |next, n| Some(std::mem::replace(next, *next + n)))
            .collect();
        let again = |who: &[(usize, usize)], requests: &[Request]| {
            let rows = who
                .iter()
                .flat_map(|(w, i)| &hidden[(firsts[*w] + i) * c..][..c]);
            let rows: Vec<f32> = rows.copied().collect();
            let requests: Vec<&Request> = requests.iter().collect();
            Ok::<_, Infallible>(self.engine.sample(&rows, &requests, self.sampling))
        };
        let Ok(()) =
            RejectionSampler::new(self.windows, self.sampling).resolve(&mut decoded, again);
        let probed = self.windows.iter().take(self.probe.futures).enumerate();
        let probed =
            probed.flat_map(|(w, window)| (0..window.next.tracked.len()).map(move |i| (w, i)));
        let seen = probed.filter_map(|(w, i)| self.look(w, i, &hidden[(firsts[w] + i) * c..][..c]));
        Decoded {
            seen: seen.collect(),
            bins: decoded,
        }
    }

    /// Full autoregression: each object sees the final states of those before it. The windows
    /// advance in step, object by object; those with fewer objects finish earlier.
    fn one_by_one(mut self, kv_caches: &mut [&mut KvCache]) -> Decoded {
        let n = |i: usize| self.windows[i].next.tracked.len();
        let most = (0..self.windows.len()).map(n).max().unwrap_or(0);
        let mut decoded: Vec<Vec<Bins>> = vec![Vec::new(); self.windows.len()];
        let mut seen = Vec::new();
        let mut rejection_sampler = RejectionSampler::new(self.windows, self.sampling);
        for i in 0..most {
            let mut members = Vec::new();
            let mut jobs: Vec<Job<'_>> = Vec::new();
            let placed = self.placed.iter().zip(kv_caches.iter_mut()).enumerate();
            for (w, (slots, kv_cache)) in placed {
                let window = &self.windows[w];
                let n = window.next.tracked.len();
                if i >= n {
                    continue;
                }
                if self.sampling.cache == CacheMode::None {
                    kv_cache.clear();
                }
                members.push(w);
                jobs.push(Job {
                    slots,
                    wanted: vec![slots.len() - 2 * (n - i)],
                    memory: self.memories[window.scene],
                    kv_cache,
                    keep: self.sampling.cache != CacheMode::None,
                });
            }
            let hidden = self.engine.run(&mut jobs);
            let requests: Vec<&Request> = members
                .iter()
                .map(|w| &self.windows[*w].requests[i])
                .collect();
            let bins = self.engine.sample(&hidden, &requests, self.sampling);
            let rows = members.iter().zip(hidden.chunks(self.engine.width()));
            seen.extend(rows.filter_map(|(w, hidden)| self.look(*w, i, hidden)));
            for (w, bins) in members.iter().zip(bins) {
                decoded[*w].push(bins);
            }
            let again = |who: &[(usize, usize)], requests: &[Request]| {
                let row = |(w, _): &(usize, usize)| members.partition_point(|member| member < w);
                let c = self.engine.width();
                let rows = who.iter().flat_map(|who| &hidden[row(who) * c..][..c]);
                let rows: Vec<f32> = rows.copied().collect();
                let requests: Vec<&Request> = requests.iter().collect();
                Ok::<_, Infallible>(self.engine.sample(&rows, &requests, self.sampling))
            };
            let Ok(()) = rejection_sampler.resolve(&mut decoded, again);
            for (&w, request) in members.iter().zip(requests) {
                let bins = &decoded[w][i];
                let settled = request.resolve(bins, self.sampling);
                let slots = &mut self.placed[w];
                let value = slots.len() - 2 * (self.windows[w].next.tracked.len() - i) + 1;
                slots[value].slot = Slot::Value(request.settled_state(bins, settled));
                let like = slots[value - 1].exact;
                slots[value].exact = like.map(|like| like.with_state(settled));
            }
        }
        Decoded {
            bins: decoded,
            seen,
        }
    }
}

/// All windows as [`presented`].
pub(crate) fn present_all(
    windows: &[Window],
    block_size: usize,
) -> Result<Vec<Vec<PlacedSlot>>, EngineError> {
    windows
        .par_iter()
        .map(|window| presented(window, block_size))
        .collect()
}
