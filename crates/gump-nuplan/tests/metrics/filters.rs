//! The Savitzky–Golay filter and the comfort values derived with it.

use gump_metrics::ComfortBounds;
use gump_nuplan::metrics::{ComfortSeries, Motion, SavitzkyGolay, Statistics};
use gump_scene::VehicleParameters;
use serde_json::Value;

use crate::common::{assert_all_close, assert_close, egos, golden, list, number, numbers};

#[test]
fn filters_agree_at_odd_and_even_windows() {
    let cases = golden("savgol");
    assert_eq!(list(&cases).len(), 11);
    for case in list(&cases) {
        let whole = |key: &str| case[key].as_u64().unwrap() as usize;
        let filter = SavitzkyGolay {
            window: whole("window"),
            polynomial: whole("poly"),
            derivative: whole("deriv"),
            delta: number(&case["delta"]),
        };
        let what = format!("{filter:?}");
        let filtered = filter.filter(&numbers(&case["y"])).unwrap();
        assert_all_close(&filtered, &numbers(&case["out"]), 1e-10, &what);
        // Recorded for a convolution, hence from last to first.
        let mut weights = filter.weights((filter.window - 1) as f64 / 2.0);
        weights.reverse();
        assert_all_close(&weights, &numbers(&case["coeffs_conv"]), 1e-10, &what);
    }
}

/// The devkit's name of a series, its name in the recording, and the series.
pub(crate) fn named(series: &ComfortSeries) -> [(&'static str, &'static str, &Vec<f64>); 8] {
    [
        (
            "ego_lon_acceleration",
            "lon_accel",
            &series.longitudinal_acceleration,
        ),
        (
            "ego_lat_acceleration",
            "lat_accel",
            &series.lateral_acceleration,
        ),
        ("ego_acceleration", "mag_accel", &series.acceleration),
        ("ego_jerk", "mag_jerk", &series.jerk),
        ("ego_lon_jerk", "lon_jerk", &series.longitudinal_jerk),
        ("ego_lat_jerk", "lat_jerk", &series.lateral_jerk),
        ("ego_yaw_rate", "yaw_rate", &series.yaw_rate),
        (
            "ego_yaw_acceleration",
            "yaw_accel",
            &series.yaw_acceleration,
        ),
    ]
}

/// Compares max, min, mean and 90th percentile, the first four of recorded [.., value] rows.
pub(crate) fn assert_statistics(series: &[f64], rows: &[Value], tolerance: f64, what: &str) {
    let found = Statistics::of(series).unwrap();
    let found = [found.max, found.min, found.mean, found.p90];
    for (found, row) in found.into_iter().zip(rows) {
        let value = list(row).last().unwrap();
        assert_close(found, number(value), tolerance, what);
    }
}

/// Values are rounded to 8 decimals before they are differentiated at up to 20 Hz, twice for
/// headings: one unit in the last place becomes up to 5e-6.
#[test]
fn comfort_of_random_drives_agrees() {
    let golden = golden("comfort_random");
    let cases = list(&golden["cases"]);
    assert_eq!(cases.len(), 11);
    for (i, case) in cases.iter().enumerate() {
        let states = egos(&case["inputs"]);
        let motion = Motion::of(&VehicleParameters::PACIFICA, &states);
        let series = ComfortSeries::of(&motion).unwrap();
        for (metric, key, series) in named(&series) {
            let what = format!("case {i} {key}");
            assert_all_close(series, &numbers(&case["outputs"][key]), 5e-6, &what);
            if let Some(rows) = case["statistics"].get(metric) {
                assert_statistics(series, list(rows), 5e-6, &what);
            }
        }
        let comfortable = &case["statistics"]["ego_is_comfortable"][0][1];
        let found = series.is_comfortable(&ComfortBounds::NUPLAN);
        assert_eq!(found, comfortable.as_bool().unwrap(), "case {i}");
    }
}
