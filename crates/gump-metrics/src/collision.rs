//! Overlap of boxes.

use gump_scene::{Agent, AgentId, Frame, SceneState};

use crate::{Metric, Reduce};

/// 1 if the agent's box overlaps that of any other agent now, else 0.
///
/// Boxes that only touch do not overlap. Fault and duration are ignored. [`crate::summarize`]
/// leaves out overlaps that exist at the start; `gump-nuplan` classifies collisions (and counts
/// touching, as its reference does).
#[derive(Clone, Copy, Debug)]
pub struct Collision;

impl Metric for Collision {
    fn name(&self) -> &'static str {
        "collision"
    }

    fn at(&self, scene: &SceneState<'_>, agent: &Agent) -> Option<f64> {
        let hit = overlapping(scene.now(), agent).next().is_some();
        Some(f64::from(hit))
    }

    fn reduce(&self) -> Reduce {
        Reduce::Any
    }
}

/// Ids of the agents whose box overlaps that of `agent`.
pub fn overlapping<'a>(frame: &'a Frame, agent: &'a Agent) -> impl Iterator<Item = AgentId> + 'a {
    let own = agent.oriented_box();
    frame
        .agents()
        .iter()
        .filter(move |other| other.id != agent.id && own.overlaps(&other.oriented_box()))
        .map(|other| other.id)
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::fixture;

    fn check(other: &str, expected: f64) {
        let text = format!("ego vehicle 0: 0,0 size 4,2\nagent {other}");
        let scenario = fixture::scenario(&text).unwrap();
        let scene = scenario.present();
        for agent in scene.now().agents() {
            assert_eq!(Collision.at(&scene, agent), Some(expected), "{other}");
        }
    }

    #[test]
    fn boxes_collide_when_they_overlap() {
        check("vehicle 1: 3.9,0 size 4,2", 1.0);
        check("pedestrian 1: 0,1.3 size 0.8,0.8", 1.0);
        check("other 1: 1,0 size 0.5,0.5", 1.0);
        check("vehicle 1: 10,0 size 4,2", 0.0);
    }

    #[test]
    fn touching_is_not_colliding() {
        check("vehicle 1: 4,0 size 4,2", 0.0);
        check("vehicle 1: 0,2 size 4,2", 0.0);
    }

    #[test]
    fn headings_matter() {
        check("vehicle 1: 2.9,0 size 4,2 heading 1.5707963267948966", 1.0);
        check("vehicle 1: 3.1,0 size 4,2 heading 1.5707963267948966", 0.0);
    }
}
