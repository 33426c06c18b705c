//! Drawing again where objects would run into each other.
//!
//! Objects of a frame are drawn independently, given surrogates of each other, so two of them may
//! choose the same place. Who would overlap another within the next second and a half is drawn
//! again, a few times at most, and the draw that stays clear longest is kept. The paper does not;
//! without it, chance alone makes collisions that no driver of the log would have had.

use std::borrow::Borrow;

use gump_geometry::{OrientedBox, Pose};
use gump_tokenizer::{Field, QuantizedState};
use rayon::prelude::*;

use crate::decode::Window;
use crate::sampling::{Bins, Request, SamplingConfig};

/// Poses of a chunk that must be clear: 1.5 s.
const POSES: usize = 3;
/// Separates the streams of redraws from those of fields.
const REDRAW: u64 = 1 << 20;

/// Draws again, up to `config.redraws` times, what is not clear. `draw` decodes the objects that
/// it is given, each by its window and its place there.
pub(crate) fn redraw<E>(
    windows: &[impl Borrow<Window> + Sync],
    decoded: &mut [Vec<Bins>],
    config: &SamplingConfig,
    mut draw: impl FnMut(&[(usize, usize)], &[Request]) -> Result<Vec<Bins>, E>,
) -> Result<(), E> {
    if config.redraws == 0 {
        return Ok(());
    }
    let mut crowds: Vec<Crowd> = windows
        .par_iter()
        .zip(decoded.par_iter())
        .map(|(window, bins)| Crowd::new(window.borrow(), bins, config))
        .collect();
    for attempt in 0..config.redraws {
        let unclear = crowds.par_iter().enumerate().flat_map_iter(|(w, crowd)| {
            let unclear = crowd.unclear();
            unclear.into_iter().map(move |i| (w, i))
        });
        let unclear: Vec<(usize, usize)> = unclear.collect();
        if unclear.is_empty() {
            break;
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
    Ok(())
}

/// Where an object will be, scene frame.
fn foreseen(request: &Request, bins: &Bins, config: &SamplingConfig) -> [Pose; POSES] {
    let said = request.anchor.poses(bins);
    std::array::from_fn(|i| match i {
        0 => request.settle(bins, config),
        i => said[i],
    })
}

/// The objects of a window.
struct Crowd {
    members: Vec<Member>,
}

struct Member {
    length: f64,
    width: f64,
    before: Option<Pose>,
    ahead: [Pose; POSES],
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

    fn moves(&self) -> f64 {
        let before = self.before.map_or(self.ahead[0].position, |p| p.position);
        self.ahead[POSES - 1].position.distance(before)
    }
}

impl Crowd {
    fn new(window: &Window, decoded: &[Bins], config: &SamplingConfig) -> Self {
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
            .zip(decoded);
        let member =
            |((agent, request), bins): ((&gump_tokenizer::TokenAgent, &Request), &Bins)| {
                let size = |field: Field| field.dequantize(agent.state.get(field));
                let (length, width) = (size(Field::Length), size(Field::Width));
                Member {
                    length,
                    width,
                    before: of_last(agent.key.id).map(QuantizedState::pose),
                    ahead: foreseen(request, bins, config),
                    is_driven: request.forced[4].is_some(),
                    reach: length.hypot(width) / 2.0,
                }
            };
        Self {
            members: members.map(member).collect(),
        }
    }

    /// Who should be drawn again: of two that get into each other's way, the one that moves more.
    fn unclear(&self) -> Vec<usize> {
        let mut unclear = vec![false; self.members.len()];
        for (i, a) in self.members.iter().enumerate() {
            for (j, b) in self.members.iter().enumerate().skip(i + 1) {
                if clear_poses(a, &a.ahead, b) == POSES {
                    continue;
                }
                let a_gives_way = b.is_driven || (!a.is_driven && a.moves() > b.moves());
                unclear[if a_gives_way { i } else { j }] = true;
            }
        }
        let driven = |i: &usize| self.members[*i].is_driven;
        (0..unclear.len())
            .filter(|i| unclear[*i] && !driven(i))
            .collect()
    }

    /// Takes a draw of an object if it stays clear of all others longer than what it has.
    fn improve(&mut self, i: usize, ahead: [Pose; POSES]) -> bool {
        let member = &self.members[i];
        let clear = |ahead: &[Pose; POSES]| {
            let others = self.members.iter().enumerate().filter(|(j, _)| *j != i);
            let clear = others.map(|(_, other)| clear_poses(member, ahead, other));
            clear.min().unwrap_or(POSES)
        };
        let better = clear(&ahead) > clear(&member.ahead);
        if better {
            self.members[i].ahead = ahead;
        }
        better
    }
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
        assert_eq!(crowd.unclear(), [1]);
        // Into the other at the second pose: no better than before. At the third: better.
        assert!(!crowd.improve(1, member(0.0, 4.0).ahead));
        assert!(crowd.improve(1, member(0.0, 2.5).ahead));
        assert_eq!(crowd.unclear(), [1]);
        assert!(crowd.improve(1, member(0.0, 1.0).ahead));
        assert!(crowd.unclear().is_empty());
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
        assert_eq!(crowd.unclear(), [0]);
        let touching = Crowd {
            members: vec![member(3.0, 0.0), member(0.0, 1.0)],
        };
        assert!(touching.unclear().is_empty());
    }
}
