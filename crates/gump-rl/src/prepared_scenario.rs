//! Scenarios prepared for driving: the values that episodes need at every step, computed once.

use std::sync::{Arc, OnceLock};

use gump_geometry::{DVec2, LineIndex, Polyline};
use gump_metrics::Border;
use gump_scene::{AgentId, AgentState, Frame, LaneId, Light, LightState, Scenario};

use crate::RlError;
use crate::observation::Texture;
use crate::route::extended;

/// Distance from the ego's start within which the road border is prepared, metres to each side: 8 s
/// at 30 m/s. Beyond it queries give the same results more slowly.
const HALF: f64 = 256.0;

/// A scenario to drive in, with steps of a fixed length.
#[derive(Debug)]
pub struct PreparedScenario {
    scenario: Scenario,
    dt: f64,
    /// Frames of the log per step.
    stride: usize,
    route: Option<(Polyline, LineIndex)>,
    lights: Vec<RouteLight>,
    pub(crate) border: Border,
    /// The other agents of the present; computed on first use.
    by_distance: OnceLock<Vec<AgentId>>,
    /// The map in bird's-eye view, for rasters; rendered on first use.
    pub(crate) texture: OnceLock<Texture>,
}

/// A signalled lane of the route.
#[derive(Clone, Copy, Debug)]
struct RouteLight {
    lane: LaneId,
    /// Stop position for its light, metres along the route.
    stop_at: f64,
}

impl PreparedScenario {
    /// Prepares a scenario for steps of `dt` seconds.
    ///
    /// Its route is extended along the straightest lanes to 240 m beyond the end of the ego's log,
    /// as far as the map goes, so that the route does not tell how far the recorded driver got.
    ///
    /// # Errors
    /// [`RlError::Scenario`] if it is not valid, [`RlError::TimeStep`] if `dt` is no multiple of
    /// its time step.
    pub fn new(mut scenario: Scenario, dt: f64) -> Result<Self, RlError> {
        scenario.validate().map_err(|source| RlError::Scenario {
            id: scenario.id.clone(),
            source,
        })?;
        let stride = (dt / scenario.dt).round();
        if !(stride >= 1.0 && (dt / scenario.dt - stride).abs() < 1e-6) {
            return Err(RlError::TimeStep {
                step: dt,
                frames: scenario.dt,
            });
        }
        scenario.route = extended(&scenario);
        let ego = *scenario.present().ego_now();
        let route = scenario
            .route
            .as_ref()
            .map(|route| (route.path.clone(), LineIndex::new(&route.path)));
        Ok(Self {
            dt,
            stride: stride as usize,
            lights: route.as_ref().map_or_else(Vec::new, |(path, index)| {
                route_lights(&scenario, path, index)
            }),
            border: Border::new(
                &scenario.map,
                ego.state.pose.position,
                ego.elevation - ego.height / 2.0,
                HALF,
            ),
            route,
            by_distance: OnceLock::new(),
            texture: OnceLock::new(),
            scenario,
        })
    }

    /// Prepares many scenarios, to be shared by any number of environments.
    ///
    /// # Errors
    /// As [`PreparedScenario::new`], for the first that cannot be prepared, and [`RlError::NoScenario`].
    pub fn prepare(
        scenarios: impl IntoIterator<Item = Scenario>,
        dt: f64,
    ) -> Result<Arc<[Self]>, RlError> {
        let prepared: Result<Vec<Self>, _> = scenarios
            .into_iter()
            .map(|scenario| Self::new(scenario, dt))
            .collect();
        let prepared = prepared?;
        if prepared.is_empty() {
            return Err(RlError::NoScenario);
        }
        Ok(prepared.into())
    }

    /// The scenario, with its route extended as [`PreparedScenario::new`] says.
    pub fn scenario(&self) -> &Scenario {
        &self.scenario
    }

    /// Seconds per step.
    pub fn dt(&self) -> f64 {
        self.dt
    }

    /// Steps until the log ends.
    pub fn logged_steps(&self) -> usize {
        self.scenario.future().len() / self.stride
    }

    /// The log after `step` steps; its last frame past its end.
    pub fn logged(&self, step: usize) -> &Frame {
        let last = self.scenario.log.len() - 1;
        &self.scenario.log[(self.scenario.now + step * self.stride).min(last)]
    }

    /// The recorded lights `elapsed` seconds into the step after `step` steps; the last ones past
    /// the end of the log.
    pub(crate) fn lights(&self, step: usize, elapsed: f64) -> &[Light] {
        let frames = step * self.stride + (elapsed / self.scenario.dt).round() as usize;
        let last = self.scenario.log.len() - 1;
        self.scenario.log[(self.scenario.now + frames).min(last)].lights()
    }

    /// The log one step before [`PreparedScenario::logged`], if it goes back that far.
    pub(crate) fn logged_before(&self, step: usize) -> Option<&Frame> {
        let index = (self.scenario.now + step * self.stride).checked_sub(self.stride)?;
        self.scenario.log.get(index)
    }

    /// The ego's logged motion after `step` steps; `None` where it is absent and past the end.
    pub fn logged_ego(&self, step: usize) -> Option<AgentState> {
        let frame = self
            .scenario
            .log
            .get(self.scenario.now + step * self.stride)?;
        Some(frame.agent(self.scenario.ego)?.state)
    }

    /// The other agents of the present, by the smallest distance to the ego that the log has from
    /// then on.
    pub(crate) fn by_distance(&self) -> &[AgentId] {
        self.by_distance.get_or_init(|| {
            let ego = self.scenario.ego;
            let smallest = |id: AgentId| {
                let frames = (0..=self.logged_steps()).map(|step| self.logged(step));
                let distances = frames.filter_map(|frame| {
                    let [own, other] = [ego, id].map(|id| frame.agent(id));
                    Some(
                        own?.state
                            .pose
                            .position
                            .distance(other?.state.pose.position),
                    )
                });
                distances.fold(f64::INFINITY, f64::min)
            };
            let others = self
                .logged(0)
                .agents()
                .iter()
                .filter(|agent| agent.id != ego);
            let mut by: Vec<_> = others.map(|agent| (smallest(agent.id), agent.id)).collect();
            by.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            by.into_iter().map(|(_, id)| id).collect()
        })
    }

    /// The ego `steps` steps before the present, if the log goes back that far.
    pub(crate) fn ego_before(&self, steps: usize) -> Option<AgentState> {
        let index = self.scenario.now.checked_sub(steps * self.stride)?;
        Some(self.scenario.log[index].agent(self.scenario.ego)?.state)
    }

    /// The route.
    pub fn route(&self) -> Option<&Polyline> {
        self.route.as_ref().map(|(path, _)| path)
    }

    /// Metres along the route of the point nearest to `position`; 0 without a route.
    pub(crate) fn along_route(&self, position: DVec2) -> f64 {
        self.route.as_ref().map_or(0.0, |(path, index)| {
            index.project(path, position).arc_length
        })
    }

    /// The next light of the route after `along` metres: distance to its stop point, and its colour
    /// in `frame`. Lights that the frame does not contain are skipped.
    pub(crate) fn light_ahead(&self, along: f64, frame: &Frame) -> Option<(f64, LightState)> {
        self.lights.iter().find_map(|light| {
            let distance = light.stop_at - along;
            let now = frame.light(light.lane)?;
            (distance >= 0.0).then_some((distance, now.state))
        })
    }
}

/// The signalled lanes of the route by where vehicles stop for them.
fn route_lights(scenario: &Scenario, path: &Polyline, index: &LineIndex) -> Vec<RouteLight> {
    let Some(route) = &scenario.route else {
        return Vec::new();
    };
    let seen = scenario.log.iter().flat_map(Frame::lights);
    let mut lights: Vec<RouteLight> = Vec::new();
    for light in seen {
        let known = lights.iter().any(|known| known.lane == light.lane);
        if known || !route.lanes.contains(&light.lane) {
            continue;
        }
        let Some(lane) = scenario.map.lane(light.lane) else {
            continue;
        };
        // As the red-light metric has it: at the entry of an intersection, at the end elsewhere.
        let points = lane.centerline.points();
        let edge = if lane.in_intersection {
            points[0]
        } else {
            points[points.len() - 1]
        };
        let stop = light.stop_point.unwrap_or(edge);
        lights.push(RouteLight {
            lane: light.lane,
            stop_at: index.project(path, stop).arc_length,
        });
    }
    lights.sort_by(|a, b| a.stop_at.total_cmp(&b.stop_at).then(a.lane.cmp(&b.lane)));
    lights
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::fixture;

    const STREET: &str = "lane 1: 0,0 50,0 next 2\nlane 2: 50,0 100,0\nroute 1,2\n
        light 1 red: 38,0\nlight 2 green:\nego vehicle 0: 10,0 velocity 10,0\n";

    fn prepared(text: &str, dt: f64) -> Result<PreparedScenario, RlError> {
        PreparedScenario::new(fixture::scenario(text).unwrap(), dt)
    }

    #[test]
    fn the_log_is_read_in_steps() {
        let prepared = prepared(STREET, 0.5).unwrap();
        assert_eq!(prepared.logged_steps(), 16);
        let x = |step| prepared.logged_ego(step).unwrap().pose.position.x;
        assert!((x(0) - 10.0).abs() < 1e-9 && (x(3) - 25.0).abs() < 1e-9);
        assert_eq!(prepared.logged_ego(17), None);
        assert_eq!(prepared.logged(99), prepared.logged(16));
        let before = |n| prepared.ego_before(n).map(|s| s.pose.position.x.round());
        assert_eq!(
            (before(1), before(2), before(3)),
            (Some(5.0), Some(0.0), None)
        );
    }

    #[test]
    fn the_next_light_of_the_route_is_the_one_that_counts() {
        let prepared = prepared(STREET, 0.5).unwrap();
        let ahead = |along| prepared.light_ahead(along, prepared.logged(0));
        assert_eq!(ahead(10.0), Some((28.0, LightState::Red)));
        assert_eq!(ahead(40.0), Some((60.0, LightState::Green)));
        assert_eq!(ahead(101.0), None);
    }

    #[test]
    fn the_light_that_the_recorded_driver_waits_for_is_on_the_route() {
        let text = "lane 1: 0,0 50,0 next 2\nlane 2: 50,0 80,0 next 3\nlane 3: 80,0 400,0\n
            route 1\nlight 2 red: 49,0\nego vehicle 0: 44,0 heading 0\n";
        let prepared = prepared(text, 0.5).unwrap();
        let ahead = prepared.light_ahead(44.0, prepared.logged(0));
        assert_eq!(ahead, Some((5.0, LightState::Red)));
        assert_eq!(prepared.route().map(Polyline::length), Some(400.0));
    }

    #[test]
    fn scenarios_that_cannot_be_driven_are_refused() {
        let error = prepared(STREET, 0.25).unwrap_err();
        assert!(matches!(error, RlError::TimeStep { step: 0.25, .. }));
        let mut broken = fixture::scenario(STREET).unwrap();
        broken.now = 1000;
        let error = PreparedScenario::new(broken, 0.5).unwrap_err();
        assert!(matches!(error, RlError::Scenario { .. }));
        let error = PreparedScenario::prepare([], 0.5).unwrap_err();
        assert!(matches!(error, RlError::NoScenario));
    }
}
