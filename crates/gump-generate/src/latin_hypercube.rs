//! Stratified random numbers for the objects of a scene (Latin hypercube sampling).
//!
//! With few objects, independent draws may give scenes with lorries only, or with all agents on one
//! side. Where the number of objects of a class is known, every field of each is decided by a
//! number from a separate stratum: each draw has its usual distribution, and all together cover it.
//!
//! Source: Latin hypercube sampling (McKay, Beckman and Conover 1979).

use gump_engine::nucleus::uniform;
use gump_model::decoder::STATE_STEPS;
use gump_scene::Seed;
use rand::seq::SliceRandom;

/// The numbers for the steps of object `i` of `n`; all objects of a scene and class share `seed`.
pub(crate) fn numbers(seed: Seed, i: usize, n: usize) -> [f64; STATE_STEPS] {
    std::array::from_fn(|step| {
        let seed = seed.fork(step as u64);
        let mut strata: Vec<usize> = (0..n).collect();
        strata.shuffle(&mut seed.fork(0).rng());
        (strata[i] as f64 + uniform(seed.fork(1 + i as u64))) / n as f64
    })
}

/// Other numbers of the same object, drawn anew but for those of its place: these are within a part of
/// `spread` (0 to 1) of the range, about the first ones, so that the objects stay spread over the scene.
pub(crate) fn near(
    first: &[f64; STATE_STEPS],
    seed: Seed,
    spread: f64,
    is_place: impl Fn(usize) -> bool,
) -> [f64; STATE_STEPS] {
    std::array::from_fn(|step| {
        let fresh = uniform(seed.fork(step as u64));
        match is_place(step) {
            true => {
                let low = (first[step] - spread / 2.0).clamp(0.0, 1.0 - spread);
                low + spread * fresh
            }
            false => fresh,
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stratum_has_one_object_and_every_object_any_stratum() {
        let all: Vec<_> = (0..8).map(|i| numbers(Seed(3), i, 8)).collect();
        for step in 0..STATE_STEPS {
            let mut strata: Vec<usize> = all.iter().map(|of| (of[step] * 8.0) as usize).collect();
            strata.sort_unstable();
            assert_eq!(strata, (0..8).collect::<Vec<_>>());
        }
        assert_ne!(all[0][0], all[0][1]);
        let mean: f64 = (0..400).map(|i| numbers(Seed(i), 2, 8)[4]).sum::<f64>() / 400.0;
        // The standard deviation of the mean is 0.014.
        assert!((mean - 0.5).abs() < 0.06, "{mean}");
    }

    #[test]
    fn places_are_drawn_again_near_the_first() {
        let mut first = numbers(Seed(3), 2, 8);
        first[4] = 0.02;
        let all = (0..200).map(|i| near(&first, Seed(i), 0.2, |step| step >= 4));
        let (mut low, mut high) = ([1.0_f64; STATE_STEPS], [0.0_f64; STATE_STEPS]);
        for again in all {
            for step in 0..STATE_STEPS {
                low[step] = low[step].min(again[step]);
                high[step] = high[step].max(again[step]);
            }
        }
        // The whole range for the size, a fifth of it for the place, within the range at its end.
        assert!(low[0] < 0.05 && high[0] > 0.95);
        assert!(low[4] >= 0.0 && high[4] <= 0.2 && high[4] > 0.15);
        assert!((low[5]..=high[5]).contains(&first[5]) && high[5] - low[5] <= 0.2);
    }
}
