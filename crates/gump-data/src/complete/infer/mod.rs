//! Inference of what formats lack, by the same rules for all of them.
//!
//! Every rule uses only the [`Scenario`] itself, so a scenario that is written and read again gets
//! the same inferred values. Start with [`map`] and [`route`].

mod drivable;
mod edges;
mod intersections;
mod lane_graph;
mod light_gaps;
mod light_lanes;
mod route;
mod stop_sign_lanes;
mod targets;
mod widths;

use std::sync::Arc;

use gump_scene::{Frame, LaneKind, Light, MapGraph, MapParts, Scenario};

use crate::{ReadOptions, ReadReport};
pub(crate) use targets::choose as choose_targets;

/// The default width of a lane of this kind, metres.
///
/// Source: lanes of 10 to 12 feet (3.0 to 3.7 m) are the rule in AASHTO's "A Policy on Geometric
/// Design of Highways and Streets"; bicycle lanes of 5 feet (1.5 m) in its "Guide for the
/// Development of Bicycle Facilities".
pub(crate) fn default_width(kind: LaneKind) -> f64 {
    match kind {
        LaneKind::BikeLane => 1.5,
        LaneKind::Freeway | LaneKind::SurfaceStreet | LaneKind::Undefined => 3.5,
    }
}

/// Fills gaps of a map whose lanes still have their default widths.
pub(crate) fn map(parts: &mut MapParts, options: ReadOptions, report: &mut ReadReport) {
    if options.infer_intersections {
        intersections::infer(&mut parts.lanes, report);
    }
    if options.infer_stop_sign_lanes {
        stop_sign_lanes::infer(parts, report);
    }
    if options.infer_widths {
        widths::infer(parts, report);
    }
    if options.infer_drivable && parts.drivable.is_empty() {
        drivable::infer(parts, report);
    }
}

/// Links lanes of a format that states no links; call it before [`map`], which uses links.
pub(crate) fn lane_graph(parts: &mut MapParts, options: ReadOptions, report: &mut ReadReport) {
    if options.infer_lane_graph {
        lane_graph::infer(parts, report);
    }
}

/// Fills gaps that only some formats leave; call it after [`map`].
pub(crate) fn limits_and_edges(
    parts: &mut MapParts,
    options: ReadOptions,
    report: &mut ReadReport,
) {
    if options.infer_speed_limits {
        lane_graph::speed_limits(parts, report);
    }
    if options.infer_edges {
        edges::infer(parts, report);
    }
}

/// Attaches lights of unknown lanes to lanes.
pub(crate) fn light_lanes(
    lights: &mut [(usize, Light)],
    map: &MapGraph,
    options: ReadOptions,
    report: &mut ReadReport,
) {
    if options.infer_light_lanes {
        light_lanes::infer(lights, map, report);
    }
}

/// Holds the colours of lights across gaps in observations; `now` is the index of the present.
pub(crate) fn light_gaps(
    log: &mut [Frame],
    now: usize,
    dt: f64,
    options: ReadOptions,
    report: &mut ReadReport,
) {
    if options.infer_light_gaps {
        light_gaps::infer(log, now, dt, report);
    }
}

/// Chooses prediction targets, for a format without them.
pub(crate) fn targets(scenario: &mut Scenario, options: ReadOptions, report: &mut ReadReport) {
    if options.infer_targets {
        scenario.targets = choose_targets(&scenario.log, scenario.now, scenario.ego);
        report.infer("agent to predict", scenario.targets.len());
    }
}

/// Infers the ego's route if none is stated.
pub(crate) fn route(scenario: &mut Scenario, options: ReadOptions, report: &mut ReadReport) {
    if !options.infer_route || scenario.route.is_some() {
        return;
    }
    match route::infer(scenario) {
        Some(route) => {
            report.infer("route from the ego's log", 1);
            scenario.route = Some(Arc::new(route));
        }
        None => report.drop("route: the ego's log follows no lane", 1),
    }
}
