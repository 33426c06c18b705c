//! Drawing of agents, their trails, and lights.
//!
//! Shapes of one colour are gathered into one path each, which keeps films fast.

use gump_geometry::{DVec2, OrientedBox, Pose, dvec2};
use gump_scene::{Agent, AgentId, AgentKind, Frame, LightState, MapGraph};

use crate::pen::{Pen, Shape};
use crate::theme::{Colours, Rgb};

/// In this order, so that what is rare and small ends up on top.
const KINDS: [AgentKind; 7] = [
    AgentKind::Other,
    AgentKind::Barrier,
    AgentKind::Sign,
    AgentKind::TrafficCone,
    AgentKind::Vehicle,
    AgentKind::Bicycle,
    AgentKind::Pedestrian,
];

/// Boxes smaller than this are drawn as discs, pixels: their shape would not show.
const SMALLEST_BOX: f32 = 4.0;

/// Boxes narrower than this have neither border nor round corners, pixels: these would be
/// invisible, and are half the cost of a film.
const FINE: f32 = 5.0;

/// Draws the agents of a frame, the ego last and set off, with an opacity in [0, 1].
pub(crate) fn draw_agents(
    pen: &mut Pen<'_>,
    frame: &Frame,
    ego: AgentId,
    colours: &Colours,
    opacity: f32,
) {
    for kind in KINDS {
        let is_shown = |a: &&Agent| a.kind == kind && a.id != ego && is_seen(pen, a);
        let agents: Vec<&Agent> = frame.agents().iter().filter(is_shown).collect();
        draw_boxes(pen, &agents, colours.kind(kind), colours, opacity);
    }
    draw_ego(pen, frame, ego, colours, opacity);
}

/// Draws the ego with a halo.
fn draw_ego(pen: &mut Pen<'_>, frame: &Frame, ego: AgentId, colours: &Colours, opacity: f32) {
    let Some(ego) = frame.agent(ego) else { return };
    let mut halo = Shape::new(&pen.camera);
    let margin = f64::from(pen.px(1.1, 2.5)) / pen.camera.scale();
    let around = OrientedBox {
        length: ego.length + 2.0 * margin,
        width: ego.width + 2.0 * margin,
        ..ego.oriented_box()
    };
    halo.rounded(&around.corners(), f64::from(pen.px(margin * 1.4, 3.0)));
    pen.fill(halo, colours.ego, 0.3 * opacity);
    draw_boxes(pen, &[ego], colours.ego, colours, opacity);
}

fn draw_boxes(pen: &mut Pen<'_>, agents: &[&Agent], colour: Rgb, colours: &Colours, opacity: f32) {
    let mut bodies = Shape::new(&pen.camera);
    let mut borders = Shape::new(&pen.camera);
    let mut wedges = Shape::new(&pen.camera);
    for agent in agents {
        let pose = agent.state.pose;
        let (length, width) = (pen.px(agent.length, 0.0), pen.px(agent.width, 0.0));
        if agent.kind == AgentKind::Pedestrian || length.max(width) < SMALLEST_BOX {
            let radius = (length.min(width) / 2.0).max(SMALLEST_BOX / 2.0);
            bodies.disc(pose.position, radius);
            if radius >= FINE / 2.0 {
                borders.disc(pose.position, radius);
            }
            continue;
        }
        let corners = agent.oriented_box().corners();
        if width < FINE {
            bodies.ring(corners);
        } else {
            let radius = f64::from(length.min(width)) * 0.22;
            bodies.rounded(&corners, radius);
            borders.rounded(&corners, radius);
        }
        if length > 12.0 && width > 6.0 && agent.kind.is_moving() {
            wedges.ring(wedge(pose, agent.length, agent.width));
        }
    }
    pen.fill(bodies, colour, opacity);
    // Ghosts of many futures are a cloud; details of each would only be noise.
    if opacity > 0.5 {
        pen.fill(wedges, colours.wedge, 0.85 * opacity);
        let width = pen.px(0.12, 0.6).min(1.5);
        pen.stroke(borders, colours.outline, 0.8 * opacity, width);
    }
}

/// A triangle at the front of a box that points where it heads.
fn wedge(pose: Pose, length: f64, width: f64) -> [DVec2; 3] {
    let nose = length / 2.0 - 0.14 * width;
    let base = nose - 0.55 * width;
    [
        dvec2(nose, 0.0),
        dvec2(base, 0.32 * width),
        dvec2(base, -0.32 * width),
    ]
    .map(|point| pose * point)
}

/// Draws where agents have been, fading with age in `n_fades` steps; `frames` are oldest first and
/// end now.
pub(crate) fn draw_past(
    pen: &mut Pen<'_>,
    frames: &[Frame],
    ego: AgentId,
    colours: &Colours,
    n_fades: usize,
) {
    let last = frames.len().saturating_sub(1);
    for step in 0..n_fades {
        let (from, to) = (step * last / n_fades, (step + 1) * last / n_fades);
        let opacity = 0.6 * (step + 1) as f32 / n_fades as f32;
        if from < to {
            draw_trails(pen, &frames[from..=to], ego, colours, |_| opacity);
        }
    }
}

/// Draws where agents go in each of several futures; every one starts from `now`.
pub(crate) fn draw_trails_of_futures(
    pen: &mut Pen<'_>,
    now: &Frame,
    futures: &[&[Frame]],
    ego: AgentId,
    colours: &Colours,
) {
    // Where all futures agree their lines add up to a solid one.
    let opacity = (2.0 / (futures.len().max(1) as f32)).clamp(0.08, 0.75);
    for future in futures {
        let frames: Vec<&Frame> = std::iter::once(now).chain(future.iter()).collect();
        draw_trails(pen, &frames, ego, colours, |is_ego| {
            if is_ego {
                (opacity * 1.6).min(0.9)
            } else {
                opacity
            }
        });
    }
}

/// One line per agent through the frames, one stroke per kind.
fn draw_trails<F: std::borrow::Borrow<Frame>>(
    pen: &mut Pen<'_>,
    frames: &[F],
    ego: AgentId,
    colours: &Colours,
    opacity: impl Fn(bool) -> f32,
) {
    let Some((first, later)) = frames.split_first() else {
        return;
    };
    let mut shapes = KINDS.map(|_| Shape::new(&pen.camera));
    let mut of_ego = Shape::new(&pen.camera);
    // Agents that appear on the way have no past here; their trail begins in a later call.
    for agent in first
        .borrow()
        .agents()
        .iter()
        .filter(|a| is_seen_far(pen, a))
    {
        let positions = later
            .iter()
            .map_while(|frame| frame.borrow().agent(agent.id))
            .map(|a| a.state.pose.position);
        let line = std::iter::once(agent.state.pose.position).chain(positions);
        if agent.id == ego {
            of_ego.line(line);
        } else if let Some(i) = KINDS.iter().position(|&kind| kind == agent.kind) {
            shapes[i].line(line);
        }
    }
    let width = pen.px(0.35, 1.0).min(3.0);
    for (shape, kind) in shapes.into_iter().zip(KINDS) {
        pen.trail(shape, colours.kind(kind), opacity(false), width);
    }
    pen.trail(of_ego, colours.ego, opacity(true), width * 1.3);
}

/// Draws each light as a dot where vehicles stop for it.
pub(crate) fn draw_lights(pen: &mut Pen<'_>, frame: &Frame, map: &MapGraph, colours: &Colours) {
    let radius = pen.px(0.55, 1.5).min(8.0);
    for (at, state) in places_of_lights(frame, map) {
        if pen.camera.may_see(at, 2.0) {
            let mut ring = Shape::new(&pen.camera);
            ring.disc(at, radius * 1.4);
            pen.fill(ring, colours.outline, 0.9);
            let mut dot = Shape::new(&pen.camera);
            dot.disc(at, radius);
            pen.fill(dot, colours.light(state), 1.0);
        }
    }
}

/// Where vehicles stop for each light, and its state; lights on lanes that the map lacks are left
/// out.
pub(crate) fn places_of_lights(
    frame: &Frame,
    map: &MapGraph,
) -> impl Iterator<Item = (DVec2, LightState)> {
    frame.lights().iter().filter_map(|light| {
        let start = || map.lane(light.lane).map(|lane| lane.centerline.points()[0]);
        Some((light.stop_point.or_else(start)?, light.state))
    })
}

fn is_seen(pen: &Pen<'_>, agent: &Agent) -> bool {
    let radius = agent.length.hypot(agent.width) / 2.0;
    pen.camera.may_see(agent.state.pose.position, radius + 2.0)
}

/// As [`is_seen`], for agents that may come into view within the frames of a trail.
fn is_seen_far(pen: &Pen<'_>, agent: &Agent) -> bool {
    pen.camera.may_see(agent.state.pose.position, 200.0)
}
