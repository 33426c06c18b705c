//! Every reader survives what strangers may give it: seeds, damaged copies of them, and whatever the
//! fuzzer once found (`tests/hostile/TARGET`).

#[path = "common/hostile.rs"]
mod hostile;

use std::path::Path;

use hostile::TARGETS;

const TESTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests");

#[test]
fn whatever_broke_a_reader_once_is_read_or_refused() {
    for target in &TARGETS {
        let folder = target.folder();
        let mut scenarios = 0;
        for (_, bytes) in target.corpus() {
            scenarios += target.read(&folder, &bytes);
        }
        // An index alone holds no scenario.
        let name = target.name;
        assert!(
            scenarios > 0 || name == "cache_index",
            "{name}: no seed reaches the end"
        );
    }
}

/// Numbers below `n`, the same in every run.
struct Dice(u64);

impl Dice {
    fn roll(&mut self, n: usize) -> usize {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        (self.0 >> 33) as usize % n.max(1)
    }
}

/// Cuts, flipped bits, other digits, removed, repeated and foreign stretches.
fn damage(bytes: &mut Vec<u8>, kind: usize, dice: &mut Dice) {
    let at = dice.roll(bytes.len());
    let stretch = |n: usize| at..(at + n).min(bytes.len());
    match kind {
        0 => bytes.truncate(at),
        1 => bytes[at] ^= 1 << dice.roll(8),
        2 => {
            let digit = bytes[at..].iter_mut().find(|b| b.is_ascii_digit());
            digit.into_iter().for_each(|b| *b = b'9');
        }
        3 => drop(bytes.drain(stretch(dice.roll(40)))),
        4 => {
            let again = bytes[stretch(60)].to_vec();
            bytes.splice(at..at, again);
        }
        _ => drop(bytes.splice(at..at, *b"e99")),
    }
}

/// Damaged copies of a large seed take longer.
fn rounds(file: &Path, bytes: &[u8]) -> usize {
    let seed = file
        .file_name()
        .is_some_and(|name| name.to_string_lossy().starts_with("seed"));
    match bytes.len() {
        _ if !seed => 0,
        0..10_000 => 600,
        _ => 100,
    }
}

#[test]
fn damaged_files_never_panic() {
    for target in &TARGETS {
        let (folder, mut dice) = (target.folder(), Dice(0x9e37_79b9_7f4a_7c15));
        let (mut read, mut tried) = (0, 0);
        for (file, bytes) in target.corpus() {
            for round in 0..rounds(&file, &bytes) {
                let mut damaged = bytes.clone();
                for _ in 0..=dice.roll(3) {
                    if !damaged.is_empty() {
                        damage(&mut damaged, round % 6, &mut dice);
                    }
                }
                tried += 1;
                read += usize::from(target.read(&folder, &damaged) > 0);
            }
        }
        let name = target.name;
        assert!(
            read < tried || tried == 0,
            "{name}: all {tried} damaged files were read"
        );
    }
}
