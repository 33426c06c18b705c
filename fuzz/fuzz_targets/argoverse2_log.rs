//! Any bytes as the annotations of an Argoverse 2 sensor log: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("argoverse2_log", bytes));
