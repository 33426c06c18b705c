//! Any bytes as a record of the cache with a good checksum: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("cache", bytes));
