//! Surfaces that connectors share with each other and with crosswalks.

use crate::curve::Track;
use crate::network::leg::CROSSWALK_DEPTH;
use crate::network::{Conflict, Crossing, LaneIdx, Network, NetworkLane, Overlap};

/// Half the width that a car needs besides what it sweeps in a bend, metres: half of a van (2.2 m)
/// and 5 cm. Lorries are wider; they take gentle turns only.
const HALF_WIDTH: f64 = 1.15;
/// The same for a bicycle: half of the widest (1.05 m) and a little.
const BIKE_HALF_WIDTH: f64 = 0.55;
/// Length of a car, for the width it sweeps in a bend, metres: the longest of plain scenes has
/// 5.25.
const CAR_LENGTH: f64 = 5.4;
/// Metres that a conflict reaches beyond the shared surface: half of what lies between two samples.
const MARGIN: f64 = 0.5;

impl Network {
    /// Finds which connectors of each junction overlap, and which of those conflict. Connectors
    /// from the same lane overlap but do not conflict: vehicles on them follow each other.
    pub(crate) fn find_overlaps(&mut self) {
        for junction in 0..self.junctions.len() {
            let connectors = self.junctions[junction].connectors.clone();
            let half_widths: Vec<Vec<f64>> = connectors
                .iter()
                .map(|&lane| half_widths(&self.lanes[lane]))
                .collect();
            for i in 0..connectors.len() {
                for j in i + 1..connectors.len() {
                    let widths = [&half_widths[i][..], &half_widths[j][..]];
                    self.relate(connectors[i], connectors[j], widths);
                }
            }
        }
    }

    fn relate(&mut self, a: LaneIdx, b: LaneIdx, half_widths: [&[f64]; 2]) {
        let (ta, tb) = (&self.lanes[a].track, &self.lanes[b].track);
        let on_b = nearest_within(ta, tb, half_widths);
        if on_b.iter().all(|s| s.is_nan()) {
            return;
        }
        let on_a = nearest_within(tb, ta, [half_widths[1], half_widths[0]]);
        let zone = |track: &Track, at: &[f64]| {
            let first = at.iter().position(|s| !s.is_nan());
            let last = at.iter().rposition(|s| !s.is_nan());
            let at = |i: Option<usize>| i.map_or(0.0, |i| i as f64 * track.step());
            (at(first) - MARGIN, at(last) + MARGIN)
        };
        let (zone_a, zone_b) = (zone(ta, &on_b), zone(tb, &on_a));
        let same_origin = self.lanes[a].track.points()[0].distance(self.lanes[b].track.points()[0]);
        for (lane, other, at, mine, theirs) in
            [(a, b, on_b, zone_a, zone_b), (b, a, on_a, zone_b, zone_a)]
        {
            let first = at.iter().position(|s| !s.is_nan()).unwrap_or(0);
            let last = at.iter().rposition(|s| !s.is_nan()).unwrap_or(0);
            let at = at[first..=last.max(first)].to_vec();
            self.lanes[lane].overlaps.push(Overlap { other, first, at });
            if same_origin > 0.5
                && let Some(connector) = &mut self.lanes[lane].connector
            {
                connector.conflicts.push(Conflict {
                    other,
                    mine,
                    theirs,
                });
            }
        }
    }

    /// Finds where connectors pass the crosswalks of their junction.
    pub(crate) fn find_crossings(&mut self) {
        for index in 0..self.crosswalks.len() {
            let crosswalk = &self.crosswalks[index];
            let Some(walk) = self.walks.iter().find(|walk| walk.crosswalk == Some(index)) else {
                continue;
            };
            let (start, across) = (walk.track.pose_at(0.0), walk.track.length());
            let connectors = self.junctions[crosswalk.junction].connectors.clone();
            for lane in connectors {
                let track = &self.lanes[lane].track;
                let reach = CROSSWALK_DEPTH / 2.0 + 0.4;
                let inside: Vec<(f64, f64)> = track
                    .points()
                    .iter()
                    .enumerate()
                    .map(|(i, point)| (i as f64 * track.step(), start.inverse() * *point))
                    .filter(|(_, p)| p.y.abs() < reach + 0.5 && 0.0 < p.x && p.x < across)
                    .map(|(s, p)| (s, p.x))
                    .collect();
                let [Some(first), Some(last)] = [inside.first(), inside.last()] else {
                    continue;
                };
                let half = self.lanes[lane].width.min(2.6) / 2.0;
                let crossing = Crossing {
                    crosswalk: index,
                    along: (first.0 - 0.5, last.0 + 0.5),
                    across: (first.1.min(last.1) - half, first.1.max(last.1) + half),
                };
                if let Some(connector) = &mut self.lanes[lane].connector {
                    let place = connector.crossings.len();
                    connector.crossings.push(crossing);
                    self.crosswalks[index].passed_by.push((lane, place));
                }
            }
        }
    }
}

/// Half the width that a vehicle sweeps at each sample, metres.
fn half_widths(lane: &NetworkLane) -> Vec<f64> {
    let (half, length) = if lane.is_bike_lane() {
        (BIKE_HALF_WIDTH, 1.8)
    } else {
        (HALF_WIDTH, CAR_LENGTH)
    };
    let swept = |k: &f64| half + length * length / 8.0 * k.abs();
    lane.track.curvatures().iter().map(swept).collect()
}

/// For each sample of `a` the arc length of the nearest sample of `b`, or NaN if vehicles there
/// would not touch.
fn nearest_within(a: &Track, b: &Track, half_widths: [&[f64]; 2]) -> Vec<f64> {
    let near = |(i, p): (usize, &gump_geometry::DVec2)| {
        let mut best = (f64::INFINITY, f64::NAN);
        for (j, q) in b.points().iter().enumerate() {
            let gap = p.distance(*q) - half_widths[0][i] - half_widths[1][j];
            if gap < best.0 {
                best = (gap, j as f64 * b.step());
            }
        }
        if best.0 < 0.0 { best.1 } else { f64::NAN }
    };
    a.points().iter().enumerate().map(near).collect()
}
