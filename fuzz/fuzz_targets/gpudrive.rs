//! Any bytes as a GPUDrive or Nocturne JSON: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("gpudrive", bytes));
