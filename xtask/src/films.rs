//! Films of what was simulated: formats, cameras, panels.

use std::path::{Path, PathBuf};

use gump_eval::worlds::WorldName;
use gump_scene::{Rollout, Scenario, SceneState};
use gump_viz::{Film, FilmSpec, LabelledRollout, can_encode_mp4, grid_film, log_as_rollout};
use serde::Serialize;

use crate::cli::WrongArguments;
use crate::run::Run;

/// Arguments of verbs that film.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct FilmArgs {
    /// Formats of the film; mp4 needs ffmpeg
    #[arg(
        long,
        value_enum,
        value_name = "F",
        value_delimiter = ',',
        default_value = "gif"
    )]
    video: Vec<Video>,
    /// Camera of the film [default: frame, or follow where that is over 110 m across]
    #[arg(long, value_enum, value_name = "C")]
    camera: Option<CameraName>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum Video {
    /// film.gif
    Gif,
    /// film.mp4
    Mp4,
    /// An animated PNG, film.png
    Apng,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum CameraName {
    /// Fixed view of all moving agents near the ego
    Frame,
    /// Follows the ego
    Follow,
}

/// Most frames of a film: three minutes at 10 Hz. Longer ones have fewer a second; an hour of all took
/// eight minutes to write.
const MOST_FRAMES: usize = 1800;

impl FilmArgs {
    /// Refuses what cannot be written here, before anything is simulated.
    ///
    /// Error: [`WrongArguments`] for mp4 without ffmpeg.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        if self.video.contains(&Video::Mp4) && !can_encode_mp4() {
            let wrong =
                "--video mp4: expected ffmpeg on the path, found none; gif and apng need nothing";
            return Err(WrongArguments(wrong.into()).into());
        }
        Ok(())
    }

    /// These arguments, with animated PNGs added if `apng`.
    pub(crate) fn and(&self, apng: bool) -> Self {
        let mut this = self.clone();
        if apng && !this.video.contains(&Video::Apng) {
            this.video.push(Video::Apng);
        }
        this
    }

    /// Writes a film of the log, as far as it is known, beside futures with their names.
    ///
    /// Error: files that cannot be written.
    pub(crate) fn write(
        &self,
        run: &Run,
        scenario: &Scenario,
        futures: &[(&str, &Rollout)],
    ) -> anyhow::Result<()> {
        let _waiting = run.wait("writing the film");
        let film = self.film(scenario, futures)?;
        for video in &self.video {
            film.save(&video.path(run))?;
        }
        Ok(())
    }

    fn film(&self, scenario: &Scenario, futures: &[(&str, &Rollout)]) -> anyhow::Result<Film> {
        beside_log(
            scenario,
            futures,
            match self.camera {
                None => FilmSpec::of_rollouts,
                Some(CameraName::Frame) => FilmSpec::framing,
                Some(CameraName::Follow) => |_, size| FilmSpec::following(size),
            },
        )
    }
}

impl Video {
    fn path(self, run: &Run) -> PathBuf {
        run.path(match self {
            Self::Gif => "film.gif",
            Self::Mp4 => "film.mp4",
            Self::Apng => "film.png",
        })
    }
}

/// The log, as far as it is known, beside futures with their names.
///
/// Error: a film that cannot be encoded.
pub(crate) fn film(scenario: &Scenario, futures: &[(&str, &Rollout)]) -> anyhow::Result<Film> {
    beside_log(scenario, futures, FilmSpec::of_rollouts)
}

fn beside_log(
    scenario: &Scenario,
    futures: &[(&str, &Rollout)],
    spec: fn(&[&Rollout], (u32, u32)) -> FilmSpec,
) -> anyhow::Result<Film> {
    let log = log_until(scenario, futures);
    let longest = futures.iter().map(|(_, rollout)| rollout.steps()).max();
    let every = longest.unwrap_or_default().div_ceil(MOST_FRAMES).max(1);
    let thin: Vec<(&str, Rollout)> = match every {
        1 => Vec::new(),
        _ => {
            let all = futures.iter();
            all.map(|(label, rollout)| (*label, thinned(rollout, every)))
                .collect()
        }
    };
    let thin: Vec<(&str, &Rollout)> = thin.iter().map(|(label, take)| (*label, take)).collect();
    let (log, futures) = match every {
        1 => (log, futures),
        _ => (thinned(&log, every), &thin[..]),
    };
    let known = (log.steps() > 0).then_some(("log", &log));
    let takes: Vec<_> = known
        .into_iter()
        .chain(futures.iter().copied())
        .map(|(label, rollout)| LabelledRollout {
            rollout,
            label: label.into(),
        })
        .collect();
    let rollouts: Vec<&Rollout> = takes.iter().map(|take| take.rollout).collect();
    // About a thousand pixels wide, as most pages are.
    let (columns, side) = match takes.len() {
        0 | 1 => (1, 720),
        2 => (2, 540),
        3 => (3, 400),
        _ => (2, 480),
    };
    let spec = FilmSpec {
        columns,
        ..spec(&rollouts, (side, side))
    };
    Ok(grid_film(&takes, &spec)?)
}

/// Every so many steps of a rollout.
fn thinned(rollout: &Rollout, every: usize) -> Rollout {
    let mut thin = Rollout::begin(SceneState {
        dt: rollout.dt() * every as f64,
        ..rollout.at(0)
    });
    let kept = rollout.imagined().chunks_exact(every);
    kept.filter_map(<[_]>::last)
        .for_each(|frame| thin.push(frame.clone()));
    thin
}

/// The log for as long as the futures last: where they end, nothing is left to compare.
fn log_until(scenario: &Scenario, futures: &[(&str, &Rollout)]) -> Rollout {
    let seconds = |rollout: &Rollout| rollout.steps() as f64 * rollout.dt();
    let longest = futures.iter().map(|(_, rollout)| seconds(rollout));
    let longest = longest.fold(0.0, f64::max);
    let log = log_as_rollout(scenario);
    if futures.is_empty() || seconds(&log) <= longest {
        return log;
    }
    let n = (longest / scenario.dt).round() as usize;
    let mut cut = Rollout::begin(scenario.present());
    for frame in log.imagined().iter().take(n) {
        cut.push(frame.clone());
    }
    cut
}

/// The label of a drive: who drives, and in which world's traffic.
pub(crate) fn label(driver: &str, world: &WorldName) -> String {
    match world {
        WorldName::Model(_) => format!("{driver} among learned traffic"),
        other => format!("{driver} among {other}"),
    }
}

/// A world's name as part of that of a film's file: of a model that of its weights.
pub(crate) fn short(world: &WorldName) -> String {
    match world {
        WorldName::Model(weights) => Path::new(weights).file_stem().map_or_else(
            || "model".into(),
            |stem| stem.to_string_lossy().into_owned(),
        ),
        other => other.to_string(),
    }
}

/// The first few futures with their numbers, for a film.
pub(crate) fn first_few(rollouts: &[Rollout]) -> Vec<(&'static str, &Rollout)> {
    ["future 1", "future 2", "future 3"]
        .into_iter()
        .zip(rollouts)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_films_have_fewer_frames_a_second() {
        let scenario = gump_scene::fixture::scenario(
            "ego vehicle 0: 0,0 velocity 5,0\nhistory 1 future 2 dt 0.1",
        )
        .unwrap();
        let log = log_as_rollout(&scenario);
        let thin = thinned(&log, 6);
        assert_eq!(
            (thin.steps(), thin.history().len()),
            (3, log.history().len())
        );
        assert!((thin.dt() - 0.6).abs() < 1e-9);
        let x = thin.imagined()[2]
            .agent(thin.ego())
            .unwrap()
            .state
            .pose
            .position
            .x;
        assert!((x - 9.0).abs() < 1e-9, "{x}");
    }

    #[test]
    fn the_log_ends_with_the_futures() {
        let scenario = gump_scene::fixture::scenario(
            "ego vehicle 0: 0,0 velocity 5,0\nhistory 1 future 8 dt 0.1",
        )
        .unwrap();
        let log = log_as_rollout(&scenario);
        let mut short = Rollout::begin(scenario.present());
        for frame in &log.imagined()[..30] {
            short.push(frame.clone());
        }
        let steps = |futures: &[(&str, &Rollout)]| log_until(&scenario, futures).steps();
        assert_eq!(steps(&[("short", &short)]), 30);
        assert_eq!(steps(&[("short", &short), ("long", &log)]), 80);
        assert_eq!(steps(&[]), 80);
    }
}
