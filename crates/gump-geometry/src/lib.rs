//! Points, poses, boxes, polylines, polygons, a spatial index and pixel filling.
//!
//! Everything here is plane geometry in f64 metres and radians; nothing knows what a car or a
//! lane is. Points are [`glam::DVec2`]. Start with [`Pose`], then [`Polyline`] and
//! [`OrientedBox`].
//!
//! # Terms
//! * **pose**: position and heading; as a transform it maps its own frame to the frame it is
//!   expressed in, written `world_from_box * point_in_box`.
//! * **heading**: radians, counter-clockwise from +x, wrapped to [-π, π).
//! * **arc length**: metres along a polyline from its first point.
//! * **lateral**: signed metres to the left (+) or right (-) of a polyline's direction.

mod distance;
mod fast;
mod fill;
mod index;
mod oriented_box;
mod polygon;
mod polyline;
mod pose;
mod quad;

pub use distance::{cross, distance_to_segment, project_on_segment, segments_intersect};
pub use fast::{LineIndex, PolygonIndex};
pub use fill::{Canvas, fill_disc, fill_polygon, stroke_polyline};
pub use index::{BoxIndex, PointIndex, SegmentIndex};
pub use oriented_box::OrientedBox;
pub use polygon::Polygon;
pub use polyline::{Polyline, Projection};
pub use pose::{Pose, angle_difference, interpolate_angle, wrap_angle};
pub use quad::{Quad, joint, widen};

pub use glam::{DVec2, DVec3, dvec2, dvec3};
