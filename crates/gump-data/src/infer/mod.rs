//! What formats leave out, inferred by one set of rules for all of them.
//!
//! Every rule looks only at what a [`Scenario`](gump_scene::Scenario) itself holds, so a scenario
//! that is written and read again is inferred the same.

use gump_scene::{MapParts, Scenario};

use crate::{ReadOptions, ReadReport};

/// The width of a lane about which nothing is known, metres.
///
/// Source: the usual width in the standard drawings for North American streets, 10 to 12 feet;
/// 3.5 m lies within, and the lanes of the mini scenarios measure so.
pub(crate) const DEFAULT_LANE_WIDTH: f64 = 3.5;

/// Fills gaps of a map.
pub(crate) fn map(_parts: &mut MapParts, _options: ReadOptions, _report: &mut ReadReport) {}

/// Fills in the ego's route.
pub(crate) fn route(_scenario: &mut Scenario, _options: ReadOptions, _report: &mut ReadReport) {}
