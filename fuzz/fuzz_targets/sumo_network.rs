//! Any bytes as a SUMO network: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("sumo_network", bytes));
