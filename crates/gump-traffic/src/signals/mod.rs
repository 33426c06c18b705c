//! Traffic signals with groups, phases, yellow and clearance.

mod movement;
mod plan;
mod timing;

use std::sync::Arc;

use gump_geometry::Pose;
use gump_scene::{Light, LightState, Seed};

pub use plan::SignalPlan;
use plan::{Begun, Junction, Phase};
use timing::{CLEARANCE_S, green_s, least_green_s, met_s};

/// Share of junctions whose signals have detectors. Which do is not seen in a scene, and both kinds
/// are common. With detectors everywhere lights change as often as recorded ones, but too rarely in
/// SUMO's scenes, whose times are fixed; a half comes near both (result 23).
const DETECTING: f64 = 0.5;
/// Seconds for which a phase continues if no vehicle waits for another, before that is looked at
/// again. Not tuned.
const EXTENSION_S: f64 = 4.0;

/// The lights of one future after the present.
///
/// Phases have usual durations, drawn from the future's seed. Half of the junctions run through their
/// phases whatever the traffic; the others have detectors in the road: a phase for which no vehicle
/// waits is skipped, green continues while no vehicle waits anywhere, and ends before its time if no
/// vehicle is left that it serves while others wait.
#[derive(Clone, Debug)]
pub struct Signals {
    plan: Arc<SignalPlan>,
    seed: Seed,
    turns: Vec<Turn>,
    /// Seconds of yellow left for lights that showed green against the phase they began in.
    fading: Vec<f64>,
    shown: Vec<Light>,
}

/// The phase and stage of a junction.
#[derive(Clone, Debug)]
struct Turn {
    phase: usize,
    /// The next phase, once it is decided.
    next: usize,
    stage: Stage,
    /// Seconds left of it.
    left: f64,
    /// Seconds of green so far.
    green_s: f64,
    /// Whether the junction has detectors.
    detects: bool,
    /// Phases so far.
    n: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Green,
    Yellow,
    Red,
}

impl Signals {
    /// As at the present.
    pub fn begin(plan: &Arc<SignalPlan>, seed: Seed) -> Self {
        let begin = |(j, junction): (usize, &Junction)| {
            let seed = seed.fork(j as u64).fork(0);
            let share = || rand::Rng::random::<f64>(&mut seed.fork(1).rng());
            let phase = &junction.phases[junction.phase];
            let (stage, (green_s, left)) = match junction.stage {
                Begun::Green(age) => (Stage::Green, met_s(phase.is_left, age, seed)),
                Begun::Yellow => (Stage::Yellow, (0.0, share() * junction.yellow)),
                Begun::Red => (Stage::Red, (0.0, share() * CLEARANCE_S)),
            };
            Turn {
                phase: junction.phase,
                next: (junction.phase + 1) % junction.phases.len(),
                stage,
                left,
                green_s,
                detects: rand::Rng::random_bool(&mut seed.fork(2).rng(), DETECTING),
                n: 1,
            }
        };
        let turns = plan.junctions.iter().enumerate().map(begin).collect();
        let mut this = Self {
            plan: Arc::clone(plan),
            seed,
            turns,
            fading: vec![0.0; plan.lights.len()],
            shown: plan.lights.clone(),
        };
        // A light that is green or yellow against the phase found is yellow first.
        let planned = this.colours();
        for (light, state) in planned {
            let was_open = matches!(
                this.shown[light].state,
                LightState::Green | LightState::Yellow
            );
            if was_open && state == LightState::Red {
                this.fading[light] = timing::yellow_s(0.0);
            }
        }
        this
    }

    /// The state of all lights by lane: as logged at the present, as planned after it.
    pub fn lights(&self) -> &[Light] {
        &self.shown
    }

    /// Advances by `dt` seconds; `vehicles` are the positions of vehicles that may wait at a light.
    /// Without them every light counts as having a waiting vehicle.
    pub fn advance(&mut self, dt: f64, vehicles: Option<&[Pose]>) {
        let plan = Arc::clone(&self.plan);
        for (j, junction) in plan.junctions.iter().enumerate() {
            let mut left = dt;
            if self.is_served(j, junction, vehicles) {
                self.turns[j].left = 0.0;
            }
            // Each pass ends a stage or uses the time up; stages last for a second at least.
            while self.turns[j].left <= left {
                left -= self.turns[j].left;
                self.end_stage(j, junction, vehicles);
            }
            let turn = &mut self.turns[j];
            turn.left -= left;
            if turn.stage == Stage::Green {
                turn.green_s += left;
            }
        }
        for left in &mut self.fading {
            *left = (*left - dt).max(0.0);
        }
        for (light, state) in self.colours() {
            let fades = self.fading[light] > 0.0 && state == LightState::Red;
            self.shown[light].state = if fades { LightState::Yellow } else { state };
        }
    }

    fn end_stage(&mut self, j: usize, junction: &Junction, vehicles: Option<&[Pose]>) {
        let seed = self.seed.fork(j as u64).fork(self.turns[j].n);
        match self.turns[j].stage {
            Stage::Green => match self.next_phase(j, junction, vehicles) {
                Some(next) => {
                    let turn = &mut self.turns[j];
                    turn.next = next;
                    turn.stage = Stage::Yellow;
                    turn.left = junction.yellow;
                }
                None => self.turns[j].left = EXTENSION_S,
            },
            Stage::Yellow => {
                self.turns[j].stage = Stage::Red;
                self.turns[j].left = CLEARANCE_S;
            }
            Stage::Red => {
                let turn = &mut self.turns[j];
                turn.phase = turn.next;
                turn.stage = Stage::Green;
                turn.green_s = 0.0;
                turn.left = green_s(junction.phases[turn.phase].is_left, seed);
                turn.n += 1;
            }
        }
    }

    /// Whether green has lasted for its least time, no vehicle is left before its lines, and one
    /// waits for another phase. Phases without known lights have no lines to watch.
    fn is_served(&self, j: usize, junction: &Junction, vehicles: Option<&[Pose]>) -> bool {
        let turn = &self.turns[j];
        let phase = &junction.phases[turn.phase];
        let (Stage::Green, true, Some(vehicles)) = (turn.stage, turn.detects, vehicles) else {
            return false;
        };
        if turn.green_s < least_green_s(phase.is_left) || phase.green.iter().all(|green| !green) {
            return false;
        }
        let green = (0..junction.groups.len()).filter(|&g| phase.green[g]);
        let lights = green.flat_map(|g| &junction.groups[g].members);
        let mut movements = lights.filter_map(|&l| self.plan.movements[l].as_ref());
        let has_traffic = movements.any(|m| vehicles.iter().any(|at| m.has_demand_from(*at)));
        !has_traffic && self.next_phase(j, junction, Some(vehicles)).is_some()
    }

    /// The next phase in turn for which a vehicle waits; `None` to stay in this one. A phase
    /// without known lights always gets its turn, because its waiting vehicles are not known.
    fn next_phase(
        &self,
        j: usize,
        junction: &Junction,
        vehicles: Option<&[Pose]>,
    ) -> Option<usize> {
        let n = junction.phases.len();
        let now = self.turns[j].phase;
        let vehicles = vehicles.filter(|_| self.turns[j].detects);
        let is_red = |group: usize| !junction.phases[now].green[group];
        let is_asked_for = |phase: &Phase| {
            let green = (0..junction.groups.len()).filter(|&g| phase.green[g]);
            let lights = green
                .filter(|&g| is_red(g))
                .flat_map(|g| &junction.groups[g].members);
            let mut movements = lights.filter_map(|&l| self.plan.movements[l].as_ref());
            movements.any(|movement| match vehicles {
                Some(all) => all.iter().any(|at| movement.has_demand_from(*at)),
                None => true,
            })
        };
        let is_blank = |phase: &Phase| phase.green.iter().all(|green| !green);
        let mut turns = (1..n).map(|k| (now + k) % n);
        turns.find(|&phase| {
            let phase = &junction.phases[phase];
            is_blank(phase) || is_asked_for(phase)
        })
    }

    /// The state of every light of a junction in its phase.
    fn colours(&self) -> Vec<(usize, LightState)> {
        let junctions = self.plan.junctions.iter().zip(&self.turns);
        let of = |(junction, turn): (&Junction, &Turn)| {
            let (now, next) = (&junction.phases[turn.phase], &junction.phases[turn.next]);
            let colour = |group: usize| match (turn.stage, now.green[group], next.green[group]) {
                (_, false, _) => LightState::Red,
                (Stage::Green, true, _) | (_, true, true) => LightState::Green,
                (Stage::Yellow, true, false) => LightState::Yellow,
                (Stage::Red, true, false) => LightState::Red,
            };
            let groups = junction.groups.iter().enumerate();
            let each = groups.flat_map(|(g, group)| {
                let colour = colour(g);
                group.members.iter().map(move |&light| (light, colour))
            });
            each.collect::<Vec<_>>()
        };
        junctions.flat_map(of).collect()
    }
}

#[cfg(test)]
mod tests;
