//! A pixmap to draw world geometry on, anti-aliased.

use gump_geometry::{DVec2, Polyline};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pattern, Pixmap, Shader, Stroke,
    StrokeDash, Transform,
};

use crate::Camera;
use crate::theme::Rgb;

/// Draws in world coordinates through a camera.
pub(crate) struct Pen<'a> {
    pub(crate) pixmap: &'a mut Pixmap,
    pub(crate) camera: Camera,
}

impl<'a> Pen<'a> {
    pub(crate) fn new(pixmap: &'a mut Pixmap, camera: Camera) -> Self {
        Self { pixmap, camera }
    }

    /// `metres` in pixels, but at least `min_px`.
    pub(crate) fn px(&self, metres: f64, min_px: f32) -> f32 {
        ((metres * self.camera.scale()) as f32).max(min_px)
    }

    /// Fills a path with an opacity in [0, 1].
    pub(crate) fn fill(&mut self, path: Shape, colour: Rgb, opacity: f32) {
        if let Some(path) = path.finish() {
            let paint = paint(colour, opacity);
            let identity = Transform::identity();
            self.pixmap
                .fill_path(&path, &paint, FillRule::Winding, identity, None);
        }
    }

    /// Fills a path with bars of a colour across `direction` (a pixel-space vector), `period`
    /// pixels apart and half as wide.
    pub(crate) fn hatch(&mut self, path: Shape, colour: Rgb, direction: DVec2, period: f32) {
        // Pixels of the pattern, half of them coloured; they are scaled to the period.
        const STEPS: u32 = 16;
        let (Some(path), Some(mut tile)) = (path.finish(), Pixmap::new(STEPS, 1)) else {
            return;
        };
        let [r, g, b] = colour;
        for pixel in &mut tile.pixels_mut()[..STEPS as usize / 2] {
            *pixel = tiny_skia::ColorU8::from_rgba(r, g, b, 0xFF).premultiply();
        }
        let zoom = period / STEPS as f32;
        let turn = direction.to_angle().to_degrees() as f32;
        let shader = Pattern::new(
            tile.as_ref(),
            tiny_skia::SpreadMode::Repeat,
            tiny_skia::FilterQuality::Bilinear,
            1.0,
            Transform::from_scale(zoom, zoom).post_rotate(turn),
        );
        let paint = Paint {
            shader,
            ..Paint::default()
        };
        let identity = Transform::identity();
        self.pixmap
            .fill_path(&path, &paint, FillRule::Winding, identity, None);
    }

    /// Strokes a path.
    pub(crate) fn stroke(&mut self, path: Shape, colour: Rgb, opacity: f32, width_px: f32) {
        self.stroke_path(
            path.finish(),
            colour,
            opacity,
            width_px,
            LineCap::Round,
            None,
        );
    }

    /// Strokes a path with blunt ends, so that translucent pieces can follow one another.
    pub(crate) fn trail(&mut self, path: Shape, colour: Rgb, opacity: f32, width_px: f32) {
        self.stroke_path(
            path.finish(),
            colour,
            opacity,
            width_px,
            LineCap::Butt,
            None,
        );
    }

    /// Strokes a path with dashes and gaps of these lengths, pixels.
    pub(crate) fn dash(&mut self, path: Shape, colour: Rgb, width_px: f32, dash: [f32; 2]) {
        let dash = StrokeDash::new(dash.to_vec(), 0.0);
        self.stroke_path(path.finish(), colour, 1.0, width_px, LineCap::Butt, dash);
    }

    fn stroke_path(
        &mut self,
        path: Option<Path>,
        colour: Rgb,
        opacity: f32,
        width: f32,
        line_cap: LineCap,
        dash: Option<StrokeDash>,
    ) {
        let stroke = Stroke {
            width,
            line_cap,
            line_join: LineJoin::Round,
            dash,
            ..Stroke::default()
        };
        if let Some(path) = path {
            let paint = paint(colour, opacity);
            let identity = Transform::identity();
            self.pixmap
                .stroke_path(&path, &paint, &stroke, identity, None);
        }
    }

    /// True if some of the line may be in view; constant time.
    pub(crate) fn may_see_line(&self, line: &Polyline, margin: f64) -> bool {
        self.camera
            .may_see(line.points()[0], line.length() + margin)
    }
}

/// A path under construction, fed with world points and kept in pixels.
pub(crate) struct Shape {
    camera: Camera,
    builder: PathBuilder,
}

impl Shape {
    pub(crate) fn new(camera: &Camera) -> Self {
        Self {
            camera: *camera,
            builder: PathBuilder::new(),
        }
    }

    /// Appends an open line through world points; a line of one point is left out.
    pub(crate) fn line(&mut self, points: impl IntoIterator<Item = DVec2>) {
        let mut points = points.into_iter().map(|p| self.camera.pixel(p));
        let Some(first) = points.next() else { return };
        let mut begun = false;
        let mut last = first;
        for point in points {
            // A fifth of a pixel cannot be seen, and dense maps have many such steps.
            if point.distance_squared(last) < 0.04 {
                continue;
            }
            if !begun {
                self.builder.move_to(first.x as f32, first.y as f32);
                begun = true;
            }
            self.builder.line_to(point.x as f32, point.y as f32);
            last = point;
        }
    }

    /// Appends a closed ring of world points.
    pub(crate) fn ring(&mut self, points: impl IntoIterator<Item = DVec2>) {
        let mut empty = true;
        for point in points {
            let p = self.camera.pixel(point);
            if empty {
                self.builder.move_to(p.x as f32, p.y as f32);
                empty = false;
            } else {
                self.builder.line_to(p.x as f32, p.y as f32);
            }
        }
        if !empty {
            self.builder.close();
        }
    }

    /// Appends a closed ring whose corners are rounded off by `radius` pixels.
    pub(crate) fn rounded(&mut self, corners: &[DVec2], radius: f64) {
        let pixels: Vec<DVec2> = corners.iter().map(|&c| self.camera.pixel(c)).collect();
        let n = pixels.len();
        for i in 0..n {
            let (before, corner, after) = (pixels[(i + n - 1) % n], pixels[i], pixels[(i + 1) % n]);
            let toward = |other: DVec2| {
                let way = other - corner;
                corner + way.normalize_or_zero() * radius.min(way.length() / 2.0)
            };
            let (from, to) = (toward(before), toward(after));
            if i == 0 {
                self.builder.move_to(from.x as f32, from.y as f32);
            } else {
                self.builder.line_to(from.x as f32, from.y as f32);
            }
            let c = corner.as_vec2();
            self.builder.quad_to(c.x, c.y, to.x as f32, to.y as f32);
        }
        if n > 0 {
            self.builder.close();
        }
    }

    /// Appends a disc around a world point, radius in pixels.
    pub(crate) fn disc(&mut self, centre: DVec2, radius_px: f32) {
        let p = self.camera.pixel(centre).as_vec2();
        self.builder.push_circle(p.x, p.y, radius_px);
    }

    fn finish(self) -> Option<Path> {
        self.builder.finish()
    }
}

pub(crate) fn paint(colour: Rgb, opacity: f32) -> Paint<'static> {
    let [r, g, b] = colour;
    let alpha = (opacity.clamp(0.0, 1.0) * 255.0).round() as u8;
    Paint {
        shader: Shader::SolidColor(Color::from_rgba8(r, g, b, alpha)),
        ..Paint::default()
    }
}
