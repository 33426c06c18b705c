//! Pictures, films, charts and pages: everything a person looks at.
//!
//! Start with [`draw_scene`] for a still, [`grid_film`] and [`overlay_film`] for futures in
//! motion, [`Chart`] for curves, [`Bars`] for tables and [`Page`] to put them all into one file that needs no network.
//! [`Viewer`] writes a page of another sort: a scene to play, turn over and click into; [`Gallery`] one of
//! several scenes.
//!
//! # Terms
//! * **camera**: which part of the world is seen, from above, and which way is up.
//! * **picture**: opaque RGBA pixels. **Film**: an animated GIF, its bytes complete.
//! * **trail**: where an agent has been (fading with age) or will be (thin, one per future).
//! * **theme**: light or dark; classes keep their colours, from the colour-blind safe set of
//!   Okabe and Ito (2008).
//!
//! Drawing cannot fail; writing files and compressing can, with [`VizError`]. Sizes, widths and
//! opacities of what is drawn are chosen by eye.
//!
//! ```
//! use gump_viz::{Camera, Page, PictureSpec, draw_scene};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 100,0
//!      ego vehicle 0: 10,0 velocity 8,0",
//! ).unwrap();
//! let scene = scenario.present();
//! let spec = PictureSpec::new(Camera::on_ego(&scene, 80.0, 400, 300));
//! let picture = draw_scene(&scene, &spec);
//!
//! let mut page = Page::new("One car");
//! page.section("The scene").picture(&picture, "A car on a straight lane.")?;
//! assert!(page.to_html().contains("data:image/png;base64,"));
//! # Ok::<(), gump_viz::VizError>(())
//! ```

mod bars;
mod camera;
mod chart;
mod chart_canvas;
mod draw_agents;
mod draw_map;
mod error;
mod files;
mod film;
mod indexed;
mod legend;
mod page;
mod pen;
mod picture;
mod plot;
mod text_layout;
mod theme;
mod video;
mod viewer;

#[cfg(test)]
mod tests;

pub use bars::{Bar, BarGroup, Bars};
pub use camera::Camera;
pub use chart::{Chart, Series};
pub use error::VizError;
pub use film::{Film, FilmSpec, LabelledRollout, grid_film, log_as_rollout, overlay_film};
pub use page::{Page, Section};
pub use picture::{
    Picture, PictureSpec, draw_candidates, draw_futures, draw_raster_layer, draw_scene,
};
pub use theme::Theme;
pub use video::can_encode_mp4;
pub use viewer::{CandidatePath, Gallery, HeatMap, MetricTrack, Viewer};
