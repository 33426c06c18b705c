//! Vehicle types: sizes and kinds of vehicles.

use std::collections::BTreeMap;
use std::path::Path;

use gump_scene::AgentKind;

use super::xml::Xml;
use crate::DataError;

/// Kind, length, width and height in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Body {
    pub(super) kind: AgentKind,
    pub(super) size: [f64; 3],
}

/// The types of a folder by name.
#[derive(Clone, Debug, Default)]
pub(super) struct VehicleTypes(BTreeMap<String, Body>);

impl VehicleTypes {
    /// Adds the `vType` elements of a file.
    pub(super) fn read(&mut self, path: &Path) -> Result<(), DataError> {
        let mut xml = Xml::open(path)?;
        while let Some(element) = xml.next()? {
            if element.name() != "vType" {
                continue;
            }
            let class = element.get("vClass")?;
            let mut body = of_class(class.as_deref().unwrap_or("passenger"));
            for (extent, name) in body.size.iter_mut().zip(["length", "width", "height"]) {
                let stated = element.number::<f64>(name)?.filter(|stated| *stated > 0.0);
                *extent = stated.unwrap_or(*extent);
            }
            self.0.insert(element.need("id")?.into_owned(), body);
        }
        Ok(())
    }

    /// The body of a type, and whether the type is known.
    pub(super) fn get(&self, name: &str, is_person: bool) -> (Body, bool) {
        if let Some(body) = self.0.get(name) {
            return (*body, true);
        }
        let class = match name {
            "DEFAULT_VEHTYPE" => "passenger",
            "DEFAULT_BIKETYPE" => "bicycle",
            "DEFAULT_TAXITYPE" => "taxi",
            "DEFAULT_RAILTYPE" => "rail",
            _ if is_person => "pedestrian",
            _ => "passenger",
        };
        (of_class(class), name.starts_with("DEFAULT_"))
    }
}

/// The default kind and size of a vehicle class.
///
/// Source: the table of defaults in SUMO's documentation of vehicle classes. People are drawn
/// larger than SUMO's 0.2 x 0.5 m, which is a body without its limbs.
fn of_class(class: &str) -> Body {
    let vehicle = AgentKind::Vehicle;
    let (kind, size) = match class {
        "pedestrian" | "wheelchair" => (AgentKind::Pedestrian, [0.6, 0.6, 1.72]),
        "bicycle" => (AgentKind::Bicycle, [1.6, 0.65, 1.7]),
        "scooter" => (AgentKind::Bicycle, [1.2, 0.5, 1.7]),
        "moped" => (vehicle, [2.1, 0.8, 1.7]),
        "motorcycle" => (vehicle, [2.2, 0.9, 1.5]),
        "truck" => (vehicle, [7.1, 2.4, 2.4]),
        "trailer" => (vehicle, [16.5, 2.55, 4.0]),
        "bus" => (vehicle, [12.0, 2.5, 3.4]),
        "coach" => (vehicle, [14.0, 2.6, 4.0]),
        "delivery" | "emergency" => (vehicle, [6.5, 2.16, 2.86]),
        "tram" => (vehicle, [22.0, 2.4, 3.2]),
        "rail" | "rail_urban" | "rail_electric" => (vehicle, [36.5, 3.0, 3.6]),
        _ => (vehicle, [5.0, 1.8, 1.5]),
    };
    Body { kind, size }
}
