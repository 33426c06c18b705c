//! A `plotters` backend that draws charts as pixels with the drawing code of pictures.

use std::convert::Infallible;

use plotters_backend::text_anchor::{HPos, VPos};
use plotters_backend::{
    BackendColor, BackendCoord, BackendStyle, BackendTextStyle, DrawingBackend, DrawingErrorKind,
    FontTransform,
};
use tiny_skia::{
    FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, Transform,
};

use crate::pen::paint;
use crate::text_layout;
use crate::theme::Rgb;

/// Pixels per unit of the drawing, so that it is sharp on dense screens and on paper.
pub(crate) const DENSITY: f32 = 2.0;
/// Height of a capital as a share of the size of a font: about that of common sans-serif fonts.
const CAPITAL: f64 = 0.7;
/// Divisor of font sizes in the other backend, so that both draw alike.
///
/// Source: plotters' SVG backend.
const FONT_SCALE: f64 = 1.24;

/// A pixmap in units of the drawing.
pub(crate) struct ChartCanvas<'a> {
    pixmap: &'a mut Pixmap,
    /// The placeholder for the text colour, and the text colour.
    text: (Rgb, Rgb),
}

type Drawn = Result<(), DrawingErrorKind<Infallible>>;

impl<'a> ChartCanvas<'a> {
    /// A canvas on `pixmap`, on which `text.0` is drawn as `text.1`.
    pub(crate) fn new(pixmap: &'a mut Pixmap, text: (Rgb, Rgb)) -> Self {
        Self { pixmap, text }
    }

    fn ink(&self, colour: BackendColor) -> Paint<'static> {
        let (r, g, b) = colour.rgb;
        let rgb = if [r, g, b] == self.text.0 {
            self.text.1
        } else {
            [r, g, b]
        };
        paint(rgb, colour.alpha as f32)
    }

    fn fill(&mut self, path: Option<Path>, colour: BackendColor) {
        let ink = self.ink(colour);
        if let Some(path) = path {
            let dense = Transform::from_scale(DENSITY, DENSITY);
            self.pixmap
                .fill_path(&path, &ink, FillRule::Winding, dense, None);
        }
    }

    fn stroke(&mut self, path: Option<Path>, style: &impl BackendStyle) {
        let ink = self.ink(style.color());
        let stroke = Stroke {
            width: style.stroke_width().max(1) as f32,
            line_cap: LineCap::Round,
            line_join: LineJoin::Round,
            ..Stroke::default()
        };
        if let Some(path) = path {
            let dense = Transform::from_scale(DENSITY, DENSITY);
            self.pixmap.stroke_path(&path, &ink, &stroke, dense, None);
        }
    }
}

/// The middle of the cell at a point of the integer grid.
fn middle((x, y): BackendCoord) -> (f32, f32) {
    (x as f32 + 0.5, y as f32 + 0.5)
}

fn line(points: impl IntoIterator<Item = BackendCoord>, closed: bool) -> Option<Path> {
    let mut builder = PathBuilder::new();
    for point in points {
        let (x, y) = middle(point);
        if builder.is_empty() {
            builder.move_to(x, y);
        } else {
            builder.line_to(x, y);
        }
    }
    if closed {
        builder.close();
    }
    builder.finish()
}

fn capital(style: &impl BackendTextStyle) -> f64 {
    style.size() / FONT_SCALE * CAPITAL
}

impl DrawingBackend for ChartCanvas<'_> {
    type ErrorType = Infallible;

    fn get_size(&self) -> (u32, u32) {
        let units = |px: u32| (px as f32 / DENSITY) as u32;
        (units(self.pixmap.width()), units(self.pixmap.height()))
    }

    fn ensure_prepared(&mut self) -> Drawn {
        Ok(())
    }

    fn present(&mut self) -> Drawn {
        Ok(())
    }

    fn draw_pixel(&mut self, (x, y): BackendCoord, colour: BackendColor) -> Drawn {
        let square = Rect::from_xywh(x as f32, y as f32, 1.0, 1.0);
        self.fill(square.map(PathBuilder::from_rect), colour);
        Ok(())
    }

    fn draw_line<S: BackendStyle>(
        &mut self,
        from: BackendCoord,
        to: BackendCoord,
        style: &S,
    ) -> Drawn {
        self.stroke(line([from, to], false), style);
        Ok(())
    }

    fn draw_rect<S: BackendStyle>(
        &mut self,
        (left, top): BackendCoord,
        (right, bottom): BackendCoord,
        style: &S,
        fill: bool,
    ) -> Drawn {
        let corners = [(left, top), (right, top), (right, bottom), (left, bottom)];
        let path = line(corners, true);
        if fill {
            self.fill(path, style.color());
        } else {
            self.stroke(path, style);
        }
        Ok(())
    }

    fn draw_path<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        path: I,
        style: &S,
    ) -> Drawn {
        self.stroke(line(path, false), style);
        Ok(())
    }

    fn draw_circle<S: BackendStyle>(
        &mut self,
        centre: BackendCoord,
        radius: u32,
        style: &S,
        fill: bool,
    ) -> Drawn {
        let (x, y) = middle(centre);
        let path = PathBuilder::from_circle(x, y, radius as f32);
        if fill {
            self.fill(path, style.color());
        } else {
            self.stroke(path, style);
        }
        Ok(())
    }

    fn fill_polygon<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        corners: I,
        style: &S,
    ) -> Drawn {
        self.fill(line(corners, true), style.color());
        Ok(())
    }

    fn draw_text<S: BackendTextStyle>(&mut self, text: &str, style: &S, at: BackendCoord) -> Drawn {
        let height = capital(style);
        let width = text_layout::width(text, height);
        let anchor = style.anchor();
        let left = match anchor.h_pos {
            HPos::Left => 0.0,
            HPos::Center => -width / 2.0,
            HPos::Right => -width,
        };
        let baseline = match anchor.v_pos {
            VPos::Top => height * 1.2,
            VPos::Center => height / 2.0,
            VPos::Bottom => -height * 0.2,
        };
        let turn = match style.transform() {
            FontTransform::None => 0.0,
            FontTransform::Rotate90 => 90.0,
            FontTransform::Rotate180 => 180.0,
            FontTransform::Rotate270 => 270.0,
        };
        let (x, y) = middle(at);
        let placed = Transform::from_scale(DENSITY, DENSITY)
            .pre_translate(x, y)
            .pre_rotate(turn);
        let ink = self.ink(style.color());
        text_layout::stroke(self.pixmap, text, (left, baseline), height, &ink, placed);
        Ok(())
    }

    fn estimate_text_size<S: BackendTextStyle>(
        &self,
        text: &str,
        style: &S,
    ) -> Result<(u32, u32), DrawingErrorKind<Infallible>> {
        let height = capital(style);
        let width = text_layout::width(text, height);
        Ok((width.ceil() as u32, (1.4 * height).ceil() as u32))
    }
}
