//! Resamples the frames of a world with a long time step to the time step of the scene, agent by
//! agent.
//!
//! A *knot* is a frame of the world, the present being knot 0; a *sample* is a frame of the
//! result. A *run* is an unbroken presence of one agent.

use std::collections::BTreeMap;

use gump_geometry::{DVec2, Pose, interpolate_angle};
use gump_scene::{Agent, AgentId, Frame, MapGraph, SceneState};

use crate::{Interpolation, SimulateConfig};

/// Samples 1 to `n_samples` after the present of `scene`, `stride` of them per knot.
///
/// Lights hold from their knot until the next. Extents, height and kind of an agent are those of
/// the first knot of its run, so rounding of sizes by a world has no effect.
///
/// Source: the paper's Waymo post-processing for linear interpolation, elevation and smoothing,
/// with the sine *and* the cosine of the heading smoothed.
pub(crate) fn resample(
    scene: SceneState<'_>,
    knots: &[Frame],
    stride: usize,
    n_samples: usize,
    config: &SimulateConfig,
) -> Vec<Frame> {
    let mut samples: Vec<Vec<Agent>> = vec![Vec::new(); n_samples];
    for (id, present) in tracks(scene.now(), knots) {
        let mut rest = present.as_slice();
        while let Some(n) = run_length(rest) {
            let (knots, tail) = rest.split_at(n);
            let run = Run {
                scene,
                id,
                stride,
                knots,
            };
            let first = knots[0].0 * stride;
            for (i, agent) in run.samples(config).into_iter().enumerate() {
                // Sample 0 is the logged present, which the rollout already holds.
                if let Some(slot) = (first + i).checked_sub(1).and_then(|j| samples.get_mut(j)) {
                    slot.push(agent);
                }
            }
            rest = tail;
        }
    }
    samples
        .into_iter()
        .enumerate()
        .map(|(i, agents)| {
            let lights = match (i + 1) / stride {
                0 => scene.now().lights(),
                knot => knots[knot - 1].lights(),
            };
            Frame::new(agents, lights.to_vec())
        })
        .collect()
}

/// A knot of one agent: its index and the agent there.
type Knot<'a> = (usize, &'a Agent);

/// The knots of every agent in order; knot 0 is the present.
fn tracks<'a>(present: &'a Frame, knots: &'a [Frame]) -> BTreeMap<AgentId, Vec<Knot<'a>>> {
    let mut tracks: BTreeMap<AgentId, Vec<Knot<'a>>> = BTreeMap::new();
    for (knot, frame) in std::iter::once(present).chain(knots).enumerate() {
        for agent in frame.agents() {
            tracks.entry(agent.id).or_default().push((knot, agent));
        }
    }
    tracks
}

/// Number of knots at the start of `knots` that follow each other; `None` if there is none.
fn run_length(knots: &[Knot<'_>]) -> Option<usize> {
    let first = knots.first()?.0;
    Some(
        knots
            .iter()
            .enumerate()
            .take_while(|(i, (knot, _))| *knot == first + i)
            .count(),
    )
}

struct Run<'a> {
    scene: SceneState<'a>,
    id: AgentId,
    stride: usize,
    knots: &'a [Knot<'a>],
}

impl Run<'_> {
    /// The agent at every sample from its first knot to its last.
    fn samples(&self, config: &SimulateConfig) -> Vec<Agent> {
        let smoothed = config.smoothing_window > 1;
        if self.stride == 1 && !smoothed {
            let mut agents: Vec<Agent> = self.knots.iter().map(|(_, agent)| **agent).collect();
            self.elevate(&mut agents, config);
            return agents;
        }
        let mut poses = self.poses(config.interpolation);
        if smoothed {
            poses = self.smooth(&poses, config.smoothing_window / 2);
        }
        let first = self.knots[0].1;
        let mut agents: Vec<Agent> = poses
            .iter()
            .enumerate()
            .map(|(i, &pose)| {
                let mut agent = *first;
                agent.state.pose = pose;
                agent.elevation = self.interpolated_elevation(i);
                if i > 0 {
                    agent.state.velocity = (pose.position - poses[i - 1].position) / self.scene.dt;
                }
                agent
            })
            .collect();
        self.elevate(&mut agents, config);
        agents
    }

    fn poses(&self, interpolation: Interpolation) -> Vec<Pose> {
        let points: Vec<DVec2> = self
            .knots
            .iter()
            .map(|(_, agent)| agent.state.pose.position)
            .collect();
        let tangents = match interpolation {
            Interpolation::Linear => Vec::new(),
            Interpolation::Hermite => tangents(&points, self.incoming()),
        };
        let mut poses = Vec::with_capacity(self.n_samples());
        for i in 0..self.n_samples() {
            let (knot, t) = self.place(i);
            let heading = self.knots[knot].1.state.pose.heading;
            let pose = if t == 0.0 {
                self.knots[knot].1.state.pose
            } else {
                Pose {
                    position: match interpolation {
                        Interpolation::Linear => points[knot].lerp(points[knot + 1], t),
                        Interpolation::Hermite => hermite(
                            [points[knot], points[knot + 1]],
                            [tangents[knot], tangents[knot + 1]],
                            t,
                        ),
                    },
                    heading: interpolate_angle(
                        heading,
                        self.knots[knot + 1].1.state.pose.heading,
                        t,
                    ),
                }
            };
            poses.push(pose);
        }
        poses
    }

    fn n_samples(&self) -> usize {
        (self.knots.len() - 1) * self.stride + 1
    }

    /// The knot at or before sample `i` and the fraction of the way to the next.
    fn place(&self, i: usize) -> (usize, f64) {
        let fraction = (i % self.stride) as f64 / self.stride as f64;
        (i / self.stride, fraction)
    }

    fn interpolated_elevation(&self, i: usize) -> f64 {
        let (knot, t) = self.place(i);
        let from = self.knots[knot].1.elevation;
        if t == 0.0 {
            return from;
        }
        from + t * (self.knots[knot + 1].1.elevation - from)
    }

    /// Displacement over the knot interval before the run: from the log if the run starts now and
    /// the agent was seen that long ago, else from its velocity.
    fn incoming(&self) -> DVec2 {
        let (knot, agent) = self.knots[0];
        let history = self.scene.history;
        let earlier = (knot == 0)
            .then(|| (history.len() - 1).checked_sub(self.stride))
            .flatten()
            .and_then(|i| history[i].agent(self.id));
        match earlier {
            Some(earlier) => agent.state.pose.position - earlier.state.pose.position,
            None => agent.state.velocity * (self.scene.dt * self.stride as f64),
        }
    }

    /// Centred moving average over history and run. Where one side ends the window shrinks but
    /// stays centred. History and present stay as logged.
    fn smooth(&self, poses: &[Pose], half_window: usize) -> Vec<Pose> {
        let starts_now = self.knots[0].0 == 0;
        let past = self.scene.history.iter().rev().skip(1).take(half_window);
        let mut line: Vec<Pose> = past
            .map_while(|frame| frame.agent(self.id))
            .map(|agent| agent.state.pose)
            .filter(|_| starts_now)
            .collect();
        line.reverse();
        let n_past = line.len();
        line.extend(poses);
        let first = n_past + usize::from(starts_now);
        let mut smooth = line.clone();
        for i in first..line.len() {
            let half = half_window.min(i).min(line.len() - 1 - i);
            smooth[i] = average(&line[i - half..=i + half], line[i]);
        }
        smooth.split_off(n_past)
    }

    /// Sets the elevation of agents to that of the road plus their offset at the start of the run.
    fn elevate(&self, agents: &mut [Agent], config: &SimulateConfig) {
        if !config.relative_elevation {
            return;
        }
        let map: &MapGraph = self.scene.map;
        let start = *self.knots[0].1;
        let Some(road_at_start) = map.elevation_at(start.state.pose.position) else {
            return;
        };
        let (mut position, mut road) = (start.state.pose.position, road_at_start);
        for agent in agents {
            // Standing agents are many and the look-up is the most expensive part of resampling.
            if agent.state.pose.position != position {
                position = agent.state.pose.position;
                road = map.elevation_at(position).unwrap_or(road_at_start);
            }
            agent.elevation = start.elevation + road - road_at_start;
        }
    }
}

/// Mean position, and the direction of the mean of the unit vectors; `middle`'s where they cancel.
fn average(poses: &[Pose], middle: Pose) -> Pose {
    let n = poses.len() as f64;
    // Relative to the middle: world coordinates are large.
    let shift: DVec2 = poses.iter().map(|p| p.position - middle.position).sum();
    let direction: DVec2 = poses.iter().map(|p| p.direction()).sum();
    Pose {
        position: middle.position + shift / n,
        heading: if direction.length() / n > 1e-6 {
            direction.to_angle()
        } else {
            middle.heading
        },
    }
}

/// Displacement per knot interval at every knot, from the differences on both sides.
///
/// Each is at most three times the shorter neighbouring difference, and zero at a reversal: the
/// curve then neither overshoots a stop nor moves between two equal knots.
///
/// Source: the limit of Fritsch and Carlson (1980), applied to the length so that it does not
/// depend on the axes.
fn tangents(points: &[DVec2], incoming: DVec2) -> Vec<DVec2> {
    let mut before = incoming;
    (0..points.len())
        .map(|i| {
            let after = points.get(i + 1).map_or(before, |next| *next - points[i]);
            let tangent = if before.dot(after) < 0.0 {
                DVec2::ZERO
            } else {
                ((before + after) / 2.0).clamp_length_max(3.0 * before.length().min(after.length()))
            };
            before = after;
            tangent
        })
        .collect()
}

fn hermite(points: [DVec2; 2], tangents: [DVec2; 2], t: f64) -> DVec2 {
    let step = points[1] - points[0];
    let (t2, t3) = (t * t, t * t * t);
    points[0]
        + step * (3.0 * t2 - 2.0 * t3)
        + tangents[0] * (t3 - 2.0 * t2 + t)
        + tangents[1] * (t3 - t2)
}
