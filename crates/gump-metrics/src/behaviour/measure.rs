//! Measures of behaviour: events, classes of agents, and denominators.

use std::collections::BTreeMap;
use std::fmt;

use gump_scene::{AgentId, AgentKind};

/// An event that a driver would notice. The definitions are in the table of the [module](super).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Measure {
    /// A vehicle that stands for the whole log moves away from its place.
    ParkedMove,
    /// The same of a vehicle that is beside the lanes in the present.
    RoadsideMove,
    /// A vehicle stops without a reason.
    FreeRoadStop,
    /// A vehicle that has moved stands for ten seconds without a reason.
    FreeRoadStanding,
    /// Two boxes overlap that did not in the present.
    NewOverlap,
    /// A change of velocity beyond the grip of tyres.
    HardAcceleration,
    /// A vehicle slips sideways.
    Slip,
    /// A vehicle passes a stop line at red.
    RedLight,
    /// A vehicle changes to an adjacent lane.
    LaneChange,
    /// A vehicle leaves the road.
    RoadExit,
    /// A standing vehicle starts.
    SetOff,
    /// An agent stands at a given time.
    Standing,
    /// A vehicle that moves slowly in the present stands at a given time.
    ComeToRest,
    /// Speed, at a given time, of an agent that does not stand in the present, metres per second.
    Speed,
    /// An agent is near the ego at a given time.
    NearEgo,
    /// The ego is on a lane of the map at a given time.
    EgoOnLane,
    /// Lights of crossing approaches are green at the same time.
    ConflictingGreen,
    /// A light changes its colour.
    LightChange,
    /// A light is red.
    LightRed,
    /// Seconds that a light is red at a time.
    RedPhase,
    /// Seconds that a light is green at a time.
    GreenPhase,
}

impl Measure {
    /// All, in the order of tables.
    pub const ALL: [Self; 21] = [
        Self::ParkedMove,
        Self::RoadsideMove,
        Self::FreeRoadStop,
        Self::FreeRoadStanding,
        Self::NewOverlap,
        Self::HardAcceleration,
        Self::Slip,
        Self::RedLight,
        Self::LaneChange,
        Self::RoadExit,
        Self::SetOff,
        Self::Standing,
        Self::ComeToRest,
        Self::Speed,
        Self::NearEgo,
        Self::EgoOnLane,
        Self::ConflictingGreen,
        Self::LightChange,
        Self::LightRed,
        Self::RedPhase,
        Self::GreenPhase,
    ];

    /// Name in reports, `snake_case`.
    pub fn name(self) -> &'static str {
        match self {
            Self::ParkedMove => "parked_move",
            Self::RoadsideMove => "roadside_move",
            Self::FreeRoadStop => "free_road_stop",
            Self::FreeRoadStanding => "free_road_standing",
            Self::NewOverlap => "new_overlap",
            Self::HardAcceleration => "hard_acceleration",
            Self::Slip => "slip",
            Self::RedLight => "red_light",
            Self::LaneChange => "lane_change",
            Self::RoadExit => "road_exit",
            Self::SetOff => "set_off",
            Self::Standing => "standing",
            Self::ComeToRest => "come_to_rest",
            Self::Speed => "speed_mps",
            Self::NearEgo => "near_ego",
            Self::EgoOnLane => "ego_on_lane",
            Self::ConflictingGreen => "conflicting_green",
            Self::LightChange => "light_change",
            Self::LightRed => "light_red",
            Self::RedPhase => "red_phase_s",
            Self::GreenPhase => "green_phase_s",
        }
    }

    /// The measure with this name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|measure| measure.name() == name)
    }

    /// The unit of its denominator.
    pub fn per(self) -> &'static str {
        match self {
            Self::ParkedMove => "parked vehicle",
            Self::RoadsideMove => "vehicle parked beside the lanes",
            Self::FreeRoadStop | Self::LaneChange | Self::RoadExit => "minute of moving",
            Self::FreeRoadStanding => "vehicle that moves",
            Self::NewOverlap | Self::Standing => "agent",
            Self::ComeToRest => "vehicle that moves slowly",
            Self::Speed => "agent that did not stand",
            Self::NearEgo | Self::EgoOnLane => "ego",
            Self::HardAcceleration | Self::SetOff => "minute",
            Self::LightChange => "minute of a light",
            Self::LightRed => "time of a light",
            Self::RedPhase => "red that ends",
            Self::GreenPhase => "green that ends",
            Self::Slip => "time of moving",
            Self::RedLight => "passage of a light",
            Self::ConflictingGreen => "time of crossing lights",
        }
    }

    /// True if the value is a rate per minute.
    pub fn is_rate(self) -> bool {
        self.per().starts_with("minute")
    }

    /// True if the value is a mean duration in seconds. What is neither a rate nor a duration nor
    /// [`Measure::Speed`] is a share or a number per agent or ego.
    pub fn is_duration(self) -> bool {
        matches!(self, Self::RedPhase | Self::GreenPhase)
    }

    /// True if the value is of moments instead of the whole horizon.
    pub fn is_of_moments(self) -> bool {
        matches!(
            self,
            Self::Standing | Self::ComeToRest | Self::Speed | Self::NearEgo | Self::EgoOnLane
        )
    }

    /// True if the value depends on the horizon, so that a shorter log has none.
    pub fn needs_whole_horizon(self) -> bool {
        matches!(
            self,
            Self::ParkedMove | Self::RoadsideMove | Self::NewOverlap | Self::FreeRoadStanding
        )
    }
}

impl fmt::Display for Measure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A class of agents that events are counted for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// All agents.
    All,
    /// Vehicles; of pairs those of two vehicles.
    Vehicle,
    /// Pedestrians; of pairs those with at least one.
    Pedestrian,
    /// Bicycles; of pairs those with one and without pedestrians.
    Bicycle,
    /// Traffic lights.
    Light,
}

impl Class {
    /// All, in the order of tables.
    pub const ALL: [Self; 5] = [
        Self::All,
        Self::Vehicle,
        Self::Pedestrian,
        Self::Bicycle,
        Self::Light,
    ];

    /// Name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::All => "all",
            Self::Vehicle => "vehicle",
            Self::Pedestrian => "pedestrian",
            Self::Bicycle => "bicycle",
            Self::Light => "light",
        }
    }

    /// The class with this name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|class| class.name() == name)
    }

    /// The class of an agent.
    pub(super) fn of(kind: AgentKind) -> Self {
        match kind {
            AgentKind::Vehicle => Self::Vehicle,
            AgentKind::Pedestrian => Self::Pedestrian,
            AgentKind::Bicycle => Self::Bicycle,
            _ => Self::All,
        }
    }

    /// The class of a pair.
    pub(super) fn of_pair(a: AgentKind, b: AgentKind) -> Self {
        let has = |kind| a == kind || b == kind;
        if has(AgentKind::Pedestrian) {
            Self::Pedestrian
        } else if has(AgentKind::Bicycle) {
            Self::Bicycle
        } else {
            Self::Vehicle
        }
    }
}

impl fmt::Display for Class {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One row of a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Key {
    /// The measure.
    pub measure: Measure,
    /// The class.
    pub class: Class,
    /// Of a measure [of moments](Measure::is_of_moments) the second after the present, otherwise the horizon.
    pub seconds: u32,
}

/// Events and their denominator.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Count {
    /// Events; of a measure that [is a duration](Measure::is_duration) seconds, of speeds their sum,
    /// metres per second.
    pub events: f64,
    /// The denominator, in the unit of [`Measure::per`].
    pub of: f64,
}

impl Count {
    /// Events per unit; `None` where there was nothing to count.
    pub fn rate(self) -> Option<f64> {
        (self.of > 0.0).then(|| self.events / self.of)
    }
}

/// Counts by key. Counts of several futures, scenarios or machines can be added.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tally(pub BTreeMap<Key, Count>);

impl Tally {
    /// The count of a key; zero if there is none.
    pub fn count(&self, measure: Measure, class: Class, seconds: u32) -> Count {
        let key = Key {
            measure,
            class,
            seconds,
        };
        self.0.get(&key).copied().unwrap_or_default()
    }

    /// Adds to a key.
    pub fn add(&mut self, key: Key, count: Count) {
        let sum = self.0.entry(key).or_default();
        sum.events += count.events;
        sum.of += count.of;
    }

    /// Adds the counts of another tally.
    pub fn merge(&mut self, other: &Self) {
        for (&key, &count) in &other.0 {
            self.add(key, count);
        }
    }
}

/// An event in a future.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Incident {
    /// The measure.
    pub measure: Measure,
    /// The agent.
    pub agent: AgentId,
    /// The other agent of an overlap.
    pub other: Option<AgentId>,
    /// Seconds after the present.
    pub at_s: f64,
}

/// The events of one future or of the log.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Seen {
    /// The counts.
    pub tally: Tally,
    /// Events by measure and agent. Standing is not an event.
    pub incidents: Vec<Incident>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_read_as_they_are_written() {
        for measure in Measure::ALL {
            assert_eq!(Measure::of_name(measure.name()), Some(measure));
        }
        for class in Class::ALL {
            assert_eq!(Class::of_name(class.name()), Some(class));
        }
        assert_eq!(
            (Measure::of_name("speed"), Class::of_name("bus")),
            (None, None)
        );
    }

    #[test]
    fn tallies_add_up() {
        let key = Key {
            measure: Measure::Slip,
            class: Class::Vehicle,
            seconds: 8,
        };
        let mut tally = Tally::default();
        assert_eq!(tally.count(Measure::Slip, Class::Vehicle, 8).rate(), None);
        let count = Count {
            events: 1.0,
            of: 4.0,
        };
        tally.add(key, count);
        let other = tally.clone();
        tally.merge(&other);
        let found = tally.count(Measure::Slip, Class::Vehicle, 8);
        assert_eq!(
            (found.events, found.of, found.rate()),
            (2.0, 8.0, Some(0.25))
        );
    }
}
