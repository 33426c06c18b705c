//! Any bytes in a file named `some.fcd.xml`: reading them may fail, never panic.

#![no_main]

use libfuzzer_sys::fuzz_target;

#[path = "read.rs"]
mod read;

fuzz_target!(|bytes: &[u8]| read::read("some.fcd.xml", bytes));
