//! Measurements of one prediction against the recording: distances, matches, overlaps.
//!
//! A measurement at an instant at which the agent was not recorded is `None`.

use gump_geometry::{DVec2, OrientedBox, Pose};
use gump_scene::{Agent, AgentId, AgentKind, Frame, PredictedMode, Prediction, Scenario};

use super::config::{Horizon, MotionConfig};
use super::error::MotionProblem;
use super::evaluate::ModeScore;
use super::shape::{Shape, shape};

/// A prediction and the recording it is measured against; both fit, see `check`.
pub(crate) struct Measured<'a> {
    pub(crate) scenario: &'a Scenario,
    pub(crate) prediction: &'a Prediction,
    pub(crate) config: &'a MotionConfig,
    /// Recorded frames between positions of a path.
    pub(crate) stride: usize,
}

impl<'a> Measured<'a> {
    /// The modes that count.
    fn counted(&self) -> &'a [PredictedMode] {
        let modes = &self.prediction.modes;
        &modes[..modes.len().min(self.config.max_modes)]
    }

    /// The least average displacement of any mode up to a horizon, metres.
    pub(crate) fn min_ade(&self, horizon: &Horizon) -> Option<f64> {
        self.least(|agent, path| {
            let errors = (0..=horizon.step).filter_map(|step| self.distance(agent, path, step));
            let (mut sum, mut n) = (0.0, 0);
            for error in errors {
                sum += error;
                n += 1;
            }
            (n > 0).then(|| sum / f64::from(n))
        })
    }

    /// The least displacement of any mode at a horizon, metres.
    pub(crate) fn min_fde(&self, horizon: &Horizon) -> Option<f64> {
        self.least(|agent, path| self.distance(agent, path, horizon.step))
    }

    /// Every mode that counts, and whether it matches the log at a horizon.
    pub(crate) fn modes(&self, horizon: &Horizon) -> Vec<ModeScore> {
        let of_mode = |mode: &PredictedMode| {
            let paths = self.paths(mode);
            let matches = paths.map(|(agent, path)| self.is_match(agent, path, horizon));
            let all: Option<Vec<bool>> = matches.collect();
            ModeScore {
                confidence: mode.confidence,
                matches: all.map(|all| all.into_iter().all(|is_match| is_match)),
            }
        };
        self.counted().iter().map(of_mode).collect()
    }

    /// The first step at which the most confident mode overlaps the recorded box of another agent
    /// that is present now.
    ///
    /// Agents predicted together are obstacles to each other at their recorded, not their predicted
    /// positions. Where the agent itself was not recorded it has no size, so it overlaps nothing.
    pub(crate) fn first_overlap(&self) -> Option<usize> {
        let mode = self.most_confident()?;
        let obstacles = self.scenario.present().now().agents();
        (0..self.config.n_steps).find(|&step| {
            let frame = self.frame(step);
            self.paths(mode).any(|(agent, path)| {
                let Some(logged) = frame.agent(agent) else {
                    return false;
                };
                let own = OrientedBox {
                    pose: Pose {
                        position: path[step],
                        heading: heading(path, step),
                    },
                    ..logged.oriented_box()
                };
                let others = obstacles.iter().filter(|other| other.id != agent);
                others
                    .filter_map(|other| frame.agent(other.id))
                    .any(|other| own.overlaps(&other.oriented_box()))
            })
        })
    }

    /// The kind of agent it counts for: the rarest among those predicted together.
    ///
    /// Error: an agent that is in no frame.
    pub(crate) fn kind(&self) -> Result<AgentKind, MotionProblem> {
        let mut rarest = AgentKind::Other;
        for &agent in &self.prediction.agents {
            let recorded = self
                .scenario
                .log
                .iter()
                .find_map(|frame| frame.agent(agent));
            let kind = recorded.ok_or(MotionProblem::NeverPresent(agent))?.kind;
            if rarity(kind) > rarity(rarest) {
                rarest = kind;
            }
        }
        Ok(rarest)
    }

    /// The shape it counts for; `None` if no agent has one.
    pub(crate) fn shape(&self) -> Option<Shape> {
        let agents = self.prediction.agents.iter();
        let shapes = agents.filter_map(|&agent| shape(self.scenario, agent, self.config.shapes));
        shapes.max().map(Shape::counted_as)
    }

    /// The smallest value over modes of the mean over agents; modes without a value for some
    /// agent do not count.
    fn least(&self, one: impl Fn(AgentId, &[DVec2]) -> Option<f64>) -> Option<f64> {
        let n = self.prediction.agents.len() as f64;
        let of_mode = |mode| {
            let sum: Option<f64> = self.paths(mode).map(|(a, path)| one(a, path)).sum();
            Some(sum? / n)
        };
        self.counted()
            .iter()
            .filter_map(of_mode)
            .min_by(f64::total_cmp)
    }

    fn is_match(&self, agent: AgentId, path: &[DVec2], horizon: &Horizon) -> Option<bool> {
        let logged = self.recorded(agent, horizon.step)?.state.pose;
        let error = DVec2::from_angle(-logged.heading).rotate(path[horizon.step] - logged.position);
        // An agent that is absent now counts as standing.
        let now = self.scenario.present().now().agent(agent);
        let speed = now.map_or(0.0, |agent| agent.state.speed());
        let error = error / self.config.speed_scale.at(speed);
        Some(error.x.abs() <= horizon.longitudinal && error.y.abs() <= horizon.lateral)
    }

    /// The most confident of the modes that count, the first of equals.
    ///
    /// Confidences are divided by their sum over all modes, as in the challenge, which reverses the
    /// order where the sum is negative.
    fn most_confident(&self) -> Option<&'a PredictedMode> {
        let sum: f64 = self.prediction.modes.iter().map(|m| m.confidence).sum();
        let value = |mode: &PredictedMode| {
            if sum == 0.0 {
                0.0
            } else {
                mode.confidence / sum
            }
        };
        let mut best: Option<&PredictedMode> = None;
        for mode in self.counted() {
            if best.is_none_or(|best| value(mode) > value(best)) {
                best = Some(mode);
            }
        }
        best
    }

    fn distance(&self, agent: AgentId, path: &[DVec2], step: usize) -> Option<f64> {
        let logged = self.recorded(agent, step)?.state.pose.position;
        Some(path[step].distance(logged))
    }

    fn paths(
        &self,
        mode: &'a PredictedMode,
    ) -> impl Iterator<Item = (AgentId, &'a [DVec2])> + use<'a> {
        let agents = self.prediction.agents.iter().copied();
        agents.zip(mode.paths.iter().map(Vec::as_slice))
    }

    fn recorded(&self, agent: AgentId, step: usize) -> Option<&'a Agent> {
        self.frame(step).agent(agent)
    }

    /// The recorded frame at a position of a path.
    fn frame(&self, step: usize) -> &'a Frame {
        &self.scenario.log[self.scenario.now + (step + 1) * self.stride]
    }
}

/// Vehicles, pedestrians and bicycles in this order, after everything else.
fn rarity(kind: AgentKind) -> Option<usize> {
    AgentKind::MOVING.iter().position(|&moving| moving == kind)
}

/// The direction of a path at a position: that of the segment at either end, the mean direction of
/// the two segments in between. A standing path points along +x.
fn heading(path: &[DVec2], step: usize) -> f64 {
    let segment = |i: usize| (path[i + 1] - path[i]).to_angle();
    let last = path.len() - 1;
    match step {
        _ if last == 0 => 0.0,
        0 => segment(0),
        step if step == last => segment(last - 1),
        step => {
            let (before, after) = (segment(step - 1), segment(step));
            let mean = DVec2::from_angle(before) + DVec2::from_angle(after);
            mean.to_angle()
        }
    }
}
