//! The measures: names, definitions and bins.

/// A statistic of scenes. Rates and shares are fractions, other units are SI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum Statistic {
    /// Share of steps slower than 0.3 m/s.
    Standing,
    /// Share of tracks of at least two seconds that stay within 1 m of their first position.
    Parked,
    /// Of the parked tracks, the share more than 2 m from any lane centre.
    ParkedOffLane,
    /// Distance of parked tracks to the nearest lane centre, m.
    ParkedLaneDistance,
    /// Share of tracks that both stand and drive faster than 1 m/s.
    StopsAndGoes,
    /// Speed of moving agents, m/s.
    Speed,
    /// Share of the steps of moving agents that are slower than 3 m/s.
    Crawling,
    /// Acceleration along the heading of moving agents, m/s².
    Acceleration,
    /// Absolute yaw rate of moving agents, rad/s.
    YawRate,
    /// Change of speed within 4 s of agents from 1 to 4 m/s, m/s.
    SpeedChange1To4,
    /// Change of speed within 4 s of agents from 4 to 8 m/s, m/s.
    SpeedChange4To8,
    /// Change of speed within 4 s of agents from 8 to 12 m/s, m/s.
    SpeedChange8To12,
    /// Change of speed within 4 s of agents from 12 to 16 m/s, m/s.
    SpeedChange12To16,
    /// Change of speed within 4 s of agents from 16 to 22 m/s, m/s.
    SpeedChange16To22,
    /// Change of speed within 4 s of agents above 22 m/s, m/s.
    SpeedChangeAbove22,
    /// Absolute turn within 1 s of agents above 14 m/s, radians.
    FastTurn,
    /// Gap to the agent ahead in the same direction within 50 m, of agents on a lane, m.
    Gap,
    /// Time to where the agent ahead is now, seconds: that gap over the speed, of agents above 5 m/s whose
    /// leader is at least half as fast.
    Headway,
    /// Distance from a walking pedestrian to the nearest other one, centre to centre, at most 10 m.
    Company,
    /// Length of a track's box, m.
    Length,
    /// Width of a track's box, m.
    Width,
    /// Agents at the present.
    Agents,
    /// Agents within 60 m of the ego at the present.
    AgentsNear,
    /// Tracks over the whole scene.
    Tracks,
    /// Share of the scene's steps in which a track is present.
    Presence,
    /// Share of tracks that begin after the first step.
    BeginsLate,
    /// Share of tracks that end before the last step.
    EndsEarly,
    /// Share of tracks that are missing between two steps in which they are present.
    Interrupted,
    /// Movement of the box of a parked track per 0.1 s, m.
    Jitter,
    /// Rotation of the box of a parked track per 0.1 s, radians.
    HeadingJitter,
    /// Stated speed of parked tracks, m/s.
    ParkedSpeed,
    /// Share of moving agents within 3 m of the centre of a lane in their direction.
    OnLane,
    /// Distance from that centre, m.
    LateralOffset,
    /// Share of steps within a crosswalk, of pedestrians and bicycles.
    OnCrosswalk,
    /// Share of steps on a lane outside of crosswalks, of pedestrians and bicycles.
    OnRoad,
    /// Share of steps beside the road, of pedestrians and bicycles.
    Beside,
    /// Signed distance of the centre to the nearest road edge, m: negative on the road.
    EdgeDistance,
    /// Other agents within 10 m.
    Neighbours,
    /// Gap to the nearest other agent, m.
    Nearest,
    /// Distance from the ego, m.
    EgoDistance,
    /// Speed of the ego at the present, m/s.
    EgoSpeed,
    /// Share of egos that stand at the present.
    EgoStands,
    /// Lanes.
    Lanes,
    /// Kilometres of lanes.
    LaneKilometres,
    /// Intersections: groups of lanes in an intersection less than 25 m apart.
    Junctions,
    /// Share of lanes with a speed limit.
    LanesWithLimit,
    /// Lights at the present.
    Lights,
    /// Stop signs.
    StopSigns,
    /// Crosswalks.
    Crosswalks,
    /// Driveways.
    Driveways,
}

impl Statistic {
    /// Every measure.
    pub const ALL: [Self; 50] = [
        Self::Standing,
        Self::Parked,
        Self::ParkedOffLane,
        Self::ParkedLaneDistance,
        Self::StopsAndGoes,
        Self::Speed,
        Self::Crawling,
        Self::Acceleration,
        Self::YawRate,
        Self::SpeedChange1To4,
        Self::SpeedChange4To8,
        Self::SpeedChange8To12,
        Self::SpeedChange12To16,
        Self::SpeedChange16To22,
        Self::SpeedChangeAbove22,
        Self::FastTurn,
        Self::Gap,
        Self::Headway,
        Self::Company,
        Self::Length,
        Self::Width,
        Self::Agents,
        Self::AgentsNear,
        Self::Tracks,
        Self::Presence,
        Self::BeginsLate,
        Self::EndsEarly,
        Self::Interrupted,
        Self::Jitter,
        Self::HeadingJitter,
        Self::ParkedSpeed,
        Self::OnLane,
        Self::LateralOffset,
        Self::OnCrosswalk,
        Self::OnRoad,
        Self::Beside,
        Self::EdgeDistance,
        Self::Neighbours,
        Self::Nearest,
        Self::EgoDistance,
        Self::EgoSpeed,
        Self::EgoStands,
        Self::Lanes,
        Self::LaneKilometres,
        Self::Junctions,
        Self::LanesWithLimit,
        Self::Lights,
        Self::StopSigns,
        Self::Crosswalks,
        Self::Driveways,
    ];

    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Standing => "standing",
            Self::Parked => "parked",
            Self::ParkedOffLane => "parked_off_lane",
            Self::ParkedLaneDistance => "parked_lane_distance",
            Self::StopsAndGoes => "stops_and_goes",
            Self::Speed => "speed",
            Self::Crawling => "crawling",
            Self::Acceleration => "acceleration",
            Self::YawRate => "yaw_rate",
            Self::SpeedChange1To4 => "speed_change_1_to_4",
            Self::SpeedChange4To8 => "speed_change_4_to_8",
            Self::SpeedChange8To12 => "speed_change_8_to_12",
            Self::SpeedChange12To16 => "speed_change_12_to_16",
            Self::SpeedChange16To22 => "speed_change_16_to_22",
            Self::SpeedChangeAbove22 => "speed_change_above_22",
            Self::FastTurn => "fast_turn",
            Self::Gap => "gap",
            Self::Headway => "headway",
            Self::Company => "company",
            Self::Length => "length",
            Self::Width => "width",
            Self::Agents => "agents",
            Self::AgentsNear => "agents_near",
            Self::Tracks => "tracks",
            Self::Presence => "presence",
            Self::BeginsLate => "begins_late",
            Self::EndsEarly => "ends_early",
            Self::Interrupted => "interrupted",
            Self::Jitter => "jitter",
            Self::HeadingJitter => "heading_jitter",
            Self::ParkedSpeed => "parked_speed",
            Self::OnLane => "on_lane",
            Self::LateralOffset => "lateral_offset",
            Self::OnCrosswalk => "on_crosswalk",
            Self::OnRoad => "on_road",
            Self::Beside => "beside",
            Self::EdgeDistance => "edge_distance",
            Self::Neighbours => "neighbours",
            Self::Nearest => "nearest",
            Self::EgoDistance => "ego_distance",
            Self::EgoSpeed => "ego_speed",
            Self::EgoStands => "ego_stands",
            Self::Lanes => "lanes",
            Self::LaneKilometres => "lane_km",
            Self::Junctions => "junctions",
            Self::LanesWithLimit => "lanes_with_limit",
            Self::Lights => "lights",
            Self::StopSigns => "stop_signs",
            Self::Crosswalks => "crosswalks",
            Self::Driveways => "driveways",
        }
    }

    /// The measure with this name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|measure| measure.name() == name)
    }

    /// Lower and upper end of its bins, and their number. Shares have two bins: no and yes. Ranges
    /// are chosen by hand; stored targets have these bins.
    pub fn bins(self) -> (f64, f64, usize) {
        match self {
            Self::Standing
            | Self::Parked
            | Self::ParkedOffLane
            | Self::StopsAndGoes
            | Self::Crawling
            | Self::BeginsLate
            | Self::EndsEarly
            | Self::Interrupted
            | Self::OnLane
            | Self::OnCrosswalk
            | Self::OnRoad
            | Self::Beside
            | Self::EgoStands
            | Self::LanesWithLimit => (-0.5, 1.5, 2),
            Self::Speed | Self::EgoSpeed => (0.0, 30.0, 60),
            Self::Acceleration => (-6.0, 6.0, 60),
            Self::YawRate => (0.0, 1.0, 100),
            Self::SpeedChange1To4
            | Self::SpeedChange4To8
            | Self::SpeedChange8To12
            | Self::SpeedChange12To16
            | Self::SpeedChange16To22
            | Self::SpeedChangeAbove22 => (-20.0, 20.0, 80),
            Self::FastTurn => (0.0, 0.2, 80),
            Self::Gap => (0.0, 50.0, 50),
            Self::Headway | Self::Company => (0.0, 10.0, 100),
            Self::Length => (0.0, 16.0, 64),
            Self::Width => (0.0, 4.0, 40),
            Self::Agents | Self::AgentsNear | Self::Tracks => (0.0, 200.0, 50),
            Self::Presence => (0.0, 1.0, 20),
            Self::Jitter => (0.0, 0.1, 100),
            Self::HeadingJitter => (0.0, 0.5, 100),
            Self::ParkedSpeed => (0.0, 0.5, 50),
            Self::LateralOffset => (0.0, 3.0, 30),
            Self::ParkedLaneDistance => (0.0, 20.0, 40),
            Self::EdgeDistance => (-15.0, 25.0, 40),
            Self::Neighbours => (0.0, 25.0, 25),
            Self::Nearest => (0.0, 20.0, 40),
            Self::EgoDistance => (0.0, 150.0, 50),
            Self::Lanes => (0.0, 500.0, 50),
            Self::LaneKilometres => (0.0, 20.0, 40),
            Self::Junctions => (0.0, 20.0, 20),
            Self::Lights | Self::StopSigns | Self::Crosswalks | Self::Driveways => (0.0, 40.0, 40),
        }
    }
}
