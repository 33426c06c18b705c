//! What imagines how traffic goes on.

use std::error::Error;

use gump_scene::{AgentState, Frame, SceneState, Seed};

/// An error of whoever implements a world or a policy.
pub type BoxError = Box<dyn Error + Send + Sync>;

/// Imagines how traffic goes on, many futures at once.
///
/// Implementations see a [`SceneState`] and so cannot see the logged future; one that needs the log
/// is an oracle and takes a `Scenario` in its constructor.
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

    /// Reuses the slot of a finished future for a fresh start (of one future).
    ///
    /// # Errors
    /// Whatever keeps the implementation from imagining this scene.
    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError>;
}
