//! Any bytes as a nuPlan log: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("nuplan", bytes));
