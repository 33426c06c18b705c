//! Bar charts of tables: a name per row, and a bar per column with its uncertainty interval.

use std::path::Path;

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::plot::{COLOURS, Plot, TEXT, font, tick};
use crate::{Picture, Theme, VizError, text_layout};

/// Horizontal bars in groups, so that long names can be read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bars {
    /// Title above the chart, may be empty; also names the chart in errors.
    pub title: String,
    /// The measured quantity and its unit.
    pub label: String,
    /// Names of the bars of a group, in order; shown in a legend if there are several.
    pub series: Vec<String>,
    /// Groups from top to bottom.
    pub groups: Vec<BarGroup>,
}

/// The bars of one row of a table.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BarGroup {
    /// Label to the left of the bars.
    pub name: String,
    /// One per series; `None` and values that are not finite leave a gap.
    pub bars: Vec<Option<Bar>>,
}

/// A number and its interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bar {
    /// Length of the bar.
    pub value: f64,
    /// Lower and upper bound of the value.
    pub span: Option<(f64, f64)>,
}

// Layout, chosen by eye.
/// Width of the drawing, pixels.
const WIDTH: u32 = 760;
/// Height of a bar, and of the gap between groups, pixels.
const BAR: f64 = 11.0;
const GAP: f64 = 9.0;
/// Height of what is not bars: margins and the axis below without its title, pixels.
const FRAME: u32 = 58;
/// Size of the title of the axis, and the height of each of its lines, pixels.
const AXIS_TITLE: f64 = 13.5;
const LINE: u32 = 18;
/// Space to the left and right of it, pixels.
const MARGIN: f64 = 12.0;
/// Height of the title and of the legend, pixels.
const TITLE: u32 = 30;
const LEGEND: u32 = 26;
/// Width of a letter and of a legend's swatch with its gaps, pixels.
const LETTER: i32 = 8;
const SWATCH: i32 = 34;

impl Bars {
    /// The chart as an SVG element; put inline into a page, it takes the page's text colour.
    ///
    /// # Errors
    /// [`VizError::EmptyChart`] without a bar to draw; [`VizError::Chart`] if the backend refuses.
    pub fn to_svg(&self) -> Result<String, VizError> {
        self.svg()
    }

    /// The chart as pixels, 1520 wide.
    ///
    /// # Errors
    /// As [`Bars::to_svg`].
    pub fn to_picture(&self, theme: Theme) -> Result<Picture, VizError> {
        self.picture(theme)
    }

    /// Writes `STEM.svg`, and `STEM.png` on light ground.
    ///
    /// # Errors
    /// As [`Bars::to_svg`], and [`VizError::Write`] with the path.
    pub fn save(&self, stem: &Path) -> Result<(), VizError> {
        self.write(stem)
    }

    /// Height of a group in the drawing, pixels.
    fn group_px(&self) -> f64 {
        BAR * self.series.len().max(1) as f64 + GAP
    }

    /// Bars with their group and series.
    fn bars(&self) -> impl Iterator<Item = (usize, usize, Bar)> + '_ {
        let groups = self.groups.iter().enumerate();
        groups.flat_map(|(row, group)| {
            let bars = group.bars.iter().enumerate();
            let known = bars.filter_map(|(series, bar)| Some((series, (*bar)?)));
            let finite = known.filter(|(_, bar)| bar.value.is_finite());
            finite.map(move |(series, bar)| (row, series, bar))
        })
    }

    fn draw<B: DrawingBackend>(
        &self,
        backend: B,
        (low, high): (f64, f64),
    ) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
        let mut area = backend.into_drawing_area();
        let root = area.clone();
        if !self.title.is_empty() {
            let (head, rest) = area.split_vertically(TITLE);
            let middle = font(16.0).pos(Pos::new(HPos::Center, VPos::Center));
            let place = (WIDTH as i32 / 2, TITLE as i32 / 2 + 4);
            head.draw(&Text::new(self.title.as_str(), place, middle))?;
            area = rest;
        }
        if self.series.len() > 1 {
            let (head, rest) = area.split_vertically(LEGEND);
            self.draw_legend(&head)?;
            area = rest;
        }
        let label = self.label_lines();
        let height = area.dim_in_pixel().1 - LINE * label.len() as u32;
        let (area, below) = area.split_vertically(height);
        let longest = self.groups.iter().map(|group| group.name.chars().count());
        let names = longest.max().unwrap_or(0) as i32 * LETTER + 16;
        let names = names.clamp(40, WIDTH as i32 / 2);
        let n = self.groups.len();
        let middle = (MARGIN + f64::from(names) + f64::from(WIDTH) - 2.0 * MARGIN) / 2.0;
        draw_label(&below, &label, middle)?;
        let mut chart = ChartBuilder::on(&area)
            .margin(12)
            .margin_right(24)
            .x_label_area_size(28)
            .y_label_area_size(names)
            .build_cartesian_2d(low..high, n as f64 + 0.5..0.5)?;
        chart
            .configure_mesh()
            .x_labels(8)
            .y_labels(2 * n + 1)
            .x_label_formatter(&|v| tick(*v))
            .y_label_formatter(&|v| self.name_at(*v))
            .label_style(font(13.0))
            .axis_style(TEXT.mix(0.45))
            .bold_line_style(TEXT.mix(0.12))
            .light_line_style(TEXT.mix(0.0))
            .disable_y_mesh()
            .draw()?;
        let thick = BAR / self.group_px();
        for (row, series, bar) in self.bars() {
            let top =
                row as f64 + 1.0 + (series as f64 - self.series.len().max(1) as f64 / 2.0) * thick;
            let (top, bottom) = (top + 0.08 * thick, top + 0.92 * thick);
            let colour = COLOURS[series % COLOURS.len()];
            let base = 0f64.clamp(low, high);
            let body = Rectangle::new([(base, top), (bar.value, bottom)], colour.filled());
            chart.draw_series([body])?;
            let span = bar.span.filter(|(a, b)| a.is_finite() && b.is_finite());
            if let Some((from, to)) = span {
                let y = (top + bottom) / 2.0;
                let line = PathElement::new(vec![(from, y), (to, y)], TEXT.stroke_width(1));
                let ends = [from, to].map(|x| {
                    let reach = 0.3 * thick;
                    PathElement::new(vec![(x, y - reach), (x, y + reach)], TEXT.stroke_width(1))
                });
                chart.draw_series(ends.into_iter().chain([line]))?;
            }
        }
        root.present()
    }

    fn draw_legend<B: DrawingBackend>(
        &self,
        area: &DrawingArea<B, plotters::coord::Shift>,
    ) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
        let width = |name: &String| SWATCH + name.chars().count() as i32 * LETTER;
        let all: i32 = self.series.iter().map(width).sum();
        let mut x = ((WIDTH as i32 - all) / 2).max(8);
        let y = LEGEND as i32 / 2 + 4;
        for (i, name) in self.series.iter().enumerate() {
            let colour = COLOURS[i % COLOURS.len()];
            area.draw(&Rectangle::new(
                [(x, y - 5), (x + 12, y + 5)],
                colour.filled(),
            ))?;
            let words = font(13.0).pos(Pos::new(HPos::Left, VPos::Center));
            area.draw(&Text::new(name.as_str(), (x + 18, y), words))?;
            x += width(name);
        }
        Ok(())
    }

    /// The title of the horizontal axis in as many lines as the width of the drawing demands.
    fn label_lines(&self) -> Vec<String> {
        let mut lines: Vec<String> = Vec::new();
        for word in self.label.split_whitespace() {
            match lines.last_mut() {
                Some(line) if label_width(&format!("{line} {word}")) <= WIDEST => {
                    *line += " ";
                    *line += word;
                }
                _ => lines.push(word.to_owned()),
            }
        }
        lines
    }

    /// Returns the label at a place of the vertical axis.
    fn name_at(&self, y: f64) -> String {
        let is_whole = (y - y.round()).abs() < 1e-6 && y >= 1.0;
        let group = is_whole.then(|| self.groups.get(y.round() as usize - 1));
        group
            .flatten()
            .map(|group| group.name.clone())
            .unwrap_or_default()
    }
}

/// Greatest width of a line of the title of the axis, pixels.
const WIDEST: f64 = WIDTH as f64 - 2.0 * MARGIN;

/// Width of a line of the title of the axis as pixels draw it, which the fonts of SVG stay below.
fn label_width(line: &str) -> f64 {
    text_layout::width(line, AXIS_TITLE * 0.7)
}

/// Draws the title of the axis around `middle`, moved so that it does not run off an edge.
fn draw_label<B: DrawingBackend>(
    area: &DrawingArea<B, plotters::coord::Shift>,
    lines: &[String],
    middle: f64,
) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
    for (i, line) in lines.iter().enumerate() {
        let half = label_width(line) / 2.0;
        let most = f64::from(WIDTH) - MARGIN - half;
        let x = middle.min(most).max(MARGIN + half);
        let y = LINE as i32 * i as i32 + LINE as i32 / 3;
        let style = font(AXIS_TITLE).pos(Pos::new(HPos::Center, VPos::Center));
        area.draw(&Text::new(line.as_str(), (x as i32, y), style))?;
    }
    Ok(())
}

impl Plot for Bars {
    fn size(&self) -> (u32, u32) {
        let rows = (self.groups.len() as f64 * self.group_px()).ceil() as u32;
        let title = if self.title.is_empty() { 0 } else { TITLE };
        let legend = if self.series.len() > 1 { LEGEND } else { 0 };
        let label = LINE * self.label_lines().len() as u32;
        (WIDTH, rows + FRAME + label + title + legend)
    }

    fn draw_on<B: DrawingBackend>(&self, backend: B) -> Result<(), VizError> {
        let ends = self.bars().flat_map(|(.., bar)| {
            let (from, to) = bar.span.unwrap_or((bar.value, bar.value));
            [bar.value, from, to]
        });
        let ends: Vec<f64> = ends.filter(|end| end.is_finite()).collect();
        if ends.is_empty() {
            return Err(VizError::EmptyChart {
                title: self.title.clone(),
            });
        }
        let low = ends.iter().copied().fold(0.0, f64::min);
        let high = ends.iter().copied().fold(0.0, f64::max);
        let room = if high > low { 0.03 * (high - low) } else { 1.0 };
        let range = (if low < 0.0 { low - room } else { 0.0 }, high + room);
        self.draw(backend, range).map_err(|error| VizError::Chart {
            title: self.title.clone(),
            reason: error.to_string(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scores() -> Bars {
        let bar = |value: f64| {
            let span = Some((value - 0.1, value + 0.05));
            Some(Bar { value, span })
        };
        let group = |name: &str, bars: &[Option<Bar>]| BarGroup {
            name: name.into(),
            bars: bars.to_vec(),
        };
        Bars {
            title: "Realism".into(),
            label: "likelihood".into(),
            series: ["model", "log"].map(String::from).into(),
            groups: vec![
                group("distance to nearest object", &[bar(0.4), bar(0.7)]),
                group("collision", &[bar(0.9), None]),
                group("linear speed", &[bar(f64::NAN), bar(0.2)]),
            ],
        }
    }

    #[test]
    fn every_group_and_series_is_named_and_every_bar_drawn() {
        let svg = scores().to_svg().unwrap();
        for word in [
            "Realism",
            "likelihood",
            "model",
            "log",
            "collision",
            "linear speed",
        ] {
            assert!(svg.contains(word), "{word} is missing");
        }
        assert!(!svg.contains("NaN") && !svg.contains("#010203"));
        // Two swatches and four bars; whiskers are lines.
        let filled = |colour: RGBColor| {
            let RGBColor(r, g, b) = colour;
            svg.matches(&format!("fill=\"#{r:02X}{g:02X}{b:02X}\""))
                .count()
        };
        assert_eq!(
            COLOURS[..2].iter().map(|c| filled(*c)).collect::<Vec<_>>(),
            [3, 3]
        );
        assert_eq!(scores().name_at(1.5), "");
        assert_eq!(scores().name_at(2.0), "collision");
    }

    #[test]
    fn bars_are_as_long_as_their_values() {
        let picture = scores().to_picture(Theme::Light).unwrap();
        let [r, g, b] = [COLOURS[0].0, COLOURS[0].1, COLOURS[0].2];
        let width = picture.width;
        let rows = picture.rgba.chunks_exact(4 * width);
        let lengths: Vec<usize> = rows
            .map(|row| row.chunks_exact(4).filter(|p| p[..3] == [r, g, b]).count())
            .filter(|n| *n > 100)
            .collect();
        let (short, long) = (lengths[0], lengths[lengths.len() - 1]);
        let ratio = long as f64 / short as f64;
        assert!((ratio - 0.9 / 0.4).abs() < 0.1, "{ratio}");
    }

    #[test]
    fn long_titles_of_the_axis_stay_in_the_drawing() {
        let text = "speed of the slowest of all vehicles, metres per second, with 95 % intervals \
                    over scenarios";
        let ink = Theme::Light.colours().text;
        let is_ink = |pixel: &[u8]| pixel[..3] == ink;
        for n in [1, 3] {
            let mut bars = scores();
            bars.groups[0].name = "a name as long as that of many a row".into();
            bars.label = [text; 3][..n].join(" ");
            let lines = bars.label_lines();
            assert_eq!(lines.join(" "), bars.label);
            assert!(lines.len() >= n && lines.iter().all(|line| label_width(line) <= WIDEST));
            let picture = bars.to_picture(Theme::Light).unwrap();
            let rows = picture.rgba.chunks_exact(4 * picture.width);
            let margin = 4 * MARGIN as usize;
            for row in rows {
                let (left, right) = (&row[..margin], &row[row.len() - margin..]);
                let outside = left.chunks_exact(4).chain(right.chunks_exact(4));
                assert_eq!(outside.filter(|pixel| is_ink(pixel)).count(), 0);
            }
            let svg = bars.to_svg().unwrap();
            assert!(lines.iter().all(|line| svg.contains(line.as_str())));
        }
    }

    #[test]
    fn nothing_to_draw_is_an_error() {
        let mut bars = scores();
        bars.groups.truncate(0);
        let error = bars.to_svg().unwrap_err().to_string();
        assert_eq!(error, "chart \"Realism\" has no point to draw");
    }
}
