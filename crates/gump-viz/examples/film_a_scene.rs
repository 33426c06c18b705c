//! A recorded scene as a still and as a film, without a display.
//!
//! `cargo run -p gump-viz --example film_a_scene [FILE#INDEX]` writes `out/scene.png` and
//! `out/scene.gif`.

use std::error::Error;
use std::path::Path;

use gump_viz::{Camera, FilmSpec, LabelledRollout, PictureSpec, Theme};
use gump_viz::{draw_futures, grid_film, log_as_rollout};

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../../datasets/mini/sumo-lankershim.tfrecord.gz#0"
);

fn main() -> Result<(), Box<dyn Error>> {
    let name = std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into());
    let scenario = gump_data::find(&name)?;
    let scene = scenario.present();
    std::fs::create_dir_all("out")?;

    // A hundred metres around the ego, which looks up; thin lines show the paths of all agents.
    let camera = Camera::on_ego(&scene, 100.0, 640, 480);
    let spec = PictureSpec::new(camera)
        .with_theme(Theme::Dark)
        .with_label(&scenario.id);
    let picture = draw_futures(&scene, &[scenario.future()], &spec);
    picture.save_png(Path::new("out/scene.png"))?;

    let log = log_as_rollout(&scenario);
    let take = LabelledRollout {
        rollout: &log,
        label: scenario.id.clone(),
    };
    let spec = FilmSpec {
        columns: 1,
        speed: 2.0,
        ..FilmSpec::new(camera)
    };
    let film = grid_film(&[take], &spec)?;
    film.save(Path::new("out/scene.gif"))?;
    println!(
        "out/scene.png: {} x {} pixels; out/scene.gif: {} frames, {} kB",
        picture.width,
        picture.height,
        film.n_frames,
        film.gif.len() / 1000
    );
    Ok(())
}
