//! Properties of every procedural scene, checked on two hundred of them.

use std::collections::BTreeSet;
use std::sync::OnceLock;

use gump_geometry::{DVec2, angle_difference};
use gump_scene::{Agent, AgentKind, LightState, Scenario, Seed};
use gump_synthesis::{RoadFamily, SynthesisConfig, synthesize_many};

const N: usize = 200;

fn scenes() -> &'static [Scenario] {
    static SCENES: OnceLock<Vec<Scenario>> = OnceLock::new();
    SCENES.get_or_init(|| synthesize_many(&SynthesisConfig::standard(), Seed(2024), N))
}

/// Calls `visit` with every agent that is in three frames in a row: before, now, after.
fn each_step(visit: &mut dyn FnMut(&Scenario, [&Agent; 3])) {
    for scene in scenes() {
        for frames in scene.log.windows(3) {
            for now in frames[1].agents() {
                if let (Some(before), Some(after)) =
                    (frames[0].agent(now.id), frames[2].agent(now.id))
                {
                    visit(scene, [before, now, after]);
                }
            }
        }
    }
}

fn quantile(values: &mut [f64], q: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * q) as usize]
}

#[test]
fn every_scene_is_a_valid_scenario() {
    for scene in scenes() {
        scene.validate().unwrap();
        assert_eq!((scene.log.len(), scene.now), (91, 10));
        assert!(
            scene
                .log
                .iter()
                .all(|frame| frame.agent(scene.ego).is_some())
        );
        assert!((1..=8).contains(&scene.targets.len()) && scene.targets.contains(&scene.ego));
        let route = scene.route.as_ref().unwrap();
        let now = scene.present().ego_now().state.pose.position;
        // A lane change may be under way, so a lane's width.
        assert!(route.path.project(now).distance < 3.8, "{}", scene.id);
        for pair in route.lanes.windows(2) {
            let lane = scene.map.lane(pair[0]).unwrap();
            let beside = [&lane.left_neighbors, &lane.right_neighbors];
            assert!(
                lane.successors.contains(&pair[1]) || beside.iter().any(|n| n.contains(&pair[1]))
            );
        }
    }
}

#[test]
fn boxes_never_overlap() {
    for scene in scenes() {
        for (i, frame) in scene.log.iter().enumerate() {
            for (k, a) in frame.agents().iter().enumerate() {
                for b in &frame.agents()[k + 1..] {
                    let apart = !a.oriented_box().overlaps(&b.oriented_box());
                    assert!(apart, "{}: {} and {} in frame {i}", scene.id, a.id, b.id);
                }
            }
        }
    }
}

#[test]
fn moving_vehicles_stay_on_the_road() {
    let (mut on, mut all) = (0, 0);
    each_step(&mut |scene, [_, agent, _]| {
        if agent.kind == AgentKind::Vehicle && agent.state.speed() > 0.5 {
            all += 1;
            on += usize::from(scene.map.is_drivable(agent.state.pose.position));
        }
    });
    assert!(on as f64 >= 0.99 * all as f64, "{on} of {all}");
}

#[test]
fn nobody_drives_over_a_red_line() {
    let (mut crossed, mut lights) = (vec![], 0);
    for scene in scenes() {
        for pair in scene.log.windows(2) {
            for light in pair[1].lights() {
                let was = pair[0].light(light.lane).map(|light| light.state);
                lights += 1;
                if light.state != LightState::Red || was != Some(LightState::Red) {
                    continue;
                }
                let lane = scene.map.lane(light.lane).unwrap();
                let line = lane.centerline.pose_at(0.0);
                for agent in pair[1]
                    .agents()
                    .iter()
                    .filter(|a| a.kind == AgentKind::Vehicle)
                {
                    let Some(before) = pair[0].agent(agent.id) else {
                        continue;
                    };
                    let front = |a: &Agent| {
                        let front = a.state.pose * DVec2::new(a.length / 2.0, 0.0);
                        line.inverse() * front
                    };
                    let (from, to) = (front(before), front(agent));
                    let along =
                        angle_difference(agent.state.pose.heading, line.heading).abs() < 0.5;
                    if from.x < 0.0 && to.x >= 0.0 && to.y.abs() < 1.2 && along {
                        crossed.push((scene.id.as_str(), agent.id, light.lane));
                    }
                }
            }
        }
    }
    assert!(lights > 1000);
    assert!(crossed.is_empty(), "{crossed:?}");
}

#[test]
fn velocities_are_what_positions_say() {
    let mut worst: f64 = 0.0;
    each_step(&mut |scene, [before, now, after]| {
        let moved = (after.state.pose.position - before.state.pose.position) / (2.0 * scene.dt);
        worst = worst.max(moved.distance(now.state.velocity));
        let step = (after.state.pose.position - now.state.pose.position) / scene.dt;
        worst = worst.max(step.distance(now.state.velocity) - 0.5);
    });
    assert!(worst <= 0.3, "{worst} m/s");
}

/// From the centre of a vehicle to its rear axle, as a share of its length.
const REAR_AXLE: f64 = 0.23;

#[test]
fn motion_is_smooth() {
    let (mut accelerations, mut yaw_rates, mut slips) = (vec![], vec![], vec![]);
    each_step(&mut |scene, [before, now, after]| {
        if now.kind == AgentKind::Pedestrian {
            return;
        }
        let gain = after.state.speed() - before.state.speed();
        accelerations.push(gain / (2.0 * scene.dt));
        if now.state.speed() > 0.5 {
            let turn = angle_difference(after.state.pose.heading, before.state.pose.heading);
            yaw_rates.push((turn / (2.0 * scene.dt)).abs());
            // The rear axle does not slip, and the centre does in a turn.
            let axle = match now.kind {
                AgentKind::Vehicle => DVec2::new(-REAR_AXLE * now.length, 0.0),
                _ => DVec2::ZERO,
            };
            let course = after.state.pose * axle - before.state.pose * axle;
            slips.push(angle_difference(course.to_angle(), now.state.pose.heading).abs());
        }
    });
    let (low, high) = (
        quantile(&mut accelerations, 0.0),
        quantile(&mut accelerations, 1.0),
    );
    assert!(
        -8.0 <= low && high <= 4.0,
        "accelerations from {low} to {high}"
    );
    let yaw_rate = quantile(&mut yaw_rates, 0.99);
    assert!(
        (0.2..0.8).contains(&yaw_rate),
        "99 % of yaw rates up to {yaw_rate}"
    );
    let slip = quantile(&mut slips, 0.999);
    assert!(
        slip < 0.05,
        "courses of rear axles differ from headings by {slip}"
    );
}

#[test]
fn statistics_resemble_real_traffic() {
    let (mut stationary, mut all, mut speeds) = (0_usize, 0_usize, vec![]);
    each_step(&mut |_, [_, agent, _]| {
        if agent.kind == AgentKind::Vehicle {
            assert!((3.8..=12.0).contains(&agent.length));
            all += 1;
            stationary += usize::from(agent.state.speed() < 0.5);
            speeds.push(agent.state.speed());
        }
    });
    let share = stationary as f64 / all as f64;
    assert!((0.35..0.75).contains(&share), "{share} stationary");
    let fast = quantile(&mut speeds, 0.99);
    assert!((12.0..25.0).contains(&fast), "99 % of speeds up to {fast}");
    let mut counts: Vec<f64> = scenes()
        .iter()
        .map(|scene| scene.present().now().agents().len() as f64)
        .collect();
    assert!(quantile(&mut counts, 0.1) >= 6.0 && quantile(&mut counts, 0.9) <= 70.0);
    let of_kind = |kind| {
        let has = |scene: &&Scenario| {
            scene
                .present()
                .now()
                .agents()
                .iter()
                .any(|a| a.kind == kind)
        };
        scenes().iter().filter(has).count()
    };
    assert!(of_kind(AgentKind::Pedestrian) > N / 3 && of_kind(AgentKind::Bicycle) > N / 3);
}

#[test]
fn a_hundred_scenes_show_every_family() {
    let seen: BTreeSet<&str> = scenes()[..100]
        .iter()
        .filter_map(|scene| scene.id.rsplit_once('-').map(|(family, _)| family))
        .collect();
    let all: BTreeSet<&str> = RoadFamily::ALL.iter().map(|family| family.name()).collect();
    assert_eq!(seen, all);
}

#[test]
fn threads_change_nothing() {
    let make = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| synthesize_many(&SynthesisConfig::standard(), Seed(5), 12))
    };
    for (one, three) in make(1).iter().zip(&make(3)) {
        assert_eq!(one.id, three.id);
        assert_eq!(one.log, three.log);
        assert_eq!(one.route, three.route);
        assert_eq!(one.map.lanes(), three.map.lanes());
    }
}

#[test]
fn unusual_requests_are_met() {
    let standard = SynthesisConfig::standard();
    for family in RoadFamily::ALL {
        for (density, dt, extent_m) in [(0.1, 0.1, 120.0), (3.0, 0.1, 90.0), (1.0, 0.2, 160.0)] {
            let config = SynthesisConfig {
                density,
                dt,
                extent_m,
                history_s: 2.0,
                family: Some(family),
                ..standard.clone()
            };
            for scene in synthesize_many(&config, Seed(3), 3) {
                scene.validate().unwrap();
                assert_eq!(scene.now, (2.0 / dt).round() as usize);
                assert!(scene.id.starts_with(family.name()));
            }
        }
    }
}
