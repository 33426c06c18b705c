//! What is asked for, what comes of it, and the making.

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_engine::TransformerWorld;
use gump_engine::placement::object_spec::ObjectSpec;
use gump_geometry::{DVec2, Pose};
use gump_model::ModelError;
use gump_scene::{Agent, AgentId, AgentKind, Frame, Light, MapGraph, Scenario, ScenarioTag, Seed};
use serde::{Deserialize, Serialize};

use crate::advance;
use crate::draft::Draft;
use crate::prepared::Prepared;

/// A scene to be made.
#[derive(Clone, Debug)]
pub struct GenerateRequest {
    /// The road.
    pub map: Arc<MapGraph>,
    /// Where the ego is and what of it is known.
    pub ego: EgoStart,
    /// Traffic lights as they are shown.
    pub lights: Vec<Light>,
    /// What stands around without moving: cones, barriers, signs. Never drawn by the network.
    pub fixtures: Vec<Agent>,
    /// What kind of situation it is to be; at most four, none for any.
    pub prompts: Vec<ScenarioTag>,
    /// How many objects besides the ego; `None` leaves that to the network.
    pub counts: Option<Counts>,
    /// Wishes for single objects. They are among those counted.
    pub objects: Vec<ObjectSpec>,
    /// How scenes are drawn.
    pub config: GenerateConfig,
}

/// The ego of a scene to be made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EgoStart {
    /// Box centre, world frame.
    pub pose: Pose,
    /// Metres.
    pub length: f64,
    /// Metres.
    pub width: f64,
    /// World frame, metres per second; `None` leaves the speed to the network.
    pub velocity: Option<DVec2>,
}

/// Numbers of objects by class.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Cars, trucks, buses, the ego not counted.
    pub vehicles: usize,
    /// People on foot.
    pub pedestrians: usize,
    /// Bicycles.
    pub bicycles: usize,
}

impl Counts {
    /// The number of a class.
    pub fn of(&self, kind: AgentKind) -> usize {
        match kind {
            AgentKind::Vehicle => self.vehicles,
            AgentKind::Pedestrian => self.pedestrians,
            AgentKind::Bicycle => self.bicycles,
            _ => 0,
        }
    }

    /// All together.
    pub fn total(&self) -> usize {
        self.vehicles + self.pedestrians + self.bicycles
    }
}

/// How scenes are drawn.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GenerateConfig {
    /// Divides the logits (paper: 1.25).
    pub temperature: f64,
    /// Multiplies the temperature of widths and lengths (paper: 1).
    pub size_boldness: f64,
    /// Multiplies the temperature of x and y (paper: 1).
    pub place_boldness: f64,
    /// What training spread the targets of sizes and velocities by (`smoothing_bins`), to be taken
    /// off again: a standard deviation in bins; 0 leaves it (paper).
    pub smoothing_bins: f64,
    /// Whether training spread the targets of sizes, too: not with `exact_standing`.
    pub smoothed_sizes: bool,
    /// Whether the draws of a scene's objects are spread evenly where their number is given (paper:
    /// no).
    pub even: bool,
    /// Bins that may be drawn per field (paper: 200 in the text, 400 in the table).
    pub top_k: usize,
    /// Where objects may be drawn.
    pub placement: Placement,
    /// Whether who stands in a lane has a reason to: a light, a sign, a junction or somebody before
    /// him. In guided placement only. Scenes are less like recorded ones for it, and go on better.
    pub standing_has_reasons: bool,
    /// Draws per object before the scene is begun anew.
    pub tries: usize,
    /// Times a scene is begun anew before it is given up.
    pub restarts: usize,
    /// Most objects where their number is left to the network.
    pub max_agents: usize,
}

impl GenerateConfig {
    /// Draws as the paper has them: bolder, and each on its own.
    pub fn paper() -> Self {
        Self {
            temperature: 1.25,
            size_boldness: 1.0,
            place_boldness: 1.0,
            top_k: 400,
            smoothing_bins: 0.0,
            smoothed_sizes: true,
            even: false,
            ..Self::default()
        }
    }
}

impl Default for GenerateConfig {
    /// What makes scenes most like recorded ones with the shipped weights
    /// (docs/results/0012-generation.md).
    fn default() -> Self {
        Self {
            temperature: 1.0,
            size_boldness: 1.3,
            place_boldness: 1.5,
            smoothing_bins: 0.7,
            smoothed_sizes: true,
            even: true,
            standing_has_reasons: false,
            top_k: 1000,
            placement: Placement::Guided,
            tries: 24,
            restarts: 4,
            max_agents: 64,
        }
    }
}

/// Where objects may be drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Placement {
    /// Wherever the network puts them, overlaps and off-road starts excepted.
    Free,
    /// Of what the network proposes, only what lies on lanes (vehicles, bicycles) or walkways, goes
    /// the lane's way, and has a size and speed common in its class.
    Guided,
}

/// A scene that was made.
#[derive(Clone, Debug)]
pub struct GeneratedScene {
    /// Who is there and how the lights stand, world frame.
    pub frame: Frame,
    /// The ego, which is in it.
    pub ego: AgentId,
    /// Objects that were wished for, by their name.
    pub names: BTreeMap<String, AgentId>,
    /// Draws that broke a rule.
    pub redraws: usize,
    /// Times it was begun anew.
    pub restarts: usize,
}

impl GeneratedScene {
    /// The scene as the only frame of a scenario.
    pub fn scenario(&self, id: String, map: &Arc<MapGraph>, prompts: &[ScenarioTag]) -> Scenario {
        let mut tags = prompts.to_vec();
        tags.sort_unstable();
        Scenario {
            id,
            map: Arc::clone(map),
            route: None,
            log: vec![self.frame.clone()],
            dt: 0.1,
            now: 0,
            ego: self.ego,
            targets: Vec::new(),
            objects_of_interest: Vec::new(),
            tags,
        }
    }
}

/// Why there is no scene.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// Wishes that contradict themselves, each other or the map.
    #[error("constraints: {0}")]
    Constraints(String),
    /// Nothing can drive on the map.
    #[error("the map has no drivable lane within 100 m of the ego")]
    NoLane,
    /// Prompts for which the map has no place.
    #[error(
        "prompts: no place within 150 m of the ego can hold {prompts}; the map may lack a crosswalk, \
         a stop sign, a lit light or a way that it needs"
    )]
    NoStage {
        /// Their names.
        prompts: String,
    },
    /// More objects than there are keys or room for.
    #[error("{asked} objects are more than the {most} that a scene of this model holds")]
    TooMany {
        /// Objects asked for.
        asked: usize,
        /// The most there can be.
        most: usize,
    },
    /// An object found no place.
    #[error(
        "{object} found no place in {scenes} scenes begun with {tries} draws each; most often it \
         could not meet: {clause}"
    )]
    NoPlace {
        /// Its id, or its class if it has none.
        object: String,
        /// Scenes begun.
        scenes: usize,
        /// Draws in each.
        tries: usize,
        /// The rule broken most often.
        clause: String,
    },
    /// The network failed.
    #[error(transparent)]
    Model(#[from] ModelError),
}

/// One scene per seed, each a function of the request and its own seed alone.
///
/// # Errors
/// What makes every scene impossible; what a single scene failed at stands in its place.
pub fn generate(
    world: &TransformerWorld,
    request: &GenerateRequest,
    seeds: &[Seed],
) -> Result<Vec<Result<GeneratedScene, GenerateError>>, GenerateError> {
    let prepared = Prepared::new(world, request)?;
    let mut drafts: Vec<Draft<'_>> = seeds
        .iter()
        .map(|seed| Draft::new(&prepared, *seed))
        .collect();
    while advance::advance(world, &mut drafts)? {}
    Ok(drafts.into_iter().map(Draft::finish).collect())
}
