//! The GUMP paper's metrics of reinforcement learning: stricter than nuPlan's, and over whole
//! episodes.
//!
//! Collision, off-road and progress are the metrics that [`gump_metrics::Reward`] uses.

use gump_scene::Rollout;

use super::comfort::{ComfortSeries, Motion};
use super::history::motion_of;
use gump_metrics::{Collision, ComfortBounds, Discomfort, Metric, OffRoad, Progress, over_rollout};

/// The mean progress in nuPlan, metres, by which an episode's progress is divided. The ratio is not
/// clipped.
///
/// Source: the GUMP paper.
pub const MEAN_PROGRESS: f64 = 62.0;

/// The measurements of one episode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RlEpisode {
    /// The ego touched an agent, regardless of fault.
    pub collided: bool,
    /// A corner of the ego left the road, without tolerance.
    pub off_road: bool,
    /// Metres along the route.
    pub progress: f64,
    /// The whole drive kept nuPlan's bounds of comfort.
    pub comfortable: bool,
}

impl RlEpisode {
    /// Measures the ego of a rollout. Undefined metrics (no borders, no route) count as no
    /// violation and no progress.
    ///
    /// Comfort is evaluated on the smoothed drive; on a drive of fewer than four frames frame by
    /// frame.
    pub fn of(rollout: &Rollout) -> Self {
        let ego = rollout.ego();
        let over = |metric: &dyn Metric| over_rollout(metric, rollout, ego).unwrap_or_default();
        let smoothed = ComfortSeries::of(&motion(rollout));
        Self {
            collided: over(&Collision) > 0.0,
            off_road: over(&OffRoad) > 0.0,
            progress: over(&Progress),
            comfortable: match smoothed {
                Some(series) => series.is_comfortable(&ComfortBounds::NUPLAN),
                None => over(&Discomfort) == 0.0,
            },
        }
    }

    /// True if the ego neither collided nor left the road.
    pub fn is_safe(&self) -> bool {
        !self.collided && !self.off_road
    }

    /// The score of the episode: 0 if it was not safe.
    pub fn score(&self) -> f64 {
        let phi = (self.progress / MEAN_PROGRESS + f64::from(self.comfortable)) / 2.0;
        if self.is_safe() { phi } else { 0.0 }
    }
}

/// One row of the paper's table of reinforcement learning.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct RlScore {
    /// Number of episodes.
    pub episodes: usize,
    /// Share of safe episodes times their mean score.
    pub score: f64,
    /// Share of episodes with a collision.
    pub collision_rate: f64,
    /// Share of episodes that left the road.
    pub off_road_rate: f64,
    /// Mean progress of safe episodes, metres; 0 if none is safe.
    pub progress: f64,
    /// Share of safe episodes that are comfortable; 0 if none is safe.
    pub comfort: f64,
}

impl RlScore {
    /// Summarises episodes; all zero for none.
    ///
    /// Source: the paper's appendix. Its formula, taken literally, rewards violations; this
    /// interpretation reproduces the five published rows to the rounding of their rates.
    pub fn of(episodes: &[RlEpisode]) -> Self {
        let mean = |n: usize, sum: f64| if n == 0 { 0.0 } else { sum / n as f64 };
        let share = |counts: fn(&RlEpisode) -> bool| {
            let n = episodes.iter().filter(|e| counts(e)).count();
            mean(episodes.len(), n as f64)
        };
        let safe = || episodes.iter().filter(|episode| episode.is_safe());
        let n_safe = safe().count();
        let progress = mean(n_safe, safe().map(|e| e.progress).sum());
        let comfort = mean(n_safe, safe().map(|e| f64::from(e.comfortable)).sum());
        let share_safe = share(RlEpisode::is_safe);
        Self {
            episodes: episodes.len(),
            score: share_safe * (progress / MEAN_PROGRESS + comfort) / 2.0,
            collision_rate: share(|e| e.collided),
            off_road_rate: share(|e| e.off_road),
            progress,
            comfort,
        }
    }
}

fn motion(rollout: &Rollout) -> Motion {
    let frames = std::iter::once(rollout.start()).chain(rollout.imagined());
    motion_of(frames, rollout.ego(), rollout.dt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_metrics::logged;
    use gump_scene::fixture;

    #[test]
    fn the_row_is_the_mean_of_its_episodes() {
        let episode = |collided, off_road, progress, comfortable| RlEpisode {
            collided,
            off_road,
            progress,
            comfortable,
        };
        let episodes = [
            episode(false, false, 62.0, true),
            episode(false, false, 93.0, false),
            episode(true, false, 31.0, true),
            episode(true, true, 500.0, true),
        ];
        let row = RlScore::of(&episodes);
        // Half are safe; they get 77.5 m far and one of two is comfortable.
        assert_eq!((row.collision_rate, row.off_road_rate), (0.5, 0.25));
        assert_eq!((row.progress, row.comfort), (77.5, 0.5));
        assert_abs_diff_eq!(row.score, 0.5 * (77.5 / 62.0 + 0.5) / 2.0, epsilon = 1e-12);
        let mean = episodes.iter().map(RlEpisode::score).sum::<f64>() / 4.0;
        assert_abs_diff_eq!(row.score, mean, epsilon = 1e-12);
        assert_eq!(RlScore::of(&[]), RlScore::default());
    }

    fn episode(text: &str) -> RlEpisode {
        let text = format!("lane 1: 0,0 200,0\nroute 1\nedge: 0,-2 200,-2\n{text}");
        RlEpisode::of(&logged(&fixture::scenario(&text).unwrap()))
    }

    #[test]
    fn every_collision_and_every_corner_counts() {
        let free = episode("ego vehicle 0: 10,0 velocity 5,0");
        assert!(free.is_safe() && free.comfortable);
        assert_abs_diff_eq!(free.progress, 40.0, epsilon = 1e-9);
        assert_abs_diff_eq!(free.score(), (40.0 / 62.0 + 1.0) / 2.0, epsilon = 1e-9);
        // Hit from behind: not at fault in nuPlan, a collision here.
        let hit = episode("ego vehicle 0: 50,0\nagent vehicle 1: 30,0 velocity 9,0");
        assert!(hit.collided && hit.score() == 0.0);
        // 5 cm over the edge: within nuPlan's tolerance.
        assert!(episode("ego vehicle 0: 10,-1.05 velocity 5,0").off_road);
    }
}
