//! Any bytes as people's own JSON: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("scenario_json", bytes));
