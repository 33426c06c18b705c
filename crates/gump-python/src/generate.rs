//! Scenes out of nothing, on the map of any scenario.

use gump_generate::constraint::parse_constraints;
use gump_generate::pipeline::{CheckedScene, GenerationJob, GenerationWorlds, make_many};
use gump_generate::{Counts, GenerateConfig, GenerateRequest, Placement};
use gump_scene::{ScenarioTag, Seed};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::scenario::{Scenario, Scene};
use crate::world::{Kind, World};
use crate::{errors, threads};

/// Scenes made together, by all threads, before an interrupt is looked for. Chosen by hand.
const BATCH: u64 = 32;

/// Arguments of `gump.generate`.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct Wish {
    prompts: Vec<String>,
    vehicles: Option<usize>,
    pedestrians: Option<usize>,
    bicycles: Option<usize>,
    objects: Option<String>,
    count: u64,
    seconds: f64,
    anywhere: bool,
    guided: bool,
    attempts: usize,
    seed: u64,
}

impl Wish {
    fn order(&self, recorded: &gump_scene::Scenario) -> PyResult<GenerationJob> {
        let tag = |name: &String| {
            let tag = name.parse::<ScenarioTag>();
            tag.map_err(|why| errors::value(format!("prompt: {why}")))
        };
        if !(0.0..=3600.0).contains(&self.seconds) {
            let found = self.seconds;
            return Err(errors::value(format!(
                "seconds: expected a number from 0 to 3600, found {found}"
            )));
        }
        let objects = match &self.objects {
            Some(text) => parse_constraints(text)
                .map_err(|error| errors::value(format!("objects: {error}")))?,
            None => Vec::new(),
        };
        let counts = [self.vehicles, self.pedestrians, self.bicycles];
        Ok(GenerationJob {
            request: GenerateRequest {
                prompts: self.prompts.iter().map(tag).collect::<PyResult<_>>()?,
                counts: counts.iter().any(Option::is_some).then(|| Counts {
                    vehicles: self.vehicles.unwrap_or(0),
                    pedestrians: self.pedestrians.unwrap_or(0),
                    bicycles: self.bicycles.unwrap_or(0),
                }),
                objects,
                config: GenerateConfig {
                    placement: if self.guided {
                        Placement::Guided
                    } else {
                        Placement::Free
                    },
                    ..GenerateConfig::default()
                },
                ..GenerateRequest::in_place_of(recorded)
            },
            roams: self.anywhere,
            seconds: self.seconds,
            attempts: self.attempts,
        })
    }
}

/// Makes scenes with `world`, whose seconds `traffic` simulates; a list of dictionaries.
#[pyfunction]
pub(crate) fn generate<'py>(
    py: Python<'py>,
    world: &World,
    traffic: &World,
    scenario: &Scenario,
    wish: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyList>> {
    let wish: Wish = wish.extract()?;
    let Kind::Transformer(model) = &world.kind else {
        return Err(errors::value(
            "world: expected a network that generates scenes, found one that does not",
        ));
    };
    if matches!(traffic.kind, Kind::Log) {
        return Err(errors::value(
            "traffic: expected a world that simulates new scenes, found log",
        ));
    }
    let traffic = traffic.model(&scenario.scene)?;
    let worlds = GenerationWorlds {
        scenes: model,
        traffic: &*traffic,
    };
    let order = wish.order(&scenario.scene.scenario)?;
    let list = PyList::empty(py);
    for first in (0..wish.count).step_by(BATCH as usize) {
        py.check_signals()?;
        let numbers = first..(first + BATCH).min(wish.count);
        let checked = threads::work(py, || make_many(worlds, &order, numbers, Seed(wish.seed)))?;
        for checked in checked.map_err(errors::value)? {
            list.append(scene_dict(py, checked.map_err(errors::runtime)?)?)?;
        }
    }
    Ok(list)
}

fn scene_dict(py: Python<'_>, checked: CheckedScene) -> PyResult<Bound<'_, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("holds", checked.holds())?;
    dict.set_item("attempts", checked.attempts)?;
    dict.set_item("is_steered", checked.is_steered)?;
    let clauses = checked
        .clauses
        .iter()
        .map(|clause| (&clause.clause, clause.holds));
    dict.set_item("clauses", clauses.collect::<Vec<_>>())?;
    let scenario = Scenario::new(Scene::of(checked.scenario));
    dict.set_item("scenario", Bound::new(py, scenario)?)?;
    Ok(dict)
}
