//! Compliance with the drivable area.

use gump_geometry::DVec2;
use gump_scene::MapGraph;

use super::history::SimulationHistory;
use super::lanes::{CornerLanes, Lanes, distance};
use gump_metrics::metres_off_road;

/// Tolerance for a corner outside the area, metres, exclusive.
///
/// Source: nuPlan's challenges; the paper's reinforcement learning allows nothing.
pub const TOLERANCE: f64 = 0.3;

/// Whether and where the ego left the drivable area.
#[derive(Clone, Debug, PartialEq)]
pub struct DrivableArea {
    /// 1 if no corner was ever outside by more than the tolerance, else 0.
    pub score: f64,
    /// Per sample, true if no corner was outside at all.
    pub inside: Vec<bool>,
}

/// Evaluates a drive; `followed` and `corners` are the lanes of its samples.
///
/// A corner on a lane is inside. Any other corner is outside by its distance to the drivable area
/// or to the followed lanes, whichever is less. On a map without any border nothing is outside.
///
/// Source: nuPlan's `drivable_area_compliance`.
pub fn drivable_area(
    drive: &SimulationHistory<'_>,
    followed: &[Lanes<'_>],
    corners: &[CornerLanes<'_>],
) -> DrivableArea {
    let mut inside = Vec::with_capacity(drive.samples.len());
    let mut violated = false;
    for ((sample, followed), corner_lanes) in drive.samples.iter().zip(followed).zip(corners) {
        let footprint = drive.footprint(sample);
        let z = ground(drive.map, footprint.pose.position);
        let mut all_inside = true;
        for (corner, lanes) in footprint.corners().into_iter().zip(corner_lanes) {
            if !lanes.is_empty() {
                continue;
            }
            let Some(off) = metres_off_road(drive.map, corner, z).filter(|off| *off > 0.0) else {
                continue;
            };
            all_inside = false;
            let near_route = || followed.iter().any(|l| distance(l, corner) < TOLERANCE);
            violated |= off >= TOLERANCE && !near_route();
        }
        inside.push(all_inside);
    }
    DrivableArea {
        score: f64::from(!violated),
        inside,
    }
}

/// Height of the road; needed only by maps with road edges above one another.
fn ground(map: &MapGraph, point: DVec2) -> f64 {
    if map.road_edges().is_empty() {
        0.0
    } else {
        map.elevation_at(point).unwrap_or_default()
    }
}
