//! Settings of each year of the challenge: components, estimators, weights; one TOML file per year.

use std::fmt;
use std::str::FromStr;

use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

/// A year of the challenge.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[non_exhaustive]
pub enum Year {
    /// 2023 as first published: leaderboard V0.
    #[serde(rename = "2023-v0")]
    Y2023V0,
    /// 2023 after the correction of collisions and off-road: leaderboard V1, the GUMP paper's.
    #[serde(rename = "2023")]
    Y2023,
    /// 2024.
    #[serde(rename = "2024")]
    Y2024,
    /// 2025, simulated agents.
    #[serde(rename = "2025")]
    Y2025,
    /// 2025, scenario generation.
    #[serde(rename = "2025-generation")]
    Y2025Generation,
}

impl fmt::Display for Year {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Year {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

impl Year {
    /// All years in order.
    pub const ALL: [Self; 5] = [
        Self::Y2023V0,
        Self::Y2023,
        Self::Y2024,
        Self::Y2025,
        Self::Y2025Generation,
    ];

    /// The name that it is stored and displayed under.
    pub fn name(self) -> &'static str {
        match self {
            Self::Y2023V0 => "2023-v0",
            Self::Y2023 => "2023",
            Self::Y2024 => "2024",
            Self::Y2025 => "2025",
            Self::Y2025Generation => "2025-generation",
        }
    }
}

/// The version of the feature code; the reference's code changed with the years, not only its
/// settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[non_exhaustive]
pub enum Algorithm {
    /// Backward differences; the log counts as valid throughout when distances are computed.
    #[serde(rename = "2023-v0")]
    V2023V0,
    /// Backward differences; logged validity is respected everywhere.
    #[serde(rename = "2023-v1")]
    V2023V1,
    /// Central differences, boxes with rounded corners, road edges with elevation.
    #[serde(rename = "2024")]
    V2024,
    /// As 2024; time to collision of vehicles only, and traffic lights.
    #[serde(rename = "2025")]
    V2025,
}

impl Algorithm {
    /// True for both versions of 2023.
    pub(crate) fn is_2023(self) -> bool {
        matches!(self, Self::V2023V0 | Self::V2023V1)
    }
}

/// The simulated agents and the scored ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// 80 future steps of the agents that are present; the ego and the targets are scored.
    SimAgents,
    /// All 91 steps, with sizes and kinds; every agent that is present is scored.
    Generation,
}

/// The components of a score, in the order of the reference.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Component {
    /// Speed in space, m/s.
    LinearSpeed,
    /// Change of speed, m/s².
    LinearAcceleration,
    /// Change of heading, rad/s.
    AngularSpeed,
    /// Change of angular speed, rad/s².
    AngularAcceleration,
    /// Signed distance to the nearest other box, m.
    DistanceToNearestObject,
    /// Whether the boxes ever overlap.
    Collision,
    /// Time to the collision with the vehicle followed, s, at most 5.
    TimeToCollision,
    /// Signed distance of the outermost corner to the road edge, m, positive off the road.
    DistanceToRoadEdge,
    /// Whether a corner ever leaves the road.
    Offroad,
    /// Whether a vehicle ever passes a red light.
    TrafficLightViolation,
}

/// Groups of components in reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// Motion of the agent.
    Kinematic,
    /// Relation to other agents.
    Interactive,
    /// Relation to the road.
    MapBased,
}

impl Component {
    /// All, in the order of the reference; a component is its own index here.
    pub const ALL: [Self; 10] = [
        Self::LinearSpeed,
        Self::LinearAcceleration,
        Self::AngularSpeed,
        Self::AngularAcceleration,
        Self::DistanceToNearestObject,
        Self::Collision,
        Self::TimeToCollision,
        Self::DistanceToRoadEdge,
        Self::Offroad,
        Self::TrafficLightViolation,
    ];

    /// Its name in settings and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::LinearSpeed => "linear_speed",
            Self::LinearAcceleration => "linear_acceleration",
            Self::AngularSpeed => "angular_speed",
            Self::AngularAcceleration => "angular_acceleration",
            Self::DistanceToNearestObject => "distance_to_nearest_object",
            Self::Collision => "collision",
            Self::TimeToCollision => "time_to_collision",
            Self::DistanceToRoadEdge => "distance_to_road_edge",
            Self::Offroad => "offroad",
            Self::TrafficLightViolation => "traffic_light_violation",
        }
    }

    /// The group that it is reported in.
    pub fn group(self) -> Group {
        match self {
            Self::LinearSpeed
            | Self::LinearAcceleration
            | Self::AngularSpeed
            | Self::AngularAcceleration => Group::Kinematic,
            Self::DistanceToNearestObject | Self::Collision | Self::TimeToCollision => {
                Group::Interactive
            }
            Self::DistanceToRoadEdge | Self::Offroad | Self::TrafficLightViolation => {
                Group::MapBased
            }
        }
    }

    /// True if it counts once per rollout (did it ever happen?) rather than at every step.
    pub fn is_indication(self) -> bool {
        matches!(
            self,
            Self::Collision | Self::Offroad | Self::TrafficLightViolation
        )
    }
}

/// Estimator of a distribution from samples.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Estimator {
    /// Shares of equal bins; values outside count in the nearest bin, NaN in the last bin.
    Histogram {
        /// Lower end of the first bin.
        min: f32,
        /// Upper end of the last bin, > `min`.
        max: f32,
        /// Number of bins, > 0.
        bins: usize,
        /// Added to every bin's count, ≥ 0.
        pseudocount: f32,
    },
    /// Shares of yes and no.
    Bernoulli {
        /// Added to both counts, ≥ 0.
        pseudocount: f32,
    },
    /// A Gaussian around every sample, scaled so that a perfect sample has likelihood 1.
    KernelDensity {
        /// Standard deviation, > 0, in the feature's unit.
        bandwidth: f32,
    },
}

/// Settings of one component.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeatureConfig {
    /// Estimator of its distribution.
    pub estimator: Estimator,
    /// True: one distribution for all steps; false: one for each.
    #[serde(default)]
    pub independent_timesteps: bool,
    /// True: one distribution for all agents; false: one for each.
    #[serde(default)]
    pub aggregate_agents: bool,
    /// Weight in the metametric.
    pub weight: f32,
}

/// All settings of a year.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The version of the feature code.
    pub algorithm: Algorithm,
    /// The simulated agents and the scored ones.
    pub mode: Mode,
    #[allow(missing_docs, reason = "named as the component it is for")]
    pub linear_speed: FeatureConfig,
    #[allow(missing_docs, reason = "named as the component it is for")]
    pub linear_acceleration: FeatureConfig,
    #[allow(missing_docs, reason = "named as the component it is for")]
    pub angular_speed: FeatureConfig,
    #[allow(missing_docs, reason = "named as the component it is for")]
    pub angular_acceleration: FeatureConfig,
    #[allow(missing_docs, reason = "named as the component it is for")]
    pub distance_to_nearest_object: FeatureConfig,
    #[allow(missing_docs, reason = "named as the component it is for")]
    pub collision: FeatureConfig,
    #[allow(missing_docs, reason = "named as the component it is for")]
    pub time_to_collision: FeatureConfig,
    #[allow(missing_docs, reason = "named as the component it is for")]
    pub distance_to_road_edge: FeatureConfig,
    #[allow(missing_docs, reason = "named as the component it is for")]
    pub offroad: FeatureConfig,
    /// `None` before 2025.
    #[serde(default)]
    pub traffic_light_violation: Option<FeatureConfig>,
}

/// The error of reading a [`Config`]: the invalid line and what is wrong with it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ConfigError(String);

impl Config {
    /// The challenge of a year.
    pub fn of(year: Year) -> Self {
        let text = match year {
            Year::Y2023V0 | Year::Y2023 => include_str!("configs/2023.toml"),
            Year::Y2024 => include_str!("configs/2024.toml"),
            Year::Y2025 => include_str!("configs/2025.toml"),
            Year::Y2025Generation => include_str!("configs/2025-generation.toml"),
        };
        let mut config = Self::parse(text).expect("the shipped settings are tested");
        if year == Year::Y2023V0 {
            config.algorithm = Algorithm::V2023V0;
        }
        config
    }

    /// Custom settings, in the format of the shipped files.
    ///
    /// # Errors
    /// Text that is not TOML, and unknown, missing or wrong settings.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        toml::from_str(text).map_err(|error| ConfigError(error.to_string()))
    }

    /// The settings of a component; `None` if it is not scored.
    pub fn feature(&self, component: Component) -> Option<&FeatureConfig> {
        Some(match component {
            Component::LinearSpeed => &self.linear_speed,
            Component::LinearAcceleration => &self.linear_acceleration,
            Component::AngularSpeed => &self.angular_speed,
            Component::AngularAcceleration => &self.angular_acceleration,
            Component::DistanceToNearestObject => &self.distance_to_nearest_object,
            Component::Collision => &self.collision,
            Component::TimeToCollision => &self.time_to_collision,
            Component::DistanceToRoadEdge => &self.distance_to_road_edge,
            Component::Offroad => &self.offroad,
            Component::TrafficLightViolation => return self.traffic_light_violation.as_ref(),
        })
    }

    /// Components that are scored, in order.
    pub(crate) fn components(&self) -> impl Iterator<Item = (Component, &FeatureConfig)> {
        let scored = |c| Some((c, self.feature(c)?));
        Component::ALL.into_iter().filter_map(scored)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_add_up_as_published() {
        for (year, sum) in Year::ALL.into_iter().zip([0.99, 0.99, 1.0, 1.0, 1.0]) {
            let config = Config::of(year);
            let weights = config.components().map(|(_, f)| f64::from(f.weight));
            assert!((weights.sum::<f64>() - sum).abs() < 1e-6, "{year:?}");
        }
    }

    #[test]
    fn years_are_read_by_their_names() {
        for year in Year::ALL {
            assert_eq!(year.to_string(), year.name());
            assert_eq!(year.name().parse(), Ok(year));
        }
        assert!("2022".parse::<Year>().is_err());
    }

    #[test]
    fn components_are_their_own_index() {
        for (i, component) in Component::ALL.into_iter().enumerate() {
            assert_eq!(component as usize, i);
        }
    }

    #[test]
    fn unknown_settings_are_refused() {
        let text = include_str!("configs/2024.toml").replace("weight", "wait");
        let error = Config::parse(&text).unwrap_err().to_string();
        assert!(error.contains("wait"), "{error}");
        let text = include_str!("configs/2024.toml").replace("bins", "bars");
        assert!(Config::parse(&text).is_err());
    }
}
