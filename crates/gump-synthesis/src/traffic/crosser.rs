//! Pedestrians that cross the road where there is no crosswalk: they come along the sidewalk, wait for a
//! gap if there is none, walk straight across, and go on along the sidewalk.
//!
//! Vehicles do not have to yield, so pedestrians start only when all approaching vehicles are far
//! enough away; once they are on the road, vehicles stop for them as for any obstacle.

use gump_geometry::{DVec2, Pose, wrap_angle};
use gump_scene::AgentKind;

use super::vehicle::Vehicle;
use super::{Body, TrafficSimulation};
use crate::curve::Track;
use crate::network::{LaneIdx, Network};

// Chosen by hand.
/// Seconds left between a person who has crossed a lane and the next vehicle.
const SPARE_S: f64 = 2.0;
/// Vehicles slower than this could start at any time: they are assumed to drive at this speed, m/s.
const AT_LEAST: f64 = 3.0;
/// Metres before and behind a lane in which a person is in the way.
const IN_THE_WAY: f64 = 0.9;
/// Seconds before the curb at which people look for a gap, so that they need not stop if there is one.
const LOOKS_S: f64 = 1.2;
/// Change of walking speed, m/s²: that of all people here.
const CHANGE: f64 = 1.2;
/// Lanes of its path on which a vehicle is looked for ahead of where it is.
const LOOK_AHEAD: usize = 5;

/// A way along the sidewalk, across the road from curb to curb, and on along the sidewalk.
#[derive(Clone, Debug)]
pub(crate) struct Jaywalk {
    pub(crate) track: Track,
    /// Arc lengths of the two curbs, metres: people wait for a gap at the first.
    pub(crate) curbs: (f64, f64),
    /// The lanes on the way.
    pub(crate) spans: Vec<Span>,
}

/// A lane on the way.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Span {
    pub(crate) lane: LaneIdx,
    /// Arc length on the lane, metres.
    pub(crate) at: f64,
    /// From where to where on the way, arc lengths, metres.
    pub(crate) across: (f64, f64),
}

/// A pedestrian on such a way.
#[derive(Clone, Debug)]
pub(crate) struct Crosser {
    pub(crate) id: i64,
    /// The one it walks with, or itself.
    group: i64,
    pub(crate) size: [f64; 3],
    /// Index of the way.
    pub(crate) jaywalk: usize,
    /// Metres per second.
    pub(crate) pace: f64,
    /// Seconds of the simulation at which it begins to walk.
    sets_off: f64,
    /// Metres to the left of the way's middle.
    aside: f64,
    progress: f64,
    speed: f64,
    goes: bool,
    pose: Pose,
}

impl Crosser {
    /// A pedestrian at the beginning of a way.
    pub(crate) fn new(
        id: i64,
        size: [f64; 3],
        (jaywalk, way): (usize, &Jaywalk),
        pace: f64,
        sets_off: f64,
    ) -> Self {
        Self {
            id,
            group: id,
            size,
            jaywalk,
            pace,
            sets_off,
            aside: 0.0,
            progress: 0.0,
            speed: 0.0,
            goes: false,
            pose: way.track.pose_at(0.0),
        }
    }

    /// A companion this far to the left.
    pub(crate) fn companion(&self, id: i64, size: [f64; 3], aside: f64) -> Self {
        Self {
            id,
            size,
            aside,
            ..self.clone()
        }
    }

    pub(crate) fn body(&self) -> Body {
        Body {
            id: self.id,
            group: self.group,
            kind: AgentKind::Pedestrian,
            size: self.size,
            pose: Pose {
                position: self.pose * DVec2::new(0.0, self.aside),
                heading: wrap_angle(self.pose.heading),
            },
            is_mobile: true,
            place: None,
        }
    }
}

impl TrafficSimulation<'_> {
    /// Moves crossing people, and puts them in the way of vehicles; after the lanes were filled.
    pub(super) fn step_crossers(&mut self) {
        let ways = std::mem::take(&mut self.demand.scenery.jaywalks);
        for i in 0..self.crossers.len() {
            let mut crosser = self.crossers[i].clone();
            let way = &ways[crosser.jaywalk];
            let to_curb = way.curbs.0 - crosser.progress;
            if !crosser.goes && to_curb < LOOKS_S * crosser.pace {
                crosser.goes = self.has_gap(way, &crosser);
            }
            let length = way.track.length();
            let end = if crosser.goes { length } else { way.curbs.0 };
            let left = end - crosser.progress;
            if self.time >= crosser.sets_off && left > 0.05 {
                let wanted = crosser.pace.min((2.0 * CHANGE * left).sqrt());
                crosser.speed = (crosser.speed + CHANGE * self.dt).min(wanted);
                crosser.progress = (crosser.progress + crosser.speed * self.dt).min(length);
                crosser.pose = way.track.pose_at(crosser.progress);
            }
            for span in way.spans.iter().filter(|_| crosser.goes) {
                let soon = crosser.progress + 1.5 * crosser.pace + IN_THE_WAY;
                let (from, to) = span.across;
                if from < soon && crosser.progress < to + IN_THE_WAY {
                    self.occupancy.block(span.lane, span.at - 0.6);
                }
            }
            self.crossers[i] = crosser;
        }
        self.demand.scenery.jaywalks = ways;
    }

    /// True if no vehicle on any lane of the way arrives before the person has passed.
    fn has_gap(&self, way: &Jaywalk, crosser: &Crosser) -> bool {
        way.spans.iter().all(|span| {
            let after = |metres: f64| (metres - crosser.progress) / crosser.pace;
            let (enters, leaves) = (after(span.across.0), after(span.across.1) + 1.0);
            self.vehicles.iter().all(|vehicle| {
                let Some(distance) = metres_to(self.network, vehicle, span) else {
                    return true;
                };
                let passed = -distance > vehicle.length() + 0.8;
                let speed = vehicle.speed.max(AT_LEAST);
                // Gone by before the person gets there, or there well after.
                let gone = vehicle.speed > AT_LEAST
                    && (distance + vehicle.length() + 2.0) / speed + 0.5 < enters;
                passed || gone || distance / speed > leaves + SPARE_S
            })
        })
    }
}

/// Metres from a vehicle's front to a place on a lane; `None` if it is not on its way there.
fn metres_to(network: &Network, vehicle: &Vehicle, span: &Span) -> Option<f64> {
    let first = vehicle.leg.saturating_sub(1);
    let last = (vehicle.leg + LOOK_AHEAD).min(vehicle.path.len());
    let leg = (first..last).find(|&leg| vehicle.path[leg] == span.lane)?;
    Some(vehicle.distance_to(network, leg) + span.at)
}
