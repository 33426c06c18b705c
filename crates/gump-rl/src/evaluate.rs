//! Evaluation of policies: every scenario once per seed, with the columns of the paper's table.

use std::sync::Arc;

use gump_metrics::{Interval, intervals_of_groups};
use gump_rollout::{SimulateConfig, fill};
use gump_scene::{Rollout, Seed};
use rand::Rng as _;

use crate::{
    Actor, Autoreset, DrivingEnv, EnvConfig, EpisodeStart, Outcome, PreparedScenario, RlError,
    TrafficSource, VectorEnv,
};

/// Mean progress of the logged drivers in the paper's test set, metres, by which progress is
/// divided.
///
/// Source: reproduces the paper's scores from its other columns.
pub const LOGGED_PROGRESS: f64 = 62.0;

/// Resamples of a bootstrap; the ends of an interval then vary by about 2 % of its width.
const N_RESAMPLES: usize = 2000;

/// The driver.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum EvaluatedPolicy<'a> {
    /// A policy, by the modes of its distributions.
    Learned(&'a Actor),
    /// The log, as far as the dynamics can follow it: an oracle.
    Expert,
    /// Uniformly random actions.
    Random,
    /// One constant action. Shape: `[action_len]`.
    Constant(&'a [f32]),
}

/// The outcome of one episode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpisodeResult {
    /// Index of the scenario.
    pub scenario: usize,
    /// Index of the seed.
    pub repeat: usize,
    /// True if the ego's box overlapped another.
    pub collided: bool,
    /// True if it did so other than standing or hit from behind.
    pub at_fault: bool,
    /// True if a corner of the ego's box left the road.
    pub off_road: bool,
    /// Metres along the route.
    pub progress: f64,
    /// True if no comfort bound was exceeded.
    pub comfortable: bool,
    /// Number of steps.
    pub steps: usize,
}

/// The paper's columns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Columns {
    /// Share of safe episodes times the mean of their progress over 62 m and their comfort.
    pub score: f64,
    /// Share of episodes with a collision.
    pub collision_rate: f64,
    /// Share of episodes with a collision in which the ego neither stood nor was hit from behind.
    pub at_fault_rate: f64,
    /// Share of episodes that left the road.
    pub offroad_rate: f64,
    /// Mean progress of safe episodes, metres; `None` if there is none.
    pub progress: Option<f64>,
    /// Share of safe episodes in which no comfort bound was exceeded; `None` if there is none.
    pub comfort: Option<f64>,
}

impl EpisodeResult {
    fn new(scenario: usize, repeat: usize, outcome: &Outcome) -> Self {
        let totals = &outcome.totals;
        Self {
            scenario,
            repeat,
            collided: totals.collided,
            at_fault: totals.at_fault,
            off_road: totals.off_road,
            progress: totals.progress,
            comfortable: !totals.uncomfortable,
            steps: outcome.steps,
        }
    }

    /// True if the ego neither collided nor left the road.
    pub fn is_safe(&self) -> bool {
        !self.collided && !self.off_road
    }

    /// 0 if not safe, else the mean of progress over [`LOGGED_PROGRESS`], which may exceed 1, and
    /// comfort.
    pub fn score(&self) -> f64 {
        if !self.is_safe() {
            return 0.0;
        }
        let comfort = f64::from(u8::from(self.comfortable));
        0.5 * (self.progress / LOGGED_PROGRESS + comfort)
    }
}

impl Columns {
    /// Over episodes; `None` if there are none.
    pub fn of(drives: &[EpisodeResult]) -> Option<Self> {
        let n = drives.len() as f64;
        let share = |happened: fn(&EpisodeResult) -> bool| {
            drives.iter().filter(|drive| happened(drive)).count() as f64 / n
        };
        let safe: Vec<&EpisodeResult> = drives.iter().filter(|drive| drive.is_safe()).collect();
        let of_safe = |value: fn(&EpisodeResult) -> f64| {
            let sum: f64 = safe.iter().map(|drive| value(drive)).sum();
            (!safe.is_empty()).then(|| sum / safe.len() as f64)
        };
        (!drives.is_empty()).then(|| Self {
            score: drives.iter().map(EpisodeResult::score).sum::<f64>() / n,
            collision_rate: share(|drive| drive.collided),
            at_fault_rate: share(|drive| drive.at_fault),
            offroad_rate: share(|drive| drive.off_road),
            progress: of_safe(|drive| drive.progress),
            comfort: of_safe(|drive| f64::from(u8::from(drive.comfortable))),
        })
    }
}

/// The episodes of an evaluation.
#[derive(Clone, Debug, PartialEq)]
pub struct Episodes {
    /// Indices of the scenarios to drive.
    pub scenarios: Vec<usize>,
    /// Drives of each, in other traffic of the same world.
    pub repeats: usize,
    /// Source of all randomness: that of an episode depends on this seed, the index of the scenario
    /// and the repeat only, so an evaluation in parts equals one in one go.
    pub seed: Seed,
}

impl Episodes {
    /// All of `n` scenarios.
    pub fn all(n: usize, repeats: usize, seed: Seed) -> Self {
        Self {
            scenarios: (0..n).collect(),
            repeats,
            seed,
        }
    }

    /// The start of a drive of one of them.
    fn start(&self, scenario: usize, repeat: usize) -> EpisodeStart {
        EpisodeStart {
            scenario,
            seed: self.seed.fork(scenario as u64).fork(repeat as u64),
        }
    }
}

/// Drives these episodes, `config.n_envs` in parallel.
///
/// All drivers are compared in the same traffic, of which worlds simulate all agents whatever
/// [`EnvConfig::nearest`] is. The results are in the order of the scenarios, with the repeats of
/// one together.
///
/// # Errors
/// Errors of the environment; [`RlError::Shape`] for a driver with other observations or actions.
pub fn evaluate(
    prepared: &Arc<[PreparedScenario]>,
    traffic: TrafficSource<'_>,
    config: &EnvConfig,
    driver: EvaluatedPolicy<'_>,
    episodes: &Episodes,
) -> Result<Vec<EpisodeResult>, RlError> {
    let of_scenario = |&scenario: &usize| {
        let repeats = 0..episodes.repeats;
        repeats.map(move |repeat| (scenario, repeat))
    };
    let all: Vec<_> = episodes.scenarios.iter().flat_map(of_scenario).collect();
    let mut drives = Vec::with_capacity(all.len());
    for episodes_now in all.chunks(config.n_envs.max(1)) {
        let config = EnvConfig {
            n_envs: episodes_now.len(),
            autoreset: Autoreset::SameStep,
            nearest: None,
            ..*config
        };
        let mut env = DrivingEnv::new(Arc::clone(prepared), traffic, config)?;
        let start = |&(scenario, repeat): &(usize, usize)| episodes.start(scenario, repeat);
        let starts: Vec<EpisodeStart> = episodes_now.iter().map(start).collect();
        let outcomes = drive(&mut env, driver, &starts, &mut |_| Ok(()))?;
        let ended = episodes_now.iter().zip(&outcomes);
        drives
            .extend(ended.map(|(&(scenario, repeat), o)| EpisodeResult::new(scenario, repeat, o)));
    }
    Ok(drives)
}

/// The first drive of a scenario among those of an evaluation, with all agents, at the time step of the
/// scenario: to be looked at.
///
/// `scenario` is an index of `prepared`, `seed` that of [`Episodes`]. The ego drives as in [`evaluate`]; the
/// rollout ends where its episode does.
///
/// # Errors
/// As [`evaluate`].
pub fn recorded_drive(
    prepared: &Arc<[PreparedScenario]>,
    traffic: TrafficSource<'_>,
    config: &EnvConfig,
    driver: EvaluatedPolicy<'_>,
    (scenario, seed): (usize, Seed),
) -> Result<Rollout, RlError> {
    let config = EnvConfig {
        n_envs: 1,
        // The last frame of the episode is there until the next begins.
        autoreset: Autoreset::Disabled,
        nearest: None,
        ..*config
    };
    let episodes = Episodes {
        scenarios: vec![scenario],
        repeats: 1,
        seed,
    };
    let mut env = DrivingEnv::new(Arc::clone(prepared), traffic, config)?;
    let mut rollout = None;
    let mut record = |env: &DrivingEnv<'_>| {
        let (Some(frame), Some(prepared)) = (env.frame(0), prepared.get(scenario)) else {
            return Ok(());
        };
        let Some(rollout) = &mut rollout else {
            rollout = Some(Rollout::begin(prepared.scenario().present()));
            return Ok(());
        };
        let frames = fill(
            rollout.last(),
            &frame,
            prepared.dt(),
            &SimulateConfig::default(),
        );
        let frames = frames.map_err(|_| RlError::TimeStep {
            step: prepared.dt(),
            frames: rollout.dt(),
        })?;
        frames.into_iter().for_each(|frame| rollout.push(frame));
        Ok(())
    };
    drive(
        &mut env,
        driver,
        &[episodes.start(scenario, 0)],
        &mut record,
    )?;
    rollout.ok_or(RlError::NotReset)
}

/// Drives every row to the end of its first episode; `visit` sees the environment at the start and after
/// every step.
fn drive(
    env: &mut DrivingEnv<'_>,
    driver: EvaluatedPolicy<'_>,
    starts: &[EpisodeStart],
    visit: &mut dyn FnMut(&DrivingEnv<'_>) -> Result<(), RlError>,
) -> Result<Vec<Outcome>, RlError> {
    env.reset_to(starts)?;
    visit(env)?;
    let (n, o, a) = (env.n_envs(), env.observation_len(), env.action_len());
    // Seeds that no world forks from the start of an episode.
    let of_driver = |start: &EpisodeStart| start.seed.fork(u64::MAX).rng();
    let mut rngs: Vec<_> = starts.iter().map(of_driver).collect();
    let mut actions = vec![0.0; n * a];
    let mut outcomes: Vec<Option<Outcome>> = vec![None; n];
    while outcomes.contains(&None) {
        match driver {
            EvaluatedPolicy::Learned(actor) => {
                check("observations", actor.observation_len(), o)?;
                check("actions", actor.action_len(), a)?;
                actions = actor.modes(env.observations());
            }
            EvaluatedPolicy::Expert => env.expert_actions(&mut actions)?,
            EvaluatedPolicy::Random => {
                for (action, rng) in actions.chunks_exact_mut(a).zip(&mut rngs) {
                    action.fill_with(|| rng.random_range(-1.0..=1.0));
                }
            }
            EvaluatedPolicy::Constant(action) => {
                check("actions", action.len(), a)?;
                actions = action.repeat(n);
            }
        }
        env.step(&actions)?;
        visit(env)?;
        for (row, outcome) in env.finished() {
            outcomes[*row].get_or_insert(*outcome);
        }
    }
    Ok(outcomes.into_iter().flatten().collect())
}

fn check(what: &'static str, expected: usize, found: usize) -> Result<(), RlError> {
    if expected == found {
        Ok(())
    } else {
        Err(RlError::Shape {
            what,
            expected,
            found,
        })
    }
}

/// Mean score of every scenario over its drives, in the order of the scenarios.
pub fn score_by_scenario(drives: &[EpisodeResult]) -> Vec<f64> {
    let n = drives.iter().map(|drive| drive.scenario + 1).max();
    let mut sums = vec![(0.0, 0.0); n.unwrap_or(0)];
    for drive in drives {
        let (sum, n) = &mut sums[drive.scenario];
        *sum += drive.score();
        *n += 1.0;
    }
    let driven = sums.into_iter().filter(|(_, n)| *n > 0.0);
    driven.map(|(sum, n)| sum / n).collect()
}

/// The mean score of a group of policies that differ in their seeds, or the difference of the means
/// of two groups, with its interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// The mean.
    pub mean: f64,
    /// Its 95 % interval; `None` for fewer than two scenarios.
    pub interval: Option<Interval>,
    /// Whether the interval resamples policies as well as scenarios, which takes two policies or
    /// more in each group.
    pub over_policies: bool,
    /// Number of policies of the smallest group.
    pub n_policies: usize,
}

/// The mean of `scores`, by policy and scenario, all of them on the same scenarios. `None` if there
/// is no score, or policies were tested on different numbers of scenarios.
///
/// The interval is a bootstrap of 2000 resamples, each of which draws scenarios and policies with
/// replacement, independently of each other (Owen 2007, "The pigeonhole bootstrap"); of `n` policies
/// it draws `n - 1`, so that the variance over few of them is not too low by a share of `1 / n`
/// (Efron 1982, "The Jackknife, the Bootstrap and Other Resampling Plans", section 5.3).
pub fn estimate(scores: &[Vec<f64>], seed: Seed) -> Option<Estimate> {
    resampled(&[(scores, 1.0)], seed)
}

/// The mean of `a` less that of `b`, as in [`estimate`]; scenarios are paired, policies are drawn
/// from each group independently.
pub fn estimate_difference(a: &[Vec<f64>], b: &[Vec<f64>], seed: Seed) -> Option<Estimate> {
    resampled(&[(a, 1.0), (b, -1.0)], seed)
}

/// A weighted sum of the means of groups.
fn resampled(groups: &[(&[Vec<f64>], f64)], seed: Seed) -> Option<Estimate> {
    let n = groups.first()?.0.first()?.len();
    let fits = |(scores, _): &(&[Vec<f64>], f64)| {
        !scores.is_empty() && scores.iter().all(|policy| policy.len() == n)
    };
    if n == 0 || !groups.iter().all(fits) {
        return None;
    }
    let n_policies = groups.iter().map(|(scores, _)| scores.len()).min()?;
    let over_policies = n_policies > 1;
    let of = |scenarios: &[usize], policies: &[&[usize]]| -> f64 {
        let groups = groups.iter().zip(policies);
        let means = groups.map(|((scores, weight), policies)| {
            let of_policy = |&p: &usize| scenarios.iter().map(|&s| scores[p][s]).sum::<f64>();
            weight * policies.iter().map(of_policy).sum::<f64>() / policies.len() as f64
        });
        means.sum::<f64>() / scenarios.len() as f64
    };
    let of_groups = groups.iter().map(|(scores, _)| scores.len());
    let sizes: Vec<usize> = std::iter::once(n).chain(of_groups).collect();
    let everyone: Vec<Vec<usize>> = sizes.iter().map(|&n| (0..n).collect()).collect();
    let all_policies: Vec<&[usize]> = everyone[1..].iter().map(Vec::as_slice).collect();
    // The first of `drawn` are scenarios, the others policies of each group.
    let statistic = |drawn: &[Vec<usize>]| {
        let policies: Vec<&[usize]> = match over_policies {
            true => drawn[1..].iter().map(|drawn| &drawn[1..]).collect(),
            false => all_policies.clone(),
        };
        vec![Some(of(&drawn[0], &policies))]
    };
    let found = match n {
        1 => Vec::new(),
        _ => intervals_of_groups(&sizes, N_RESAMPLES, seed, statistic),
    };
    Some(Estimate {
        mean: of(&everyone[0], &all_policies),
        interval: found.first().copied().flatten(),
        over_policies,
        n_policies,
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use super::*;
    use crate::sac::SacConfig;
    use gump_rollout::worlds::Idm;
    use gump_scene::{Scenario, fixture};

    fn drive(
        scenario: usize,
        collided: bool,
        off_road: bool,
        progress: f64,
        comfortable: bool,
    ) -> EpisodeResult {
        EpisodeResult {
            scenario,
            repeat: 0,
            collided,
            at_fault: collided && scenario == 1,
            off_road,
            progress,
            comfortable,
            steps: 16,
        }
    }

    #[test]
    fn columns_by_hand() {
        let drives = [
            drive(0, false, false, 31.0, true),
            drive(0, false, false, 93.0, false),
            drive(1, true, false, 40.0, true),
            drive(2, false, true, 10.0, true),
        ];
        let columns = Columns::of(&drives).unwrap();
        assert_eq!((columns.collision_rate, columns.offroad_rate), (0.25, 0.25));
        assert_eq!(columns.at_fault_rate, 0.25);
        assert_eq!((columns.progress, columns.comfort), (Some(62.0), Some(0.5)));
        // From the rates: half of the episodes are safe.
        assert!((columns.score - 0.5 * 0.5 * (1.0 + 0.5)).abs() < 1e-9);
        assert_eq!(score_by_scenario(&drives), [0.75, 0.0, 0.0]);
        assert!(Columns::of(&[]).is_none());
        let failed = Columns::of(&drives[2..]).unwrap();
        assert_eq!((failed.score, failed.progress), (0.0, None));
    }

    #[test]
    fn differences_are_paired() {
        let a: Vec<f64> = (0..50).map(f64::from).collect();
        let b: Vec<f64> = a.iter().map(|x| x - 0.5).collect();
        let [first, second] = [&a, &b].map(std::slice::from_ref);
        let one = estimate_difference(first, second, Seed(0)).unwrap();
        let interval = one.interval.unwrap();
        assert_eq!((one.mean, interval.low, interval.high), (0.5, 0.5, 0.5));
        assert!(!one.over_policies);
        assert!(estimate_difference(&[a], &[b[1..].to_vec()], Seed(0)).is_none());
        assert!(estimate(&[], Seed(0)).is_none());
        let single = estimate(&[vec![1.0]], Seed(0)).unwrap();
        assert_eq!((single.mean, single.interval), (1.0, None));
    }

    /// Of means of rows and columns without interaction the variance is known: that of the rows
    /// over their number plus that of the columns over theirs; of few rows it is estimated without
    /// bias.
    #[test]
    fn intervals_are_over_scenarios_and_policies() {
        let of_policy = |p: usize| 0.3 * (p % 2) as f64;
        let of_scenario = |s: usize| 0.2 * (s % 2) as f64;
        let policy = |p| (0..400).map(|s| of_policy(p) + of_scenario(s)).collect();
        let group = |n: usize| (0..n).map(policy).collect::<Vec<Vec<f64>>>();
        let half = |found: Estimate| {
            let interval = found.interval.unwrap();
            (interval.high - interval.low) / 2.0
        };
        let of_rows = |n: f64| 0.15f64.powi(2) / (n - 1.0);
        let expected = |n: f64| 1.96 * (of_rows(n) + 0.1f64.powi(2) / 400.0).sqrt();
        let ten = estimate(&group(10), Seed(1)).unwrap();
        assert!((ten.mean - 0.25).abs() < 1e-9 && ten.over_policies);
        assert!(
            (half(ten) / expected(10.0) - 1.0).abs() < 0.1,
            "{}",
            half(ten)
        );
        // Scenarios are paired, so only the policies are left in a difference.
        let difference = estimate_difference(&group(10), &group(10), Seed(1)).unwrap();
        assert_eq!(difference.mean, 0.0);
        let of_both = 1.96 * (2.0 * of_rows(10.0)).sqrt();
        assert!((half(difference) / of_both - 1.0).abs() < 0.1);
        let one = estimate(&group(1), Seed(1)).unwrap();
        assert!(!one.over_policies && half(one) < 0.012);
        assert_eq!((ten.n_policies, one.n_policies), (10, 1));
    }

    /// Empty roads of different lengths behind the ego, a recorded ego of constant speed.
    fn prepared() -> Arc<[PreparedScenario]> {
        let scene = |speed: f64| -> Scenario {
            let text = format!(
                "lane 1: 0,0 400,0 speed 15\nroute 1\nego vehicle 0: 10,0 velocity {speed},0"
            );
            fixture::scenario(&text).unwrap()
        };
        PreparedScenario::prepare([4.0, 8.0, 12.0].map(scene), 0.5).unwrap()
    }

    fn run(driver: EvaluatedPolicy<'_>, n_envs: usize) -> Vec<EpisodeResult> {
        let config = EnvConfig {
            n_envs,
            ..EnvConfig::default()
        };
        let world = Idm::default();
        let traffic = TrafficSource::World(&world);
        let episodes = Episodes::all(3, 2, Seed(3));
        evaluate(&prepared(), traffic, &config, driver, &episodes).unwrap()
    }

    #[test]
    fn every_scenario_is_driven_once_per_repeat() {
        let drives = run(EvaluatedPolicy::Expert, 4);
        let order: Vec<_> = drives.iter().map(|d| (d.scenario, d.repeat)).collect();
        assert_eq!(order, [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)]);
        for drive in &drives {
            let expected = [32.0, 64.0, 96.0][drive.scenario];
            assert!(
                (drive.progress - expected).abs() < 0.01 * expected,
                "{drive:?}"
            );
            assert!(drive.is_safe() && drive.comfortable, "{drive:?}");
        }
    }

    #[test]
    fn episodes_do_not_depend_on_who_drives_beside_them() {
        let config = SacConfig {
            hidden: vec![8],
            ..SacConfig::default()
        };
        let observation = EnvConfig::default().observation.len();
        let actor = Actor::new(&config, observation, 2, Seed(1));
        assert_eq!(
            run(EvaluatedPolicy::Learned(&actor), 6),
            run(EvaluatedPolicy::Learned(&actor), 1)
        );
        let still = run(EvaluatedPolicy::Constant(&[-1.0, 0.0]), 6);
        assert!(still.iter().all(|drive| drive.progress < 20.0));
        assert_eq!(
            run(EvaluatedPolicy::Random, 6),
            run(EvaluatedPolicy::Random, 1)
        );
    }

    #[test]
    fn policies_of_another_shape_are_refused() {
        let actor = Actor::new(&SacConfig::default(), 3, 2, Seed(1));
        let config = EnvConfig::default();
        let driver = EvaluatedPolicy::Learned(&actor);
        let episodes = Episodes::all(3, 1, Seed(0));
        let result = evaluate(&prepared(), TrafficSource::Log, &config, driver, &episodes);
        assert!(matches!(result, Err(RlError::Shape { expected: 3, .. })));
    }
}
