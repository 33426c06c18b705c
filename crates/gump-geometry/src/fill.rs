//! Pixel filling on a grid: polygons, lines and discs without anti-aliasing.
//!
//! The grid frame is continuous: pixel (row, column) covers `row..row + 1` by
//! `column..column + 1`, so its centre is at +0.5. `x` runs along columns, `y` along rows. What
//! metres mean is the caller's business.

use glam::DVec2;

/// A plane of pixels to draw on, row-major.
#[derive(Debug)]
pub struct Canvas<'a> {
    pixels: &'a mut [f32],
    width: usize,
    height: usize,
}

impl<'a> Canvas<'a> {
    /// Wraps `pixels`, which must hold `height` rows of `width` values.
    ///
    /// # Panics
    /// If the length does not match: the caller sized the buffer.
    pub fn new(pixels: &'a mut [f32], width: usize, height: usize) -> Self {
        assert_eq!(
            pixels.len(),
            width * height,
            "a canvas holds height x width pixels"
        );
        Self {
            pixels,
            width,
            height,
        }
    }

    /// Sets the pixel that contains the point, if there is one.
    pub fn set(&mut self, column: i64, row: i64, value: f32) {
        if (0..self.width as i64).contains(&column) && (0..self.height as i64).contains(&row) {
            self.pixels[row as usize * self.width + column as usize] = value;
        }
    }
}

/// Fills the area inside `ring` with `value`.
///
/// A pixel is inside when its centre is, by the even-odd rule; an edge shared by two polygons is
/// drawn once. Rings with fewer than 3 points fill nothing.
///
/// Units: `ring` in pixels, x along columns, y along rows.
/// Source: scan-line conversion after Foley et al. 1990, ch. 3.
pub fn fill_polygon(canvas: &mut Canvas<'_>, ring: &[DVec2], value: f32) {
    if ring.len() < 3 || ring.iter().any(|p| !p.is_finite()) {
        return;
    }
    let low = ring.iter().map(|p| p.y).fold(f64::INFINITY, f64::min);
    let high = ring.iter().map(|p| p.y).fold(f64::NEG_INFINITY, f64::max);
    let first = (low - 0.5).ceil().max(0.0) as usize;
    let last = (high - 0.5).ceil().clamp(0.0, canvas.height as f64) as usize;
    let mut crossings: Vec<f64> = Vec::new();
    for row in first..last {
        let y = row as f64 + 0.5;
        crossings.clear();
        for i in 0..ring.len() {
            let (a, b) = (ring[i], ring[(i + 1) % ring.len()]);
            if (a.y <= y) != (b.y <= y) {
                crossings.push(a.x + (y - a.y) / (b.y - a.y) * (b.x - a.x));
            }
        }
        crossings.sort_by(f64::total_cmp);
        for span in crossings.chunks_exact(2) {
            let from = (span[0] - 0.5).ceil().clamp(0.0, canvas.width as f64) as usize;
            let to = (span[1] - 0.5).ceil().clamp(0.0, canvas.width as f64) as usize;
            if from < to {
                canvas.pixels[row * canvas.width + from..row * canvas.width + to].fill(value);
            }
        }
    }
}

/// Draws `points` as a connected line one pixel wide.
///
/// Every pixel the line passes through nearest to its centre along the steeper axis is set
/// (a DDA walk), so the line is 8-connected and has no gaps.
pub fn stroke_polyline(canvas: &mut Canvas<'_>, points: &[DVec2], value: f32) {
    for pair in points.windows(2) {
        stroke_segment(canvas, pair[0], pair[1], value);
    }
    if let [only] = points {
        canvas.set(only.x.floor() as i64, only.y.floor() as i64, value);
    }
}

/// Fills a disc of `radius` pixels around `centre`.
pub fn fill_disc(canvas: &mut Canvas<'_>, centre: DVec2, radius: f64, value: f32) {
    if !centre.is_finite() {
        return;
    }
    let (low, high) = ((centre - radius).floor(), (centre + radius).ceil());
    for row in low.y as i64..=high.y as i64 {
        for column in low.x as i64..=high.x as i64 {
            let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
            if pixel.distance_squared(centre) <= radius * radius {
                canvas.set(column, row, value);
            }
        }
    }
}

fn stroke_segment(canvas: &mut Canvas<'_>, a: DVec2, b: DVec2, value: f32) {
    let Some((a, b)) = clip(a, b, canvas.width as f64, canvas.height as f64) else {
        return;
    };
    // A little under one pixel a step: at exactly one, rounding could skip a pixel where the
    // coordinates are whole numbers.
    let steps = ((b - a).abs().max_element() * 1.0001).ceil().max(1.0);
    for i in 0..=steps as usize {
        let p = a.lerp(b, i as f64 / steps);
        canvas.set(p.x.floor() as i64, p.y.floor() as i64, value);
    }
}

/// The part of the segment on the canvas (Liang–Barsky), so that far ends cost nothing.
fn clip(a: DVec2, b: DVec2, width: f64, height: f64) -> Option<(DVec2, DVec2)> {
    if !a.is_finite() || !b.is_finite() {
        return None;
    }
    let d = b - a;
    let (mut enter, mut leave) = (0.0f64, 1.0f64);
    for (p, q) in [
        (-d.x, a.x),
        (d.x, width - a.x),
        (-d.y, a.y),
        (d.y, height - a.y),
    ] {
        if p == 0.0 {
            if q < 0.0 {
                return None;
            }
        } else if p < 0.0 {
            enter = enter.max(q / p);
        } else {
            leave = leave.min(q / p);
        }
    }
    (enter <= leave).then(|| (a + d * enter, a + d * leave))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::dvec2;

    fn draw(f: impl Fn(&mut Canvas<'_>)) -> String {
        let mut pixels = vec![0.0; 6 * 4];
        f(&mut Canvas::new(&mut pixels, 6, 4));
        let rows = pixels.chunks(6).map(|row| {
            row.iter()
                .map(|&v| if v > 0.0 { '#' } else { '.' })
                .collect::<String>()
        });
        rows.collect::<Vec<_>>().join("\n")
    }

    #[test]
    fn a_pixel_is_inside_when_its_centre_is() {
        let ring = [
            dvec2(1.0, 1.0),
            dvec2(4.4, 1.0),
            dvec2(4.4, 3.0),
            dvec2(1.0, 3.0),
        ];
        assert_eq!(
            draw(|c| fill_polygon(c, &ring, 1.0)),
            "......\n.###..\n.###..\n......"
        );
    }

    #[test]
    fn shared_edges_are_drawn_once() {
        let mut pixels = vec![0.0; 16];
        let mut canvas = Canvas::new(&mut pixels, 4, 4);
        let left = [
            dvec2(0.0, 0.0),
            dvec2(2.5, 0.0),
            dvec2(1.5, 4.0),
            dvec2(0.0, 4.0),
        ];
        let right = [
            dvec2(2.5, 0.0),
            dvec2(4.0, 0.0),
            dvec2(4.0, 4.0),
            dvec2(1.5, 4.0),
        ];
        fill_polygon(&mut canvas, &left, 1.0);
        let before = canvas.pixels.to_vec();
        let mut second = vec![0.0; 16];
        fill_polygon(&mut Canvas::new(&mut second, 4, 4), &right, 1.0);
        assert!(before.iter().zip(&second).all(|(a, b)| a + b == 1.0));
    }

    #[test]
    fn lines_have_no_gaps_and_survive_far_ends() {
        assert_eq!(
            draw(|c| stroke_polyline(c, &[dvec2(0.5, 0.5), dvec2(5.5, 3.5)], 1.0))
                .matches('#')
                .count(),
            6
        );
        let far = draw(|c| stroke_polyline(c, &[dvec2(-1e9, 2.5), dvec2(1e9, 2.5)], 1.0));
        assert_eq!(far.lines().nth(2).unwrap(), "######");
        assert_eq!(
            draw(|c| stroke_polyline(c, &[dvec2(f64::NAN, 0.0), dvec2(1.0, 1.0)], 1.0))
                .matches('#')
                .count(),
            0
        );
    }

    #[test]
    fn lines_on_pixel_borders_have_no_gaps() {
        for length in 1..400 {
            let mut pixels = vec![0.0; 400];
            let (a, b) = (dvec2(0.0, 0.5), dvec2(f64::from(length), 0.5));
            stroke_polyline(&mut Canvas::new(&mut pixels, 400, 1), &[b, a], 1.0);
            let n_set = pixels.iter().filter(|&&v| v > 0.0).count();
            assert_eq!(n_set, (length + 1).min(400) as usize);
        }
    }

    #[test]
    fn discs_are_round() {
        assert_eq!(
            draw(|c| fill_disc(c, dvec2(3.0, 2.0), 1.2, 1.0)),
            "......\n..##..\n..##..\n......"
        );
    }
}
