//! The trait [`Metric`], the list of all metrics, and their reduction over a rollout.

use gump_scene::{Agent, AgentId, Rollout, Scenario, SceneState};
use rayon::prelude::*;

use crate::{
    Acceleration, Collision, Discomfort, DistanceToRoadEdge, OffRoad, Progress, RedLight, Speed,
    YawRate,
};

/// A measurement of one agent at one instant; a [`crate::Reward`] decides what is good or bad.
///
/// The same definition is used in tables and rewards, for logs and rollouts.
pub trait Metric: Send + Sync {
    /// Name for tables, `snake_case`, with the unit where it is not a share.
    fn name(&self) -> &'static str;

    /// The value for `agent`, which is present now; `None` where it is not defined (no road edges,
    /// too little history, not a vehicle).
    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64>;

    /// Reduction of the values over time to one.
    fn reduce(&self) -> Reduce;
}

/// A reduction of values over time to one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reduce {
    /// 1 if any value is above 0, else 0.
    Any,
    /// The average.
    Mean,
    /// The largest.
    Max,
    /// The smallest.
    Min,
    /// The sum.
    Sum,
    /// The latest.
    Last,
}

impl Reduce {
    /// One value from the defined ones; `None` if there are none.
    pub fn apply(self, values: impl IntoIterator<Item = f64>) -> Option<f64> {
        let mut values = values.into_iter();
        let first = values.next()?;
        Some(match self {
            Self::Any => f64::from(first > 0.0 || values.any(|v| v > 0.0)),
            Self::Mean => {
                let (sum, n) = values.fold((first, 1.0), |(sum, n), v| (sum + v, n + 1.0));
                sum / n
            }
            Self::Max => values.fold(first, f64::max),
            Self::Min => values.fold(first, f64::min),
            Self::Sum => values.fold(first, |sum, v| sum + v),
            Self::Last => values.last().unwrap_or(first),
        })
    }
}

/// Every metric that does not need the log. A new one is a file and a line here.
pub static ALL: [&dyn Metric; 9] = [
    &Collision,
    &OffRoad,
    &DistanceToRoadEdge,
    &RedLight,
    &Progress,
    &Discomfort,
    &Speed,
    &Acceleration,
    &YawRate,
];

/// The metric over all simulated frames in which the agent is present and the metric is defined.
///
/// The first frame is not simulated and does not count.
pub fn over_rollout(metric: &dyn Metric, rollout: &Rollout, agent: AgentId) -> Option<f64> {
    let values = (1..=rollout.steps()).filter_map(|step| {
        let scene = rollout.at(step);
        metric.at(&scene, scene.now().agent(agent)?)
    });
    metric.reduce().apply(values)
}

/// [`over_rollout`] for many rollouts in parallel, in their order.
pub fn over_rollouts(
    metric: &dyn Metric,
    rollouts: &[Rollout],
    agent: AgentId,
) -> Vec<Option<f64>> {
    let one = |rollout| over_rollout(metric, rollout, agent);
    rollouts.par_iter().map(one).collect()
}

/// The logged future as a rollout, so that it can be measured in the same way.
pub fn logged(scenario: &Scenario) -> Rollout {
    let mut rollout = Rollout::begin(scenario.present());
    for frame in scenario.future() {
        rollout.push(frame.clone());
    }
    rollout
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::fixture;

    #[test]
    fn values_reduce_as_named() {
        let check = |reduce: Reduce, expected: f64| {
            assert_eq!(reduce.apply([1.0, -2.0, 4.0, 0.0]), Some(expected));
            assert_eq!(reduce.apply([]), None);
        };
        check(Reduce::Any, 1.0);
        check(Reduce::Mean, 0.75);
        check(Reduce::Max, 4.0);
        check(Reduce::Min, -2.0);
        check(Reduce::Sum, 3.0);
        check(Reduce::Last, 0.0);
        assert_eq!(Reduce::Any.apply([0.0, -1.0]), Some(0.0));
        assert_eq!(Reduce::Last.apply([7.0]), Some(7.0));
    }

    #[test]
    fn names_are_unique() {
        let mut names = ALL.map(Metric::name);
        names.sort_unstable();
        assert!(names.windows(2).all(|pair| pair[0] != pair[1]));
    }

    #[test]
    fn the_log_is_measured_like_imagination() {
        let text = "ego vehicle 0: 0,0 velocity 5,0\nagent vehicle 1: 40,0";
        let scenario = fixture::scenario(text).unwrap();
        let rollout = logged(&scenario);
        assert_eq!(rollout.steps(), 80);
        // 40 m apart, 4.8 m long, 5 m/s: they meet after 7.04 s.
        assert_eq!(over_rollout(&Collision, &rollout, AgentId(1)), Some(1.0));
        let mean = over_rollout(&Speed, &rollout, AgentId(0)).unwrap();
        assert!((mean - 5.0).abs() < 1e-12);
        assert_eq!(over_rollout(&Speed, &rollout, AgentId(9)), None);
        let both = over_rollouts(&Speed, &[rollout.clone(), rollout], AgentId(1));
        assert_eq!(both, [Some(0.0), Some(0.0)]);
    }
}
