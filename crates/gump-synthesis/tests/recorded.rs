//! Properties of scenes like recorded ones, checked on fifty of them.

use std::sync::OnceLock;

use gump_geometry::{Pose, angle_difference};
use gump_metrics::statistics::{Statistic as M, Statistics};
use gump_scene::{Agent, AgentKind, AreaKind, LaneKind, Scenario, Seed};
use gump_synthesis::{Profile, RoadFamily, SynthesisConfig, Tracker, track};
use rayon::prelude::*;

const N: u64 = 50;
const PROFILE: Profile = Profile::RecordedLike;

/// Scenes as they are, without a tracker.
fn clean() -> &'static [Scenario] {
    static SCENES: OnceLock<Vec<Scenario>> = OnceLock::new();
    SCENES.get_or_init(|| {
        let scene = |k| PROFILE.synthesize_clean(&PROFILE.config(), Seed(77).fork(k));
        (0..N).into_par_iter().map(scene).collect()
    })
}

/// The same scenes as the tracker sees them.
fn seen() -> Vec<Scenario> {
    let scene = |k| PROFILE.synthesize(&PROFILE.config(), Seed(77).fork(k));
    (0..N).into_par_iter().map(scene).collect()
}

fn is_parked(scene: &Scenario, agent: &Agent) -> bool {
    let stays = |frame: &gump_scene::Frame| {
        let there = frame.agent(agent.id);
        there.is_none_or(|a| a.state.pose.position.distance(agent.state.pose.position) < 0.5)
    };
    agent.kind == AgentKind::Vehicle && scene.log.iter().all(stays)
}

#[test]
fn every_scene_is_a_valid_scenario() {
    for (clean, seen) in clean().iter().zip(seen()) {
        for scene in [clean, &seen] {
            scene.validate().unwrap();
            assert_eq!((scene.log.len(), scene.now), (91, 10));
            assert!(
                scene
                    .log
                    .iter()
                    .all(|frame| frame.agent(scene.ego).is_some())
            );
            assert!(scene.targets.contains(&scene.ego), "{}", scene.id);
            let present = scene.present();
            let is_there = |id: &&gump_scene::AgentId| present.now().agent(**id).is_some();
            assert_eq!(
                scene.targets.iter().filter(is_there).count(),
                scene.targets.len()
            );
            let route = scene.route.as_ref().unwrap();
            assert!(
                route
                    .lanes
                    .iter()
                    .all(|lane| scene.map.lane(*lane).is_some())
            );
        }
        assert_eq!(clean.id, seen.id);
        for scene in [clean, &seen] {
            assert_eq!(scene.tags, gump_metrics::tags::extract_tags(scene));
        }
        assert!(clean.id.starts_with("like-"));
    }
}

#[test]
fn only_people_who_walk_together_overlap() {
    let mut together = 0;
    for scene in clean() {
        for (i, frame) in scene.log.iter().enumerate().step_by(5) {
            let agents = frame.agents();
            for (k, a) in agents.iter().enumerate() {
                for b in &agents[k + 1..] {
                    let reach = a.length + b.length;
                    let near = a.state.pose.position.distance(b.state.pose.position) < reach;
                    if !near || !a.oriented_box().overlaps(&b.oriented_box()) {
                        continue;
                    }
                    let pair = [a, b].map(|agent| agent.kind);
                    assert_eq!(
                        pair,
                        [AgentKind::Pedestrian; 2],
                        "{}: {} and {} in frame {i}",
                        scene.id,
                        a.id,
                        b.id
                    );
                    // Nobody walks through somebody else: they are beside each other all the time.
                    for frame in &scene.log {
                        if let (Some(a), Some(b)) = (frame.agent(a.id), frame.agent(b.id)) {
                            let apart = a.state.pose.position.distance(b.state.pose.position);
                            assert!(
                                apart < 4.0,
                                "{}: {} and {} in frame {i}",
                                scene.id,
                                a.id,
                                b.id
                            );
                        }
                    }
                    together += 1;
                }
            }
        }
    }
    assert!(together > 20, "{together}");
}

#[test]
fn vehicles_park_beside_the_lanes_not_in_them() {
    let (mut parked, mut in_lane) = (0, vec![]);
    for scene in clean() {
        let lanes = || scene.map.lanes().iter();
        for agent in scene.log[0].agents().iter().filter(|a| is_parked(scene, a)) {
            let position = agent.state.pose.position;
            let distance = |lane: &gump_scene::Lane| lane.centerline.project(position).distance;
            let nearest = lanes().map(distance).fold(f64::INFINITY, f64::min);
            parked += 1;
            if nearest < 2.0 {
                in_lane.push((scene.id.as_str(), agent.id));
            }
        }
    }
    // Those that stand in a queue for all nine seconds, and the few that stopped to load.
    assert!(
        parked > 1000 && in_lane.len() * 5 < parked,
        "{} of {parked}",
        in_lane.len()
    );
}

/// Recorded scenes have 2.2 of them, and 0.7 passes in nine seconds.
#[test]
fn vehicles_pass_those_that_are_parked_partly_in_the_lane() {
    let (mut narrow, mut passes, mut clearance) = (0, 0, 0.0);
    for scene in clean() {
        for parked in scene.log[0].agents().iter().filter(|a| is_parked(scene, a)) {
            let place = parked.state.pose;
            let lanes = scene.map.lanes().iter();
            let lanes = lanes.filter(|lane| lane.kind == LaneKind::SurfaceStreet);
            let mut ahead = lanes.filter_map(|lane| {
                let foot = lane.centerline.project(place.position);
                let there = lane.centerline.pose_at(foot.arc_length);
                let local = there.inverse() * place;
                let beside = local.position.x.abs() < 0.5 && local.heading.cos() > 0.9;
                let gap = -local.position.y - parked.width / 2.0;
                (beside && (0.2..1.5).contains(&gap)).then_some((there, gap))
            });
            let Some((lane, gap)) = ahead.next() else {
                continue;
            };
            narrow += 1;
            let moving = scene.log[0]
                .agents()
                .iter()
                .filter(|a| !is_parked(scene, a));
            for other in moving.filter(|a| a.kind == AgentKind::Vehicle) {
                let places = scene.log.iter().filter_map(|frame| frame.agent(other.id));
                let local = places.map(|a| lane.inverse() * a.state.pose);
                let abeam = local.filter(|p| p.position.x.abs() < 1.0 && p.heading.cos() > 0.9);
                let nearest = abeam.map(|p| p.position.y - other.width / 2.0 + gap);
                let nearest = nearest.filter(|gap| *gap < 3.0).reduce(f64::min);
                if let Some(nearest) = nearest.filter(|gap| *gap > -0.5) {
                    (passes, clearance) = (passes + 1, clearance + nearest);
                }
            }
        }
    }
    // The tracker sees a quarter of these.
    assert!(
        (200..1500).contains(&narrow),
        "{narrow} are partly in a lane"
    );
    let mean = clearance / f64::from(passes);
    assert!(passes >= 50, "{passes} passes, {mean} m");
    assert!((0.6..1.6).contains(&mean), "{mean} m between the sides");
}

/// The nearest point of a lane within reach whose direction suits, and the pose relative to it.
fn on_lane(scene: &Scenario, pose: Pose, suits: impl Fn(Pose) -> bool) -> Option<Pose> {
    let lanes = scene.map.lanes().iter();
    let places = lanes.filter_map(|lane| {
        let foot = lane.centerline.project(pose.position);
        let local = lane.centerline.pose_at(foot.arc_length).inverse() * pose;
        suits(local).then_some((foot.distance, local))
    });
    let nearest = places.min_by(|a, b| a.0.total_cmp(&b.0));
    nearest.map(|(_, local)| local)
}

/// 32 % of the recorded ones do.
#[test]
fn many_that_are_parked_off_the_lanes_stand_aslant() {
    let (mut all, mut aslant) = (0, 0);
    for scene in seen() {
        for agent in scene.log[0]
            .agents()
            .iter()
            .filter(|a| is_parked(&scene, a))
        {
            let Some(local) = on_lane(&scene, agent.state.pose, |_| true) else {
                continue;
            };
            if local.position.y.abs() > 1.5 {
                all += 1;
                aslant += usize::from((0.2..0.97).contains(&local.heading.cos().abs()));
            }
        }
    }
    let share = aslant as f64 / f64::from(all);
    assert!((0.1..0.45).contains(&share), "{aslant} of {all}");
}

/// Recorded ones are 0.7 m inside (median).
#[test]
fn vehicles_turn_inside_of_the_centre_line() {
    let mut inside = Vec::new();
    for scene in clean() {
        for agent in scene.log[scene.now].agents() {
            let later = scene.log[scene.now + 5].agent(agent.id);
            let Some(later) = later.filter(|_| agent.kind == AgentKind::Vehicle) else {
                continue;
            };
            let turned = angle_difference(later.state.pose.heading, agent.state.pose.heading);
            let ahead = |local: Pose| local.heading.cos() > 0.7;
            let local = on_lane(scene, later.state.pose, ahead);
            if let Some(local) = local.filter(|local| local.position.y.abs() < 2.5)
                && turned.abs() > 0.08
                && later.state.speed() > 1.0
            {
                inside.push(local.position.y * turned.signum());
            }
        }
    }
    let n = inside.len();
    let mean = inside.iter().sum::<f64>() / n as f64;
    assert!(n > 30, "{n} turn");
    assert!((0.15..0.9).contains(&mean), "{mean} m");
}

#[test]
fn shares_are_those_of_recordings() {
    let mut statistics = Statistics::default();
    seen().iter().for_each(|scene| statistics.add(scene));
    let check = |measure: M, class, range: std::ops::Range<f64>| {
        let mean = statistics.get(measure, class).unwrap().mean();
        assert!(
            range.contains(&mean),
            "{}: {mean}, expected {range:?}",
            measure.name()
        );
    };
    let [vehicle, person] = [AgentKind::Vehicle, AgentKind::Pedestrian].map(Some);
    // Around the means of `configs/targets/waymo-like.toml`, as far as fifty scenes may vary.
    check(M::Standing, vehicle, 0.62..0.87);
    check(M::Parked, vehicle, 0.6..0.87);
    check(M::ParkedOffLane, vehicle, 0.75..0.97);
    check(M::Speed, vehicle, 5.5..12.5);
    check(M::YawRate, vehicle, 0.03..0.09);
    check(M::Length, vehicle, 4.6..4.9);
    check(M::Agents, vehicle, 18.0..45.0);
    check(M::Presence, vehicle, 0.4..0.75);
    check(M::OnCrosswalk, person, 0.04..0.35);
    check(M::Standing, person, 0.08..0.38);
    check(M::EgoStands, None, 0.06..0.45);
}

#[test]
fn threads_change_nothing() {
    let make = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let scene = |k| PROFILE.synthesize(&PROFILE.config(), Seed(5).fork(k));
        pool.install(|| (0..8).into_par_iter().map(scene).collect::<Vec<_>>())
    };
    for (one, three) in make(1).iter().zip(&make(3)) {
        assert_eq!((&one.id, &one.log), (&three.id, &three.log));
        assert_eq!(one.map.lanes(), three.map.lanes());
    }
}

#[test]
fn what_is_seen_is_what_the_tracker_makes_of_the_clean_scene() {
    for (k, clean) in clean().iter().enumerate().take(5) {
        let seed = Seed(77).fork(k as u64);
        let mut tracked = clean.clone();
        track(&mut tracked, &Tracker::recorded_like(), seed.fork(u64::MAX));
        let seen = PROFILE.synthesize(&PROFILE.config(), seed);
        assert_eq!(tracked.log, seen.log);
    }
}

#[test]
fn some_vehicles_leave_the_road_across_its_edge() {
    // As they turn into yards and car parks whose mouths recorded maps do not open.
    let crosses = |scene: &Scenario, id: gump_scene::AgentId| {
        let edges: Vec<_> = scene
            .map
            .road_edges()
            .iter()
            .map(|edge| &edge.line)
            .collect();
        let places = scene.log.iter().filter_map(|frame| frame.agent(id));
        let places: Vec<_> = places.map(|agent| agent.state.pose.position).collect();
        places.windows(2).any(|step| {
            edges.iter().any(|line| {
                line.points().windows(2).any(|edge| {
                    let side = |p: gump_geometry::DVec2, line: &[gump_geometry::DVec2]| {
                        (line[1] - line[0]).perp_dot(p - line[0]) > 0.0
                    };
                    side(step[0], edge) != side(step[1], edge)
                        && side(edge[0], step) != side(edge[1], step)
                })
            })
        })
    };
    let (mut moving, mut crossing) = (0, 0);
    for scene in clean() {
        let now = &scene.log[scene.now];
        for agent in now.agents() {
            let drives = agent.kind == AgentKind::Vehicle && agent.state.speed() > 2.0;
            if drives {
                moving += 1;
                crossing += usize::from(crosses(scene, agent.id));
            }
        }
    }
    let share = crossing as f64 / f64::from(moving);
    assert!((0.005..0.1).contains(&share), "{crossing} of {moving}");
}

#[test]
fn some_vehicles_slow_down_for_bumps() {
    let mut with_bumps = 0;
    let (mut over, mut crossings) = (0.0, 0.0);
    for scene in clean() {
        let areas = scene.map.areas().iter();
        let bumps: Vec<_> = areas
            .filter(|area| area.kind == AreaKind::SpeedBump)
            .collect();
        with_bumps += usize::from(!bumps.is_empty());
        for agent in scene.log[0].agents() {
            let of_frames = scene.log.iter().filter_map(|frame| frame.agent(agent.id));
            let states: Vec<_> = of_frames.map(|agent| agent.state).collect();
            let fastest = states.iter().map(|s| s.speed()).fold(0.0, f64::max);
            let on_bump = |position| bumps.iter().any(|bump| bump.polygon.contains(position));
            let slowest = states.iter().filter(|s| on_bump(s.pose.position));
            let slowest = slowest.map(|s| s.speed()).fold(f64::INFINITY, f64::min);
            if agent.kind == AgentKind::Vehicle && fastest > 5.0 && slowest > 0.5 && slowest < 1e3 {
                over += slowest / fastest;
                crossings += 1.0;
            }
        }
    }
    // Four of five recorded scenes have them.
    assert!((30..=48).contains(&with_bumps), "{with_bumps} scenes");
    let ratio = over / crossings;
    assert!(crossings > 20.0 && (0.6..0.97).contains(&ratio), "{ratio}");
}

#[test]
fn half_of_the_drivers_roll_over_stop_lines() {
    let config = SynthesisConfig {
        family: Some(RoadFamily::StopCrossing),
        ..PROFILE.config()
    };
    let scene = |k| PROFILE.synthesize_clean(&config, Seed(78).fork(k));
    let scenes: Vec<Scenario> = (0..360).into_par_iter().map(scene).collect();
    let (mut passes, mut stops) = (0, 0);
    for scene in &scenes {
        let lanes = scene.map.stop_signs().iter().flat_map(|sign| &sign.lanes);
        let lines = lanes.filter_map(|lane| scene.map.lane(*lane));
        let lines: Vec<_> = lines.map(|lane| lane.centerline.pose_at(0.0)).collect();
        for agent in scene.log[0].agents() {
            let of_frames = scene.log.iter().filter_map(|frame| frame.agent(agent.id));
            let states: Vec<_> = of_frames.map(|agent| agent.state).collect();
            // Metres of the centre from the line, where the vehicle drives towards it.
            let before = |state: &gump_scene::AgentState| {
                let ahead = |line: &Pose| {
                    let local = line.inverse() * state.pose.position;
                    let turn = angle_difference(state.pose.heading, line.heading);
                    let near = local.y.abs() < 2.0 && turn.abs() < 0.8;
                    (near && local.x > -12.0 && local.x < 4.0).then_some(local.x)
                };
                lines.iter().find_map(ahead)
            };
            let near: Vec<_> = states
                .iter()
                .filter_map(|s| Some((before(s)?, s)))
                .collect();
            let comes = near.iter().any(|(x, _)| *x < -8.0);
            let goes = near.iter().any(|(x, _)| *x > 3.0);
            if agent.kind == AgentKind::Vehicle && comes && goes {
                passes += 1;
                stops += usize::from(near.iter().any(|(_, s)| s.speed() < 0.5));
            }
        }
    }
    let share = stops as f64 / f64::from(passes);
    assert!(
        passes > 90 && (0.2..0.8).contains(&share),
        "{stops} of {passes}"
    );
}

#[test]
fn curbs_of_car_parks_stay_beside_the_lanes_of_wide_roads() {
    let config = SynthesisConfig {
        family: Some(RoadFamily::Arterial),
        ..PROFILE.config()
    };
    let scenes = (0..12).into_par_iter();
    scenes.for_each(|k| {
        let scene = PROFILE.synthesize_clean(&config, Seed(78).fork(k));
        for lane in scene.map.lanes() {
            let way = &lane.centerline;
            let turn =
                angle_difference(way.pose_at(way.length()).heading, way.pose_at(0.0).heading);
            // Those that turn may lead across a closed mouth.
            let is_fast = lane.speed_limit.is_some_and(|limit| limit > 10.0);
            if turn.abs() > 0.5 || !is_fast || lane.kind != LaneKind::SurfaceStreet {
                continue;
            }
            for point in way.points() {
                let edge = scene.map.nearest_road_edges(*point).next();
                let distance = edge.map_or(10.0, |edge| edge.2);
                assert!(
                    distance > 0.5,
                    "{}: {:?} at {point}: {distance}",
                    scene.id,
                    lane.id
                );
            }
        }
    });
}
