//! Where objects may be put, and as what: for generating scenes and for agents that come into one.

pub mod births;
pub mod ground;
pub mod object_spec;
pub mod rules;
