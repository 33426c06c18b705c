//! What the imagined futures are worth, and which candidate to take.

use std::cmp::Ordering;

use gump_metrics::{Gate, Score, Term};
use gump_scene::{EgoState, Frame, Rollout};
use rayon::prelude::*;

use super::imagine::{DECISION, Row};
use super::{InteractiveDriverConfig, Prospect, Worth};
use crate::ProposalKind;
use crate::pdm::comfort::ComfortFilters;
use crate::pdm::propose::DT;
use crate::pdm::score::{Judge, NO_PROGRESS, PdmScore, WEIGHTS, normalize};
use crate::pdm::{BRAKE_SPEED, BRAKE_STEPS};

/// Two values this close are a tie; rounding must not decide.
const TIE: f64 = 1e-6;

/// How a candidate did over the imagined futures.
#[derive(Clone, Debug, PartialEq)]
pub struct CandidateScore {
    /// Mean reward over the futures.
    pub mean: f64,
    /// Standard error of the mean; `None` with fewer than two futures.
    pub standard_error: Option<f64>,
    /// The reward of each future with its parts, in their order; never empty.
    pub futures: Vec<Score>,
}

impl CandidateScore {
    /// Sums up the futures of a candidate; `None` if there is none.
    pub fn new(futures: Vec<Score>) -> Option<Self> {
        let n = futures.len() as f64;
        if futures.is_empty() {
            return None;
        }
        let mean = futures.iter().map(|score| score.total).sum::<f64>() / n;
        let squares: f64 = futures
            .iter()
            .map(|score| (score.total - mean).powi(2))
            .sum();
        let standard_error = (futures.len() > 1).then(|| (squares / (n - 1.0) / n).sqrt());
        Some(Self {
            mean,
            standard_error,
            futures,
        })
    }

    /// Means over the futures of every gate's factor and every term's value, by name.
    pub fn parts(&self) -> Vec<(&'static str, f64)> {
        let Some(first) = self.futures.first() else {
            return Vec::new();
        };
        let n = self.futures.len() as f64;
        let mean = |value: &dyn Fn(&Score) -> f64| self.futures.iter().map(value).sum::<f64>() / n;
        let gates = (0..first.gates.len())
            .map(|i| (first.gates[i].name, mean(&|score| score.gates[i].factor)));
        let terms = (0..first.terms.len()).map(|i| {
            let value = |score: &Score| score.terms[i].value.unwrap_or(0.0);
            (first.terms[i].name, mean(&value))
        });
        gates.chain(terms).collect()
    }

    /// True if some gate is closed in every future: there is nothing good about the candidate.
    pub fn is_hopeless(&self) -> bool {
        let closed = |score: &Score| score.gates.iter().any(|gate| gate.factor == 0.0);
        self.futures.iter().all(closed)
    }
}

/// The score of every row; progress is a share of the farthest candidate's in the same future.
pub(super) fn judge(
    rows: &[Row],
    judge: &Judge<'_>,
    comfort: &ComfortFilters,
    config: &InteractiveDriverConfig,
    n_decisions: usize,
) -> Vec<PdmScore> {
    let n_states = n_decisions * DECISION + 1;
    let filters = || {
        if comfort.n() == n_states {
            comfort.clone()
        } else {
            ComfortFilters::new(n_states, DT)
        }
    };
    let parts = rows.par_iter().map_init(filters, |filters, row| {
        let judge = Judge {
            forecast: &row.forecast,
            ..*judge
        };
        judge.parts(&row.drive, filters)
    });
    let mut scores: Vec<PdmScore> = parts.collect();
    for future in 0..config.n_futures {
        let of_future = || (future..rows.len()).step_by(config.n_futures);
        let mut group: Vec<PdmScore> = of_future().map(|i| scores[i].clone()).collect();
        normalize(&mut group);
        if let Worth::DiscountedStep { gamma } = config.worth {
            let drives: Vec<&[EgoState]> = of_future().map(|i| &rows[i].drive[..]).collect();
            discount(&mut group, &drives, judge, gamma);
        }
        for (i, score) in of_future().zip(group) {
            scores[i] = score;
        }
    }
    scores
}

/// Replaces the totals of one future's candidates by discounted sums over half seconds.
fn discount(scores: &mut [PdmScore], drives: &[&[EgoState]], judge: &Judge<'_>, gamma: f64) {
    let n = (drives[0].len() - 1) / DECISION;
    let open = |score: &PdmScore, t: usize| {
        let by_then = |step: Option<usize>| step.is_some_and(|step| step <= t * DECISION);
        let hit = if by_then(score.collision_step) {
            score.no_at_fault_collision
        } else {
            1.0
        };
        let on_road = f64::from(u8::from(!by_then(score.off_road_step)));
        hit * on_road * score.driving_direction
    };
    let places: Vec<Vec<f64>> = drives
        .iter()
        .map(|drive| {
            let states = drive.iter().step_by(DECISION);
            states.map(|state| judge.place(state)).collect()
        })
        .collect();
    let (mut sums, mut weights) = (vec![0.0; scores.len()], 0.0);
    for t in 1..=n {
        let gained: Vec<f64> = scores
            .iter()
            .zip(&places)
            .map(|(score, s)| (s[t] - s[t - 1]).max(0.0) * open(score, t))
            .collect();
        let most = gained.iter().copied().fold(0.0, f64::max);
        let weight = gamma.powi(t as i32 - 1);
        weights += weight;
        for ((sum, score), gained) in sums.iter_mut().zip(&*scores).zip(gained) {
            let progress = if most > NO_PROGRESS / n as f64 {
                gained / most
            } else {
                1.0
            };
            let clear = score.ttc_step.is_none_or(|step| step > t * DECISION);
            let terms = [progress, f64::from(u8::from(clear)), score.comfort];
            *sum += weight * open(score, t) * weighted_mean(terms);
        }
    }
    for (score, sum) in scores.iter_mut().zip(sums) {
        score.total = sum / weights;
    }
}

fn weighted_mean(terms: [f64; 3]) -> f64 {
    let sum: f64 = terms.iter().zip(WEIGHTS).map(|(t, w)| t * w).sum();
    sum / WEIGHTS.iter().sum::<f64>()
}

/// Rows and scores, candidate by candidate.
pub(super) fn summarize(
    rows: Vec<Row>,
    scores: &[PdmScore],
    config: &InteractiveDriverConfig,
    kind: impl Fn(usize) -> ProposalKind,
    film: impl Fn(Vec<Frame>) -> Rollout,
) -> Vec<Prospect> {
    let mut prospects = Vec::new();
    let mut rows = rows.into_iter();
    for scores in scores.chunks(config.n_futures) {
        let (mut futures, mut drives, mut candidate) = (Vec::new(), Vec::new(), 0);
        for row in rows.by_ref().take(scores.len()) {
            candidate = row.candidate;
            futures.push(film(row.frames));
            drives.push(row.drive);
        }
        let steps = drives[0].len() - 1;
        let n = scores.len() as f64;
        let mean = |part: &dyn Fn(&PdmScore) -> f64| scores.iter().map(part).sum::<f64>() / n;
        let told = scores.iter().map(told).collect();
        let score = CandidateScore::new(told).expect("there is at least one future");
        let deviation = score.standard_error.map_or(0.0, |error| error * n.sqrt());
        prospects.push(Prospect {
            kind: kind(candidate),
            value: score.mean - config.caution * deviation,
            score,
            collisions: scores.iter().filter(|s| s.collision_step.is_some()).count(),
            progress_m: mean(&|score| score.progress_m),
            collision_s: mean(&|score| score.collision_step.unwrap_or(steps) as f64 * DT),
            futures,
            drives,
        });
    }
    prospects
}

/// A score in the form that all planners tell theirs.
fn told(score: &PdmScore) -> Score {
    let gate = |name, factor| Gate { name, factor };
    let sum: f64 = WEIGHTS.iter().sum();
    let term = |name, weight: f64, value| Term {
        name,
        weight: weight / sum,
        value: Some(value),
    };
    Score {
        total: score.total,
        gates: vec![
            gate("no_at_fault_collisions", score.no_at_fault_collision),
            gate("drivable_area", score.drivable_area),
            gate("driving_direction", score.driving_direction),
        ],
        terms: vec![
            term("progress", WEIGHTS[0], score.progress),
            term("time_to_collision", WEIGHTS[1], score.time_to_collision),
            term("comfort", WEIGHTS[2], score.comfort),
        ],
    }
}

/// The best prospect; ties are broken as [`super::InteractiveDriver`] says.
pub(super) fn choose(prospects: &[Prospect], previous: Option<usize>, hysteresis: f64) -> usize {
    let worth = |i: usize| {
        let kept = previous == Some(i) && prospects[i].value > 0.0;
        prospects[i].value + if kept { hysteresis } else { 0.0 }
    };
    let hopeless = prospects.iter().all(|prospect| prospect.value <= TIE);
    let better = |a: usize, b: usize| {
        let (x, y) = (&prospects[a], &prospects[b]);
        let first = if hopeless {
            clearly(x.collision_s, y.collision_s)
        } else {
            clearly(worth(a), worth(b))
        };
        first
            .then(y.collisions.cmp(&x.collisions))
            .then(clearly(x.progress_m, y.progress_m))
            .then((previous == Some(a)).cmp(&(previous == Some(b))))
    };
    let mut best = 0;
    for i in 1..prospects.len() {
        if better(i, best) == Ordering::Greater {
            best = i;
        }
    }
    best
}

fn clearly(a: f64, b: f64) -> Ordering {
    if (a - b).abs() <= TIE {
        Ordering::Equal
    } else {
        a.total_cmp(&b)
    }
}

/// True if even the chosen one hits something soon in most futures and the ego is slow enough for
/// the brake.
pub(super) fn is_emergency(chosen: &Prospect, ego: &EgoState) -> bool {
    let soon = chosen.collision_s <= BRAKE_STEPS as f64 * DT;
    soon && ego.speed() <= BRAKE_SPEED
}

#[cfg(test)]
mod tests {
    use super::*;

    fn score(total: f64, factor: f64) -> Score {
        Score {
            total,
            gates: vec![Gate {
                name: "collision",
                factor,
            }],
            terms: vec![],
        }
    }

    #[test]
    fn the_error_of_a_mean_by_hand() {
        let futures = vec![score(1.0, 1.0), score(2.0, 0.0), score(6.0, 1.0)];
        let found = CandidateScore::new(futures).unwrap();
        assert_eq!(found.mean, 3.0);
        // Variance (4 + 1 + 9) / 2 = 7 over three futures.
        assert_eq!(found.standard_error, Some((7.0f64 / 3.0).sqrt()));
        assert!(!found.is_hopeless());
        let single = CandidateScore::new(vec![score(0.0, 0.0)]).unwrap();
        assert_eq!(single.standard_error, None);
        assert!(single.is_hopeless());
        assert_eq!(CandidateScore::new(vec![]), None);
    }
}
