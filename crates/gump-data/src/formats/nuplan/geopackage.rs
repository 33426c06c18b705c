//! Access to a GeoPackage map as rows: the layers of nuPlan's maps, projected to the plane.
//!
//! `map` combines the layers. Start with [`GeoPackage::open`].

use std::path::Path;

use gump_geometry::{DVec2, Polygon};
use rusqlite::Row;
use rusqlite::types::ValueRef;

use super::Utm;
use super::database::Database;
use super::wkb::{self, Shape};
use crate::error::MAX_COORDINATE;
use crate::{DataError, ReadReport};

/// The layer that names the projection of the map.
const META: &str = "meta";

/// An open map.
pub(super) struct GeoPackage {
    database: Database,
    projection: Utm,
    epsg: i64,
}

/// One feature of a layer: its id, its shape, and what else was asked for.
pub(super) struct Feature<T> {
    pub(super) fid: i64,
    pub(super) shape: PlaneShape,
    pub(super) columns: T,
}

/// A shape in the map's projection, metres.
pub(super) enum PlaneShape {
    Points,
    Lines(Vec<Vec<DVec2>>),
    Polygons(Vec<Polygon>),
}

impl GeoPackage {
    /// Opens a map and reads its projection.
    ///
    /// Error: those of opening a database; [`DataError::Table`] if it is no map or its projection
    /// is not UTM.
    pub(super) fn open(path: &Path) -> Result<Self, DataError> {
        let database = Database::open(path)?;
        database.require(META, &["key", "value"])?;
        let sql = "SELECT value FROM meta WHERE key = 'projectedCoordSystem'";
        let codes: Vec<String> =
            database.rows("read the projection of the map", sql, [], |row| row.get(0))?;
        let text = codes.first().map_or("none", String::as_str);
        let code = text
            .to_ascii_lowercase()
            .strip_prefix("epsg:")
            .map(str::to_owned);
        let epsg = code.and_then(|code| code.trim().parse::<i64>().ok());
        let known = epsg.and_then(|code| Some((code, Utm::from_epsg(code)?)));
        let Some((epsg, projection)) = known else {
            return Err(DataError::Table {
                expected: "a UTM projection (epsg:326xx) under projectedCoordSystem".into(),
                found: format!("\"{text}\""),
                path: path.into(),
            });
        };
        Ok(Self {
            database,
            projection,
            epsg,
        })
    }

    /// The EPSG code of the projection.
    pub(super) fn epsg(&self) -> i64 {
        self.epsg
    }

    /// True if the map has this layer.
    pub(super) fn has(&self, layer: &str) -> Result<bool, DataError> {
        Ok(!self.database.columns(layer)?.is_empty())
    }

    /// The features of a layer in order of their ids. A feature whose shape is damaged is left out,
    /// counted and named.
    ///
    /// Error: [`DataError::Table`] for a missing layer or column, [`DataError::Sqlite`].
    pub(super) fn layer<T>(
        &self,
        layer: &'static str,
        columns: &[&str],
        report: &mut ReadReport,
        mut read: impl FnMut(&Row<'_>) -> rusqlite::Result<T>,
    ) -> Result<Vec<Feature<T>>, DataError> {
        let all: Vec<&str> = ["fid", "geom"].iter().chain(columns).copied().collect();
        self.database.require(layer, &all)?;
        // Columns asked for come first, so that `read` counts from 0.
        let selected: String = columns.iter().map(|column| format!("{column}, ")).collect();
        let sql = format!("SELECT {selected}fid, geom FROM {layer} ORDER BY fid");
        let n = columns.len();
        let rows = self
            .database
            .rows("read a layer of the map", &sql, [], |row| {
                let shape = match row.get_ref(n + 1)? {
                    ValueRef::Blob(blob) => wkb::parse(blob),
                    other => Err(format!("expected a shape, found {}", other.data_type())),
                };
                let shape = shape.and_then(|shape| project(shape, &self.projection));
                Ok((row.get::<_, i64>(n)?, shape, read(row)?))
            })?;
        let mut features = Vec::with_capacity(rows.len());
        for (fid, shape, columns) in rows {
            match shape {
                Ok(shape) => features.push(Feature {
                    fid,
                    shape,
                    columns,
                }),
                Err(problem) => {
                    report.drop_damaged("map feature whose shape is damaged", || {
                        format!("{layer} {fid}: {problem}")
                    });
                }
            }
        }
        Ok(features)
    }
}

impl<T> Feature<T> {
    /// The line, if it is one line of at least one point.
    pub(super) fn line(&self) -> Option<&[DVec2]> {
        match &self.shape {
            PlaneShape::Lines(lines) => lines
                .iter()
                .find(|line| !line.is_empty())
                .map(Vec::as_slice),
            _ => None,
        }
    }

    pub(super) fn polygons(&self) -> &[Polygon] {
        match &self.shape {
            PlaneShape::Polygons(polygons) => polygons,
            _ => &[],
        }
    }

    /// The largest of its polygons; there is one, as a rule.
    pub(super) fn polygon(&self) -> Option<&Polygon> {
        let area = |polygon: &&Polygon| polygon.signed_area().abs();
        let polygons = self.polygons().iter();
        polygons.max_by(|a, b| area(a).total_cmp(&area(b)))
    }
}

/// Error: a sentence, for a place off the Earth and a polygon without corners.
fn project(shape: Shape, projection: &Utm) -> Result<PlaneShape, String> {
    let point = |[longitude, latitude]: [f64; 2]| {
        if !(longitude.abs() <= 180.0 && latitude.abs() <= 90.0) {
            return Err(format!(
                "expected longitude and latitude, found {longitude}, {latitude}"
            ));
        }
        let p = projection.project(longitude, latitude);
        if p.abs().max_element() <= MAX_COORDINATE {
            Ok(p)
        } else {
            Err(format!(
                "{longitude}, {latitude} is far outside the map's zone"
            ))
        }
    };
    let line = |points: Vec<[f64; 2]>| -> Result<Vec<DVec2>, String> {
        points.into_iter().map(point).collect()
    };
    let polygon = |rings: Vec<Vec<[f64; 2]>>| {
        let mut rings = rings
            .into_iter()
            .map(line)
            .collect::<Result<Vec<_>, _>>()?
            .into_iter();
        let outer = rings.next().unwrap_or_default();
        let polygon = Polygon::with_holes(outer, rings.collect());
        polygon.ok_or_else(|| "expected a ring of at least 3 points".to_owned())
    };
    Ok(match shape {
        Shape::Points(points) => {
            line(points)?;
            PlaneShape::Points
        }
        Shape::Lines(lines) => {
            PlaneShape::Lines(lines.into_iter().map(line).collect::<Result<_, _>>()?)
        }
        Shape::Polygons(polygons) => PlaneShape::Polygons(
            polygons
                .into_iter()
                .map(polygon)
                .collect::<Result<_, _>>()?,
        ),
    })
}
