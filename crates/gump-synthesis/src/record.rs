//! Recording of simulated traffic, frame by frame and track by track.

use std::collections::{BTreeMap, BTreeSet};

use gump_geometry::{DVec2, OrientedBox, Pose, wrap_angle};
use gump_scene::{Agent, AgentId, AgentKind, AgentState, LightState};

use crate::map::Placement;
use crate::network::LaneIdx;
use crate::smooth::smooth_poses;
use crate::steering::{draw_along, round_off};
use crate::traffic::{Body, TrafficSimulation};

/// Standard deviation of the average over time by which people turn gradually, seconds: with it the
/// directions of their steps change about as those of recorded people do.
const PEOPLE_S: f64 = 0.5;

/// Snapshots of traffic; one more before the first frame and after the last, for velocities.
#[derive(Debug)]
pub(crate) struct Recording {
    n_frames: usize,
    tracks: BTreeMap<i64, Track>,
    lights: Vec<Vec<(LaneIdx, LightState, DVec2)>>,
}

/// One body over all snapshots.
#[derive(Debug)]
pub(crate) struct Track {
    /// The body in its last snapshot.
    pub(crate) body: Body,
    poses: Vec<Option<Pose>>,
    places: Vec<(LaneIdx, f64)>,
}

impl Recording {
    /// Continues `traffic` for `n_frames` frames and records them.
    pub(crate) fn make(traffic: &mut TrafficSimulation<'_>, n_frames: usize) -> Self {
        let mut recording = Self {
            n_frames,
            tracks: BTreeMap::new(),
            lights: Vec::new(),
        };
        traffic.watch(recording.n_snapshots());
        for snapshot in 0..n_frames + 2 {
            if snapshot > 0 {
                traffic.step();
            }
            if (1..=n_frames).contains(&snapshot) {
                recording.lights.push(traffic.lights());
            }
            for body in traffic.bodies() {
                let track = recording.tracks.entry(body.id).or_insert_with(|| Track {
                    body,
                    poses: vec![None; n_frames + 2],
                    places: Vec::new(),
                });
                track.body = body;
                track.poses[snapshot] = Some(body.pose);
                if snapshot > 0 {
                    track.places.extend(body.place);
                }
            }
        }
        recording
    }

    /// Number of frames, without the two extra snapshots.
    pub(crate) fn n_frames(&self) -> usize {
        self.n_frames
    }

    /// Number of snapshots.
    pub(crate) fn n_snapshots(&self) -> usize {
        self.n_frames + 2
    }

    /// Gives vehicles the ways and the headings of bodies that are steered at the front, gradually.
    pub(crate) fn steer(&mut self) {
        self.reshape(AgentKind::Vehicle, |body, poses| {
            round_off(poses);
            draw_along(poses, body.size[0]);
        });
    }

    /// Lets people turn, and begin and stop to walk, gradually.
    pub(crate) fn ease_people(&mut self, dt: f64) {
        self.reshape(AgentKind::Pedestrian, |_, poses| {
            smooth_poses(poses, PEOPLE_S / dt);
        });
    }

    /// Changes the poses of all bodies of a kind, each time from when it appears to when it is gone.
    fn reshape(&mut self, kind: AgentKind, change: impl Fn(&Body, &mut [Pose])) {
        let tracks = self.tracks.values_mut();
        for track in tracks.filter(|track| track.body.kind == kind) {
            for stretch in track.poses.chunk_by_mut(|a, b| a.is_some() == b.is_some()) {
                let mut poses: Vec<Pose> = stretch.iter().copied().flatten().collect();
                change(&track.body, &mut poses);
                for (pose, changed) in stretch.iter_mut().zip(poses) {
                    *pose = Some(changed);
                }
            }
        }
    }

    /// Moves a standing body through these poses, one per snapshot.
    pub(crate) fn move_along(&mut self, id: i64, poses: Vec<Option<Pose>>) {
        debug_assert_eq!(poses.len(), self.n_snapshots());
        if let Some(track) = self.tracks.get_mut(&id) {
            track.body.is_mobile = true;
            track.poses = poses;
        }
    }

    /// Moves a vehicle of traffic through these poses, off its lanes.
    pub(crate) fn turn_off(&mut self, id: i64, poses: Vec<Option<Pose>>) {
        self.move_along(id, poses);
        if let Some(track) = self.tracks.get_mut(&id) {
            track.places.clear();
        }
    }

    /// The track of a body.
    pub(crate) fn track(&self, id: i64) -> Option<&Track> {
        self.tracks.get(&id)
    }

    /// An unused id.
    pub(crate) fn new_id(&self) -> i64 {
        self.tracks.keys().next_back().map_or(0, |last| last + 1)
    }

    /// Adds a body with its poses, one per snapshot while it is present.
    pub(crate) fn add(&mut self, body: Body, poses: Vec<Option<Pose>>) {
        debug_assert_eq!(poses.len(), self.n_snapshots());
        let places = Vec::new();
        self.tracks.insert(
            body.id,
            Track {
                body,
                poses,
                places,
            },
        );
    }

    /// All tracks in the order of their ids.
    pub(crate) fn tracks(&self) -> impl Iterator<Item = &Track> {
        self.tracks.values()
    }

    /// Lights in a frame.
    pub(crate) fn lights(&self, frame: usize) -> &[(LaneIdx, LightState, DVec2)] {
        &self.lights[frame]
    }

    /// Removes all lights.
    pub(crate) fn forget_lights(&mut self) {
        self.lights.iter_mut().for_each(Vec::clear);
    }

    /// Removes pedestrians and parked vehicles whose boxes overlap those of others, people of one
    /// group excepted; false if two boxes of traffic overlap.
    pub(crate) fn part_bodies(&mut self) -> bool {
        let mut out = BTreeSet::new();
        for frame in 0..self.n_frames {
            let boxes: Vec<(&Body, OrientedBox, f64)> = self
                .tracks
                .values()
                .filter_map(|track| {
                    let (_, shape) = track.oriented_box(frame)?;
                    Some((&track.body, shape, shape.length.hypot(shape.width) / 2.0))
                })
                .collect();
            for (i, (a, shape, reach)) in boxes.iter().enumerate() {
                for (b, other, their_reach) in &boxes[i + 1..] {
                    let stand = !a.is_mobile && !b.is_mobile && frame > 0;
                    let apart = shape.pose.position.distance(other.pose.position);
                    let together = a.group == b.group;
                    if stand || together || apart > reach + their_reach || !shape.overlaps(other) {
                        continue;
                    }
                    if out.contains(&a.id) || out.contains(&b.id) {
                        continue;
                    }
                    // Standing people go first, then parked vehicles, then people who walk.
                    let order = |body: &Body| match (body.kind, body.is_mobile) {
                        (AgentKind::Pedestrian, false) => 0,
                        (_, false) => 1,
                        (AgentKind::Pedestrian, true) => 2,
                        (_, true) => 3,
                    };
                    let first = if order(a) <= order(b) { a } else { b };
                    if order(first) == 3 {
                        return false;
                    }
                    out.insert(first.id);
                }
            }
        }
        self.tracks.retain(|id, _| !out.contains(id));
        true
    }

    /// True if two boxes overlap in any frame.
    pub(crate) fn has_overlaps(&self) -> bool {
        (0..self.n_frames).any(|frame| {
            let boxes: Vec<(bool, OrientedBox)> = self
                .tracks()
                .filter_map(|track| track.oriented_box(frame))
                .collect();
            boxes.iter().enumerate().any(|(i, a)| {
                // Parked vehicles keep apart by construction.
                let matters = |b: &&(bool, OrientedBox)| a.0 || b.0;
                boxes[i + 1..]
                    .iter()
                    .filter(matters)
                    .any(|b| a.1.overlaps(&b.1))
            })
        })
    }
}

impl Track {
    /// The pose in a frame.
    pub(crate) fn pose(&self, frame: usize) -> Option<Pose> {
        self.poses[frame + 1]
    }

    pub(crate) fn pose_at_snapshot(&self, snapshot: usize) -> Option<Pose> {
        self.poses[snapshot]
    }

    /// Present in every snapshot.
    pub(crate) fn is_complete(&self) -> bool {
        self.poses.iter().all(Option::is_some)
    }

    /// Present for at least half of the frames after `now`.
    pub(crate) fn lasts_after(&self, now: usize) -> bool {
        let after = &self.poses[now + 2..];
        2 * after.iter().flatten().count() >= after.len()
    }

    /// Distance between the first and the last position, metres.
    pub(crate) fn distance_driven(&self) -> f64 {
        let mut seen = self.poses.iter().flatten();
        match (seen.next(), seen.next_back()) {
            (Some(first), Some(last)) => first.position.distance(last.position),
            _ => 0.0,
        }
    }

    /// Lanes and arc lengths, frame by frame while present.
    pub(crate) fn places(&self) -> &[(LaneIdx, f64)] {
        &self.places
    }

    /// The box in a frame, and whether it is of something that moves.
    fn oriented_box(&self, frame: usize) -> Option<(bool, OrientedBox)> {
        let shape = OrientedBox {
            pose: self.pose(frame)?,
            length: self.body.size[0],
            width: self.body.size[1],
        };
        Some((self.body.is_mobile, shape))
    }

    /// The agent in a frame, placed in the world.
    pub(crate) fn agent(&self, frame: usize, placement: &Placement, dt: f64) -> Option<Agent> {
        let pose = self.pose(frame)?;
        let [length, width, height] = self.body.size;
        let (before, after) = (self.poses[frame], self.poses[frame + 2]);
        // The velocity is the difference of positions, centred where both neighbours exist.
        let velocity = match (before, after) {
            (Some(a), Some(b)) => (b.position - a.position) / (2.0 * dt),
            (Some(a), None) => (pose.position - a.position) / dt,
            (None, Some(b)) => (b.position - pose.position) / dt,
            (None, None) => DVec2::ZERO,
        };
        let world = placement.world_from_scene;
        let state = AgentState {
            pose: Pose {
                position: world * pose.position,
                heading: wrap_angle(world.heading + pose.heading),
            },
            velocity: world.rotate(velocity),
        };
        Some(Agent {
            id: AgentId(self.body.id),
            kind: self.body.kind,
            length,
            width,
            height,
            elevation: placement.elevation(pose.position) + height / 2.0,
            state,
        })
    }
}
