//! Helpers for fields and map features: names as ids, and coordinates.

use std::collections::BTreeMap;

use gump_geometry::{DVec3, dvec3};

use crate::complete::track::UNSTATED;
use crate::io::json::Real;

/// Ids of names: a name that is a number is its own id, others get unique negative ids.
#[derive(Default)]
pub(super) struct Names(BTreeMap<String, i64>);

impl Names {
    pub(super) fn id(&mut self, name: &str) -> i64 {
        if let Ok(id) = name.parse::<i64>() {
            return id;
        }
        let next = -1_000_000 - self.0.len() as i64;
        *self.0.entry(name.to_owned()).or_insert(next)
    }

    /// The id of a name given as text or as a number.
    pub(super) fn of(&mut self, value: &serde_json::Value) -> Option<i64> {
        match value {
            serde_json::Value::String(name) => Some(self.id(name)),
            serde_json::Value::Number(number) => number.as_i64(),
            _ => None,
        }
    }
}

/// Two or three coordinates; others are no place.
pub(super) fn place(numbers: &[Real]) -> DVec3 {
    match numbers {
        [x, y] => dvec3(x.0, y.0, UNSTATED),
        [x, y, z, ..] => dvec3(x.0, y.0, z.0),
        _ => DVec3::NAN,
    }
}
