//! The devkit's own test scenes, those that need no map.

use gump_geometry::{Pose, dvec2};
use gump_metrics::ComfortBounds;
use gump_nuplan::metrics::{
    CollisionKind, Collisions, ComfortSeries, Motion, OpenLoopConfig, RoadContext,
    SimulationHistory, Statistics, TimeToCollisionConfig, collisions, expert_errors, open_loop,
    time_to_collision,
};
use gump_scene::{Agent, AgentKind, MapGraph, VehicleParameters};
use serde_json::Value;

use crate::common::{
    agent, assert_all_close, assert_close, drive, egos, entries, golden, list, number, numbers,
    samples,
};
use crate::filters::{assert_statistics, named};
use crate::open_loop::assert_metric;

/// Recorded outputs have 6 decimals.
const TOLERANCE: f64 = 1e-5;

/// Recorded results of a scene.
struct Expected<'a> {
    /// Rows of name, type and value.
    rows: &'a [Value],
    score: Option<f64>,
    series: Option<Vec<f64>>,
}

impl Expected<'_> {
    /// Checks a metric of given values in order, with its score and series.
    fn check(&self, values: &[f64], score: Option<f64>, series: Option<&[f64]>, what: &str) {
        let expected: Vec<f64> = self.rows.iter().map(|row| number(&row[2])).collect();
        assert_all_close(values, &expected, TOLERANCE, what);
        if let (Some(found), Some(expected)) = (score, self.score) {
            assert_close(found, expected, TOLERANCE, what);
        }
        if let (Some(found), Some(expected)) = (series, &self.series) {
            assert_all_close(found, expected, TOLERANCE, what);
        }
    }
}

#[test]
fn the_devkits_scenes_pass() {
    let golden = golden("devkit_scenes");
    let (mut n_passed, mut n_on_real_map) = (0, 0);
    for (name, case) in entries(&golden["cases"]) {
        if case["needs_real_map"].as_bool().unwrap() {
            n_on_real_map += 1;
            continue;
        }
        check(name, case);
        n_passed += 1;
    }
    println!("{n_passed} scenes pass; {n_on_real_map} need the map of Las Vegas and are skipped");
    assert_eq!(n_passed, 29);
}

fn check(name: &str, case: &Value) {
    let expected = Expected {
        rows: list(&case["official_output_empty_map"]),
        score: case.get("official_score").and_then(Value::as_f64),
        series: case
            .get("official_time_series")
            .filter(|series| series.is_array())
            .map(numbers),
    };
    let frames = list(&case["tracks"]).iter().map(tracks);
    let mut samples = samples(egos(&case["ego"]), frames);
    let expert = case.get("expert").map(egos).unwrap_or_default();
    let n = samples.len();
    let plans = case.get("planner_trajectories").map(list);
    for (sample, plan) in samples.iter_mut().zip(plans.unwrap_or_default()) {
        sample.plan = egos(plan);
    }
    let map = MapGraph::default();
    let drive = drive(&samples, &expert[..expert.len().min(n)], &map);
    match case["metric"].as_str().unwrap() {
        "no_ego_at_fault_collision" => check_collisions(&drive, case, &expected, name),
        "time_to_collision_within_bound" => check_time_to_collision(&drive, case, &expected, name),
        metric if metric.starts_with("planner_") => {
            let config = OpenLoopConfig {
                interval: number(&case["database_interval"]),
                ..OpenLoopConfig::default()
            };
            let found = open_loop(&drive, &expert[n..], &config).unwrap();
            assert_metric(&found, metric, expected.rows, TOLERANCE);
            let score = found.scores[metric].unwrap();
            assert_close(score, expected.score.unwrap(), TOLERANCE, name);
        }
        "ego_expert_l2_error" => check_errors(&expert_errors(&drive, 0.0), &expected, name),
        "ego_expert_l2_error_with_yaw" => {
            check_errors(&expert_errors(&drive, 2.5), &expected, name);
        }
        "ego_mean_speed" => {
            let speeds: Vec<f64> = samples.iter().map(|s| s.ego.speed()).collect();
            let mean = Statistics::of(&speeds).unwrap().mean;
            expected.check(&[mean], None, None, name);
        }
        metric => check_comfort(&drive, metric, case, &expected, name),
    }
}

fn tracks(rows: &Value) -> Vec<Agent> {
    let rows = list(rows).iter();
    let track = |row: &Value| {
        let values: Vec<f64> = list(row)[2..].iter().map(number).collect();
        let [x, y, heading, length, width, ref velocity @ ..] = values[..] else {
            panic!("{row}");
        };
        let velocity = match *velocity {
            [vx, vy] => dvec2(vx, vy),
            _ => dvec2(0.0, 0.0),
        };
        let id = row[0].as_str().unwrap().parse().unwrap();
        agent(
            id,
            &row[1],
            Pose::new(x, y, heading),
            [length, width],
            velocity,
        )
    };
    rows.map(track).collect()
}

fn check_errors(found: &[f64], expected: &Expected<'_>, name: &str) {
    let statistics = Statistics::of(found).unwrap();
    let values = [statistics.max, statistics.mean, statistics.p90];
    expected.check(&values, None, Some(found), name);
}

fn check_comfort(
    drive: &SimulationHistory<'_>,
    metric: &str,
    case: &Value,
    expected: &Expected<'_>,
    name: &str,
) {
    let states: Vec<_> = drive.samples.iter().map(|s| s.ego).collect();
    let series = ComfortSeries::of(&Motion::of(&VehicleParameters::PACIFICA, &states)).unwrap();
    if metric == "ego_is_comfortable" {
        // The devkit's test calls this metric alone: its parts are not computed and it reports
        // discomfort whatever the drive. In the simulation, where they are, a drive that never
        // accelerates by more than 1 m/s2 nor turns is comfortable.
        assert_eq!(number(&expected.rows[0][2]), 0.0);
        assert!(series.is_comfortable(&ComfortBounds::NUPLAN), "{name}");
        return;
    }
    let named = named(&series);
    let (_, _, series) = named.iter().find(|(name, ..)| *name == metric).unwrap();
    assert_statistics(series, &expected.rows[..4], TOLERANCE, name);
    assert_all_close(series, expected.series.as_ref().unwrap(), TOLERANCE, name);
    if let Some(within) = expected.rows.get(4) {
        let constructor = case["constructors"][0].as_str().unwrap();
        let (low, high) = bounds(constructor);
        let found = series.iter().all(|v| low < *v && *v < high);
        assert_eq!(f64::from(found), number(&within[2]), "{name}");
    }
}

/// The bounds in a constructor such as `EgoJerkStatistics('..', 'Dynamics', max_abs_mag_jerk=7.0)`.
fn bounds(constructor: &str) -> (f64, f64) {
    let value = |key: &str| {
        let (_, rest) = constructor.split_once(key)?;
        let (_, rest) = rest.split_once('=')?;
        let end = rest.find([',', ')'])?;
        rest[..end].parse::<f64>().ok()
    };
    match value("max_abs") {
        Some(bound) => (-bound, bound),
        None => (value("min_lon").unwrap(), value("max_lon").unwrap()),
    }
}

fn check_collisions(
    drive: &SimulationHistory<'_>,
    case: &Value,
    expected: &Expected<'_>,
    name: &str,
) {
    // Where there is no map the ego is in no lane.
    let found = collisions(drive, &vec![false; drive.samples.len()]);
    expected.check(&statistics(&found), Some(found.score), None, name);
    for assertion in list(&case["extra_asserts"]) {
        let assertion = assertion.as_str().unwrap();
        if let Some((_, kind)) = assertion.split_once("CollisionType.") {
            let kind = match kind {
                "ACTIVE_FRONT_COLLISION" => CollisionKind::ActiveFront,
                "ACTIVE_REAR_COLLISION" => CollisionKind::ActiveRear,
                "ACTIVE_LATERAL_COLLISION" => CollisionKind::ActiveLateral,
                "STOPPED_EGO_COLLISION" => CollisionKind::StoppedEgo,
                "STOPPED_TRACK_COLLISION" => CollisionKind::StoppedTrack,
                other => panic!("unknown kind {other}"),
            };
            assert_eq!(found.events[0].kind, kind, "{name}");
            assert_eq!(found.events.len(), 1, "{name}");
        }
    }
}

/// The statistics in the devkit's order: none at fault, counts, then energies of the groups hit.
pub(crate) fn statistics(found: &Collisions) -> Vec<f64> {
    let groups: [fn(AgentKind) -> bool; 3] = [
        |kind| matches!(kind, AgentKind::Pedestrian | AgentKind::Bicycle),
        |kind| kind == AgentKind::Vehicle,
        |kind| !kind.is_moving(),
    ];
    let all = found.at_fault().count();
    let mut values = vec![f64::from(all == 0), all as f64];
    values.extend(groups.map(|group| found.n_at_fault(group) as f64));
    for group in groups {
        let of_group = found.at_fault().filter(|event| group(event.agent_kind));
        let energies: Vec<f64> = of_group.map(|event| event.energy).collect();
        if let Some(energy) = Statistics::of(&energies) {
            values.extend([energy.max, energy.min, energy.mean]);
        }
    }
    values
}

fn check_time_to_collision(
    drive: &SimulationHistory<'_>,
    case: &Value,
    expected: &Expected<'_>,
    name: &str,
) {
    let parameters = &case["metric_parameters"];
    let config = TimeToCollisionConfig {
        step: number(&parameters["time_step_size"]),
        horizon: number(&parameters["time_horizon"]),
        least: number(&parameters["least_min_ttc"]),
    };
    let context = RoadContext {
        in_one_lane: false,
        in_intersection: false,
    };
    let n = drive.samples.len();
    let hits = collisions(drive, &vec![false; n]);
    let found = time_to_collision(drive, &vec![context; n], &hits, &config);
    let values = [found.min(), found.score];
    expected.check(&values, Some(found.score), Some(&found.series), name);
}
