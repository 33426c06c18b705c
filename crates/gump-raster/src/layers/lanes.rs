//! Lane centre lines, lane surfaces and the route.

use gump_geometry::{DVec2, dvec2};
use gump_scene::{Lane, MapGraph, SceneState, TYPICAL_SPEED_LIMIT};

use super::Plane;
use crate::pixel_frame::PixelFrame;

/// Speeds are divided by this, metres per second; from the paper's code.
pub(super) const SPEED_SCALE: f64 = 24.0;

pub(crate) fn draw_baseline_paths(plane: &mut Plane<'_>, map: &MapGraph) {
    for lane in map.lanes() {
        plane.line(&lane.centerline, 1.0);
    }
}

pub(crate) fn draw_route(plane: &mut Plane<'_>, scene: &SceneState<'_>) {
    let Some(route) = scene.route else { return };
    let lanes: Vec<&Lane> = route
        .lanes
        .iter()
        .filter_map(|&id| scene.map.lane(id))
        .collect();
    for lane in &lanes {
        if plane.frame.may_show_line(&lane.centerline, lane.width) {
            for quad in ribbon(lane, plane.frame.metres_per_px) {
                plane.fill(quad.corners, 1.0);
            }
            plane.line(&lane.centerline, 1.0);
        }
    }
    if lanes.is_empty() {
        plane.line(&route.path, 1.0);
    }
}

/// The lane piece that covers each pixel, painted once and read by several layers.
///
/// Where lanes overlap the later one in the map wins, except on centre lines, which always belong
/// to their own lane or another centre line.
pub(crate) struct LaneSurfaces {
    /// Per pixel 1 + index into `segments`, or 0; whole numbers below 2^24, exact in an f32.
    owner: Vec<f32>,
    segments: Vec<SurfaceSegment>,
}

/// Values of one piece of a lane.
pub(crate) struct SurfaceSegment {
    /// Cosine and sine of its direction in the raster frame.
    pub(crate) direction: [f32; 2],
    /// Speed limit over [`SPEED_SCALE`], in [0, 1]; [`TYPICAL_SPEED_LIMIT`] where none is stated,
    /// since 0 would mean that traffic must not move.
    pub(crate) speed_limit: f32,
}

impl LaneSurfaces {
    pub(crate) fn paint(map: &MapGraph, frame: &PixelFrame) -> Self {
        let mut owner = vec![0.0; frame.side_px * frame.side_px];
        let mut plane = Plane::new(&mut owner, *frame);
        let mut segments = Vec::new();
        let mut centres = Vec::new();
        let lanes = map.lanes().iter();
        for lane in lanes.filter(|lane| frame.may_show_line(&lane.centerline, lane.width)) {
            let limit = lane.speed_limit.unwrap_or(TYPICAL_SPEED_LIMIT) / SPEED_SCALE;
            for quad in ribbon(lane, frame.metres_per_px) {
                let along = (quad.to - quad.from).normalize_or_zero();
                segments.push(SurfaceSegment {
                    direction: [
                        frame.ahead.dot(along) as f32,
                        frame.ahead.perp_dot(along) as f32,
                    ],
                    speed_limit: limit.clamp(0.0, 1.0) as f32,
                });
                let number = segments.len() as f32;
                plane.fill(quad.corners, number);
                centres.push(([quad.from, quad.to], number));
            }
        }
        for (centre, number) in centres {
            plane.stroke(centre, number);
        }
        Self { owner, segments }
    }

    /// Sets every covered pixel to `value` of the piece that covers it.
    pub(crate) fn draw(&self, plane: &mut Plane<'_>, value: impl Fn(&SurfaceSegment) -> f32) {
        for (pixel, &owner) in plane.pixels.iter_mut().zip(&self.owner) {
            if owner > 0.0 {
                *pixel = value(&self.segments[owner as usize - 1]);
            }
        }
    }
}

/// A piece of a lane's surface.
struct Quad {
    /// Start and end on the centre line.
    from: DVec2,
    to: DVec2,
    /// Left start, left end, right end, right start.
    corners: [DVec2; 4],
}

/// Cuts a lane's surface into quads that share their edges, each some two pixels long.
///
/// Points nearer than that to the last one kept are passed over: on a bend of 5 m radius the chord
/// stays within a fifth of a pixel of the line, and a raster of a map with points every half metre
/// takes half the time.
fn ribbon(lane: &Lane, metres_per_px: f64) -> impl Iterator<Item = Quad> {
    let points = lane.centerline.points();
    let mut kept: Vec<DVec2> = Vec::with_capacity(points.len());
    for (i, &point) in points.iter().enumerate() {
        let near = |last: &DVec2| last.distance_squared(point) < (2.0 * metres_per_px).powi(2);
        if i + 1 == points.len() || !kept.last().is_some_and(near) {
            kept.push(point);
        }
    }
    let half = lane.width / 2.0;
    let side = move |kept: &[DVec2], i: usize| {
        let (before, after) = (kept[i.saturating_sub(1)], kept[(i + 1).min(kept.len() - 1)]);
        let along = (after - before).normalize_or_zero();
        dvec2(-along.y, along.x) * half
    };
    (1..kept.len()).map(move |i| {
        let (from, to) = (kept[i - 1], kept[i]);
        let (a, b) = (side(&kept, i - 1), side(&kept, i));
        Quad {
            from,
            to,
            corners: [from + a, to + b, to - b, from - a],
        }
    })
}
