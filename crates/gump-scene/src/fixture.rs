//! Scenes as text, for tests and examples in every crate.
//!
//! One statement per line; `#` starts a comment. Numbers are metres, seconds, radians.
//!
//! ```text
//! lane 1: 0,0 50,0 100,0 speed 15 width 3.5 next 2,3
//! edge: 0,-2 100,-2
//! line: 0,2 100,2
//! crosswalk: 40,-2 44,-2 44,2 40,2
//! driveway: 60,-2 64,-2 64,-10 60,-10
//! drivable: 0,-2 100,-2 100,2 0,2
//! light 1 red: 38,0
//! route 1,2
//! ego vehicle 0: 10,0 heading 0 velocity 8,0 size 4.8,2
//! agent pedestrian 7: 40,3 velocity 0,-1
//! history 1.0 future 8.0 dt 0.1
//! ```
//!
//! Every agent moves with constant velocity over history and future; without a `heading` it faces
//! its velocity. Defaults: history 1 s, future 8 s, dt 0.1 s, sizes by kind.

use std::sync::Arc;

use gump_geometry::{DVec2, Polygon, Polyline, Pose, dvec2, wrap_angle};

use crate::{
    Agent, AgentId, AgentKind, AgentState, Area, AreaKind, Frame, Lane, LaneId, LaneKind, Light,
    LightState, MapError, MapGraph, MapParts, RoadEdge, RoadEdgeKind, RoadLine, RoadLineKind,
    Route, Scenario, ScenarioError,
};

/// Why a text is not a scenario.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FixtureError {
    /// A statement cannot be read.
    #[error("line {line}: {reason} in \"{statement}\"")]
    Statement {
        /// Number of the line, from 1.
        line: usize,
        /// What is wrong with it.
        reason: String,
        /// The line without its comment.
        statement: String,
    },
    /// No agent is the ego.
    #[error("no ego")]
    NoEgo,
    /// The map is not valid.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The scenario is not valid.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
}

/// Reads a scenario from the text form described in the module.
///
/// # Errors
/// The line at fault, or why the scenario is not valid.
pub fn scenario(text: &str) -> Result<Scenario, FixtureError> {
    let mut draft = Draft::default();
    for (number, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or_default().trim();
        if !line.is_empty() {
            draft
                .statement(line)
                .map_err(|reason| FixtureError::Statement {
                    line: number + 1,
                    reason,
                    statement: line.to_owned(),
                })?;
        }
    }
    draft.build()
}

struct Draft {
    parts: MapParts,
    agents: Vec<Agent>,
    lights: Vec<Light>,
    ego: Option<AgentId>,
    route: Vec<LaneId>,
    history: f64,
    future: f64,
    dt: f64,
}

impl Default for Draft {
    fn default() -> Self {
        Self {
            parts: MapParts::default(),
            agents: Vec::new(),
            lights: Vec::new(),
            ego: None,
            route: Vec::new(),
            history: 1.0,
            future: 8.0,
            dt: 0.1,
        }
    }
}

impl Draft {
    fn statement(&mut self, line: &str) -> Result<(), String> {
        let (head, body) = line.split_once(':').unwrap_or((line, ""));
        let words: Vec<&str> = head.split_whitespace().collect();
        let feature =
            1_000_000 + (self.parts.road_edges.len() + self.parts.road_lines.len()) as i64;
        match words.as_slice() {
            ["lane", id] => self.lane(LaneId(number(id)? as i64), body)?,
            ["edge"] => {
                let line = polyline(&points(body)?)?;
                let elevation = vec![0.0; line.points().len()];
                let kind = RoadEdgeKind::Boundary;
                self.parts.road_edges.push(RoadEdge {
                    id: feature,
                    kind,
                    line,
                    elevation,
                });
            }
            ["line"] => {
                let line = polyline(&points(body)?)?;
                let elevation = vec![0.0; line.points().len()];
                let kind = RoadLineKind::BrokenSingleWhite;
                self.parts.road_lines.push(RoadLine {
                    id: feature,
                    kind,
                    line,
                    elevation,
                });
            }
            [area @ ("crosswalk" | "driveway")] => {
                let polygon = Polygon::new(points(body)?).ok_or("fewer than 3 points")?;
                let id = 2_000_000 + self.parts.areas.len() as i64;
                let kind = match *area {
                    "driveway" => AreaKind::Driveway,
                    _ => AreaKind::Crosswalk,
                };
                let area = Area::new(id, kind, polygon);
                self.parts.areas.push(area);
            }
            ["drivable"] => {
                self.parts
                    .drivable
                    .push(Polygon::new(points(body)?).ok_or("fewer than 3 points")?);
            }
            ["light", lane, state] => {
                let state = match *state {
                    "green" => LightState::Green,
                    "yellow" => LightState::Yellow,
                    "red" => LightState::Red,
                    "unknown" => LightState::Unknown,
                    other => return Err(format!("unknown light state {other}")),
                };
                let stop_point = points(body)?.first().copied();
                self.lights.push(Light {
                    lane: LaneId(number(lane)? as i64),
                    state,
                    stop_point,
                });
            }
            ["route", lanes] => self.route = ids(lanes)?,
            [role @ ("ego" | "agent"), kind, id] => self.agent(*role == "ego", kind, id, body)?,
            ["history", history, "future", future, "dt", dt] => {
                (self.history, self.future, self.dt) =
                    (number(history)?, number(future)?, number(dt)?);
            }
            _ => return Err("unknown statement".into()),
        }
        Ok(())
    }

    fn lane(&mut self, id: LaneId, body: &str) -> Result<(), String> {
        let centerline = polyline(&points(body)?)?;
        let elevation = vec![0.0; centerline.points().len()];
        let mut lane = Lane {
            kind: LaneKind::SurfaceStreet,
            width: option(body, "width")?.map_or(Ok(3.5), number)?,
            speed_limit: option(body, "speed")?.map(number).transpose()?,
            successors: option(body, "next")?.map_or(Ok(Vec::new()), ids)?,
            left_neighbors: option(body, "left")?.map_or(Ok(Vec::new()), ids)?,
            right_neighbors: option(body, "right")?.map_or(Ok(Vec::new()), ids)?,
            ..Lane::new(id, centerline, elevation)
        };
        lane.successors.dedup();
        self.parts.lanes.push(lane);
        Ok(())
    }

    fn agent(&mut self, is_ego: bool, kind: &str, id: &str, body: &str) -> Result<(), String> {
        let (kind, size) = match kind {
            "vehicle" => (AgentKind::Vehicle, dvec2(4.8, 2.0)),
            "pedestrian" => (AgentKind::Pedestrian, dvec2(0.8, 0.8)),
            "bicycle" => (AgentKind::Bicycle, dvec2(1.8, 0.7)),
            "cone" => (AgentKind::TrafficCone, dvec2(0.4, 0.4)),
            "other" => (AgentKind::Other, dvec2(0.5, 0.5)),
            unknown => return Err(format!("unknown kind {unknown}")),
        };
        let position = *points(body)?.first().ok_or("no position")?;
        let velocity = option(body, "velocity")?.map_or(Ok(DVec2::ZERO), point)?;
        let facing = if velocity == DVec2::ZERO {
            0.0
        } else {
            velocity.to_angle()
        };
        let heading = option(body, "heading")?.map_or(Ok(facing), number)?;
        let size = option(body, "size")?.map_or(Ok(size), point)?;
        let id = AgentId(number(id)? as i64);
        if is_ego {
            self.ego = Some(id);
        }
        self.agents.push(Agent {
            id,
            kind,
            length: size.x,
            width: size.y,
            height: 1.6,
            elevation: 0.0,
            state: AgentState {
                pose: Pose {
                    position,
                    heading: wrap_angle(heading),
                },
                velocity,
            },
        });
        Ok(())
    }

    fn build(mut self) -> Result<Scenario, FixtureError> {
        let links: Vec<_> = self
            .parts
            .lanes
            .iter()
            .flat_map(|lane| lane.successors.iter().map(|&next| (lane.id, next)))
            .collect();
        for (from, to) in links {
            if let Some(lane) = self.parts.lanes.iter_mut().find(|lane| lane.id == to) {
                lane.predecessors.push(from);
            }
        }
        let now = (self.history / self.dt).round() as usize;
        let n_frames = now + (self.future / self.dt).round() as usize + 1;
        let log = (0..n_frames)
            .map(|i| self.frame((i as f64 - now as f64) * self.dt))
            .collect();
        let map = Arc::new(MapGraph::new(self.parts)?);
        let path: Vec<DVec2> = self
            .route
            .iter()
            .filter_map(|&id| map.lane(id))
            .flat_map(|lane| lane.centerline.points().iter().copied())
            .collect();
        let route = Polyline::new(path).map(|path| {
            Arc::new(Route {
                lanes: self.route,
                roadblocks: Vec::new(),
                path,
            })
        });
        let scenario = Scenario {
            id: "fixture".into(),
            map,
            route,
            log,
            dt: self.dt,
            now,
            ego: self.ego.ok_or(FixtureError::NoEgo)?,
            targets: self.agents.iter().map(|agent| agent.id).collect(),
            objects_of_interest: Vec::new(),
            tags: Vec::new(),
        };
        scenario.validate()?;
        Ok(scenario)
    }

    /// The frame `time` seconds from now.
    fn frame(&self, time: f64) -> Frame {
        let moved = self.agents.iter().map(|agent| {
            let mut state = agent.state;
            state.pose.position += state.velocity * time;
            agent.with_state(state)
        });
        Frame::new(moved.collect(), self.lights.clone())
    }
}

/// The points at the start of `body`, up to the first word.
fn points(body: &str) -> Result<Vec<DVec2>, String> {
    body.split_whitespace()
        .take_while(|word| !word.starts_with(|c: char| c.is_ascii_alphabetic()))
        .map(point)
        .collect()
}

/// The word after `key`, if the key is there.
fn option<'a>(body: &'a str, key: &str) -> Result<Option<&'a str>, String> {
    let mut words = body.split_whitespace();
    match words.find(|word| *word == key) {
        None => Ok(None),
        Some(_) => words
            .next()
            .map(Some)
            .ok_or_else(|| format!("nothing after {key}")),
    }
}

fn point(word: &str) -> Result<DVec2, String> {
    let (x, y) = word
        .split_once(',')
        .ok_or_else(|| format!("expected x,y, found {word}"))?;
    Ok(dvec2(number(x)?, number(y)?))
}

fn ids(word: &str) -> Result<Vec<LaneId>, String> {
    word.split(',')
        .map(|id| number(id).map(|id| LaneId(id as i64)))
        .collect()
}

fn number(word: &str) -> Result<f64, String> {
    word.parse()
        .map_err(|_| format!("expected a number, found {word}"))
}

fn polyline(points: &[DVec2]) -> Result<Polyline, String> {
    Polyline::new(points.to_vec()).ok_or_else(|| "no points".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_example_of_the_module_reads() {
        let text = "
            lane 1: 0,0 50,0 100,0 speed 15 width 3.5 next 2,3
            lane 2: 100,0 150,0
            edge: 0,-2 100,-2
            crosswalk: 40,-2 44,-2 44,2 40,2
            drivable: 0,-2 100,-2 100,2 0,2
            light 1 red: 38,0
            route 1,2
            ego vehicle 0: 10,0 velocity 8,0
            agent pedestrian 7: 40,3 velocity 0,-1 # crosses";
        let scenario = scenario(text).unwrap();
        assert_eq!(scenario.log.len(), 91);
        assert_eq!(scenario.now, 10);
        let scene = scenario.present();
        assert_eq!(scene.history.len(), 11);
        assert_eq!(
            scene.history[0]
                .agent(AgentId(0))
                .unwrap()
                .state
                .pose
                .position
                .x,
            2.0
        );
        assert_eq!(scene.strided_history(5, 3).len(), 3);
        // The link to lane 3, which is not in the map, is gone; the one back from lane 2 is there.
        assert_eq!(scene.map.lane(LaneId(1)).unwrap().successors, [LaneId(2)]);
        assert_eq!(scene.map.lane(LaneId(2)).unwrap().predecessors, [LaneId(1)]);
        assert_eq!(scene.route.unwrap().path.length(), 150.0);
        assert!(scene.map.is_drivable(dvec2(5.0, 0.0)) && !scene.map.is_drivable(dvec2(5.0, 9.0)));
        assert_eq!(scene.map.elevation_at(dvec2(0.0, 0.0)), Some(0.0));
        let nearest = scene.map.nearest_road_edges(dvec2(50.0, 1.0)).next();
        assert_eq!(nearest, Some((0, 0, 3.0)));
    }

    #[test]
    fn errors_name_the_line() {
        let error = scenario("lane 1: 0,0\nfoo # bar").unwrap_err();
        assert_eq!(
            error,
            FixtureError::Statement {
                line: 2,
                reason: "unknown statement".into(),
                statement: "foo".into(),
            }
        );
        assert_eq!(error.to_string(), "line 2: unknown statement in \"foo\"");
        let error = scenario("lane 1: 0,0 9,9").unwrap_err();
        assert_eq!(error, FixtureError::NoEgo);
        assert_eq!(error.to_string(), "no ego");
    }
}
