//! Bird's-eye rasters of scenes. Filling of pixels is in `gump-geometry`.
//!
//! Start with [`RasterSpec`], which specifies extent, resolution and an ordered list of [`Layer`]s,
//! then [`rasterize`], which renders a [`Raster`].
//!
//! # Terms
//! * **raster frame**: the pose at the centre of the image, +x forward, +y left; usually the
//!   ego's. `world_from_raster` is that pose; rotating it rotates the whole image, map and agents
//!   together.
//! * **layer**: one plane of the image, accessed by name, not by number.
//! * **row, column**: row 0 is ahead (+x up), column 0 is left (+y left). A world point falls on
//!   row `floor((half_extent - x) / metres_per_px)` and column
//!   `floor((half_extent - y) / metres_per_px)` in raster-frame coordinates.
//!
//! Nothing is anti-aliased: a polygon covers the pixels whose centres it contains, a line the
//! pixels it passes through. Values lie in [0, 1], except in the layers for which
//! [`Layer::is_signed`] holds, which use [-1, 1].
//!
//! ```
//! use gump_raster::{Layer, RasterSpec, rasterize};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 100,0
//!      ego vehicle 0: 10,0 velocity 8,0
//!      agent vehicle 1: 30,0",
//! ).unwrap();
//! let scene = scenario.present();
//! let spec = RasterSpec::new(64, 1.0, vec![Layer::BaselinePaths, Layer::Agents]);
//! let raster = rasterize(&spec, &scene, scene.ego_now().state.pose);
//!
//! let (row, column) = raster.pixel_of(gump_geometry::dvec2(30.0, 0.0)).unwrap();
//! assert_eq!((row, column), (12, 32));
//! assert_eq!(raster.get(Layer::Agents).unwrap()[row * 64 + column], 1.0);
//! assert_eq!(raster.get(Layer::BaselinePaths).unwrap()[row * 64 + column], 1.0);
//! ```

mod layer;
mod layers;
mod pixel_frame;
mod raster;
mod rasterize;
mod spec;

#[cfg(test)]
mod tests;

pub use layer::{Layer, UnknownLayer};
pub use raster::Raster;
pub use rasterize::rasterize;
pub use spec::RasterSpec;

/// The numbering of lights in [`Layer::TrafficLightIndex`] and in tokens.
pub use gump_scene::light_indices;
