//! Targets at the slots of a sample.

use gump_model::decoder::{CONTROL_KEYS, STEPS};
use gump_model::local_frame::LocalFrame;
use gump_model::placed_slot::PlacedSlot;
use gump_model::trajectory_head::{FUTURE, PAST, POSE};
use gump_scene::AgentState;
use gump_tokenizer::{FIRST_LIGHT, Identities, Key, PAD, Slot, class_index, light_token};

use super::window::Window;

/// Slower objects stand, metres per second: above the jitter of recorded boxes.
const STANDING_M_PER_S: f64 = 0.3;

/// The target of the decoder at a key.
#[derive(Clone, Debug)]
pub(crate) struct StateTarget {
    /// Index of the key in the slots.
    pub(crate) key: usize,
    /// Bin per step, in the object's local frame; `None` where the log has no state.
    pub(crate) bins: [Option<u16>; STEPS.len()],
    /// False if the window has not shown the object before, so that its position is open.
    pub(crate) is_known: bool,
    /// True if the object is slower than 0.3 m/s in the log.
    pub(crate) stands: bool,
}

impl StateTarget {
    /// Removes the targets of sizes.
    pub(crate) fn forget_size(&mut self) {
        self.bins[..2].fill(None);
    }

    /// The token of a step, PAD where the log has no state.
    pub(crate) fn token(&self, step: usize) -> u32 {
        self.bins[step].map_or(PAD, |bin| STEPS[step].token(bin))
    }
}

/// The target of the successor at a slot: an index into the control alphabet, a light's state or a
/// class.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ControlTarget {
    pub(crate) slot: usize,
    pub(crate) successor: u32,
}

/// The target of a trajectory head for an agent.
#[derive(Clone, Debug)]
pub(crate) struct TrajectoryTarget {
    /// Index of the key in the slots; the value follows it.
    pub(crate) key: usize,
    pub(crate) past: [Option<[f32; POSE]>; PAST],
    pub(crate) future: [Option<[f32; POSE]>; FUTURE],
}

/// Index of BEGIN in the control alphabet; NEWBORN and LIGHTS_END follow.
pub(super) const CONTROL_BEGIN: u32 = CONTROL_KEYS as u32;
pub(super) const CONTROL_NEWBORN: u32 = CONTROL_BEGIN + 1;
pub(super) const CONTROL_LIGHTS_END: u32 = CONTROL_BEGIN + 2;

/// Targets of every key, from the log and not from the presented (thinned, perturbed) tokens.
pub(super) fn targets(
    slots: &[PlacedSlot],
    window: &Window<'_>,
    identities: &Identities,
    local_frame: bool,
) -> (Vec<StateTarget>, Vec<TrajectoryTarget>) {
    let mut states = Vec::new();
    let mut trajectories = Vec::new();
    for (i, placed) in slots.iter().enumerate() {
        let (Slot::Key(key), Some(next)) = (placed.slot, slots.get(i + 1)) else {
            continue;
        };
        let Slot::Value(value) = next.slot else {
            continue;
        };
        let Some(id) = identities.agent(key.id) else {
            continue;
        };
        let frame = placed.frame;
        let own_frame = match local_frame {
            true => placed.last_pose().map_or(LocalFrame::SCENE, LocalFrame::at),
            false => LocalFrame::SCENE,
        };
        let mut chunk = std::array::from_fn(|pose| window.expected(frame, -1, pose + 1, id));
        chunk[0] = chunk[0].or(Some(value.to_agent_state()));
        states.push(StateTarget {
            key: i,
            bins: own_frame.bins(value, chunk),
            is_known: placed.last.is_some(),
            stands: chunk[0].is_some_and(|state| state.speed() < STANDING_M_PER_S),
        });
        let seen = |offset: isize| {
            let agent = window.seen(frame, offset)?.agent(id)?;
            Some(window.state(agent))
        };
        if let Some(present) = seen(0) {
            let relative = |state: AgentState| {
                let moved = state.pose.position - present.pose.position;
                let (sin, cos) = state.pose.heading.sin_cos();
                [moved.x as f32, moved.y as f32, sin as f32, cos as f32]
            };
            trajectories.push(TrajectoryTarget {
                key: i,
                past: std::array::from_fn(|m| seen(-(m as isize) - 1).map(relative)),
                future: std::array::from_fn(|m| window.expected(frame, 0, m + 1, id).map(relative)),
            });
        }
    }
    (states, trajectories)
}

/// At every control or value slot, its successor (model.md 10.1).
pub(super) fn control_targets(slots: &[PlacedSlot]) -> Vec<ControlTarget> {
    let mut targets = Vec::new();
    for (slot, placed) in slots.iter().enumerate() {
        if matches!(placed.slot, Slot::Key(_) | Slot::Prompt(_) | Slot::Pad) {
            continue;
        }
        let successor = match slots.get(slot + 1).map(|next| next.slot) {
            Some(Slot::Key(Key { id, .. })) => u32::from(id),
            Some(Slot::Begin) => CONTROL_BEGIN,
            Some(Slot::Newborn) => CONTROL_NEWBORN,
            Some(Slot::LightsEnd) => CONTROL_LIGHTS_END,
            _ => continue,
        };
        targets.push(ControlTarget { slot, successor });
    }
    targets
}

/// Before every light, its state; of the same frame the earlier lights are visible.
pub(super) fn light_targets(slots: &[PlacedSlot]) -> Vec<ControlTarget> {
    let successor = |next: &PlacedSlot| match next.slot {
        Slot::Light(light) => Some(light_token(light.state) - FIRST_LIGHT),
        _ => None,
    };
    successors(slots, successor)
}

/// Before every agent new to the window, its class; the ego's is known.
pub(super) fn class_targets(slots: &[PlacedSlot]) -> Vec<ControlTarget> {
    let successor = |next: &PlacedSlot| match next.slot {
        Slot::Key(key) if !key.is_ego() && next.last.is_none() => {
            Some(class_index(key.kind) as u32)
        }
        _ => None,
    };
    successors(slots, successor)
}

/// A target at every slot for whose successor `successor_of` returns one.
fn successors(
    slots: &[PlacedSlot],
    successor_of: impl Fn(&PlacedSlot) -> Option<u32>,
) -> Vec<ControlTarget> {
    let pairs = slots.windows(2).enumerate();
    let target = |(slot, pair): (usize, &[PlacedSlot])| {
        let successor = successor_of(&pair[1])?;
        Some(ControlTarget { slot, successor })
    };
    pairs.filter_map(target).collect()
}
