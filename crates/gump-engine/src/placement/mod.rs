//! Placement of objects: valid positions and states, for generated scenes and for agents that enter
//! a scene.

pub mod births;
pub mod network;
pub mod object_spec;
pub mod places;
pub mod rules;
pub mod spawn_map;
