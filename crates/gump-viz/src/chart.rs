//! Line charts as SVG or pixels, in colours that can be read on light and dark ground alike.

use std::path::Path;

use plotters::coord::Shift;
use plotters::coord::combinators::BindKeyPoints;
use plotters::coord::ranged1d::{AsRangedCoord, Ranged, ValueFormatter};
use plotters::prelude::*;

use crate::plot::{COLOURS, Plot, TEXT, font, tick};
use crate::{Picture, Theme, VizError};

/// A line chart.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Chart {
    /// Title above the chart, may be empty; also names the chart in errors.
    pub title: String,
    /// Name and unit of the horizontal axis.
    pub x_label: String,
    /// Name and unit of the vertical axis.
    pub y_label: String,
    /// Whether the horizontal axis is logarithmic; then points at x <= 0 are left out.
    pub log_x: bool,
    /// Whether the vertical axis is logarithmic; then points at y <= 0 are left out.
    pub log_y: bool,
    /// Whether to mark each point with a disc: for few points that were measured.
    pub markers: bool,
    /// Labels at 1, 2, ... of a horizontal axis of categories; empty for an axis of numbers.
    pub categories: Vec<String>,
    /// The curves, in the order of the legend.
    pub series: Vec<Series>,
}

/// One curve.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// Name in the legend; a curve without a name is not in the legend.
    pub name: String,
    /// Points from left to right; points that are not finite are left out.
    pub points: Vec<(f64, f64)>,
    /// Intervals: x, and the lower and upper bound of the value.
    pub spans: Vec<(f64, f64, f64)>,
}

/// Size of the drawing, pixels; SVG scales. Chosen by eye.
const SIZE: (u32, u32) = (760, 400);

impl Chart {
    /// The chart as an SVG element; put inline into a page, it takes the page's text colour.
    ///
    /// # Errors
    /// [`VizError::EmptyChart`] without a point to draw; [`VizError::Chart`] if the backend
    /// refuses.
    pub fn to_svg(&self) -> Result<String, VizError> {
        self.svg()
    }

    /// The chart as pixels, 1520 by 800.
    ///
    /// # Errors
    /// As [`Chart::to_svg`].
    pub fn to_picture(&self, theme: Theme) -> Result<Picture, VizError> {
        self.picture(theme)
    }

    /// Writes `STEM.svg`, and `STEM.png` on light ground.
    ///
    /// # Errors
    /// As [`Chart::to_svg`], and [`VizError::Write`] with the path.
    pub fn save(&self, stem: &Path) -> Result<(), VizError> {
        self.write(stem)
    }

    fn drawable(&self, series: &Series) -> Vec<(f64, f64)> {
        let points = series.points.iter().copied();
        points
            .filter(|&(x, y)| self.fits(x, self.log_x) && self.fits(y, self.log_y))
            .collect()
    }

    fn fits(&self, v: f64, is_log: bool) -> bool {
        v.is_finite() && (!is_log || v > 0.0)
    }

    /// Returns the label at a place of the horizontal axis.
    fn x_tick(&self, x: f64) -> String {
        if self.categories.is_empty() {
            return tick(x);
        }
        let is_whole = (x - x.round()).abs() < 1e-6 && x >= 1.0;
        let way = is_whole.then(|| self.categories.get(x.round() as usize - 1));
        way.flatten().cloned().unwrap_or_default()
    }

    fn draw<B, X, Y>(
        &self,
        root: &DrawingArea<B, Shift>,
        x: X,
        y: Y,
        series: &[Vec<(f64, f64)>],
    ) -> Result<(), DrawingAreaErrorKind<B::ErrorType>>
    where
        B: DrawingBackend,
        X: AsRangedCoord<Value = f64>,
        Y: AsRangedCoord<Value = f64>,
        X::CoordDescType: ValueFormatter<f64> + Ranged<ValueType = f64>,
        Y::CoordDescType: ValueFormatter<f64> + Ranged<ValueType = f64>,
    {
        let mut builder = ChartBuilder::on(root);
        builder
            .margin(12)
            .margin_right(24)
            .x_label_area_size(52)
            .y_label_area_size(72);
        if !self.title.is_empty() {
            builder.caption(&self.title, font(16.0));
        }
        let mut chart = builder.build_cartesian_2d(x, y)?;
        chart
            .configure_mesh()
            .x_desc(self.x_label.as_str())
            .y_desc(self.y_label.as_str())
            .x_labels(if self.categories.is_empty() {
                8
            } else {
                2 * self.categories.len() + 1
            })
            .y_labels(6)
            .x_label_formatter(&|v| self.x_tick(*v))
            .y_label_formatter(&|v| tick(*v))
            .label_style(font(13.0))
            .axis_desc_style(font(13.5))
            .axis_style(TEXT.mix(0.45))
            .bold_line_style(TEXT.mix(0.12))
            .light_line_style(TEXT.mix(0.0))
            .draw()?;
        for (i, (points, named)) in series.iter().zip(&self.series).enumerate() {
            if points.is_empty() {
                continue;
            }
            let colour = COLOURS[i % COLOURS.len()];
            let style = colour.stroke_width(2);
            let line = chart.draw_series(LineSeries::new(points.iter().copied(), style))?;
            if !named.name.is_empty() {
                line.label(named.name.as_str())
                    .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + 18, y)], style));
            }
            for &(x, low, high) in &named.spans {
                if [low, high].iter().all(|&y| self.fits(y, self.log_y)) {
                    let span = PathElement::new(vec![(x, low), (x, high)], colour.stroke_width(1));
                    chart.draw_series([span])?;
                }
            }
            if self.markers || points.len() == 1 {
                let discs = points.iter().map(|&p| Circle::new(p, 4, colour.filled()));
                chart.draw_series(discs)?;
            }
        }
        if self.series.iter().any(|s| !s.name.is_empty()) {
            chart
                .configure_series_labels()
                .position(SeriesLabelPosition::UpperRight)
                .label_font(font(13.0))
                .margin(8)
                .draw()?;
        }
        Ok(())
    }
}

impl Plot for Chart {
    fn size(&self) -> (u32, u32) {
        SIZE
    }

    fn draw_on<B: DrawingBackend>(&self, backend: B) -> Result<(), VizError> {
        let series: Vec<Vec<(f64, f64)>> = self.series.iter().map(|s| self.drawable(s)).collect();
        let points = || series.iter().flatten();
        let spans = self.series.iter().flat_map(|series| &series.spans);
        let ends = spans.flat_map(|&(_, low, high)| [low, high]);
        let ends = ends.filter(|&y| self.fits(y, self.log_y));
        let empty = || VizError::EmptyChart {
            title: self.title.clone(),
        };
        let x = match self.categories.len() {
            0 => range(points().map(|p| p.0), self.log_x, 0.0).ok_or_else(empty)?,
            n => (0.5, n as f64 + 0.5),
        };
        let y = points().map(|p| p.1).chain(ends);
        let y = range(y, self.log_y, 0.05).ok_or_else(empty)?;
        let root = backend.into_drawing_area();
        let logarithmic = |(low, high): (f64, f64)| {
            (low..high)
                .log_scale()
                .with_key_points(log_ticks(low, high))
        };
        match (self.log_x, self.log_y) {
            (false, false) => self.draw(&root, x.0..x.1, y.0..y.1, &series),
            (true, false) => self.draw(&root, logarithmic(x), y.0..y.1, &series),
            (false, true) => self.draw(&root, x.0..x.1, logarithmic(y), &series),
            (true, true) => self.draw(&root, logarithmic(x), logarithmic(y), &series),
        }
        .and_then(|()| root.present())
        .map_err(|error| VizError::Chart {
            title: self.title.clone(),
            reason: error.to_string(),
        })
    }
}

/// The least and greatest value, widened by a share of their distance, and to some width in any
/// case; `None` without values.
fn range(values: impl Iterator<Item = f64>, is_log: bool, share: f64) -> Option<(f64, f64)> {
    let to = |v: f64| if is_log { v.log10() } else { v };
    let from = |v: f64| if is_log { 10f64.powf(v) } else { v };
    let values: Vec<f64> = values.map(to).collect();
    let low = values.iter().copied().reduce(f64::min)?;
    let high = values.iter().copied().reduce(f64::max)?;
    let margin = if high > low {
        (high - low) * share
    } else {
        (high.abs() * 0.1).max(0.1)
    };
    Some((from(low - margin), from(high + margin)))
}

/// At least three numbers between two positive ones, as round as that allows.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    let decades = low.log10().floor() as i32..=high.log10().ceil() as i32;
    let rounds: [&[f64]; 3] = [
        &[1.0],
        &[1.0, 2.0, 5.0],
        &[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0],
    ];
    for digits in rounds {
        let all = decades
            .clone()
            .flat_map(|decade| digits.iter().map(move |d| d * 10f64.powi(decade)));
        let ticks: Vec<f64> = all.filter(|tick| (low..=high).contains(tick)).collect();
        if ticks.len() >= 3 {
            return ticks;
        }
    }
    (0..4)
        .map(|i| low + (high - low) * f64::from(i) / 3.0)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn losses() -> Chart {
        let points =
            |scale: f64| (1..=50).map(move |i| (f64::from(i) * 100.0, scale / f64::from(i)));
        Chart {
            title: "Loss & <friends>".into(),
            x_label: "step".into(),
            y_label: "loss, nats".into(),
            series: vec![
                Series {
                    name: "training".into(),
                    points: points(6.0).collect(),
                    spans: vec![(2000.0, 1.0, 9.0), (3000.0, f64::NAN, 2.0)],
                },
                Series {
                    name: "validation".into(),
                    points: points(7.0).chain([(f64::NAN, 1.0)]).collect(),
                    ..Series::default()
                },
            ],
            ..Chart::default()
        }
    }

    #[test]
    fn a_chart_names_its_axes_and_curves() {
        let svg = losses().to_svg().unwrap();
        for text in [
            "step",
            "loss, nats",
            "training",
            "validation",
            "&lt;friends&gt;",
        ] {
            assert!(svg.contains(text), "{text} is missing");
        }
        assert!(svg.matches("<polyline").count() >= 2);
        assert!(svg.contains("currentColor") && !svg.contains("#010203"));
        assert!(!svg.contains("NaN"));
    }

    #[test]
    fn pixels_show_curves_axes_and_words() {
        for theme in [Theme::Light, Theme::Dark] {
            let colours = theme.colours();
            let with = losses().to_picture(theme).unwrap();
            assert_eq!((with.width, with.height), (1520, 800));
            let count = |picture: &Picture, [r, g, b]: [u8; 3]| {
                let pixels = picture.rgba.chunks_exact(4);
                pixels.filter(|pixel| pixel[..3] == [r, g, b]).count()
            };
            for curve in &COLOURS[..2] {
                assert!(count(&with, [curve.0, curve.1, curve.2]) > 500);
            }
            assert_eq!(count(&with, [COLOURS[2].0, COLOURS[2].1, COLOURS[2].2]), 0);
            let mut bare = losses();
            (bare.title, bare.x_label, bare.y_label) = Default::default();
            let bare = bare.to_picture(theme).unwrap();
            assert!(count(&with, colours.text) > count(&bare, colours.text) + 200);
            assert_eq!(count(&with, [TEXT.0, TEXT.1, TEXT.2]), 0);
        }
        let folder = tempfile::tempdir().unwrap();
        losses().save(&folder.path().join("loss")).unwrap();
        let png = std::fs::read(folder.path().join("loss.png")).unwrap();
        let svg = std::fs::read_to_string(folder.path().join("loss.svg")).unwrap();
        assert!(png.starts_with(b"\x89PNG") && svg.starts_with("<svg"));
    }

    #[test]
    fn logarithmic_axes_leave_out_what_they_cannot_show() {
        let mut chart = losses();
        (chart.log_x, chart.log_y) = (true, true);
        chart.series[0].points.push((-1.0, 0.0));
        assert!(!chart.to_svg().unwrap().contains("NaN"));
        chart.series.truncate(1);
        chart.series[0].points = vec![(1.0, -1.0)];
        let error = chart.to_svg().unwrap_err();
        assert_eq!(
            error.to_string(),
            "chart \"Loss & <friends>\" has no point to draw"
        );
    }

    #[test]
    fn a_single_point_is_drawn_and_none_is_not() {
        let mut chart = losses();
        chart.series[0].points = vec![(3.0, 0.5)];
        chart.series[1].points.clear();
        let svg = chart.to_svg().unwrap();
        assert!(svg.contains("<circle"));
        // What has no points has no line in the legend either.
        assert!(svg.contains("training") && !svg.contains("validation"));
    }

    #[test]
    fn ways_stand_under_their_points() {
        let mut chart = losses();
        chart.categories = ["full", "partial"].map(String::from).into();
        chart.series.truncate(1);
        chart.series[0].points = vec![(1.0, 0.5), (2.0, 0.75)];
        chart.series[0].spans = vec![(1.0, 0.4, 0.6)];
        let svg = chart.to_svg().unwrap();
        assert!(
            ["full", "partial"]
                .iter()
                .all(|way| svg.matches(way).count() == 1)
        );
        assert_eq!(chart.x_tick(1.5), "");
        assert_eq!((chart.x_tick(0.0), chart.x_tick(3.0)), Default::default());
    }

    #[test]
    fn logarithmic_ticks_are_round() {
        assert_eq!(log_ticks(1e3, 1e8), [1e3, 1e4, 1e5, 1e6, 1e7, 1e8]);
        assert_eq!(log_ticks(1.2, 30.0), [2.0, 5.0, 10.0, 20.0]);
        assert_eq!(log_ticks(1.2, 3.0), [1.5, 2.0, 3.0]);
        assert_eq!(log_ticks(1.0, 1.3).len(), 4);
    }
}
