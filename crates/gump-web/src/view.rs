//! Data for the page to draw: the road as JSON, all agents as numbers.
//!
//! Places are metres from where the ego started, x to the east and y to the north, so that 32 bits
//! are enough for them.

use gump_geometry::{DVec2, Polyline};
use gump_scene::{AgentKind, AreaKind, LaneKind, Light, LightState, RoadLineKind};
use serde::Serialize;

use crate::branches::Branches;
use crate::game::{DT, EventKind, FAN_STEPS, Game};
use crate::{GameError, tape};

/// Numbers before the agents of a frame: the frame, the ego's speed (negative backwards), its row,
/// how many agents and how many lights follow.
pub const HEAD: usize = 5;
/// Numbers of an agent: x, y, heading, length, width, kind, speed, id.
pub const AGENT: usize = 8;
/// Numbers of a path of a fan: kind of agent, then x and y from now on.
pub const WAY: usize = 3 + 2 * FAN_STEPS;

/// The SHA-256 of a file in hexadecimal digits, as in the page's manifest.
pub fn checksum(bytes: &[u8]) -> String {
    use sha2::{Digest as _, Sha256};
    let digest = Sha256::digest(bytes);
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The road, and the length of the recording.
#[derive(Serialize)]
struct Road {
    id: String,
    agents: usize,
    recorded_s: f64,
    origin: [f64; 2],
    drivable: Vec<Vec<f32>>,
    lanes: Vec<LaneShape>,
    lines: Vec<Shape>,
    edges: Vec<Vec<f32>>,
    areas: Vec<Shape>,
    stop_signs: Vec<[f32; 2]>,
    route: Vec<f32>,
    /// Position of each light of a frame, in the order of its states: x, y, heading, lane width.
    lights: Vec<[f32; 4]>,
}

#[derive(Serialize)]
struct LaneShape {
    points: Vec<f32>,
    width: f32,
    kind: &'static str,
}

#[derive(Serialize)]
struct Shape {
    kind: &'static str,
    points: Vec<f32>,
}

/// Summary of a drive for display.
#[derive(Serialize)]
struct DriveSummary<'a> {
    total: f64,
    seconds: f64,
    compared_seconds: f64,
    parts: Vec<(&'a str, Option<f64>)>,
    realism: Option<f64>,
    realism_missing: Option<String>,
    events: Vec<EventSummary>,
    metres: f64,
    collisions: usize,
    off_roads: usize,
    red_lights: usize,
}

#[derive(Serialize)]
struct EventSummary {
    second: f64,
    what: &'static str,
}

impl Game {
    /// The map, the route and the positions of the lights, as JSON.
    pub fn road(&self) -> String {
        let scenario = self.scenario();
        let map = &scenario.map;
        let origin = self.origin();
        let flat = |points: &[DVec2]| flat(origin, points);
        let route = scenario.route.as_ref();
        let lights = scenario.present().now().lights().iter();
        let road = Road {
            id: scenario.id.clone(),
            agents: scenario.present().now().agents().len(),
            recorded_s: (scenario.future().len() as f64) * DT,
            origin: origin.to_array(),
            drivable: map.drivable().iter().map(|p| flat(p.ring())).collect(),
            lanes: map
                .lanes()
                .iter()
                .map(|lane| LaneShape {
                    points: flat(lane.centerline.points()),
                    width: lane.width as f32,
                    kind: match lane.kind {
                        _ if lane.in_intersection => "turn",
                        LaneKind::BikeLane => "bike",
                        _ => "lane",
                    },
                })
                .collect(),
            lines: map
                .road_lines()
                .iter()
                .map(|line| Shape {
                    kind: line_kind(line.kind),
                    points: flat(line.line.points()),
                })
                .collect(),
            edges: map
                .road_edges()
                .iter()
                .map(|e| flat(e.line.points()))
                .collect(),
            areas: map
                .areas()
                .iter()
                .filter_map(|area| {
                    Some(Shape {
                        kind: match area.kind {
                            AreaKind::Crosswalk => "crosswalk",
                            AreaKind::SpeedBump => "bump",
                            _ => return None,
                        },
                        points: flat(area.polygon.ring()),
                    })
                })
                .collect(),
            stop_signs: map
                .stop_signs()
                .iter()
                .map(|sign| {
                    let at = sign.position.truncate() - origin;
                    [at.x as f32, at.y as f32]
                })
                .collect(),
            route: route.map_or(Vec::new(), |route| flat(route.path.points())),
            lights: lights.map(|light| self.light(origin, light)).collect(),
        };
        serde_json::to_string(&road).unwrap_or_default()
    }

    fn light(&self, origin: DVec2, light: &Light) -> [f32; 4] {
        let Some(lane) = self.scenario().map.lane(light.lane) else {
            let at = light.stop_point.map_or(DVec2::ZERO, |point| point - origin);
            return [at.x as f32, at.y as f32, 0.0, 0.0];
        };
        let line: &Polyline = &lane.centerline;
        let pose = line.pose_at(match light.stop_point {
            Some(point) => line.project(point).arc_length,
            None if lane.in_intersection => 0.0,
            None => line.length(),
        });
        let at = pose.position - origin;
        [at.x, at.y, pose.heading, lane.width].map(|v| v as f32)
    }

    /// All agents so many frames after the start: [`HEAD`] numbers, then [`AGENT`] for each agent,
    /// then the colour of each light (0 unknown, 1 red, 2 yellow, 3 green).
    ///
    /// # Errors
    /// [`GameError::NotDriven`] for a moment that has not been driven.
    pub fn numbers(&self, frame: usize) -> Result<Vec<f32>, GameError> {
        let scene = self.at(frame)?;
        let origin = self.origin();
        let agents = scene.now().agents();
        let row = agents.iter().position(|agent| agent.id == scene.ego);
        let ego = scene.ego_now().state;
        let speed = ego.velocity.dot(ego.pose.direction());
        let lights = scene.now().lights();
        let mut numbers = vec![
            frame as f32,
            speed as f32,
            row.map_or(-1.0, |row| row as f32),
            agents.len() as f32,
            lights.len() as f32,
        ];
        for agent in agents {
            let at = agent.state.pose.position - origin;
            let of = [
                at.x,
                at.y,
                agent.state.pose.heading,
                agent.length,
                agent.width,
                f64::from(kind(agent.kind)),
                agent.state.speed(),
                agent.id.0 as f64,
            ];
            numbers.extend(of.map(|v| v as f32));
        }
        numbers.extend(lights.iter().map(|light| match light.state {
            LightState::Unknown => 0.0,
            LightState::Red => 1.0,
            LightState::Yellow => 2.0,
            LightState::Green => 3.0,
        }));
        Ok(numbers)
    }

    /// Possible next motions of agents, [`WAY`] numbers for each.
    pub fn fan_numbers(&self, draws: std::ops::Range<u64>) -> Vec<f32> {
        let origin = self.origin();
        let now = self.scene();
        let mut numbers = Vec::new();
        for fan in self.fans(draws) {
            let Some(agent) = now.now().agent(fan.agent) else {
                continue;
            };
            for way in &fan.ways {
                numbers.push(f32::from(kind(agent.kind)));
                for [x, y] in std::iter::once(&fan.from).chain(way) {
                    numbers.extend([(x - origin.x) as f32, (y - origin.y) as f32]);
                }
            }
        }
        numbers
    }

    /// Path of the ego so far, x and y of each frame.
    pub fn trail(&self) -> Vec<f32> {
        let origin = self.origin();
        let first = self.scenario().now;
        let frames = self.scene().history[first..].iter();
        let ego = frames.filter_map(|frame| frame.agent(self.scenario().ego));
        ego.flat_map(|agent| {
            let at = agent.state.pose.position - origin;
            [at.x as f32, at.y as f32]
        })
        .collect()
    }

    /// Paths of all agents in one of the eight futures: the number of agents and of moments, then
    /// for each agent its kind, length and width, and x, y and heading of each moment. The ego
    /// comes first.
    pub fn branch_numbers(&self, k: usize) -> Vec<f32> {
        let branch = self.branches().and_then(|branches| branches.all().get(k));
        let Some(branch) = branch else {
            return Vec::new();
        };
        let (origin, ego) = (self.origin(), self.scenario().ego);
        let mut agents: Vec<_> = branch.frames[0].agents().iter().collect();
        agents.sort_by_key(|agent| agent.id != ego);
        let mut numbers = vec![agents.len() as f32, branch.frames.len() as f32];
        for agent in agents {
            numbers.push(f32::from(kind(agent.kind)));
            numbers.extend([agent.length as f32, agent.width as f32]);
            for frame in &branch.frames {
                let pose = frame.agent(agent.id).unwrap_or(agent).state.pose;
                let at = pose.position - origin;
                numbers.extend([at.x as f32, at.y as f32, pose.heading as f32]);
            }
        }
        numbers
    }

    /// Comparison of the eight futures, as JSON: metres, seconds to the first overlap and to
    /// leaving the road.
    pub fn branch_table(&self) -> String {
        #[derive(Serialize)]
        struct Row {
            metres: f64,
            collided_s: Option<f64>,
            off_road_s: Option<f64>,
        }
        let seconds = |n: usize| n as f64 * 0.5;
        let all = self.branches().map_or(&[][..], Branches::all);
        let rows = all.iter().map(|branch| Row {
            metres: branch.metres,
            collided_s: branch.collided.map(seconds),
            off_road_s: branch.off_road.map(seconds),
        });
        serde_json::to_string(&rows.collect::<Vec<_>>()).unwrap_or_default()
    }

    /// Summary of the drive so far for display, as JSON.
    ///
    /// # Errors
    /// As [`Game::score`].
    pub fn summary(&self) -> Result<String, GameError> {
        let score = self.score()?;
        let realism = self.realism();
        let trail = self.trail();
        let points = trail.as_chunks::<2>().0;
        let metres = points.windows(2).map(|pair| {
            let [[x0, y0], [x1, y1]] = [pair[0], pair[1]].map(|p| p.map(f64::from));
            (x1 - x0).hypot(y1 - y0)
        });
        let count =
            |is: fn(&EventKind) -> bool| self.events().iter().filter(|e| is(&e.kind)).count();
        let summary = DriveSummary {
            total: score.total,
            seconds: score.seconds,
            compared_seconds: score.compared_seconds,
            parts: score.parts.iter().map(|(n, v)| (n.as_str(), *v)).collect(),
            realism_missing: realism.as_ref().err().map(ToString::to_string),
            realism: realism.ok().filter(|value| value.is_finite()),
            events: self.events().iter().map(event_summary).collect(),
            metres: metres.sum(),
            collisions: count(|kind| matches!(kind, EventKind::Collision(_))),
            off_roads: count(|kind| *kind == EventKind::OffRoad),
            red_lights: count(|kind| *kind == EventKind::RedLight),
        };
        Ok(serde_json::to_string(&summary).unwrap_or_default())
    }

    /// Events of the ego so far, as JSON.
    pub fn events_json(&self) -> String {
        let events: Vec<EventSummary> = self.events().iter().map(event_summary).collect();
        serde_json::to_string(&events).unwrap_or_default()
    }

    /// The inputs of the drive as a code for a link.
    pub fn code(&self) -> String {
        tape::encode(self.inputs())
    }

    /// Hash that two drives share if all agents were at the same places at all times, to the bit
    /// (FNV-1a, 64 bits, as 16 hexadecimal digits).
    pub fn fingerprint(&self) -> String {
        let mut hash = 0xcbf2_9ce4_8422_2325_u64;
        for frame in self.scene().history {
            for agent in frame.agents() {
                let pose = agent.state.pose;
                let numbers = [pose.position.x, pose.position.y, pose.heading];
                for byte in numbers.iter().flat_map(|number| number.to_le_bytes()) {
                    hash = (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
                }
            }
        }
        format!("{hash:016x}")
    }

    /// Start position of the ego, world frame, metres.
    pub fn origin(&self) -> DVec2 {
        self.scenario().present().ego_now().state.pose.position
    }
}

fn event_summary(event: &crate::game::Event) -> EventSummary {
    EventSummary {
        second: event.frame as f64 * DT,
        what: match event.kind {
            EventKind::Collision(_) => "collision",
            EventKind::OffRoad => "off the road",
            EventKind::RedLight => "red light",
        },
    }
}

fn flat(origin: DVec2, points: &[DVec2]) -> Vec<f32> {
    let near = points.iter().flat_map(|&point| (point - origin).to_array());
    // Centimetres are finer than a pixel.
    near.map(|v| ((v * 100.0).round() / 100.0) as f32).collect()
}

fn kind(kind: AgentKind) -> u8 {
    match kind {
        AgentKind::Vehicle => 0,
        AgentKind::Pedestrian => 1,
        AgentKind::Bicycle => 2,
        _ => 3,
    }
}

fn line_kind(kind: RoadLineKind) -> &'static str {
    use RoadLineKind as K;
    match kind {
        K::BrokenSingleWhite => "broken white",
        K::SolidSingleWhite | K::SolidDoubleWhite => "white",
        K::BrokenSingleYellow | K::BrokenDoubleYellow => "broken yellow",
        K::SolidSingleYellow | K::SolidDoubleYellow | K::PassingDoubleYellow => "yellow",
        _ => "plain",
    }
}
