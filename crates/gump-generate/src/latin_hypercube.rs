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
}
