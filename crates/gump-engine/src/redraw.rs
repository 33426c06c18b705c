//! Redraws of the sequence network's objects that would overlap others or leave the road.
//!
//! `rejection` decides which objects those are.

use std::borrow::Borrow;

use gump_model::decoder::Bins;
use gump_model::steps::TOKEN_DT;
use gump_scene::{AgentKind, AgentState};
use gump_tokenizer::{Field, QuantizedState};
use rayon::prelude::*;

use crate::partial_ar::Window;
use crate::rejection::{BRAKING, Footprints, Member, Way, way};
use crate::request::Request;
use crate::sampling::SamplingConfig;

/// Separates the streams of redraws from those of fields, which are few.
const REDRAW: u64 = 1 << 20;

/// The objects of some windows that have been drawn so far.
pub(crate) struct RejectionSampler<'a, W> {
    windows: &'a [W],
    config: &'a SamplingConfig,
    crowds: Vec<Footprints>,
}

impl<'a, W: Borrow<Window> + Sync> RejectionSampler<'a, W> {
    /// Nothing has been drawn yet.
    pub(crate) fn new(windows: &'a [W], config: &'a SamplingConfig) -> Self {
        Self {
            windows,
            config,
            crowds: windows.iter().map(|_| Footprints::default()).collect(),
        }
    }

    /// Redraws, up to `config.redraws` times, those of the objects added to `decoded` since the
    /// last call that are not clear; earlier ones stay. `draw` decodes the objects that it is
    /// given, each by its window and its index there.
    pub(crate) fn resolve<E>(
        &mut self,
        decoded: &mut [Vec<Bins>],
        mut draw: impl FnMut(&[(usize, usize)], &[Request]) -> Result<Vec<Bins>, E>,
    ) -> Result<(), E> {
        let Self {
            windows,
            config,
            crowds,
        } = self;
        if config.redraws == 0 {
            return Ok(());
        }
        let firsts: Vec<usize> = crowds.iter().map(|crowd| crowd.members.len()).collect();
        crowds
            .par_iter_mut()
            .zip(windows.par_iter())
            .zip(decoded.par_iter())
            .for_each(|((crowd, window), bins)| crowd.admit(window.borrow(), bins, config));
        for attempt in 0..config.redraws {
            let unclear = crowds.par_iter().enumerate().flat_map_iter(|(w, crowd)| {
                let unclear = crowd.unclear(firsts[w]);
                unclear.into_iter().map(move |i| (w, i))
            });
            let unclear: Vec<(usize, usize)> = unclear.collect();
            if unclear.is_empty() {
                return Ok(());
            }
            let again = |&(w, i): &(usize, usize)| {
                let request = windows[w].borrow().requests[i].clone();
                let stream = request.stream.fork(REDRAW + attempt as u64);
                Request { stream, ..request }
            };
            let requests: Vec<Request> = unclear.iter().map(again).collect();
            let draws = draw(&unclear, &requests)?;
            for ((&(w, i), request), bins) in unclear.iter().zip(&requests).zip(draws) {
                if crowds[w].improve(i, &foreseen(request, &bins, config)) {
                    decoded[w][i] = bins;
                }
            }
        }
        for ((w, crowd), decoded) in crowds.iter_mut().enumerate().zip(decoded) {
            for i in crowd.unclear(firsts[w]) {
                let request = &windows[w].borrow().requests[i];
                let Some(bins) = crowd.members[i].brake(request, &decoded[i]) else {
                    continue;
                };
                if crowd.improve(i, &foreseen(request, &bins, config)) {
                    decoded[i] = bins;
                }
            }
        }
        Ok(())
    }
}

/// The future positions of an object, scene frame.
fn foreseen(request: &Request, bins: &Bins, config: &SamplingConfig) -> Way {
    let poses = request.local_frame.poses(bins);
    let first = request.resolve(bins, config).pose;
    way(request.from(), [first, poses[1], poses[2]])
}

impl Member {
    /// The chunk of braking along the path of `bins`; `None` for an object that hardly moves.
    pub(crate) fn brake(&self, request: &Request, bins: &Bins) -> Option<Bins> {
        // Slower, it is a quarter of a metre in a step.
        let before = self.before.filter(|_| self.speed > 0.5)?;
        let poses = request.local_frame.poses(bins);
        let at = |s: f64| {
            let mut from = (before, 0.0);
            for pose in poses {
                let step = from.0.position.distance(pose.position);
                if s <= from.1 + step && step > 0.0 {
                    return from.0.interpolate(pose, (s - from.1) / step);
                }
                from = (pose, from.1 + step);
            }
            from.0
        };
        let stop = self.speed / BRAKING;
        let states = std::array::from_fn(|i| {
            let t = (TOKEN_DT * (i + 1) as f64).min(stop);
            let pose = at(self.speed * t - 0.5 * BRAKING * t * t);
            let velocity = pose.direction() * (self.speed - BRAKING * t).max(0.0);
            Some(AgentState { pose, velocity })
        });
        let braking = request.local_frame.bins(QuantizedState::default(), states);
        let sizes = 2;
        let bin = |i: usize| braking[i].filter(|_| i >= sizes).unwrap_or(bins[i]);
        Some(std::array::from_fn(bin))
    }
}

impl Footprints {
    /// Takes in the objects that `decoded` has more.
    fn admit(&mut self, window: &Window, decoded: &[Bins], config: &SamplingConfig) {
        let last = window.history.last();
        let of_last = |id: u16| -> Option<&QuantizedState> {
            let agent = last?.agents().find(|agent| agent.key.id == id)?;
            Some(&agent.state)
        };
        let members = window
            .next
            .tracked
            .iter()
            .zip(&window.requests)
            .zip(decoded)
            .skip(self.members.len());
        let member =
            |((agent, request), bins): ((&gump_tokenizer::TokenAgent, &Request), &Bins)| {
                let size = |field: Field| field.dequantize(agent.state.get(field));
                let (length, width) = (size(Field::Length), size(Field::Width));
                let last = of_last(agent.key.id);
                let mut member = Member::new(
                    [length, width],
                    request.from().or(last.map(QuantizedState::pose)),
                    last.map_or(0.0, |state| state.velocity().length()),
                    foreseen(request, bins, config),
                    request.forced[4].is_some(),
                );
                member.is_ignored = member.is_driven && !config.yields_to_driven;
                if agent.key.kind == AgentKind::Vehicle && !member.is_driven {
                    member.look_for_edges(&window.lane_map);
                }
                member
            };
        let new: Vec<Member> = members.map(member).collect();
        self.members.extend(new);
    }
}
