//! Repeated rollouts of a scene, and the instant at which one of them satisfies the prompts: a tag
//! is about an instant, so any instant may become the present of the scenario.

use gump_rollout::{SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{Frame, Rollout, Scenario, Seed};

use crate::GenerateError;
use crate::check::{LOOK_S, overlaps_in};
use crate::drive::{PlannedDrive, Steered};

#[cfg(doc)]
use crate::check::through_time;

/// Number of futures simulated of a scene, after a first one that is often sufficient. Each costs as
/// much as the first; not tuned.
pub(super) const FUTURES: usize = 4;
/// Seconds of future that tags need: a change of lanes is looked for 4 s ahead
/// (`gump_metrics::tags`).
pub(super) const JUDGED_S: f64 = 4.0;
/// Maximum time from the generated scene to the instant, seconds: longer, and what was generated has
/// moved away. Chosen by hand.
const MOMENTS_S: f64 = 2.0;
/// Seconds before the instant that are kept, as long as recorded histories.
const HISTORY_S: f64 = 1.0;

/// Separates the streams of further futures from those that the world forks from the same seed.
const AGAIN: u64 = 1 << 20;

/// Whether no agents overlap from the present of a scenario on.
pub(super) fn stays_clear(scenario: &Scenario) -> bool {
    are_clear(&scenario.log[scenario.now..], 0, scenario.dt)
}

/// Whether no agents overlap in these frames, which begin so many frames after the present; looked
/// at at the instants at which [`through_time`] does, and at the end.
fn are_clear(frames: &[Frame], since: usize, dt: f64) -> bool {
    let stride = (LOOK_S / dt).round().max(1.0) as usize;
    let first = since.next_multiple_of(stride) - since;
    let looked_at = frames.iter().skip(first).step_by(stride);
    let mut looked_at = looked_at.chain(frames.last());
    looked_at.all(|frame| overlaps_in(frame) == 0)
}

/// Futures in which the world drives all agents, including the ego.
pub(super) fn free(
    world: &dyn WorldModel,
    scene: &Scenario,
    n_futures: usize,
    seed: Seed,
) -> Result<Vec<Scenario>, GenerateError> {
    let start = Start {
        scene: scene.present(),
        n_futures,
        seed,
    };
    let rollouts = imagine(world, &[start], None, JUDGED_S + MOMENTS_S)?;
    Ok(rollouts.iter().map(|r| with_future(scene, r)).collect())
}

/// Futures in which the ego is steered at first and then driven by the world; only those in which
/// it does not collide.
pub(super) fn steered(
    world: &dyn WorldModel,
    scene: &Scenario,
    drive: &PlannedDrive,
    seed: Seed,
) -> Result<Vec<Scenario>, GenerateError> {
    let start = Start {
        scene: scene.present(),
        n_futures: FUTURES,
        seed: seed.fork(0),
    };
    let rollouts = imagine(world, &[start], Some(drive), drive.seconds())?;
    let mut takes: Vec<Scenario> = rollouts.iter().map(|r| with_future(scene, r)).collect();
    takes.retain(|take| !meets_somebody(take));
    let starts = takes.iter().zip(1..).map(|(take, i)| Start {
        scene: take.at(take.log.len() - 1),
        n_futures: 1,
        seed: seed.fork(i),
    });
    let starts: Vec<Start<'_>> = starts.collect();
    if starts.is_empty() {
        return Ok(Vec::new());
    }
    let rest = JUDGED_S + MOMENTS_S - drive.seconds();
    let rollouts = imagine(world, &starts, None, rest)?;
    let takes = takes.iter().zip(&rollouts);
    Ok(takes
        .map(|(take, rollout)| with_future(take, rollout))
        .collect())
}

/// The first instant of any of these futures at which `holds` is true, as the present of that
/// future, and in seconds from the scene; of two at the same time the first future counts.
pub(super) fn moment(
    mut takes: Vec<Scenario>,
    holds: impl Fn(&Scenario) -> bool,
) -> Option<(Scenario, f64)> {
    let dt = takes.first()?.dt;
    let steps = |seconds: f64| (seconds / dt).round() as usize;
    let found = (0..=steps(MOMENTS_S)).find_map(|now| {
        takes.iter_mut().position(|take| {
            take.now = now;
            holds(take)
        })
    })?;
    let mut take = takes.swap_remove(found);
    let seconds = take.now as f64 * dt;
    let cut = take.now.saturating_sub(steps(HISTORY_S));
    take.log.drain(..cut);
    take.now -= cut;
    Some((take, seconds))
}

/// Continues the rollout until there are this many seconds after the present: by the first of a few
/// futures in which no agents overlap, or by the first.
pub(super) fn extend(
    world: &dyn WorldModel,
    scenario: &mut Scenario,
    seconds: f64,
    seed: Seed,
) -> Result<(), GenerateError> {
    let wanted = (seconds / scenario.dt).round() as usize;
    let missing = wanted.saturating_sub(scenario.future().len());
    if missing == 0 {
        return Ok(());
    }
    let since = scenario.log.len() - scenario.now;
    let mut first = None;
    for attempt in 0..FUTURES as u64 {
        let start = Start {
            scene: scenario.at(scenario.log.len() - 1),
            n_futures: 1,
            seed: if attempt == 0 {
                seed
            } else {
                seed.fork(AGAIN + attempt)
            },
        };
        let rollouts = imagine(world, &[start], None, missing as f64 * scenario.dt)?;
        let future = rollouts.first().map_or(&[][..], Rollout::imagined);
        let is_clear = are_clear(future, since, scenario.dt);
        if is_clear || first.is_none() {
            first = Some(future.to_vec());
        }
        if is_clear {
            break;
        }
    }
    scenario.log.extend(first.into_iter().flatten());
    Ok(())
}

fn imagine(
    world: &dyn WorldModel,
    starts: &[Start<'_>],
    drive: Option<&PlannedDrive>,
    seconds: f64,
) -> Result<Vec<Rollout>, GenerateError> {
    let config = SimulateConfig {
        seconds,
        made_scenes: true,
        ..SimulateConfig::default()
    };
    let result = match drive {
        Some(drive) => simulate(world, starts, Some(&mut Steered::new(drive)), &config),
        None => simulate(world, starts, None, &config),
    };
    result.map_err(GenerateError::Rollout)
}

fn with_future(scene: &Scenario, rollout: &Rollout) -> Scenario {
    let mut take = scene.clone();
    take.log.extend_from_slice(rollout.imagined());
    take
}

/// True if the ego's box overlaps another in some frame.
fn meets_somebody(take: &Scenario) -> bool {
    take.log.iter().any(|frame| {
        let ego = frame.agent(take.ego);
        ego.is_some_and(|ego| gump_metrics::overlapping(frame, ego).next().is_some())
    })
}

#[cfg(test)]
mod tests {
    use gump_geometry::Pose;
    use gump_rollout::{BoxError, Session};
    use gump_scene::{AgentState, fixture};

    use super::*;

    /// Ten seconds at 2 m/s from x.
    fn take(x: f64) -> Scenario {
        let text = format!("ego vehicle 0: {x},0 velocity 2,0\nhistory 0 future 10 dt 0.1");
        fixture::scenario(&text).unwrap()
    }

    fn beyond(x: f64) -> impl Fn(&Scenario) -> bool {
        move |take| take.present().ego_now().state.pose.position.x > x
    }

    /// A world in which all agents stand still, except that with one seed all move to one place.
    struct Fickle(Seed);

    struct FickleSession {
        frame: Frame,
        gathers: bool,
    }

    impl WorldModel for Fickle {
        fn name(&self) -> &str {
            "fickle"
        }

        fn open(&self, starts: &[Start<'_>]) -> Result<Box<dyn Session + '_>, BoxError> {
            Ok(Box::new(FickleSession {
                frame: starts[0].scene.now().clone(),
                gathers: starts[0].seed == self.0,
            }))
        }
    }

    impl Session for FickleSession {
        fn dt(&self) -> f64 {
            0.5
        }

        fn step(&mut self, _: Option<&[AgentState]>) -> Result<Vec<Frame>, BoxError> {
            let mut agents = self.frame.agents().to_vec();
            if self.gathers {
                agents
                    .iter_mut()
                    .for_each(|agent| agent.state.pose = Pose::IDENTITY);
            }
            Ok(vec![Frame::new(agents, Vec::new())])
        }

        fn replace(&mut self, _: usize, start: Start<'_>) -> Result<(), BoxError> {
            self.frame = start.scene.now().clone();
            Ok(())
        }
    }

    #[test]
    fn a_future_without_overlaps_goes_on() {
        let text = "ego vehicle 0: 0,0\nagent vehicle 1: 20,0\nhistory 0 future 1 dt 0.1";
        let scene = fixture::scenario(text).unwrap();
        for seed in [Seed(3), Seed(4)] {
            let mut longer = scene.clone();
            extend(&Fickle(Seed(3)), &mut longer, 4.0, seed).unwrap();
            assert_eq!(longer.future().len(), 40);
            assert!(stays_clear(&longer), "{seed:?}");
        }
        let gathered = with_overlap(&scene);
        assert!(!stays_clear(&gathered));
    }

    #[test]
    fn a_continuation_is_looked_at_when_the_whole_is() {
        let text = "ego vehicle 0: 0,0\nagent vehicle 1: 20,0\nhistory 0 future 2 dt 0.1";
        let scene = fixture::scenario(text).unwrap();
        let (clear, gathered) = (scene.log[0].clone(), with_overlap(&scene));
        let overlap = gathered.log[gathered.log.len() - 1].clone();
        for n in 1..12 {
            for k in 0..n {
                let mut whole = scene.clone();
                let mut future = vec![clear.clone(); n];
                future[k] = overlap.clone();
                whole.log.extend_from_slice(&future);
                let is_clear = are_clear(&future, scene.log.len() - scene.now, scene.dt);
                assert_eq!(is_clear, stays_clear(&whole), "frame {k} of {n}");
            }
        }
    }

    /// The scene with a last frame in which all are in one place.
    fn with_overlap(scene: &Scenario) -> Scenario {
        let mut gathered = scene.clone();
        let last = scene.log[scene.now].agents().iter().map(|agent| {
            let mut agent = *agent;
            agent.state.pose = Pose::IDENTITY;
            agent
        });
        gathered.log.push(Frame::new(last.collect(), Vec::new()));
        gathered
    }

    #[test]
    fn the_earliest_moment_of_any_future_is_the_present() {
        let (found, seconds) = moment(vec![take(0.0), take(1.0)], beyond(3.1)).unwrap();
        assert!((seconds - 1.1).abs() < 1e-9, "{seconds}");
        // The second is there after 1.1 s, of which one is kept.
        assert_eq!((found.now, found.log.len()), (10, 100));
        let x = found.present().ego_now().state.pose.position.x;
        assert!((x - 3.2).abs() < 1e-9, "{x}");
        assert!(moment(vec![take(0.0)], beyond(4.1)).is_none());
        assert!(moment(Vec::new(), beyond(0.0)).is_none());
    }

    #[test]
    fn somebody_in_the_way_is_met() {
        let scene = |y: f64| {
            let text = format!("ego vehicle 0: 0,0 velocity 2,0\nagent vehicle 1: 12,{y}");
            fixture::scenario(&text).unwrap()
        };
        assert!(meets_somebody(&scene(0.0)) && !meets_somebody(&scene(5.0)));
    }
}
