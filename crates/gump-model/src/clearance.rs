//! Drawing again where objects would run into each other or off the road.
//!
//! Objects of a frame are drawn independently, given surrogates of each other, so two of them may
//! choose the same place. Who would overlap another within the next second and a half is drawn
//! again, a few times at most, and the draw that stays clear longest is kept; so is a vehicle that
//! would cross the edge of the road. Who finds no clear way brakes, if that helps. In full
//! autoregression, objects give way to those drawn before them. The paper does
//! none of this; without it, chance alone makes collisions that no driver of the log would have had.

use std::borrow::Borrow;

use gump_geometry::{DVec2, OrientedBox, Pose};
use gump_scene::{AgentKind, AgentState};
use gump_tokenizer::{Field, QuantizedState};
use rayon::prelude::*;

use crate::decode::Window;
use crate::sample::TOKEN_DT;
use crate::sampling::{Bins, Request, SamplingConfig};
use crate::surroundings::Survey;

/// Poses of a chunk that must be clear: 1.5 s.
const POSES: usize = 3;
/// How hard a vehicle without a clear way brakes, metres per second squared: firmly, on a dry road.
const BRAKING: f64 = 5.0;
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
                if crowds[w].improve(i, foreseen(request, &bins, config)) {
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
                if crowd.improve(i, foreseen(request, &bins, config)) {
                    decoded[i] = bins;
                }
            }
        }
        Ok(())
    }
}

/// Where an object will be, scene frame.
fn foreseen(request: &Request, bins: &Bins, config: &SamplingConfig) -> [Pose; POSES] {
    let said = request.anchor.poses(bins);
    std::array::from_fn(|i| match i {
        0 => request.settle(bins, config).pose,
        i => said[i],
    })
}

/// The objects of a window.
#[derive(Default)]
struct Crowd {
    members: Vec<Member>,
}

struct Member {
    length: f64,
    width: f64,
    before: Option<Pose>,
    /// Metres per second, before.
    speed: f64,
    ahead: [Pose; POSES],
    /// The edges of the road that it must not cross, as points in reach.
    edges: Vec<DVec2>,
    /// Driven objects are where they are.
    is_driven: bool,
    reach: f64,
}

impl Member {
    fn at(&self, pose: Pose) -> OrientedBox {
        OrientedBox {
            pose,
            length: self.length,
            width: self.width,
        }
    }

    /// How many poses pass before the object crosses an edge of the road.
    fn poses_on_road(&self, ahead: &[Pose; POSES]) -> usize {
        let crosses = |pose: &Pose| self.covers(*pose, &self.edges);
        ahead.iter().position(crosses).unwrap_or(POSES)
    }

    fn covers(&self, pose: Pose, points: &[DVec2]) -> bool {
        let (half, scene) = (DVec2::new(self.length, self.width) / 2.0, pose.inverse());
        points
            .iter()
            .any(|point| (scene * *point).abs().cmplt(half).all())
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

    fn moves(&self) -> f64 {
        let before = self.before.map_or(self.ahead[0].position, |p| p.position);
        self.ahead[POSES - 1].position.distance(before)
    }
}

impl Crowd {
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
                let mut member = Member {
                    length,
                    width,
                    before: last.map(QuantizedState::pose),
                    speed: last.map_or(0.0, |state| state.velocity().length()),
                    ahead: foreseen(request, bins, config),
                    edges: Vec::new(),
                    is_driven: request.forced[4].is_some(),
                    reach: length.hypot(width) / 2.0,
                };
                if agent.key.kind == AgentKind::Vehicle && !member.is_driven {
                    member.edges = edges_in_reach(&member, &window.survey);
                }
                member
            };
        let new: Vec<Member> = members.map(member).collect();
        self.members.extend(new);
    }

    /// Who of those from `first` on should be drawn again: who leaves the road, and of two that get
    /// into each other's way the one that moves more, unless only the other may be.
    fn unclear(&self, first: usize) -> Vec<usize> {
        let leaves = |member: &Member| member.poses_on_road(&member.ahead) < POSES;
        let mut unclear: Vec<bool> = self.members.iter().map(leaves).collect();
        for (i, a) in self.members.iter().enumerate() {
            for (j, b) in self.members.iter().enumerate().skip(first.max(i + 1)) {
                if clear_poses(a, &a.ahead, b) == POSES {
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
    fn improve(&mut self, i: usize, ahead: [Pose; POSES]) -> bool {
        let member = &self.members[i];
        let clear = |ahead: &[Pose; POSES]| {
            let others = self.members.iter().enumerate().filter(|(j, _)| *j != i);
            let clear = others.map(|(_, other)| clear_poses(member, ahead, other));
            clear
                .min()
                .unwrap_or(POSES)
                .min(member.poses_on_road(ahead))
        };
        let better = clear(&ahead) > clear(&member.ahead);
        if better {
            self.members[i].ahead = ahead;
        }
        better
    }
}

/// The points of road edges that a vehicle might cross within the poses that are looked at; none
/// for one that is on an edge already.
fn edges_in_reach(member: &Member, survey: &Survey) -> Vec<DVec2> {
    let Some(before) = member.before else {
        return Vec::new();
    };
    let radius = member.reach + (member.moves() + 1.0).max(member.speed * 1.5);
    let near = survey.edges_near(before.position, radius);
    let edges: Vec<DVec2> = near
        .filter(|point| point.distance(before.position) <= radius)
        .collect();
    if member.covers(before, &edges) {
        return Vec::new();
    }
    edges
}

/// How many poses pass before two objects, the first of them on its way `ahead`, overlap; all of
/// them for a pair that overlaps already, since no draw can undo that.
fn clear_poses(a: &Member, ahead: &[Pose; POSES], b: &Member) -> usize {
    let reach = a.reach + b.reach;
    let meets = |(p, q): (&Pose, &Pose)| {
        p.position.distance_squared(q.position) < reach * reach && a.at(*p).overlaps(&b.at(*q))
    };
    let first = ahead.iter().zip(&b.ahead).position(meets);
    match (first, a.before.zip(b.before)) {
        (None, _) => POSES,
        (Some(_), Some((p, q))) if a.at(p).overlaps(&b.at(q)) => POSES,
        (Some(first), _) => first,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn member(x: f64, step: f64) -> Member {
        Member {
            length: 4.0,
            width: 2.0,
            before: Some(Pose::new(x, 0.0, 0.0)),
            speed: 2.0 * step,
            edges: Vec::new(),
            ahead: std::array::from_fn(|i| Pose::new(x + step * (i + 1) as f64, 0.0, 0.0)),
            is_driven: false,
            reach: 2.3,
        }
    }

    #[test]
    fn the_one_that_moves_is_drawn_again_and_keeps_the_clearest_draw() {
        let mut crowd = Crowd {
            members: vec![member(10.0, 0.0), member(0.0, 5.0), member(-20.0, 1.0)],
        };
        assert_eq!(crowd.unclear(0), [1]);
        // Into the other at the second pose: no better than before. At the third: better.
        assert!(!crowd.improve(1, member(0.0, 4.0).ahead));
        assert!(crowd.improve(1, member(0.0, 2.5).ahead));
        assert_eq!(crowd.unclear(0), [1]);
        assert!(crowd.improve(1, member(0.0, 1.0).ahead));
        assert!(crowd.unclear(0).is_empty());
    }

    #[test]
    fn the_driven_stay_and_those_that_overlap_already_are_left_alone() {
        let driven = Member {
            is_driven: true,
            ..member(0.0, 5.0)
        };
        let crowd = Crowd {
            members: vec![member(10.0, 0.0), driven],
        };
        assert_eq!(crowd.unclear(0), [0]);
        let yielding = Crowd {
            members: vec![member(0.0, 5.0), member(10.0, 0.0)],
        };
        // The first is settled, so the other must find another way.
        assert_eq!(
            (yielding.unclear(0), yielding.unclear(1)),
            (vec![0], vec![1])
        );
        let touching = Crowd {
            members: vec![member(3.0, 0.0), member(0.0, 1.0)],
        };
        assert!(touching.unclear(0).is_empty());
    }

    #[test]
    fn who_would_leave_the_road_is_drawn_again() {
        let edges = vec![DVec2::new(10.0, 0.5)];
        let leaving = Member {
            edges,
            ..member(0.0, 3.0)
        };
        let mut crowd = Crowd {
            members: vec![leaving],
        };
        // The nose passes the edge at the third pose.
        assert_eq!(
            crowd.members[0].poses_on_road(&crowd.members[0].ahead),
            POSES - 1
        );
        assert_eq!(crowd.unclear(0), [0]);
        assert!(!crowd.improve(0, member(0.0, 5.0).ahead));
        assert!(crowd.improve(0, member(0.0, 2.0).ahead));
        assert!(crowd.unclear(0).is_empty());
    }

    #[test]
    fn braking_stays_on_the_way_and_stops() {
        let request = Request {
            anchor: crate::anchor::Anchor::at(Pose::new(0.0, 0.0, 0.0)),
            forced: [None; crate::decoder::STEPS.len()],
            stream: gump_scene::Seed(0),
            near: None,
            ring: crate::aggregation::Ring::default(),
            limits: None,
            frame: 0,
            guide: None,
        };
        let arc = |i: usize| {
            let turn = 0.1 * (i + 1) as f64;
            let pose = Pose::new(40.0 * turn.sin(), 40.0 * (1.0 - turn.cos()), turn);
            Some(AgentState {
                pose,
                velocity: pose.direction() * 8.0,
            })
        };
        let said = request
            .anchor
            .bins(QuantizedState::default(), std::array::from_fn(arc));
        let said: Bins = said.map(|bin| bin.expect("all are within the grid"));
        let moving = Member {
            speed: 8.0,
            ..member(0.0, 4.0)
        };
        let braking = moving.brake(&request, &said).expect("it moves");
        let poses = request.anchor.poses(&braking);
        // 8 m/s and 5 m/s^2: 3.4 m after half a second, 6.4 m after 1.6 s for good.
        for (pose, s) in poses.iter().zip([3.375_f64, 5.5, 6.375, 6.4]) {
            let on_arc = DVec2::new(40.0 * (s / 40.0).sin(), 40.0 * (1.0 - (s / 40.0).cos()));
            assert!(pose.position.distance(on_arc) < 0.15, "{pose:?} {on_arc}");
        }
        let stands = Member {
            speed: 0.0,
            ..member(0.0, 0.0)
        };
        assert!(stands.brake(&request, &said).is_none());
    }
}
