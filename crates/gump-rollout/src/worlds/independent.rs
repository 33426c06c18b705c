//! A session of independent futures, stepped in parallel.

use gump_scene::{Agent, AgentId, AgentState, Frame, Light};
use rayon::prelude::*;

use crate::{BoxError, RolloutError, Session, Start};

/// One future of a rule-based world.
pub(crate) trait Future: Send {
    /// The next frame; `ego` is the ego's state in it, if it is driven externally.
    fn step(&mut self, ego: Option<AgentState>) -> Frame;

    /// Sets the lights from now on, unless the world controls them itself.
    fn show(&mut self, lights: &[Light]) -> bool {
        let _ = lights;
        false
    }

    /// Removes agents except the ego and adds others, if supported.
    fn exchange(&mut self, leave: &[AgentId], come: &[Agent]) -> bool {
        let (_, _) = (leave, come);
        false
    }
}

/// A function that opens all futures of a start, in order.
pub(crate) type Opener<'a, F> = Box<dyn Fn(&Start<'_>) -> Result<Vec<F>, RolloutError> + Send + 'a>;

/// Futures that run in parallel. Each depends only on its own state, so results do not depend on
/// the number of threads.
pub(crate) struct Independent<'a, F> {
    dt: f64,
    futures: Vec<F>,
    open: Opener<'a, F>,
}

impl<'a, F: Future> Independent<'a, F> {
    /// Opens all futures of `starts`, start-major.
    ///
    /// # Errors
    /// [`RolloutError::MixedTimeSteps`], and the errors of `open`.
    pub(crate) fn new(starts: &[Start<'_>], open: Opener<'a, F>) -> Result<Self, RolloutError> {
        let dt = starts.first().map_or(0.1, |start| start.scene.dt);
        let mut futures = Vec::new();
        for start in starts {
            check_time_step(dt, start.scene.dt)?;
            futures.extend(open(start)?);
        }
        Ok(Self { dt, futures, open })
    }
}

impl<F: Future> Session for Independent<'_, F> {
    fn dt(&self) -> f64 {
        self.dt
    }

    fn step(&mut self, ego: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
        let expected = self.futures.len();
        if let Some(ego) = ego {
            let (who, found) = ("the driver of the ego", ego.len());
            if found != expected {
                return Err(RolloutError::Count {
                    who,
                    expected,
                    found,
                }
                .into());
            }
            if !ego.iter().all(AgentState::is_finite) {
                return Err(RolloutError::NotFinite { who }.into());
            }
        }
        let frames = self
            .futures
            .par_iter_mut()
            .enumerate()
            .map(|(i, future)| future.step(ego.map(|states| states[i])));
        Ok(frames.collect())
    }

    fn keep(&mut self, futures: &[usize]) -> bool {
        let mut index = 0..;
        self.futures
            .retain(|_| index.next().is_some_and(|i| futures.contains(&i)));
        true
    }

    fn show(&mut self, future: usize, lights: &[Light]) -> bool {
        self.futures[future].show(lights)
    }

    fn exchange(&mut self, future: usize, leave: &[AgentId], come: &[Agent]) -> bool {
        self.futures[future].exchange(leave, come)
    }

    fn replace(&mut self, future: usize, start: Start<'_>) -> Result<(), BoxError> {
        let n = self.futures.len();
        if future >= n {
            return Err(RolloutError::NoSuchFuture { future, n }.into());
        }
        check_time_step(self.dt, start.scene.dt)?;
        let only = Start {
            n_futures: 1,
            ..start
        };
        self.futures.splice(future..=future, (self.open)(&only)?);
        Ok(())
    }
}

fn check_time_step(first: f64, other: f64) -> Result<(), RolloutError> {
    if (first - other).abs() > 1e-9 {
        return Err(RolloutError::MixedTimeSteps { first, other });
    }
    Ok(())
}
