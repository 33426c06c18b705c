//! Drawing of the layers, one file per theme. A new layer is a variant of [`Layer`](crate::Layer),
//! a function here and an arm in `rasterize`.

pub(crate) mod agents;
pub(crate) mod lanes;
pub(crate) mod lights;
pub(crate) mod planes;
pub(crate) mod roads;

use gump_geometry::{
    Canvas, DVec2, OrientedBox, Polygon, Polyline, fill_disc, fill_polygon, stroke_polyline,
};

use crate::pixel_frame::PixelFrame;

/// A plane to draw world geometry on.
pub(crate) struct Plane<'a> {
    pixels: &'a mut [f32],
    frame: PixelFrame,
    /// Pixel coordinates of the shape at hand, kept to save allocations.
    projected: Vec<DVec2>,
}

impl<'a> Plane<'a> {
    /// Wraps a plane of `frame.side_px` rows and columns.
    pub(crate) fn new(pixels: &'a mut [f32], frame: PixelFrame) -> Self {
        Self {
            pixels,
            frame,
            projected: Vec::new(),
        }
    }

    /// Strokes a world polyline one pixel wide.
    fn line(&mut self, line: &Polyline, value: f32) {
        if self.frame.may_show_line(line, 0.0) {
            self.stroke(line.points().iter().copied(), value);
        }
    }

    /// Strokes world points one pixel wide.
    fn stroke(&mut self, points: impl IntoIterator<Item = DVec2>, value: f32) {
        let side = self.frame.side_px;
        if self.frame.project(points, &mut self.projected) {
            let mut canvas = Canvas::new(self.pixels, side, side);
            stroke_polyline(&mut canvas, &self.projected, value);
        }
    }

    /// Fills a world polygon.
    fn polygon(&mut self, polygon: &Polygon, value: f32) {
        if self.frame.may_show_polygon(polygon) {
            self.fill(polygon.ring().iter().copied(), value);
        }
    }

    /// Fills the ring of world points.
    fn fill(&mut self, ring: impl IntoIterator<Item = DVec2>, value: f32) {
        let side = self.frame.side_px;
        if self.frame.project(ring, &mut self.projected) {
            let mut canvas = Canvas::new(self.pixels, side, side);
            fill_polygon(&mut canvas, &self.projected, value);
        }
    }

    /// Fills a box, and the pixel of its centre in any case: a pedestrian may miss every centre
    /// of a pixel.
    fn oriented_box(&mut self, shape: &OrientedBox, value: f32) {
        self.fill(shape.corners(), value);
        self.stroke([shape.pose.position], value);
    }

    /// Fills a disc of `radius` metres, at least one pixel.
    fn disc(&mut self, centre: DVec2, radius: f64, value: f32) {
        let side = self.frame.side_px;
        let radius = (radius / self.frame.metres_per_px).max(1.0);
        let mut canvas = Canvas::new(self.pixels, side, side);
        fill_disc(&mut canvas, self.frame.pixel(centre), radius, value);
    }
}
