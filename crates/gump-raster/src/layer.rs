//! The names of the layers and what each contains.

use std::fmt;
use std::str::FromStr;

/// One plane of a raster.
///
/// Lines are one pixel wide. "Surface" of a lane means its centre line widened to the lane's
/// width. Layers that the map has no data for are zero.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum Layer {
    /// Painted lines: 1.
    RoadLines,
    /// Borders of the drivable surface: 1.
    RoadEdge,
    /// Crosswalk polygons: 1.
    Crosswalk,
    /// Stop-line polygons, and a line across each lane that a stop sign applies to: 1.
    StopLine,
    /// Speed-bump polygons: 1.
    SpeedBump,
    /// Lane centre lines: 1.
    BaselinePaths,
    /// Cosine of the lane's direction in the raster frame, on its surface; signed, 0 off the lanes.
    LaneDirectionCos,
    /// Sine of the lane's direction in the raster frame, on its surface; signed, 0 off the lanes.
    LaneDirectionSin,
    /// Surfaces of the route's lanes, or the route's path where the map has none of them: 1.
    Route,
    /// Drivable polygons: 1.
    DrivableArea,
    /// Speed limit over 24 m/s, at most 1, on lane surfaces; a lane that states none has
    /// [`TYPICAL_SPEED_LIMIT`](gump_scene::TYPICAL_SPEED_LIMIT).
    SpeedLimit,
    /// Boxes of cones, barriers and other things that do not move by themselves, now: 1.
    StaticAgents,
    /// Signalled lanes: centre line and a disc at the start: 1.
    TrafficLightOccupancy,
    /// Signalled lanes, painted with the index of [`light_indices`](crate::light_indices) over 64,
    /// centred on the raster; beyond the last index nothing is painted.
    TrafficLightIndex,
    /// Signalled lanes whose light is red now: 1.
    TrafficLightRed,
    /// Signalled lanes whose light is yellow now: 1.
    TrafficLightYellow,
    /// Signalled lanes whose light is green now: 1.
    TrafficLightGreen,
    /// Forward coordinate of the pixel's centre over the half extent; signed.
    CoordinateX,
    /// Leftward coordinate of the pixel's centre over the half extent; signed.
    CoordinateY,
    /// The paper's road channel: surfaces of lanes and intersections 1, then stop lines,
    /// crosswalks and speed bumps 0.5 on top.
    Roadmap,
    /// The ego's box now: 1.
    Ego,
    /// The ego's speed over 24 m/s, at most 1: a constant plane.
    EgoSpeed,
    /// Boxes of moving agents other than the ego, now: 1.
    Agents,
    /// Boxes of moving agents other than the ego over the last two seconds, fading linearly with
    /// age from 1 now to 0.
    AgentHistory,
}

/// No layer has this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is not the name of a raster layer")]
pub struct UnknownLayer(pub String);

impl Layer {
    /// Every layer, in the order of declaration.
    pub const ALL: [Self; 24] = [
        Self::RoadLines,
        Self::RoadEdge,
        Self::Crosswalk,
        Self::StopLine,
        Self::SpeedBump,
        Self::BaselinePaths,
        Self::LaneDirectionCos,
        Self::LaneDirectionSin,
        Self::Route,
        Self::DrivableArea,
        Self::SpeedLimit,
        Self::StaticAgents,
        Self::TrafficLightOccupancy,
        Self::TrafficLightIndex,
        Self::TrafficLightRed,
        Self::TrafficLightYellow,
        Self::TrafficLightGreen,
        Self::CoordinateX,
        Self::CoordinateY,
        Self::Roadmap,
        Self::Ego,
        Self::EgoSpeed,
        Self::Agents,
        Self::AgentHistory,
    ];

    /// The name in configurations and reports, snake case.
    pub fn name(self) -> &'static str {
        match self {
            Self::RoadLines => "road_lines",
            Self::RoadEdge => "road_edge",
            Self::Crosswalk => "crosswalk",
            Self::StopLine => "stop_line",
            Self::SpeedBump => "speed_bump",
            Self::BaselinePaths => "baseline_paths",
            Self::LaneDirectionCos => "lane_direction_cos",
            Self::LaneDirectionSin => "lane_direction_sin",
            Self::Route => "route",
            Self::DrivableArea => "drivable_area",
            Self::SpeedLimit => "speed_limit",
            Self::StaticAgents => "static_agents",
            Self::TrafficLightOccupancy => "traffic_light_occupancy",
            Self::TrafficLightIndex => "traffic_light_index",
            Self::TrafficLightRed => "traffic_light_red",
            Self::TrafficLightYellow => "traffic_light_yellow",
            Self::TrafficLightGreen => "traffic_light_green",
            Self::CoordinateX => "coordinate_x",
            Self::CoordinateY => "coordinate_y",
            Self::Roadmap => "roadmap",
            Self::Ego => "ego",
            Self::EgoSpeed => "ego_speed",
            Self::Agents => "agents",
            Self::AgentHistory => "agent_history",
        }
    }

    /// True if the layer's values lie in [-1, 1] rather than [0, 1].
    pub fn is_signed(self) -> bool {
        matches!(
            self,
            Self::LaneDirectionCos | Self::LaneDirectionSin | Self::CoordinateX | Self::CoordinateY
        )
    }
}

impl fmt::Display for Layer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.name().fmt(f)
    }
}

impl FromStr for Layer {
    type Err = UnknownLayer;

    /// Finds a layer by name.
    ///
    /// # Errors
    /// [`UnknownLayer`] with the name.
    fn from_str(name: &str) -> Result<Self, UnknownLayer> {
        Self::ALL
            .into_iter()
            .find(|layer| layer.name() == name)
            .ok_or_else(|| UnknownLayer(name.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_found() {
        for (i, layer) in Layer::ALL.into_iter().enumerate() {
            assert_eq!(layer as usize, i, "ALL is in the order of declaration");
            assert_eq!(layer.name().parse(), Ok(layer));
        }
        assert_eq!(
            "roads".parse::<Layer>().unwrap_err().to_string(),
            "\"roads\" is not the name of a raster layer"
        );
    }
}
