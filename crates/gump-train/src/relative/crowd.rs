//! Agents that are added to samples in which everybody moves freely under the rules.
//!
//! Those samples need no log, so agents can be put where logs have none: in the way. The network
//! meets more conflicts than in scenes as dense as recorded ones, and of more kinds.

use gump_geometry::{DVec2, OrientedBox, Pose};
use gump_model::relative::graph::Body;
use gump_model::relative::sample::{State, Track};
use gump_model::steps::TOKEN_DT;
use gump_scene::{AgentKind, MapGraph, Rng, Seed, standard_normal};

use rand::Rng as _;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::relative::drives::WARM_UP;

// All of these were chosen by hand and not varied.

/// Standing agents and people are added to the paths of agents that move at least this far in the
/// log, metres, ...
const MOVES_M: f64 = 5.0;
/// ... where those are after at least this many frames: two seconds suffice to brake.
const AHEAD: usize = 4;
/// Deviation of standing agents from the path, metres: from in the way to beside it.
const BESIDE_M: f64 = 2.2;
/// Deviation of the heading of standing agents from the path, radians.
const TURNED: f64 = 0.15;
/// Deviation of the place where people meet the path, metres.
const MEETS_M: f64 = 2.0;
/// Speed of people, metres per second.
const WALKS: std::ops::Range<f64> = 0.8..1.8;
/// Speed of vehicles on lanes, metres per second, up to this and to the limit.
const SLOWEST: f64 = 2.0;
const FASTEST: f64 = 14.0;
/// Vehicles are added to lanes within this of the sample's centre, metres.
const REACH_M: f64 = 70.0;
/// Space around an added agent, metres, ...
const SPACE_M: f64 = 0.6;
/// ... and ahead of one that moves, seconds at its speed.
pub(super) const HEADWAY_S: f64 = 1.0;
/// Places tried for an agent.
const ATTEMPTS: usize = 6;

/// The maximum numbers of agents that are added to a sample; each number is uniform from 0 on.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Crowd {
    /// Vehicles, bicycles and people that stand in or near the paths of others.
    pub standing: usize,
    /// People that walk across the paths of others.
    pub people: usize,
    /// Vehicles on lanes.
    pub vehicles: usize,
}

/// An agent that may be added: its poses in the frames that are shown before the network drives,
/// and its speed.
struct Newcomer {
    body: Body,
    poses: [Pose; WARM_UP],
    speed: f64,
}

impl Crowd {
    /// Error: [`TrainError::Config`] if a number is beyond what a sample can have.
    pub(super) fn validate(&self) -> Result<(), TrainError> {
        let most = self.standing.max(self.people).max(self.vehicles);
        match most <= 64 {
            true => Ok(()),
            false => Err(TrainError::Config {
                key: "closed_loop.crowd",
                reason: format!("closed_loop: a crowd of {most} is more than 64"),
            }),
        }
    }

    /// Adds agents to the tracks of a sample of `n_frames` around `centre`.
    pub(super) fn join(
        &self,
        streets: &MapGraph,
        centre: DVec2,
        tracks: &mut Vec<Track>,
        n_frames: usize,
        seed: Seed,
    ) {
        if *self == Self::default() || n_frames <= WARM_UP {
            return;
        }
        let mut rng = seed.rng();
        let paths = paths(tracks);
        let mut taken = boxes(tracks);
        let lanes: Vec<_> = streets
            .lanes_near(centre, REACH_M)
            .map(|near| near.0)
            .collect();
        let mut add = |most: usize, draw: &mut dyn FnMut(&mut Rng) -> Option<Newcomer>| {
            for _ in 0..rng.random_range(0..=most) {
                for _ in 0..ATTEMPTS {
                    let Some(newcomer) = draw(&mut rng) else {
                        break;
                    };
                    if newcomer.has_room(&taken) {
                        taken.extend(newcomer.poses.map(|pose| shape(newcomer.body, pose)));
                        tracks.push(newcomer.track(n_frames));
                        break;
                    }
                }
            }
        };
        add(self.standing, &mut |rng| {
            Some(standing(place(&paths, rng)?.0, rng))
        });
        add(self.people, &mut |rng| {
            let (place, t) = place(&paths, rng)?;
            Some(walking(place, t, rng))
        });
        add(self.vehicles, &mut |rng| {
            let lane = lanes.get(rng.random_range(0..lanes.len().max(1)))?;
            let line = &lane.centerline;
            let limit = lane
                .speed_limit
                .unwrap_or(FASTEST)
                .clamp(SLOWEST + 1.0, FASTEST);
            let speed = rng.random_range(SLOWEST..limit);
            let at = rng.random::<f64>() * (line.length() - speed * TOKEN_DT).max(0.0);
            Some(Newcomer {
                body: vehicle(rng),
                poses: [0.0, speed * TOKEN_DT].map(|on| line.pose_at(at + on)),
                speed,
            })
        });
    }
}

impl Newcomer {
    fn has_room(&self, taken: &[OrientedBox]) -> bool {
        let ahead = HEADWAY_S * self.speed;
        self.poses.iter().all(|pose| {
            let own = OrientedBox {
                pose: *pose * Pose::new(0.5 * ahead, 0.0, 0.0),
                length: self.body.length + 2.0 * SPACE_M + ahead,
                width: self.body.width + 2.0 * SPACE_M,
            };
            !taken.iter().any(|other| own.overlaps(other))
        })
    }

    /// Those that stand are obstacles: if they were driven, vehicles that were put into a lane would
    /// start, and from that the network would learn that parked vehicles do. The later poses of
    /// others are placeholders, which the drive replaces.
    fn track(&self, n_frames: usize) -> Track {
        let state = |t: usize| {
            let pose = self.poses[t.min(WARM_UP - 1)];
            Some(State::added(pose, pose.direction() * self.speed))
        };
        Track {
            body: self.body,
            states: (0..n_frames).map(state).collect(),
            routes: Vec::new(),
            is_obstacle: self.speed == 0.0,
        }
    }
}

/// The box of an agent at a pose.
pub(super) fn shape(body: Body, pose: Pose) -> OrientedBox {
    OrientedBox {
        pose,
        length: body.length,
        width: body.width,
    }
}

/// The agents in the frames that are shown before the network drives.
fn boxes(tracks: &[Track]) -> Vec<OrientedBox> {
    let of = |track: &Track| {
        let body = track.body;
        let states = track.states.iter().take(WARM_UP).flatten();
        states
            .map(|state| shape(body, state.shown))
            .collect::<Vec<_>>()
    };
    tracks.iter().flat_map(of).collect()
}

/// The logged paths of agents that move: poses and their frames.
fn paths(tracks: &[Track]) -> Vec<Vec<(Pose, usize)>> {
    let path = |track: &Track| {
        let states = track.states.iter().enumerate();
        let poses = states.filter_map(|(t, state)| Some(((*state)?.logged, t)));
        poses.collect::<Vec<_>>()
    };
    let moves = |path: &Vec<(Pose, usize)>| match (path.first(), path.last()) {
        (Some(from), Some(to)) => {
            to.1 >= AHEAD && from.0.position.distance(to.0.position) > MOVES_M
        }
        _ => false,
    };
    tracks.iter().map(path).filter(moves).collect()
}

/// A pose on a path, and its frame.
fn place(paths: &[Vec<(Pose, usize)>], rng: &mut Rng) -> Option<(Pose, usize)> {
    let path = paths.get(rng.random_range(0..paths.len().max(1)))?;
    let later: Vec<_> = path.iter().filter(|(_, t)| *t >= AHEAD).collect();
    Some(*later[rng.random_range(0..later.len())])
}

fn standing(on: Pose, rng: &mut Rng) -> Newcomer {
    let body = match rng.random_range(0..10) {
        0..6 => vehicle(rng),
        6..9 => person(rng),
        _ => Body {
            kind: AgentKind::Bicycle,
            length: 1.8,
            width: 0.8,
            sized: true,
        },
    };
    let aside = BESIDE_M * standard_normal(rng);
    let turned = match body.kind {
        AgentKind::Pedestrian => std::f64::consts::TAU * rng.random::<f64>(),
        _ => TURNED * standard_normal(rng),
    };
    let back = match rng.random_bool(0.2) {
        true => std::f64::consts::PI,
        false => 0.0,
    };
    Newcomer {
        body,
        poses: [on * Pose::new(0.0, aside, turned + back); WARM_UP],
        speed: 0.0,
    }
}

/// Someone who would be at a place after `t` frames.
fn walking(at: Pose, t: usize, rng: &mut Rng) -> Newcomer {
    let speed = rng.random_range(WALKS);
    let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let turned = side * std::f64::consts::FRAC_PI_2 + 2.0 * TURNED * standard_normal(rng);
    let meets = MEETS_M * standard_normal(rng);
    let crosses = at * Pose::new(0.0, 0.0, turned);
    let after = |frames: f64| meets + speed * TOKEN_DT * (frames - t as f64);
    Newcomer {
        body: person(rng),
        poses: std::array::from_fn(|i| crosses * Pose::new(after(i as f64), 0.0, 0.0)),
        speed,
    }
}

fn person(rng: &mut Rng) -> Body {
    let size = rng.random_range(0.6..1.0);
    Body {
        kind: AgentKind::Pedestrian,
        length: size,
        width: size,
        sized: true,
    }
}

fn vehicle(rng: &mut Rng) -> Body {
    let (length, width) = match rng.random_bool(0.1) {
        true => (rng.random_range(6.5..11.0), rng.random_range(2.3..2.7)),
        false => (rng.random_range(4.1..5.5), rng.random_range(1.8..2.3)),
    };
    Body {
        kind: AgentKind::Vehicle,
        length,
        width,
        sized: true,
    }
}
