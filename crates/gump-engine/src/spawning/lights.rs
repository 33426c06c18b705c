//! Traffic lights during spawning: drawn from the network, one after another, within the sequence
//! of signals.
//!
//! A signal cycles from green over yellow to red and back to green, and holds each for a minimum
//! time: yellow for 3 to 6 s (US Manual on Uniform Traffic Control Devices, 2009, 4D.26), green and
//! red for at least 5 s, the minimum green of common practice (US Signal Timing Manual, 2008, 5.4).
//! Lights of one stop line that show the same colour change together.

use std::collections::BTreeMap;

use gump_geometry::DVec2;
use gump_model::decoder::N_LIGHT_STATES;
use gump_model::placed_slot::PlacedSlot;
use gump_scene::{Frame, LaneId, LightState};
use gump_tokenizer::{Slot, TokenLight};

use crate::counters::CountedEngine;
use crate::cpu::KvCache;
use crate::nucleus::uniform;
use crate::partial_ar::Window;
use crate::placement::births::pick;
use crate::scene::SceneContext;
use crate::session::TransformerSession;
use crate::spawning::{About, first_slot};

/// States of a light in the order of their tokens.
const LIGHT_STATES: [LightState; 4] = [
    LightState::Green,
    LightState::Yellow,
    LightState::Red,
    LightState::Unknown,
];
/// Frames that green and red last at least: 5 s, as above.
const LEAST: usize = 10;
/// Frames that yellow lasts at least and at most: 3 and 6 s, as above.
const YELLOW: (usize, usize) = (6, 12);
/// Lights that stop vehicles this near to each other belong to one stop line, metres: the paths
/// that begin at one place. The next lane's line is farther.
const ONE_LINE_M: f64 = 1.0;

/// For how many frames each light has shown what it shows.
#[derive(Clone, Debug, Default)]
pub(crate) struct Phases(BTreeMap<LaneId, usize>);

impl Phases {
    /// From the frames so far, the last of which is the present.
    pub(crate) fn of(frames: &[Frame]) -> Self {
        let Some((now, before)) = frames.split_last() else {
            return Self::default();
        };
        let age = |lane: LaneId, state: LightState| {
            let states = before.iter().rev().map(|frame| frame.light(lane));
            let mut states = states.map(|light| light.map(|light| light.state));
            // Nobody knows what was shown before a frame in which the light was not seen.
            let age = 1 + states.clone().take_while(|s| *s == Some(state)).count();
            let other = states.nth(age - 1).flatten()?;
            (other != LightState::Unknown).then_some(age)
        };
        let lights = now.lights().iter();
        let ages = lights.filter_map(|light| Some((light.lane, age(light.lane, light.state)?)));
        Self(ages.collect())
    }

    /// Of a light that was not seen to change: as if it might just now.
    fn age(&self, lane: LaneId) -> usize {
        self.0.get(&lane).copied().unwrap_or(LEAST)
    }

    fn note(&mut self, lane: LaneId, changed: bool) {
        let age = if changed { 1 } else { self.age(lane) + 1 };
        self.0.insert(lane, age);
    }
}

impl TransformerSession<'_> {
    /// Draws the lights of the next frames.
    pub(super) fn draw_lights(
        &mut self,
        engine: &CountedEngine<'_>,
        windows: &mut [Window],
        placed: &mut [Vec<PlacedSlot>],
        kv_caches: &mut [KvCache],
    ) {
        let companions: Vec<Vec<Option<usize>>> = windows
            .iter()
            .zip(&self.futures)
            .map(|(window, future)| {
                let now = future.recent.last().expect("a future has a present");
                companions(&window.next.lights, &self.scenes[window.scene], now)
            })
            .collect();
        let most = companions.iter().map(Vec::len).max().unwrap_or(0);
        for light in 0..most {
            let is_independent = |w: &usize| companions[*w].get(light).is_some_and(Option::is_none);
            let members: Vec<usize> = (0..windows.len()).filter(is_independent).collect();
            let at = |w: usize| first_slot(&windows[w], &placed[w]) + light;
            let wanted: Vec<Vec<usize>> = members.iter().map(|w| vec![at(*w)]).collect();
            let hidden = self.run(engine, windows, placed, kv_caches, &members, &wanted);
            let mut successors = engine.successors(&hidden).into_iter();
            for (w, window) in windows.iter_mut().enumerate() {
                let Some(companion) = companions[w].get(light) else {
                    continue;
                };
                let token = window.next.lights[light];
                let lane = self.scenes[window.scene].lights[usize::from(token.index) - 1];
                let future = &mut self.futures[w];
                let state = match companion {
                    Some(other) => window.next.lights[*other].state,
                    None => {
                        let successor = successors
                            .next()
                            .expect("one word per light that is asked about");
                        let seed = future.decision(About::Lights).fork(light as u64);
                        let changes = self.world.sampling().spawn_rates.light_changes;
                        let age = future.phases.age(lane);
                        next_light(
                            &successor.lights,
                            (token.state, age),
                            changes,
                            uniform(seed),
                        )
                    }
                };
                future.phases.note(lane, state != token.state);
                window.next.lights[light].state = state;
                let slot = first_slot(window, &placed[w]) + light + 1;
                placed[w][slot].slot = Slot::Light(window.next.lights[light]);
            }
        }
    }
}

/// Per light the first one that it goes with: of the same stop line and showing the same.
fn companions(lights: &[TokenLight], scene: &SceneContext, now: &Frame) -> Vec<Option<usize>> {
    let stop = |light: &TokenLight| -> Option<DVec2> {
        let lane = *scene.lights.get(usize::from(light.index).checked_sub(1)?)?;
        let stated = now.light(lane).and_then(|light| light.stop_point);
        stated.or_else(|| Some(scene.map.lane(lane)?.centerline.pose_at(0.0).position))
    };
    let stops: Vec<Option<DVec2>> = lights.iter().map(stop).collect();
    let goes_with = |i: usize, j: &usize| {
        let apart = stops[i].zip(stops[*j]).map(|(a, b)| a.distance(b));
        lights[i].state == lights[*j].state && apart.is_some_and(|apart| apart <= ONE_LINE_M)
    };
    (0..lights.len())
        .map(|i| (0..i).find(|j| goes_with(i, j)))
        .collect()
}

/// Whether a light that has shown `shown` for `age` frames may show `next` in the next one. From an
/// unknown state any may follow.
fn may_show(shown: LightState, age: usize, next: LightState) -> bool {
    match (shown, next) {
        (LightState::Unknown, _) => true,
        (LightState::Yellow, LightState::Yellow) => age < YELLOW.1,
        (LightState::Yellow, LightState::Red) => age >= YELLOW.0,
        (LightState::Green, LightState::Yellow) | (LightState::Red, LightState::Green) => {
            age >= LEAST
        }
        _ => shown == next,
    }
}

/// The next state of a light that has shown a state for a number of frames, from the logits of all;
/// the odds of any other are multiplied by `changes`.
fn next_light(
    logits: &[f32; N_LIGHT_STATES],
    (shown, age): (LightState, usize),
    changes: f64,
    uniform: f64,
) -> LightState {
    let may = |state: LightState| may_show(shown, age, state);
    let open = LIGHT_STATES.iter().zip(logits).filter(|(s, _)| may(**s));
    let peak = open.map(|(_, logit)| *logit).fold(f32::MIN, f32::max);
    let weigh = |(state, logit): (&LightState, &f32)| {
        let factor = if *state == shown { 1.0 } else { changes };
        let weight = factor * f64::from((logit - peak).exp());
        if may(*state) { weight } else { 0.0 }
    };
    let weights: Vec<f64> = LIGHT_STATES.iter().zip(logits).map(weigh).collect();
    pick(&weights, uniform).map_or(shown, |state| LIGHT_STATES[state])
}

#[cfg(test)]
mod tests {
    use LightState::{Green, Red, Unknown, Yellow};
    use gump_scene::{Light, Seed};

    use super::*;

    #[test]
    fn lights_change_with_the_odds_of_the_network_times_their_pace() {
        // The network gives red, which shows, as much as green.
        let logits = [0.0, -30.0, 0.0, -30.0];
        let share = |pace: f64, age: usize| {
            let draws = (0..4000).map(|i| uniform(Seed(i)));
            let states = draws.map(|u| next_light(&logits, (Red, age), pace, u));
            states.filter(|state| *state == Green).count() as f64 / 4000.0
        };
        // Standard deviations are below 0.008.
        assert!((share(1.0, LEAST) - 0.5).abs() < 0.03);
        assert!((share(0.25, LEAST) - 0.2).abs() < 0.03);
        assert_eq!((share(0.0, LEAST), share(1.0, LEAST - 1)), (0.0, 0.0));
    }

    #[test]
    fn changes_that_were_seen_count() {
        let frame = |states: [LightState; 3]| {
            let lights = states.iter().zip(1..).map(|(state, lane)| Light {
                lane: LaneId(lane),
                state: *state,
                stop_point: None,
            });
            Frame::new(Vec::new(), lights.collect())
        };
        let phases = Phases::of(&[
            frame([Green, Red, Unknown]),
            frame([Green, Red, Green]),
            frame([Yellow, Red, Green]),
            frame([Yellow, Green, Green]),
        ]);
        let ages = [1, 2, 3].map(|lane| phases.age(LaneId(lane)));
        assert_eq!(ages, [2, 1, LEAST]);
        assert_eq!(Phases::of(&[]).age(LaneId(1)), LEAST);
    }

    #[test]
    fn phases_keep_their_order_and_their_times() {
        // With random logits, for many steps.
        let (mut phases, lane) = (Phases::default(), LaneId(1));
        let (mut state, mut seen) = (Yellow, Vec::new());
        for i in 0..4000 {
            let logits = std::array::from_fn(|k| 6.0 * uniform(Seed(4 * i + k as u64)) as f32);
            let draw = uniform(Seed(90_000 + i));
            let next = next_light(&logits, (state, phases.age(lane)), 0.5, draw);
            if next != state {
                seen.push((state, phases.age(lane), next));
            }
            phases.note(lane, next != state);
            state = next;
        }
        // How long the first phase was is not known.
        assert!(seen.len() > 100);
        for (state, age, next) in &seen[1..] {
            let follows = [(Green, Yellow), (Yellow, Red), (Red, Green)];
            assert!(follows.contains(&(*state, *next)), "{state:?} {next:?}");
            let (least, most) = match state {
                Yellow => YELLOW,
                _ => (LEAST, usize::MAX),
            };
            assert!((least..=most).contains(age), "{state:?} for {age} frames");
        }
        assert!(may_show(Unknown, 1, Green) && !may_show(Red, 99, Unknown));
    }
}
