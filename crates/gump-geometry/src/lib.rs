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
//!
//! ```
//! use gump_geometry::{OrientedBox, Polyline, Pose, dvec2};
//!
//! let lane = Polyline::new(vec![dvec2(0.0, 0.0), dvec2(30.0, 40.0)]).unwrap();
//! let car = OrientedBox { pose: lane.pose_at(10.0), length: 4.8, width: 2.0 };
//! let ahead = OrientedBox { pose: lane.pose_at(20.0), ..car };
//! // Bumper to bumper; then where the first car's front is, and how far along the lane that is.
//! assert!((car.signed_distance(&ahead) - 5.2).abs() < 1e-9);
//! let world_from_car: Pose = car.pose;
//! let front = world_from_car * dvec2(2.4, 0.0);
//! let projection = lane.project(front);
//! assert!((projection.arc_length - 12.4).abs() < 1e-9 && projection.lateral.abs() < 1e-9);
//! ```

mod distance;
mod fast;
mod fill;
mod index;
mod oriented_box;
mod polygon;
mod polyline;
mod pose;
mod quad;
mod simplify;

pub use distance::{cross, distance_to_segment, project_on_segment, segments_intersect};
pub use fast::{LineIndex, PolygonIndex};
pub use fill::{Canvas, fill_disc, fill_polygon, stroke_polyline};
pub use index::{BoxIndex, PointIndex, SegmentIndex};
pub use oriented_box::OrientedBox;
pub use polygon::Polygon;
pub use polyline::{Polyline, Projection};
pub use pose::{Pose, angle_difference, interpolate_angle, wrap_angle};
pub use quad::{Quad, joint, widen};
pub use simplify::simplify;

pub use glam::{DVec2, DVec3, dvec2, dvec3};
