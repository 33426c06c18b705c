//! Any bytes as a table of tracks of TAF-BW: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("taf_bw", bytes));
