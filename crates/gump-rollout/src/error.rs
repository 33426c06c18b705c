//! Errors of worlds, policies and simulation.

use gump_scene::AgentId;

/// Why a recording cannot be driven in.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingDefect {
    /// There are more or fewer states of the ego than frames.
    #[error("has {frames} frames but {states} states of the ego")]
    StateCount {
        /// Frames of the log.
        frames: usize,
        /// States of the ego.
        states: usize,
    },
    /// A frame is not later than the one before.
    #[error("frame {frame} is not later than the one before")]
    TimeOrder {
        /// Index of the frame.
        frame: usize,
    },
    /// The ego is absent in the present.
    #[error("lacks its ego (agent {ego}) now")]
    NoEgo {
        /// The ego.
        ego: AgentId,
    },
    /// There is nothing to drive through.
    #[error("has {frames} frames after the present, expected two or more")]
    TooShort {
        /// Frames after the present.
        frames: usize,
    },
}

/// Why traffic could not be simulated; errors inside a world or a policy are passed on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RolloutError {
    /// The duration is not a positive number.
    #[error("asked to simulate {0} s, expected a positive number of seconds")]
    Duration(f64),
    /// The world's time step cannot be divided into steps of the scene.
    #[error("the world steps by {session} s, which is not a multiple of the scene's {scene} s")]
    TimeStep {
        /// Seconds between the frames of the session.
        session: f64,
        /// Seconds between the frames of the scene.
        scene: f64,
    },
    /// The scenes of one session do not share a time step.
    #[error("scenes with time steps of {first} s and {other} s cannot share a session")]
    MixedTimeSteps {
        /// Time step of the first scene, seconds.
        first: f64,
        /// A time step that differs, seconds.
        other: f64,
    },
    /// A world or policy returned a different number of futures than requested.
    #[error("{who} gave {found} answers for {expected} futures")]
    Count {
        /// The world or policy.
        who: &'static str,
        /// Futures in the session.
        expected: usize,
        /// Number returned.
        found: usize,
    },
    /// A future has lost the ego, so that no policy can drive it.
    #[error("the world dropped the ego (agent {ego}) from future {future} at step {step}")]
    EgoVanished {
        /// The ego.
        ego: AgentId,
        /// Index of the future.
        future: usize,
        /// Session steps simulated before the error.
        step: usize,
    },
    /// A trajectory command that cannot be followed.
    #[error(
        "a command to follow needs at least one state and a positive time step, got {n} states {dt} s apart"
    )]
    Trajectory {
        /// States given.
        n: usize,
        /// Seconds between them.
        dt: f64,
    },
    /// A trajectory too short to be followed.
    #[error("a trajectory needs at least two states, got {0}")]
    TooFewStates(usize),
    /// A trajectory whose times do not increase.
    #[error("state {state} of a trajectory is not later than the one before")]
    TimeOrder {
        /// Index of the state.
        state: usize,
    },
    /// A time that a trajectory does not cover.
    #[error("a trajectory from {start_us} to {end_us} µs says nothing of {time_us} µs")]
    OutsideTrajectory {
        /// The requested time, microseconds.
        time_us: i64,
        /// Time of the first state, microseconds.
        start_us: i64,
        /// Time of the last state, microseconds.
        end_us: i64,
    },
    /// A command or a state that is not a finite number.
    #[error("{who} gave a value that is not a finite number")]
    NotFinite {
        /// Its origin.
        who: &'static str,
    },
    /// A slot that the session does not have.
    #[error("the session has {n} futures, there is none with index {future}")]
    NoSuchFuture {
        /// The requested index.
        future: usize,
        /// Futures in the session.
        n: usize,
    },
    /// A recording that cannot be driven in.
    #[error("the recording {0}")]
    Recording(#[from] RecordingDefect),
    /// A plan that no vehicle can drive.
    #[error("the planner asks for {0:.1} m/s, expected less than 50")]
    Speed(f64),
    /// A planner or traffic failed during a closed loop.
    #[error("iteration {iteration}: {who}: {what}")]
    Loop {
        /// Iterations completed before the error.
        iteration: usize,
        /// The component that failed.
        who: String,
        /// Its error.
        what: String,
    },
    /// A scene that does not belong to the replayed log.
    #[error("the scene shows no moment of the replayed log \"{0}\"")]
    ForeignScene(String),
    /// A parameter outside its range.
    #[error("the parameter {name} is {value}, expected a positive number")]
    Parameter {
        /// Its name.
        name: &'static str,
        /// Its value.
        value: f64,
    },
}
