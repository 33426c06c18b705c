//! Any bytes as Waymo's message, framed with good checksums: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("womd_message", bytes));
