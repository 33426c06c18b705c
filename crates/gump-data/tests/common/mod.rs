//! Helpers of the integration tests: paths of real data, and scenarios to write.

#![allow(dead_code, reason = "each test file uses a part of this")]

use std::fs::File;
use std::path::Path;

use arrow_array::RecordBatch;
use gump_scene::Scenario;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

#[path = "../../../../tests/shared.rs"]
mod shared_data;

#[allow(unused_imports, reason = "each test file uses a part of this")]
pub(crate) use shared_data::shared;

/// A Parquet file whose rows fit into one batch.
pub(crate) fn table(path: &Path) -> RecordBatch {
    let file = File::open(path).expect("the file was just written");
    let builder = ParquetRecordBatchReaderBuilder::try_new(file).expect("a Parquet file");
    let mut batches = builder.with_batch_size(1 << 20).build().expect("a reader");
    let all = batches.next().expect("one batch").expect("a whole batch");
    assert!(batches.next().is_none());
    all
}

/// A small crossing with everything Waymo's messages can hold.
pub(crate) fn crossing() -> Scenario {
    let mut scenario = gump_scene::fixture::scenario(
        "lane 1: -60,0 -30,0 0,0 speed 13.4112 next 2,3
         lane 2: 0,0 60,0 speed 13.4112
         lane 3: 0,0 10,5 15,40
         lane 4: -60,3.5 0,3.5 left 5
         lane 5: -60,7 0,7 right 4
         edge: -60,-2 60,-2
         line: -60,1.75 0,1.75
         crosswalk: -4,-2 -1,-2 -1,9 -4,9
         light 1 red: -5,0
         light 4 green: -5,3.5
         ego vehicle 10: -40,0.1 velocity 8,0
         agent vehicle 3: -20,3.4 velocity 5,0.25 size 5.5,2.25
         agent pedestrian 7: -3,8 velocity 0,-1.25
         agent bicycle 8: -30,7 velocity 4,0
         agent other 9: 20,-1.5
         history 1.0 future 8.0 dt 0.1",
    )
    .expect("the fixture is well-formed");
    scenario.objects_of_interest = vec![scenario.ego];
    scenario.targets.sort_unstable();
    scenario
}
