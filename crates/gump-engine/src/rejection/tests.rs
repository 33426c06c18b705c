//! Choice of objects to redraw, on small hand-made roads.

use gump_geometry::{Polyline, dvec2};

use super::*;

fn member(x: f64, step: f64) -> Member {
    Member {
        length: 4.0,
        width: 2.0,
        before: Some(Pose::new(x, 0.0, 0.0)),
        speed: 2.0 * step,
        edges: Vec::new(),
        off: 0.0,
        ahead: straight(x, step),
        is_driven: false,
        is_ignored: false,
        walks: false,
        reach: 2.3,
    }
}

/// Ahead by so many metres every half second.
fn straight(x: f64, step: f64) -> Way {
    let ahead = |i: usize| Pose::new(x + step * i as f64, 0.0, 0.0);
    way(Some(ahead(0)), [ahead(1), ahead(2), ahead(3)])
}

#[test]
fn the_one_that_moves_is_drawn_again_and_keeps_the_clearest_draw() {
    let mut crowd = Footprints {
        members: vec![member(10.0, 0.0), member(0.0, 5.0), member(-20.0, 1.0)],
    };
    assert_eq!(crowd.unclear(0), [1]);
    // Into the other sooner: no better than before. In the third half second: better.
    assert!(!crowd.improve(1, &straight(0.0, 6.0)));
    assert!(crowd.improve(1, &straight(0.0, 2.5)));
    assert_eq!(crowd.unclear(0), [1]);
    assert!(crowd.improve(1, &straight(0.0, 1.0)));
    assert!(crowd.unclear(0).is_empty());
}

#[test]
fn the_driven_stay_and_those_that_overlap_already_are_left_alone() {
    let driven = Member {
        is_driven: true,
        ..member(0.0, 5.0)
    };
    let crowd = Footprints {
        members: vec![member(10.0, 0.0), driven],
    };
    assert_eq!(crowd.unclear(0), [0]);
    let ignored = Member {
        is_driven: true,
        is_ignored: true,
        ..member(0.0, 5.0)
    };
    let mut unimpressed = Footprints {
        members: vec![member(10.0, 0.0), ignored],
    };
    assert!(unimpressed.unclear(0).is_empty());
    assert!(!unimpressed.improve(0, &straight(10.0, 5.0)));
    let yielding = Footprints {
        members: vec![member(0.0, 5.0), member(10.0, 0.0)],
    };
    // The first is settled, so the other must find another way.
    assert_eq!(
        (yielding.unclear(0), yielding.unclear(1)),
        (vec![0], vec![1])
    );
    let touching = Footprints {
        members: vec![member(3.0, 0.0), member(0.0, 1.0)],
    };
    assert!(touching.unclear(0).is_empty());
}

#[test]
fn people_on_foot_may_touch_each_other_and_no_vehicle() {
    let walker = |x: f64, step: f64| Member {
        walks: true,
        ..member(x, step)
    };
    let pair = Footprints {
        members: vec![walker(10.0, 0.0), walker(0.0, 5.0)],
    };
    assert!(pair.unclear(0).is_empty());
    let mixed = Footprints {
        members: vec![walker(10.0, 0.0), member(0.0, 5.0)],
    };
    assert_eq!(mixed.unclear(0), [1]);
}

/// A vehicle at a pose beside edges.
fn beside(x: f64, y: f64, heading: f64, edges: &[&[(f64, f64)]]) -> Member {
    let line = |points: &&[(f64, f64)]| {
        let points = points.iter().map(|&(x, y)| dvec2(x, y)).collect();
        Edge::of(&Polyline::new(points).expect("an edge"), Pose::default())
    };
    let mut member = Member {
        before: Some(Pose::new(x, y, heading)),
        edges: edges.iter().flat_map(line).collect(),
        ..member(x, 0.0)
    };
    let before = member.at(Pose::new(x, y, heading));
    member.off = metres_off(&before, member.reach, &member.edges);
    member
}

/// The way of a member straight ahead, so many metres every half second.
fn ahead(member: &Member, step: f64) -> Way {
    let before = member.before.expect("it was somewhere");
    let at = |i: f64| before * Pose::new(step * i, 0.0, 0.0);
    way(Some(before), [at(1.0), at(2.0), at(3.0)])
}

#[test]
fn who_would_leave_the_road_is_drawn_again() {
    // The road ends 10 m ahead: north along the edge is the road's left.
    let mut leaving = beside(0.0, 0.0, 0.0, &[&[(10.0, -20.0), (10.0, 20.0)]]);
    leaving.ahead = ahead(&leaving, 3.0);
    let mut crowd = Footprints {
        members: vec![leaving],
    };
    // The nose reaches the edge 8 m on, in the third half second.
    let first = crowd.members[0].places_on_road(&crowd.members[0].ahead);
    assert!((2 * PLACES..3 * PLACES).contains(&first), "{first}");
    assert_eq!(crowd.unclear(0), [0]);
    assert!(!crowd.improve(0, &straight(0.0, 5.0)));
    assert!(crowd.improve(0, &straight(0.0, 2.0)));
    assert!(crowd.unclear(0).is_empty());
}

#[test]
fn a_thin_median_is_not_jumped() {
    // Two edges a foot apart, the road on the outer side of each; 9 m every half second puts the
    // car before them, then behind them, and across them never.
    let median: [&[(f64, f64)]; 2] = [
        &[(10.0, -20.0), (10.0, 20.0)],
        &[(10.3, 20.0), (10.3, -20.0)],
    ];
    let car = beside(4.5, 0.0, 0.0, &median);
    let jumping = ahead(&car, 9.0);
    let across = |pose: &Pose| metres_across(&car.at(*pose), car.reach, &car.edges) > 0.0;
    let ends = jumping.iter().skip(PLACES - 1).step_by(PLACES);
    assert!(
        !ends.into_iter().any(across),
        "the poses themselves are clear"
    );
    assert!(car.places_on_road(&jumping) < PLACES);
    assert_eq!(car.places_on_road(&ahead(&car, 0.5)), 3 * PLACES);
}

#[test]
fn who_is_off_the_road_may_come_back_but_go_no_farther() {
    // The road is north of the edge; the car is south of it.
    let edge: [&[(f64, f64)]; 1] = [&[(-40.0, 0.0), (40.0, 0.0)]];
    let north = std::f64::consts::FRAC_PI_2;
    for y in [-6.0, -1.0, 0.5] {
        let back = beside(0.0, y, north, &edge);
        assert!(back.off > 1.0, "{}", back.off);
        assert_eq!(back.places_on_road(&ahead(&back, 3.0)), 3 * PLACES, "{y}");
        let away = beside(0.0, y, -north, &edge);
        assert!(away.places_on_road(&ahead(&away, 3.0)) < PLACES, "{y}");
        // Along the edge it is no farther off.
        let along = beside(0.0, y, 0.0, &edge);
        assert_eq!(along.places_on_road(&ahead(&along, 3.0)), 3 * PLACES);
    }
    // Back on the road it does not leave it again.
    let back = beside(0.0, -6.0, north, &edge);
    let at = |y: f64, heading: f64| Pose::new(0.0, y, heading);
    let returns = way(
        back.before,
        [at(0.0, north), at(6.0, north), at(0.0, north)],
    );
    assert!(back.places_on_road(&returns) > 2 * PLACES);
    assert!(back.places_on_road(&returns) < 3 * PLACES);
}

#[test]
fn crossing_cars_meet_between_the_poses() {
    let east = Member {
        ahead: way(
            Some(Pose::new(-8.0, 0.0, 0.0)),
            [Pose::new(8.0, 0.0, 0.0); POSES],
        ),
        before: Some(Pose::new(-8.0, 0.0, 0.0)),
        ..member(0.0, 0.0)
    };
    let north = std::f64::consts::FRAC_PI_2;
    let north = Member {
        ahead: way(
            Some(Pose::new(0.0, -8.0, north)),
            [Pose::new(0.0, 8.0, north); POSES],
        ),
        before: Some(Pose::new(0.0, -8.0, north)),
        ..member(0.0, 0.0)
    };
    assert!(clear_places(&east, &east.ahead, &north) < PLACES);
}

#[cfg(feature = "tensors")]
#[test]
fn braking_stays_on_the_way_and_stops() {
    use gump_geometry::DVec2;
    use gump_model::decoder::Bins;
    use gump_scene::AgentState;
    use gump_tokenizer::QuantizedState;

    use crate::request::Request;

    let request = Request {
        local_frame: gump_model::local_frame::LocalFrame::at(Pose::new(0.0, 0.0, 0.0)),
        forced: [None; gump_model::decoder::STEPS.len()],
        stream: gump_scene::Seed(0),
        near: None,
        ring: crate::temporal_ensemble::ChunkBuffer::default(),
        limits: None,
        frame: 0,
        guide: None,
    };
    let arc = |i: usize| {
        let turn = 0.1 * (i + 1) as f64;
        let pose = Pose::new(40.0 * turn.sin(), 40.0 * (1.0 - turn.cos()), turn);
        Some(AgentState {
            pose,
            velocity: pose.direction() * 8.0,
        })
    };
    let bins = request
        .local_frame
        .bins(QuantizedState::default(), std::array::from_fn(arc));
    let bins: Bins = bins.map(|bin| bin.expect("all are within the grid"));
    let moving = Member {
        speed: 8.0,
        ..member(0.0, 4.0)
    };
    let braking = moving.brake(&request, &bins).expect("it moves");
    let poses = request.local_frame.poses(&braking);
    // 8 m/s and 5 m/s^2: 3.4 m after half a second, 6.4 m after 1.6 s for good.
    for (pose, s) in poses.iter().zip([3.375_f64, 5.5, 6.375, 6.4]) {
        let on_arc = DVec2::new(40.0 * (s / 40.0).sin(), 40.0 * (1.0 - (s / 40.0).cos()));
        assert!(pose.position.distance(on_arc) < 0.15, "{pose:?} {on_arc}");
    }
    let stands = Member {
        speed: 0.0,
        ..member(0.0, 0.0)
    };
    assert!(stands.brake(&request, &bins).is_none());
}
