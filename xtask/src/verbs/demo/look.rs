//! The scenario: numbers, a picture, a raster, tokens.

use gump_data::{ReadReport, Summary};
use gump_model::ModelConfig;
use gump_raster::{Layer, rasterize};
use gump_scene::Scenario;
use gump_tokenizer::{Encoded, Identities, Tokenizer, TokenizerConfig};
use gump_viz::{Picture, Theme, draw_raster_layer};
use serde_json::{Value, json};

use super::Demo;
use crate::run::Run;
use crate::verbs::data;

/// Layers shown on the page: those that say most.
const SHOWN: [Layer; 6] = [
    Layer::DrivableArea,
    Layer::BaselinePaths,
    Layer::LaneDirectionCos,
    Layer::SpeedLimit,
    Layer::Route,
    Layer::RoadEdge,
];

/// Lines of the token listing on the page. Chosen by eye.
const LISTED: usize = 16;

pub(super) fn read(demo: &mut Demo, _: &mut Run) -> anyhow::Result<Value> {
    let scenario = &demo.scenario;
    Ok(json!({
        "scenario": scenario.id,
        "agents": scenario.present().now().agents().len(),
        "frames": scenario.log.len(),
        "lanes": scenario.map.lanes().len(),
    }))
}

/// Contents of the scenario, as (name, value).
fn facts(scenario: &Scenario) -> Vec<(String, String)> {
    let mut summary = Summary::default();
    summary.add(scenario, &ReadReport::default());
    let mut facts = vec![
        ("scenario".to_owned(), scenario.id.clone()),
        (
            "frames".to_owned(),
            format!(
                "{:.1} s of past, {:.1} s of future, one every {} s",
                scenario.now as f64 * scenario.dt,
                scenario.future().len() as f64 * scenario.dt,
                scenario.dt
            ),
        ),
        ("agents now".to_owned(), counts(&summary.agents_now)),
        ("map".to_owned(), counts(&summary.map)),
        (
            "lane kilometres".to_owned(),
            format!("{:.1}", summary.lane_length_m / 1000.0),
        ),
    ];
    if !summary.lights_now.is_empty() {
        facts.push(("lights now".to_owned(), counts(&summary.lights_now)));
    }
    facts
}

fn counts(counts: &std::collections::BTreeMap<&'static str, usize>) -> String {
    let parts: Vec<_> = counts
        .iter()
        .map(|(name, n)| format!("{name} {n}"))
        .collect();
    parts.join(", ")
}

pub(super) fn picture(demo: &mut Demo, run: &mut Run) -> anyhow::Result<Value> {
    let picture = data::picture(&demo.scenario);
    let path = run.path("scene.png");
    picture.save_png(&path)?;
    let caption = "The present, where agents came from, and where they went in the recording.";
    demo.page
        .section("The scene")
        .prose("A scenario is a map, traffic lights, and every agent at every instant.")
        .picture(&picture, caption)?
        .key_values(&facts(&demo.scenario));
    Ok(json!({ "file": path }))
}

pub(super) fn raster(demo: &mut Demo, _: &mut Run) -> anyhow::Result<Value> {
    let scene = demo.scenario.present();
    let spec = ModelConfig::tiny().raster_spec()?;
    let raster = rasterize(&spec, &scene, scene.ego_now().state.pose);
    let gallery: Vec<(Picture, String)> = SHOWN
        .into_iter()
        .filter_map(|layer| {
            let picture = draw_raster_layer(&raster, layer, 1, Theme::Light)?;
            Some((picture, layer.name().replace('_', " ")))
        })
        .collect();
    let (side, metres) = (spec.side_px, spec.metres_per_px);
    demo.page
        .section("What the network sees")
        .prose(&format!(
            "The map around the ego as {} layers of {side} x {side} pixels, {metres} m each, the \
             ego in the middle and looking up. Six of them:",
            spec.layers.len()
        ))
        .gallery(&gallery)?;
    Ok(json!({ "layers": spec.layers.len(), "side_px": side, "metres_per_px": metres }))
}

pub(super) fn tokens(demo: &mut Demo, _: &mut Run) -> anyhow::Result<Value> {
    let scene = demo.scenario.present();
    let stride = (0.5 / scene.dt).round() as usize;
    let frames = scene.strided_history(stride, 3);
    let world_from_scene = scene.ego_now().state.pose;
    let identities = Identities::ranked(&frames, scene.ego, world_from_scene);
    let tokenizer = Tokenizer::new(TokenizerConfig::default());
    let Encoded {
        sequence, report, ..
    } = tokenizer.encode(scene.map, &frames, scene.ego, world_from_scene, &identities);
    let text = sequence.to_string();
    let mut listing: String = text
        .lines()
        .take(LISTED)
        .map(|line| format!("{line}\n"))
        .collect();
    let n_lines = text.lines().count();
    if n_lines > LISTED {
        listing.push_str(&format!("... and {} lines more\n", n_lines - LISTED));
    }
    let clamped: usize = report.clamped.values().sum();
    demo.page
        .section("What the network reads")
        .prose(&format!(
            "{} frames, half a second apart, as {} tokens: who, then in which state. Positions are \
             relative to the ego and rounded to the quantum of their field. {clamped} values lay \
             outside their range, {} agent-frames too far away.",
            frames.len(),
            sequence.len(),
            report.out_of_range,
        ))
        .preformatted(&listing);
    Ok(json!({
        "frames": frames.len(),
        "tokens": sequence.len(),
        "clamped": clamped,
        "out_of_range": report.out_of_range,
    }))
}
