//! Average precision of the modes by confidence.

use std::cmp::Ordering;

use super::evaluate::ModeScore;

/// Modes of many predictions of one shape, each with its confidence and whether it is a hit.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PrecisionSamples {
    n_predictions: usize,
    samples: Vec<Sample>,
}

/// One mode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// As given by the predictor.
    pub confidence: f64,
    /// True if it matches the log and no earlier mode of its prediction did.
    pub hit: bool,
}

impl PrecisionSamples {
    /// Adds the modes of one prediction, with their matches. Of several matches the most confident
    /// is the hit; `later_matches_count` selects whether the others are false alarms (mAP) or
    /// ignored (soft mAP).
    ///
    /// Modes whose match is unknown are left out; a prediction of such modes only is not counted.
    pub(crate) fn add(&mut self, modes: &[ModeScore], later_matches_count: bool) {
        let known = modes.iter().filter_map(|mode| {
            let hit = mode.matches?;
            let confidence = mode.confidence;
            Some(Sample { confidence, hit })
        });
        let mut known: Vec<Sample> = known.collect();
        if known.is_empty() {
            return;
        }
        self.n_predictions += 1;
        known.sort_by(|a, b| b.confidence.total_cmp(&a.confidence));
        let mut found = false;
        for Sample { confidence, hit } in known {
            if hit && found && !later_matches_count {
                continue;
            }
            let hit = hit && !found;
            found |= hit;
            self.samples.push(Sample { confidence, hit });
        }
    }

    /// Adds the samples of another.
    pub fn merge(&mut self, other: &Self) {
        self.n_predictions += other.n_predictions;
        self.samples.extend_from_slice(&other.samples);
    }

    /// Predictions counted.
    pub fn n_predictions(&self) -> usize {
        self.n_predictions
    }

    /// The samples in order of insertion.
    pub fn samples(&self) -> &[Sample] {
        &self.samples
    }

    /// Area under the interpolated curve of precision over recall, 0..1; `None` without samples.
    ///
    /// The order of the samples does not matter: of equal confidences the false alarms come first.
    ///
    /// Source: the all-points rule of PASCAL VOC 2010, with precision and recall as f32, as the
    /// challenge computes it.
    pub fn average_precision(&self) -> Option<f64> {
        let mut samples = self.samples.clone();
        samples.sort_by(|a, b| match b.confidence.total_cmp(&a.confidence) {
            Ordering::Equal => a.hit.cmp(&b.hit),
            order => order,
        });
        let mut hits = 0;
        let curve = samples.iter().enumerate().map(|(i, sample)| {
            hits += usize::from(sample.hit);
            let precision = hits as f32 / (i + 1) as f32;
            let recall = hits as f32 / self.n_predictions as f32;
            (f64::from(precision), f64::from(recall))
        });
        let curve: Vec<(f64, f64)> = curve.collect();
        let (&last, rest) = curve.split_last()?;
        let (mut area, mut best) = (0.0, last);
        for &(precision, recall) in rest.iter().rev() {
            if precision > best.0 {
                area += best.0 * (best.1 - recall);
                best = (precision, recall);
            }
        }
        Some(area + best.0 * best.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    fn samples(
        predictions: &[&[(f64, Option<bool>)]],
        later_matches_count: bool,
    ) -> PrecisionSamples {
        let mut samples = PrecisionSamples::default();
        for modes in predictions {
            let mode = |&(confidence, matches): &(f64, Option<bool>)| ModeScore {
                confidence,
                matches,
            };
            let modes: Vec<_> = modes.iter().map(mode).collect();
            samples.add(&modes, later_matches_count);
        }
        samples
    }

    #[test]
    fn one_prediction_by_hand() {
        // Hit at rank 2 of 3: recall 1 at precision 1/2.
        let modes = [(0.5, Some(false)), (0.2, Some(false)), (0.3, Some(true))];
        let found = samples(&[&modes], true).average_precision().unwrap();
        assert_abs_diff_eq!(found, 0.5, epsilon = 1e-7);
    }

    #[test]
    fn two_predictions_by_hand() {
        // By confidence: hit (1/1, 1/2), miss, hit (2/3, 1), miss. Area 1/2 + 1/2 * 2/3.
        let a = [(0.9, Some(true)), (0.1, Some(false))];
        let b = [(0.8, Some(false)), (0.7, Some(true))];
        for predictions in [[&a[..], &b[..]], [&b[..], &a[..]]] {
            let found = samples(&predictions, true).average_precision().unwrap();
            assert_abs_diff_eq!(found, 5.0 / 6.0, epsilon = 1e-7);
        }
    }

    #[test]
    fn a_second_match_is_a_false_alarm_unless_soft() {
        let a = [(0.9, Some(true)), (0.8, Some(true))];
        let b = [(0.7, Some(true))];
        let hard = samples(&[&a, &b], true);
        assert_eq!(hard.samples().len(), 3);
        assert_abs_diff_eq!(hard.average_precision().unwrap(), 5.0 / 6.0, epsilon = 1e-7);
        let soft = samples(&[&a, &b], false);
        assert_eq!(soft.samples().len(), 2);
        assert_abs_diff_eq!(soft.average_precision().unwrap(), 1.0);
    }

    #[test]
    fn of_equal_confidences_false_alarms_come_first() {
        let a = [(0.5, Some(true))];
        let b = [(0.5, Some(false))];
        for predictions in [[&a, &b], [&b, &a]] {
            // Miss, then hit: precision 1/2 at recall 1/2.
            let predictions = predictions.map(|modes| &modes[..]);
            let found = samples(&predictions, true).average_precision().unwrap();
            assert_abs_diff_eq!(found, 0.25, epsilon = 1e-7);
        }
    }

    #[test]
    fn unknown_modes_do_not_count() {
        let nobody_knows = samples(&[&[(0.5, None)]], true);
        assert_eq!(nobody_knows.n_predictions(), 0);
        assert_eq!(nobody_knows.average_precision(), None);
        let missed = samples(&[&[(0.5, None), (0.4, Some(false))]], true);
        assert_eq!((missed.n_predictions(), missed.samples().len()), (1, 1));
        assert_eq!(missed.average_precision(), Some(0.0));
    }
}
