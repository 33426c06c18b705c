//! The ego's path through the lane graph.

use gump_geometry::Polyline;

use crate::{LaneId, RoadblockId};

/// Lanes to follow in order, and the path along their centres.
#[derive(Clone, Debug, PartialEq)]
pub struct Route {
    /// Lanes in driving order; each is a successor or a neighbour of the one before.
    pub lanes: Vec<LaneId>,
    /// The roadblocks that the format states, in driving order; empty where it states none. Repeats
    /// and gaps are kept as stated.
    pub roadblocks: Vec<RoadblockId>,
    /// The path itself, world frame, metres; starts at or behind the ego's present position.
    pub path: Polyline,
}
