//! A SUMO network file (`*.net.xml`, also `.gz`): edges, connections, junctions.
//!
//! `roads` converts lanes and shapes to a map. Start with [`Network::read`].

use std::collections::BTreeMap;
use std::path::Path;

use super::xml::{Element, Xml};
use crate::DataError;
use crate::error::MAX_COORDINATE;

/// Width of a lane that states none, metres.
///
/// Source: SUMO's documentation of road networks.
const DEFAULT_LANE_WIDTH: f64 = 3.2;

/// Edges, connections and junctions of a network, in file order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Network {
    /// Roads in one direction each, junction-internal ones included.
    pub edges: Vec<Edge>,
    /// Connections from lane to lane.
    pub connections: Vec<Connection>,
    /// Junctions, in which roads meet.
    pub junctions: Vec<Junction>,
}

/// The function of an edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EdgeFunction {
    /// A road between two junctions.
    Normal,
    /// A path through a junction.
    Internal,
    /// A pedestrian crossing.
    Crossing,
    /// A walking area at a junction.
    WalkingArea,
}

/// Lanes side by side in one direction.
#[derive(Clone, Debug, PartialEq)]
pub struct Edge {
    /// Its name.
    pub id: String,
    /// Its function.
    pub function: EdgeFunction,
    /// The junction it comes from; empty for an edge inside a junction.
    pub from: String,
    /// The junction it leads to; empty for an edge inside a junction.
    pub to: String,
    /// The road's type, for instance `highway.primary`; empty if not stated.
    pub kind: String,
    /// From right to left.
    pub lanes: Vec<NetworkLane>,
}

/// A lane of an edge.
#[derive(Clone, Debug, PartialEq)]
pub struct NetworkLane {
    /// Its name: the edge's, an underscore and the index.
    pub id: String,
    /// Allowed speed, metres per second.
    pub speed: f64,
    /// Width, metres.
    pub width: f64,
    /// Length as simulated, metres.
    pub length: f64,
    /// Permitted users.
    pub access: Access,
    /// Centre line, x, y and z in metres.
    pub shape: Vec<[f64; 3]>,
}

/// The users of a lane, as far as needed here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Access {
    /// Passenger cars.
    pub cars: bool,
    /// Trucks.
    pub trucks: bool,
    /// Any motor vehicle of the road: cars, trucks, buses, motorcycles.
    pub motor: bool,
    /// Bicycles.
    pub bicycles: bool,
    /// Pedestrians.
    pub pedestrians: bool,
}

/// A link between two lanes.
#[derive(Clone, Debug, PartialEq)]
pub struct Connection {
    /// The lane it starts from.
    pub from: String,
    /// The lane it leads to in the end.
    pub to: String,
    /// The first lane inside the junction on the way, if there is one.
    pub via: Option<String>,
    /// The signal system and the index of the signal that controls it.
    pub signal: Option<(String, usize)>,
    /// SUMO's code for the right of way, for instance `M` for major and `s` for stop.
    pub state: char,
}

/// A place where roads meet.
#[derive(Clone, Debug, PartialEq)]
pub struct Junction {
    /// Its name.
    pub id: String,
    /// SUMO's type, for instance `traffic_light`.
    pub kind: String,
    /// Its area, metres; empty for a dead end.
    pub shape: Vec<[f64; 3]>,
}

/// Vehicle classes of the road with a motor.
///
/// Source: SUMO's list of vehicle classes, without those of rails, water, air and feet.
const MOTOR: [&str; 18] = [
    "passenger",
    "private",
    "taxi",
    "delivery",
    "truck",
    "trailer",
    "bus",
    "coach",
    "motorcycle",
    "moped",
    "emergency",
    "authority",
    "army",
    "vip",
    "hov",
    "evehicle",
    "custom1",
    "custom2",
];

impl Network {
    /// Reads a network.
    ///
    /// # Errors
    /// [`DataError::Xml`] with the place of what cannot be understood, and those of opening a
    /// file.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let mut xml = Xml::open(path)?;
        let mut network = Self::default();
        let mut in_edge = false;
        while let Some(element) = xml.next()? {
            match element.name() {
                "edge" => {
                    let edge = edge(&element)?;
                    in_edge = edge.is_some();
                    network.edges.extend(edge);
                }
                "lane" if in_edge => {
                    let lane = lane(&element)?;
                    if let Some(edge) = network.edges.last_mut() {
                        edge.lanes.push(lane);
                    }
                }
                "connection" => network.connections.push(connection(&element)?),
                "junction" => network.junctions.push(Junction {
                    id: element.need("id")?.into_owned(),
                    kind: element.get("type")?.unwrap_or_default().into_owned(),
                    shape: shape(&element)?,
                }),
                _ => {}
            }
        }
        Ok(network)
    }

    /// The lanes of all edges by name.
    pub fn lanes(&self) -> BTreeMap<&str, &NetworkLane> {
        let lanes = self.edges.iter().flat_map(|edge| &edge.lanes);
        lanes.map(|lane| (lane.id.as_str(), lane)).collect()
    }

    /// The names of all signal systems that control a connection.
    pub fn signal_systems(&self) -> Vec<&str> {
        let signals = self.connections.iter().filter_map(|c| c.signal.as_ref());
        let mut systems: Vec<&str> = signals.map(|(system, _)| system.as_str()).collect();
        systems.sort_unstable();
        systems.dedup();
        systems
    }
}

fn edge(element: &Element<'_>) -> Result<Option<Edge>, DataError> {
    let function = match element.get("function")?.as_deref() {
        None | Some("normal" | "connector") => EdgeFunction::Normal,
        Some("internal") => EdgeFunction::Internal,
        Some("crossing") => EdgeFunction::Crossing,
        Some("walkingarea") => EdgeFunction::WalkingArea,
        // Districts and other bookkeeping edges have no lanes.
        Some(_) => return Ok(None),
    };
    let text = |name| Ok::<_, DataError>(element.get(name)?.unwrap_or_default().into_owned());
    Ok(Some(Edge {
        id: element.need("id")?.into_owned(),
        function,
        from: text("from")?,
        to: text("to")?,
        kind: text("type")?,
        lanes: Vec::new(),
    }))
}

fn lane(element: &Element<'_>) -> Result<NetworkLane, DataError> {
    let width: f64 = element.number("width")?.unwrap_or(DEFAULT_LANE_WIDTH);
    let shape = shape(element)?;
    if shape.len() < 2 {
        let found = shape.len();
        return Err(element.error(&format!("expected at least 2 points, found {found}")));
    }
    Ok(NetworkLane {
        id: element.need("id")?.into_owned(),
        speed: element.need_number("speed")?,
        // SUMO writes a negative width if none is stated.
        width: if width > 0.0 {
            width
        } else {
            DEFAULT_LANE_WIDTH
        },
        length: element.number("length")?.unwrap_or(0.0),
        access: access(
            element.get("allow")?.as_deref(),
            element.get("disallow")?.as_deref(),
        ),
        shape,
    })
}

fn shape(element: &Element<'_>) -> Result<Vec<[f64; 3]>, DataError> {
    let shape = element.shape("shape")?;
    let far = shape
        .iter()
        .flatten()
        .find(|value| value.abs() > MAX_COORDINATE);
    match far {
        None => Ok(shape),
        Some(value) => Err(element.error(&format!(
            "expected coordinates within {MAX_COORDINATE} m, found {value}"
        ))),
    }
}

fn access(allow: Option<&str>, disallow: Option<&str>) -> Access {
    let lists = |list: &str, class: &str| {
        list.split_whitespace()
            .any(|word| word == class || word == "all")
    };
    let may = |class: &str| match (allow, disallow) {
        (Some(list), _) if !list.is_empty() => lists(list, class),
        (_, Some(list)) => !lists(list, class),
        _ => true,
    };
    Access {
        cars: may("passenger"),
        trucks: may("truck"),
        motor: MOTOR.iter().any(|class| may(class)),
        bicycles: may("bicycle"),
        pedestrians: may("pedestrian"),
    }
}

fn connection(element: &Element<'_>) -> Result<Connection, DataError> {
    let lane = |edge: &str, index: &str| -> Result<String, DataError> {
        let index: usize = element.number(index)?.unwrap_or(0);
        Ok(format!("{}_{index}", element.need(edge)?))
    };
    // An index of -1 means that the system does not control this connection.
    let index = element.number::<i64>("linkIndex")?;
    let index = index.and_then(|index| usize::try_from(index).ok());
    let signal = match (element.get("tl")?, index) {
        (Some(system), Some(index)) => Some((system.into_owned(), index)),
        _ => None,
    };
    let state = element.get("state")?.and_then(|state| state.chars().next());
    Ok(Connection {
        from: lane("from", "fromLane")?,
        to: lane("to", "toLane")?,
        via: element.get("via")?.map(std::borrow::Cow::into_owned),
        signal,
        state: state.unwrap_or('M'),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_may_use_a_lane() {
        let check = |allow, disallow, expected: [bool; 4]| {
            let a = access(allow, disallow);
            assert_eq!([a.cars, a.motor, a.bicycles, a.pedestrians], expected);
        };
        check(None, None, [true; 4]);
        check(Some("pedestrian"), None, [false, false, false, true]);
        check(Some("bicycle pedestrian"), None, [false, false, true, true]);
        check(Some("bus taxi"), None, [false, true, false, false]);
        check(None, Some("pedestrian bicycle"), [true, true, false, false]);
        check(None, Some("all"), [false; 4]);
        check(Some("tram rail_urban"), None, [false; 4]);
    }
}
