//! The road network for traffic: lanes with conflicts, crosswalks, signals, sidewalks, and paint.
//!
//! Coordinates are in the scene's own frame (centre at the origin); [`crate::map`] places it in the
//! world. [`Network::new`] builds a network; the traffic modules decide the right of way.

mod build;
mod conflict;
mod furniture;
mod leg;
mod lot;
mod sidewalk;
mod signal;

pub(crate) use lot::draw_slant;
pub(crate) use signal::Cycle;

use std::collections::BTreeSet;

use gump_geometry::{DVec2, Pose, wrap_angle};
use gump_scene::{AreaKind, LaneKind, RoadEdgeKind, RoadLineKind};

use crate::curve::Track;
use crate::plan::Control;

/// Index into [`Network::lanes`].
pub(crate) type LaneIdx = usize;

/// The built network.
#[derive(Debug, Default)]
pub(crate) struct Network {
    /// Lanes of roads first, then the connectors inside junctions.
    pub(crate) lanes: Vec<NetworkLane>,
    /// Junctions in the plan's order.
    pub(crate) junctions: Vec<Junction>,
    /// Crosswalks of all junctions.
    pub(crate) crosswalks: Vec<Crosswalk>,
    /// Lines along which pedestrians walk.
    pub(crate) walks: Vec<Walk>,
    /// Number of points where walks meet.
    pub(crate) n_walk_nodes: usize,
    /// Middles of parking strips, in the direction of the lane beside them.
    pub(crate) parking: Vec<Track>,
    /// Middles of strips where cars park at right angles, in the direction of the lane beside them.
    pub(crate) bays: Vec<Track>,
    /// Places of parking lots, as poses of parked cars.
    pub(crate) lot_places: Vec<Pose>,
    /// Features that are only drawn.
    pub(crate) furniture: Furniture,
    /// Whether the map states no speed limits, though vehicles comply with them.
    pub(crate) hides_limits: bool,
    /// Lanes that are not on the map, often those of car parks.
    pub(crate) unmapped: BTreeSet<LaneIdx>,
    /// Openings of car parks and yards to a road.
    pub(crate) mouths: Vec<Mouth>,
    /// Edges inside car parks and yards, as indices into [`Furniture::edges`].
    pub(crate) inner_edges: BTreeSet<usize>,
}

/// The opening of a car park or yard to a road.
#[derive(Clone, Debug)]
pub(crate) struct Mouth {
    /// The edges of its two corners, as indices into [`Furniture::edges`].
    pub(crate) corners: [usize; 2],
    /// The edge of the road as if there were no opening.
    pub(crate) curb: Vec<DVec2>,
}

impl Mouth {
    /// The middle of the curb; +y points away from the road.
    fn pose(&self) -> Pose {
        let curb = Track::through(&self.curb);
        let middle = curb.pose_at(curb.length() / 2.0);
        Pose {
            heading: wrap_angle(middle.heading + std::f64::consts::PI),
            ..middle
        }
    }
}

impl Network {
    /// Draws the edge of the road across all mouths, with a driveway like any other behind it, and
    /// forgets the edges inside: recorded maps have no more of most yards and car parks.
    /// `driveway` draws the surface for the pose of a curb.
    pub(crate) fn close_mouths(&mut self, mut driveway: impl FnMut(Pose) -> Vec<DVec2>) {
        let mut gone = std::mem::take(&mut self.inner_edges);
        let mouths = std::mem::take(&mut self.mouths);
        gone.extend(mouths.iter().flat_map(|mouth| mouth.corners));
        let edges = std::mem::take(&mut self.furniture.edges).into_iter();
        let kept = edges.enumerate().filter(|(i, _)| !gone.contains(i));
        self.furniture.edges = kept.map(|(_, edge)| edge).collect();
        for mouth in mouths {
            let surface = driveway(mouth.pose());
            self.furniture.areas.push((AreaKind::Driveway, surface));
            let edge = (RoadEdgeKind::Boundary, mouth.curb);
            self.furniture.edges.push(edge);
        }
    }
}

/// Curbs, paint and surfaces.
#[derive(Debug, Default)]
pub(crate) struct Furniture {
    /// Borders of the road, which lies on their left.
    pub(crate) edges: Vec<(RoadEdgeKind, Vec<DVec2>)>,
    /// Painted lines.
    pub(crate) lines: Vec<(RoadLineKind, Vec<DVec2>)>,
    /// Areas other than crosswalks.
    pub(crate) areas: Vec<(AreaKind, Vec<DVec2>)>,
    /// Surfaces vehicles may be on.
    pub(crate) drivable: Vec<Vec<DVec2>>,
    /// Stop signs: positions and the connectors they apply to.
    pub(crate) stop_signs: Vec<(DVec2, Vec<LaneIdx>)>,
}

/// The direction of a connector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Turn {
    Left,
    /// On, within about 35 degrees.
    Straight,
    Right,
}

/// A lane of a road, or a connector through a junction.
#[derive(Debug)]
pub(crate) struct NetworkLane {
    /// Centre line.
    pub(crate) track: Track,
    /// The centre line on the map, if it is not the track.
    pub(crate) drawn: Option<Vec<DVec2>>,
    /// Full width, metres.
    pub(crate) width: f64,
    /// Speed limit, metres per second.
    pub(crate) speed_limit: f64,
    /// Its use.
    pub(crate) kind: LaneKind,
    /// Lanes it leads to.
    pub(crate) successors: Vec<LaneIdx>,
    /// Lanes that lead here.
    pub(crate) predecessors: Vec<LaneIdx>,
    /// Neighbour of the same direction on the left.
    pub(crate) left: Option<LaneIdx>,
    /// Neighbour of the same direction on the right.
    pub(crate) right: Option<LaneIdx>,
    /// Starts at the border of the scene.
    pub(crate) is_entry: bool,
    /// Ends at the border of the scene.
    pub(crate) is_exit: bool,
    /// Part of the circle of a roundabout, connectors within it included.
    pub(crate) in_ring: bool,
    /// Set for connectors.
    pub(crate) connector: Option<Connector>,
    /// Highest speed at each sample of the track that its bends and those ahead on it allow,
    /// metres per second.
    pub(crate) bend_speeds: Vec<f64>,
    /// Arc lengths at which drivers slow down for a bump, metres.
    pub(crate) bumps: Vec<f64>,
    /// Lanes of the same junction whose surface this one shares.
    pub(crate) overlaps: Vec<Overlap>,
}

impl NetworkLane {
    /// Length, metres.
    pub(crate) fn length(&self) -> f64 {
        self.track.length()
    }

    /// True for bicycle lanes.
    pub(crate) fn is_bike_lane(&self) -> bool {
        self.kind == LaneKind::BikeLane
    }

    /// Ends inside the scene without a successor: traffic must leave it sideways.
    pub(crate) fn is_dead_end(&self) -> bool {
        self.successors.is_empty() && !self.is_exit
    }
}

/// Data of a lane that is a path through a junction. Vehicles wait for it at its start.
#[derive(Debug)]
pub(crate) struct Connector {
    pub(crate) junction: usize,
    /// The leg it comes from.
    pub(crate) from_leg: usize,
    /// Its direction.
    pub(crate) turn: Turn,
    /// Of two that conflict, the one with the higher rank goes first; equal ranks in order of
    /// arrival.
    pub(crate) rank: u8,
    /// Vehicles stop before they enter.
    pub(crate) must_stop: bool,
    /// Signal group, if there are lights.
    pub(crate) signal: Option<usize>,
    /// Connectors that cross or join this one.
    pub(crate) conflicts: Vec<Conflict>,
    /// Crosswalks on the path.
    pub(crate) crossings: Vec<Crossing>,
    /// Largest curvature, radians per metre.
    pub(crate) sharpest: f64,
}

/// A stretch of a connector that only one of two vehicles can use at a time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Conflict {
    /// The other connector.
    pub(crate) other: LaneIdx,
    /// Start and end on this connector, metres.
    pub(crate) mine: (f64, f64),
    /// Start and end on the other, metres.
    pub(crate) theirs: (f64, f64),
}

/// The intersection of a connector with a crosswalk.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Crossing {
    /// Index into [`Network::crosswalks`].
    pub(crate) crosswalk: usize,
    /// Start and end on the connector, metres.
    pub(crate) along: (f64, f64),
    /// Start and end on the crosswalk's walk, metres.
    pub(crate) across: (f64, f64),
}

/// A stretch on which a lane shares its surface with another.
#[derive(Debug)]
pub(crate) struct Overlap {
    /// The other lane.
    pub(crate) other: LaneIdx,
    /// Sample of this lane's track of the first entry of `at`.
    pub(crate) first: usize,
    /// Arc length on the other lane next to each sample; NaN where they are apart.
    pub(crate) at: Vec<f64>,
}

/// A junction.
#[derive(Debug)]
pub(crate) struct Junction {
    /// Its right-of-way rule.
    pub(crate) control: Control,
    /// Light phases, if it has lights.
    pub(crate) cycle: Option<Cycle>,
    pub(crate) connectors: Vec<LaneIdx>,
}

/// A marked crossing.
#[derive(Debug)]
pub(crate) struct Crosswalk {
    /// The junction it belongs to.
    pub(crate) junction: usize,
    /// The leg it spans.
    pub(crate) leg: usize,
    /// Its corners.
    pub(crate) ring: Vec<DVec2>,
    /// The part of its walk that is on the road, metres.
    pub(crate) on_road: (f64, f64),
    /// Connectors that pass it: the connector and the place in its list of crossings.
    pub(crate) passed_by: Vec<(LaneIdx, usize)>,
}

/// A line along which pedestrians walk, in both directions.
#[derive(Debug)]
pub(crate) struct Walk {
    /// The line.
    pub(crate) track: Track,
    /// The nodes at its ends.
    pub(crate) ends: [usize; 2],
    /// Set if it crosses the road.
    pub(crate) crosswalk: Option<usize>,
}
