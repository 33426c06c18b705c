//! Plans of road networks: junctions, and roads with their cross-section.
//!
//! A plan has no lanes yet; [`crate::network`] adds them. The plans of the road families are in
//! [`crate::layout`].

use crate::curve::Track;

// Widths of these are common ones of streets, chosen by hand.
/// Metres between the outermost lane or parking strip and the curb.
const GUTTER: f64 = 0.4;
/// Width of a bicycle lane, metres.
pub(crate) const BIKE_LANE_WIDTH: f64 = 1.8;
/// Width of a strip of parked cars, metres.
pub(crate) const PARKING_WIDTH: f64 = 2.4;
/// Depth of a strip of cars parked at right angles to the road, metres.
pub(crate) const BAY_DEPTH: f64 = 5.8;

/// Junctions and the roads that join them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Plan {
    /// Junctions; roads refer to them by index.
    pub(crate) nodes: Vec<NodePlan>,
    /// Roads between junctions and the border of the scene.
    pub(crate) roads: Vec<RoadPlan>,
}

/// A place where roads meet.
#[derive(Clone, Debug)]
pub(crate) struct NodePlan {
    /// The right of way.
    pub(crate) control: Control,
    /// Whether every leg has a crosswalk.
    pub(crate) crosswalks: bool,
    /// Radius of the curb at the corners, metres.
    pub(crate) corner_radius: f64,
    /// Metres of every leg taken up by the junction even where no corner needs them.
    pub(crate) min_setback: f64,
}

/// The right-of-way rule of a junction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Control {
    /// No right-of-way rule: lanes join or end without crossing.
    Free,
    /// Traffic lights.
    Signals,
    /// All-way stop, first come first served.
    AllWayStop,
    /// Minor roads stop and give way.
    MinorStop,
    /// Minor roads give way without stopping.
    MinorYield,
}

/// A road from end to end with its cross-section.
#[derive(Clone, Debug)]
pub(crate) struct RoadPlan {
    /// The line between the directions, from the first end to the second.
    pub(crate) reference: Track,
    /// The junction at either end; `None` is the border of the scene.
    pub(crate) ends: [Option<usize>; 2],
    /// Lanes along the reference, right of it.
    pub(crate) forward: usize,
    /// Lanes against the reference, left of it.
    pub(crate) backward: usize,
    /// Width of a lane, metres.
    pub(crate) lane_width: f64,
    /// Width between the directions, metres.
    pub(crate) median: f64,
    /// Bicycle lanes beside the outermost lanes.
    pub(crate) bike_lanes: bool,
    /// Parking strips along the curbs.
    pub(crate) parking: bool,
    /// The strips lie within the outermost lanes, which are as wide as that takes.
    pub(crate) parks_in_lane: bool,
    /// Cars park at right angles to the road, as in car parks, instead of along it.
    pub(crate) bays: bool,
    /// Sidewalks beyond the curbs.
    pub(crate) sidewalks: bool,
    /// Metres per second.
    pub(crate) speed_limit: f64,
    /// Has priority over roads that are not major.
    pub(crate) major: bool,
    /// A grade-separated road.
    pub(crate) freeway: bool,
    /// Part of the circle of a roundabout.
    pub(crate) ring: bool,
}

/// Roads with a lower limit lie in car parks and yards, metres per second: their aisles have at
/// most 5.5 m/s, streets at least 8.
pub(crate) const CAR_PARK_SPEED: f64 = 6.0;

impl RoadPlan {
    /// Whether it lies in a car park or yard.
    pub(crate) fn is_inner(&self) -> bool {
        self.speed_limit < CAR_PARK_SPEED
    }

    /// Lanes in the direction `forward` (or against it).
    pub(crate) fn n_lanes(&self, forward: bool) -> usize {
        if forward { self.forward } else { self.backward }
    }

    /// Distance of the centre of lane `k` (0 is innermost) from the reference, metres.
    pub(crate) fn lane_offset(&self, k: usize) -> f64 {
        self.median / 2.0 + self.lane_width * (k as f64 + 0.5)
    }

    /// Distance of the outer border of the outermost lane from the reference, metres.
    pub(crate) fn lanes_half_width(&self, forward: bool) -> f64 {
        self.median / 2.0 + self.lane_width * self.n_lanes(forward) as f64
    }

    /// Distance of the bicycle lane's centre from the reference, metres.
    pub(crate) fn bike_offset(&self, forward: bool) -> f64 {
        self.lanes_half_width(forward) + BIKE_LANE_WIDTH / 2.0
    }

    /// Distance of the middle of the parking strip from the reference, metres.
    pub(crate) fn parking_offset(&self, forward: bool) -> f64 {
        self.half_width(forward) - GUTTER - self.parking_depth() / 2.0
    }

    /// Depth of parked cars from the curb, metres.
    fn parking_depth(&self) -> f64 {
        if self.bays { BAY_DEPTH } else { PARKING_WIDTH }
    }

    /// Distance of the curb from the reference on the side of one direction, metres.
    pub(crate) fn half_width(&self, forward: bool) -> f64 {
        let mut half = self.lanes_half_width(forward) + GUTTER;
        if self.n_lanes(forward) > 0 {
            half += if self.bike_lanes {
                BIKE_LANE_WIDTH
            } else {
                0.0
            };
            half += if self.parking && !self.parks_in_lane {
                self.parking_depth()
            } else {
                0.0
            };
        }
        half
    }
}
