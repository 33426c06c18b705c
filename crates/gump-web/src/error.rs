//! Errors of the game, as sentences for the page.

use gump_nuplan::metrics::NuPlanError;

/// Errors of the game, each one sentence for the player.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GameError {
    /// The file holds no scenario that can be read.
    #[error("This file cannot be read as a scene: {0}.")]
    Scene(String),
    /// The scene has no agent to drive.
    #[error(
        "The scene {0} has no car to drive: its ego is not a vehicle, or not there at the start."
    )]
    NoEgo(String),
    /// The frames of the scene do not come ten times a second.
    #[error(
        "The scene has a frame every {0} s, and the page drives scenes with a frame every 0.1 s."
    )]
    Clock(f64),
    /// There is no road.
    #[error("The scene {0} has no lanes, and the network needs a road to imagine traffic on.")]
    NoLanes(String),
    /// Too many agents.
    #[error(
        "The scene is too large: it has {found} agents, and the page drives among at most {limit}. Drive it with a lower density."
    )]
    TooManyAgents {
        /// Number of agents at the start, after thinning.
        found: usize,
        /// The most there may be.
        limit: usize,
    },
    /// Too many points of the map.
    #[error(
        "The scene is too large: its map has {found} points, and the page draws at most {limit}."
    )]
    TooLargeMap {
        /// Number of points.
        found: usize,
        /// The most there may be.
        limit: usize,
    },
    /// The weights are damaged or of another network.
    #[error("These weights cannot be used: {0}.")]
    Weights(String),
    /// A setting out of its range.
    #[error("The {name} must be between {from} and {to}, and is {found}.")]
    Setting {
        /// Name of the setting.
        name: &'static str,
        /// The least it may be.
        from: f64,
        /// The most it may be.
        to: f64,
        /// The value found.
        found: f64,
    },
    /// A driver that cannot drive here.
    #[error("{driver} cannot drive here: {what}.")]
    Driver {
        /// Its name.
        driver: &'static str,
        /// Why not.
        what: String,
    },
    /// The drive is as long as drives get.
    #[error("The drive is over: a drive lasts at most {0} minutes.")]
    Over(usize),
    /// A moment that has not been driven.
    #[error("The moment {asked:.1} s has not been driven: the drive is {driven:.1} s long.")]
    NotDriven {
        /// The requested moment, seconds.
        asked: f64,
        /// Length of the drive, seconds.
        driven: f64,
    },
    /// A link that holds no drive.
    #[error("This link holds no drive that can be replayed: {0}.")]
    Link(#[from] LinkError),
    /// The drive is too short to be scored.
    #[error("Nothing to score yet: drive for two seconds or more.")]
    TooShort,
    /// The drive is too short for its realism.
    #[error("Realism is measured over eight seconds: drive on.")]
    TooShortForRealism,
    /// The recording cannot be compared with.
    #[error("Realism needs a recording of one second before and eight after the start.")]
    NoRecording,
    /// A score that cannot be computed.
    #[error("The drive cannot be scored: {0}.")]
    Score(NuPlanError),
}

/// Why a link holds no drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LinkError {
    /// It is no text of this encoding.
    #[error("it was cut off or changed on its way")]
    Damaged,
    /// It is of another version.
    #[error("it is of another version of this page")]
    OtherVersion,
    /// It ends within an input.
    #[error("it was cut off")]
    CutOff,
    /// It has more inputs than a drive.
    #[error("it is longer than a drive can be")]
    TooLong,
    /// It names an unknown driver.
    #[error("it names a driver that there is not")]
    NoSuchDriver,
    /// It names an unknown gear.
    #[error("it names a gear that there is not")]
    NoSuchGear,
}
