//! Drives of every planner in every world through one scenario.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

use gump_eval::planners::{PlannerConfig, PlannerName, PlanningWorld, TimedDriver};
use gump_eval::recordings::{Case, Named};
use gump_eval::worlds::WorldName;
use gump_nuplan::closed_loop::{Driver, Mission, Moment};
use gump_nuplan::tracking::Trajectory;
use gump_planner::closed_loop::{Scored, drive_and_score};
use gump_planner::{Explain, PdmClosed, PdmConfig, ProposalKind};
use gump_rollout::{BoxError, WorldModel};
use gump_scene::Seed;

use super::{Args, Driven, Finished, Outcome};
use crate::films;
use crate::planners::Chosen;
use crate::run::{Run, interrupted, stop_if_interrupted};

/// What the drives of all scenarios share.
pub(super) struct Drives<'a> {
    pub(super) args: &'a Args,
    /// Of every world that is asked for, in their order.
    pub(super) worlds: &'a [PlanningWorld],
    pub(super) imagination: &'a dyn WorldModel,
    pub(super) thinking: &'a PlannerConfig,
}

/// A planner of a row: those that are asked for, and every proposal alone.
enum Planner<'a> {
    Chosen(&'a Chosen),
    Proposal {
        speed_fraction: f64,
        lateral_offset: f64,
    },
}

impl Planner<'_> {
    fn name(&self) -> String {
        match *self {
            Self::Chosen(chosen) => chosen.to_string(),
            Self::Proposal {
                speed_fraction,
                lateral_offset,
            } => ProposalKind::Idm {
                speed_fraction,
                lateral_offset,
            }
            .to_string(),
        }
    }
}

impl Drives<'_> {
    /// What every planner gets in every world in the scenario at `index` of all.
    ///
    /// Error: a film that cannot be written. What a drive fails at is its outcome.
    pub(super) fn through(&self, run: &Run, index: usize, named: Named) -> anyhow::Result<Driven> {
        let seed = run.seed().fork(index as u64);
        let planners = self.planners();
        let mut outcomes = Vec::new();
        for (world, surroundings) in self.args.world.iter().zip(self.worlds) {
            for planner in &planners {
                let scored = match &named.case {
                    _ if interrupted() => Err("stopped by Ctrl-C".into()),
                    Ok(case) => self.drive(planner, case, surroundings, seed),
                    Err(error) => Err(error.to_string()),
                };
                if let (Ok((scored, _)), Ok(case)) = (&scored, &named.case)
                    && index < self.args.films
                {
                    let label = format!("{} among {world}", planner.name());
                    let name = file_name(&planner.name());
                    let file = format!("{index}-{name}-{}.gif", short(world));
                    film(run, case, scored, &label, &file)?;
                }
                let (finished, error) = match scored {
                    Ok((scored, milliseconds)) => (Some(finished(&scored, milliseconds)), None),
                    Err(error) => (None, Some(error)),
                };
                outcomes.push(Outcome {
                    world: world.to_string(),
                    planner: planner.name(),
                    proposal: matches!(planner, Planner::Proposal { .. }),
                    finished,
                    error,
                });
            }
        }
        Ok(Driven {
            log_name: named.log_name,
            scenario_type: named.scenario_type,
            outcomes,
        })
    }

    /// The planners of all rows.
    fn planners(&self) -> Vec<Planner<'_>> {
        let mut planners = Vec::new();
        for chosen in &self.args.planner {
            if !matches!(chosen, Chosen::Ours(PlannerName::Proposals)) {
                planners.push(Planner::Chosen(chosen));
                continue;
            }
            let all = PdmConfig::default();
            for &lateral_offset in &all.lateral_offsets {
                for &speed_fraction in &all.speed_fractions {
                    planners.push(Planner::Proposal {
                        speed_fraction,
                        lateral_offset,
                    });
                }
            }
        }
        planners
    }

    /// One drive: what it came to and the milliseconds of a plan, or why it failed. A planner that
    /// panics has failed like any other.
    fn drive(
        &self,
        planner: &Planner<'_>,
        case: &Case,
        surroundings: &PlanningWorld,
        seed: Seed,
    ) -> Result<(Scored, f64), String> {
        let drive = || {
            let mut driver = self.build(planner, case, seed)?;
            let mut stoppable = Stoppable(&mut *driver);
            let mut timed = TimedDriver::new(&mut stoppable, self.args.driving.budget());
            let scored = drive_and_score(
                &case.recording,
                &case.map,
                &mut *surroundings.traffic(seed),
                &mut timed,
                &self.args.driving.config(),
            )?;
            let milliseconds = timed.milliseconds_per_step();
            Ok::<_, anyhow::Error>((scored, milliseconds))
        };
        match catch_unwind(AssertUnwindSafe(drive)) {
            Ok(driven) => driven.map_err(|error| format!("{error:#}")),
            Err(panic) => {
                let message = panic
                    .downcast_ref::<&str>()
                    .map(|text| (*text).to_owned())
                    .or_else(|| panic.downcast_ref::<String>().cloned());
                let message = message.unwrap_or_else(|| "without a message".into());
                Err(format!("{} panicked: {message}", planner.name()))
            }
        }
    }

    fn build(
        &self,
        planner: &Planner<'_>,
        case: &Case,
        seed: Seed,
    ) -> anyhow::Result<Box<dyn Explain + '_>> {
        match planner {
            Planner::Chosen(Chosen::Ours(planner)) => {
                Ok(planner.build(case, self.imagination, seed, self.thinking)?)
            }
            Planner::Chosen(Chosen::Remote(address)) => self.remote(case, address),
            Planner::Proposal {
                speed_fraction,
                lateral_offset,
            } => {
                let only = PdmConfig {
                    speed_fractions: vec![*speed_fraction],
                    lateral_offsets: vec![*lateral_offset],
                    ..PdmConfig::default()
                };
                Ok(Box::new(PdmClosed::new(only)?))
            }
        }
    }

    /// A planner in another process.
    #[cfg(feature = "grpc")]
    fn remote(&self, case: &Case, address: &str) -> anyhow::Result<Box<dyn Explain + '_>> {
        let limit = self.args.driving.budget();
        let driver = gump_grpc::RemoteDriver::new(address, &case.map_name, limit);
        Ok(Box::new(driver))
    }

    #[cfg(not(feature = "grpc"))]
    fn remote(&self, _: &Case, address: &str) -> anyhow::Result<Box<dyn Explain + '_>> {
        Chosen::Remote(address.into()).check()?;
        anyhow::bail!("this build cannot call {address}")
    }
}

/// A driver that ends its drive after Ctrl-C.
struct Stoppable<'a>(&'a mut dyn Driver);

impl Driver for Stoppable<'_> {
    fn name(&self) -> &str {
        self.0.name()
    }

    fn start(&mut self, mission: &Mission<'_>) -> Result<(), BoxError> {
        self.0.start(mission)
    }

    fn drive(&mut self, moment: &Moment<'_>) -> Result<Trajectory, BoxError> {
        stop_if_interrupted()?;
        self.0.drive(moment)
    }
}

fn finished(scored: &Scored, milliseconds: f64) -> Finished {
    let metrics = scored.metrics.scores().into_iter();
    let metrics = metrics.filter_map(|(name, value)| Some((name, value?)));
    Finished {
        score: scored.score,
        milliseconds,
        metrics: metrics.collect::<BTreeMap<_, _>>(),
    }
}

/// A name without what file systems dislike.
fn file_name(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    name.chars().map(plain).collect()
}

/// A film of what was driven beside the log.
fn film(run: &Run, case: &Case, scored: &Scored, label: &str, name: &str) -> anyhow::Result<()> {
    let folder = run.path("films");
    std::fs::create_dir_all(&folder)?;
    let film = films::film(
        case.recording.scenario(),
        &[(label, &scored.driven.rollout)],
    )?;
    Ok(film.save(&folder.join(name))?)
}

/// A world's name as part of a file's.
fn short(world: &WorldName) -> String {
    match world {
        WorldName::Model(_) => "model".into(),
        other => other.to_string(),
    }
}
