//! Films of futures, as animated GIFs or PNGs, and as MP4 where `ffmpeg` is installed.
//!
//! The road is drawn once unless the camera follows the ego; a frame stores only the pixels that
//! differ from the frame before.

use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Arc;

use gif::{DisposalMethod, Encoder, Frame as GifFrame, Repeat};
use gump_geometry::Pose;
use gump_scene::{Rollout, Scenario};
use tiny_skia::Pixmap;

use crate::draw_agents::{draw_agents, draw_lights, draw_past};
use crate::draw_map::draw_backdrop;
use crate::files::{write_beside, write_whole};
use crate::indexed::{Palette, UNCHANGED};
use crate::pen::Pen;
use crate::picture::{draw_label, draw_rectangle, recent};
use crate::theme::{Colours, mix};
use crate::{Camera, Theme, VizError, text_layout, video};

/// Content and style of a film.
#[derive(Clone, Debug, PartialEq)]
pub struct FilmSpec {
    /// View of one panel.
    pub camera: Camera,
    /// Whether the camera follows the ego of a panel's first rollout, its heading up, and only the
    /// size of `camera` counts; otherwise it is fixed in the world. Once the ego has left the map the
    /// camera shows the place of the start.
    pub follow: bool,
    /// Colour theme.
    pub theme: Theme,
    /// Panels side by side, > 0; an overlay has one panel.
    pub columns: usize,
    /// Seconds of traffic between two frames, > 0.
    pub frame_s: f64,
    /// Seconds of traffic per second of film, > 0.
    pub speed: f64,
    /// Length of trails, seconds; 0 for none. Overlays have none.
    pub past_s: f64,
}

impl FilmSpec {
    /// A light film in real time, ten frames a second, two panels wide, the camera fixed.
    pub fn new(camera: Camera) -> Self {
        Self {
            camera,
            follow: false,
            theme: Theme::Light,
            columns: 2,
            frame_s: 0.1,
            speed: 1.0,
            past_s: 1.5,
        }
    }

    /// As [`FilmSpec::framing`], or as [`FilmSpec::following`] where the ego goes further than fits
    /// into 110 m.
    pub fn of_rollouts(rollouts: &[&Rollout], size_px: (u32, u32)) -> Self {
        match Camera::on_movement(rollouts, FRAMED, size_px) {
            Some(camera) => Self::new(camera),
            None => Self::following(size_px),
        }
    }

    /// As [`FilmSpec::new`], from a camera that shows the whole path of the ego in these rollouts
    /// and, as far as they fit into 110 m, agents that move near it.
    ///
    /// Units: `size_px` is width and height of a panel.
    pub fn framing(rollouts: &[&Rollout], size_px: (u32, u32)) -> Self {
        let framed = Camera::on_movement(rollouts, FRAMED, size_px);
        let whole = || Camera::on_futures(rollouts, *FRAMED.end(), size_px);
        Self::new(framed.unwrap_or_else(whole))
    }

    /// As [`FilmSpec::new`], from a camera that follows the ego and shows 90 m.
    ///
    /// Units: `size_px` is width and height of a panel.
    pub fn following((width_px, height_px): (u32, u32)) -> Self {
        let camera = Camera {
            world_from_camera: Pose::IDENTITY,
            metres: FOLLOWED,
            width_px,
            height_px,
        };
        Self {
            follow: true,
            ..Self::new(camera)
        }
    }
}

/// Metres across a panel whose camera is fixed. Chosen by eye, like the next.
const FRAMED: RangeInclusive<f64> = 50.0..=110.0;
/// Metres across a panel whose camera follows the ego.
const FOLLOWED: f64 = 90.0;

/// A rollout and the label in the corner of its panel.
#[derive(Clone, Debug)]
pub struct LabelledRollout<'a> {
    /// The rollout.
    pub rollout: &'a Rollout,
    /// Label; empty for none.
    pub label: String,
}

/// A finished film.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Film {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Number of frames.
    pub n_frames: usize,
    /// The bytes of a GIF file that repeats for ever.
    pub gif: Vec<u8>,
    /// Red, green and blue by number.
    palette: Vec<u8>,
    patches: Vec<Patch>,
}

/// The part of a frame that differs from the one before.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Patch {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
    /// Colours by number, row by row; [`UNCHANGED`] where nothing changes.
    pixels: Vec<u8>,
    /// Display time of the frame, hundredths of a second.
    delay: u16,
}

/// A film of several rollouts side by side, row by row.
///
/// # Errors
/// [`VizError::NothingToFilm`], or [`VizError::Size`] if the panels together are too large for a
/// GIF (65 535 pixels a side) or empty.
pub fn grid_film(takes: &[LabelledRollout<'_>], spec: &FilmSpec) -> Result<Film, VizError> {
    let panels = takes.iter().map(|take| Panel {
        rollouts: vec![take.rollout],
        label: &take.label,
        opacity: 1.0,
    });
    film(&panels.collect::<Vec<_>>(), spec)
}

/// A film of several rollouts drawn over one another, each fainter the more there are: what all
/// futures have in common is solid.
///
/// # Errors
/// As [`grid_film`].
pub fn overlay_film(rollouts: &[&Rollout], spec: &FilmSpec) -> Result<Film, VizError> {
    if rollouts.is_empty() {
        return Err(VizError::NothingToFilm);
    }
    let opacity = (2.0 / rollouts.len() as f32).clamp(0.12, 1.0);
    let panel = Panel {
        rollouts: rollouts.to_vec(),
        label: "",
        opacity,
    };
    film(&[panel], spec)
}

/// Returns the logged future as a rollout.
pub fn log_as_rollout(scenario: &Scenario) -> Rollout {
    let mut rollout = Rollout::begin(scenario.present());
    for frame in scenario.future() {
        rollout.push(frame.clone());
    }
    rollout
}

impl Film {
    /// Writes the film, as an animated PNG if the file is named so (`.png`, `.apng`), as a video if
    /// it is named `.mp4`, else as a GIF; a reader finds the old file or the new one, never half of
    /// one.
    ///
    /// # Errors
    /// [`VizError::Write`] with the path, and those of [`Film::to_apng`];
    /// [`VizError::NoFfmpeg`] and [`VizError::Ffmpeg`] for videos.
    pub fn save(&self, path: &Path) -> Result<(), VizError> {
        let ending = path.extension().and_then(|ending| ending.to_str());
        match ending {
            Some("png" | "apng") => write_whole(path, &self.to_apng()?),
            Some("mp4") => write_beside(path, |beside| self.save_mp4(beside)),
            _ => write_whole(path, &self.gif),
        }
    }

    /// The bytes of an animated PNG that repeats for ever: the same frames and colours as the GIF,
    /// with another compression. Software without support for animation shows the first frame.
    ///
    /// # Errors
    /// [`VizError::Apng`] if the encoder refuses.
    pub fn to_apng(&self) -> Result<Vec<u8>, VizError> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Indexed);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_palette(&self.palette[..]);
        let mut opacity = vec![0xFF; usize::from(UNCHANGED)];
        opacity.push(0);
        encoder.set_trns(opacity);
        encoder.set_animated(self.n_frames as u32, 0)?;
        encoder.set_blend_op(png::BlendOp::Over)?;
        let mut writer = encoder.write_header()?;
        for patch in &self.patches {
            writer.set_frame_delay(patch.delay, 100)?;
            // The old place and the new size may not go together.
            writer.reset_frame_position()?;
            writer.set_frame_dimension(patch.width as u32, patch.height as u32)?;
            writer.set_frame_position(patch.left as u32, patch.top as u32)?;
            writer.write_image_data(&patch.pixels)?;
        }
        writer.finish()?;
        Ok(bytes)
    }
}

impl Film {
    /// Writes the frames of the GIF as video, encoded by `ffmpeg`.
    ///
    /// # Errors
    /// [`VizError::NoFfmpeg`] if that is not on the path, [`VizError::Ffmpeg`] with its message.
    fn save_mp4(&self, path: &Path) -> Result<(), VizError> {
        let delay = self.patches.first().map_or(10, |patch| patch.delay);
        let mut canvas = vec![0; self.width * self.height];
        let frames = self.patches.iter().flat_map(|patch| {
            patch.apply(&mut canvas, self.width);
            let colour = |&i: &u8| &self.palette[usize::from(i) * 3..][..3];
            let frame: Vec<u8> = canvas.iter().flat_map(colour).copied().collect();
            // The last frame stays longer: it is repeated.
            std::iter::repeat_n(frame, usize::from((patch.delay / delay).max(1)))
        });
        video::encode(path, (self.width, self.height), delay, frames)
    }
}

impl Patch {
    /// Writes the changed pixels into the frame before, whose rows are `stride` long.
    fn apply(&self, canvas: &mut [u8], stride: usize) {
        for (row, pixels) in self.pixels.chunks_exact(self.width).enumerate() {
            let start = (self.top + row) * stride + self.left;
            let shown = canvas[start..start + self.width].iter_mut();
            for (shown, &pixel) in shown.zip(pixels) {
                if pixel != UNCHANGED {
                    *shown = pixel;
                }
            }
        }
    }

    fn as_gif(&self) -> GifFrame<'_> {
        GifFrame {
            left: self.left as u16,
            top: self.top as u16,
            width: self.width as u16,
            height: self.height as u16,
            delay: self.delay,
            transparent: Some(UNCHANGED),
            dispose: DisposalMethod::Keep,
            buffer: self.pixels.as_slice().into(),
            ..GifFrame::default()
        }
    }
}

/// One view of one or more rollouts drawn over one another.
struct Panel<'a> {
    rollouts: Vec<&'a Rollout>,
    label: &'a str,
    opacity: f32,
}

// Chosen by eye.
/// Pixels between panels.
const GAP: usize = 2;
/// Height of the line with the clock, pixels.
const FOOTER: usize = 24;
/// Minimum display time of the last frame, hundredths of a second.
const LAST_DELAY: u16 = 120;

fn film(panels: &[Panel<'_>], spec: &FilmSpec) -> Result<Film, VizError> {
    let layout = Layout::new(panels.len(), spec)?;
    let colours = spec.theme.colours();
    let backdrops = match spec.follow {
        true => Vec::new(),
        false => backdrops(panels, spec, colours),
    };
    let mut palette = Palette::new(colours);
    let duration = panels
        .iter()
        .flat_map(|panel| &panel.rollouts)
        .map(|rollout| rollout.steps() as f64 * rollout.dt())
        .fold(0.0, f64::max);
    let n_frames = (duration / spec.frame_s + 1e-9).floor() as usize + 1;

    let delay = (spec.frame_s / spec.speed * 100.0)
        .round()
        .clamp(2.0, 6000.0) as u16;
    let mut patches = Vec::with_capacity(n_frames);
    let gap_colour = palette.index(mix(colours.ground, colours.edge, 0.5));
    let mut canvas = vec![gap_colour; layout.width * layout.height];
    let mut shown: Option<Vec<u8>> = None;
    for i in 0..n_frames {
        let time = i as f64 * spec.frame_s;
        for (number, panel) in panels.iter().enumerate() {
            let pixmap = draw_panel(panel, backdrops.get(number), time, spec, colours);
            let place = layout.panel(number);
            palette.blit(&pixmap, &mut canvas, layout.width, place);
        }
        if let Some(footer) = draw_footer(layout.width, time, duration, colours) {
            let place = (0, layout.height - FOOTER);
            palette.blit(&footer, &mut canvas, layout.width, place);
        }
        let delay = if i + 1 == n_frames {
            LAST_DELAY.max(delay)
        } else {
            delay
        };
        patches.push(difference(shown.as_deref(), &canvas, layout.width, delay));
        shown = Some(canvas.clone());
    }
    let palette = palette.bytes();
    Ok(Film {
        width: layout.width,
        height: layout.height,
        n_frames,
        gif: gif(&layout, &palette, &patches)?,
        palette,
        patches,
    })
}

fn gif(layout: &Layout, palette: &[u8], patches: &[Patch]) -> Result<Vec<u8>, VizError> {
    let mut bytes = Vec::new();
    let (width, height) = layout.size_u16();
    let mut encoder = Encoder::new(&mut bytes, width, height, palette)?;
    encoder.set_repeat(Repeat::Infinite)?;
    for patch in patches {
        encoder.write_frame(&patch.as_gif())?;
    }
    drop(encoder);
    Ok(bytes)
}

/// The arrangement of the panels, sizes in pixels.
struct Layout {
    columns: usize,
    panel: (usize, usize),
    width: usize,
    height: usize,
}

impl Layout {
    fn new(n_panels: usize, spec: &FilmSpec) -> Result<Self, VizError> {
        if n_panels == 0 {
            return Err(VizError::NothingToFilm);
        }
        let columns = spec.columns.clamp(1, n_panels);
        let rows = n_panels.div_ceil(columns);
        let panel = (
            spec.camera.width_px as usize,
            spec.camera.height_px as usize,
        );
        let width = columns.saturating_mul(panel.0 + GAP) - GAP;
        let height = rows.saturating_mul(panel.1 + GAP) + FOOTER;
        let most = usize::from(u16::MAX);
        if panel.0 == 0 || panel.1 == 0 || width > most || height > most {
            return Err(VizError::Size { width, height });
        }
        Ok(Self {
            columns,
            panel,
            width,
            height,
        })
    }

    fn size_u16(&self) -> (u16, u16) {
        (self.width as u16, self.height as u16)
    }

    /// The top left corner of a panel.
    fn panel(&self, number: usize) -> (usize, usize) {
        let (row, column) = (number / self.columns, number % self.columns);
        (column * (self.panel.0 + GAP), row * (self.panel.1 + GAP))
    }
}

/// The road of each panel; panels that share map and route share the drawing.
fn backdrops(panels: &[Panel<'_>], spec: &FilmSpec, colours: &Colours) -> Vec<Arc<Pixmap>> {
    let mut drawn: Vec<Arc<Pixmap>> = Vec::with_capacity(panels.len());
    for (i, panel) in panels.iter().enumerate() {
        let scene = |panel: &Panel<'_>| panel.rollouts[0].at(0).route.map(Arc::as_ptr);
        let same = |other: &Panel<'_>| {
            Arc::ptr_eq(other.rollouts[0].map(), panel.rollouts[0].map())
                && scene(other) == scene(panel)
        };
        let backdrop = match panels[..i].iter().position(same) {
            Some(j) => Arc::clone(&drawn[j]),
            None => {
                let start = panel.rollouts[0].at(0);
                Arc::new(draw_backdrop(start.map, start.route, spec.camera, colours))
            }
        };
        drawn.push(backdrop);
    }
    drawn
}

/// One view at one time, on the road that was drawn before if the camera is fixed.
fn draw_panel(
    panel: &Panel<'_>,
    backdrop: Option<&Arc<Pixmap>>,
    time: f64,
    spec: &FilmSpec,
    colours: &Colours,
) -> Pixmap {
    let (camera, mut pixmap) = match backdrop {
        Some(backdrop) => (spec.camera, Pixmap::clone(backdrop)),
        None => {
            let first = panel.rollouts[0];
            let step = step_at(first, time);
            let scene = first.at(step);
            let camera = spec.camera.with_ego(first, step);
            let backdrop = draw_backdrop(scene.map, scene.route, camera, colours);
            (camera, backdrop)
        }
    };
    let mut pen = Pen::new(&mut pixmap, camera);
    for (i, rollout) in panel.rollouts.iter().enumerate() {
        let scene = rollout.at(step_at(rollout, time));
        if i == 0 {
            draw_lights(&mut pen, scene.now(), scene.map, colours);
        }
        if panel.rollouts.len() == 1 {
            let past = recent(scene.history, spec.past_s, scene.dt);
            draw_past(&mut pen, past, scene.ego, colours, 3);
        }
        draw_agents(&mut pen, scene.now(), scene.ego, colours, panel.opacity);
    }
    draw_label(&mut pixmap, panel.label, colours);
    pixmap
}

/// The step at a time; a rollout that is over stays as it ended.
fn step_at(rollout: &Rollout, time: f64) -> usize {
    ((time / rollout.dt()).round() as usize).min(rollout.steps())
}

/// A clock and a bar that grows; `None` only for a film without width.
fn draw_footer(width: usize, time: f64, duration: f64, colours: &Colours) -> Option<Pixmap> {
    let mut pixmap = Pixmap::new(u32::try_from(width).ok()?, FOOTER as u32)?;
    let [r, g, b] = colours.ground;
    pixmap.fill(tiny_skia::Color::from_rgba8(r, g, b, 0xFF));
    let label = format!("{time:.1} s");
    text_layout::write(&mut pixmap, &label, (8.0, 16.0), 8.0, colours.text);
    let left = 16.0 + text_layout::width("88.8 s", 8.0);
    let track = width as f64 - left - 10.0;
    let share = if duration > 0.0 {
        (time / duration).min(1.0)
    } else {
        1.0
    };
    for (length, colour) in [(track, colours.direction), (track * share, colours.ego)] {
        draw_rectangle(&mut pixmap, (left, 11.0), (length, 3.0), colour, 1.0);
    }
    Some(pixmap)
}

/// The smallest frame that turns `shown` into `canvas`.
fn difference(shown: Option<&[u8]>, canvas: &[u8], width: usize, delay: u16) -> Patch {
    let height = canvas.len() / width;
    let differs = |i: usize| shown.is_none_or(|shown| shown[i] != canvas[i]);
    let (mut left, mut right, mut top, mut bottom) = (width, 0, height, 0);
    for row in 0..height {
        let cells = row * width..(row + 1) * width;
        let Some(first) = cells.clone().find(|&i| differs(i)) else {
            continue;
        };
        let last = cells.rev().find(|&i| differs(i)).unwrap_or(first);
        (top, bottom) = (top.min(row), row + 1);
        (left, right) = (left.min(first % width), right.max(last % width + 1));
    }
    if left >= right {
        // Nothing moved: one pixel, unchanged, to carry the delay.
        (left, right, top, bottom) = (0, 1, 0, 1);
    }
    let mut pixels = Vec::with_capacity((right - left) * (bottom - top));
    for row in top..bottom {
        let cells = row * width + left..row * width + right;
        pixels.extend(cells.map(|i| if differs(i) { canvas[i] } else { UNCHANGED }));
    }
    Patch {
        left,
        top,
        width: right - left,
        height: bottom - top,
        pixels,
        delay,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_holds_only_what_changed() {
        let shown = [1, 2, 3, 4, 5, 6];
        let first = difference(None, &shown, 3, 2);
        assert_eq!(
            (first.width, first.height, &first.pixels[..]),
            (3, 2, &shown[..])
        );
        let still = difference(Some(&shown), &shown, 3, 2);
        assert_eq!(
            (still.width, still.height, &still.pixels[..]),
            (1, 1, &[UNCHANGED][..])
        );
        let moved = difference(Some(&shown), &[1, 9, 3, 4, 5, 8], 3, 2);
        assert_eq!(
            (moved.left, moved.top, moved.width, moved.height),
            (1, 0, 2, 2)
        );
        assert_eq!(moved.pixels[..], [9, UNCHANGED, UNCHANGED, 8]);
    }
}
