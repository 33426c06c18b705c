//! Crafted drives over the made-up map: keeping and changing lanes, the wrong way, off the road,
//! too fast, turning, braking, standing.

use gump_nuplan::metrics::score;

use crate::common::{drive, egos, entries, golden, samples};
use crate::map::synthetic_map;
use crate::recorded::assert_closed_loop;

#[test]
fn crafted_drives_score_as_recorded() {
    let map = synthetic_map();
    let golden = golden("synth_histories_a");
    assert_eq!(entries(&golden["cases"]).count(), 13);
    for (name, case) in entries(&golden["cases"]) {
        assert_eq!(entries(&case["tracks"]).count(), 0, "{name}");
        let samples = samples(egos(&case["ego"]), std::iter::repeat(Vec::new()));
        let expert = egos(&case["expert"]);
        let times_us: Vec<i64> = samples.iter().map(|s| s.ego.time_us).collect();
        let found = score(&drive(&samples, &expert, &map)).unwrap();
        assert_closed_loop(&found, &times_us, case, name);
    }
}
