//! Speed of reading scenarios: framing alone, with decoding, with everything inferred.
//!
//! Reads the recorded file of the shared data if it is there, otherwise a generated one.

use std::hint::black_box;
use std::path::PathBuf;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use gump_data::tfrecord::TfRecordReader;
use gump_data::womd::write_scenarios;
use gump_data::{ReadOptions, open_with};
use prost::Message;

fn sample(folder: &tempfile::TempDir) -> PathBuf {
    let shared = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared");
    let real = PathBuf::from(shared).join("data/waymo/scenario_a.tfrecord");
    if real.exists() {
        return real;
    }
    eprintln!("SKIPPED the real file: it is not beside the repository; reading a made one");
    let agents: String = (1..100)
        .map(|i| format!("agent vehicle {i}: {},3 velocity 9,0\n", 8 * i))
        .collect();
    let text = format!("lane 1: 0,0 900,0\nego vehicle 0: 9,0 velocity 8,0\n{agents}");
    let scenario = gump_scene::fixture::scenario(&text).expect("the text is well-formed");
    let path = folder.path().join("made.tfrecord");
    write_scenarios(&path, [scenario]).expect("the temporary folder is writable");
    path
}

fn read(c: &mut Criterion) {
    let folder = tempfile::tempdir().expect("there is a temporary folder");
    let path = sample(&folder);
    let mut group = c.benchmark_group("read");
    let size = std::fs::metadata(&path).expect("the file is there").len();
    group.throughput(Throughput::Bytes(size));
    let payloads = || TfRecordReader::open(path.clone()).expect("the file opens");
    group.bench_function("framing", |b| {
        b.iter(|| {
            payloads()
                .map(|p| p.expect("sound").bytes.len())
                .sum::<usize>()
        });
    });
    group.bench_function("framing and decoding", |b| {
        b.iter(|| {
            for payload in payloads() {
                let bytes = payload.expect("sound").bytes;
                let message = gump_proto::Scenario::decode(bytes.as_slice());
                black_box(message.expect("sound"));
            }
        });
    });
    for (name, options) in [
        ("stated", ReadOptions::STATED),
        ("all inferred", ReadOptions::ALL),
    ] {
        group.bench_function(name, |b| {
            b.iter(|| {
                let reader = open_with(&path, options).expect("the file opens");
                reader.for_each(|record| drop(black_box(record.expect("sound"))));
            });
        });
    }
    group.finish();
}

criterion_group!(benches, read);
criterion_main!(benches);
