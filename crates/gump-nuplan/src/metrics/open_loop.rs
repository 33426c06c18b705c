//! Open loop: distances of plans from the expert.

use gump_geometry::{Pose, angle_difference};
use gump_scene::{EgoState, VehicleParameters};

use super::error::NuPlanError;
use super::history::{Sample, SimulationHistory};
use super::scoring::MetricScores;

/// Settings of the comparison: rate and horizons.
#[derive(Clone, Debug, PartialEq)]
pub struct OpenLoopConfig {
    /// Seconds between samples of the history.
    pub interval: f64,
    /// Horizons in seconds, ascending, each with the largest displacement that is not a miss,
    /// metres.
    pub horizons: [(usize, f64); 3],
    /// Mean displacement that scores 0, metres.
    pub displacement: f64,
    /// Mean heading error that scores 0, radians.
    pub heading: f64,
    /// Largest share of misses.
    pub miss_rate: f64,
}

impl Default for OpenLoopConfig {
    /// The values of nuPlan's open-loop challenge, samples at 10 Hz.
    fn default() -> Self {
        Self {
            interval: 0.1,
            horizons: [(3, 6.0), (5, 8.0), (8, 16.0)],
            displacement: 8.0,
            heading: 0.8,
            miss_rate: 0.3,
        }
    }
}

/// Mean errors over one horizon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HorizonError {
    /// The horizon, seconds.
    pub seconds: usize,
    /// Average displacement, metres.
    pub ade: f64,
    /// Final displacement, metres.
    pub fde: f64,
    /// Average heading error, radians.
    pub ahe: f64,
    /// Final heading error, radians.
    pub fhe: f64,
    /// Share of plans that are farther from the expert than allowed at any time.
    pub miss_rate: f64,
}

/// The open-loop score and its parts.
#[derive(Clone, Debug, PartialEq)]
pub struct OpenLoop {
    /// Errors per horizon, means over the plans that were compared.
    pub horizons: [HorizonError; 3],
    /// Scores by nuPlan's metric names.
    pub scores: MetricScores,
}

/// Compares the plans of a drive with the expert, once a second.
///
/// `expert_future` continues the expert after the last compared sample: states 1 s apart, as many
/// as the longest horizon has seconds. Plans must begin at the time of their sample.
///
/// As in the devkit, the expert of the drive and its future are concatenated: if the drive's expert
/// has a state at the first future time, that time occurs twice and some horizons end a second
/// early.
///
/// # Errors
/// [`NuPlanError`] if a plan or the expert is too short.
///
/// Source: nuPlan's planner-expert metrics.
pub fn open_loop(
    drive: &SimulationHistory<'_>,
    expert_future: &[EgoState],
    config: &OpenLoopConfig,
) -> Result<OpenLoop, NuPlanError> {
    let stride = ((1.0 / config.interval) as usize).max(1);
    let longest = config.horizons[2].0;
    let sampled: Vec<(usize, &Sample)> = drive.samples.iter().enumerate().step_by(stride).collect();
    if sampled.is_empty() {
        return Err(NuPlanError::NoSamples);
    }
    let strided = drive.expert.iter().step_by(stride);
    let expert: Vec<EgoState> = strided.chain(expert_future).copied().collect();
    let expected = sampled.len() + longest;
    if expert.len() < expected {
        let found = expert.len();
        return Err(NuPlanError::ShortExpert { expected, found });
    }
    let mut errors = Vec::with_capacity(sampled.len());
    for (c, (sample, plan)) in sampled.into_iter().enumerate() {
        let window = &expert[c..=c + longest];
        let compared = compare(&drive.vehicle, &plan.plan, window);
        errors.push(compared.map_err(|covered| NuPlanError::ShortPlan {
            sample,
            covered,
            needed: longest,
        })?);
    }
    let horizons = config
        .horizons
        .map(|(seconds, allowed)| horizon_error(&errors, seconds, allowed));
    let scores = scores(&horizons, config);
    Ok(OpenLoop { horizons, scores })
}

/// The distance of a plan from the expert at one instant.
#[derive(Clone, Copy)]
struct Difference {
    /// Between box centres, metres.
    displacement: f64,
    /// Unsigned, radians.
    heading: f64,
}

/// The differences of one plan at each state of the expert after the first; as an error the
/// possible number, if there are too few.
fn compare(
    vehicle: &VehicleParameters,
    plan: &[EgoState],
    expert: &[EgoState],
) -> Result<Vec<Difference>, usize> {
    let needed = expert.len() - 1;
    let (Some(first), Some(last)) = (plan.first(), plan.last()) else {
        return Err(0);
    };
    if first.time_us > expert[0].time_us {
        return Err(0);
    }
    let reached = expert.partition_point(|state| state.time_us <= last.time_us);
    let inner = expert[..reached].iter();
    let mut pairs: Vec<(Pose, Pose)> = inner
        .filter_map(|state| Some((pose_at(plan, state.time_us)?, state.rear_axle)))
        .skip(1)
        .collect();
    if reached < expert.len() {
        let end = pose_at(expert, last.time_us).ok_or(0usize)?;
        pairs.push((last.rear_axle, end));
    }
    if pairs.len() != needed {
        return Err(pairs.len());
    }
    let errors = pairs.into_iter().map(|(plan, expert)| {
        let centre = |pose: Pose| vehicle.center_of(pose).position;
        let turn = angle_difference(plan.heading, expert.heading);
        Difference {
            displacement: centre(plan).distance(centre(expert)),
            heading: turn.abs(),
        }
    });
    Ok(errors.collect())
}

/// The rear axle at a time, linear between states and with the heading in the shorter direction;
/// `None` before the first and after the last.
fn pose_at(states: &[EgoState], time_us: i64) -> Option<Pose> {
    let after = states.partition_point(|state| state.time_us < time_us);
    let next = states.get(after)?;
    if next.time_us == time_us {
        return Some(next.rear_axle);
    }
    let before = &states[after.checked_sub(1)?];
    let t = (time_us - before.time_us) as f64 / (next.time_us - before.time_us) as f64;
    Some(before.rear_axle.interpolate(next.rear_axle, t))
}

fn horizon_error(errors: &[Vec<Difference>], seconds: usize, allowed: f64) -> HorizonError {
    let mean = |of: &dyn Fn(&[Difference]) -> f64| {
        errors.iter().map(|plan| of(&plan[..seconds])).sum::<f64>() / errors.len() as f64
    };
    let average = |part: fn(&Difference) -> f64| {
        mean(&|plan| plan.iter().map(part).sum::<f64>() / seconds as f64)
    };
    HorizonError {
        seconds,
        ade: average(|d| d.displacement),
        fde: mean(&|plan| plan[seconds - 1].displacement),
        ahe: average(|d| d.heading),
        fhe: mean(&|plan| plan[seconds - 1].heading),
        miss_rate: mean(&|plan| f64::from(plan.iter().any(|d| d.displacement > allowed))),
    }
}

fn scores(horizons: &[HorizonError; 3], config: &OpenLoopConfig) -> MetricScores {
    let linear = |error: fn(&HorizonError) -> f64, worst: f64| {
        let mean = horizons.iter().map(error).sum::<f64>() / horizons.len() as f64;
        Some((1.0 - mean / worst).max(0.0))
    };
    let hits = horizons.iter().all(|h| h.miss_rate <= config.miss_rate);
    let named = [
        ("average_l2", linear(|h| h.ade, config.displacement)),
        ("final_l2", linear(|h| h.fde, config.displacement)),
        ("average_heading", linear(|h| h.ahe, config.heading)),
        ("final_heading", linear(|h| h.fhe, config.heading)),
    ];
    let mut scores: MetricScores = named
        .into_iter()
        .map(|(name, score)| (format!("planner_expert_{name}_error_within_bound"), score))
        .collect();
    let name = "planner_miss_rate_within_bound";
    scores.insert(name.to_owned(), Some(f64::from(hits)));
    scores
}

/// Distance of the driven box centre from the expert's, sample by sample, metres; `heading_weight`
/// metres are added per radian between them.
///
/// Source: nuPlan's `ego_expert_L2_error` (weight 0) and `ego_expert_L2_error_with_yaw` (2.5),
/// statistics without score.
pub fn expert_errors(drive: &SimulationHistory<'_>, heading_weight: f64) -> Vec<f64> {
    let pairs = drive.samples.iter().map(|s| &s.ego).zip(drive.expert);
    let centre = |state: &EgoState| drive.vehicle.center_of(state.rear_axle);
    let error = |(ego, expert): (&EgoState, &EgoState)| {
        let (ego, expert) = (centre(ego), centre(expert));
        let turn = angle_difference(ego.heading, expert.heading).abs();
        ego.position.distance(expert.position) + heading_weight * turn
    };
    pairs.map(error).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::MapGraph;

    fn straight(from_s: i64, to_s: i64, speed: f64) -> Vec<EgoState> {
        let state = |t: i64| EgoState {
            time_us: t * 1_000_000,
            rear_axle: Pose::new(speed * t as f64, 0.0, 0.0),
            ..EgoState::default()
        };
        (from_s..=to_s).map(state).collect()
    }

    fn check(plan: Vec<EgoState>) -> Result<OpenLoop, NuPlanError> {
        let sample = Sample {
            plan,
            ..Sample::default()
        };
        let drive = SimulationHistory {
            samples: &[sample],
            expert: &straight(0, 0, 5.0),
            map: &MapGraph::default(),
            ego: None,
            vehicle: VehicleParameters::PACIFICA,
        };
        let config = OpenLoopConfig {
            interval: 1.0,
            ..OpenLoopConfig::default()
        };
        open_loop(&drive, &straight(1, 8, 5.0), &config)
    }

    #[test]
    fn errors_grow_with_the_horizon() {
        let found = check(straight(0, 8, 6.0)).unwrap();
        let fde = found.horizons.map(|h| h.fde);
        assert_eq!(fde, [3.0, 5.0, 8.0]);
        assert_eq!(found.horizons.map(|h| h.ade), [2.0, 3.0, 4.5]);
        assert_eq!(found.horizons.map(|h| h.miss_rate), [0.0; 3]);
        let miss = check(straight(0, 8, 8.0)).unwrap();
        assert_eq!(miss.horizons.map(|h| h.miss_rate), [1.0; 3]);
        assert_eq!(miss.scores["planner_miss_rate_within_bound"], Some(0.0));
    }

    #[test]
    fn short_plans_are_named() {
        let error = check(straight(0, 5, 5.0)).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the plan of sample 0 covers 6 of 8 comparisons"
        );
        assert!(check(Vec::new()).is_err());
        // The end of a plan that just misses the last comparison is compared with the expert then.
        let mut plan = straight(0, 8, 5.0);
        plan[8].time_us -= 100_000;
        assert!((check(plan).unwrap().horizons[2].fde - 0.5).abs() < 1e-9);
    }
}
