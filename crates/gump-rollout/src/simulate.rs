//! Closed-loop simulation: a world and optionally a policy produce futures.
//!
//! Resampling of the world's frames to the scene's rate is in `resample`; the world moves the
//! traffic.

use gump_scene::{AgentState, Frame, Rollout, SceneState};
use rayon::prelude::*;

use crate::resample::resample;
use crate::{BoxError, Policy, RolloutError, Session, Start, WorldModel, dynamics};

/// Interpolation of positions between the frames of a world with a longer time step than the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interpolation {
    /// Linear; velocities jump at frames. Used by the paper's evaluation.
    Linear,
    /// Cubic Hermite with tangents from finite differences, limited so that it never overshoots.
    Hermite,
}

/// Duration of a simulation, and resampling of frames to the scene's rate.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulateConfig {
    /// Seconds to simulate, > 0; rounded to whole steps of the scene.
    pub seconds: f64,
    /// Positions between the world's frames.
    pub interpolation: Interpolation,
    /// Samples in the centred moving average over history and future; 0 and 1 turn it off, an
    /// even number counts as the odd one below it.
    pub smoothing_window: usize,
    /// True: agents keep their height over the road they are on. False: the world's elevations are
    /// kept.
    pub relative_elevation: bool,
    /// Whether the scenes are made rather than recorded (see [`Session::take_for_made`]).
    pub made_scenes: bool,
}

impl Default for SimulateConfig {
    /// 8 s, the horizon of the Waymo Sim Agents Challenge; Hermite, no smoothing, relative
    /// elevation.
    fn default() -> Self {
        Self {
            seconds: 8.0,
            interpolation: Interpolation::Hermite,
            smoothing_window: 0,
            relative_elevation: true,
            made_scenes: false,
        }
    }
}

impl SimulateConfig {
    /// The post-processing of the paper's Waymo evaluation: linear, smoothed over 9 samples.
    pub fn compat() -> Self {
        Self {
            interpolation: Interpolation::Linear,
            smoothing_window: 9,
            ..Self::default()
        }
    }
}

/// Simulates futures of the scenes, one rollout per future, start-major.
///
/// Rollouts have the time step of their scene, whatever the world's own: positions are interpolated
/// per agent, headings turn the shorter way, velocities are finite differences. An agent that is
/// missing in the world's next frame is absent from then on; one that appears does so at its first
/// frame. Frames of a world that already has the scene's time step are kept unchanged, including
/// velocities.
///
/// A `policy`, if given, acts on all futures before every step *of the world*, on scenes thinned to
/// that step, and the ego's next state is fixed by its command. Without a policy the world drives
/// the ego.
///
/// # Errors
/// Errors of the world or the policy, and [`RolloutError`] where they do not fit together.
pub fn simulate(
    world: &dyn WorldModel,
    starts: &[Start<'_>],
    mut policy: Option<&mut dyn Policy>,
    config: &SimulateConfig,
) -> Result<Vec<Rollout>, BoxError> {
    if !(config.seconds > 0.0 && config.seconds.is_finite()) {
        return Err(RolloutError::Duration(config.seconds).into());
    }
    let mut session = world.open(starts)?;
    if config.made_scenes {
        session.take_for_made();
    }
    let dt = session.dt();
    let mut futures = Vec::new();
    for start in starts {
        let stride = stride(dt, start.scene.dt)?;
        let n_samples = (config.seconds / start.scene.dt).round().max(1.0) as usize;
        let coarse = begin(start.scene, dt, stride);
        futures.extend((0..start.n_futures).map(|_| Future {
            scene: start.scene,
            stride,
            n_samples,
            coarse: coarse.clone(),
        }));
    }
    let n_steps = futures.iter().map(|f| f.n_samples.div_ceil(f.stride)).max();
    for step in 0..n_steps.unwrap_or(0) {
        let ego = match policy.as_deref_mut() {
            Some(policy) => Some(decide(policy, &futures, dt, step)?),
            None => None,
        };
        let frames = step_checked(&mut *session, ego.as_deref(), futures.len())?;
        for (future, frame) in futures.iter_mut().zip(frames) {
            future.coarse.push(frame);
        }
    }
    Ok(futures
        .into_par_iter()
        .map(|future| future.finish(config))
        .collect())
}

/// The frames from the present of a scene (excluded) to the world's next frame (included) at the
/// scene's rate: the frames that [`simulate`] inserts between two frames of a world, for callers
/// that step a world themselves.
///
/// The start of the curve matches the frame `dt` before the present. Frames after `next` are not
/// known yet, so the end is straight.
///
/// # Errors
/// [`RolloutError::TimeStep`] if `dt`, seconds, is no multiple of the scene's.
pub fn fill(
    scene: SceneState<'_>,
    next: &Frame,
    dt: f64,
    config: &SimulateConfig,
) -> Result<Vec<Frame>, RolloutError> {
    let stride = stride(dt, scene.dt)?;
    let knots = std::slice::from_ref(next);
    Ok(resample(scene, knots, stride, stride, config))
}

/// One future in progress, at the time step of the world.
struct Future<'a> {
    scene: SceneState<'a>,
    stride: usize,
    n_samples: usize,
    coarse: Rollout,
}

impl Future<'_> {
    fn finish(self, config: &SimulateConfig) -> Rollout {
        let knots = self.coarse.imagined();
        let samples = resample(self.scene, knots, self.stride, self.n_samples, config);
        let mut rollout = Rollout::begin(self.scene);
        for frame in samples {
            rollout.push(frame);
        }
        rollout
    }
}

fn stride(session: f64, scene: f64) -> Result<usize, RolloutError> {
    let ratio = session / scene;
    let whole = ratio.round();
    if whole >= 1.0 && (ratio - whole).abs() < 1e-6 {
        Ok(whole as usize)
    } else {
        Err(RolloutError::TimeStep { session, scene })
    }
}

/// A rollout at the world's rate, which is what a policy sees while the world steps.
fn begin(scene: SceneState<'_>, dt: f64, stride: usize) -> Rollout {
    if stride == 1 {
        return Rollout::begin(scene);
    }
    let thinned: Vec<Frame> = scene
        .strided_history(stride, usize::MAX)
        .into_iter()
        .cloned()
        .collect();
    Rollout::begin(SceneState {
        history: &thinned,
        dt,
        ..scene
    })
}

/// Calls the policy and turns its commands into the ego's next states.
fn decide(
    policy: &mut dyn Policy,
    futures: &[Future<'_>],
    dt: f64,
    step: usize,
) -> Result<Vec<AgentState>, BoxError> {
    let scenes: Vec<_> = futures.iter().map(|future| future.coarse.last()).collect();
    for (future, scene) in scenes.iter().enumerate() {
        let ego = scene.ego;
        if scene.now().agent(ego).is_none() {
            return Err(RolloutError::EgoVanished { ego, future, step }.into());
        }
    }
    let commands = policy.act(&scenes)?;
    check_count("the policy", scenes.len(), commands.len())?;
    let states = scenes
        .iter()
        .zip(&commands)
        .map(|(scene, command)| dynamics::advance(&scene.ego_now().state, command, dt));
    Ok(states.collect::<Result<_, _>>()?)
}

fn step_checked(
    session: &mut (dyn Session + '_),
    ego: Option<&[AgentState]>,
    n_futures: usize,
) -> Result<Vec<Frame>, BoxError> {
    let frames = session.step(ego)?;
    check_count("the world", n_futures, frames.len())?;
    Ok(frames)
}

fn check_count(who: &'static str, expected: usize, found: usize) -> Result<(), RolloutError> {
    if expected == found {
        Ok(())
    } else {
        Err(RolloutError::Count {
            who,
            expected,
            found,
        })
    }
}
