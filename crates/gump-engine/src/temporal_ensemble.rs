//! Temporal ensemble: the average of several chunks' predictions for the same instant, which
//! smooths motion.
//!
//! A ring buffer per agent keeps its last chunks, tagged with the frame they were decoded for, so
//! that stale chunks are never used. It is only filled by the model, never from a log.

use gump_geometry::{DVec2, Pose, angle_difference};
use gump_model::decoder::CHUNK;

/// A prediction farther than this from the present one belongs to another plan and is ignored,
/// metres (released code: 5).
const GATE_M: f64 = 5.0;
/// Likewise for headings, radians: beyond a right angle two directions have no useful mean. The
/// released code has no such limit.
const GATE_RAD: f64 = std::f64::consts::FRAC_PI_2;

/// The predicted poses of an agent, half a second apart, scene frame.
pub(crate) type Chunk = [Pose; CHUNK];

/// The last chunks of one agent.
#[derive(Clone, Debug, Default)]
pub struct ChunkBuffer {
    chunks: Vec<(usize, Chunk)>,
}

impl ChunkBuffer {
    /// Stores the raw chunk decoded for `frame`.
    pub(crate) fn push(&mut self, frame: usize, chunk: Chunk) {
        self.chunks.retain(|(tag, _)| tag + CHUNK > frame + 1);
        self.chunks.push((frame, chunk));
    }

    /// Expresses all chunks in another frame of reference.
    pub(crate) fn transform(&mut self, new_from_old: Pose) {
        for pose in self.chunks.iter_mut().flat_map(|(_, chunk)| chunk) {
            *pose = new_from_old * *pose;
        }
    }

    /// Drops all chunks, as needed for an agent that was driven externally.
    pub(crate) fn clear(&mut self) {
        self.chunks.clear();
    }

    /// The prediction of earlier chunks for `frame`, if there is one: its surrogate. Without
    /// averaging it is the newest chunk's prediction.
    pub(crate) fn surrogate(&self, frame: usize, decay: f64) -> Option<Pose> {
        let newest = self.said_of(frame).next()?.1;
        Some(if decay == 0.0 {
            newest
        } else {
            self.average(frame, newest, 0.0, decay)
        })
    }

    /// `sample`, decoded for `frame`, averaged with the predictions of earlier chunks for the same
    /// frame.
    ///
    /// The prediction made `i` frames ago has the weight `decay^i`; 0 switches averaging off.
    pub(crate) fn aggregate(&self, frame: usize, sample: Pose, decay: f64) -> Pose {
        if decay == 0.0 {
            sample
        } else {
            self.average(frame, sample, 1.0, decay)
        }
    }

    /// Weighted mean of `centre` (with its own weight) and the chunks near it.
    fn average(&self, frame: usize, centre: Pose, own: f64, decay: f64) -> Pose {
        let (mut weight, mut moved, mut direction) = (own, DVec2::ZERO, centre.direction() * own);
        for (age, pose) in self.said_of(frame) {
            let near = pose.position.distance(centre.position) <= GATE_M
                && angle_difference(pose.heading, centre.heading).abs() <= GATE_RAD;
            if near {
                let w = decay.powi(age as i32);
                weight += w;
                moved += w * (pose.position - centre.position);
                direction += w * pose.direction();
            }
        }
        Pose {
            position: centre.position + moved / weight,
            heading: direction.to_angle(),
        }
    }

    /// (age in frames, pose) of every chunk that reaches `frame`, newest first.
    fn said_of(&self, frame: usize) -> impl Iterator<Item = (usize, Pose)> + '_ {
        self.chunks.iter().rev().filter_map(move |(tag, chunk)| {
            let age = frame.checked_sub(*tag)?;
            (1..CHUNK).contains(&age).then(|| (age, chunk[age]))
        })
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    fn chunk(poses: [(f64, f64); CHUNK]) -> [Pose; CHUNK] {
        poses.map(|(x, heading)| Pose::new(x, 0.0, heading))
    }

    fn ring(chunks: &[(usize, [(f64, f64); CHUNK])]) -> ChunkBuffer {
        let mut ring = ChunkBuffer::default();
        chunks
            .iter()
            .for_each(|(frame, poses)| ring.push(*frame, chunk(*poses)));
        ring
    }

    #[test]
    fn agreeing_chunks_are_a_fixed_point() {
        let ring = ring(&[
            (1, [(1.0, 0.1), (2.0, 0.1), (3.0, 0.1), (4.0, 0.1)]),
            (2, [(2.0, 0.1), (3.0, 0.1), (4.0, 0.1), (5.0, 0.1)]),
        ]);
        let pose = ring.aggregate(3, Pose::new(3.0, 0.0, 0.1), 1.2);
        assert!((pose.position.x - 3.0).abs() < 1e-12 && (pose.heading - 0.1).abs() < 1e-12);
    }

    #[test]
    fn weights_grow_with_age_and_are_normalised() {
        let ring = ring(&[
            (1, [(0.0, 0.0), (0.0, 0.0), (2.0, 0.0), (0.0, 0.0)]),
            (2, [(0.0, 0.0), (1.0, 0.0), (0.0, 0.0), (0.0, 0.0)]),
        ]);
        let pose = ring.aggregate(3, Pose::new(0.0, 0.0, 0.0), 1.2);
        let expected = (1.2 * 1.0 + 1.44 * 2.0) / (1.0 + 1.2 + 1.44);
        assert!((pose.position.x - expected).abs() < 1e-12);
    }

    #[test]
    fn without_decay_or_memory_the_sample_stays() {
        let sample = Pose::new(3.0, 0.0, 0.4);
        let full = ring(&[(2, [(0.0, 0.0), (1.0, 0.0), (0.0, 0.0), (0.0, 0.0)])]);
        assert_eq!(full.aggregate(3, sample, 0.0), sample);
        assert!(
            ChunkBuffer::default()
                .aggregate(3, sample, 1.2)
                .position
                .distance(sample.position)
                < 1e-12
        );
        assert!(ChunkBuffer::default().surrogate(3, 1.2).is_none());
    }

    #[test]
    fn far_and_stale_predictions_are_ignored() {
        let far = ring(&[(2, [(0.0, 0.0), (9.0, 0.0), (0.0, 0.0), (0.0, 0.0)])]);
        assert!(far.aggregate(3, Pose::new(3.0, 0.0, 0.0), 1.2).position.x == 3.0);
        let stale = ring(&[(2, [(0.0, 0.0), (3.5, 0.0), (0.0, 0.0), (0.0, 0.0)])]);
        assert!(stale.aggregate(6, Pose::new(3.0, 0.0, 0.0), 1.2).position.x == 3.0);
    }

    #[test]
    fn headings_near_the_seam_average_there() {
        let ring = ring(&[(2, [(0.0, 0.0), (0.0, -PI + 0.1), (0.0, 0.0), (0.0, 0.0)])]);
        let pose = ring.aggregate(3, Pose::new(0.0, 0.0, PI - 0.1), 1.0);
        assert!(angle_difference(pose.heading, PI).abs() < 1e-9);
    }

    #[test]
    fn a_surrogate_is_what_the_chunks_say() {
        let ring = ring(&[(2, [(0.0, 0.0), (1.0, 0.2), (2.0, 0.2), (3.0, 0.2)])]);
        assert_eq!(ring.surrogate(3, 1.2).unwrap().position.x, 1.0);
        assert_eq!(ring.surrogate(5, 0.0).unwrap().position.x, 3.0);
        assert!(ring.surrogate(6, 1.2).is_none());
    }
}
