//! The legend of a picture: its colours and lines by name, bottom right.
//!
//! Only what is in view is named.

use gump_geometry::{DVec2, Pose, dvec2};
use gump_scene::{AgentKind, Frame, SceneState};
use tiny_skia::Pixmap;

use crate::draw_agents::places_of_lights;
use crate::pen::{Pen, Shape};
use crate::picture::draw_patch;
use crate::theme::{Colours, Rgb};
use crate::{Camera, PictureSpec, text_layout};

/// A name and what it names.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Entry {
    pub(crate) text: String,
    pub(crate) mark: Mark,
}

/// A small copy of what is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Mark {
    /// A filled square.
    Box(Rgb),
    /// Discs with a dark rim in the three colours.
    Light,
    /// An octagon.
    StopSign,
    /// A line with an opacity.
    Line(Rgb, f32),
    /// A line that becomes fainter to the left.
    FadingLine(Rgb),
    /// Nothing: the text stands for itself.
    None,
}

impl Entry {
    pub(crate) fn new(text: impl Into<String>, mark: Mark) -> Self {
        Self {
            text: text.into(),
            mark,
        }
    }

    /// Pixels from the left end of this entry to that of the next.
    fn advance(&self, size: f64) -> f64 {
        self.mark.width(size) + text_layout::width(&self.text, size) + size * 1.5
    }
}

impl Mark {
    /// Pixels from the left end of the mark to the text.
    fn width(self, size: f64) -> f64 {
        match self {
            Self::Box(_) => size * 1.5,
            Self::StopSign => size * 1.7,
            Self::Light => size * 4.1,
            Self::Line(..) | Self::FadingLine(_) => size * 3.0,
            Self::None => 0.0,
        }
    }
}

/// Entries for the classes, lights, signs, route and past trails that are in view, and how many
/// agents are if that is not all of them.
pub(crate) fn of_scene(
    scene: &SceneState<'_>,
    spec: &PictureSpec,
    colours: &Colours,
) -> Vec<Entry> {
    let (camera, now) = (&spec.camera, scene.now());
    let mut entries = Vec::new();
    if let Some(text) = shown(now, camera) {
        entries.push(Entry::new(text, Mark::None));
    }
    let classes = [
        ("vehicle", AgentKind::Vehicle),
        ("pedestrian", AgentKind::Pedestrian),
        ("bicycle", AgentKind::Bicycle),
        ("other", AgentKind::Other),
    ];
    entries.push(Entry::new("ego", Mark::Box(colours.ego)));
    for (name, kind) in classes {
        let colour = colours.kind(kind);
        // What stands on the road, such as cones, has the colour of other agents.
        let is_one = |agent: &gump_scene::Agent| {
            agent.id != scene.ego
                && colours.kind(agent.kind) == colour
                && camera.sees(agent.state.pose.position)
        };
        if now.agents().iter().any(is_one) {
            entries.push(Entry::new(name, Mark::Box(colour)));
        }
    }
    if places_of_lights(now, scene.map).any(|(at, _)| camera.sees(at)) {
        entries.push(Entry::new("traffic light", Mark::Light));
    }
    let mut signs = scene.map.stop_signs().iter();
    if signs.any(|sign| camera.sees(sign.position.truncate())) {
        entries.push(Entry::new("stop sign", Mark::StopSign));
    }
    if scene.route.is_some() {
        entries.push(Entry::new("route of the ego", Mark::Box(colours.route)));
    }
    if spec.past_s > 0.0 && scene.history.len() > 1 {
        let text = format!("last {} s", spec.past_s);
        entries.push(Entry::new(text, Mark::FadingLine(colours.vehicle)));
    }
    entries
}

/// "N of M agents shown"; `None` if all are.
fn shown(now: &Frame, camera: &Camera) -> Option<String> {
    let n = now.agents().len();
    let seen = now.agents().iter();
    let seen = seen.filter(|agent| camera.sees(agent.state.pose.position));
    let seen = seen.count();
    (seen < n).then(|| format!("{seen} of {n} agents shown"))
}

/// Share of the width that a row may take: the scale bar is at the left. Chosen by eye.
const WIDEST: f64 = 0.66;

/// Draws the entries in as many rows as they need.
pub(crate) fn draw_legend(pixmap: &mut Pixmap, entries: &[Entry], colours: &Colours) {
    let (width, height) = (f64::from(pixmap.width()), f64::from(pixmap.height()));
    let size = (width / 60.0).clamp(6.0, 11.0);
    let rows = rows(entries, size, width * WIDEST);
    let length = |row: &[Entry]| row.iter().map(|entry| entry.advance(size)).sum::<f64>();
    let widest = rows.iter().map(|row| length(row)).fold(0.0, f64::max);
    let step = size * 2.1;
    let first = height - size * 1.2 - step * rows.len().saturating_sub(1) as f64;
    let top = first - size * 1.9;
    let left = width - widest;
    draw_patch(
        pixmap,
        (left - size, top),
        (widest + size, height - top),
        colours,
    );
    for (i, row) in rows.iter().enumerate() {
        let (mut x, baseline) = (left, first + step * i as f64);
        for entry in *row {
            draw_mark(pixmap, entry.mark, (x, baseline), size, colours);
            let words = (x + entry.mark.width(size), baseline);
            text_layout::write(pixmap, &entry.text, words, size, colours.text);
            x += entry.advance(size);
        }
    }
}

/// The entries, cut into rows of at most `most` pixels.
fn rows(entries: &[Entry], size: f64, most: f64) -> Vec<&[Entry]> {
    let mut rows = Vec::new();
    let (mut start, mut length) = (0, 0.0);
    for (i, entry) in entries.iter().enumerate() {
        let advance = entry.advance(size);
        if i > start && length + advance > most {
            rows.push(&entries[start..i]);
            (start, length) = (i, 0.0);
        }
        length += advance;
    }
    rows.push(&entries[start..]);
    rows
}

/// Draws a mark above a baseline.
fn draw_mark(
    pixmap: &mut Pixmap,
    mark: Mark,
    (x, baseline): (f64, f64),
    size: f64,
    colours: &Colours,
) {
    let camera = pixel_camera(pixmap);
    let height = f64::from(pixmap.height());
    let at = |dx: f64, dy: f64| dvec2(x + dx * size, height - baseline + dy * size);
    let mut pen = Pen::new(pixmap, camera);
    let fill = |pen: &mut Pen<'_>, shape: Shape, colour| pen.fill(shape, colour, 1.0);
    let line = |points: [DVec2; 2]| {
        let mut shape = Shape::new(&camera);
        shape.line(points);
        shape
    };
    let thick = (size / 5.0) as f32;
    match mark {
        Mark::None => {}
        Mark::Box(colour) => {
            let mut shape = Shape::new(&camera);
            shape.ring([at(0.0, 0.0), at(1.0, 0.0), at(1.0, 1.0), at(0.0, 1.0)]);
            fill(&mut pen, shape, colour);
        }
        Mark::Light => {
            let lights = [colours.red, colours.yellow, colours.green];
            for (i, colour) in lights.into_iter().enumerate() {
                let centre = at(0.6 + 1.25 * i as f64, 0.5);
                for (radius, colour) in [(0.6, colours.outline), (0.43, colour)] {
                    let mut disc = Shape::new(&camera);
                    disc.disc(centre, (radius * size) as f32);
                    fill(&mut pen, disc, colour);
                }
            }
        }
        Mark::StopSign => {
            let mut shape = Shape::new(&camera);
            shape.ring((0..8).map(|i| {
                let turn = (f64::from(i) + 0.5) * std::f64::consts::FRAC_PI_4;
                at(0.6, 0.5) + DVec2::from_angle(turn) * 0.6 * size
            }));
            fill(&mut pen, shape, colours.red);
        }
        Mark::Line(colour, opacity) => {
            let shape = line([at(0.0, 0.5), at(2.5, 0.5)]);
            pen.trail(shape, colour, opacity, thick);
        }
        Mark::FadingLine(colour) => {
            for step in 0..4 {
                let from = 0.625 * f64::from(step);
                let shape = line([at(from, 0.5), at(from + 0.625, 0.5)]);
                pen.trail(shape, colour, 0.15 * (step + 1) as f32, thick);
            }
        }
    }
}

/// A camera whose world is the picture: a metre is a pixel, x to the right, y up from the bottom.
fn pixel_camera(pixmap: &Pixmap) -> Camera {
    let (width, height) = (f64::from(pixmap.width()), f64::from(pixmap.height()));
    Camera {
        world_from_camera: Pose::new(width / 2.0, height / 2.0, std::f64::consts::FRAC_PI_2),
        metres: width,
        width_px: pixmap.width(),
        height_px: pixmap.height(),
    }
}

#[cfg(test)]
mod tests {
    use gump_scene::{Scenario, fixture};

    use super::*;
    use crate::Theme;

    fn texts(scenario: &Scenario, metres: f64) -> Vec<String> {
        let scene = scenario.present();
        let spec = PictureSpec::new(Camera::on_ego(&scene, metres, 200, 200));
        let entries = of_scene(&scene, &spec, Theme::Light.colours());
        entries.into_iter().map(|entry| entry.text).collect()
    }

    #[test]
    fn a_legend_names_what_is_in_view() {
        let scenario = fixture::scenario(
            "lane 1: -40,0 40,0
             light 1 red: 6,0
             route 1
             ego vehicle 0: 0,0 velocity 5,0
             agent pedestrian 3: 9,7 velocity 0,-1
             agent vehicle 1: 30,0
             history 1.0 future 2.0 dt 0.1",
        )
        .unwrap();
        let all = [
            "ego",
            "vehicle",
            "pedestrian",
            "traffic light",
            "route of the ego",
            "last 2 s",
        ];
        assert_eq!(texts(&scenario, 100.0), all);
        let cropped = [
            "2 of 3 agents shown",
            "ego",
            "pedestrian",
            "traffic light",
            "route of the ego",
            "last 2 s",
        ];
        assert_eq!(texts(&scenario, 24.0), cropped);
        let bare = fixture::scenario("ego vehicle 0: 0,0").unwrap();
        assert_eq!(texts(&bare, 24.0), ["ego", "last 2 s"]);
    }

    #[test]
    fn rows_hold_all_entries_and_are_no_wider_than_allowed() {
        let entries: Vec<Entry> = (0..9)
            .map(|i| Entry::new(format!("entry {i}"), Mark::Light))
            .collect();
        let rows = rows(&entries, 10.0, 300.0);
        assert!(rows.len() > 1);
        assert_eq!(rows.concat(), entries);
        for row in rows {
            let length: f64 = row.iter().map(|entry| entry.advance(10.0)).sum();
            assert!(length <= 300.0);
        }
    }
}
