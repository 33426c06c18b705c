//! Scores of a drive: nuPlan's closed-loop score, and the realism of the traffic.

use gump_nuplan::metrics::{MetricScores, RolloutHistory, Scoring, score};
use gump_wosac::realism::{self, Config, Log, N_FUTURE, Rollouts, Year};

use crate::{Game, GameError};

/// Frames of the shortest drive that is scored: the longest filter of comfort spans 15.
const SHORTEST: usize = 20;
/// Parts that compare with what the recorded driver did in the same time.
const COMPARED: [&str; 2] = ["ego_progress_along_expert_route", "ego_is_making_progress"];

/// A drive by nuPlan's measure.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveScore {
    /// From 0 to 1.
    pub total: f64,
    /// Its parts by nuPlan's names.
    pub parts: MetricScores,
    /// Seconds that were judged.
    pub seconds: f64,
    /// Seconds that progress was compared over: as long as the recording lasts.
    pub compared_seconds: f64,
}

impl Game {
    /// Scores the drive so far as nuPlan's closed-loop challenges do.
    ///
    /// Progress is compared with the recorded driver's, for as long as there is a recording; all
    /// else is judged over the whole drive.
    ///
    /// # Errors
    /// [`GameError::TooShort`] for less than two seconds, [`GameError::Score`] for a drive that
    /// nuPlan's metrics refuse.
    pub fn score(&self) -> Result<DriveScore, GameError> {
        let driven = self.driven();
        if driven < SHORTEST {
            return Err(GameError::TooShort);
        }
        let whole = RolloutHistory::new(&self.rollout(driven), self.scenario());
        let mut parts = score(&whole.on(self.map()))
            .map_err(GameError::Score)?
            .scores();
        let recorded = self.scenario().future().len().min(driven);
        if recorded < driven && recorded >= SHORTEST {
            let begun = RolloutHistory::new(&self.rollout(recorded), self.scenario());
            let begun = score(&begun.on(self.map()))
                .map_err(GameError::Score)?
                .scores();
            for name in COMPARED {
                if let Some(&compared) = begun.get(name) {
                    parts.insert(name.into(), compared);
                }
            }
        }
        Ok(DriveScore {
            total: Scoring::closed_loop().score(&parts),
            parts,
            seconds: driven as f64 * crate::game::DT,
            compared_seconds: recorded as f64 * crate::game::DT,
        })
    }

    /// Realism of the first eight seconds, by Waymo's metric of 2025: the drive as the only
    /// rollout, whichever driver drove the ego.
    ///
    /// # Errors
    /// [`GameError::TooShortForRealism`], [`GameError::NoRecording`].
    pub fn realism(&self) -> Result<f64, GameError> {
        if self.driven() < N_FUTURE {
            return Err(GameError::TooShortForRealism);
        }
        let failed = |_| GameError::NoRecording;
        let log = Log::of(self.scenario()).map_err(failed)?;
        let config = Config::of(Year::Y2025);
        let rollouts = [self.rollout(N_FUTURE)];
        let rollouts = Rollouts::of(&self.scenario().id, &rollouts, config.mode);
        let rollouts = rollouts.map_err(failed)?;
        let scores = realism::score(&log, &rollouts, &config).map_err(failed)?;
        Ok(scores.metametric)
    }

    fn map(&self) -> &gump_scene::MapGraph {
        &self.scenario().map
    }
}
