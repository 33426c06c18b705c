//! Frames around the present as one series of poses per agent.

use std::collections::BTreeSet;

use gump_geometry::{DVec2, OrientedBox, Pose};
use gump_scene::{AgentId, AgentKind, Frame, Rollout, Scenario};

/// Length of the past that is used, seconds: enough to determine which agents move in the present.
const PAST_S: f64 = 2.0;
/// Time over which speed is measured, seconds: a tracker's jitter of 10 cm then is 0.1 m/s, which
/// separates standing from slow agents.
const PACE_S: f64 = 1.0;

/// The log or a future, from [`PAST_S`] before the present to the horizon.
pub(super) struct Take<'a> {
    pub(super) frames: Vec<&'a Frame>,
    /// Index of the present.
    pub(super) now: usize,
    /// Seconds between frames.
    pub(super) dt: f64,
    /// Whether it reaches the horizon.
    pub(super) is_whole: bool,
}

impl<'a> Take<'a> {
    pub(super) fn of_rollout(rollout: &'a Rollout, horizon_s: f64) -> Self {
        Self::cut(
            rollout.history(),
            rollout.imagined(),
            rollout.dt(),
            horizon_s,
        )
    }

    pub(super) fn of_log(scenario: &'a Scenario, horizon_s: f64) -> Self {
        let (past, future) = scenario.log.split_at(scenario.now + 1);
        Self::cut(past, future, scenario.dt, horizon_s)
    }

    /// `past` ends with the present.
    fn cut(past: &'a [Frame], future: &'a [Frame], dt: f64, horizon_s: f64) -> Self {
        let n_past = ((PAST_S / dt).round() as usize + 1).min(past.len());
        let n_future = (horizon_s / dt).round() as usize;
        let past = &past[past.len() - n_past..];
        let ahead = &future[..n_future.min(future.len())];
        Self {
            frames: past.iter().chain(ahead).collect(),
            now: n_past.saturating_sub(1),
            dt,
            is_whole: future.len() >= n_future,
        }
    }

    /// This many seconds in frames, at least one.
    pub(super) fn steps(&self, seconds: f64) -> usize {
        ((seconds / self.dt).round() as usize).max(1)
    }

    /// Indices of the frames after the present.
    pub(super) fn ahead(&self) -> std::ops::Range<usize> {
        self.now + 1..self.frames.len()
    }

    /// Seconds of frame `k` after the present.
    pub(super) fn at_s(&self, k: usize) -> f64 {
        (k as f64 - self.now as f64) * self.dt
    }

    /// One track per moving kind of agent in the present frame, with `newcomers` also of those that
    /// appear later; by id.
    pub(super) fn tracks(&self, newcomers: bool) -> Vec<Track> {
        let n_counted = if newcomers { usize::MAX } else { 1 };
        let cast: BTreeSet<AgentId> = self.frames[self.now..]
            .iter()
            .take(n_counted)
            .flat_map(|frame| frame.agents())
            .filter(|agent| agent.kind.is_moving())
            .map(|agent| agent.id)
            .collect();
        let n = self.frames.len();
        let new = |id| Track {
            id,
            kind: AgentKind::Other,
            length: 0.0,
            width: 0.0,
            pace_steps: self.steps(PACE_S),
            dt: self.dt,
            poses: vec![None; n],
        };
        let mut tracks: Vec<Track> = cast.into_iter().map(new).collect();
        // The extent is that of the present, or of the first frame: a tracker's changes from frame
        // to frame. So the present comes first.
        let order = (self.now..n).chain(0..self.now);
        for k in order {
            let mut agents = self.frames[k].agents().iter().peekable();
            for track in &mut tracks {
                while agents.next_if(|agent| agent.id < track.id).is_some() {}
                if let Some(agent) = agents.next_if(|agent| agent.id == track.id) {
                    if track.length == 0.0 {
                        (track.kind, track.length, track.width) =
                            (agent.kind, agent.length, agent.width);
                    }
                    track.poses[k] = Some(agent.state.pose);
                }
            }
        }
        tracks
    }
}

/// One agent over the frames of a [`Take`]; `None` where it is absent.
pub(super) struct Track {
    pub(super) id: AgentId,
    pub(super) kind: AgentKind,
    /// Extent in metres, of the present.
    pub(super) length: f64,
    pub(super) width: f64,
    pub(super) poses: Vec<Option<Pose>>,
    pace_steps: usize,
    dt: f64,
}

impl Track {
    /// Its pose at a frame.
    pub(super) fn pose(&self, k: usize) -> Option<Pose> {
        self.poses.get(k).copied().flatten()
    }

    /// Its box at a frame.
    pub(super) fn oriented_box(&self, k: usize) -> Option<OrientedBox> {
        Some(OrientedBox {
            pose: self.pose(k)?,
            length: self.length,
            width: self.width,
        })
    }

    /// Mean velocity from `reach` frames before to as many after frame `k`, m/s. Computed from
    /// positions, since stated velocities may not agree with them.
    pub(super) fn velocity(&self, k: usize, reach: usize) -> Option<DVec2> {
        let (before, after) = (self.pose(k.checked_sub(reach)?)?, self.pose(k + reach)?);
        Some((after.position - before.position) / (2.0 * reach as f64 * self.dt))
    }

    /// Speed over the last second, from the distance between then and now, m/s.
    pub(super) fn pace(&self, k: usize) -> Option<f64> {
        let before = self.pose(k.checked_sub(self.pace_steps)?)?;
        let moved = self.pose(k)?.position.distance(before.position);
        Some(moved / (self.pace_steps as f64 * self.dt))
    }

    /// Frames over which [`Track::pace`] is measured.
    pub(super) fn pace_steps(&self) -> usize {
        self.pace_steps
    }

    /// The bounding box of its positions; `None` if it is never present.
    pub(super) fn bounds(&self) -> Option<(DVec2, DVec2)> {
        let mut positions = self.poses.iter().flatten().map(|pose| pose.position);
        let first = positions.next()?;
        Some(positions.fold((first, first), |(low, high), p| (low.min(p), high.max(p))))
    }
}
