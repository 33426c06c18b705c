//! Any bytes as a Lanelet2 map: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("taf_bw_map", bytes));
