//! Closed-loop evaluation: drives recordings with a planner and scores the drives.
//!
//! [`drive_scenario`] drives one scenario, [`drive_and_score`] one recording, [`evaluate`] many in
//! parallel; [`plan_once`] only plans. Errors are reported per recording; nothing is averaged here.

use gump_nuplan::closed_loop::{
    DriveConfig, Driven, Driver, PlannerInput, Recording, Tracking, Traffic, derive_roadblocks,
    drive,
};
use gump_nuplan::metrics::{
    ClosedLoop, OpenLoop, OpenLoopConfig, Sample, Scoring, SimulationHistory,
};
use gump_nuplan::metrics::{open_loop, score};
use gump_nuplan::tracking::Trajectory;
use gump_rollout::BoxError;
use gump_scene::{EgoState, MapGraph, Scenario};
use rayon::prelude::*;

use crate::PlanError;

/// A finished drive with its scores.
#[derive(Clone, Debug)]
pub struct Scored {
    /// The drive.
    pub driven: Driven,
    /// Every metric.
    pub metrics: ClosedLoop,
    /// nuPlan's score, 0 to 1.
    pub score: f64,
}

/// Drives a recording among some traffic and scores the drive as nuPlan's closed-loop challenges
/// do.
///
/// `map` is the map used for scoring, usually that of the recording. Passing the map without
/// derived roadblocks scores the drive on the map as it was stated.
///
/// # Errors
/// [`PlanError::Drive`] with the iteration if the loop cannot continue, [`PlanError::Score`] if the
/// drive cannot be scored.
pub fn drive_and_score(
    recording: &Recording,
    map: &MapGraph,
    traffic: &mut dyn Traffic,
    driver: &mut dyn Driver,
    config: &DriveConfig,
) -> Result<Scored, PlanError> {
    let driven = drive(recording, traffic, driver, config)?;
    let samples = samples(&driven);
    let metrics = score(&judged(recording, map, &samples, &driven))?;
    Ok(Scored {
        score: metrics.score(&Scoring::closed_loop()),
        metrics,
        driven,
    })
}

/// As [`drive_and_score`], for a scenario of lanes and boxes as most datasets have them.
///
/// The roadblocks and rear axle that nuPlan's drivers need are derived for driving
/// ([`derive_roadblocks`], [`Recording::of_boxes`]); the drive is scored on the map as stated.
///
/// # Errors
/// As [`drive_and_score`].
pub fn drive_scenario(
    scenario: &Scenario,
    traffic: &mut dyn Traffic,
    driver: &mut dyn Driver,
    config: &DriveConfig,
) -> Result<Scored, PlanError> {
    let mut driven = scenario.clone();
    derive_roadblocks(&mut driven);
    let recording = Recording::of_boxes(driven)?;
    drive_and_score(&recording, &scenario.map, traffic, driver, config)
}

/// The plan of a driver in the present of a recording; nothing is driven.
///
/// # Errors
/// The error of the driver.
pub fn plan_once(recording: &Recording, driver: &mut dyn Driver) -> Result<Trajectory, BoxError> {
    driver.start(&recording.initialization())?;
    driver.drive(&PlannerInput {
        iteration: 0,
        scene: recording.scenario().present(),
        ego: recording.ego_at(0),
        past: recording.past(),
    })
}

/// Lets a driver plan along the log without following its plans, and compares the plans with the
/// logged drive; `after` is the drive after the recording's end, if it is known.
///
/// # Errors
/// As [`drive_and_score`].
pub fn plan_and_compare(
    recording: &Recording,
    after: &[EgoState],
    traffic: &mut dyn Traffic,
    driver: &mut dyn Driver,
    seconds: f64,
) -> Result<OpenLoop, PlanError> {
    let config = DriveConfig {
        tracking: Tracking::Log,
        seconds,
        keep_plans: true,
    };
    let driven = drive(recording, traffic, driver, &config)?;
    let samples = samples(&driven);
    let judged = judged(recording, &recording.scenario().map, &samples, &driven);
    let config = OpenLoopConfig::default();
    let per_second = (1.0 / recording.scenario().dt).round() as usize;
    let last = (samples.len() - 1) / per_second * per_second;
    let all = recording.expert().iter().chain(after).skip(last);
    let longest = config.horizons[config.horizons.len() - 1].0;
    let future: Vec<EgoState> = all
        .step_by(per_second)
        .skip(1)
        .take(longest)
        .copied()
        .collect();
    Ok(open_loop(&judged, &future, &config)?)
}

/// The drive in the form that metrics read.
pub fn samples(driven: &Driven) -> Vec<Sample> {
    let states = driven.ego.iter().enumerate();
    states
        .map(|(i, ego)| Sample {
            ego: *ego,
            frame: driven.rollout.at(i).now().clone(),
            plan: driven
                .plans
                .get(i)
                .map_or(Vec::new(), |plan| plan.states().to_vec()),
        })
        .collect()
}

fn judged<'a>(
    recording: &'a Recording,
    map: &'a MapGraph,
    samples: &'a [Sample],
    driven: &Driven,
) -> SimulationHistory<'a> {
    let n = (driven.ego.len() + 1).min(recording.expert().len());
    SimulationHistory {
        samples,
        expert: &recording.expert()[..n],
        map,
        ego: Some(recording.scenario().ego),
        vehicle: *recording.vehicle(),
    }
}

/// Processes recordings in parallel, with at most as many in memory as there are threads; results
/// come in the order of the recordings.
pub fn evaluate<T: Send, R: Send>(
    recordings: impl Iterator<Item = T> + Send,
    work: impl Fn(usize, T) -> R + Sync,
) -> Vec<R> {
    let mut done: Vec<(usize, R)> = recordings
        .enumerate()
        .par_bridge()
        .map(|(i, recording)| (i, work(i, recording)))
        .collect();
    done.sort_by_key(|(i, _)| *i);
    done.into_iter().map(|(_, result)| result).collect()
}
