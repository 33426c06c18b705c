//! Any bytes as an Argoverse 2 map: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("argoverse2_map", bytes));
