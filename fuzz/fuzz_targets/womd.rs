//! Any bytes as a TFRecord file: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("womd", bytes));
