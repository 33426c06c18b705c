//! Rollouts of candidates: policies and world take turns, half a second each.

use std::sync::Arc;
use std::time::Duration;

use gump_geometry::Pose;
use gump_nuplan::closed_loop::PlannerInput;
use gump_rollout::worlds::IdmConfig;
use gump_rollout::{BoxError, RolloutError, Session, Start, WorldModel};
use gump_scene::{AgentId, AgentState, EgoState, Frame, Rollout, SceneState, Seed};
use rayon::prelude::*;

use super::choice::{Judged, Reward, Tally, best_of, half};
use super::modes::Following;
use super::policies::{self, Policy};
use super::{Allocation, Decision, InteractiveDriverConfig, Phases, steps};
use crate::pdm::forecast::{Forecast, MOMENT_DT};
use crate::pdm::propose::{Corridor, DT, Proposal, Proposer};
use crate::pdm::score::Judge;
use crate::pdm::state::State;
use crate::pdm::track::Tracker;
use crate::{PlanError, ProposalKind};

/// Steps of a tenth of a second that a policy drives before the world reacts, a step of the learned
/// world ...
pub(super) const DECISION: usize = 5;
/// ... and the same in seconds.
pub(super) const DECISION_S: f64 = 0.5;
/// Steps that a policy plans ahead each time: those it drives and the second that the tracker
/// needs.
const LOOK: usize = DECISION + 10;
/// Seconds of history given to a world: the learned one's three frames.
const HISTORY_S: f64 = 1.0;

/// Inputs of the rollouts.
pub(super) struct Imagination<'a> {
    pub(super) world: &'a dyn WorldModel,
    pub(super) config: &'a InteractiveDriverConfig,
    /// Prepared for the decision.
    pub(super) state: &'a State,
    pub(super) speeds: &'a [f64],
    pub(super) input: &'a PlannerInput<'a>,
    pub(super) clock: &'a dyn Fn() -> Duration,
    /// The last decision of this drive.
    pub(super) last: Option<&'a Decision>,
    /// Number of decisions before this one.
    pub(super) n_decisions: usize,
    /// The drive of the world's ego that is followed.
    pub(super) following: Option<&'a Following>,
}

/// Past states, a tenth of a second apart, used for comfort: nuPlan's longest filter needs 1.5 s,
/// and the rest is a margin.
const COMFORT_PAST: usize = 20;

/// Separates the random numbers of later rounds from those of iterations, which never reach it.
pub(super) const ROUND: u64 = 1 << 32;

/// Some futures of some candidates, simulated together.
#[derive(Clone, Copy)]
pub(super) struct Round<'a> {
    /// Time at which the decision began.
    pub(super) began: Duration,
    pub(super) scene: SceneState<'a>,
    proposer: &'a Proposer<'a>,
    /// The corridor of every line.
    corridors: &'a [Corridor],
    /// Indices of the candidates in order; imitation, which is the last, has no policy.
    candidates: &'a [usize],
    /// Number of futures of every candidate.
    n_futures: usize,
    /// Half seconds to imagine.
    n_decisions: usize,
    /// Future *k* of every candidate has the same random numbers.
    seed: Seed,
}

impl Allocation {
    /// Futures of a candidate in every round, `n` together.
    fn rounds(self, n: usize) -> Vec<usize> {
        let mut rounds = Vec::new();
        let mut done = 0;
        while done < n {
            let next = match self {
                Self::Uniform => n,
                Self::Halving => done.max(1).min(n - done),
            };
            rounds.push(next);
            done += next;
        }
        rounds
    }
}

/// One future of one candidate.
pub(super) struct CandidateFuture {
    /// The other agents as simulated so far.
    pub(super) forecast: Forecast,
    /// The policy's own line so far; none for imitation.
    policy: Proposal,
    /// Car-following law of the policy.
    law: IdmConfig,
    /// The fixed drive of a mode, from now on.
    course: Option<Arc<[EgoState]>>,
    /// States of the car that tracks it, from now on.
    pub(super) drive: Vec<EgoState>,
    /// Frames of the world, one per decision; shorter where the future was dropped.
    pub(super) frames: Vec<Frame>,
    /// True once the future can have no value any more: it is not simulated further.
    lost: bool,
}

/// A candidate before it has driven: a policy with the law that it drives by, or a fixed drive.
#[derive(Clone, Debug, Default)]
pub(super) struct Begun {
    policy: Proposal,
    law: IdmConfig,
    course: Option<Arc<[EgoState]>>,
}

impl<'a> Imagination<'a> {
    /// Rolls all candidates out and scores them; none is chosen yet.
    pub(super) fn imagine(&self) -> Result<Decision, PlanError> {
        let began = (self.clock)();
        let mut phases = Phases::default();
        let history = self.surroundings();
        let scene = SceneState {
            history: &history,
            ..self.input.scene
        };
        let proposer = self.state.proposer(&self.config.proposals.law, self.speeds);
        let policies = policies::all(self.config, self.speeds, self.state.lane_changes());
        let mut begun = self.begin(&proposer, &policies);
        let corridors: Vec<Corridor> = (0..proposer.lines.len())
            .map(|line| {
                let place = self.input.ego.rear_axle.position;
                proposer.corridor(line, proposer.lines[line].project(place))
            })
            .collect();
        let mut horizon = steps(&self.config.budget) / DECISION;
        // Sessions of a round stay open, so that those of later ones may share what they read.
        let mut opened: Vec<Box<dyn Session + '_>> = Vec::new();
        let modes = self.modes(scene, began, horizon, &mut opened, &mut phases)?;
        begun.extend(modes.iter().map(|mode| Begun {
            course: Some(mode.drive.clone()),
            ..Begun::default()
        }));
        let mut kinds: Vec<ProposalKind> = policies.iter().map(|policy| policy.kind).collect();
        kinds.extend(modes.iter().map(|mode| mode.kind()));
        if self.config.imitation {
            kinds.push(ProposalKind::Imitation);
        }
        let cost = |i: usize| policies.get(i).map_or(0.0, |policy| policy.cost);
        let n_candidates = kinds.len();
        let mut tallies: Vec<Tally> = (0..n_candidates).map(|i| Tally::new(cost(i))).collect();
        let mut resting = self.resting(&kinds);
        let mut left: Vec<usize> = (0..n_candidates)
            .filter(|&i| resting.iter().all(|rest| rest.candidate != i))
            .collect();
        let rounds = self.config.allocation.rounds(self.config.n_futures);
        for (r, &n_futures) in rounds.iter().enumerate() {
            let round = Round {
                began,
                scene,
                proposer: &proposer,
                corridors: &corridors,
                candidates: &left,
                n_futures,
                n_decisions: horizon,
                seed: self.seed(r),
            };
            let (mut futures, imagined) = self.round(&round, &begun, &mut opened, &mut phases)?;
            if r > 0 && imagined < horizon {
                // Time is up. What all others were judged by reaches farther.
                break;
            }
            horizon = imagined;
            let mut time = (self.clock)();
            let mut scores = self.reward().judge(&futures, n_futures);
            let n_before = left.len() + resting.len();
            let mut hedged = Vec::new();
            if r == 0 && (self.config.hedge > 0.0 || !resting.is_empty()) {
                let own = left.last() == Some(&begun.len());
                let own = own.then(|| &futures[futures.len() - n_futures]);
                hedged = self.hedge(&round, &begun, horizon, n_candidates, own);
            }
            if r == 0 && !resting.is_empty() {
                let woken = self.woken(&resting, &left, &scores, &hedged, cost);
                phases.score += (self.clock)() - time;
                if !woken.is_empty() {
                    let again = Round {
                        candidates: &woken,
                        n_decisions: horizon,
                        ..round
                    };
                    let (more, reached) = self.round(&again, &begun, &mut opened, &mut phases)?;
                    if reached == horizon {
                        let mut all: Vec<(usize, CandidateFuture)> =
                            left.iter().copied().zip(futures).collect();
                        all.extend(woken.iter().copied().zip(more));
                        all.sort_by_key(|(candidate, _)| *candidate);
                        (left, futures) = all.into_iter().unzip();
                        resting.retain(|rest| !woken.contains(&rest.candidate));
                    }
                }
                time = (self.clock)();
                // Progress is relative to the farthest of all.
                scores = self.reward().judge(&futures, n_futures);
            }
            let mut judged = futures.into_iter().zip(scores);
            for &candidate in &left {
                let own = judged.by_ref().take(n_futures);
                tallies[candidate].add(own);
            }
            self.settle(hedged, &resting, scene, &mut tallies);
            if r + 1 < rounds.len() {
                // Who rests would have dropped out.
                let n = half(if r == 0 { n_before } else { left.len() });
                left = best_of(&tallies, &left, n, self.config);
            }
            phases.score += (self.clock)() - time;
        }
        let time = (self.clock)();
        let evaluations = tallies.into_iter().zip(&kinds).enumerate();
        let evaluations = evaluations.map(|(i, (tally, &kind))| {
            let film = |frames| film(scene, frames);
            tally.sum_up(kind, left.contains(&i), self.config, film)
        });
        let evaluations = evaluations.collect();
        phases.score += (self.clock)() - time;
        Ok(Decision {
            chosen: 0,
            brakes: false,
            candidates: evaluations,
            horizon: horizon as f64 * DECISION_S,
            phases,
        })
    }

    /// Scores all candidates among agents that keep their velocity, as PDM forecasts them. Policies
    /// drive anew there; imitation, which has none, as it did in its first future, `own`.
    fn hedge(
        &self,
        round: &Round<'_>,
        begun: &[Begun],
        n_decisions: usize,
        n_candidates: usize,
        own: Option<&CandidateFuture>,
    ) -> Vec<(CandidateFuture, Judged)> {
        let all: Vec<usize> = (0..n_candidates).collect();
        let one = Round {
            n_futures: 1,
            candidates: &all,
            ..*round
        };
        let mut futures = self.futures(&one, begun);
        let n_ruled = begun.len().min(futures.len());
        for _ in 0..n_decisions {
            self.drive(one.proposer, one.corridors, &mut futures[..n_ruled]);
        }
        for (future, own) in futures[n_ruled..].iter_mut().zip(own) {
            future.drive.clone_from(&own.drive);
        }
        let scores = self.reward().judge(&futures, 1);
        futures.into_iter().zip(scores).collect()
    }

    /// Seed of a round: the same for all candidates.
    pub(super) fn seed(&self, round: usize) -> Seed {
        let seed = self.config.seed.fork(self.input.iteration as u64);
        match round {
            0 => seed,
            _ => seed.fork(ROUND + round as u64),
        }
    }

    /// Simulates some futures of some candidates; returns them, those of one candidate after
    /// another, and the number of half seconds reached.
    fn round(
        &self,
        round: &Round<'_>,
        begun: &[Begun],
        opened: &mut Vec<Box<dyn Session + 'a>>,
        phases: &mut Phases,
    ) -> Result<(Vec<CandidateFuture>, usize), PlanError> {
        let time = (self.clock)();
        let mut futures = self.futures(round, begun);
        let imitates = round.candidates.last() == Some(&begun.len());
        let n_ruled = futures.len() - if imitates { round.n_futures } else { 0 };
        let start = Start {
            scene: round.scene,
            n_futures: round.n_futures,
            seed: round.seed,
        };
        let open = |starts: &[Start<'_>]| {
            let opened = self.world.open(starts);
            opened.map_err(|error| self.failed(error))
        };
        // One session in which policies drive and one in which the world does.
        let mut ruled = open(&vec![start; n_ruled / round.n_futures])?;
        let mut own = imitates.then(|| open(&[start])).transpose()?;
        let per = frames_per_decision(&*ruled).map_err(|error| self.failed(error.into()))?;
        phases.open += (self.clock)() - time;

        let mut live: Vec<usize> = (0..n_ruled).collect();
        let mut imagined = 0;
        for decision in 1..=round.n_decisions {
            let time = (self.clock)();
            let spent = time - round.began;
            if decision > 1 && self.config.budget.wall.is_some_and(|wall| spent > wall) {
                break;
            }
            self.drive(round.proposer, round.corridors, &mut futures[..n_ruled]);
            let open: Vec<usize> = (0..live.len())
                .filter(|&i| !futures[live[i]].lost)
                .collect();
            if open.len() < live.len() && !open.is_empty() && ruled.keep(&open) {
                live = open.into_iter().map(|i| live[i]).collect();
            }
            let driven = (self.clock)();
            phases.policies += driven - time;
            let (ruled_futures, own_futures) = futures.split_at_mut(n_ruled);
            self.answer(&mut *ruled, ruled_futures, &live, per, true)?;
            if let Some(own) = &mut own {
                let all: Vec<usize> = (0..own_futures.len()).collect();
                self.answer(&mut **own, own_futures, &all, per, false)?;
            }
            let answered = (self.clock)();
            phases.frames += answered - driven;
            let (present, judge) = (round.scene.now(), self.judge_of());
            futures
                .par_iter_mut()
                .filter(|future| future.frames.len() == decision)
                .for_each(|future| future.remember(present));
            // Not before the others' answer: they may have braked.
            futures[..n_ruled]
                .par_iter_mut()
                .filter(|future| future.frames.len() == decision)
                .for_each(|future| {
                    let judge = Judge {
                        forecast: &future.forecast,
                        ..judge
                    };
                    future.lost = judge.is_lost(&future.drive);
                });
            phases.policies += (self.clock)() - answered;
            imagined = decision;
        }
        self.imitate(&mut futures[n_ruled..], imagined);
        opened.push(ruled);
        opened.extend(own);
        Ok((futures, imagined))
    }

    /// The last second of the ego and of the agents nearest to it.
    fn surroundings(&self) -> Vec<Frame> {
        let scene = self.input.scene;
        let place = scene.ego_now().state.pose.position;
        let moving = scene.now().agents().iter();
        let mut near: Vec<(f64, AgentId)> = moving
            .filter(|agent| agent.id != scene.ego && agent.kind.is_moving())
            .map(|agent| (agent.state.pose.position.distance(place), agent.id))
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        near.truncate(self.config.budget.nearest);
        let kept = |id: AgentId| id == scene.ego || near.iter().any(|(_, near)| *near == id);
        let n = (HISTORY_S / scene.dt).round() as usize + 1;
        let first = scene.history.len().saturating_sub(n);
        let frames = scene.history[first..].iter().map(|frame| {
            let agents = frame.agents().iter().filter(|agent| kept(agent.id));
            Frame::new(agents.copied().collect(), frame.lights().to_vec())
        });
        frames.collect()
    }

    /// Policies before they have driven, with the laws they drive by.
    fn begin(&self, proposer: &Proposer<'_>, policies: &[Policy]) -> Vec<Begun> {
        let ego = self.input.ego;
        let begin = |policy: &Policy| {
            let mut begun = proposer.begin(policy.line, ego.rear_axle, ego.velocity.x);
            begun.desired_speed = policy.desired_speed;
            Begun {
                policy: begun,
                law: policy.law.clone(),
                course: None,
            }
        };
        policies.iter().map(begin).collect()
    }

    /// The futures of a round at its start. Imitation has no policy.
    fn futures(&self, round: &Round<'_>, begun: &[Begun]) -> Vec<CandidateFuture> {
        let future =
            |&candidate: &usize| self.future(begun.get(candidate).cloned().unwrap_or_default());
        let candidates = round.candidates.iter();
        let futures = candidates.flat_map(|c| (0..round.n_futures).map(move |_| future(c)));
        futures.collect()
    }

    /// A future at its start.
    pub(super) fn future(&self, begun: Begun) -> CandidateFuture {
        CandidateFuture {
            forecast: self.state.forecast.clone(),
            policy: begun.policy,
            law: begun.law,
            course: begun.course,
            drive: vec![*self.input.ego],
            frames: Vec::new(),
            lost: false,
        }
    }

    /// Lets every policy drive for half a second among the other agents as known so far.
    fn drive(
        &self,
        proposer: &Proposer<'_>,
        corridors: &[Corridor],
        futures: &mut [CandidateFuture],
    ) {
        let wheel_base = self.state.vehicle.wheel_base;
        let room = || (Tracker::new(LOOK), Vec::new());
        futures
            .par_iter_mut()
            .for_each_init(room, |(tracker, states), future| {
                let k = future.drive.len() - 1;
                if future.lost {
                    coast(&mut future.drive);
                    return;
                }
                if let Some(course) = &future.course {
                    future
                        .drive
                        .extend_from_slice(&course[k + 1..=k + DECISION]);
                } else {
                    let proposer = Proposer {
                        forecast: &future.forecast,
                        law: &future.law,
                        ..*proposer
                    };
                    let corridor = &corridors[future.policy.line];
                    let policy = std::slice::from_mut(&mut future.policy);
                    proposer.drive_within(corridor, policy, k + 1..=k + LOOK);
                    let reference = &future.policy.poses[k..];
                    tracker.drive(&future.drive[k], reference, wheel_base, states);
                    future.drive.extend_from_slice(&states[1..=DECISION]);
                    future.policy.truncate(k + DECISION);
                }
            });
    }

    /// Steps the world through the half second that was just driven, in the futures that are still
    /// simulated.
    pub(super) fn answer(
        &self,
        session: &mut (dyn Session + '_),
        futures: &mut [CandidateFuture],
        live: &[usize],
        per: usize,
        driven: bool,
    ) -> Result<(), PlanError> {
        let vehicle = &self.state.vehicle;
        let mut frames = Vec::new();
        for i in 1..=per {
            // The half second ends with the last state.
            let behind = DECISION - i * DECISION / per;
            let ego = |&i: &usize| {
                let drive = &futures[i].drive;
                drive[drive.len() - 1 - behind].agent_state(vehicle)
            };
            let egos: Option<Vec<AgentState>> = driven.then(|| live.iter().map(ego).collect());
            let answered = session.step(egos.as_deref());
            frames = answered.map_err(|error| self.failed(error))?;
        }
        let who = "the world";
        let (expected, found) = (live.len(), frames.len());
        if expected != found {
            let wrong = RolloutError::Count {
                who,
                expected,
                found,
            };
            return Err(self.failed(wrong.into()));
        }
        let agents = frames.iter().flat_map(Frame::agents);
        if !agents.map(|agent| agent.state).all(|s| s.is_finite()) {
            return Err(self.failed(RolloutError::NotFinite { who }.into()));
        }
        for (n, (&i, frame)) in live.iter().zip(frames).enumerate() {
            let future = &mut futures[i];
            let ego = self.input.scene.ego;
            if !driven && frame.agent(ego).is_none() {
                let gone = RolloutError::EgoVanished {
                    ego,
                    future: n,
                    step: future.frames.len(),
                };
                return Err(self.failed(gone.into()));
            }
            future.frames.push(frame);
        }
        Ok(())
    }

    /// Lets the vehicle follow the world's motion of the ego.
    pub(super) fn imitate(&self, futures: &mut [CandidateFuture], n_decisions: usize) {
        let (scene, vehicle) = (self.input.scene, &self.state.vehicle);
        let now = scene.ego_now().state;
        let mut tracker = Tracker::new(n_decisions * DECISION);
        for future in futures {
            let places: Vec<Pose> = std::iter::once(now.pose)
                .chain(future.frames.iter().filter_map(|frame| {
                    let ego = frame.agent(scene.ego)?;
                    Some(ego.state.pose)
                }))
                .collect();
            let kind = ProposalKind::Imitation;
            let reference = crate::Proposal::through(kind, &places, DECISION_S);
            let states = reference.resampled(&now, DT);
            let poses: Vec<Pose> = std::iter::once(now.pose)
                .chain(states.iter().map(|state| state.pose))
                .map(|center| vehicle.rear_axle_of(center))
                .collect();
            let ego = self.input.ego;
            tracker.drive(ego, &poses, vehicle.wheel_base, &mut future.drive);
        }
    }

    fn reward(&self) -> Reward<'_> {
        // The drive before the first iteration is not judged.
        let past = self.input.past;
        let driven = self.input.iteration.min(COMFORT_PAST).min(past.len());
        Reward {
            judge: self.judge_of(),
            value: self.config.value,
            past: &past[past.len() - driven..],
            limit: self.state.stated_limit,
        }
    }

    fn judge_of(&self) -> Judge<'_> {
        Judge {
            vehicle: &self.state.vehicle,
            forecast: &self.state.forecast,
            ground: &self.state.ground,
            centerline: self.state.centerline(),
        }
    }

    pub(super) fn failed(&self, source: BoxError) -> PlanError {
        PlanError::World {
            world: self.world.name().to_owned(),
            source,
        }
    }
}

impl CandidateFuture {
    /// Records the positions of the others in the last frame: linear between frames, and after it
    /// at the velocity of the last second, since positions are quantised.
    fn remember(&mut self, present: &Frame) {
        let n = self.frames.len();
        let frame = |i: usize| i.checked_sub(1).map_or(present, |i| &self.frames[i]);
        let first = ((n - 1) as f64 * DECISION_S / MOMENT_DT + 1e-9).floor() as usize + 1;
        let last = (n as f64 * DECISION_S / MOMENT_DT + 1e-9).floor() as usize;
        for object in &mut self.forecast.objects {
            let pose = |i: usize| frame(i).agent(object.agent.id).map(|a| a.state.pose);
            let (Some(from), Some(to)) = (pose(n - 1), pose(n)) else {
                continue;
            };
            let before = n.saturating_sub(2);
            let Some(earlier) = pose(before) else {
                continue;
            };
            let elapsed = (n - before) as f64 * DECISION_S;
            let drift = (to.position - earlier.position) / elapsed;
            let moments = (first..=last).map(|moment| {
                let t = moment as f64 * MOMENT_DT / DECISION_S - (n - 1) as f64;
                from.interpolate(to, t)
            });
            object.imagine(moments, drift);
        }
    }
}

/// Half a second straight on at constant speed.
fn coast(drive: &mut Vec<EgoState>) {
    for _ in 0..DECISION {
        let mut next = drive[drive.len() - 1];
        next.rear_axle.position += next.rear_axle.direction() * (next.velocity.x * DT);
        next.time_us += (DT * 1e6) as i64;
        drive.push(next);
    }
}

/// Frames of a session in half a second.
pub(super) fn frames_per_decision(session: &(dyn Session + '_)) -> Result<usize, RolloutError> {
    let ratio = DECISION_S / session.dt();
    let per = ratio.round();
    let divides = per >= 1.0 && DECISION.is_multiple_of(per as usize);
    if divides && (ratio - per).abs() < 1e-6 {
        Ok(per as usize)
    } else {
        Err(RolloutError::TimeStep {
            session: session.dt(),
            scene: DECISION_S,
        })
    }
}

/// The simulated future as a separate rollout, from the present on.
fn film(scene: SceneState<'_>, frames: Vec<Frame>) -> Rollout {
    let last = scene.history.len() - 1;
    let mut rollout = Rollout::begin(SceneState {
        history: &scene.history[last..],
        dt: DECISION_S,
        ..scene
    });
    for frame in frames {
        rollout.push(frame);
    }
    rollout
}
