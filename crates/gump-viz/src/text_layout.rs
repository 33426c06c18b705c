//! A small stroked alphabet, so that pictures carry labels without a font file.
//!
//! A glyph is a list of strokes on a grid of 4 by 6 (capitals from row 0 to the baseline at row 6;
//! small letters start at row 2, descenders end at row 8). A stroke is a list of two-digit points;
//! one that begins with `~` is a smooth curve with its inner points as controls.

use gump_geometry::{DVec2, dvec2};
use tiny_skia::{LineCap, LineJoin, Paint, PathBuilder, Pixmap, Stroke, Transform};

use crate::pen::paint;
use crate::theme::Rgb;

/// Distance between glyphs, grid units. Chosen by eye, like the next.
const GAP: f64 = 1.7;
/// Width of a space, grid units.
const SPACE: f64 = 2.0;

/// Writes a line of text; `left` and `baseline` are pixels, `height` that of a capital.
pub(crate) fn write(pixmap: &mut Pixmap, text: &str, at: (f64, f64), height: f64, colour: Rgb) {
    let ink = paint(colour, 1.0);
    stroke(pixmap, text, at, height, &ink, Transform::identity());
}

/// As [`write`], in the units of `placed`.
pub(crate) fn stroke(
    pixmap: &mut Pixmap,
    text: &str,
    (left, baseline): (f64, f64),
    height: f64,
    ink: &Paint<'_>,
    placed: Transform,
) {
    let unit = height / 6.0;
    let mut builder = PathBuilder::new();
    let mut x = left;
    for character in text.chars() {
        let (strokes, min, max) = glyph(character);
        let place = |p: DVec2| dvec2(x + (p.x - min) * unit, baseline + (p.y - 6.0) * unit);
        for (is_smooth, points) in &strokes {
            trace(&mut builder, *is_smooth, points.iter().map(|&p| place(p)));
        }
        x += (max - min + GAP) * unit;
    }
    let stroke = Stroke {
        width: (height * 0.14).max(1.0) as f32,
        line_cap: LineCap::Round,
        line_join: LineJoin::Round,
        ..Stroke::default()
    };
    if let Some(path) = builder.finish() {
        pixmap.stroke_path(&path, ink, &stroke, placed, None);
    }
}

/// The width of a line of text in pixels.
pub(crate) fn width(text: &str, height: f64) -> f64 {
    let units: f64 = text
        .chars()
        .map(glyph)
        .map(|(_, min, max)| max - min + GAP)
        .sum();
    (units - GAP).max(0.0) * height / 6.0
}

/// A line of text cut so that it is at most `most` pixels wide, with two dots where it was cut.
pub(crate) fn fitted(text: &str, height: f64, most: f64) -> String {
    if width(text, height) <= most {
        return text.to_owned();
    }
    let mut cut = text.to_owned();
    while cut.pop().is_some() {
        let dotted = format!("{}..", cut.trim_end());
        if width(&dotted, height) <= most {
            return dotted;
        }
    }
    String::new()
}

/// Strokes with their smoothness, and the leftmost and rightmost coordinate.
type Glyph = (Vec<(bool, Vec<DVec2>)>, f64, f64);

fn glyph(character: char) -> Glyph {
    let parse = |stroke: &str| {
        let points = stroke.trim_start_matches('~').split(' ');
        let digit = |point: &str, i: usize| f64::from(point.as_bytes()[i] - b'0');
        let points = points.map(|p| dvec2(digit(p, 0), digit(p, 1)));
        (stroke.starts_with('~'), points.collect::<Vec<_>>())
    };
    let Some((_, strokes)) = GLYPHS.iter().find(|(name, _)| *name == character) else {
        return (Vec::new(), 0.0, SPACE);
    };
    let strokes: Vec<_> = strokes.split(", ").map(parse).collect();
    let xs = || strokes.iter().flat_map(|(_, points)| points).map(|p| p.x);
    let (min, max) = (xs().fold(9.0, f64::min), xs().fold(0.0, f64::max));
    (strokes, min, max)
}

/// Adds a stroke to the path; inner points of smooth ones pull the curve without being on it.
fn trace(builder: &mut PathBuilder, is_smooth: bool, points: impl Iterator<Item = DVec2>) {
    let points: Vec<_> = points.map(|p| p.as_vec2()).collect();
    builder.move_to(points[0].x, points[0].y);
    if let [dot, end] = points[..]
        && dot == end
    {
        // A line without length would not be drawn; its round ends make the dot.
        builder.line_to(dot.x + 0.4, dot.y);
    }
    let n = points.len();
    for i in 1..n {
        let p = points[i];
        if !is_smooth {
            builder.line_to(p.x, p.y);
        } else if i + 1 < n {
            let last = i + 2 == n;
            let to = if last {
                points[n - 1]
            } else {
                (p + points[i + 1]) / 2.0
            };
            builder.quad_to(p.x, p.y, to.x, to.y);
        }
    }
}

const GLYPHS: &[(char, &str)] = &[
    ('0', "~20 00 06 46 40 20"),
    ('1', "11 20 26"),
    ('2', "~01 00 40 43 06, 06 46"),
    ('3', "~01 00 40 43 13, ~13 43 46 06 05"),
    ('4', "36 30 04 44"),
    ('5', "40 00 03, ~03 43 46 06 05"),
    ('6', "~30 00 06 46 43 03 04"),
    ('7', "00 40 16"),
    ('8', "~20 00 03 43 40 20, ~23 03 06 46 43 23"),
    ('9', "~16 46 40 00 03 43 42"),
    ('a', "~44 42 02 06 46 44, 42 46"),
    ('b', "00 06, ~04 02 42 46 06 04"),
    ('c', "~43 42 02 06 46 45"),
    ('d', "~44 42 02 06 46 44, 40 46"),
    ('e', "04 44, ~44 42 02 06 46 45"),
    ('f', "~30 10 12, 12 16, 02 32"),
    ('g', "~44 42 02 06 46 44, 42 46, ~46 48 08 07"),
    ('h', "00 06, ~04 02 42 44, 44 46"),
    ('i', "22 26, 20 20"),
    ('j', "22 26, ~26 28 08, 20 20"),
    ('k', "00 06, 42 04, 23 46"),
    ('l', "20 26"),
    ('m', "02 06, ~04 02 22 24, 24 26, ~24 22 42 44, 44 46"),
    ('n', "02 06, ~04 02 42 44, 44 46"),
    ('o', "~22 02 06 46 42 22"),
    ('p', "02 08, ~04 02 42 46 06 04"),
    ('q', "42 48, ~44 42 02 06 46 44"),
    ('r', "02 06, ~04 02 32"),
    ('s', "~43 42 02 04 44 46 06 05"),
    ('t', "10 14, ~14 16 36, 02 32"),
    ('u', "02 04, ~04 06 46 44, 42 46"),
    ('v', "02 26 42"),
    ('w', "02 16 22 36 42"),
    ('x', "02 46, 42 06"),
    ('y', "02 26, 42 18"),
    ('z', "02 42 06 46"),
    ('A', "06 20 46, 14 34"),
    ('B', "20 00 06 26, ~20 40 43 23, 03 23, ~23 43 46 26"),
    ('C', "~41 40 00 06 46 45"),
    ('D', "10 00 06 16, ~10 40 46 16"),
    ('E', "40 00 06 46, 03 33"),
    ('F', "40 00 06, 03 33"),
    ('G', "~41 40 00 06 46 43, 43 23"),
    ('H', "00 06, 40 46, 03 43"),
    ('I', "20 26"),
    ('J', "30 34, ~34 36 06 04"),
    ('K', "00 06, 40 03, 13 46"),
    ('L', "00 06 46"),
    ('M', "06 00 23 40 46"),
    ('N', "06 00 46 40"),
    ('O', "~20 00 06 46 40 20"),
    ('P', "06 00 20, ~20 40 43 23, 23 03"),
    ('Q', "~20 00 06 46 40 20, 34 46"),
    ('R', "06 00 20, ~20 40 43 23, 03 23, 23 46"),
    ('S', "~41 40 00 03 43 46 06 05"),
    ('T', "00 40, 20 26"),
    ('U', "00 03, ~03 06 46 43, 43 40"),
    ('V', "00 26 40"),
    ('W', "00 16 22 36 40"),
    ('X', "00 46, 40 06"),
    ('Y', "00 23 40, 23 26"),
    ('Z', "00 40 06 46"),
    ('.', "26 26"),
    (',', "25 17"),
    (':', "23 23, 26 26"),
    ('-', "04 34"),
    ('+', "04 44, 22 26"),
    ('=', "03 43, 05 45"),
    ('/', "40 06"),
    ('%', "40 06, 00 00, 46 46"),
    ('(', "~20 03 26"),
    (')', "~00 23 06"),
    ('_', "06 46"),
    ('#', "10 16, 30 36, 02 42, 04 44"),
    ('\'', "20 21"),
    ('\u{B0}', "~10 00 02 22 20 10"),
    ('\u{B2}', "~00 10 20 21 03, 03 23"),
    ('<', "41 04 47"),
    ('>', "01 44 07"),
    ('\u{B7}', "24 24"),
    ('[', "30 10 17 37"),
    (']', "10 30 37 17"),
    ('"', "10 12, 30 32"),
    ('&', "~46 00 30 33 04 06 46, 46 43"),
];

#[cfg(test)]
mod tests {
    use super::*;

    fn ink(text: &str) -> usize {
        let mut pixmap = Pixmap::new(120, 30).unwrap();
        write(&mut pixmap, text, (5.0, 20.0), 12.0, [255, 255, 255]);
        pixmap.pixels().iter().filter(|p| p.alpha() > 128).count()
    }

    #[test]
    fn every_glyph_leaves_ink_inside_its_width() {
        for (name, _) in GLYPHS {
            assert!(ink(&name.to_string()) > 0, "{name}");
            assert!(width(&name.to_string(), 12.0) <= 8.0, "{name}");
        }
        assert_eq!(ink(" \u{1F600}"), 0);
        assert!(width("20 m", 12.0) > width("20", 12.0));
        assert_eq!(width("", 12.0), 0.0);
    }

    #[test]
    fn text_that_does_not_fit_is_cut_and_says_so() {
        let text = "interactive among model:weights";
        assert_eq!(fitted(text, 12.0, 1e4), text);
        let most = width(text, 12.0) / 2.0;
        let cut = fitted(text, 12.0, most);
        assert!(cut.ends_with("..") && text.starts_with(cut.trim_end_matches('.')));
        assert!(width(&cut, 12.0) <= most && cut.len() > 6);
        assert_eq!(fitted(text, 12.0, 1.0), "");
    }
}
