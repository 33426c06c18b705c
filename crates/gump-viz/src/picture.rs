//! Still pictures.

use std::io::Cursor;
use std::path::Path;

use gump_raster::{Layer, Raster};
use gump_scene::{Frame, SceneState};
use image::{ExtendedColorType, ImageFormat};
use tiny_skia::{Pixmap, Transform};

use crate::draw_agents::{draw_agents, draw_lights, draw_past, draw_trails_of_futures};
use crate::draw_map::draw_backdrop;
use crate::files::write_whole;
use crate::legend::{self, Entry, Mark, draw_legend};
use crate::pen::{Pen, Shape, paint};
use crate::theme::{Colours, Rgb, mix};
use crate::{Camera, CandidatePath, Theme, VizError, text_layout};

/// Content and style of a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct PictureSpec {
    /// View of the world.
    pub camera: Camera,
    /// Colour theme.
    pub theme: Theme,
    /// Length of trails, seconds; 0 for none.
    pub past_s: f64,
    /// Whether to draw a bar of a round number of metres, bottom left.
    pub scale_bar: bool,
    /// Whether to name colours and lines, bottom right, and to say how many agents are in view if
    /// not all are.
    pub legend: bool,
    /// Label for the top left corner; empty for none.
    pub label: String,
}

impl PictureSpec {
    /// A light picture with two seconds of trails, a scale bar and no label.
    pub fn new(camera: Camera) -> Self {
        Self {
            camera,
            theme: Theme::Light,
            past_s: 2.0,
            scale_bar: true,
            legend: false,
            label: String::new(),
        }
    }

    /// The same picture in another theme.
    pub fn with_theme(self, theme: Theme) -> Self {
        Self { theme, ..self }
    }

    /// The same picture with a label in its corner.
    pub fn with_label(self, label: impl Into<String>) -> Self {
        Self {
            label: label.into(),
            ..self
        }
    }
}

/// Opaque pixels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Red, green, blue and 255 for every pixel, row by row from the top left.
    pub rgba: Vec<u8>,
}

/// Draws a scene as it is now, with trails of where its agents have been.
///
/// # Panics
/// If the camera's size is zero or beyond memory.
pub fn draw_scene(scene: &SceneState<'_>, spec: &PictureSpec) -> Picture {
    draw_futures(scene, &[], spec)
}

/// Draws a scene as it is now, and a thin trail per agent and future: `Rollout::imagined` of some
/// rollouts, or `Scenario::future` for what really happened.
///
/// # Panics
/// If the camera's size is zero or beyond memory.
pub fn draw_futures(scene: &SceneState<'_>, futures: &[&[Frame]], spec: &PictureSpec) -> Picture {
    let colours = spec.theme.colours();
    let mut pixmap = draw_backdrop(scene.map, scene.route, spec.camera, colours);
    let mut pen = Pen::new(&mut pixmap, spec.camera);
    draw_lights(&mut pen, scene.now(), scene.map, colours);
    draw_trails_of_futures(&mut pen, scene.now(), futures, scene.ego, colours);
    let past = recent(scene.history, spec.past_s, scene.dt);
    draw_past(&mut pen, past, scene.ego, colours, 8);
    draw_agents(&mut pen, scene.now(), scene.ego, colours, 1.0);
    let mut entries = legend::of_scene(scene, spec, colours);
    match futures.len() {
        0 => {}
        n => {
            let text = if n == 1 { "future" } else { "futures" };
            entries.push(Entry::new(text, Mark::Line(colours.vehicle, 0.75)));
        }
    }
    finish(&mut pixmap, spec, &entries, colours)
}

/// Adds what lies over the scene; `entries` are those of the legend.
fn finish(
    pixmap: &mut Pixmap,
    spec: &PictureSpec,
    entries: &[Entry],
    colours: &Colours,
) -> Picture {
    if spec.scale_bar {
        draw_scale_bar(pixmap, spec.camera.scale(), colours);
    }
    if spec.legend {
        draw_legend(pixmap, entries, colours);
    }
    draw_label(pixmap, &spec.label, colours);
    Picture::from_pixmap(pixmap)
}

/// Draws a scene as it is now, and the lines of a planner's candidates with a dot at the end of each:
/// the chosen one in the ego's colour and on top, the others dark and the fainter the more there are.
///
/// # Panics
/// If the camera's size is zero or beyond memory.
pub fn draw_candidates(
    scene: &SceneState<'_>,
    candidates: &[CandidatePath],
    spec: &PictureSpec,
) -> Picture {
    let colours = spec.theme.colours();
    let mut pixmap = draw_backdrop(scene.map, scene.route, spec.camera, colours);
    let mut pen = Pen::new(&mut pixmap, spec.camera);
    draw_lights(&mut pen, scene.now(), scene.map, colours);
    let past = recent(scene.history, spec.past_s, scene.dt);
    draw_past(&mut pen, past, scene.ego, colours, 8);
    let n_others = candidates.iter().filter(|path| !path.is_chosen).count();
    let faint = (3.0 / n_others.max(1) as f32).clamp(0.25, 0.8);
    for chosen in [false, true] {
        let (colour, opacity) = match chosen {
            true => (colours.ego, 1.0),
            false => (colours.text, faint),
        };
        let width = pen.px(0.4, 2.0).min(4.0);
        for path in candidates.iter().filter(|path| path.is_chosen == chosen) {
            let mut line = Shape::new(&pen.camera);
            line.line(path.path.iter().copied());
            pen.stroke(line, colour, opacity, width);
            if let Some(&end) = path.path.last() {
                let mut dot = Shape::new(&pen.camera);
                dot.disc(end, width * 1.6);
                pen.fill(dot, colour, opacity);
            }
        }
    }
    draw_agents(&mut pen, scene.now(), scene.ego, colours, 1.0);
    let mut entries = legend::of_scene(scene, spec, colours);
    if n_others < candidates.len() {
        entries.push(Entry::new("chosen path", Mark::Line(colours.ego, 1.0)));
    }
    if n_others > 0 {
        let mark = Mark::Line(colours.text, faint.max(0.5));
        entries.push(Entry::new("other candidates", mark));
    }
    finish(&mut pixmap, spec, &entries, colours)
}

/// Draws one layer of a raster, each value a square of `zoom` pixels: 0 is the ground, 1 the
/// strongest blue, -1 the strongest orange; what a model sees.
///
/// Error: none; `None` if the raster lacks the layer.
pub fn draw_raster_layer(
    raster: &Raster,
    layer: Layer,
    zoom: usize,
    theme: Theme,
) -> Option<Picture> {
    let plane = raster.get(layer)?;
    let colours = theme.colours();
    let colour = |value: f32| {
        let ink = if value < 0.0 {
            colours.ego
        } else {
            colours.vehicle
        };
        mix(colours.ground, ink, value.abs().min(1.0))
    };
    let side = raster.side_px * zoom;
    let mut rgba = Vec::with_capacity(side * side * 4);
    for row in 0..side {
        for column in 0..side {
            let [r, g, b] = colour(plane[row / zoom * raster.side_px + column / zoom]);
            rgba.extend([r, g, b, 0xFF]);
        }
    }
    Some(Picture {
        width: side,
        height: side,
        rgba,
    })
}

impl Picture {
    pub(crate) fn from_pixmap(pixmap: &Pixmap) -> Self {
        Self {
            width: pixmap.width() as usize,
            height: pixmap.height() as usize,
            // Every drawing starts from an opaque ground, so nothing is left to un-multiply.
            rgba: pixmap.data().to_vec(),
        }
    }

    /// The bytes of a PNG file.
    ///
    /// # Errors
    /// [`VizError::Size`] if the picture is empty or its size does not match its pixels;
    /// [`VizError::Png`] if the encoder refuses.
    pub fn to_png(&self) -> Result<Vec<u8>, VizError> {
        let matches = self
            .width
            .checked_mul(self.height)
            .and_then(|n| n.checked_mul(4))
            == Some(self.rgba.len());
        let size = (u32::try_from(self.width), u32::try_from(self.height));
        let (Ok(width), Ok(height), true) = (size.0, size.1, matches && !self.rgba.is_empty())
        else {
            let (width, height) = (self.width, self.height);
            return Err(VizError::Size { width, height });
        };
        let mut bytes = Cursor::new(Vec::new());
        let colour = ExtendedColorType::Rgba8;
        image::write_buffer_with_format(
            &mut bytes,
            &self.rgba,
            width,
            height,
            colour,
            ImageFormat::Png,
        )?;
        Ok(bytes.into_inner())
    }

    /// Writes a PNG file; a reader finds the old file or the new one, never half of one.
    ///
    /// # Errors
    /// [`VizError::Write`] with the path, or as [`Self::to_png`].
    pub fn save_png(&self, path: &Path) -> Result<(), VizError> {
        write_whole(path, &self.to_png()?)
    }
}

/// The frames of the last `seconds`, the present included.
pub(crate) fn recent(history: &[Frame], seconds: f64, dt: f64) -> &[Frame] {
    let n = (seconds / dt).round() as usize + 1;
    &history[history.len().saturating_sub(n)..]
}

/// A bar whose length is a round number of metres near a sixth of the width.
fn draw_scale_bar(pixmap: &mut Pixmap, scale: f64, colours: &Colours) {
    let width = f64::from(pixmap.width());
    let metres = round_length(width / 6.0 / scale);
    let label = format!("{metres} m");
    let size = (width / 60.0).clamp(6.0, 11.0);
    let (left, bottom) = (size * 1.2, f64::from(pixmap.height()) - size * 1.2);
    let (length, thick) = (metres * scale, (size / 5.0).max(1.5));
    let words = left + length + size * 0.7;
    let right = words + text_layout::width(&label, size) + size;
    draw_patch(
        pixmap,
        (0.0, bottom - size * 1.9),
        (right, size * 4.0),
        colours,
    );
    let tick = size * 0.6;
    for (x, y, w, h) in [
        (left, bottom - thick, length, thick),
        (left, bottom - tick, thick * 0.7, tick),
        (
            left + length - thick * 0.7,
            bottom - tick,
            thick * 0.7,
            tick,
        ),
    ] {
        draw_rectangle(pixmap, (x, y), (w, h), colours.text, 1.0);
    }
    text_layout::write(pixmap, &label, (words, bottom), size, colours.text);
}

/// The largest of 1, 2, 5, 10, 20, ... that does not exceed `metres`.
fn round_length(metres: f64) -> f64 {
    let magnitude = 10f64.powf(metres.log10().floor());
    let digit = metres / magnitude;
    let round = [5.0, 2.0, 1.0].into_iter().find(|&d| d <= digit);
    magnitude * round.unwrap_or(1.0)
}

/// Draws the label in the top left corner.
pub(crate) fn draw_label(pixmap: &mut Pixmap, label: &str, colours: &Colours) {
    if label.is_empty() {
        return;
    }
    let width = f64::from(pixmap.width());
    let size = (width / 50.0).clamp(9.0, 12.0);
    let label = text_layout::fitted(label, size, width - size * 1.4);
    let patch = (text_layout::width(&label, size) + size * 1.4, size * 2.4);
    draw_patch(pixmap, (0.0, 0.0), patch, colours);
    text_layout::write(pixmap, &label, (size * 0.7, size * 1.7), size, colours.text);
}

/// A piece of ground under words, so that they can be read over anything.
pub(crate) fn draw_patch(
    pixmap: &mut Pixmap,
    corner: (f64, f64),
    size: (f64, f64),
    colours: &Colours,
) {
    draw_rectangle(pixmap, corner, size, colours.ground, 0.8);
}

/// Fills a rectangle given by its top left corner and size in pixels.
pub(crate) fn draw_rectangle(
    pixmap: &mut Pixmap,
    (x, y): (f64, f64),
    (width, height): (f64, f64),
    colour: Rgb,
    opacity: f32,
) {
    let [x, y, width, height] = [x, y, width, height].map(|v| v as f32);
    if let Some(rectangle) = tiny_skia::Rect::from_xywh(x, y, width, height) {
        let ink = paint(colour, opacity);
        pixmap.fill_rect(rectangle, &ink, Transform::identity(), None);
    }
}
