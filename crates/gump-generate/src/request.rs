//! Requests for scenes, their results, and generation.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use gump_engine::placement::object_spec::ObjectSpec;
use gump_engine::{EngineError, TransformerWorld};
use gump_geometry::{DVec2, Pose};
use gump_rollout::BoxError;
use gump_scene::{Agent, AgentId, AgentKind, Frame, Light, MapGraph, Scenario, ScenarioTag, Seed};
use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

use crate::advance;
use crate::constraint::ConstraintError;
use crate::partial_scene::PartialScene;
use crate::prepared::Prepared;

/// A request for a scene.
#[derive(Clone, Debug)]
pub struct GenerateRequest {
    /// The map.
    pub map: Arc<MapGraph>,
    /// The ego's pose and known values.
    pub ego: EgoStart,
    /// The states of traffic lights.
    pub lights: Vec<Light>,
    /// Static objects: cones, barriers, signs. The network never generates them.
    pub fixtures: Vec<Agent>,
    /// Prompts: the kind of situation; at most four, none for any.
    pub prompts: Vec<ScenarioTag>,
    /// Number of objects besides the ego; `None` leaves it to the network.
    pub counts: Option<Counts>,
    /// Constraints on single objects, which are included in the count.
    pub objects: Vec<ObjectSpec>,
    /// Sampling settings.
    pub config: GenerateConfig,
}

impl GenerateRequest {
    /// A request for scenes in place of a recorded one: its map, lights and fixtures, and its ego,
    /// whose speed is open.
    pub fn in_place_of(recorded: &Scenario) -> Self {
        let present = recorded.present();
        let ego = present.ego_now();
        let agents = present.now().agents().iter();
        Self {
            map: Arc::clone(&recorded.map),
            ego: EgoStart {
                pose: ego.state.pose,
                length: ego.length,
                width: ego.width,
                velocity: None,
            },
            lights: present.now().lights().to_vec(),
            fixtures: agents
                .filter(|agent| !agent.kind.is_moving())
                .copied()
                .collect(),
            prompts: Vec::new(),
            counts: None,
            objects: Vec::new(),
            config: GenerateConfig::default(),
        }
    }
}

/// The ego of a requested scene.
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
    /// Pedestrians.
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

    /// Their sum.
    pub fn total(&self) -> usize {
        self.vehicles + self.pedestrians + self.bicycles
    }
}

/// Sampling settings of scene generation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GenerateConfig {
    /// Divides the logits (paper: 1.25).
    pub temperature: f64,
    /// Multiplies the temperature of widths and lengths (paper: 1).
    pub size_boldness: f64,
    /// Multiplies the temperature of x and y (paper: 1).
    pub place_boldness: f64,
    /// Smoothing of the targets of sizes and velocities in training (`smoothing_bins`), which is
    /// removed: standard deviation in bins; 0 leaves it (paper).
    pub smoothing_bins: f64,
    /// Whether training smoothed the targets of sizes as well: not with `exact_standing`.
    pub smoothed_sizes: bool,
    /// Whether the draws of a scene's objects are stratified where their number is given (paper:
    /// no).
    pub even: bool,
    /// Bins that may be drawn per field (paper: 200 in the text, 400 in the table).
    pub top_k: usize,
    /// The places allowed for objects.
    pub placement: Placement,
    /// Whether the placement network draws the places of vehicles, with guided placement, and not
    /// the sequence network, which knows little about where vehicles are (paper: no). Vehicles in a
    /// row with others and those whose position is given are placed by their constraints.
    pub placement_network: bool,
    /// Whether the placement network may park vehicles beyond the edges of the road, on driveways
    /// and in car parks, where two of five recorded vehicles are. Scenes then fail the check that
    /// vehicles are on the road.
    pub parks_off_road: bool,
    /// Whether traffic must be able to go on from the scene. A vehicle that stands in a lane then needs a
    /// reason (a light, a sign, a junction or another agent ahead, in a junction an agent ahead), no two
    /// vehicles are across each other's ways in a junction, and who drives can stop behind who is ahead
    /// (paper: no). In guided placement only. Reasons to stand are waived in the second half of an object's
    /// draws.
    pub ready_to_drive: bool,
    /// Whether the network reads the prompts as tokens. Without them, prompts still choose the place
    /// and which scenes are accepted.
    pub prompt_tokens: bool,
    /// Whether the ego may be steered where no rollout satisfies the prompts.
    pub steers: bool,
    /// Draws per object before the scene is started again; at least one.
    pub tries: usize,
    /// Restarts of a scene before it is given up.
    pub restarts: usize,
    /// Maximum number of objects where the network decides it.
    pub max_agents: usize,
}

impl GenerateConfig {
    /// The paper's sampling: higher temperature, independent draws.
    pub fn paper() -> Self {
        Self {
            temperature: 1.25,
            size_boldness: 1.0,
            place_boldness: 1.0,
            top_k: 400,
            smoothing_bins: 0.0,
            smoothed_sizes: true,
            even: false,
            placement_network: false,
            ready_to_drive: false,
            ..Self::default()
        }
    }
}

impl Default for GenerateConfig {
    /// The settings with the scenes most similar to recorded ones, with the shipped weights
    /// (docs/results/0012-generation.md). The limits (`tries`, `restarts`, `max_agents`) bound the
    /// time of a scene and were not tuned.
    fn default() -> Self {
        Self {
            temperature: 1.0,
            size_boldness: 1.3,
            place_boldness: 1.5,
            smoothing_bins: 0.7,
            smoothed_sizes: true,
            even: true,
            placement_network: true,
            parks_off_road: false,
            ready_to_drive: true,
            top_k: 1000,
            placement: Placement::Guided,
            prompt_tokens: true,
            steers: true,
            tries: 24,
            restarts: 4,
            max_agents: 64,
        }
    }
}

/// The places allowed for objects.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Placement {
    /// Wherever the network places them, except overlaps and off-road starts.
    Free,
    /// Only on lanes (vehicles, bicycles) or walkways, in the lane's direction, with sizes and
    /// speeds in the usual range of their class.
    Guided,
}

impl Placement {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 2] = [Self::Free, Self::Guided];
}

impl fmt::Display for Placement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Placement {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}

/// A generated scene.
#[derive(Clone, Debug)]
pub struct GeneratedScene {
    /// Its agents and lights, world frame.
    pub frame: Frame,
    /// The ego, which is in it.
    pub ego: AgentId,
    /// Objects with constraints, by their names.
    pub names: BTreeMap<String, AgentId>,
    /// Number of rejected draws.
    pub redraws: usize,
    /// Number of restarts.
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
#[non_exhaustive]
pub enum GenerateError {
    /// Constraints that contradict themselves, each other or the map.
    #[error("constraints: {0}")]
    Constraints(#[from] ConstraintError),
    /// The map has no lane for vehicles.
    #[error("the map has no drivable lane within 100 m of the ego")]
    NoLane,
    /// Prompts for which the map has no place.
    #[error(
        "prompts: no place within 150 m of the ego can hold {prompts}; the map may lack a crosswalk, \
         a stop sign, a lit light or a way that it needs"
    )]
    NoSite {
        /// Their names.
        prompts: String,
    },
    /// More objects than there are keys or space for.
    #[error("{requested} objects are more than the {max} that a scene of this model holds")]
    TooMany {
        /// Number requested.
        requested: usize,
        /// The maximum.
        max: usize,
    },
    /// No draws are allowed.
    #[error("tries is 0, expected at least one draw per object")]
    NoTries,
    /// No valid state was found for an object.
    #[error(
        "{object} found no place in {scenes} scenes begun with {tries} draws each; most often it \
         could not meet: {clause}"
    )]
    NoPlace {
        /// Its id, or its class if it has none.
        object: String,
        /// Number of restarts.
        scenes: usize,
        /// Draws in each.
        tries: usize,
        /// The most frequent violation.
        clause: String,
    },
    /// The network failed, or cannot generate.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The future of a scene could not be simulated.
    #[error("scene: {0}")]
    Rollout(BoxError),
}

/// One scene per seed, each a function of the request and its own seed only.
///
/// # Errors
/// Reasons that make every scene impossible; the failure of a single scene is in its place.
pub fn generate(
    world: &TransformerWorld,
    request: &GenerateRequest,
    seeds: &[Seed],
) -> Result<Vec<Result<GeneratedScene, GenerateError>>, GenerateError> {
    let prepared = Prepared::new(world, request)?;
    let mut drafts: Vec<PartialScene<'_>> = seeds
        .iter()
        .map(|seed| PartialScene::new(&prepared, *seed))
        .collect();
    while advance::advance(world, &mut drafts)? {}
    Ok(drafts.into_iter().map(PartialScene::finish).collect())
}
