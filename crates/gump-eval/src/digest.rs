//! Digests of futures and of predictions, which are equal only for equal arithmetic.

use gump_scene::{Agent, Prediction, Rollout};
use sha2::{Digest, Sha256};

/// SHA-256 over x, y, heading and the two velocities of every agent of every frame, as
/// little-endian f32: futures, then steps, then agents by id. Lower-case hexadecimal.
pub fn of_rollouts(rollouts: &[Rollout]) -> String {
    let mut hash = Sha256::new();
    for frame in rollouts.iter().flat_map(Rollout::imagined) {
        for number in frame.agents().iter().flat_map(numbers) {
            hash.update((number as f32).to_le_bytes());
        }
    }
    hexadecimal(hash)
}

/// SHA-256 over the confidence and the positions of every mode, as little-endian f32.
pub fn of_predictions(predictions: &[Prediction]) -> String {
    let mut hash = Sha256::new();
    for mode in predictions.iter().flat_map(|predicted| &predicted.modes) {
        let places = mode.paths.iter().flatten().flat_map(|p| p.to_array());
        for number in std::iter::once(mode.confidence).chain(places) {
            hash.update((number as f32).to_le_bytes());
        }
    }
    hexadecimal(hash)
}

/// One digest of many in their order; `None` of none.
pub fn of_digests<'a>(digests: impl IntoIterator<Item = &'a str>) -> Option<String> {
    let mut digests = digests.into_iter().peekable();
    digests.peek()?;
    let mut hash = Sha256::new();
    digests.for_each(|digest| hash.update(digest));
    Some(hexadecimal(hash))
}

/// SHA-256 of bytes, lower-case hexadecimal.
pub(crate) fn of_bytes(bytes: &[u8]) -> String {
    hexadecimal(Sha256::new_with_prefix(bytes))
}

fn hexadecimal(hash: Sha256) -> String {
    let bytes = hash.finalize();
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The numbers of an agent that count: x, y, heading and the two velocities, in the world frame.
pub fn numbers(agent: &Agent) -> [f64; 5] {
    let pose = agent.state.pose;
    let velocity = agent.state.velocity;
    [
        pose.position.x,
        pose.position.y,
        pose.heading,
        velocity.x,
        velocity.y,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_digest_is_that_of_the_bytes_it_names() {
        let scenario = gump_scene::fixture::scenario(
            "ego vehicle 0: 0,0 velocity 5,0\nagent pedestrian 3: 9,9\nhistory 1 future 2 dt 0.1",
        )
        .unwrap();
        let mut log = Rollout::begin(scenario.present());
        for frame in scenario.future() {
            log.push(frame.clone());
        }
        let rollouts = vec![log; 2];
        let mut bytes = Vec::new();
        for rollout in &rollouts {
            for frame in rollout.imagined() {
                for a in frame.agents() {
                    let (p, v) = (a.state.pose, a.state.velocity);
                    for x in [p.position.x, p.position.y, p.heading, v.x, v.y] {
                        bytes.extend((x as f32).to_le_bytes());
                    }
                }
            }
        }
        assert_eq!(bytes.len(), 2 * 20 * 2 * 5 * 4);
        assert_eq!(of_rollouts(&rollouts), of_bytes(&bytes));
        assert_eq!(of_digests([]), None);
    }
}
