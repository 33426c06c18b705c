//! Comparison of policies with confidence intervals, and the sample size needed for significance.
//!
//! [`value_policies`] rolls policies out in futures of a world; [`Comparison`] compares two lists
//! of scores of the same scenes, from any source.

use gump_metrics::{Interval, Reward, interval};
use gump_rollout::{BoxError, Policy, SimulateConfig, Start, WorldModel, simulate};
use gump_scene::{SceneState, Seed};

/// Settings of the evaluation of policies.
#[derive(Clone, Debug, PartialEq)]
pub struct ValueConfig {
    /// Futures of every scene, > 0.
    pub n_futures: usize,
    /// The seed; all policies meet the same random numbers.
    pub seed: Seed,
    /// Horizon and time step.
    pub simulate: SimulateConfig,
}

impl Default for ValueConfig {
    /// Four futures of 4 s, as the paper's planner has them.
    fn default() -> Self {
        Self {
            n_futures: 4,
            seed: Seed(0),
            simulate: SimulateConfig {
                seconds: 4.0,
                ..SimulateConfig::default()
            },
        }
    }
}

/// The value of a policy.
#[derive(Clone, Debug, PartialEq)]
pub struct PolicyValue {
    /// Its name.
    pub name: String,
    /// The reward of every future, `[scene][future]`; never empty.
    pub scores: Vec<Vec<f64>>,
    /// Mean over scenes and futures.
    pub mean: f64,
    /// 95 % interval of the mean over scenes; `None` for a single scene.
    pub interval: Option<Interval>,
}

/// Rolls every policy out in futures of every scene and computes its value; best first, ties in the
/// given order.
///
/// Future *k* of a scene has the same random numbers for every policy.
///
/// # Errors
/// Errors of the world or a policy; a state that is not finite is one.
pub fn value_policies(
    world: &dyn WorldModel,
    scenes: &[SceneState<'_>],
    policies: &mut [&mut dyn Policy],
    reward: &Reward,
    config: &ValueConfig,
) -> Result<Vec<PolicyValue>, BoxError> {
    let n = config.n_futures;
    let starts: Vec<Start<'_>> = scenes
        .iter()
        .enumerate()
        .map(|(i, &scene)| Start {
            scene,
            n_futures: n,
            seed: config.seed.fork(i as u64),
        })
        .collect();
    let mut values = Vec::with_capacity(policies.len());
    for policy in policies {
        let rollouts = simulate(world, &starts, Some(&mut **policy), &config.simulate)?;
        let scores: Vec<Vec<f64>> = rollouts
            .chunks(n.max(1))
            .zip(scenes)
            .map(|(futures, scene)| {
                let scores = reward.over_rollouts(futures, scene.ego);
                scores.into_iter().map(|score| score.total).collect()
            })
            .collect();
        let means: Vec<f64> = scores.iter().map(|futures| mean(futures)).collect();
        values.push(PolicyValue {
            name: policy.name().to_owned(),
            mean: mean(&means),
            interval: interval(&means, config.seed),
            scores,
        });
    }
    values.sort_by(|a, b| b.mean.total_cmp(&a.mean));
    Ok(values)
}

/// The difference between two lists of scores of the same scenes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Comparison {
    /// Mean of the first minus that of the second.
    pub difference: f64,
    /// Its 95 % interval over scenes.
    pub interval: Interval,
    /// Variance of the difference between scenes, without that between futures.
    pub between_scenes: f64,
    /// Variance of the difference between futures of a scene.
    pub within_scenes: f64,
}

/// Number of standard errors of a difference that is detected with power 80 %: 1.96 for a type I
/// error of 5 %, 0.84 for a type II error of 20 %.
const TOLD: f64 = 1.96 + 0.84;

impl Comparison {
    /// Compares `[scene][future]` with the same scenes and futures of another; `None` for fewer than
    /// two scenes, a scene without futures, or lists of different shapes.
    pub fn new(a: &[Vec<f64>], b: &[Vec<f64>], seed: Seed) -> Option<Self> {
        let shapes = |x: &[Vec<f64>]| x.iter().map(Vec::len).collect::<Vec<_>>();
        if shapes(a) != shapes(b) || a.iter().any(Vec::is_empty) {
            return None;
        }
        let pairs: Vec<Vec<f64>> = a
            .iter()
            .zip(b)
            .map(|(a, b)| a.iter().zip(b).map(|(a, b)| a - b).collect())
            .collect();
        let means: Vec<f64> = pairs.iter().map(|futures| mean(futures)).collect();
        let interval = interval(&means, seed)?;
        let within: Vec<f64> = pairs.iter().filter_map(|p| variance(p)).collect();
        let within_scenes = if within.is_empty() {
            0.0
        } else {
            mean(&within)
        };
        let futures = pairs.iter().map(Vec::len).sum::<usize>() as f64 / pairs.len() as f64;
        // The means of scenes vary by chance as well, by less the more futures there are.
        let all = variance(&means).unwrap_or(0.0);
        Some(Self {
            difference: mean(&means),
            interval,
            between_scenes: (all - within_scenes / futures).max(0.0),
            within_scenes,
        })
    }

    /// Compares one score per scene.
    pub fn of_scenes(a: &[f64], b: &[f64], seed: Seed) -> Option<Self> {
        let alone = |x: &[f64]| x.iter().map(|&score| vec![score]).collect::<Vec<_>>();
        Self::new(&alone(a), &alone(b), seed)
    }

    /// True if the interval excludes 0.
    pub fn is_sure(&self) -> bool {
        self.interval.low > 0.0 || self.interval.high < 0.0
    }

    /// The number of scenes, with `n_futures` futures each, that would detect the difference with a
    /// power of 80 %, if it has the observed size; `None` if it is 0.
    ///
    /// Source: sample size of a paired comparison of means, two-sided at 5 %, power 80 %.
    pub fn scenes_needed(&self, n_futures: usize) -> Option<usize> {
        let variance = self.between_scenes + self.within_scenes / n_futures.max(1) as f64;
        let needed = (TOLD / self.difference).powi(2) * variance;
        needed.is_finite().then(|| (needed.ceil() as usize).max(2))
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn variance(values: &[f64]) -> Option<f64> {
    let middle = mean(values);
    let squares: f64 = values.iter().map(|v| (v - middle).powi(2)).sum();
    (values.len() > 1).then(|| squares / (values.len() - 1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_metrics::{Collision, Discomfort, Metric, OffRoad, Progress, RedLight, Reduce};
    use gump_rollout::Command;
    use gump_rollout::worlds::{ConstantVelocity, IdmConfig, idm_acceleration};
    use gump_scene::{Agent, fixture};

    /// Holds an acceleration unconditionally.
    struct Holds(&'static str, f64);

    impl Policy for Holds {
        fn name(&self) -> &str {
            self.0
        }

        fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError> {
            let command = Command::Drive {
                acceleration: self.1,
                curvature: 0.0,
            };
            Ok(vec![command; scenes.len()])
        }
    }

    /// Keeps the law's distance to the only other agent, which is ahead on a road along the x-axis.
    struct Careful;

    impl Policy for Careful {
        fn name(&self) -> &str {
            "careful"
        }

        fn act(&mut self, scenes: &[SceneState<'_>]) -> Result<Vec<Command>, BoxError> {
            let config = IdmConfig::default();
            let commands = scenes.iter().map(|scene| {
                let (ego, other) = (scene.ego_now(), scene.now().agents()[1]);
                let apart = other.state.pose.position.x - ego.state.pose.position.x;
                let gap = apart - (ego.length + other.length) / 2.0;
                let (speed, lead) = (ego.state.speed(), other.state.speed());
                Command::Drive {
                    acceleration: idm_acceleration(&config, speed, 12.0, gap, lead),
                    curvature: 0.0,
                }
            });
            Ok(commands.collect())
        }
    }

    /// The share of frames that keep all comfort bounds.
    struct Comfort;

    impl Metric for Comfort {
        fn name(&self) -> &'static str {
            "comfort"
        }

        fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
            Discomfort.at(scene, agent).map(|broken| 1.0 - broken)
        }

        fn reduce(&self) -> Reduce {
            Reduce::Mean
        }
    }

    #[test]
    fn policies_are_ranked_by_what_they_come_to() {
        let street = |x: u32| {
            let text = format!(
                "lane 1: 0,0 400,0 speed 12\nroute 1\n ego vehicle 0: 10,0 velocity 10,0\n
                 agent vehicle 1: {x},0 velocity 2,0"
            );
            fixture::scenario(&text).unwrap()
        };
        let scenarios = [street(40), street(45), street(300)];
        let scenes: Vec<_> = scenarios.iter().map(|s| s.present()).collect();
        let (mut blind, mut lazy) = (Holds("blind", 0.0), Holds("lazy", -4.0));
        let mut policies: [&mut dyn Policy; 3] = [&mut blind, &mut lazy, &mut Careful];
        let reward = Reward::new()
            .gate(Collision)
            .gate(OffRoad)
            .gate(RedLight)
            .term(5.0 / 7.0 / 60.0, Progress)
            .term(2.0 / 7.0, Comfort);
        let config = ValueConfig::default();
        let ranked =
            value_policies(&ConstantVelocity, &scenes, &mut policies, &reward, &config).unwrap();
        let names: Vec<&str> = ranked.iter().map(|value| value.name.as_str()).collect();
        assert_eq!(names, ["careful", "lazy", "blind"]);
        // The blind one hits the car in two scenes of three.
        let blind: Vec<bool> = ranked[2].scores.iter().map(|s| s[0] > 0.0).collect();
        assert_eq!(blind, [false, false, true]);
        let span = ranked[0].interval.unwrap();
        assert!(span.low <= ranked[0].mean && ranked[0].mean <= span.high);
        let mut broken: [&mut dyn Policy; 1] = [&mut Holds("broken", f64::NAN)];
        let error = value_policies(&ConstantVelocity, &scenes, &mut broken, &reward, &config);
        assert!(
            error
                .unwrap_err()
                .to_string()
                .contains("not a finite number")
        );
    }

    #[test]
    fn a_comparison_by_hand() {
        let a = [vec![3.0, 5.0], vec![2.0, 2.0]];
        let b = [vec![1.0, 1.0], vec![1.0, 3.0]];
        // Differences 2, 4 and 1, -1: means 3 and 0, variances within 2 and 2.
        let found = Comparison::new(&a, &b, Seed(0)).unwrap();
        assert_eq!((found.difference, found.within_scenes), (1.5, 2.0));
        // Variance of the means 4.5, of which 2 / 2 is chance.
        assert_abs_diff_eq!(found.between_scenes, 3.5);
        assert!(!found.is_sure());
        // (2.8 / 1.5)^2 * (3.5 + 2 / 4) = 13.9.
        assert_eq!(found.scenes_needed(4), Some(14));
        assert!(found.scenes_needed(1) > found.scenes_needed(100));
        let same = Comparison::of_scenes(&[1.0, 2.0], &[1.0, 2.0], Seed(0)).unwrap();
        assert_eq!((same.difference, same.scenes_needed(4)), (0.0, None));
        assert_eq!(Comparison::of_scenes(&[1.0], &[2.0], Seed(0)), None);
        assert_eq!(Comparison::new(&a, &b[..1], Seed(0)), None);
    }

    #[test]
    fn as_many_scenes_as_needed_tell_them_apart_four_times_in_five() {
        // Differences of mean 0.3 and variance 1, as sums of twelve uniform numbers.
        let draw = |seed: Seed| {
            let uniform = |i: u64| (seed.fork(i).0 >> 11) as f64 / (1u64 << 53) as f64;
            0.3 + (0..12).map(uniform).sum::<f64>() - 6.0
        };
        let sample =
            |seed: Seed, n: u64| -> Vec<f64> { (0..n).map(|i| draw(seed.fork(i))).collect() };
        let zeros = |n: u64| vec![0.0; n as usize];
        let truth = Comparison {
            difference: 0.3,
            interval: Interval {
                low: 0.0,
                high: 0.0,
            },
            between_scenes: 1.0,
            within_scenes: 0.0,
        };
        let n = truth.scenes_needed(1).unwrap() as u64;
        assert_eq!(n, 88);
        let sure = (0..100).filter(|&k| {
            let found = Comparison::of_scenes(&sample(Seed(k), n), &zeros(n), Seed(k));
            found.unwrap().is_sure()
        });
        let n_sure = sure.count();
        assert!((68..=92).contains(&n_sure), "{n_sure} of 100");
    }
}
