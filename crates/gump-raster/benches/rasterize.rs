//! The time of one raster over a city the size of a Waymo map.

use std::fmt::Write;
use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use gump_raster::{RasterSpec, rasterize};
use gump_scene::{Scenario, fixture};

/// 400 lanes of 60 points, 200 edges and lines, 40 crosswalks, 100 agents; half of it in view.
fn city() -> Scenario {
    let mut text = String::new();
    for i in 0..400 {
        let (x, y) = (
            f64::from(i % 20) * 15.0 - 150.0,
            f64::from(i / 20) * 15.0 - 150.0,
        );
        let bend = |k: i32| {
            (
                x + f64::from(k) * 0.5,
                y + (f64::from(k) * 0.05).sin() * 3.0,
            )
        };
        let points = (0..60).map(bend).fold(String::new(), |mut text, (x, y)| {
            write!(text, " {x},{y}").expect("writing to a string");
            text
        });
        writeln!(text, "lane {i}:{points} speed 15").expect("writing to a string");
        if i % 2 == 0 {
            let kind = if i % 4 == 0 { "line" } else { "edge" };
            writeln!(text, "{kind}:{points}").expect("writing to a string");
        }
        if i % 10 == 0 {
            let (right, top) = (x + 3.0, y + 8.0);
            writeln!(
                text,
                "crosswalk: {x},{y} {right},{y} {right},{top} {x},{top}\nlight {i} red: {x},{y}"
            )
            .expect("writing to a string");
        }
        if i % 4 == 0 {
            writeln!(text, "agent vehicle {}: {x},{y} velocity 5,0", i + 1)
                .expect("writing to a string");
        }
    }
    text += "route 200,201,202\nego vehicle 0: 0,0 velocity 8,0\nhistory 1.0 future 0.0 dt 0.1";
    fixture::scenario(&text).expect("the city is well-formed")
}

fn rasters(c: &mut Criterion) {
    let city = city();
    let scene = city.present();
    let pose = scene.ego_now().state.pose;
    for (name, spec) in [
        ("full 208 px at 1 m", RasterSpec::full(208, 1.0)),
        ("paper 416 px at 0.5 m", RasterSpec::paper()),
    ] {
        c.bench_function(name, |b| {
            b.iter(|| black_box(rasterize(black_box(&spec), &scene, pose)));
        });
    }
}

criterion_group!(benches, rasters);
criterion_main!(benches);
