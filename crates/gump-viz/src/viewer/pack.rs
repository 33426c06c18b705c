//! Traffic and road in few bytes: quantised, differenced twice, written as variable-length
//! integers. The page unpacks them (`unpack.js`, which must change with this file).
//!
//! An unsigned integer is written in groups of seven bits, the lowest first, the top bit set on
//! all but the last; a signed one is zigzagged first (0, -1, 1, -2, ... become 0, 1, 2, 3, ...).
//! A line of integers is written as its second differences, as if two zeros went before it:
//! steady motion costs a byte per number and mostly the byte 0, which compresses well.

use std::f64::consts::TAU;

use gump_geometry::DVec2;
use gump_scene::{Agent, AgentId, Frame, LaneId, LightState};

/// Metres, and metres per second, per unit: a centimetre is less than a pixel.
pub(super) const CENTI: f64 = 0.01;
/// Headings per turn; a power of two, so that a full turn is a whole number of them. One is 0.04
/// degrees, 2 mm at the end of a long car.
pub(super) const HEADINGS: i64 = 8192;

/// The class of a map feature, which determines how it is drawn. The page knows classes by number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Class {
    Surface = 0,
    Lane = 1,
    Route = 2,
    Crosswalk = 3,
    SpeedBump = 4,
    StopLine = 5,
    BrokenWhite = 6,
    SolidWhite = 7,
    BrokenYellow = 8,
    SolidYellow = 9,
    Edge = 10,
    StopSign = 11,
    /// A lane that gets no chevrons.
    Turn = 12,
}

/// Bytes under construction; positions are relative to `origin`.
#[derive(Debug)]
pub(super) struct Packer {
    origin: DVec2,
    bytes: Vec<u8>,
}

impl Packer {
    pub(super) fn new(origin: DVec2) -> Self {
        let bytes = Vec::new();
        Self { origin, bytes }
    }

    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    pub(super) fn unsigned(&mut self, mut n: u64) {
        while n >= 0x80 {
            self.bytes.push(n as u8 | 0x80);
            n >>= 7;
        }
        self.bytes.push(n as u8);
    }

    pub(super) fn signed(&mut self, n: i64) {
        self.unsigned(((n << 1) ^ (n >> 63)) as u64);
    }

    pub(super) fn line(&mut self, numbers: impl Iterator<Item = i64>) {
        let (mut last, mut slope) = (0, 0);
        for n in numbers {
            self.signed(n - last - slope);
            (last, slope) = (n, n - last);
        }
    }

    /// A feature of the map: class, width in centimetres (0 where it has none), points.
    pub(super) fn feature(&mut self, class: Class, width: f64, points: &[DVec2]) {
        self.unsigned(class as u64);
        self.unsigned(units(width, CENTI).max(0) as u64);
        self.unsigned(points.len() as u64);
        let origin = self.origin;
        self.line(points.iter().map(|p| units(p.x - origin.x, CENTI)));
        self.line(points.iter().map(|p| units(p.y - origin.y, CENTI)));
    }

    /// One agent over all frames: the number of stretches without a gap, and for each the frames
    /// since the last, its length, then x, y, heading and speed.
    pub(super) fn track(&mut self, id: AgentId, frames: &[&Frame]) {
        let stretches = stretches(id, frames);
        self.unsigned(stretches.len() as u64);
        let mut end = 0;
        for (start, agents) in stretches {
            self.unsigned((start - end) as u64);
            self.unsigned(agents.len() as u64);
            end = start + agents.len();
            let origin = self.origin;
            let position = |a: &&Agent| a.state.pose.position - origin;
            self.line(agents.iter().map(|a| units(position(a).x, CENTI)));
            self.line(agents.iter().map(|a| units(position(a).y, CENTI)));
            self.line(unwound(agents.iter().map(|a| a.state.pose.heading)));
            self.line(agents.iter().map(|a| units(a.state.speed(), CENTI)));
        }
    }

    /// One light over all frames: the number of stretches of one colour, and for each its colour
    /// and length.
    pub(super) fn light(&mut self, lane: LaneId, frames: &[&Frame]) {
        let mut runs: Vec<(u64, u64)> = Vec::new();
        for frame in frames {
            let colour = frame.light(lane).map_or(0, |light| colour(light.state));
            match runs.last_mut() {
                Some((last, length)) if *last == colour => *length += 1,
                _ => runs.push((colour, 1)),
            }
        }
        self.unsigned(runs.len() as u64);
        for (colour, length) in runs {
            self.unsigned(colour);
            self.unsigned(length);
        }
    }
}

/// The number of `unit`s nearest to `x`.
pub(super) fn units(x: f64, unit: f64) -> i64 {
    (x / unit).round() as i64
}

/// The number of steps of a heading nearest to `radians`.
pub(super) fn heading_units(radians: f64) -> i64 {
    units(radians, TAU / HEADINGS as f64)
}

/// 0 is for a light that is not there.
pub(super) fn colour(state: LightState) -> u64 {
    match state {
        LightState::Green => 1,
        LightState::Yellow => 2,
        LightState::Red => 3,
        LightState::Unknown => 4,
    }
}

/// The frames in which the agent is there, as first frames and agents.
fn stretches<'f>(id: AgentId, frames: &[&'f Frame]) -> Vec<(usize, Vec<&'f Agent>)> {
    let mut stretches: Vec<(usize, Vec<&Agent>)> = Vec::new();
    for (i, frame) in frames.iter().enumerate() {
        let Some(agent) = frame.agent(id) else {
            continue;
        };
        match stretches.last_mut() {
            Some((start, agents)) if *start + agents.len() == i => agents.push(agent),
            _ => stretches.push((i, vec![agent])),
        }
    }
    stretches
}

/// Headings without jumps at half a turn, in units.
fn unwound(headings: impl Iterator<Item = f64>) -> impl Iterator<Item = i64> {
    let mut last: i64 = 0;
    headings.map(move |heading| {
        let turn = heading_units(heading) - last;
        last += (turn + HEADINGS / 2).rem_euclid(HEADINGS) - HEADINGS / 2;
        last
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use gump_geometry::dvec2;

    /// The page's way of reading, for [`Packer`]'s numbers.
    pub(in crate::viewer) struct Reader<'b>(pub(in crate::viewer) &'b [u8]);

    impl Reader<'_> {
        pub(in crate::viewer) fn unsigned(&mut self) -> u64 {
            let (mut n, mut shift) = (0, 0);
            loop {
                let (&byte, rest) = self.0.split_first().unwrap();
                self.0 = rest;
                n |= u64::from(byte & 0x7F) << shift;
                shift += 7;
                if byte < 0x80 {
                    return n;
                }
            }
        }

        fn line(&mut self, n: usize) -> Vec<i64> {
            let (mut last, mut slope) = (0, 0);
            let next = |_| {
                let zigzag = self.unsigned();
                slope += (zigzag >> 1) as i64 ^ -((zigzag & 1) as i64);
                last += slope;
                last
            };
            (0..n).map(next).collect()
        }

        /// x, y, heading, speed by frame; `None` where the agent is absent.
        pub(in crate::viewer) fn track(&mut self, n_frames: usize) -> Vec<Option<[f64; 4]>> {
            let mut states = Vec::new();
            for _ in 0..self.unsigned() {
                let (gap, n) = (self.unsigned() as usize, self.unsigned() as usize);
                states.resize(states.len() + gap, None);
                let [x, y, heading, speed] = [(); 4].map(|()| self.line(n));
                let radians = TAU / HEADINGS as f64;
                states.extend((0..n).map(|i| {
                    let [x, y, v] = [x[i], y[i], speed[i]].map(|n| n as f64 * CENTI);
                    Some([x, y, heading[i] as f64 * radians, v])
                }));
            }
            states.resize(n_frames, None);
            states
        }
    }

    #[test]
    fn integers_of_any_size_and_sign_come_back() {
        let mut packer = Packer::new(DVec2::ZERO);
        let numbers = [0, -1, 1, 63, 64, -65, 300, -1_000_000, 1 << 40, -(1 << 40)];
        packer.line(numbers.into_iter());
        let bytes = packer.into_bytes();
        let mut reader = Reader(&bytes);
        assert_eq!(reader.line(numbers.len()), numbers);
        assert!(reader.0.is_empty());
    }

    #[test]
    fn headings_do_not_jump_at_half_a_turn() {
        let headings = [3.1, -3.1, 3.1, 0.0, -1.0];
        let found: Vec<_> = unwound(headings.into_iter()).collect();
        for (&n, &heading) in found.iter().zip(&headings) {
            let error = gump_geometry::wrap_angle(n as f64 * TAU / HEADINGS as f64 - heading);
            assert!(
                error.abs() <= TAU / HEADINGS as f64 / 2.0 + 1e-12,
                "{error}"
            );
        }
        assert!(
            found
                .windows(2)
                .all(|w| (w[1] - w[0]).abs() <= HEADINGS / 2)
        );
    }

    #[test]
    fn a_feature_is_relative_to_the_origin() {
        let mut packer = Packer::new(dvec2(1e6, 4e6));
        let points = [dvec2(1e6 + 0.5, 4e6), dvec2(1e6 + 1.0, 4e6 - 2.0)];
        packer.feature(Class::Lane, 3.5, &points);
        let bytes = packer.into_bytes();
        let mut reader = Reader(&bytes);
        assert_eq!([(); 3].map(|()| reader.unsigned()), [1, 350, 2]);
        assert_eq!(
            (reader.line(2), reader.line(2)),
            (vec![50, 100], vec![0, -200])
        );
    }
}
