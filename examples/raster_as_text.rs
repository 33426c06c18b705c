//! Prints the raster of a shipped scene, the input of the network, as text.
//!
//! `cargo run -p examples --example raster_as_text [FILE#INDEX]`

use gump::raster::{Layer, RasterSpec, rasterize};

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../datasets/mini/procedural.tfrecord.gz#17"
);

fn main() -> anyhow::Result<()> {
    let name = std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into());
    let scenario = gump::data::find(&name)?;
    let scene = scenario.present();
    let ego = scene.ego_now().state.pose;

    // 36 pixels of 2.5 m each way; the ego looks up.
    let drawn = [
        (Layer::Ego, '@'),
        (Layer::Agents, 'o'),
        (Layer::Crosswalk, '='),
        (Layer::Route, '+'),
        (Layer::DrivableArea, '.'),
    ];
    let spec = RasterSpec::new(36, 2.5, drawn.map(|(layer, _)| layer).to_vec());
    let raster = rasterize(&spec, &scene, ego);
    for row in 0..36 {
        let letter = |column: usize| {
            let painted = |i: &usize| raster.layer(*i)[row * 36 + column] > 0.0;
            (0..drawn.len()).find(painted).map_or(' ', |i| drawn[i].1)
        };
        let line: String = (0..36).flat_map(|column| [letter(column), ' ']).collect();
        println!("{}", line.trim_end());
    }

    // The planes that the paper's model reads, and how much of each is not zero.
    let raster = rasterize(&RasterSpec::paper(), &scene, ego);
    for layer in &raster.layers {
        let plane = raster.get(*layer).unwrap_or_default();
        let painted = plane.iter().filter(|value| **value != 0.0).count();
        let share = 100.0 * painted as f64 / plane.len() as f64;
        println!("{:>20} {share:5.1} %", layer.name());
    }
    Ok(())
}
