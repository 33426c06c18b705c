//! Conversion of obstacles to tracks, of signal cycles to lights, and of the planning problem's
//! start to the ego.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::FRAC_PI_4;

use gump_geometry::{DVec2, dvec3};
use gump_scene::{AgentKind, Lane, LaneId, Light, LightState, MapParts};

use crate::ReadReport;
use crate::complete::recording::{MAX_STEPS, Recording};
use crate::complete::track::{self, State, Track, UNSTATED};
use crate::io::xml::Element;

/// An obstacle this near to the planning problem's start, metres, is its vehicle: two would
/// overlap.
const SAME_PLACE: f64 = 0.5;

/// Everything that moves or changes.
pub(super) fn recording(
    root: &Element,
    id: String,
    dt: f64,
    parts: &MapParts,
    report: &mut ReadReport,
) -> Recording {
    let obstacles = ["obstacle", "dynamicObstacle", "staticObstacle"];
    let obstacles = root
        .children
        .iter()
        .filter(|e| obstacles.contains(&&*e.name));
    let tracks: Vec<Track> = obstacles
        .filter_map(|element| track(element, report))
        .collect();
    let last = tracks.iter().flat_map(|t| &t.states).map(|s| s.step).max();
    // Static obstacles state step 0 and are there for as long as anything is.
    let steps = last.map_or(0, |last| last.saturating_add(1));
    let mut tracks = tracks;
    if steps <= MAX_STEPS {
        stay(root, &mut tracks, steps);
    }
    let now = track::usual_present(steps, dt);
    report.infer("present one second in, or at the start", 1);
    let ego = ego(root, &tracks, now, report);
    Recording {
        id,
        dt,
        steps,
        now,
        ego,
        lights: if steps <= MAX_STEPS {
            lights(root, parts, steps, report)
        } else {
            Vec::new()
        },
        targets: None,
        objects_of_interest: Vec::new(),
        tags: Vec::new(),
        route: None,
        tracks,
    }
}

fn track(element: &Element, report: &mut ReadReport) -> Option<Track> {
    let Some(id) = element.id("id") else {
        report.drop_damaged("obstacle without an id", || element.name.to_string());
        return None;
    };
    let kind = kind(element.text(&["type"]).unwrap_or_default());
    let shape = element.child("shape");
    let size = shape.map_or([UNSTATED; 3], |shape| size(shape, report));
    let states = element.child("initialState").into_iter();
    let trajectory = element
        .child("trajectory")
        .into_iter()
        .flat_map(|t| t.all("state"));
    let mut kept = Vec::new();
    for element in states.chain(trajectory) {
        let step = element.number(&["time", "exact"]);
        if !(0.0..=1e9).contains(&step) {
            report.drop_damaged("state without an exact time", || format!("obstacle {id}"));
            continue;
        }
        kept.push(state(element, step as usize, size));
    }
    for other in ["occupancySet", "signalSeries"] {
        report.drop(
            "occupancy set or signals of an obstacle",
            element.all(other).count(),
        );
    }
    Some(Track {
        id,
        kind,
        usual_size: kind.usual_size(),
        states: kept,
    })
}

/// Positions are box centres; areas count as their rectangle's centre.
fn state(element: &Element, step: usize, size: [f64; 3]) -> State {
    let place = |path: &[&str]| {
        element
            .at(path)
            .map(|p| [p.number(&["x"]), p.number(&["y"])])
    };
    let place =
        place(&["position", "point"]).or_else(|| place(&["position", "rectangle", "center"]));
    let [x, y] = place.unwrap_or([UNSTATED; 2]);
    let heading = exact_or_middle(element, "orientation");
    let speed = exact_or_middle(element, "velocity");
    // Velocities are speeds along the heading; those across are the slip angle's.
    let slip = element.number(&["slipAngle", "exact"]);
    let direction = heading + if slip.is_finite() { slip } else { 0.0 };
    State {
        step,
        position: dvec3(x, y, element.number(&["position", "point", "z"])),
        heading,
        velocity: DVec2::from_angle(direction) * speed,
        size,
    }
}

/// A value given exactly, or the middle of its interval.
fn exact_or_middle(element: &Element, name: &str) -> f64 {
    let exact = element.number(&[name, "exact"]);
    if exact.is_finite() {
        return exact;
    }
    f64::midpoint(
        element.number(&[name, "intervalStart"]),
        element.number(&[name, "intervalEnd"]),
    )
}

fn size(shape: &Element, report: &mut ReadReport) -> [f64; 3] {
    if let Some(rectangle) = shape.child("rectangle") {
        return [
            rectangle.number(&["length"]),
            rectangle.number(&["width"]),
            UNSTATED,
        ];
    }
    if let Some(circle) = shape.child("circle") {
        let side = 2.0 * circle.number(&["radius"]);
        return [side, side, UNSTATED];
    }
    report.drop("shape that is neither rectangle nor circle", 1);
    [UNSTATED; 3]
}

fn kind(name: &str) -> AgentKind {
    match name {
        "car" | "truck" | "bus" | "motorcycle" | "priorityVehicle" | "parkedVehicle" | "taxi"
        | "train" => AgentKind::Vehicle,
        "pedestrian" => AgentKind::Pedestrian,
        "bicycle" => AgentKind::Bicycle,
        "constructionZone" | "roadBoundary" => AgentKind::Barrier,
        _ => AgentKind::Other,
    }
}

/// Repeats the one state of static obstacles at every step.
fn stay(root: &Element, tracks: &mut [Track], steps: usize) {
    let is_static =
        |e: &&Element| &*e.name == "staticObstacle" || e.text(&["role"]) == Some("static");
    let ids: BTreeSet<i64> = root
        .children
        .iter()
        .filter(is_static)
        .filter_map(|e| e.id("id"))
        .collect();
    for track in tracks.iter_mut().filter(|track| ids.contains(&track.id)) {
        if let [only] = track.states[..] {
            let still = State {
                velocity: DVec2::ZERO,
                ..only
            };
            track.states = (0..steps).map(|step| State { step, ..still }).collect();
        }
    }
}

/// The obstacle that starts where the planning problem does; `None` leaves the choice to the
/// usual rule.
fn ego(root: &Element, tracks: &[Track], now: usize, report: &mut ReadReport) -> Option<i64> {
    let start = root.at(&["planningProblem", "initialState"])?;
    let start = state(start, 0, [UNSTATED; 3]);
    let starts_there = |track: &&Track| {
        let first = track.states.first().filter(|s| s.step == 0);
        let near =
            |s: &State| s.position.truncate().distance(start.position.truncate()) < SAME_PLACE;
        first.is_some_and(near) && track.states.iter().any(|s| s.step == now)
    };
    let found = tracks.iter().find(starts_there).map(|track| track.id);
    match found {
        Some(_) => report.infer("ego: the obstacle at the planning problem's start", 1),
        None => report.drop("planning problem: nobody drives from its start", 1),
    }
    found
}

/// The lights of every step. A light rules the lanes after the lanelet that refers to it, in the
/// light's directions where the intersection states which those are.
fn lights(
    root: &Element,
    parts: &MapParts,
    steps: usize,
    report: &mut ReadReport,
) -> Vec<(usize, Light)> {
    let cycles: BTreeMap<i64, Cycle> = root
        .all("trafficLight")
        .filter_map(|e| Some((e.id("id")?, Cycle::of(e)?)))
        .collect();
    let by_id: BTreeMap<LaneId, &Lane> = parts.lanes.iter().map(|l| (l.id, l)).collect();
    let mut ruled: BTreeMap<LaneId, (DVec2, &Cycle)> = BTreeMap::new();
    for lanelet in root.all("lanelet") {
        let lane = lanelet.id("id").and_then(|id| by_id.get(&LaneId(id)));
        let Some(lane) = lane else { continue };
        let end = lane.centerline.pose_at(lane.centerline.length());
        for light in lanelet.all("trafficLightRef").filter_map(|e| e.id("ref")) {
            let Some(cycle) = cycles.get(&light) else {
                report.drop("light that is not in the file or has no cycle", 1);
                continue;
            };
            let mut lanes: Vec<LaneId> = lane
                .successors
                .iter()
                .filter_map(|id| by_id.get(id))
                .filter(|next| {
                    let far = next.centerline.pose_at(next.centerline.length());
                    cycle.leads(end.position, end.heading, far.position)
                })
                .map(|next| next.id)
                .collect();
            if lanes.is_empty() && lane.successors.is_empty() {
                lanes.push(lane.id);
            }
            for id in lanes {
                if ruled.insert(id, (end.position, cycle)).is_some() {
                    report.drop("second signal of a lane", 1);
                }
            }
        }
    }
    let at = |(lane, (stop, cycle)): (&LaneId, &(DVec2, &Cycle)), step: usize| Light {
        lane: *lane,
        state: cycle.state(step),
        stop_point: Some(*stop),
    };
    (0..steps)
        .flat_map(|step| ruled.iter().map(move |r| (step, at(r, step))))
        .collect()
}

/// The program of one signal.
struct Cycle {
    /// Colours with their durations in steps.
    phases: Vec<(LightState, usize)>,
    /// The step at which the first phase begins.
    offset: usize,
    active: bool,
    direction: String,
}

impl Cycle {
    fn of(light: &Element) -> Option<Self> {
        let cycle = light.child("cycle")?;
        let whole = |value: f64| (0.0..1e9).contains(&value).then_some(value as usize);
        let phase = |element: &Element| {
            let state = match element.text(&["color"]) {
                Some("green") => LightState::Green,
                Some("yellow" | "redYellow") => LightState::Yellow,
                Some("red") => LightState::Red,
                _ => LightState::Unknown,
            };
            Some((state, whole(element.number(&["duration"]))?))
        };
        let phases: Vec<_> = cycle.all("cycleElement").filter_map(phase).collect();
        let active = light.text(&["active"]) != Some("false");
        phases
            .iter()
            .any(|(_, duration)| *duration > 0)
            .then(|| Self {
                offset: whole(cycle.number(&["timeOffset"])).unwrap_or(0),
                direction: light.text(&["direction"]).unwrap_or("all").to_owned(),
                active,
                phases,
            })
    }

    fn state(&self, step: usize) -> LightState {
        if !self.active {
            return LightState::Unknown;
        }
        let total: usize = self.phases.iter().map(|(_, duration)| duration).sum();
        // As the format's own library counts: the offset delays the cycle.
        let mut within = (step + total - self.offset % total) % total;
        for &(state, duration) in &self.phases {
            if within < duration {
                return state;
            }
            within -= duration;
        }
        LightState::Unknown
    }

    /// True if the light rules the way from the end of a lane to `far`.
    fn leads(&self, end: DVec2, heading: f64, far: DVec2) -> bool {
        let turn = gump_geometry::angle_difference((far - end).to_angle(), heading);
        // The chord of a right-angled turn leaves at half its angle.
        let way = if turn > FRAC_PI_4 / 2.0 {
            "left"
        } else if turn < -FRAC_PI_4 / 2.0 {
            "right"
        } else {
            "straight"
        };
        let direction = self.direction.to_lowercase();
        direction == "all" || direction.is_empty() || direction.contains(way)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cycle_repeats_from_its_offset() {
        use LightState::{Green, Red, Yellow};
        let cycle = Cycle {
            phases: vec![(Green, 3), (Yellow, 1), (Red, 2)],
            offset: 7,
            active: true,
            direction: "straightRight".into(),
        };
        let found: Vec<_> = (0..8).map(|step| cycle.state(step)).collect();
        // Offset 7 is one step into the cycle of 6: step 1 begins it.
        assert_eq!(found, [Red, Green, Green, Green, Yellow, Red, Red, Green]);
        let leads = |x, y| cycle.leads(DVec2::ZERO, 0.0, DVec2::new(x, y));
        assert!(leads(20.0, 0.0) && leads(10.0, -10.0) && !leads(10.0, 10.0));
    }
}
