//! One file per verb: arguments, then what the verb does, by calling crates.

pub(crate) mod ablate;
pub(crate) mod bench;
pub(crate) mod ci;
pub(crate) mod data;
pub(crate) mod demo;
pub(crate) mod evaluate;
mod explain;
pub(crate) mod generate;
pub(crate) mod manual;
pub(crate) mod plan;
pub(crate) mod rl;
pub(crate) mod simulate;
pub(crate) mod submit;
pub(crate) mod tidy;
pub(crate) mod train;
pub(crate) mod web;
