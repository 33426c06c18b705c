//! Everything that is recorded of one drive on a map.

use gump_nuplan::metrics::{ClosedLoop, Keeping, LaneChange, Scoring, Statistics};
use gump_scene::LaneId;
use serde_json::Value;

use crate::common::{self, list, number};
use crate::scenes::statistics as collision_statistics;

/// Recorded values have 6 decimals.
const TOLERANCE: f64 = 1e-5;

/// So do the headings that turning is derived from, at 10 Hz once or twice.
fn tolerance(metric: &str) -> f64 {
    match metric {
        "ego_yaw_acceleration" => 3e-4,
        "ego_yaw_rate" => 3e-5,
        _ => TOLERANCE,
    }
}

/// Compares everything that is recorded of one drive.
pub(crate) fn assert_closed_loop(
    found: &ClosedLoop,
    times_us: &[i64],
    recorded: &Value,
    what: &str,
) {
    let scores = found.scores();
    let metrics = recorded["metrics"].as_object().unwrap();
    assert_eq!(metrics.len(), 16);
    for (metric, expected) in metrics {
        let what = format!("{what} {metric}");
        if let Some(score) = scores.get(metric) {
            common::assert_close(score.unwrap(), number(&expected["score"]), TOLERANCE, &what);
        }
        let rows = list(&expected["statistics"]).iter();
        let expected_values: Vec<f64> = rows.map(|row| number(&row[2])).collect();
        let (values, series) = measured(found, times_us, metric);
        common::assert_all_close(&values, &expected_values, tolerance(metric), &what);
        if let Some(expected) = expected.get("time_series") {
            let expected: Vec<f64> = list(expected).iter().map(number).collect();
            common::assert_all_close(&series, &expected, tolerance(metric), &what);
        }
    }
    let extra = &recorded["extra"];
    let unpacked = |key: &str| run_lengths(&extra[key]);
    let followed = unpacked("ego_driven_route_rle").map(lane_ids);
    assert_eq!(
        found.followed,
        followed.collect::<Vec<_>>(),
        "{what} followed"
    );
    let corners =
        unpacked("corners_route_rle").map(|four| list(four).iter().map(lane_ids).collect());
    let corners: Vec<Vec<Vec<LaneId>>> = corners.collect();
    let found_corners: Vec<Vec<Vec<LaneId>>> = found.corners.iter().map(|c| c.to_vec()).collect();
    assert_eq!(found_corners, corners, "{what} corners");
    let within = unpacked("in_common_or_connected_rle").map(|one| number(one) == 1.0);
    let found_within = found.keeping.iter().map(Keeping::is_within);
    assert!(found_within.eq(within), "{what} keeping");
    let at_fault = found.collisions.at_fault().map(|event| event.time_us);
    let expected = list(&extra["timestamps_at_fault"]).iter();
    assert!(at_fault.eq(expected.map(|t| t.as_i64().unwrap())), "{what}");
    let total = found.score(&Scoring::closed_loop());
    common::assert_close(total, number(&recorded["scenario_score"]), TOLERANCE, what);
}

/// One value per frame from pairs of count and value.
fn run_lengths(pairs: &Value) -> impl Iterator<Item = &Value> {
    list(pairs).iter().flat_map(|pair| {
        let n = pair[0].as_u64().unwrap() as usize;
        std::iter::repeat_n(&pair[1], n)
    })
}

fn lane_ids(ids: &Value) -> Vec<LaneId> {
    let id = |id: &Value| LaneId(id.as_str().unwrap().parse().unwrap());
    list(ids).iter().map(id).collect()
}

/// The statistics of a metric in the devkit's order, and its series if it records one.
fn measured(found: &ClosedLoop, times_us: &[i64], metric: &str) -> (Vec<f64>, Vec<f64>) {
    let comfort = found.comfort.as_ref().unwrap();
    let bounded = |series: &Vec<f64>, low: f64, high: f64| {
        let statistics = Statistics::of(series).unwrap();
        let within = series.iter().all(|v| low < *v && *v < high);
        let Statistics {
            max,
            min,
            mean,
            p90,
        } = statistics;
        (vec![max, min, mean, p90, f64::from(within)], series.clone())
    };
    match metric {
        "ego_lane_change" => (lane_change_statistics(found, times_us), vec![]),
        "ego_jerk" => bounded(&comfort.jerk, -8.37, 8.37),
        "ego_lat_acceleration" => bounded(&comfort.lateral_acceleration, -4.89, 4.89),
        "ego_lon_acceleration" => bounded(&comfort.longitudinal_acceleration, -4.05, 2.40),
        "ego_lon_jerk" => bounded(&comfort.longitudinal_jerk, -4.13, 4.13),
        "ego_yaw_acceleration" => bounded(&comfort.yaw_acceleration, -1.93, 1.93),
        "ego_yaw_rate" => bounded(&comfort.yaw_rate, -0.95, 0.95),
        "ego_is_comfortable" => (vec![found.comfort_score().unwrap()], vec![]),
        "ego_progress_along_expert_route" => {
            let progress = &found.progress;
            let values = vec![progress.expert, progress.ego, progress.ratio];
            (values, progress.series.clone())
        }
        "ego_is_making_progress" => (vec![found.progress.making_progress()], vec![]),
        "drivable_area_compliance" => (vec![found.drivable_area.score], vec![]),
        "corners_in_drivable_area" => {
            let inside = &found.drivable_area.inside;
            let all = inside.iter().all(|inside| *inside);
            let series = inside.iter().map(|inside| f64::from(*inside)).collect();
            (vec![f64::from(all)], series)
        }
        "no_ego_at_fault_collisions" => (collision_statistics(&found.collisions), vec![]),
        "time_to_collision_within_bound" => {
            let ttc = &found.time_to_collision;
            (vec![ttc.min(), ttc.score], ttc.series.clone())
        }
        "speed_limit_compliance" => speed_limit_statistics(found),
        "driving_direction_compliance" => {
            let direction = &found.driving_direction;
            (
                vec![direction.score, -direction.against],
                direction.series.clone(),
            )
        }
        other => panic!("unknown metric {other}"),
    }
}

fn lane_change_statistics(found: &ClosedLoop, times_us: &[i64]) -> Vec<f64> {
    let changes = &found.lane_changes;
    let seconds =
        |change: &LaneChange| (times_us[change.end] - times_us[change.start]) as f64 * 1e-6;
    let durations: Vec<f64> = changes.iter().map(seconds).collect();
    let Some(Statistics { max, mean, .. }) = Statistics::of(&durations) else {
        return vec![0.0, 1.0];
    };
    let n = changes.len() as f64;
    let failed = changes.iter().filter(|c| !c.success).count() as f64 / n;
    vec![n, max, mean, failed, f64::from(failed <= 0.3)]
}

/// Whether the limit was kept; where it was not, before that: how many times in a row, the worst
/// and the mildest of their peaks, and the mean of their means.
fn speed_limit_statistics(found: &ClosedLoop) -> (Vec<f64>, Vec<f64>) {
    let series = found.speed_limit.excess.clone();
    let times: Vec<Statistics> = series
        .split(|excess| *excess == 0.0)
        .filter_map(Statistics::of)
        .collect();
    let peaks: Vec<f64> = times.iter().map(|time| time.max).collect();
    let means: Vec<f64> = times.iter().map(|time| time.mean).collect();
    let kept = f64::from(times.is_empty());
    let mut values = vec![kept];
    if let (Some(peaks), Some(means)) = (Statistics::of(&peaks), Statistics::of(&means)) {
        values = vec![times.len() as f64, peaks.max, peaks.min, means.mean, kept];
    }
    (values, series)
}
