//! Plans of the road families: which roads meet where, with random dimensions, whose ranges are
//! common ones of streets, chosen by hand.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use gump_geometry::{DVec2, Pose, dvec2};
use gump_scene::Rng;
use rand::Rng as _;

use crate::RoadFamily;
use crate::curve::{Track, bend, line};
use crate::plan::{Control, NodePlan, Plan, RoadPlan};

/// How sharply roads bend.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Winding {
    /// All angles up to the sharpest are equally likely.
    Even,
    /// Most bends are slight, as recorded ones: at over 14 m/s nine tenths of recorded vehicles turn by less
    /// than 0.015 radians in a second.
    Slight,
}

impl Winding {
    /// The angle of a bend, up to `most` radians to either side.
    fn bend(self, most: f64, rng: &mut Rng) -> f64 {
        let angle = rng.random_range(-most..most);
        match self {
            Self::Even => angle,
            Self::Slight => angle * (angle / most).powi(4),
        }
    }
}

/// Draws a plan of this family around the origin, reaching `extent` metres.
pub(crate) fn draw_plan(family: RoadFamily, extent: f64, winding: Winding, rng: &mut Rng) -> Plan {
    match family {
        RoadFamily::SignalizedCrossing => crossing(Control::Signals, extent, winding, rng),
        RoadFamily::StopCrossing => {
            let control = if rng.random_bool(0.5) {
                Control::AllWayStop
            } else {
                Control::MinorStop
            };
            crossing(control, extent, winding, rng)
        }
        RoadFamily::TeeJunction => tee(extent, winding, rng),
        RoadFamily::Roundabout => roundabout(extent, winding, rng),
        RoadFamily::Arterial => arterial(extent, winding, rng),
        RoadFamily::CurvedRoad => curved_road(extent, winding, rng),
        RoadFamily::OnRamp => on_ramp(extent, winding, rng),
        RoadFamily::MidBlockCrosswalk => mid_block(extent, winding, rng),
        RoadFamily::Grid => grid(extent, winding, rng),
    }
}

fn crossing(control: Control, extent: f64, winding: Winding, rng: &mut Rng) -> Plan {
    let lanes = if control == Control::Signals {
        1..=3
    } else {
        1..=2
    };
    let main = street(rng.random_range(lanes), true, rng);
    let most = if control == Control::Signals {
        main.forward
    } else {
        1
    };
    let minor = street(rng.random_range(1..=most), false, rng);
    let skew = rng.random_range(-0.25..0.25);
    let roads = (0..4)
        .map(|leg| {
            let angle = f64::from(leg) * FRAC_PI_2 + if leg % 2 == 1 { skew } else { 0.0 };
            let style = if leg % 2 == 0 { &main } else { &minor };
            spoke(style, 0, (Pose::new(0.0, 0.0, angle), extent), winding, rng)
        })
        .collect();
    Plan {
        nodes: vec![junction(control, rng)],
        roads,
    }
}

fn tee(extent: f64, winding: Winding, rng: &mut Rng) -> Plan {
    let control = match rng.random_range(0..10) {
        0..=3 => Control::Signals,
        4..=5 => Control::AllWayStop,
        6..=8 => Control::MinorStop,
        _ => Control::MinorYield,
    };
    let n_main = if control == Control::AllWayStop {
        1
    } else {
        rng.random_range(1..=2)
    };
    let (main, minor) = (street(n_main, true, rng), street(1, false, rng));
    let skew = rng.random_range(-0.3..0.3);
    let roads = [(&main, 0.0), (&minor, FRAC_PI_2 + skew), (&main, PI)]
        .map(|(style, angle)| spoke(style, 0, (Pose::new(0.0, 0.0, angle), extent), winding, rng));
    Plan {
        nodes: vec![junction(control, rng)],
        roads: roads.into(),
    }
}

fn roundabout(extent: f64, winding: Winding, rng: &mut Rng) -> Plan {
    let n_legs = rng.random_range(3..=4);
    let radius = rng.random_range(15.0..19.0) + if n_legs == 4 { 2.0 } else { 0.0 };
    let spokes_style = RoadPlan {
        parking: false,
        ..street(1, false, rng)
    };
    let ring_style = RoadPlan {
        backward: 0,
        lane_width: rng.random_range(4.2..5.0),
        median: 0.0,
        bike_lanes: false,
        parking: false,
        sidewalks: false,
        speed_limit: 8.5,
        major: true,
        ring: true,
        ..spokes_style.clone()
    };
    let angles: Vec<f64> = (0..n_legs)
        .map(|leg| f64::from(leg) * TAU / f64::from(n_legs) + rng.random_range(-0.12..0.12))
        .collect();
    let nodes = angles.iter().map(|_| NodePlan {
        control: Control::MinorYield,
        crosswalks: false,
        corner_radius: rng.random_range(9.0..12.0),
        min_setback: 4.0,
    });
    let mut plan = Plan {
        nodes: nodes.collect(),
        roads: Vec::new(),
    };
    for (i, &angle) in angles.iter().enumerate() {
        let j = (i + 1) % angles.len();
        let sweep = (angles[j] - angle).rem_euclid(TAU);
        let n = (sweep * radius / 0.5).ceil() as usize;
        let arc = (0..=n).map(|k| DVec2::from_angle(angle + sweep * k as f64 / n as f64) * radius);
        plan.roads.push(RoadPlan {
            reference: Track::through(&arc.collect::<Vec<_>>()),
            ends: [Some(i), Some(j)],
            ..ring_style.clone()
        });
        let at = DVec2::from_angle(angle) * radius;
        let start = Pose {
            position: at,
            heading: angle,
        };
        let whole = (start, extent - radius);
        plan.roads
            .push(spoke(&spokes_style, i, whole, winding, rng));
    }
    if rng.random_bool(0.5) {
        add_crosswalks_to_spokes(&mut plan, 24.0);
    }
    plan
}

/// Splits every road that leaves the scene at a crosswalk `distance` metres from its start.
fn add_crosswalks_to_spokes(plan: &mut Plan, distance: f64) {
    for road in 0..plan.roads.len() {
        if plan.roads[road].ends[1].is_some() || plan.roads[road].backward == 0 {
            continue;
        }
        let node = plan.nodes.len();
        plan.nodes.push(crosswalk_node(Control::MinorYield));
        let whole = plan.roads[road].clone();
        let length = whole.reference.length();
        plan.roads[road].reference = whole.reference.slice(0.0, distance);
        plan.roads[road].ends[1] = Some(node);
        plan.roads.push(RoadPlan {
            reference: whole.reference.slice(distance, length),
            ends: [Some(node), None],
            ..whole
        });
    }
}

fn arterial(extent: f64, winding: Winding, rng: &mut Rng) -> Plan {
    let style = RoadPlan {
        speed_limit: rng.random_range(15.0..20.0),
        parking: false,
        ..street(rng.random_range(2..=3), true, rng)
    };
    Plan {
        nodes: Vec::new(),
        roads: vec![through_road(&style, extent * 1.2, (0.35, winding), rng)],
    }
}

fn curved_road(extent: f64, winding: Winding, rng: &mut Rng) -> Plan {
    let style = street(1, true, rng);
    Plan {
        nodes: Vec::new(),
        roads: vec![through_road(&style, extent * 1.1, (1.0, winding), rng)],
    }
}

fn mid_block(extent: f64, winding: Winding, rng: &mut Rng) -> Plan {
    let style = RoadPlan {
        sidewalks: true,
        ..street(rng.random_range(1..=2), true, rng)
    };
    let control = if rng.random_bool(0.4) {
        Control::Signals
    } else {
        Control::MinorYield
    };
    let whole = through_road(&style, extent, (0.3, winding), rng).reference;
    let middle = whole.length() / 2.0;
    let half = |reference: Track, ends| RoadPlan {
        reference,
        ends,
        ..style.clone()
    };
    Plan {
        nodes: vec![crosswalk_node(control)],
        roads: vec![
            half(whole.slice(0.0, middle), [None, Some(0)]),
            half(whole.slice(middle, whole.length()), [Some(0), None]),
        ],
    }
}

fn on_ramp(extent: f64, winding: Winding, rng: &mut Rng) -> Plan {
    let n = rng.random_range(2..=3);
    let freeway = RoadPlan {
        forward: n,
        backward: 0,
        bike_lanes: false,
        parking: false,
        sidewalks: false,
        speed_limit: rng.random_range(19.0..25.0),
        median: 1.0,
        freeway: true,
        ..street(n, true, rng)
    };
    let (reach, beside) = (extent * 1.7, rng.random_range(120.0..150.0));
    let curve = winding.bend(0.15, rng);
    let whole = bend(
        Pose::new(-reach, 0.0, 0.0),
        2.0 * reach,
        &[(reach, 0.8 * reach, curve)],
    );
    let whole = Track::through(&whole);
    let (join, end) = (reach - beside / 2.0, reach + beside / 2.0);
    let piece = |from, to, ends, forward| RoadPlan {
        reference: whole.slice(from, to),
        ends,
        forward,
        ..freeway.clone()
    };
    let at = whole.pose_at(join);
    // The ramp comes in from the right and straightens out where it meets the road.
    let aside = freeway.lane_offset(n) - freeway.lane_width / 2.0;
    let tip = Pose {
        position: at * dvec2(0.0, -aside),
        heading: at.heading + PI + 0.2,
    };
    let ramp_bend = rng.random_range(0.2..0.5);
    let mut back = bend(tip, reach - 30.0, &[(70.0, 35.0, ramp_bend)]);
    back.reverse();
    let ramp = RoadPlan {
        reference: Track::through(&back),
        ends: [None, Some(0)],
        forward: 1,
        median: 0.6,
        major: false,
        speed_limit: freeway.speed_limit * 0.75,
        ..freeway.clone()
    };
    let node = |min_setback| NodePlan {
        control: Control::Free,
        crosswalks: false,
        corner_radius: 1.0,
        min_setback,
    };
    Plan {
        nodes: vec![node(30.0), node(20.0)],
        roads: vec![
            piece(0.0, join, [None, Some(0)], n),
            piece(join, end, [Some(0), Some(1)], n + 1),
            piece(end, 2.0 * reach, [Some(1), None], n),
            ramp,
        ],
    }
}

fn grid(extent: f64, winding: Winding, rng: &mut Rng) -> Plan {
    let half = dvec2(rng.random_range(34.0..48.0), rng.random_range(34.0..48.0));
    let (east_west, north_south) = (
        street(rng.random_range(1..=2), true, rng),
        street(1, false, rng),
    );
    let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
    let corners = corners.map(|(x, y)| half * dvec2(x, y));
    let control = [Control::Signals, Control::AllWayStop, Control::MinorStop];
    let control = control[rng.random_range(0..3)];
    let mut plan = Plan {
        nodes: corners.iter().map(|_| junction(control, rng)).collect(),
        roads: Vec::new(),
    };
    for i in 0..4 {
        let j = (i + 1) % 4;
        let style = if i % 2 == 0 { &east_west } else { &north_south };
        plan.roads.push(RoadPlan {
            reference: Track::through(&line(corners[i], corners[j])),
            ends: [Some(i), Some(j)],
            ..style.clone()
        });
        for (axis, style) in [(0, &east_west), (1, &north_south)] {
            let direction = if axis == 0 {
                dvec2(corners[i].x, 0.0)
            } else {
                dvec2(0.0, corners[i].y)
            };
            let start = Pose {
                position: corners[i],
                heading: direction.to_angle(),
            };
            let length = extent - direction.length();
            plan.roads
                .push(spoke(style, i, (start, length), winding, rng));
        }
    }
    plan
}

fn junction(control: Control, rng: &mut Rng) -> NodePlan {
    NodePlan {
        control,
        crosswalks: control == Control::Signals || rng.random_bool(0.6),
        corner_radius: rng.random_range(5.0..9.0),
        min_setback: 5.0,
    }
}

fn crosswalk_node(control: Control) -> NodePlan {
    NodePlan {
        control,
        crosswalks: true,
        corner_radius: 1.0,
        min_setback: 0.0,
    }
}

/// A road style without geometry yet: `n` lanes each way and the usual other values.
pub(crate) fn street(n: usize, major: bool, rng: &mut Rng) -> RoadPlan {
    let median = match n {
        1 => 0.0,
        _ if rng.random_bool(0.4) => rng.random_range(1.8..4.5),
        _ => 0.5,
    };
    let speed = match n {
        1 => 9.0..14.0,
        2 => 12.0..17.0,
        _ => 14.0..19.0,
    };
    RoadPlan {
        reference: Track::through(&[DVec2::ZERO, dvec2(1.0, 0.0)]),
        ends: [None, None],
        forward: n,
        backward: n,
        lane_width: rng.random_range(3.2..3.7),
        median,
        bike_lanes: rng.random_bool(0.25),
        parking: n <= 2 && rng.random_bool(0.55),
        parks_in_lane: false,
        bays: false,
        sidewalks: rng.random_bool(0.9),
        speed_limit: rng.random_range(speed),
        major,
        freeway: false,
        ring: false,
    }
}

/// A road of this style from a junction outwards, straight at first, then perhaps bending.
fn spoke(
    style: &RoadPlan,
    node: usize,
    (start, length): (Pose, f64),
    winding: Winding,
    rng: &mut Rng,
) -> RoadPlan {
    // Hardly any road is quite straight; about half have a real bend.
    let mut bends = vec![(length / 2.0, 0.45 * length, winding.bend(0.12, rng))];
    if rng.random_bool(0.5) && length > 90.0 {
        let reach = rng.random_range(20.0..30.0);
        bends.push((45.0 + reach, reach, winding.bend(0.45, rng)));
    }
    RoadPlan {
        reference: Track::through(&bend(start, length, &bends)),
        ends: [Some(node), None],
        ..style.clone()
    }
}

/// A road of this style from border to border, its middle near the origin, with bends of up to
/// `sharpest` radians.
fn through_road(
    style: &RoadPlan,
    extent: f64,
    (sharpest, winding): (f64, Winding),
    rng: &mut Rng,
) -> RoadPlan {
    let n_bends = rng.random_range(1..=3);
    let bends: Vec<(f64, f64, f64)> = (0..n_bends)
        .map(|i| {
            let cell = 2.0 * extent / f64::from(n_bends);
            let reach = rng.random_range(0.25..0.45) * cell;
            // Keeps the tightest radius above about 30 m.
            let most = sharpest.min(reach / 28.0);
            ((f64::from(i) + 0.5) * cell, reach, winding.bend(most, rng))
        })
        .collect();
    let points = bend(Pose::IDENTITY, 2.0 * extent, &bends);
    let middle = points[points.len() / 2];
    let centred: Vec<DVec2> = points.iter().map(|p| *p - middle).collect();
    RoadPlan {
        reference: Track::through(&centred),
        ends: [None, None],
        ..style.clone()
    }
}
