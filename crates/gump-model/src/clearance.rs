//! Drawing again where objects would run into each other or off the road.
//!
//! Objects of a frame are drawn independently, given surrogates of each other, so two of them may
//! choose the same place. Who would overlap another within the next second and a half is drawn
//! again, a few times at most, and the draw that stays clear longest is kept; so is a vehicle that
//! would leave the road. What counts is the whole way, every tenth of a second, not the poses half a
//! second apart: at 10 m/s these are a car's length from each other, and crossing cars pass through
//! one another, thin borders between cars. Who is off the road may come back or stay as far off as it
//! is. Who finds no clear way brakes, if that helps. In full
//! autoregression, objects give way to those drawn before them. The paper does
//! none of this; without it, chance alone makes collisions that no driver of the log would have had.

#[cfg(test)]
mod tests;

use std::borrow::Borrow;

use gump_geometry::{OrientedBox, Pose, angle_difference};
use gump_scene::{AgentKind, AgentState};
use gump_tokenizer::{Field, QuantizedState};
use rayon::prelude::*;

use crate::decode::Window;
use crate::sample::TOKEN_DT;
use crate::sampling::{Bins, Request, SamplingConfig};
use crate::surroundings::{Edge, Survey, metres_across, metres_off};

/// Poses of a chunk that must be clear: 1.5 s.
pub(crate) const POSES: usize = 3;
/// Places that are looked at between two poses and at the second: every 0.1 s.
const PLACES: usize = 5;
/// A way, from 0.1 s on.
pub(crate) type Way = [Pose; POSES * PLACES];
/// What is over an edge by less than this is on the road, metres, and what is off it by so little more
/// than before is not farther off: bins and maps are no finer.
const SLACK_M: f64 = 0.05;
/// How hard a vehicle without a clear way brakes, metres per second squared: firmly, on a dry road.
pub(crate) const BRAKING: f64 = 5.0;
/// Separates the streams of redraws from those of fields.
const REDRAW: u64 = 1 << 20;

/// The objects of some windows as far as they have been drawn.
pub(crate) struct Clearance<'a, W> {
    windows: &'a [W],
    config: &'a SamplingConfig,
    crowds: Vec<Crowd>,
}

impl<'a, W: Borrow<Window> + Sync> Clearance<'a, W> {
    /// Nothing has been drawn yet.
    pub(crate) fn new(windows: &'a [W], config: &'a SamplingConfig) -> Self {
        Self {
            windows,
            config,
            crowds: windows.iter().map(|_| Crowd::default()).collect(),
        }
    }

    /// Draws again, up to `config.redraws` times, what is not clear among the objects of `decoded`
    /// that have come since the last call; those before them stay. `draw` decodes the objects that
    /// it is given, each by its window and its place there.
    pub(crate) fn settle<E>(
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

/// Where an object will be, scene frame.
fn foreseen(request: &Request, bins: &Bins, config: &SamplingConfig) -> Way {
    let said = request.anchor.poses(bins);
    let first = request.settle(bins, config).pose;
    way(request.from(), [first, said[1], said[2]])
}

/// The way through poses half a second apart; what comes from nowhere is at the first all along.
pub(crate) fn way(from: Option<Pose>, poses: [Pose; POSES]) -> Way {
    std::array::from_fn(|i| {
        let (to, step) = (i / PLACES, i % PLACES + 1);
        let from = match to {
            0 => from.unwrap_or(poses[0]),
            to => poses[to - 1],
        };
        from.interpolate(poses[to], step as f64 / PLACES as f64)
    })
}

/// Objects of a frame, with where they are going.
#[derive(Default)]
pub(crate) struct Crowd {
    members: Vec<Member>,
}

/// An object with where it is going.
pub(crate) struct Member {
    length: f64,
    width: f64,
    before: Option<Pose>,
    /// Metres per second, before.
    speed: f64,
    ahead: Way,
    /// The edges of the road in reach, beyond which it must not go; none for what is no vehicle.
    edges: Vec<Edge>,
    /// How far it was off the road before, metres.
    off: f64,
    /// Driven objects are where they are.
    is_driven: bool,
    reach: f64,
}

impl Member {
    /// What is of this length and width, metres, moves at `speed`, metres per second, and goes `ahead`;
    /// driven objects are where they are.
    pub(crate) fn new(
        [length, width]: [f64; 2],
        before: Option<Pose>,
        speed: f64,
        ahead: Way,
        is_driven: bool,
    ) -> Self {
        Self {
            length,
            width,
            before,
            speed,
            ahead,
            edges: Vec::new(),
            off: 0.0,
            is_driven,
            reach: length.hypot(width) / 2.0,
        }
    }

    fn at(&self, pose: Pose) -> OrientedBox {
        OrientedBox {
            pose,
            length: self.length,
            width: self.width,
        }
    }

    /// How many places pass before the object leaves the road, or is farther off it than it has been.
    fn places_on_road(&self, ahead: &Way) -> usize {
        if self.edges.is_empty() || self.stays(ahead) {
            return ahead.len();
        }
        let mut most = self.off;
        let leaves = |pose: &Pose| {
            let body = self.at(*pose);
            let off = match most > SLACK_M {
                true => metres_off(&body, self.reach, &self.edges),
                false => metres_across(&body, self.reach, &self.edges),
            };
            let leaves = off > most + SLACK_M;
            most = most.min(off);
            leaves
        };
        ahead.iter().position(leaves).unwrap_or(ahead.len())
    }

    /// True if a way leads nowhere.
    fn stays(&self, ahead: &Way) -> bool {
        let near = |pose: &Pose, before: Pose| {
            pose.position.distance(before.position) < SLACK_M / 2.0
                && angle_difference(pose.heading, before.heading).abs() < SLACK_M / 2.0
        };
        let stands = |before: Pose| ahead.iter().all(|pose| near(pose, before));
        self.before.is_some_and(stands)
    }

    /// The chunk of braking on the way that `bins` say; `None` for what hardly moves.
    fn brake(&self, request: &Request, bins: &Bins) -> Option<Bins> {
        let before = self.before.filter(|_| self.speed > 0.5)?;
        let said = request.anchor.poses(bins);
        let at = |s: f64| {
            let mut from = (before, 0.0);
            for pose in said {
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
        let braking = request.anchor.bins(QuantizedState::default(), states);
        let sizes = 2;
        let bin = |i: usize| braking[i].filter(|_| i >= sizes).unwrap_or(bins[i]);
        Some(std::array::from_fn(bin))
    }

    /// Takes in the edges of the road that it might cross on its way, and how far it is off the road.
    pub(crate) fn look_for_edges(&mut self, survey: &Survey) {
        let Some(before) = self.before else {
            return;
        };
        let radius = self.reach + (self.moves() + 1.0).max(self.speed * 1.5);
        let near = survey.edges_near(before.position, radius);
        self.edges = near
            .filter(|edge| edge.from.distance(before.position) <= radius)
            .collect();
        self.off = metres_off(&self.at(before), self.reach, &self.edges);
    }

    fn moves(&self) -> f64 {
        let before = self.before.map_or(self.ahead[0].position, |p| p.position);
        self.ahead[self.ahead.len() - 1].position.distance(before)
    }
}

impl Crowd {
    /// These objects.
    pub(crate) fn new(members: Vec<Member>) -> Self {
        Self { members }
    }

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
                if agent.key.kind == AgentKind::Vehicle && !member.is_driven {
                    member.look_for_edges(&window.survey);
                }
                member
            };
        let new: Vec<Member> = members.map(member).collect();
        self.members.extend(new);
    }

    /// Who of those from `first` on should be drawn again: who leaves the road, and of two that get
    /// into each other's way the one that moves more, unless only the other may be.
    pub(crate) fn unclear(&self, first: usize) -> Vec<usize> {
        let leaves = |member: &Member| member.places_on_road(&member.ahead) < member.ahead.len();
        let mut unclear: Vec<bool> = self.members.iter().map(leaves).collect();
        for (i, a) in self.members.iter().enumerate() {
            for (j, b) in self.members.iter().enumerate().skip(first.max(i + 1)) {
                if clear_places(a, &a.ahead, b) == a.ahead.len() {
                    continue;
                }
                let a_gives_way =
                    i >= first && (b.is_driven || (!a.is_driven && a.moves() > b.moves()));
                unclear[if a_gives_way { i } else { j }] = true;
            }
        }
        let driven = |i: &usize| self.members[*i].is_driven;
        (first..unclear.len())
            .filter(|i| unclear[*i] && !driven(i))
            .collect()
    }

    /// Takes a draw of an object if it stays clear of all others, and on the road, longer than what
    /// it has.
    pub(crate) fn improve(&mut self, i: usize, ahead: &Way) -> bool {
        let member = &self.members[i];
        let clear = |ahead: &Way| {
            let others = self.members.iter().enumerate().filter(|(j, _)| *j != i);
            let clear = others.map(|(_, other)| clear_places(member, ahead, other));
            let on_road = member.places_on_road(ahead);
            clear.fold(on_road, usize::min)
        };
        let better = clear(ahead) > clear(&member.ahead);
        if better {
            self.members[i].ahead = *ahead;
        }
        better
    }
}

/// How many places pass before two objects, the first of them on its way `ahead`, overlap; all of
/// them for a pair that overlaps already, since no draw can undo that.
fn clear_places(a: &Member, ahead: &Way, b: &Member) -> usize {
    let reach = a.reach + b.reach;
    let meets = |(p, q): (&Pose, &Pose)| {
        p.position.distance_squared(q.position) < reach * reach && a.at(*p).overlaps(&b.at(*q))
    };
    let first = ahead.iter().zip(&b.ahead).position(meets);
    match (first, a.before.zip(b.before)) {
        (None, _) => ahead.len(),
        (Some(_), Some((p, q))) if a.at(p).overlaps(&b.at(q)) => ahead.len(),
        (Some(first), _) => first,
    }
}
