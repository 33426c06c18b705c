//! The one transform from the world to pixels, shared by everything that is drawn or looked up.

use gump_geometry::{DVec2, Polygon, Polyline, Pose, dvec2};

use crate::RasterSpec;

/// Maps world points to continuous pixel coordinates, x along columns and y along rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PixelFrame {
    /// World position of the raster's centre, metres.
    pub(crate) centre: DVec2,
    /// World direction of "ahead", unit length.
    pub(crate) ahead: DVec2,
    pub(crate) side_px: usize,
    pub(crate) metres_per_px: f64,
}

impl PixelFrame {
    pub(crate) fn new(spec: &RasterSpec, world_from_raster: Pose) -> Self {
        Self {
            centre: world_from_raster.position,
            ahead: world_from_raster.direction(),
            side_px: spec.side_px,
            metres_per_px: spec.metres_per_px,
        }
    }

    /// Half the side, metres.
    pub(crate) fn half_extent(&self) -> f64 {
        self.side_px as f64 * self.metres_per_px / 2.0
    }

    /// The continuous pixel coordinates (column, row) of a world point.
    pub(crate) fn pixel(&self, point: DVec2) -> DVec2 {
        // The difference first: world coordinates are large, and this keeps them from cancelling.
        let offset = point - self.centre;
        let (x, y) = (self.ahead.dot(offset), self.ahead.perp_dot(offset));
        (DVec2::splat(self.half_extent()) - dvec2(y, x)) / self.metres_per_px
    }

    /// Replaces the content of `pixels` by the pixel coordinates of `points`; false if their
    /// bounding box misses the canvas.
    pub(crate) fn project(
        &self,
        points: impl IntoIterator<Item = DVec2>,
        pixels: &mut Vec<DVec2>,
    ) -> bool {
        pixels.clear();
        let (mut min, mut max) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for point in points {
            let pixel = self.pixel(point);
            (min, max) = (min.min(pixel), max.max(pixel));
            pixels.push(pixel);
        }
        let side = self.side_px as f64;
        max.cmpge(DVec2::ZERO).all() && min.cmple(DVec2::splat(side)).all()
    }

    /// False if no point within `margin` metres of the line can be on the canvas; constant time.
    pub(crate) fn may_show_line(&self, line: &Polyline, margin: f64) -> bool {
        self.may_show_disc(line.points()[0], line.length() + margin)
    }

    /// False if no point of the polygon can be on the canvas; constant time.
    pub(crate) fn may_show_polygon(&self, polygon: &Polygon) -> bool {
        let (min, max) = polygon.bounds();
        self.may_show_disc((min + max) / 2.0, min.distance(max) / 2.0)
    }

    fn may_show_disc(&self, centre: DVec2, radius: f64) -> bool {
        let reach = self.half_extent() * std::f64::consts::SQRT_2 + radius;
        self.centre.distance_squared(centre) <= reach * reach
    }
}
