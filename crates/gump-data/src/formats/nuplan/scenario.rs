//! Fifteen seconds of a log as a nuPlan scenario, and as a [`Scenario`].
//!
//! [`NuplanScenario`] keeps what nuPlan's simulation needs and a [`Scenario`] cannot represent:
//! exact times, the ego at its rear axle, boxes in nuPlan's order, the expert's states beyond the
//! end. `log` has the queries. Start with [`NuplanScenario::read`].

use std::collections::BTreeMap;
use std::sync::Arc;

use gump_geometry::{Pose, dvec2};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, EgoState, Frame, Light, MapGraph, RoadblockId, Scenario,
    ScenarioTag, VehicleParameters,
};

use super::log::{Event, Log, LogBox, LogRow, unexpected};
use super::{Token, route};
use crate::error::MAX_COORDINATE;
use crate::{DataError, Problem, ReadOptions, ReadReport, RecordLocation};

/// The ego's id; tracks count from 1.
pub const EGO: AgentId = AgentId(0);

/// Seconds between frames: every second row of a log at 20 Hz.
pub const DT: f64 = 0.1;

/// Every how many rows a frame is taken.
const STRIDE: usize = 2;

/// A time step may stray from [`DT`] by this fraction: clocks jitter by milliseconds, a lost row
/// would be 50 %.
const TIME_STEP_TOLERANCE: f64 = 0.4;

/// The part of a log around an event that becomes the scenario.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extraction {
    /// Time of iteration 0 relative to the event, seconds.
    pub offset_s: f64,
    /// From iteration 0 to the last, seconds.
    pub duration_s: f64,
    /// Frames before iteration 0, [`DT`] apart.
    pub history: usize,
    /// Ego states after the last iteration, [`DT`] apart, for open-loop scores.
    pub expert_after: usize,
}

impl Default for Extraction {
    /// The values of nuPlan's challenges: 15 s from 3 s before the event, 2.2 s of history (22
    /// frames), and the longest open-loop horizon of 8 s.
    ///
    /// Source: the scenario mapping and history buffer of nuplan-devkit.
    fn default() -> Self {
        Self {
            offset_s: -3.0,
            duration_s: 15.0,
            history: 22,
            expert_after: 80,
        }
    }
}

/// One instant of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogFrame {
    /// The row it was taken from.
    pub token: Token,
    /// The ego at its rear axle, with the time stamp of the frame.
    pub ego: EgoState,
    /// All other agents in nuPlan's order: by kind, within a kind as recorded. Velocities that were
    /// not recorded are NaN here (and 0 in a [`Scenario`]).
    pub objects: Vec<Agent>,
    /// The known lights, by lane connector.
    pub lights: Vec<Light>,
}

/// A scenario for nuPlan's simulation.
#[derive(Clone, Debug)]
pub struct NuplanScenario {
    /// The event's row, which names the scenario.
    pub token: Token,
    /// The log's own name.
    pub log_name: String,
    /// The location.
    pub map_name: String,
    /// The type that nuPlan counts it as; "unknown" if untagged.
    pub scenario_type: String,
    /// All tags of the event, sorted.
    pub types: Vec<String>,
    /// The map of the whole city.
    pub map: Arc<MapGraph>,
    /// Frames before iteration 0, oldest first; fewer at the beginning of a log.
    pub history: Vec<LogFrame>,
    /// The iterations of the simulation, the first at the scenario's start.
    pub iterations: Vec<LogFrame>,
    /// The ego after the last iteration, [`DT`] apart; fewer at the end of a log.
    pub ego_after: Vec<EgoState>,
    /// The roadblocks of the route, as stated.
    pub roadblocks: Vec<RoadblockId>,
    /// The goal, rear axle.
    pub goal: Option<Pose>,
    /// The recorded identity of each track: that of agent `AgentId(i)` is at `i - 1`.
    pub tracks: Vec<Token>,
}

impl NuplanScenario {
    /// Reads the frames around an event; `scenario_type` is the type to count it as.
    ///
    /// # Errors
    /// [`DataError::Sqlite`]; [`DataError::Scenario`] if the log has no row there or a state is not
    /// a number.
    pub fn read(
        log: &Log,
        event: &Event,
        scenario_type: &str,
        map: &Arc<MapGraph>,
        extraction: &Extraction,
    ) -> Result<Self, DataError> {
        let start = event.time_us + micros(extraction.offset_s);
        let end = start.saturating_add(micros(extraction.duration_s));
        let rows = every_second(log.between(start, end)?.into_iter());
        let problem = |problem| scenario_error(log, event.token, problem);
        let (Some(first), Some(last)) = (rows.first(), rows.last()) else {
            return Err(problem(Problem::NoAgents));
        };
        let mut before = log.before(first.ego.time_us, extraction.history * STRIDE)?;
        // The latest comes first: keep every second one, counted from iteration 0.
        before = every_second(before.into_iter().skip(STRIDE - 1));
        before.reverse();
        let after = log.after(last.ego.time_us, extraction.expert_after * STRIDE)?;
        let after = every_second(after.into_iter().skip(STRIDE - 1));
        let mut tracks = Tracks::default();
        let mut frames = |rows: Vec<LogRow>| -> Result<Vec<LogFrame>, DataError> {
            let frame = |row| tracks.frame(log, row);
            rows.into_iter().map(frame).collect()
        };
        let (history, iterations) = (frames(before)?, frames(rows)?);
        let scenario = Self {
            token: event.token,
            log_name: log.name().into(),
            map_name: log.map_name().into(),
            scenario_type: scenario_type.into(),
            types: event.types.clone(),
            map: Arc::clone(map),
            history,
            iterations,
            ego_after: after.into_iter().map(|row| row.ego).collect(),
            roadblocks: log.roadblocks(event.token)?,
            goal: log.goal(event.token)?,
            tracks: tracks.tokens,
        };
        scenario.check().map_err(problem)?;
        Ok(scenario)
    }

    /// The expert's states from iteration 0 on, [`DT`] apart, past the last iteration as far as the
    /// log goes.
    pub fn expert(&self) -> impl Iterator<Item = EgoState> + '_ {
        let logged = self.iterations.iter().map(|frame| frame.ego);
        logged.chain(self.ego_after.iter().copied())
    }

    /// The recorded identity of an agent; `None` for the ego and for ids that are none.
    pub fn track(&self, agent: AgentId) -> Option<Token> {
        let index = usize::try_from(agent.0).ok()?.checked_sub(1)?;
        self.tracks.get(index).copied()
    }

    /// Checks the invariants that users rely on: finite poses and sizes, frames one time step
    /// apart.
    fn check(&self) -> Result<(), Problem> {
        let frames = || self.history.iter().chain(&self.iterations);
        for (step, frame) in frames().enumerate() {
            let ego = &frame.ego;
            let far = ego.rear_axle.position.abs().max_element() > MAX_COORDINATE;
            if !ego.is_finite() || far {
                return Err(unexpected(
                    "the ego's states to be numbers on Earth",
                    format!("{:?}", ego.rear_axle),
                    format!("frame {step}, row {}", frame.token),
                ));
            }
        }
        let times: Vec<i64> = frames().map(|frame| frame.ego.time_us).collect();
        for (step, pair) in times.windows(2).enumerate() {
            let found = (pair[1] - pair[0]) as f64 * 1e-6;
            if (found - DT).abs() > TIME_STEP_TOLERANCE * DT {
                return Err(Problem::TimeStep {
                    expected: DT,
                    found,
                    step: step + 1,
                });
            }
        }
        Ok(())
    }

    /// The same as a [`Scenario`]: the present is iteration 0, the ego a box like other agents.
    ///
    /// The route follows the stated roadblocks from lane to lane; where that is not possible it is
    /// read off the log if `options` allow. Elevations are 0: the map has none.
    ///
    /// # Errors
    /// [`Problem::Unexpected`] if none of the route's roadblocks is in the map,
    /// [`Problem::Scenario`] if an agent is unusable.
    pub fn to_scenario(&self, options: ReadOptions) -> Result<(Scenario, ReadReport), Problem> {
        let mut report = ReadReport::default();
        let frames = self.history.iter().chain(&self.iterations);
        let log = frames
            .map(|frame| plain_frame(frame, &mut report))
            .collect();
        let mut tags: Vec<ScenarioTag> = self.types.iter().filter_map(|t| t.parse().ok()).collect();
        report.drop("tag of no known type", self.types.len() - tags.len());
        tags.sort_unstable();
        let mut scenario = Scenario {
            id: self.token.to_string(),
            map: Arc::clone(&self.map),
            route: None,
            log,
            dt: DT,
            now: self.history.len(),
            ego: EGO,
            targets: Vec::new(),
            objects_of_interest: Vec::new(),
            tags,
        };
        scenario.validate()?;
        route::fill(&mut scenario, &self.roadblocks, options, &mut report)?;
        Ok((scenario, report))
    }
}

fn scenario_error(log: &Log, token: Token, problem: Problem) -> DataError {
    DataError::Scenario {
        id: token.to_string(),
        problem,
        place: RecordLocation {
            record: 0,
            offset: 0,
            path: log.path().into(),
        },
    }
}

fn micros(seconds: f64) -> i64 {
    (seconds * 1e6) as i64
}

fn every_second(rows: impl Iterator<Item = LogRow>) -> Vec<LogRow> {
    rows.step_by(STRIDE).collect()
}

/// Ids for tracks in the order in which they appear.
#[derive(Default)]
struct Tracks {
    ids: BTreeMap<Token, AgentId>,
    tokens: Vec<Token>,
}

impl Tracks {
    fn frame(&mut self, log: &Log, row: LogRow) -> Result<LogFrame, DataError> {
        let boxes = log.boxes(row.token)?;
        Ok(LogFrame {
            token: row.token,
            ego: row.ego,
            objects: boxes.iter().map(|b| self.agent(b)).collect(),
            lights: log.lights(row.token)?,
        })
    }

    fn agent(&mut self, b: &LogBox) -> Agent {
        let id = *self.ids.entry(b.track).or_insert_with(|| {
            self.tokens.push(b.track);
            AgentId(self.tokens.len() as i64)
        });
        let ([length, width, height], [vx, vy]) = (b.size, b.velocity);
        Agent {
            id,
            kind: b.kind,
            length,
            width,
            height,
            elevation: 0.0,
            state: AgentState {
                pose: b.pose,
                velocity: dvec2(vx, vy),
            },
        }
    }
}

fn plain_frame(frame: &LogFrame, report: &mut ReadReport) -> Frame {
    let car = VehicleParameters::PACIFICA;
    let ego = Agent {
        id: EGO,
        kind: AgentKind::Vehicle,
        length: car.length(),
        width: car.width,
        height: car.height,
        elevation: 0.0,
        state: frame.ego.agent_state(&car),
    };
    let mut agents = vec![ego];
    for agent in &frame.objects {
        let is_size = |extent: f64| extent > 0.0 && extent.is_finite();
        if !(agent.state.pose.is_finite() && is_size(agent.length) && is_size(agent.width)) {
            report.drop_damaged("box without a place or a size", || {
                format!("agent {} in row {}", agent.id, frame.token)
            });
            continue;
        }
        let mut agent = *agent;
        if !agent.state.velocity.is_finite() {
            report.infer("velocity that is not recorded: 0", 1);
            agent.state.velocity = dvec2(0.0, 0.0);
        }
        if !agent.height.is_finite() {
            agent.height = 0.0;
        }
        agents.push(agent);
    }
    Frame::new(agents, frame.lights.clone())
}
