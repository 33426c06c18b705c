//! Floating-car data: positions of all agents, time step by time step, read as a stream.

use std::collections::BTreeMap;
use std::f64::consts::FRAC_PI_2;
use std::path::{Path, PathBuf};

use gump_geometry::{Pose, dvec2, wrap_angle};

use super::vehicle_types::{Body, VehicleTypes};
use super::xml::{Element, Xml};
use crate::error::MAX_COORDINATE;
use crate::{DataError, ReadReport};

/// At most so many bodies at once: a damaged file must not fill the memory. Chosen by hand.
const MAX_BODIES: usize = 200_000;

/// All bodies at one time.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Snapshot {
    /// Seconds.
    pub(super) time: f64,
    /// By number, each at most once.
    pub(super) bodies: BTreeMap<i64, Placed>,
}

/// A body and where it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Placed {
    pub(super) body: Body,
    /// Box centre and heading.
    pub(super) pose: Pose,
    /// Elevation of the ground below, metres.
    pub(super) ground: f64,
}

/// A file of floating-car data.
pub(super) struct FloatingCars {
    xml: Xml,
    path: PathBuf,
    types: VehicleTypes,
    /// Numbers of vehicles and people by name, in the order in which they appear.
    numbers: BTreeMap<String, i64>,
    /// The next snapshot's time, already read.
    ahead: Option<f64>,
    is_done: bool,
    /// Items dropped so far.
    pub(super) report: ReadReport,
}

impl FloatingCars {
    /// Opens a file.
    pub(super) fn open(path: &Path, types: VehicleTypes) -> Result<Self, DataError> {
        Ok(Self {
            xml: Xml::open(path)?,
            path: path.into(),
            types,
            numbers: BTreeMap::new(),
            ahead: None,
            is_done: false,
            report: ReadReport::default(),
        })
    }

    /// The next time step; `None` after the last.
    pub(super) fn next(&mut self) -> Result<Option<Snapshot>, DataError> {
        if self.is_done {
            return Ok(None);
        }
        let mut snapshot = self.ahead.take().map(|time| Snapshot {
            time,
            ..Snapshot::default()
        });
        // An error ends the file: what follows damage has lost its time step.
        self.is_done = true;
        while let Some(element) = self.xml.next()? {
            match element.name() {
                "timestep" => {
                    let time = element.need_number("time")?;
                    let begun = Snapshot {
                        time,
                        ..Snapshot::default()
                    };
                    if snapshot.is_some() {
                        self.ahead = Some(time);
                        self.is_done = false;
                        return Ok(snapshot);
                    }
                    snapshot = Some(begun);
                }
                "vehicle" | "person" => {
                    let Some(snapshot) = &mut snapshot else {
                        continue;
                    };
                    if snapshot.bodies.len() >= MAX_BODIES {
                        let most = format!("expected at most {MAX_BODIES} bodies in a time step");
                        return Err(element.error(&most));
                    }
                    let placed = placed(&element, &self.types, &mut self.report)?;
                    let name = element.need("id")?;
                    let number = match self.numbers.get(&*name) {
                        Some(number) => *number,
                        None => {
                            let number = self.numbers.len() as i64 + 1;
                            self.numbers.insert(name.into_owned(), number);
                            number
                        }
                    };
                    snapshot.bodies.insert(number, placed);
                }
                _ => {}
            }
        }
        Ok(snapshot)
    }

    /// The reading position, bytes.
    pub(super) fn offset(&self) -> u64 {
        self.xml.offset()
    }

    /// The file.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

fn placed(
    element: &Element<'_>,
    types: &VehicleTypes,
    report: &mut ReadReport,
) -> Result<Placed, DataError> {
    let is_person = element.name() == "person";
    let kind = element.get("type")?.unwrap_or_default();
    let (body, is_known) = types.get(&kind, is_person);
    if !is_known {
        report.infer("size of an unknown vehicle type, in time steps", 1);
    }
    let coordinate = |name| -> Result<f64, DataError> {
        let value: f64 = element.need_number(name)?;
        if value.abs() <= MAX_COORDINATE {
            return Ok(value);
        }
        let most = format!("expected coordinates within {MAX_COORDINATE} m, found {value}");
        Err(element.error(&most))
    };
    let (x, y) = (coordinate("x")?, coordinate("y")?);
    let degrees: f64 = element.need_number("angle")?;
    // Clockwise from north becomes counter-clockwise from east.
    let heading = wrap_angle(FRAC_PI_2 - degrees.rem_euclid(360.0).to_radians());
    let mut pose = Pose {
        position: dvec2(x, y),
        heading,
    };
    if !is_person {
        // SUMO's place of a vehicle is the middle of its front bumper.
        pose.position -= pose.direction() * (body.size[0] / 2.0);
    }
    Ok(Placed {
        body,
        pose,
        ground: element.number("z")?.unwrap_or(0.0),
    })
}
