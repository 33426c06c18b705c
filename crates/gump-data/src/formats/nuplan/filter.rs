//! Selection of events as scenarios: by type, token, number and distance in time.
//!
//! The published selections are in [`Split`]. Start with [`ScenarioFilter`].

use std::collections::{BTreeMap, BTreeSet};
use std::str::FromStr;

use super::Token;
use super::log::{Census, Event, Log};
use crate::DataError;

/// A selection of events. The default selects every tagged event.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ScenarioFilter {
    /// Only events of one of these types.
    pub types: Option<Vec<String>>,
    /// Only these events.
    pub tokens: Option<BTreeSet<Token>>,
    /// Maximum number of each type, spread evenly.
    pub per_type: Option<usize>,
    /// Maximum number in total, spread evenly.
    pub limit: Option<usize>,
    /// Minimum time between events of the same type, seconds.
    pub min_gap_s: Option<f64>,
    /// Only events whose scene states a goal.
    pub with_goal: bool,
    /// Also events without a tag.
    pub untagged: bool,
}

/// An event with the index of its log and the type it is counted as.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Selected {
    /// Index into the logs given.
    pub log: usize,
    /// The event.
    pub event: Event,
    /// The type it is counted as.
    pub scenario_type: String,
}

impl ScenarioFilter {
    /// The events of these logs that pass, in order of log and time.
    ///
    /// Source: the order of nuplan-devkit's filters: types, tokens and goals per log, then the
    /// number per type, the total, and the gap in time.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn select(&self, logs: &[Log]) -> Result<Vec<Selected>, DataError> {
        let mut selected = Vec::new();
        for (i, log) in logs.iter().enumerate() {
            selected.extend(self.select_in(i, log)?);
        }
        if let Some(most) = self.per_type {
            selected = cap_types(selected, most);
        }
        if let Some(limit) = self.limit {
            selected = spread(selected, limit);
        }
        if let Some(gap) = self.min_gap_s {
            selected = spaced(selected, gap);
        }
        Ok(selected)
    }

    /// Events of one log by type, token and goal.
    fn select_in(&self, i: usize, log: &Log) -> Result<Vec<Selected>, DataError> {
        let mut selected = Vec::new();
        for event in log.events(self.untagged)? {
            let listed = self
                .tokens
                .as_ref()
                .is_none_or(|t| t.contains(&event.token));
            let of_type = |wanted: &Vec<String>| event.types.iter().any(|t| wanted.contains(t));
            if !listed || !self.types.as_ref().is_none_or(of_type) {
                continue;
            }
            if self.with_goal && log.goal(event.token)?.is_none() {
                continue;
            }
            let scenario_type = event.scenario_type(self.types.as_deref()).to_owned();
            selected.push(Selected {
                log: i,
                event,
                scenario_type,
            });
        }
        Ok(selected)
    }

    /// Explains how many events of a log pass, as a sentence.
    pub fn explain(&self, census: &Census) -> String {
        let Census {
            rows,
            scenes,
            tagged,
            usable,
            types,
        } = census;
        let mut text = format!(
            "{rows} rows in {scenes} scenes, {tagged} of them tagged, {usable} of these outside of \
             the first two and last two scenes"
        );
        if let Some(wanted) = &self.types {
            let missing: Vec<&str> = wanted
                .iter()
                .filter(|t| !types.contains_key(*t))
                .map(String::as_str)
                .collect();
            if !missing.is_empty() {
                text += &format!("; of the types asked for it lacks {}", missing.join(", "));
            }
        }
        if !types.is_empty() {
            let counts = types.iter().map(|(name, n)| format!("{name} {n}"));
            text += &format!("; types: {}", counts.collect::<Vec<_>>().join(", "));
        }
        text
    }
}

/// At most `most` of each type.
fn cap_types(selected: Vec<Selected>, most: usize) -> Vec<Selected> {
    let mut by_type: BTreeMap<String, Vec<Selected>> = BTreeMap::new();
    for s in selected {
        by_type.entry(s.scenario_type.clone()).or_default().push(s);
    }
    let kept = by_type.into_values().flat_map(|list| spread(list, most));
    in_order(kept.collect())
}

/// Every n-th, so that at most `most` are left.
fn spread(list: Vec<Selected>, most: usize) -> Vec<Selected> {
    let stride = (list.len() / most.max(1)).max(1);
    list.into_iter().step_by(stride).take(most).collect()
}

/// Events at least `gap` seconds after the last one kept of their type.
fn spaced(mut selected: Vec<Selected>, gap: f64) -> Vec<Selected> {
    selected.sort_by_key(|s| s.event.time_us);
    let gap_us = (gap * 1e6) as i64;
    let mut last: BTreeMap<String, i64> = BTreeMap::new();
    selected.retain(|s| {
        let before = last.get(&s.scenario_type);
        let far = before.is_none_or(|before| s.event.time_us >= before + gap_us);
        if far {
            last.insert(s.scenario_type.clone(), s.event.time_us);
        }
        far
    });
    in_order(selected)
}

fn in_order(mut selected: Vec<Selected>) -> Vec<Selected> {
    selected.sort_by_key(|s| (s.log, s.event.time_us));
    selected
}

/// A published selection of events for evaluation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Split {
    /// 1,118 events of the validation logs.
    Val14,
    /// 318 events of the validation logs.
    ReducedVal14,
    /// 272 events of the test logs on which a rule-based planner does worst.
    Test14Hard,
}

impl Split {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Val14, Self::ReducedVal14, Self::Test14Hard];

    /// The name it is published under.
    pub fn name(self) -> &'static str {
        match self {
            Self::Val14 => "val14",
            Self::ReducedVal14 => "reduced-val14",
            Self::Test14Hard => "test14-hard",
        }
    }

    /// Its tokens.
    ///
    /// Source: tuplan_garage (val14, reduced_val14) and planTF (test14-hard).
    pub fn tokens(self) -> BTreeSet<Token> {
        let text = match self {
            Self::Val14 => include_str!("splits/val14.txt"),
            Self::ReducedVal14 => include_str!("splits/reduced-val14.txt"),
            Self::Test14Hard => include_str!("splits/test14-hard.txt"),
        };
        text.lines().filter_map(|line| line.parse().ok()).collect()
    }

    /// The filter that selects it: its tokens, counted as one of [`CHALLENGE_TYPES`], whose scene
    /// has a goal, of one type at least 15 s apart, and of val14 at most 100 a type, of
    /// reduced-val14 25.
    pub fn filter(self) -> ScenarioFilter {
        ScenarioFilter {
            types: Some(CHALLENGE_TYPES.map(str::to_owned).to_vec()),
            tokens: Some(self.tokens()),
            per_type: match self {
                Self::Val14 => Some(100),
                Self::ReducedVal14 => Some(25),
                Self::Test14Hard => None,
            },
            min_gap_s: Some(15.0),
            with_goal: true,
            ..ScenarioFilter::default()
        }
    }
}

/// The error of reading a [`Split`]: none has this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected one of {known}, found \"{0}\"", known = Split::ALL.map(Split::name).join(", "))]
pub struct ParseSplitError(String);

impl FromStr for Split {
    type Err = ParseSplitError;

    /// Finds a split by name.
    ///
    /// # Errors
    /// An unknown name; the message has the known ones.
    fn from_str(name: &str) -> Result<Self, ParseSplitError> {
        let found = Self::ALL.into_iter().find(|split| split.name() == name);
        found.ok_or_else(|| ParseSplitError(name.to_owned()))
    }
}

/// The 14 types that nuPlan's challenges score.
pub const CHALLENGE_TYPES: [&str; 14] = [
    "starting_left_turn",
    "starting_right_turn",
    "starting_straight_traffic_light_intersection_traversal",
    "stopping_with_lead",
    "high_lateral_acceleration",
    "high_magnitude_speed",
    "low_magnitude_speed",
    "traversing_pickup_dropoff",
    "waiting_for_pedestrian_to_cross",
    "behind_long_vehicle",
    "stationary_in_traffic",
    "near_multiple_vehicles",
    "changing_lane",
    "following_lane_with_lead",
];

#[cfg(test)]
mod tests {
    use super::*;

    fn selected(type_and_seconds: &[(&str, i64)]) -> Vec<Selected> {
        let event = |(i, &(kind, seconds)): (usize, &(&str, i64))| Selected {
            log: 0,
            event: Event {
                token: Token::from_bytes(&[i as u8 + 1]).unwrap(),
                time_us: seconds * 1_000_000,
                types: vec![kind.into()],
            },
            scenario_type: kind.into(),
        };
        type_and_seconds.iter().enumerate().map(event).collect()
    }

    fn seconds(selected: &[Selected]) -> Vec<i64> {
        let seconds = |s: &Selected| s.event.time_us / 1_000_000;
        selected.iter().map(seconds).collect()
    }

    #[test]
    fn a_type_with_too_many_is_thinned_evenly() {
        let all = selected(&[("a", 0), ("b", 1), ("a", 2), ("a", 3), ("a", 4), ("a", 5)]);
        assert_eq!(seconds(&cap_types(all.clone(), 2)), [0, 1, 3]);
        assert_eq!(seconds(&cap_types(all, 9)), [0, 1, 2, 3, 4, 5]);
    }

    #[test]
    fn events_of_one_type_keep_their_distance() {
        let all = selected(&[
            ("a", 0),
            ("b", 5),
            ("a", 14),
            ("a", 15),
            ("a", 29),
            ("b", 30),
        ]);
        assert_eq!(seconds(&spaced(all, 15.0)), [0, 5, 15, 30]);
    }

    #[test]
    fn published_splits_have_their_published_sizes() {
        let sizes = Split::ALL.map(|split| split.tokens().len());
        assert_eq!(sizes, [1118, 318, 272]);
        assert_eq!("val14".parse(), Ok(Split::Val14));
        assert!(
            "val15"
                .parse::<Split>()
                .unwrap_err()
                .to_string()
                .contains("reduced-val14")
        );
    }
}
