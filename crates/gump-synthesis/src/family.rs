//! The kinds of road of a scene.

use std::fmt;

/// A kind of road network; its dimensions are drawn per scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum RoadFamily {
    /// Four legs, traffic lights.
    SignalizedCrossing,
    /// Four legs, stop signs at all of them or at the minor road.
    StopCrossing,
    /// Three legs under any control.
    TeeJunction,
    /// A one-lane circle that has priority over its three or four legs.
    Roundabout,
    /// Two or three lanes each way, traffic changes lanes.
    Arterial,
    /// One lane each way through bends.
    CurvedRoad,
    /// A ramp joins a one-way road of several lanes.
    OnRamp,
    /// A pedestrian crossing away from any junction.
    MidBlockCrosswalk,
    /// Four junctions around a block.
    Grid,
}

impl RoadFamily {
    /// Every family.
    pub const ALL: [Self; 9] = [
        Self::SignalizedCrossing,
        Self::StopCrossing,
        Self::TeeJunction,
        Self::Roundabout,
        Self::Arterial,
        Self::CurvedRoad,
        Self::OnRamp,
        Self::MidBlockCrosswalk,
        Self::Grid,
    ];

    /// A name for scenario ids and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::SignalizedCrossing => "signalized-crossing",
            Self::StopCrossing => "stop-crossing",
            Self::TeeJunction => "tee-junction",
            Self::Roundabout => "roundabout",
            Self::Arterial => "arterial",
            Self::CurvedRoad => "curved-road",
            Self::OnRamp => "on-ramp",
            Self::MidBlockCrosswalk => "mid-block-crosswalk",
            Self::Grid => "grid",
        }
    }
}

impl fmt::Display for RoadFamily {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
