//! Code common to all charts: colours, ticks, and the two formats they are drawn in.

use std::path::Path;

use plotters::prelude::*;
use tiny_skia::Pixmap;

use crate::chart_canvas::{ChartCanvas, DENSITY};
use crate::files::write_whole;
use crate::{Picture, Theme, VizError};

/// Placeholder for the colour of the surrounding text; plotters knows only fixed colours, so this
/// one is replaced by `currentColor` when the drawing is done. No curve may use it.
pub(crate) const TEXT: RGBColor = RGBColor(1, 2, 3);

/// Colours in the order of Okabe and Ito, without their black and yellow, which vanish on dark or
/// light ground.
pub(crate) const COLOURS: [RGBColor; 6] = [
    RGBColor(0x2A, 0x8F, 0xD0),
    RGBColor(0xE6, 0x9F, 0x00),
    RGBColor(0x00, 0x9E, 0x73),
    RGBColor(0xD5, 0x5E, 0x00),
    RGBColor(0xCC, 0x79, 0xA7),
    RGBColor(0x56, 0xB4, 0xE9),
];

/// Text style of this size, pixels; the backend writes 1/1.24 of the size it is given.
pub(crate) fn font(px: f64) -> TextStyle<'static> {
    let font = ("system-ui, sans-serif", px * 1.24).into_font();
    font.color(&TEXT)
}

/// Something that plotters draws.
pub(crate) trait Plot {
    /// Width and height of the drawing, pixels; SVG scales.
    fn size(&self) -> (u32, u32);

    /// Draws everything.
    fn draw_on<B: DrawingBackend>(&self, backend: B) -> Result<(), VizError>;

    /// As an SVG element that takes the text colour of the page around.
    fn svg(&self) -> Result<String, VizError> {
        let mut svg = String::new();
        self.draw_on(SVGBackend::with_string(&mut svg, self.size()))?;
        Ok(svg.replace("#010203", "currentColor"))
    }

    /// As pixels, two per unit of the drawing.
    fn picture(&self, theme: Theme) -> Result<Picture, VizError> {
        let (colours, size) = (theme.colours(), self.size());
        let [width, height] = [size.0, size.1].map(|units| (units as f32 * DENSITY) as u32);
        let mut pixmap = Pixmap::new(width, height).expect("the size of a chart is not 0");
        let [r, g, b] = colours.ground;
        pixmap.fill(tiny_skia::Color::from_rgba8(r, g, b, 0xFF));
        let text = ([TEXT.0, TEXT.1, TEXT.2], colours.text);
        self.draw_on(ChartCanvas::new(&mut pixmap, text))?;
        Ok(Picture::from_pixmap(&pixmap))
    }

    /// As `STEM.svg`, and `STEM.png` on light ground.
    fn write(&self, stem: &Path) -> Result<(), VizError> {
        let svg = self.svg()?;
        write_whole(&stem.with_extension("svg"), svg.as_bytes())?;
        let picture = self.picture(Theme::Light)?;
        picture.save_png(&stem.with_extension("png"))
    }
}

/// A number as short as it can be without lying: `0.25`, `1500`, `2M`, `3e-5`.
pub(crate) fn tick(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 || size < 1e-12 {
        return "0".into();
    }
    if (1e6..1e12).contains(&size) {
        let (unit, name) = if size >= 1e9 { (1e9, "G") } else { (1e6, "M") };
        return format!("{}{name}", trimmed(value / unit));
    }
    if !(1e-3..1e12).contains(&size) {
        return format!("{value:.0e}");
    }
    trimmed(value)
}

fn trimmed(value: f64) -> String {
    let text = format!("{value:.4}");
    text.trim_end_matches('0').trim_end_matches('.').to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_short() {
        let check = |value, expected: &str| assert_eq!(tick(value), expected);
        check(0.0, "0");
        check(0.25, "0.25");
        check(-1500.0, "-1500");
        check(2e6, "2M");
        check(1.5e9, "1.5G");
        check(2e-4, "2e-4");
    }
}
