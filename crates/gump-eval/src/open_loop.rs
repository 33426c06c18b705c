//! Open-loop planning: plans along a log against what was driven, with nuPlan's scores.
//!
//! [`plan`] lets a planner plan along recordings, one of ours by name or any
//! [`PlannerFactory`](crate::closed_loop::PlannerFactory); one comparison is
//! [`gump_planner::closed_loop::plan_and_compare`].

use gump_nuplan::closed_loop::Replayed;
use gump_nuplan::metrics::{OpenLoop, Scoring};
use gump_planner::closed_loop::{evaluate, plan_and_compare};
use gump_rollout::WorldModel;
use gump_scene::Seed;

use crate::closed_loop::EvaluatedPlanner;
use crate::planners::{PlannerConfig, catch_panics};
use crate::recordings::{Case, Named};
use crate::{EvalError, Monitor};

/// Seconds that plans are compared over: the longest horizon of nuPlan's open-loop metrics.
pub const HORIZON_S: f64 = 8.0;

/// The comparison in one scenario, or why there is none.
pub struct OpenLoopOutcome {
    /// The scenario's id.
    pub id: String,
    /// The comparison.
    pub compared: Result<OpenLoop, EvalError>,
}

/// Lets a planner plan along recordings, several at a time; outcomes are in their order. `imagination`
/// is the world that planners with rollouts use; the seed of a recording is forked from `seed` by its
/// position. The monitor counts recordings.
///
/// # Errors
/// [`EvalError::Stopped`]. A failed comparison is an outcome, that of a planner that panics as well.
pub fn plan<'a>(
    cases: impl Iterator<Item = Named> + Send,
    planner: impl Into<EvaluatedPlanner<'a>>,
    imagination: &'a dyn WorldModel,
    config: &PlannerConfig,
    seed: Seed,
    monitor: &dyn Monitor,
) -> Result<Vec<OpenLoopOutcome>, EvalError> {
    let planner = planner.into();
    let name = planner.name();
    let compare = |i: usize, named: Named| {
        let compared = named.case.and_then(|case| {
            let compared = catch_panics(&name, || {
                let mut driver = planner.build(&case, imagination, seed.fork(i as u64), config)?;
                let (recording, after) = (&case.recording, &case.after);
                let seconds = comparable_seconds(&case);
                let compared =
                    plan_and_compare(recording, after, &mut Replayed, &mut *driver, seconds);
                Ok(compared.map_err(EvalError::from)?)
            });
            compared.map_err(EvalError::of_simulation)
        });
        monitor.advance(1);
        OpenLoopOutcome {
            id: named.id,
            compared,
        }
    };
    let outcomes = match planner.is_parallel() {
        true => evaluate(cases, compare),
        false => cases
            .enumerate()
            .map(|(i, named)| compare(i, named))
            .collect(),
    };
    monitor.check()?;
    Ok(outcomes)
}

/// Seconds of the log during which plans can be made so that each can still be compared with the
/// whole logged drive over its horizon.
fn comparable_seconds(case: &Case) -> f64 {
    let scenario = case.recording.scenario();
    let known = (scenario.future().len() + case.after.len()) as f64 * scenario.dt;
    // One more second than plans start in, because they start at every whole one.
    (known - HORIZON_S + 1.0).clamp(2.0 * scenario.dt, 15.0)
}

/// The numbers of a comparison by their names in reports: nuPlan's score first, distances in metres.
pub fn numbers(open: &OpenLoop) -> [(&'static str, f64); 6] {
    let [three, five, eight] = &open.horizons;
    [
        ("score", Scoring::open_loop().score(&open.scores)),
        ("ade_8s", eight.ade),
        ("fde_3s", three.fde),
        ("fde_5s", five.fde),
        ("fde_8s", eight.fde),
        ("miss_rate", eight.miss_rate),
    ]
}

#[cfg(test)]
mod tests {
    use gump_rollout::worlds::Idm;

    use super::*;
    use crate::RecordingError;
    use crate::closed_loop::tests::{NOT_A_NUMBER, PANICS, named};
    use crate::planners::PlannerName;
    use crate::recordings::of_boxes;

    #[test]
    fn the_recorded_driver_plans_what_was_driven() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -50,0 450,0\nego vehicle 0: 0,0 velocity 8,0\nhistory 1 future 20 dt 0.1",
        )
        .unwrap();
        let named = |id: &str, case| Named {
            id: id.into(),
            log_name: "log".into(),
            scenario_type: "unknown".into(),
            case,
        };
        let broken = Err(RecordingError::NoScenarios.into());
        let cases = [named("a", of_boxes(scenario)), named("b", broken)];
        let world = Idm::default();
        let config = PlannerConfig::default();
        let log = PlannerName::Log;
        let outcomes = plan(cases.into_iter(), log, &world, &config, Seed(0), &()).unwrap();
        let numbers = numbers(outcomes[0].compared.as_ref().unwrap());
        assert_eq!(numbers[0].0, "score");
        assert!(numbers[0].1 > 0.9 && numbers[1].1 < 0.1, "{numbers:?}");
        assert_eq!((&*outcomes[0].id, &*outcomes[1].id), ("a", "b"));
        assert!(outcomes[1].compared.is_err());
    }

    #[test]
    fn planners_that_fail_in_one_scenario_go_on_in_the_others() {
        let world = Idm::default();
        let config = PlannerConfig::default();
        for (planner, reason) in [
            (&PANICS, "panics panicked: lost at step 3"),
            (&NOT_A_NUMBER, "not a finite number"),
        ] {
            let cases = ["a", "b", "c"].map(named).into_iter();
            let planner = EvaluatedPlanner::Custom(planner);
            let outcomes = plan(cases, planner, &world, &config, Seed(0), &()).unwrap();
            let [first, failed, last] = &outcomes[..] else {
                panic!("{} outcomes", outcomes.len())
            };
            assert!(first.compared.is_ok() && last.compared.is_ok());
            assert_eq!(failed.id, "b");
            let error = failed.compared.as_ref().err().unwrap().sentence();
            assert!(error.contains(reason), "{error}");
        }
    }
}
