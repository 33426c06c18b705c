//! Scenario tags: which of nuPlan's 73 scenario types, the prompt vocabulary, apply to a scenario.
//!
//! Start with [`extract_tags`]. [`rules`] lists every tag with its definition. A tag is about the ego at
//! the present; the log before and after it is used, because "starting a left turn" is only known
//! from the turn that follows. Tags of pick-up zones cannot be decided, because maps do not contain
//! such zones.
//!
//! Where nuPlan's published descriptions of its fourteen challenge types give numbers (speeds,
//! distances, counts), those are used; the other tags are defined similarly with numbers of our
//! own.

mod maneuver;
mod situation;

use gump_geometry::angle_difference;
use gump_scene::{AgentId, AgentKind, AreaKind, Scenario, ScenarioTag};

use situation::{Other, Situation, View, footprint, touches};

/// A tag, its meaning, and its rule.
#[derive(Clone, Copy)]
pub struct Rule {
    name: &'static str,
    meaning: &'static str,
    decide: Option<fn(&Situation<'_>) -> bool>,
}

impl Rule {
    /// The tag.
    pub fn tag(&self) -> ScenarioTag {
        self.name.parse().expect("the table has names of tags only")
    }

    /// The definition in a few words, with its numbers.
    pub fn meaning(&self) -> &'static str {
        self.meaning
    }

    /// False for a tag that cannot be decided from states and maps.
    pub fn is_decidable(&self) -> bool {
        self.decide.is_some()
    }
}

/// All tags in the order of the vocabulary.
pub fn rules() -> &'static [Rule] {
    &RULES
}

/// The tags that hold at the present of a scenario, sorted.
pub fn extract_tags(scenario: &Scenario) -> Vec<ScenarioTag> {
    of_view(View::of(scenario))
}

/// The tags that hold at frame `now` of a scenario with `agent` as the ego, whose route is not known;
/// sorted. The agent must be in that frame.
pub fn around(scenario: &Scenario, agent: AgentId, now: usize) -> Vec<ScenarioTag> {
    of_view(View::around(scenario, agent, now))
}

fn of_view(view: View<'_>) -> Vec<ScenarioTag> {
    let situation = Situation::of(view);
    let holds = |rule: &&Rule| rule.decide.is_some_and(|decide| decide(&situation));
    RULES.iter().filter(holds).map(Rule::tag).collect()
}

/// Whether one tag holds; `None` if that cannot be decided.
pub fn holds(tag: ScenarioTag, scenario: &Scenario) -> Option<bool> {
    let decide = RULES[tag.index()].decide?;
    Some(decide(&Situation::of(View::of(scenario))))
}

const fn rule(
    name: &'static str,
    meaning: &'static str,
    decide: fn(&Situation<'_>) -> bool,
) -> Rule {
    Rule {
        name,
        meaning,
        decide: Some(decide),
    }
}

const fn unknowable(name: &'static str) -> Rule {
    Rule {
        name,
        meaning: "maps state no pick-up zones",
        decide: None,
    }
}

/// "Starting": below 3 m/s, accelerating by more than 0.6 m/s². "Stopping": braking by more than
/// 0.6 m/s² and below 0.3 m/s within 3 s. "Stationary": below 0.1 m/s. "Lead": the nearest vehicle
/// in the ego's path, within 30 m. "Close lead": within 6 m.
const RULES: [Rule; 73] = [
    rule(
        "accelerating_at_crosswalk",
        "starting with a crosswalk within 5 m",
        |s| s.is_starting() && s.is_crosswalk_within(5.0),
    ),
    rule(
        "accelerating_at_stop_sign",
        "starting at a stop sign",
        |s| s.is_starting() && s.is_lane_ruled_by_stop(6.0),
    ),
    rule(
        "accelerating_at_stop_sign_no_crosswalk",
        "starting at a stop sign without a crosswalk within 8 m",
        |s| s.is_starting() && s.is_lane_ruled_by_stop(6.0) && !s.is_crosswalk_within(8.0),
    ),
    rule(
        "accelerating_at_traffic_light",
        "starting within 15 m of a light",
        |s| s.is_starting() && s.is_light_within(15.0),
    ),
    rule(
        "accelerating_at_traffic_light_with_lead",
        "starting within 15 m of a light behind a vehicle",
        |s| s.is_starting() && s.is_light_within(15.0) && s.lead().is_some(),
    ),
    rule(
        "accelerating_at_traffic_light_without_lead",
        "starting within 15 m of a light as the first",
        |s| s.is_starting() && s.is_light_within(15.0) && s.lead().is_none(),
    ),
    rule(
        "behind_bike",
        "a bicycle less than 10 m ahead in the way",
        |s| {
            s.in_the_way(AgentKind::Bicycle)
                .is_some_and(|bike| bike.gap < 10.0)
        },
    ),
    rule(
        "behind_long_vehicle",
        "a vehicle longer than 8 m is 3 to 10 m ahead, less than 0.5 m to the side",
        |s| {
            s.lead().is_some_and(|lead| {
                let near = (3.0..10.0).contains(&lead.gap) && lead.place.y.abs() < 0.5;
                near && lead.agent.length > 8.0
            })
        },
    ),
    rule(
        "behind_pedestrian_on_driveable",
        "a person walks ahead in the way, less than 10 m away, on the road",
        |s| {
            s.in_the_way(AgentKind::Pedestrian).is_some_and(|person| {
                let place = person.agent.state.pose.position;
                person.gap < 10.0 && s.scenario.map.is_drivable(place)
            })
        },
    ),
    unknowable("behind_pedestrian_on_pickup_dropoff"),
    rule(
        "changing_lane",
        "begins to change to a neighbouring lane",
        |s| s.lane_change.is_some(),
    ),
    rule(
        "changing_lane_to_left",
        "begins to change to the left",
        |s| s.lane_change.is_some_and(|side| side > 0.0),
    ),
    rule(
        "changing_lane_to_right",
        "begins to change to the right",
        |s| s.lane_change.is_some_and(|side| side < 0.0),
    ),
    rule(
        "changing_lane_with_lead",
        "begins to change lanes behind a vehicle",
        |s| s.lane_change.is_some() && s.lead().is_some(),
    ),
    rule(
        "changing_lane_with_trail",
        "begins to change lanes with a vehicle less than 20 m behind in the new lane",
        |s| {
            s.lane_change.is_some_and(|side| {
                s.of_kind(AgentKind::Vehicle).any(|other| {
                    let beside = other.place.y * side.signum();
                    (1.5..5.5).contains(&beside) && (-20.0..0.0).contains(&other.place.x)
                })
            })
        },
    ),
    rule(
        "crossed_by_bike",
        "a bicycle crosses less than 20 m ahead within 3 s",
        |s| s.of_kind(AgentKind::Bicycle).any(|other| crosses(s, other)),
    ),
    rule(
        "crossed_by_vehicle",
        "a vehicle crosses less than 20 m ahead within 3 s",
        |s| s.of_kind(AgentKind::Vehicle).any(|other| crosses(s, other)),
    ),
    rule(
        "following_lane_with_lead",
        "faster than 3.5 m/s in a lane behind a lead faster than 3.5 m/s, less than 7.5 m ahead",
        |s| {
            let near = |lead: &Other<'_>| lead.gap < 7.5 && lead.agent.state.speed() > 3.5;
            follows_lane(s) && s.lead().is_some_and(near)
        },
    ),
    rule(
        "following_lane_with_slow_lead",
        "moving in a lane behind a lead of 0.5 to 3.5 m/s, less than 10 m ahead",
        |s| {
            let slow = |lead: &Other<'_>| {
                lead.gap < 10.0 && (0.5..3.5).contains(&lead.agent.state.speed())
            };
            s.speed > 0.5
                && s.lane.is_some()
                && s.lane_change.is_none()
                && s.lead().is_some_and(slow)
        },
    ),
    rule(
        "following_lane_without_lead",
        "faster than 3.5 m/s in a lane without a lead",
        |s| follows_lane(s) && s.lead().is_none(),
    ),
    rule(
        "high_lateral_acceleration",
        "1.5 to 3 m/s² across the heading, not on an intersection",
        |s| (1.5..3.0).contains(&s.lateral_acceleration.abs()) && !s.on_intersection,
    ),
    rule("high_magnitude_jerk", "jerk above 5 m/s³", |s| {
        s.jerk > 5.0
    }),
    rule("high_magnitude_speed", "faster than 9 m/s, steady", |s| {
        s.speed > 9.0 && s.is_steady()
    }),
    rule("low_magnitude_speed", "0.3 to 1.2 m/s, steady", |s| {
        s.speed > 0.3 && s.speed < 1.2 && s.is_steady()
    }),
    rule("medium_magnitude_speed", "3 to 9 m/s, steady", |s| {
        s.speed > 3.0 && s.speed <= 9.0 && s.is_steady()
    }),
    rule(
        "near_barrier_on_driveable",
        "a barrier on the road within 8 m",
        |s| on_road(s, AgentKind::Barrier, 8.0),
    ),
    rule(
        "near_construction_zone_sign",
        "a construction sign within 20 m",
        |s| count(s, AgentKind::Sign, 20.0, |_| true) > 0,
    ),
    rule(
        "near_high_speed_vehicle",
        "a vehicle faster than 12 m/s within 8 m",
        |s| count(s, AgentKind::Vehicle, 8.0, |o| o.agent.state.speed() > 12.0) > 0,
    ),
    rule(
        "near_long_vehicle",
        "a vehicle longer than 8 m within 5 m",
        |s| count(s, AgentKind::Vehicle, 5.0, |o| o.agent.length > 8.0) > 0,
    ),
    rule(
        "near_multiple_bikes",
        "more than 2 bicycles within 10 m",
        |s| count(s, AgentKind::Bicycle, 10.0, |_| true) > 2,
    ),
    rule(
        "near_multiple_pedestrians",
        "more than 3 people within 8 m",
        |s| count(s, AgentKind::Pedestrian, 8.0, |_| true) > 3,
    ),
    rule(
        "near_multiple_vehicles",
        "faster than 6 m/s with more than 6 moving vehicles within 8 m",
        |s| s.speed > 6.0 && count(s, AgentKind::Vehicle, 8.0, is_moving) > 6,
    ),
    unknowable("near_pedestrian_at_pickup_dropoff"),
    rule(
        "near_pedestrian_on_crosswalk",
        "a person on a crosswalk within 8 m",
        |s| count(s, AgentKind::Pedestrian, 8.0, |o| is_on_crosswalk(s, o)) > 0,
    ),
    rule(
        "near_pedestrian_on_crosswalk_with_ego",
        "a person within 8 m on a crosswalk that the ego is on, too",
        |s| {
            count(s, AgentKind::Pedestrian, 8.0, |o| {
                is_on_crosswalk(s, o) && shares_crosswalk(s, o)
            }) > 0
        },
    ),
    rule(
        "near_trafficcone_on_driveable",
        "a cone on the road within 8 m",
        |s| on_road(s, AgentKind::TrafficCone, 8.0),
    ),
    rule(
        "on_all_way_stop_intersection",
        "on an intersection whose approaches (3 or more) all have stop signs",
        |s| s.on_intersection && !s.lit_here && is_all_way_stop(s),
    ),
    rule("on_carpark", "on a car park", |s| {
        touches(s.scenario.map, s.ego, AreaKind::Carpark)
    }),
    rule("on_intersection", "on an intersection", |s| {
        s.on_intersection
    }),
    unknowable("on_pickup_dropoff"),
    rule(
        "on_stopline_crosswalk",
        "the front less than 2 m from a crosswalk where neither light nor sign rules",
        |s| {
            s.is_crosswalk_within(2.0)
                && !s.on_crosswalk
                && !s.is_light_within(8.0)
                && !s.is_lane_ruled_by_stop(8.0)
        },
    ),
    rule(
        "on_stopline_stop_sign",
        "the front less than 2 m from where a stop sign rules",
        |s| s.is_lane_ruled_by_stop(2.0),
    ),
    rule(
        "on_stopline_traffic_light",
        "the front less than 2 m from a light's stop line",
        |s| s.is_light_within(2.0),
    ),
    rule(
        "on_traffic_light_intersection",
        "on an intersection, in a lane with a light",
        |s| s.lit_here,
    ),
    rule(
        "starting_high_speed_turn",
        "starting a turn at more than 6 m/s",
        |s| {
            s.turn
                .is_some_and(|turn| !turn.is_straight() && turn.speed > 6.0)
        },
    ),
    rule(
        "starting_left_turn",
        "entering an intersection to turn left",
        |s| s.turn.is_some_and(|turn| turn.is_left()),
    ),
    rule(
        "starting_low_speed_turn",
        "starting a turn at less than 4 m/s",
        |s| {
            s.turn
                .is_some_and(|turn| !turn.is_straight() && turn.speed < 4.0)
        },
    ),
    rule(
        "starting_protected_cross_turn",
        "starting a left turn under a light",
        |s| s.turn.is_some_and(|turn| turn.is_left() && turn.is_lit),
    ),
    rule(
        "starting_protected_noncross_turn",
        "starting a right turn under a light",
        |s| s.turn.is_some_and(|turn| turn.is_right() && turn.is_lit),
    ),
    rule(
        "starting_right_turn",
        "entering an intersection to turn right",
        |s| s.turn.is_some_and(|turn| turn.is_right()),
    ),
    rule(
        "starting_straight_stop_sign_intersection_traversal",
        "entering an intersection straight ahead from a stop sign",
        |s| s.turn.is_some_and(|turn| turn.is_straight()) && s.is_lane_ruled_by_stop(8.0),
    ),
    rule(
        "starting_straight_traffic_light_intersection_traversal",
        "entering an intersection straight ahead under a light, not stopped",
        |s| {
            s.turn
                .is_some_and(|turn| turn.is_straight() && turn.is_lit && turn.speed > 0.1)
        },
    ),
    rule(
        "starting_u_turn",
        "entering an intersection to turn by more than 140°",
        |s| s.turn.is_some_and(|turn| turn.is_around()),
    ),
    rule(
        "starting_unprotected_cross_turn",
        "starting a left turn without a light",
        |s| s.turn.is_some_and(|turn| turn.is_left() && !turn.is_lit),
    ),
    rule(
        "starting_unprotected_noncross_turn",
        "starting a right turn without a light",
        |s| s.turn.is_some_and(|turn| turn.is_right() && !turn.is_lit),
    ),
    rule("stationary", "slower than 0.1 m/s", |s| s.is_stationary()),
    rule(
        "stationary_at_crosswalk",
        "stationary with a crosswalk less than 5 m ahead",
        |s| s.is_stationary() && s.is_crosswalk_within(5.0),
    ),
    rule(
        "stationary_at_traffic_light_with_lead",
        "stationary within 30 m of a stop light behind a close lead",
        |s| s.is_stationary() && s.is_stop_light_within(30.0) && s.has_close_lead(),
    ),
    rule(
        "stationary_at_traffic_light_without_lead",
        "stationary within 10 m of a stop light as the first",
        |s| s.is_stationary() && s.is_stop_light_within(10.0) && !s.has_close_lead(),
    ),
    rule(
        "stationary_in_traffic",
        "stationary with more than 6 vehicles within 8 m",
        |s| s.is_stationary() && count(s, AgentKind::Vehicle, 8.0, |_| true) > 6,
    ),
    rule(
        "stopping_at_crosswalk",
        "stopping with a crosswalk less than 10 m ahead",
        |s| s.is_stopping() && s.is_crosswalk_within(10.0),
    ),
    rule(
        "stopping_at_stop_sign_no_crosswalk",
        "stopping less than 15 m before a stop sign, no crosswalk within 18 m",
        |s| s.is_stopping() && s.is_lane_ruled_by_stop(15.0) && !s.is_crosswalk_within(18.0),
    ),
    rule(
        "stopping_at_stop_sign_with_lead",
        "stopping before a stop sign behind a vehicle",
        |s| s.is_stopping() && s.is_lane_ruled_by_stop(25.0) && s.has_close_lead(),
    ),
    rule(
        "stopping_at_stop_sign_without_lead",
        "stopping before a stop sign as the first",
        |s| s.is_stopping() && s.is_lane_ruled_by_stop(15.0) && !s.has_close_lead(),
    ),
    rule(
        "stopping_at_traffic_light_with_lead",
        "stopping before a stop light behind a lead",
        |s| s.is_stopping() && s.is_stop_light_within(30.0) && s.lead().is_some(),
    ),
    rule(
        "stopping_at_traffic_light_without_lead",
        "stopping before a stop light as the first",
        |s| s.is_stopping() && s.is_stop_light_within(20.0) && s.lead().is_none(),
    ),
    rule(
        "stopping_with_lead",
        "stopping with a lead less than 6 m ahead",
        |s| s.is_stopping() && s.has_close_lead(),
    ),
    rule("traversing_crosswalk", "moving, on a crosswalk", |s| {
        s.speed > 0.3 && s.on_crosswalk
    }),
    rule(
        "traversing_intersection",
        "moving, on an intersection",
        |s| s.speed > 0.3 && s.on_intersection,
    ),
    rule(
        "traversing_narrow_lane",
        "moving in a lane narrower than 2.8 m",
        |s| s.speed > 0.3 && s.lane.is_some_and(|lane| lane.width < 2.8),
    ),
    unknowable("traversing_pickup_dropoff"),
    rule(
        "traversing_traffic_light_intersection",
        "moving, on an intersection under a light",
        |s| s.speed > 0.3 && s.lit_here,
    ),
    rule(
        "waiting_for_pedestrian_to_cross",
        "slower than 2 m/s, a crosswalk less than 8 m ahead, and a person within 8 m who is or \
         will be in the way on it within 1.5 s",
        |s| {
            let waits = s.speed < 2.0 && s.is_crosswalk_within(8.0);
            waits
                && count(s, AgentKind::Pedestrian, 8.0, |person| {
                    will_cross(s, person)
                }) > 0
        },
    ),
];

fn count(
    s: &Situation<'_>,
    kind: AgentKind,
    within: f64,
    wanted: impl Fn(&Other<'_>) -> bool,
) -> usize {
    let near = s.of_kind(kind).filter(|other| other.distance < within);
    near.filter(|other| wanted(other)).count()
}

fn is_moving(other: &Other<'_>) -> bool {
    other.agent.state.speed() > 0.5
}

fn follows_lane(s: &Situation<'_>) -> bool {
    let on_road = s.lane.is_some_and(|lane| !lane.in_intersection);
    s.speed > 3.5 && on_road && s.lane_change.is_none()
}

fn on_road(s: &Situation<'_>, kind: AgentKind, within: f64) -> bool {
    let on_road = |o: &Other<'_>| s.scenario.map.is_drivable(o.agent.state.pose.position);
    count(s, kind, within, on_road) > 0
}

/// Passes from one side of the line ahead to the other, more across than along it.
fn crosses(s: &Situation<'_>, other: &Other<'_>) -> bool {
    let turn = angle_difference(other.agent.state.pose.heading, s.ego.state.pose.heading);
    let across = turn.sin().abs() > 0.5;
    let ahead = |x: f64| (0.0..20.0 + s.ego.length / 2.0).contains(&x);
    let passes = |seconds| {
        s.place_after(other, seconds).is_some_and(|then| {
            then.y * other.place.y < 0.0 && ahead(other.place.x) && ahead(then.x)
        })
    };
    across && is_moving(other) && [1.0, 2.0, 3.0].into_iter().any(passes)
}

fn is_on_crosswalk(s: &Situation<'_>, other: &Other<'_>) -> bool {
    let place = other.agent.state.pose.position;
    s.scenario
        .map
        .areas_containing(place, AreaKind::Crosswalk)
        .next()
        .is_some()
}

fn shares_crosswalk(s: &Situation<'_>, other: &Other<'_>) -> bool {
    let place = other.agent.state.pose.position;
    let own = footprint(s.ego);
    let mut crosswalks = s.scenario.map.areas_containing(place, AreaKind::Crosswalk);
    crosswalks.any(|area| area.polygon.intersects(&own))
}

/// Is in the ego's path now or within 1.5 s, and on a crosswalk then or now.
fn will_cross(s: &Situation<'_>, person: &Other<'_>) -> bool {
    let half = s.ego.width / 2.0;
    let velocity = s
        .ego
        .state
        .pose
        .inverse()
        .rotate(person.agent.state.velocity);
    let ahead = person.place.x > s.ego.length / 2.0;
    let on = (0..=3).any(|i| {
        let then = person.place + velocity * (0.5 * f64::from(i));
        let world = s.ego.state.pose * then;
        let walks = s
            .scenario
            .map
            .areas_containing(world, AreaKind::Crosswalk)
            .next();
        then.y.abs() < half + 0.5 && walks.is_some()
    });
    ahead && on
}

fn is_all_way_stop(s: &Situation<'_>) -> bool {
    let map = &s.scenario.map;
    let here = s.ego.state.pose.position;
    let approaches: Vec<_> = map
        .lanes_near(here, 25.0)
        .map(|(lane, _)| lane)
        .filter(|lane| !lane.in_intersection)
        .filter(|lane| map.successors(lane.id).any(|next| next.in_intersection))
        .filter(|lane| {
            let points = lane.centerline.points();
            points[points.len() - 1].distance(here) < 25.0
        })
        .collect();
    let ruled = |id| map.stop_signs_of(id).next().is_some();
    approaches.len() >= 3 && approaches.iter().all(|lane| ruled(lane.id))
}

#[cfg(test)]
mod tests;
