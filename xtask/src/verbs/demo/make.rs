//! A scene from a prompt, on the scenario's map.

use gump_eval::worlds::World;
use gump_generate::check::{off_road, overlaps};
use gump_generate::pipeline::{GenerationJob, GenerationWorlds, make_many};
use gump_generate::{Counts, GenerateRequest};
use gump_model::Device;
use gump_scene::ScenarioTag;
use gump_viz::{Camera, PictureSpec, draw_scene, log_as_rollout};
use serde_json::{Value, json};

use super::Demo;
use crate::run::Run;
use crate::verbs::generate;
use crate::{films, shipped};

/// Prompt of the generated scene.
const PROMPT: &str = "near_multiple_vehicles";
/// Agents of the generated scene: so many that the prompt can hold. Chosen by hand.
const COUNTS: Counts = Counts {
    vehicles: 14,
    pedestrians: 4,
    bicycles: 2,
};
/// Length of its future in the learned world, seconds. Chosen by hand, like the next.
const SECONDS: f64 = 6.0;
/// Attempts before a scene that misses the prompt is shown.
const ATTEMPTS: usize = 20;

pub(super) fn scene(demo: &mut Demo, run: &mut Run) -> anyhow::Result<Value> {
    let prompt: ScenarioTag = PROMPT.parse().map_err(anyhow::Error::msg)?;
    let network = generate::world(&Device::Cpu, None, false)?;
    let traffic = World::without_log(run.device(), &shipped::world(), &demo.sampling)?;
    let worlds = GenerationWorlds {
        scenes: &network,
        traffic: traffic.model(),
    };
    let order = GenerationJob {
        request: GenerateRequest {
            prompts: vec![prompt],
            counts: Some(COUNTS),
            ..GenerateRequest::in_place_of(&demo.scenario)
        },
        roams: false,
        seconds: SECONDS,
        attempts: ATTEMPTS,
    };
    let mut checked = make_many(worlds, &order, 0..1, run.seed())?;
    let checked = checked.remove(0)?;
    let scene = &checked.scenario;
    let spec = PictureSpec {
        legend: true,
        ..PictureSpec::new(Camera::on_ego(&scene.present(), 100.0, 960, 640))
    };
    let picture = draw_scene(&scene.present(), &spec);
    picture.save_png(&run.path("generated.png"))?;
    let alone = gump_scene::Scenario {
        log: scene.log[..=scene.now].to_vec(),
        ..scene.clone()
    };
    let film = films::film(&alone, &[("generated", &log_as_rollout(scene))])?;
    film.save(&run.path("generated.gif"))?;
    let table: Vec<Vec<String>> = checked
        .clauses
        .iter()
        .map(|clause| {
            let verdict = match clause.holds {
                Some(true) => "yes",
                Some(false) => "no",
                None => "cannot be decided",
            };
            vec![clause.clause.clone(), verdict.to_owned()]
        })
        .collect();
    let present = scene.present();
    demo.page
        .section("A scene from a prompt")
        .prose(&format!(
            "On the same map, the sequence network placed {} vehicles, {} pedestrians and {} bicycles \
             so that \"{PROMPT}\" is satisfied; the tag is one of nuPlan's 73.",
            COUNTS.vehicles, COUNTS.pedestrians, COUNTS.bicycles
        ))
        .picture(&picture, "The generated scene.")?
        .table(&["constraint", "satisfied"], &table)
        .link("generated.gif", "Play the rollout in the learned world");
    Ok(json!({
        "agents": present.now().agents().len(),
        "attempts": checked.attempts,
        "overlaps": overlaps(scene),
        "offroad": off_road(scene),
        "holds": checked.holds(),
    }))
}
