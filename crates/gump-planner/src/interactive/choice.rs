//! Values of candidates from their simulated futures, and the choice among them.

use std::cmp::Ordering;

use gump_metrics::{ComfortBounds, Gate, Score, Term};
use gump_nuplan::metrics::{ComfortSeries, MAX_OVERSPEED, Motion};
use gump_scene::{EgoState, Frame, Rollout};
use rayon::prelude::*;

use super::imagine::{CandidateFuture, DECISION};
use super::{Aggregate, CandidateEvaluation, InteractiveDriverConfig, ValueEstimate};
use crate::ProposalKind;
use crate::pdm::propose::DT;
use crate::pdm::score::{Judge, NO_PROGRESS, PdmScore, normalize};
use crate::pdm::{BRAKE_SPEED, BRAKE_STEPS};

/// Values within this are a tie, so that rounding does not decide: far more than its errors, far
/// less than any difference of scores that matters.
const TIE: f64 = 1e-6;

/// The result of a candidate over its futures.
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
    /// Summarises the futures of a candidate; `None` if there are none.
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

    /// True if some gate is closed in every future, so that the candidate has no value.
    #[cfg(test)]
    pub(crate) fn is_hopeless(&self) -> bool {
        let closed = |score: &Score| score.gates.iter().any(|gate| gate.factor == 0.0);
        self.futures.iter().all(closed)
    }
}

/// Scorer of the drives of a decision: PDM's score with the terms and weights of nuPlan's.
#[derive(Clone, Copy)]
pub(super) struct Reward<'a> {
    pub(super) judge: Judge<'a>,
    pub(super) value: ValueEstimate,
    /// The drive so far, oldest first, which nuPlan's metric includes: a drive that begins with a
    /// jolt is not comfortable.
    pub(super) past: &'a [EgoState],
    /// The stated limit, metres per second.
    pub(super) limit: Option<f64>,
}

/// The score of a future with its parts.
#[derive(Clone, Debug)]
pub(super) struct Judged {
    parts: PdmScore,
    /// Whatever is driven from this step on is no progress.
    closes_up_at: Option<usize>,
    /// 1 if never too fast; falls with the mean excess.
    speed_limit: f64,
    /// The total.
    total: f64,
}

/// Weights of progress, time to collision, the speed limit and comfort, as in nuPlan's score.
const WEIGHTS: [f64; 4] = [5.0, 5.0, 4.0, 2.0];

impl Judged {
    /// The total, 0 to 1.
    pub(super) fn total(&self) -> f64 {
        self.total
    }

    fn terms(&self) -> [f64; 4] {
        let parts = &self.parts;
        [
            parts.progress,
            parts.time_to_collision,
            self.speed_limit,
            parts.comfort,
        ]
    }
}

impl Reward<'_> {
    /// The score of every future, with the `n_futures` of a candidate after another; progress is
    /// relative to the farthest candidate in the same future.
    pub(super) fn judge(&self, futures: &[CandidateFuture], n_futures: usize) -> Vec<Judged> {
        let judged = futures.par_iter().map(|future| {
            let judge = Judge {
                forecast: &future.forecast,
                ..self.judge
            };
            let drive = &future.drive;
            let mut parts = judge.parts(drive, self.is_comfortable(drive));
            // Driving up to the bumper of who stands ahead is not worth anything: the last metre
            // would otherwise be all that candidates in a queue differ in.
            let closes_up_at = judge.closes_up_at(drive);
            if let Some(step) = closes_up_at {
                let counted = judge.place(&drive[step]) - judge.place(&drive[0]);
                parts.progress_m = parts.progress_m.min(counted.max(0.0));
            }
            (parts, closes_up_at)
        });
        let (mut parts, closing): (Vec<PdmScore>, Vec<Option<usize>>) = judged.unzip();
        for future in 0..n_futures {
            let of_future = || (future..futures.len()).step_by(n_futures);
            let mut group: Vec<PdmScore> = of_future().map(|i| parts[i].clone()).collect();
            normalize(&mut group);
            of_future()
                .zip(group)
                .for_each(|(i, score)| parts[i] = score);
        }
        let all = futures.iter().zip(parts).zip(closing);
        let all = all.map(|((future, parts), closes_up_at)| {
            let mut judged = Judged {
                parts,
                closes_up_at,
                speed_limit: self.speed_limit(&future.drive),
                total: 0.0,
            };
            judged.total = judged.parts.gates() * weighted_mean(judged.terms());
            judged
        });
        let mut all: Vec<Judged> = all.collect();
        if let ValueEstimate::DiscountedStep { gamma } = self.value {
            for future in 0..n_futures {
                let mut of_future: Vec<(&mut Judged, &[EgoState])> = all
                    .iter_mut()
                    .zip(futures)
                    .skip(future)
                    .step_by(n_futures)
                    .map(|(judged, simulated)| (judged, &simulated.drive[..]))
                    .collect();
                discount(&mut of_future, &self.judge, gamma);
            }
        }
        all
    }

    /// Whether the last part of the drive and the planned one are comfortable by nuPlan's metric.
    fn is_comfortable(&self, drive: &[EgoState]) -> bool {
        let states: Vec<EgoState> = self.past.iter().chain(drive).copied().collect();
        let series = ComfortSeries::of(&Motion::of(self.judge.vehicle, &states));
        series.is_none_or(|series| series.is_comfortable(&ComfortBounds::NUPLAN))
    }

    fn speed_limit(&self, drive: &[EgoState]) -> f64 {
        let Some(limit) = self.limit else {
            return 1.0;
        };
        let excess = drive.iter().map(|state| (state.speed() - limit).max(0.0));
        let mean = excess.sum::<f64>() / drive.len() as f64;
        (1.0 - mean / MAX_OVERSPEED).max(0.0)
    }
}

/// Replaces the totals of one future's candidates by discounted sums over half seconds.
fn discount(rows: &mut [(&mut Judged, &[EgoState])], judge: &Judge<'_>, gamma: f64) {
    let n = (rows[0].1.len() - 1) / DECISION;
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
    let places: Vec<Vec<f64>> = rows
        .iter()
        .map(|(judged, drive)| {
            let end = judged.closes_up_at.unwrap_or(drive.len());
            let steps = (0..drive.len()).step_by(DECISION);
            steps
                .map(|step| judge.place(&drive[step.min(end)]))
                .collect()
        })
        .collect();
    let (mut sums, mut weights) = (vec![0.0; rows.len()], 0.0);
    for t in 1..=n {
        let gained: Vec<f64> = rows
            .iter()
            .zip(&places)
            .map(|((judged, _), s)| (s[t] - s[t - 1]).max(0.0) * open(&judged.parts, t))
            .collect();
        let most = gained.iter().copied().fold(0.0, f64::max);
        let weight = gamma.powi(t as i32 - 1);
        weights += weight;
        for ((sum, (judged, _)), gained) in sums.iter_mut().zip(&*rows).zip(gained) {
            let score = &judged.parts;
            let progress = if most > NO_PROGRESS / n as f64 {
                gained / most
            } else {
                1.0
            };
            let clear = score.ttc_step.is_none_or(|step| step > t * DECISION);
            let clear = f64::from(u8::from(clear));
            let terms = [progress, clear, judged.speed_limit, score.comfort];
            *sum += weight * open(score, t) * weighted_mean(terms);
        }
    }
    for ((judged, _), sum) in rows.iter_mut().zip(sums) {
        judged.total = sum / weights;
    }
}

fn weighted_mean(terms: [f64; 4]) -> f64 {
    let sum: f64 = terms.iter().zip(WEIGHTS).map(|(t, w)| t * w).sum();
    sum / WEIGHTS.iter().sum::<f64>()
}

/// The futures of one candidate so far.
#[derive(Default)]
pub(super) struct Tally {
    futures: Vec<CandidateFuture>,
    scores: Vec<Judged>,
    /// The score among agents that keep their velocity, where it counts.
    hedge: Option<Judged>,
    /// Deducted from the value.
    cost: f64,
    /// Of a candidate that rests: for how many decisions, and its last value.
    rest: Option<(usize, f64)>,
}

/// The value by which a candidate is chosen.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Standing {
    value: f64,
    collisions: usize,
    progress_m: f64,
    collision_s: f64,
}

impl Tally {
    /// No futures yet, of a candidate whose choice costs so much.
    pub(super) fn new(cost: f64) -> Self {
        Self {
            cost,
            ..Self::default()
        }
    }

    /// Adds simulated and scored futures.
    pub(super) fn add(&mut self, judged: impl Iterator<Item = (CandidateFuture, Judged)>) {
        for (future, score) in judged {
            self.futures.push(future);
            self.scores.push(score);
        }
    }

    /// Sets the score among agents that keep their velocity.
    pub(super) fn hedge(&mut self, score: Judged) {
        self.hedge = Some(score);
    }

    /// Instead of futures in the world, the one in which others keep their velocity, with its frames;
    /// the value is the `value` of the last decision in which it was simulated, `rests` decisions ago.
    pub(super) fn rest(
        &mut self,
        future: CandidateFuture,
        score: Judged,
        rests: usize,
        value: f64,
    ) {
        (self.futures, self.scores) = (vec![future], vec![score]);
        self.rest = Some((rests, value));
    }

    fn score(&self) -> CandidateScore {
        let scores = self.scores.iter().map(score_of).collect();
        CandidateScore::new(scores).expect("every candidate has a future")
    }

    fn standing(&self, config: &InteractiveDriverConfig) -> Standing {
        let n = self.scores.len() as f64;
        // A short horizon without a collision is no emergency.
        let never = (self.futures[0].drive.len() - 1).max(2 * BRAKE_STEPS);
        let mean = |part: &dyn Fn(&PdmScore) -> f64| {
            let parts = self.scores.iter().map(|judged| part(&judged.parts));
            parts.sum::<f64>() / n
        };
        let score = self.score();
        let value = match config.aggregate {
            Aggregate::Mean => {
                let deviation = score.standard_error.map_or(0.0, |error| error * n.sqrt());
                score.mean - config.caution * deviation
            }
            Aggregate::Worst => {
                let totals = self.scores.iter().map(|judged| judged.total);
                totals.fold(f64::INFINITY, f64::min)
            }
        };
        let value = self
            .hedge
            .as_ref()
            .map_or(value, |hedge| value + config.hedge * (hedge.total - value));
        // What has no value costs nothing: the least evil is chosen by other means.
        let value = (value - self.cost).max(value.min(0.0));
        let collided = self.scores.iter();
        let collided = collided.filter(|judged| judged.parts.collision_step.is_some());
        Standing {
            value,
            collisions: collided.count(),
            progress_m: mean(&|score| score.progress_m),
            collision_s: mean(&|score| score.collision_step.unwrap_or(never) as f64 * DT),
        }
    }

    /// The reported details of the candidate.
    pub(super) fn sum_up(
        self,
        kind: ProposalKind,
        finalist: bool,
        config: &InteractiveDriverConfig,
        film: impl Fn(Vec<Frame>) -> Rollout,
    ) -> CandidateEvaluation {
        let standing = self.standing(config);
        let score = self.score();
        let hedge = self.hedge.as_ref().map(score_of);
        let (mut futures, mut drives) = (Vec::new(), Vec::new());
        for future in self.futures {
            futures.push(film(future.frames));
            drives.push(future.drive);
        }
        CandidateEvaluation {
            kind,
            value: self.rest.map_or(standing.value, |(_, value)| value),
            score,
            hedge,
            finalist,
            rests: self.rest.map_or(0, |(rests, _)| rests),
            collisions: standing.collisions,
            progress_m: standing.progress_m,
            collision_s: standing.collision_s,
            futures,
            drives,
        }
    }
}

/// The better half of so many candidates, at least two.
pub(super) fn half(n: usize) -> usize {
    n.div_ceil(2).max(2)
}

/// The best `n` of some candidates with futures, in their order.
pub(super) fn best_of(
    tallies: &[Tally],
    among: &[usize],
    n: usize,
    config: &InteractiveDriverConfig,
) -> Vec<usize> {
    let mut standing = vec![Standing::default(); tallies.len()];
    for &i in among {
        standing[i] = tallies[i].standing(config);
    }
    let mut left = among.to_vec();
    let mut kept = Vec::new();
    while kept.len() < n && !left.is_empty() {
        let best = first_of(&standing, &left, None, 0.0);
        left.retain(|&i| i != best);
        kept.push(best);
    }
    kept.sort_unstable();
    kept
}

/// Converts a score into the form that all planners report.
fn score_of(judged: &Judged) -> Score {
    let parts = &judged.parts;
    let gate = |name, factor| Gate { name, factor };
    let sum: f64 = WEIGHTS.iter().sum();
    let names = ["progress", "time_to_collision", "speed_limit", "comfort"];
    let terms = names.into_iter().zip(WEIGHTS).zip(judged.terms());
    Score {
        total: judged.total,
        gates: vec![
            gate("no_at_fault_collisions", parts.no_at_fault_collision),
            gate("drivable_area", parts.drivable_area),
            gate("driving_direction", parts.driving_direction),
        ],
        terms: terms
            .map(|((name, weight), value)| Term {
                name,
                weight: weight / sum,
                value: Some(value),
            })
            .collect(),
    }
}

/// The best candidate of those that were simulated to the end; ties are broken as
/// [`super::InteractiveDriver`] states.
pub(super) fn choose(
    evaluations: &[CandidateEvaluation],
    previous: Option<usize>,
    hysteresis: f64,
) -> usize {
    let standing = evaluations.iter().map(|evaluation| Standing {
        value: evaluation.value,
        collisions: evaluation.collisions,
        progress_m: evaluation.progress_m,
        collision_s: evaluation.collision_s,
    });
    let finalists: Vec<usize> = (0..evaluations.len())
        .filter(|&i| evaluations[i].finalist)
        .collect();
    let standing: Vec<Standing> = standing.collect();
    first_of(&standing, &finalists, previous, hysteresis)
}

/// The best of some candidates, of which there is at least one.
fn first_of(
    standing: &[Standing],
    among: &[usize],
    previous: Option<usize>,
    hysteresis: f64,
) -> usize {
    let worth = |i: usize| {
        let kept = previous == Some(i) && standing[i].value > 0.0;
        standing[i].value + if kept { hysteresis } else { 0.0 }
    };
    let hopeless = among.iter().all(|&i| standing[i].value <= TIE);
    let better = |a: usize, b: usize| {
        let (x, y) = (&standing[a], &standing[b]);
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
    let mut best = among[0];
    for &i in &among[1..] {
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

/// True if even the chosen candidate collides soon in most futures and the ego is slow enough for
/// the brake.
pub(super) fn is_emergency(chosen: &CandidateEvaluation, ego: &EgoState) -> bool {
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
