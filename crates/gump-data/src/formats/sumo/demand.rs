//! Input of a SUMO run: vehicle types, trips, and the signals to log.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

use quick_xml::escape::escape;

use crate::io::stream::io_error;
use crate::{DataError, write_atomically};

/// Trips of vehicles and pedestrians with their times.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Demand {
    /// The types that trips refer to.
    pub types: Vec<VehicleType>,
    /// Trips in any order.
    pub trips: Vec<Trip>,
}

/// A type of vehicle or person.
#[derive(Clone, Debug, PartialEq)]
pub struct VehicleType {
    /// Its name.
    pub id: String,
    /// SUMO's vehicle class, for instance `passenger`.
    pub class: &'static str,
    /// Length, width and height, metres.
    pub size: [f64; 3],
    /// Top speed, metres per second.
    pub max_speed: f64,
    /// Desired speed as a multiple of the limit: mean and standard deviation.
    pub speed_factor: [f64; 2],
    /// Acceleration and comfortable braking, metres per second squared.
    pub acceleration: [f64; 2],
}

/// A way from one edge to another.
#[derive(Clone, Debug, PartialEq)]
pub struct Trip {
    /// Seconds after the start.
    pub depart_s: f64,
    /// The edge where it starts.
    pub from: String,
    /// The edge where it ends.
    pub to: String,
    /// Index into [`Demand::types`].
    pub kind: usize,
    /// By vehicle or on foot.
    pub on: TripKind,
}

/// The mode of a trip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TripKind {
    /// In a vehicle.
    Wheels,
    /// On foot.
    Foot,
}

impl Demand {
    /// Writes types and trips, sorted by departure, as a SUMO routes file.
    ///
    /// # Errors
    /// [`DataError::Io`].
    ///
    /// # Panics
    /// If a trip's type is not in the list.
    pub fn write(&self, path: &Path) -> Result<(), DataError> {
        let mut text = String::from("<routes>\n");
        for kind in &self.types {
            push(&mut text, &type_element(kind));
        }
        let mut trips: Vec<(usize, &Trip)> = self.trips.iter().enumerate().collect();
        trips.sort_by(|a, b| a.1.depart_s.total_cmp(&b.1.depart_s).then(a.0.cmp(&b.0)));
        for (i, trip) in trips {
            push(&mut text, &trip_element(i, trip, &self.types[trip.kind].id));
        }
        text.push_str("</routes>\n");
        write_text(path, &text)
    }

    /// Writes the order to log every change of these signal systems to a file.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn write_signal_log(systems: &[&str], log: &str, path: &Path) -> Result<(), DataError> {
        let mut text = String::from("<additional>\n");
        for system in systems {
            let (source, log) = (escape(*system), escape(log));
            let event = format!(
                r#"<timedEvent type="SaveTLSSwitchStates" source="{source}" dest="{log}"/>"#
            );
            push(&mut text, &event);
        }
        text.push_str("</additional>\n");
        write_text(path, &text)
    }
}

fn push(text: &mut String, element: &str) {
    text.push_str("    ");
    text.push_str(element);
    text.push('\n');
}

fn type_element(kind: &VehicleType) -> String {
    let [length, width, height] = kind.size;
    let [mean, deviation] = kind.speed_factor;
    let [accel, decel] = kind.acceleration;
    let (low, high) = (mean - 2.0 * deviation, mean + 2.0 * deviation);
    let mut element = format!(
        r#"<vType id="{}" vClass="{}" length="{length:.2}" width="{width:.2}" height="{height:.2}" maxSpeed="{:.2}""#,
        escape(&kind.id),
        kind.class,
        kind.max_speed,
    );
    if kind.class == "pedestrian" {
        element.push_str("/>");
        return element;
    }
    let written = write!(
        element,
        r#" speedFactor="normc({mean:.3},{deviation:.3},{low:.3},{high:.3})" accel="{accel:.2}" decel="{decel:.2}"/>"#
    );
    written.expect("writing to a string cannot fail");
    element
}

fn trip_element(i: usize, trip: &Trip, kind: &str) -> String {
    let (from, to, kind) = (escape(&trip.from), escape(&trip.to), escape(kind));
    let depart = trip.depart_s;
    match trip.on {
        TripKind::Wheels => format!(
            r#"<trip id="v{i}" type="{kind}" depart="{depart:.2}" from="{from}" to="{to}" departLane="best" departSpeed="max" departPos="random_free"/>"#
        ),
        TripKind::Foot => format!(
            r#"<person id="p{i}" type="{kind}" depart="{depart:.2}" departPos="random"><walk from="{from}" to="{to}"/></person>"#
        ),
    }
}

fn write_text(path: &Path, text: &str) -> Result<(), DataError> {
    write_atomically(path, |file| {
        file.write_all(text.as_bytes())
            .map_err(|error| io_error("write", error, path))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trips_are_sorted_and_names_escaped() {
        let trip = |depart_s, on| Trip {
            depart_s,
            from: "a<b".into(),
            to: "c".into(),
            kind: 0,
            on,
        };
        let demand = Demand {
            types: vec![VehicleType {
                id: "car".into(),
                class: "passenger",
                size: [4.5, 1.8, 1.5],
                max_speed: 50.0,
                speed_factor: [1.0, 0.1],
                acceleration: [2.6, 4.5],
            }],
            trips: vec![trip(7.0, TripKind::Wheels), trip(3.0, TripKind::Foot)],
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("demand.rou.xml");
        demand.write(&path).unwrap();
        let text = std::fs::read_to_string(path).unwrap();
        let (person, car) = (text.find("<person id=\"p1\""), text.find("<trip id=\"v0\""));
        assert!(person.unwrap() < car.unwrap());
        assert!(text.contains("from=\"a&lt;b\""), "{text}");
    }
}
