//! Worlds: models of how traffic continues.

use std::error::Error;

use gump_scene::{Agent, AgentId, AgentState, Frame, Light, SceneState, Seed};

use crate::predictive_samples::{PredictiveSamples, ProbeConfig};

/// The error type of implementations of worlds and policies.
pub type BoxError = Box<dyn Error + Send + Sync>;

/// Simulates how traffic continues, for many futures at once.
///
/// Implementations receive a [`SceneState`], which does not contain the logged future; one that
/// needs the log is an oracle and takes a `Scenario` in its constructor.
///
/// An example, in which every agent slows down to a halt:
///
/// ```
/// use gump_rollout::{BoxError, Session, SimulateConfig, Start, WorldModel, simulate};
/// use gump_scene::{Agent, AgentState, Frame, Rollout, Seed};
///
/// struct RollToAHalt;
/// /// The futures so far, whose last frames are the present.
/// struct Rolling(Vec<Rollout>);
///
/// impl WorldModel for RollToAHalt {
///     fn name(&self) -> &str {
///         "roll-to-a-halt"
///     }
///     fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
///         let futures = |start: &Start<'_>| vec![Rollout::begin(start.scene); start.n_futures];
///         Ok(Box::new(Rolling(starts.iter().flat_map(futures).collect())))
///     }
/// }
///
/// impl Session for Rolling {
///     fn dt(&self) -> f64 {
///         self.0.first().map_or(0.1, Rollout::dt)
///     }
///     fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
///         for (i, future) in self.0.iter_mut().enumerate() {
///             let (scene, dt) = (future.last(), future.dt());
///             let next = |agent: &Agent| match ego {
///                 Some(driven) if agent.id == scene.ego => agent.with_state(driven[i]),
///                 _ => {
///                     let mut state = agent.state;
///                     state.velocity *= 1.0 - 0.5 * dt;
///                     state.pose.position += state.velocity * dt;
///                     agent.with_state(state)
///                 }
///             };
///             let agents = scene.now().agents().iter().map(next).collect();
///             let lights = scene.now().lights().to_vec();
///             future.push(Frame::new(agents, lights));
///         }
///         Ok(self.0.iter().map(|future| future.last().now().clone()).collect())
///     }
///     fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
///         self.0[future] = Rollout::begin(start.scene);
///         Ok(())
///     }
/// }
///
/// let scenario = gump_scene::fixture::scenario("ego vehicle 0: 0,0 velocity 8,0").unwrap();
/// let start = Start { scene: scenario.present(), n_futures: 2, seed: Seed(0) };
/// let futures = simulate(&RollToAHalt, &[start], None, &SimulateConfig::default()).unwrap();
/// assert!(futures[1].last().ego_now().state.speed() < 0.2);
/// ```
pub trait WorldModel: Send + Sync {
    /// A short name for tables and reports.
    fn name(&self) -> &str;

    /// Opens one session over all futures of all starts, start-major: the futures of the first
    /// start come first.
    ///
    /// # Errors
    /// Any reason for which the implementation cannot simulate these scenes.
    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError>;
}

impl<W: WorldModel + ?Sized> WorldModel for Box<W> {
    fn name(&self) -> &str {
        (**self).name()
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        (**self).open(starts)
    }
}

impl<W: WorldModel + ?Sized> WorldModel for &W {
    fn name(&self) -> &str {
        (**self).name()
    }

    fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
        (**self).open(starts)
    }
}

/// A scene to continue, the number of futures, and their seed.
#[derive(Clone, Copy, Debug)]
pub struct Start<'a> {
    /// The past and present of the scene.
    pub scene: SceneState<'a>,
    /// Number of futures to simulate.
    pub n_futures: usize,
    /// Future `k` of this start uses only `seed.fork(k)`.
    pub seed: Seed,
}

/// Work of a session so far. Numbers that a session does not count are 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionStats {
    /// Passes of a network, whatever their batch size.
    pub passes: u64,
    /// Floating-point operations, counting a multiplication and an addition each.
    pub operations: u64,
    /// The maximum of the bytes of keys and values that the futures have held at once.
    pub cache_bytes: usize,
}

/// Futures in progress. The session owns the state of the world, such as a KV cache.
pub trait Session {
    /// Seconds between the frames this session yields.
    fn dt(&self) -> f64;

    /// Simulates the next frame of every future, start-major.
    ///
    /// `ego` gives the ego's next state in every future, start-major; it is final, and the others
    /// react to it within the same frame. `None` lets the world drive the ego too.
    ///
    /// # Errors
    /// Any reason for which the implementation cannot simulate the frame.
    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError>;

    /// Keeps only these futures, given by ascending index; true if it did.
    ///
    /// The kept futures continue unchanged. A session that cannot drop futures returns false and
    /// keeps all, as the default does.
    fn keep(&mut self, futures: &[usize]) -> bool {
        let _ = futures;
        false
    }

    /// Sets the lights of the next frame of a future and of later ones; `lights` is the complete
    /// list. True if the session accepted them.
    ///
    /// The agents of that frame still move by the earlier lights. A session that controls its own
    /// lights returns false and keeps them, as the default does.
    fn show(&mut self, future: usize, lights: &[Light]) -> bool {
        let (_, _) = (future, lights);
        false
    }

    /// Removes agents from a future and adds others at their given states, before its next frame;
    /// true if it did. The ego is never removed.
    ///
    /// A session that does not support this returns false and changes nothing, as the default does.
    fn exchange(&mut self, future: usize, leave: &[AgentId], come: &[Agent]) -> bool {
        let (_, _, _) = (future, leave, come);
        false
    }

    /// Takes the scenes for made rather than recorded, from the next step on: nobody is parked in a lane,
    /// even if it has stood there from the first frame on.
    ///
    /// A session that makes no difference between them ignores it, as the default does.
    fn take_for_made(&mut self) {}

    /// Records predictive samples in later steps; true if it does. Futures do not change.
    ///
    /// A session whose states are not drawn from distributions returns false, as the default does.
    fn probe(&mut self, config: ProbeConfig) -> bool {
        let _ = config;
        false
    }

    /// Takes the predictive samples recorded since the last call: step by step, futures in order.
    fn take_predictive_samples(&mut self) -> Vec<PredictiveSamples> {
        Vec::new()
    }

    /// The work of this session so far, opening included.
    fn stats(&self) -> SessionStats {
        SessionStats::default()
    }

    /// Reuses the slot of a finished future for a fresh start (of one future).
    ///
    /// # Errors
    /// Any reason for which the implementation cannot simulate this scene.
    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError>;
}
