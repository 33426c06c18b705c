//! Constraints on single objects of a scene, as a small TOML file, with a check for contradictions.
//!
//! ```toml
//! [[object]]
//! id = "ego"             # the ego; any other id names a new object
//! speed = [0.5, 1.0]     # a number fixes, two bound
//!
//! [[object]]
//! id = "bike"
//! class = "bicycle"
//! ahead_of = { object = "ego", metres = 6.0 }
//! ```
//!
//! Metres, metres per second and radians; `x` ahead of and `y` left of the ego, headings relative
//! to the ego's. Fixed values are met to the nearest value of the grid.

use std::collections::BTreeSet;

use gump_engine::placement::object_spec::{Bounds, Class, ObjectSpec, Relation};
use gump_scene::{AgentKind, LaneId};
use gump_tokenizer::Field;
use serde::Deserialize;

use crate::GenerateError;

/// Name of the ego among the objects.
pub const EGO: &str = "ego";
/// Fastest a state can be along an axis, metres per second: the end of [`Field::VelocityX`].
const FASTEST: f64 = 25.0;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    object: Vec<ObjectSpec>,
}

/// Why constraints cannot be met.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ConstraintError {
    /// The text is not of the form.
    #[error("line {line}: {reason}")]
    Text {
        /// Number of the line, from 1.
        line: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// Two objects have the same id.
    #[error("the id \"{id}\" occurs twice")]
    RepeatedId {
        /// The id.
        id: String,
    },
    /// The ego is of another class.
    #[error("the ego is a vehicle")]
    EgoClass,
    /// The ego is given a place.
    #[error("the ego is the origin: it has no x, y, heading or lane")]
    EgoPlace,
    /// A relation names an object that does not exist.
    #[error("\"{id}\" refers to \"{other}\", which is no object")]
    NoSuchObject {
        /// The object with the relation.
        id: String,
        /// The name.
        other: String,
    },
    /// An object is related to itself.
    #[error("\"{id}\" cannot be in a row with itself")]
    OwnRow {
        /// The object.
        id: String,
    },
    /// The gap of a relation is out of its range.
    #[error("the gap of \"{id}\" is {metres} m, expected 0 to 150")]
    Gap {
        /// The object with the relation.
        id: String,
        /// The gap, metres.
        metres: f64,
    },
    /// The bounds of a number are out of their range, or not in order.
    #[error(
        "{key} of \"{id}\" goes from {from} to {to}, expected ascending numbers from {low:.1} to \
         {high:.1}"
    )]
    Range {
        /// The key.
        key: &'static str,
        /// The object.
        id: String,
        /// The lower bound given.
        from: f64,
        /// The upper bound given.
        to: f64,
        /// The least it may be.
        low: f64,
        /// The most it may be.
        high: f64,
    },
    /// Objects would have to follow each other in a circle.
    #[error("\"{id}\" would have to be both ahead of and behind others in one row")]
    Circle {
        /// One of them.
        id: String,
    },
    /// More objects of a class are described than requested.
    #[error("{described} objects of class {} are described but {requested} asked for", kind.name())]
    TooManyDescribed {
        /// The class.
        kind: AgentKind,
        /// Number described.
        described: usize,
        /// Number requested.
        requested: usize,
    },
    /// No point satisfies the constraints of an object.
    #[error(
        "{} fits the x, y and heading of \"{id}\"",
        lane.map_or("no lane".into(), |lane| format!("no point of lane {lane}"))
    )]
    NoPoint {
        /// The object.
        id: String,
        /// The lane that it must be in.
        lane: Option<i64>,
    },
    /// A lane does not exist.
    #[error("the map has no lane {lane}")]
    NoSuchLane {
        /// Its id.
        lane: LaneId,
    },
    /// A lane is too far from the ego.
    #[error("lane {lane} does not come within 100 m of the ego")]
    LaneTooFar {
        /// Its id.
        lane: LaneId,
    },
}

/// Reads the objects of a TOML file.
///
/// # Errors
/// [`GenerateError::Constraints`] for invalid or contradictory text.
pub fn parse_constraints(text: &str) -> Result<Vec<ObjectSpec>, GenerateError> {
    let file: File = toml::from_str(text).map_err(|error| {
        let line = error
            .span()
            .map_or(1, |span| text[..span.start].matches('\n').count() + 1);
        let reason = error.message().trim().replace('\n', " ");
        ConstraintError::Text { line, reason }
    })?;
    check(&file.object)?;
    Ok(file.object)
}

/// Checks objects against each other and the grid.
///
/// # Errors
/// [`GenerateError::Constraints`] with the first contradiction.
pub(crate) fn check(objects: &[ObjectSpec]) -> Result<(), GenerateError> {
    let fail = |error: ConstraintError| Err(error.into());
    let mut ids = BTreeSet::new();
    for object in objects {
        if !ids.insert(object.id.as_str()) {
            let id = object.id.clone();
            return fail(ConstraintError::RepeatedId { id });
        }
    }
    ids.insert(EGO);
    for object in objects {
        let id = &object.id;
        if id == EGO && object.class != Class::Vehicle {
            return fail(ConstraintError::EgoClass);
        }
        if id == EGO
            && (object.x.or(object.y).or(object.heading).is_some() || object.lane.is_some())
        {
            return fail(ConstraintError::EgoPlace);
        }
        check_numbers(object)?;
        for relation in [&object.behind, &object.ahead_of].into_iter().flatten() {
            if !ids.contains(relation.object.as_str()) {
                return fail(ConstraintError::NoSuchObject {
                    id: id.clone(),
                    other: relation.object.clone(),
                });
            }
            if relation.object == *id {
                return fail(ConstraintError::OwnRow { id: id.clone() });
            }
            if !(relation.metres.is_finite() && (0.0..=150.0).contains(&relation.metres)) {
                return fail(ConstraintError::Gap {
                    id: id.clone(),
                    metres: relation.metres,
                });
            }
        }
    }
    check_rows(objects)
}

fn check_numbers(object: &ObjectSpec) -> Result<(), GenerateError> {
    let (x, length, width) = (Field::X.high(), Field::Length.high(), Field::Width.high());
    let turn = std::f64::consts::TAU;
    for (key, given, low, high) in [
        ("x", object.x, -x, x),
        ("y", object.y, -x, x),
        ("heading", object.heading, -turn, turn),
        ("speed", object.speed, 0.0, FASTEST),
        ("length", object.length, 0.3, length),
        ("width", object.width, 0.3, width),
    ] {
        let Some(Bounds {
            low: from,
            high: to,
        }) = given
        else {
            continue;
        };
        let in_range = from <= to && low <= from && to <= high;
        if !in_range {
            let id = object.id.clone();
            let error = ConstraintError::Range {
                key,
                id,
                from,
                to,
                low,
                high,
            };
            return Err(error.into());
        }
    }
    Ok(())
}

/// Checks that no cycle of objects follows itself.
fn check_rows(objects: &[ObjectSpec]) -> Result<(), GenerateError> {
    // (front, back), by every statement of either kind.
    let pairs: Vec<(&str, &str)> = objects
        .iter()
        .flat_map(|object| {
            let id = object.id.as_str();
            let behind = object.behind.iter().map(move |r| (r.object.as_str(), id));
            let ahead = object.ahead_of.iter().map(move |r| (id, r.object.as_str()));
            behind.chain(ahead)
        })
        .collect();
    for &(front, _) in &pairs {
        let mut reached = BTreeSet::from([front]);
        loop {
            let more = pairs.iter().filter(|(f, _)| reached.contains(f));
            let more: Vec<&str> = more.map(|(_, back)| *back).collect();
            if more.contains(&front) {
                let id = front.to_owned();
                return Err(ConstraintError::Circle { id }.into());
            }
            let before = reached.len();
            reached.extend(more);
            if reached.len() == before {
                break;
            }
        }
    }
    Ok(())
}

/// Adds the inverse of every relation, so that the object placed later knows it.
pub(crate) fn mutual(objects: &mut [ObjectSpec]) {
    let all = objects.to_vec();
    for object in objects {
        let id = object.id.clone();
        for other in &all {
            let of = |relation: &Option<Relation>| {
                let named = relation.as_ref().filter(|relation| relation.object == id);
                named.map(|relation| Relation {
                    object: other.id.clone(),
                    metres: relation.metres,
                })
            };
            object.ahead_of = object.ahead_of.take().or_else(|| of(&other.behind));
            object.behind = object.behind.take().or_else(|| of(&other.ahead_of));
        }
    }
}

#[cfg(test)]
mod tests {
    use gump_scene::AgentKind;

    use super::*;

    fn error(text: &str) -> String {
        parse_constraints(text).unwrap_err().to_string()
    }

    #[test]
    fn numbers_fix_and_pairs_bound() {
        let objects = parse_constraints(
            "[[object]]\nid = \"bike\"\nclass = \"bicycle\"\nx = 4\nspeed = [1, 2.5]\n\
             ahead_of = { object = \"ego\", metres = 6 }",
        )
        .unwrap();
        assert_eq!(objects[0].class.kind(), AgentKind::Bicycle);
        assert_eq!(objects[0].x, Some(Bounds::new(4.0, 4.0)));
        assert_eq!(objects[0].speed, Some(Bounds::new(1.0, 2.5)));
    }

    #[test]
    fn contradictions_are_named() {
        let twice = "[[object]]\nid = \"a\"\n[[object]]\nid = \"a\"";
        assert!(error(twice).contains("\"a\" occurs twice"));
        let empty = "[[object]]\nid = \"a\"\nx = [5, 4]";
        assert!(error(empty).contains("x of \"a\" goes from 5 to 4"));
        let far = "[[object]]\nid = \"a\"\nx = 500";
        assert!(error(far).contains("from -100.0 to 100.0"));
        let nobody = "[[object]]\nid = \"a\"\nbehind = { object = \"b\", metres = 3 }";
        assert!(error(nobody).contains("\"b\", which is no object"));
        let circle = "[[object]]\nid = \"a\"\nbehind = { object = \"b\", metres = 3 }\n\
                      [[object]]\nid = \"b\"\nbehind = { object = \"a\", metres = 3 }";
        assert!(error(circle).contains("both ahead of and behind"));
        let key = "[[object]]\nid = \"a\"\ncolour = 3";
        assert!(error(key).contains("line 3") && error(key).contains("colour"));
    }

    #[test]
    fn headings_are_bounded_on_the_circle() {
        let bounds = Bounds::new(3.0, 3.5);
        assert!(bounds.admit_angle(-3.1, 0.0) && bounds.admit_angle(3.1, 0.0));
        assert!(!bounds.admit_angle(0.0, 0.0) && !bounds.admit_angle(2.8, 0.1));
    }

    #[test]
    fn rows_are_known_from_both_sides() {
        let mut objects = parse_constraints(
            "[[object]]\nid = \"a\"\nbehind = { object = \"b\", metres = 3 }\n[[object]]\nid = \"b\"",
        )
        .unwrap();
        mutual(&mut objects);
        let ahead = objects[1].ahead_of.clone().unwrap();
        assert_eq!((ahead.object.as_str(), ahead.metres), ("a", 3.0));
    }
}
