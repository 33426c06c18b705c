//! What imagines how traffic goes on.

use std::error::Error;

use gump_scene::{Agent, AgentId, AgentState, Frame, Light, SceneState, Seed};

/// An error of whoever implements a world or a policy.
pub type BoxError = Box<dyn Error + Send + Sync>;

/// Imagines how traffic goes on, many futures at once.
///
/// Implementations see a [`SceneState`] and so cannot see the logged future; one that needs the log
/// is an oracle and takes a `Scenario` in its constructor.
///
/// A world of one's own, in which everyone rolls to a halt:
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
    /// Whatever keeps the implementation from imagining these scenes.
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

/// A scene to continue, how often, and from which randomness.
#[derive(Clone, Copy, Debug)]
pub struct Start<'a> {
    /// What has been seen.
    pub scene: SceneState<'a>,
    /// How many futures to imagine.
    pub n_futures: usize,
    /// Future `k` of this start uses `seed.fork(k)` and nothing else.
    pub seed: Seed,
}

/// Futures in progress. The session owns whatever the world remembers, a KV cache for instance.
pub trait Session {
    /// Seconds between the frames this session yields.
    fn dt(&self) -> f64;

    /// Imagines the next frame of every future, start-major.
    ///
    /// `ego` gives the ego's next state in every future, start-major; it is final, and the others
    /// react to it within the same frame. `None` lets the world drive the ego too.
    ///
    /// # Errors
    /// Whatever keeps the implementation from imagining the frame.
    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError>;

    /// Goes on with these futures alone, given by ascending index; true if it does.
    ///
    /// What becomes of those kept does not change. A session that cannot let futures go says false
    /// and keeps all; so does the default.
    fn keep(&mut self, futures: &[usize]) -> bool {
        let _ = futures;
        false
    }

    /// Shows these lights, all that there are, in the next frame of a future and after it; true if
    /// it does.
    ///
    /// The frame's agents move by what they have seen until then. A session whose lights are its
    /// own affair says false and shows those; so does the default.
    fn show(&mut self, future: usize, lights: &[Light]) -> bool {
        let (_, _) = (future, lights);
        false
    }

    /// Before its next frame, takes agents out of a future and puts others in, where they are now;
    /// true if it does. The ego stays, whoever is asked to leave.
    ///
    /// A session that cannot says false and nothing changes; so does the default.
    fn exchange(&mut self, future: usize, leave: &[AgentId], come: &[Agent]) -> bool {
        let (_, _, _) = (future, leave, come);
        false
    }

    /// Reuses the slot of a finished future for a fresh start (of one future).
    ///
    /// # Errors
    /// Whatever keeps the implementation from imagining this scene.
    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError>;
}
