//! Motion that is physically implausible: accelerations that are too large, sideways slip.

use gump_geometry::{Pose, angle_difference};
use gump_scene::AgentKind;

use super::track::Track;
use super::{Class, Counter, MOVES, Measure, vehicles};

/// Dry tyres on dry asphalt brake with 8 to 9 m/s² and cars accelerate with less.
const HARD: f64 = 8.0;
/// Half of the time over which a velocity is measured, and half of that between two of them,
/// seconds. An error of 5 cm in positions then gives an acceleration of 0.4 m/s².
const REACH_S: f64 = 0.25;
/// Events separated by less than this are one event, seconds: the time over which one is measured.
const APART_S: f64 = 0.5;
/// A vehicle that moves sideways faster than this slips, m/s: recorded vehicles do for less than
/// 0.1 % of the time (docs/results/0018-frozen-sets.md). Chosen by hand.
const SLIDES: f64 = 0.5;
/// Slip for at least this long is an incident, seconds: not a jump of a box. Chosen by hand.
const SLIDE_S: f64 = 0.3;

impl Counter<'_> {
    pub(super) fn body(&mut self) {
        let reach = self.take.steps(REACH_S);
        for track in self.tracks {
            self.accelerations(track, reach);
        }
        for track in vehicles(self.tracks) {
            self.slips(track, reach);
        }
    }

    fn accelerations(&mut self, track: &Track, reach: usize) {
        let between = 2.0 * reach as f64 * self.take.dt;
        let apart = self.take.steps(APART_S);
        let (mut n_judged, mut last, mut n): (usize, Option<usize>, usize) = (0, None, 0);
        for k in self.take.ahead() {
            let before = k.checked_sub(reach).and_then(|k| track.velocity(k, reach));
            let Some((before, after)) = before.zip(track.velocity(k + reach, reach)) else {
                continue;
            };
            n_judged += 1;
            if before.distance(after) > HARD * between {
                if last.is_none_or(|last| k - last > apart) {
                    n += 1;
                    self.note(Measure::HardAcceleration, track.id, None, k);
                }
                last = Some(k);
            }
        }
        let (class, minutes) = (Class::of(track.kind), self.minutes(n_judged));
        self.add(Measure::HardAcceleration, class, n as f64, minutes);
    }

    fn slips(&mut self, track: &Track, reach: usize) {
        debug_assert_eq!(
            track.kind,
            AgentKind::Vehicle,
            "others step where they like"
        );
        let long = self.take.steps(SLIDE_S);
        let (mut n_moving, mut n_sliding, mut run) = (0, 0, 0);
        for k in self.take.ahead() {
            let slides = self.slip(track, k, reach);
            n_moving += usize::from(slides.is_some());
            let slides = slides.is_some_and(|speed| speed > SLIDES);
            n_sliding += usize::from(slides);
            run = if slides { run + 1 } else { 0 };
            if run == long {
                self.note(Measure::Slip, track.id, None, k + 1 - long);
            }
        }
        let (class, events) = (Class::Vehicle, n_sliding as f64);
        self.add(Measure::Slip, class, events, n_moving as f64);
    }

    /// Slip of a vehicle at a frame, m/s; `None` unless it moves.
    ///
    /// In a vehicle that turns about its rear axle, the box centre moves sideways by the turn rate
    /// times its distance from the axle, which is between zero and half of the length. The slip is
    /// zero if some position of the axle in that range explains the motion.
    fn slip(&self, track: &Track, k: usize, reach: usize) -> Option<f64> {
        let velocity = track.velocity(k, reach)?;
        if velocity.length_squared() <= MOVES * MOVES {
            return None;
        }
        let (before, after): (Pose, Pose) = (track.pose(k - reach)?, track.pose(k + reach)?);
        let turn = angle_difference(after.heading, before.heading);
        // The mean over the window, which a tracker's jitter moves less than a single heading.
        let middle = angle_difference(track.pose(k)?.heading, before.heading);
        let heading = before.heading + (turn + middle) / 3.0;
        let (sin, cos) = heading.sin_cos();
        let sideways = velocity.y * cos - velocity.x * sin;
        let most = turn / (2.0 * reach as f64 * self.take.dt) * track.length / 2.0;
        Some((sideways - sideways.clamp(most.min(0.0), most.max(0.0))).abs())
    }
}
