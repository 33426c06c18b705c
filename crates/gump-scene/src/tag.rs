//! The vocabulary of scenario prompts.

use std::fmt;
use std::str::FromStr;

/// One of the 73 scenario types of nuPlan; the prompt vocabulary.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ScenarioTag(u8);

impl ScenarioTag {
    /// Number of tags.
    pub const COUNT: usize = NAMES.len();

    /// All tags in the order of their index.
    pub fn all() -> impl Iterator<Item = Self> {
        (0..Self::COUNT as u8).map(Self)
    }

    /// Position in the vocabulary, 0..73.
    pub fn index(self) -> usize {
        usize::from(self.0)
    }

    /// Its name in nuPlan.
    pub fn name(self) -> &'static str {
        NAMES[self.index()]
    }
}

impl fmt::Display for ScenarioTag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.name().fmt(f)
    }
}

/// The error of reading a [`ScenarioTag`]: no tag has this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is not one of the {n} scenario tags", n = ScenarioTag::COUNT)]
pub struct ParseTagError(String);

impl FromStr for ScenarioTag {
    type Err = ParseTagError;

    /// Finds a tag by name.
    ///
    /// # Errors
    /// An unknown name.
    fn from_str(name: &str) -> Result<Self, ParseTagError> {
        match NAMES.binary_search(&name) {
            Ok(i) => Ok(Self(i as u8)),
            Err(_) => Err(ParseTagError(name.to_owned())),
        }
    }
}

/// Sorted, so that an index is also a rank.
const NAMES: [&str; 73] = [
    "accelerating_at_crosswalk",
    "accelerating_at_stop_sign",
    "accelerating_at_stop_sign_no_crosswalk",
    "accelerating_at_traffic_light",
    "accelerating_at_traffic_light_with_lead",
    "accelerating_at_traffic_light_without_lead",
    "behind_bike",
    "behind_long_vehicle",
    "behind_pedestrian_on_driveable",
    "behind_pedestrian_on_pickup_dropoff",
    "changing_lane",
    "changing_lane_to_left",
    "changing_lane_to_right",
    "changing_lane_with_lead",
    "changing_lane_with_trail",
    "crossed_by_bike",
    "crossed_by_vehicle",
    "following_lane_with_lead",
    "following_lane_with_slow_lead",
    "following_lane_without_lead",
    "high_lateral_acceleration",
    "high_magnitude_jerk",
    "high_magnitude_speed",
    "low_magnitude_speed",
    "medium_magnitude_speed",
    "near_barrier_on_driveable",
    "near_construction_zone_sign",
    "near_high_speed_vehicle",
    "near_long_vehicle",
    "near_multiple_bikes",
    "near_multiple_pedestrians",
    "near_multiple_vehicles",
    "near_pedestrian_at_pickup_dropoff",
    "near_pedestrian_on_crosswalk",
    "near_pedestrian_on_crosswalk_with_ego",
    "near_trafficcone_on_driveable",
    "on_all_way_stop_intersection",
    "on_carpark",
    "on_intersection",
    "on_pickup_dropoff",
    "on_stopline_crosswalk",
    "on_stopline_stop_sign",
    "on_stopline_traffic_light",
    "on_traffic_light_intersection",
    "starting_high_speed_turn",
    "starting_left_turn",
    "starting_low_speed_turn",
    "starting_protected_cross_turn",
    "starting_protected_noncross_turn",
    "starting_right_turn",
    "starting_straight_stop_sign_intersection_traversal",
    "starting_straight_traffic_light_intersection_traversal",
    "starting_u_turn",
    "starting_unprotected_cross_turn",
    "starting_unprotected_noncross_turn",
    "stationary",
    "stationary_at_crosswalk",
    "stationary_at_traffic_light_with_lead",
    "stationary_at_traffic_light_without_lead",
    "stationary_in_traffic",
    "stopping_at_crosswalk",
    "stopping_at_stop_sign_no_crosswalk",
    "stopping_at_stop_sign_with_lead",
    "stopping_at_stop_sign_without_lead",
    "stopping_at_traffic_light_with_lead",
    "stopping_at_traffic_light_without_lead",
    "stopping_with_lead",
    "traversing_crosswalk",
    "traversing_intersection",
    "traversing_narrow_lane",
    "traversing_pickup_dropoff",
    "traversing_traffic_light_intersection",
    "waiting_for_pedestrian_to_cross",
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_sorted_and_found() {
        assert!(NAMES.is_sorted());
        for tag in ScenarioTag::all() {
            assert_eq!(tag.name().parse(), Ok(tag));
        }
        assert!("behind_bikes".parse::<ScenarioTag>().is_err());
    }
}
