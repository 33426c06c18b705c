//! The rendered image.

use gump_geometry::{DVec2, Pose};

use crate::Layer;
use crate::pixel_frame::PixelFrame;

/// A bird's-eye image with one plane per layer.
#[derive(Clone, Debug, PartialEq)]
pub struct Raster {
    /// The planes, in the order in which `data` stores them.
    pub layers: Vec<Layer>,
    /// Pixels along each side.
    pub side_px: usize,
    /// Metres along each side of a pixel.
    pub metres_per_px: f64,
    /// All values, `[layer, row, column]`, row 0 ahead, column 0 left.
    pub data: Vec<f32>,
    /// The transform from world points to the raster frame, whose origin is the centre of the
    /// image.
    pub raster_from_world: Pose,
    pub(crate) frame: PixelFrame,
}

impl Raster {
    /// The lengths of the axes: layers, rows, columns.
    pub fn shape(&self) -> [usize; 3] {
        [self.layers.len(), self.side_px, self.side_px]
    }

    /// Plane number `i`, `[row, column]`.
    ///
    /// # Panics
    /// If there are fewer planes.
    pub fn layer(&self, i: usize) -> &[f32] {
        let area = self.side_px * self.side_px;
        &self.data[i * area..(i + 1) * area]
    }

    /// The plane of this layer, `[row, column]`; `None` if the raster has none.
    pub fn get(&self, layer: Layer) -> Option<&[f32]> {
        let i = self.layers.iter().position(|&l| l == layer)?;
        Some(self.layer(i))
    }

    /// The (row, column) of the pixel on which a world point falls; `None` off the image.
    pub fn pixel_of(&self, point: DVec2) -> Option<(usize, usize)> {
        let pixel = self.frame.pixel(point);
        let inside = |v: f64| (0.0..self.side_px as f64).contains(&v);
        (inside(pixel.x) && inside(pixel.y)).then_some((pixel.y as usize, pixel.x as usize))
    }
}
