//! The frame in which a chunk is expressed: that of the scene, as in the paper, or that of the
//! object's last state.
//!
//! In its own frame, the motion of an object that goes straight on is the same at every position
//! and in every direction, and half a second covers a small part of the scene, so that the same
//! bins are finer: 5 cm and 0.9° at the first pose instead of 20 cm and 1.8°.

use gump_geometry::{DVec2, Pose};
use gump_scene::AgentState;
use gump_tokenizer::{Field, QuantizedState};

use crate::decoder::{Bins, CHUNK, STEPS};

/// Factor by which the positions of a chunk are finer in an object's own frame, pose by pose: the
/// first reaches 25 m (50 m/s), each further one 25 m more.
const FINER_PLACES: [f64; CHUNK] = [4.0, 2.0, 4.0 / 3.0, 1.0];
/// Likewise for headings. The first reaches a quarter turn; beyond, opposite directions coincide.
const FINER_HEADINGS: [f64; CHUNK] = [2.0, 1.0, 1.0, 1.0];
/// Steps of the decoder before the first pose: width, length and velocity.
const POSES: usize = 4;

/// The frame in which a chunk is expressed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalFrame {
    scene_from_local: Pose,
    places: [f64; CHUNK],
    headings: [f64; CHUNK],
}

impl LocalFrame {
    /// The scene's own frame, in the bins of the tokens.
    pub const SCENE: Self = Self {
        scene_from_local: Pose {
            position: DVec2::ZERO,
            heading: 0.0,
        },
        places: [1.0; CHUNK],
        headings: [1.0; CHUNK],
    };

    /// The frame of an object that was last at `pose`, scene frame.
    pub fn at(pose: Pose) -> Self {
        Self {
            scene_from_local: pose,
            places: FINER_PLACES,
            headings: FINER_HEADINGS,
        }
    }

    /// The object's last pose; `None` if chunks are expressed in the scene's frame.
    pub fn origin(&self) -> Option<Pose> {
        (*self != Self::SCENE).then_some(self.scene_from_local)
    }

    /// The bins of a chunk: the size of `like`, the velocity of the first state, and the poses of
    /// all, scene frame; `None` where there is no state. A later pose beyond the grid has no bins,
    /// because clamped ones would be wrong; the first is clamped.
    pub fn bins(
        &self,
        like: QuantizedState,
        states: [Option<AgentState>; CHUNK],
    ) -> [Option<u16>; STEPS.len()] {
        let mut bins = [None; STEPS.len()];
        bins[0] = Some(like.get(STEPS[0]));
        bins[1] = Some(like.get(STEPS[1]));
        let local_from_scene = self.scene_from_local.inverse();
        if let Some(state) = states[0] {
            let velocity = local_from_scene.rotate(state.velocity);
            bins[2] = Some(Field::VelocityX.quantize(velocity.x).bin);
            bins[3] = Some(Field::VelocityY.quantize(velocity.y).bin);
        }
        for (i, state) in states.into_iter().enumerate() {
            let Some(state) = state else { continue };
            let pose = local_from_scene * state.pose;
            let place = pose.position * self.places[i];
            if i > 0 && place.abs().max_element() > Field::X.high() {
                continue;
            }
            let at = POSES + CHUNK_STEP * i;
            bins[at] = Some(Field::X.quantize(place.x).bin);
            bins[at + 1] = Some(Field::Y.quantize(place.y).bin);
            let heading = gump_geometry::wrap_angle(pose.heading) * self.headings[i];
            bins[at + 2] = Some(Field::Heading.quantize(heading).bin);
        }
        bins
    }

    /// The velocity of the bins of a chunk, scene frame, metres per second.
    pub fn velocity(&self, bins: &Bins) -> DVec2 {
        let (x, y) = (
            Field::VelocityX.dequantize(bins[2]),
            Field::VelocityY.dequantize(bins[3]),
        );
        self.scene_from_local.rotate(DVec2::new(x, y))
    }

    /// The poses of the bins of a chunk, scene frame.
    pub fn poses(&self, bins: &Bins) -> [Pose; CHUNK] {
        std::array::from_fn(|i| {
            let at = POSES + CHUNK_STEP * i;
            self.scene_from_local
                * Pose::new(
                    Field::X.dequantize(bins[at]) / self.places[i],
                    Field::Y.dequantize(bins[at + 1]) / self.places[i],
                    Field::Heading.dequantize(bins[at + 2]) / self.headings[i],
                )
        })
    }

    /// The bins of the first x and y whose places may lie within `reach` metres of `centre`, scene
    /// frame, along both axes of the frame.
    pub fn near(&self, centre: DVec2, reach: f64) -> [std::ops::RangeInclusive<u16>; 2] {
        let centre = self.scene_from_local.inverse() * centre;
        [(Field::X, centre.x), (Field::Y, centre.y)].map(|(field, at)| {
            let bin = |place: f64| field.quantize(place * self.places[0]).bin;
            bin(at - reach)..=bin(at + reach)
        })
    }
}

/// Steps of the decoder per pose.
const CHUNK_STEP: usize = 3;

#[cfg(test)]
mod tests {
    use gump_geometry::{angle_difference, dvec2};

    use super::*;

    fn state(x: f64, y: f64, heading: f64) -> Option<AgentState> {
        Some(AgentState {
            pose: Pose::new(x, y, heading),
            velocity: Pose::new(0.0, 0.0, heading).rotate(dvec2(8.0, 0.0)),
        })
    }

    fn all(bins: [Option<u16>; STEPS.len()]) -> Bins {
        bins.map(|bin| bin.expect("every step has a bin"))
    }

    #[test]
    fn what_is_said_in_a_frame_is_read_back_within_half_a_bin() {
        let chunk = [
            state(52.3, -31.7, 2.0),
            state(50.6, -28.1, 2.1),
            state(48.5, -24.6, 2.2),
            state(46.0, -21.5, 2.3),
        ];
        let own = LocalFrame::at(Pose::new(54.0, -35.4, 1.9));
        for (local_frame, place, turn) in [(LocalFrame::SCENE, 0.1, 0.016), (own, 0.025, 0.008)] {
            let bins = all(local_frame.bins(QuantizedState::default(), chunk));
            let poses = local_frame.poses(&bins);
            let found = poses[0].position - dvec2(52.3, -31.7);
            // Both coordinates may be half a bin off, along the axes of the frame.
            assert!(found.length() <= 1.415 * place, "{found}");
            assert!(angle_difference(poses[0].heading, 2.0).abs() <= turn);
            assert!(poses[3].position.distance(dvec2(46.0, -21.5)) < 0.15);
            let expected = Pose::new(0.0, 0.0, 2.0).rotate(dvec2(8.0, 0.0));
            assert!(local_frame.velocity(&bins).distance(expected) < 0.18);
        }
    }

    #[test]
    fn the_same_motion_says_the_same_anywhere() {
        let steps = |from: Pose| {
            let ahead = |m: f64| AgentState {
                pose: from * Pose::new(m, 0.0, 0.01 * m),
                velocity: from.rotate(dvec2(8.0, 0.0)),
            };
            let chunk = [4.01, 8.01, 12.01, 16.01].map(|m| Some(ahead(m)));
            all(LocalFrame::at(from).bins(QuantizedState::default(), chunk))
        };
        assert_eq!(
            steps(Pose::new(0.0, 0.0, 0.0)),
            steps(Pose::new(61.0, -44.0, -2.5))
        );
    }

    #[test]
    fn what_is_missing_or_beyond_the_grid_has_no_bins() {
        let far = LocalFrame::at(Pose::default()).bins(
            QuantizedState::default(),
            [
                state(30.0, 0.0, 0.0),
                state(60.0, 0.0, 0.0),
                None,
                state(99.0, 0.0, 0.0),
            ],
        );
        // The first is clamped, the second beyond 50 m, the third missing.
        assert_eq!(far[4], Some(999));
        assert_eq!((far[7], far[10]), (None, None));
        assert!(far[13].is_some());
    }
}
