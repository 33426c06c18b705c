//! Any bytes as the index of a shard with a good checksum: reading may fail, never panic.

#![no_main]

mod attack;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| attack::read("cache_index", bytes));
