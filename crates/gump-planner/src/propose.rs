//! What the ego might do, before anyone imagines how others take it.
//!
//! Here are the parameters and the list of proposals. `path_ahead` finds the line they follow,
//! `obstacle` what stands in it, `driver` drives along it.

use gump_geometry::Pose;
use gump_rollout::worlds::IdmConfig;
use gump_scene::{AgentState, Route, SceneState};

use crate::driver::{DECISION, Driver, Merge};
use crate::obstacle::Forecast;
use crate::path_ahead::PathAhead;
use crate::{PlanError, Proposal, ProposalKind};

/// Which proposals to make.
#[derive(Clone, Debug, PartialEq)]
pub struct ProposalConfig {
    /// Desired speeds as shares of the limit, each > 0.
    pub speed_fractions: Vec<f64>,
    /// Lines to follow, metres to the left of the centre.
    pub lateral_offsets: Vec<f64>,
    /// The limit of a lane that states neither one nor of what kind it is, metres per second, > 0.
    pub fallback_speed: f64,
    /// Seconds to propose, > 0; rounded to whole steps.
    pub horizon: f64,
    /// Seconds between states, > 0; rounded to whole tenths of a second.
    pub dt: f64,
    /// The driver; its target velocity is not used.
    pub idm: IdmConfig,
    /// Deceleration of the emergency brake, metres per second squared, > 0.
    pub emergency_deceleration: f64,
}

impl Default for ProposalConfig {
    /// The 15 proposals of PDM (Dauner et al. 2023) at the paper's 2 Hz over 4 s. The emergency
    /// brake reaches 6 m/s², well within dry-road grip, as in the reactive world.
    fn default() -> Self {
        Self {
            speed_fractions: vec![0.2, 0.4, 0.6, 0.8, 1.0],
            lateral_offsets: vec![0.0, -1.0, 1.0],
            fallback_speed: 15.0,
            horizon: 4.0,
            dt: 0.5,
            idm: IdmConfig {
                target_velocity: 15.0,
                min_gap: 1.0,
                headway: 1.5,
                max_acceleration: 1.5,
                max_deceleration: 3.0,
                exponent: 10.0,
                emergency_deceleration: 3.0,
                ..IdmConfig::default()
            },
            emergency_deceleration: 6.0,
        }
    }
}

impl ProposalConfig {
    pub(crate) fn check(&self) -> Result<(), PlanError> {
        let single = [
            ("fallback_speed", self.fallback_speed),
            ("horizon", self.horizon),
            ("dt", self.dt),
            ("emergency_deceleration", self.emergency_deceleration),
            ("min_gap", self.idm.min_gap),
            ("headway", self.idm.headway),
            ("max_acceleration", self.idm.max_acceleration),
            ("max_deceleration", self.idm.max_deceleration),
            ("exponent", self.idm.exponent),
            (
                "idm.emergency_deceleration",
                self.idm.emergency_deceleration,
            ),
            ("look_ahead", self.idm.look_ahead),
        ];
        let fractions = self.speed_fractions.iter().map(|&f| ("speed_fraction", f));
        for (name, value) in single.into_iter().chain(fractions) {
            if !(value > 0.0 && value.is_finite()) {
                let expected = "a positive number";
                return Err(PlanError::Parameter {
                    name,
                    value,
                    expected,
                });
            }
        }
        if let Some(&value) = self.lateral_offsets.iter().find(|o| !o.is_finite()) {
            return Err(PlanError::Parameter {
                name: "lateral_offset",
                value,
                expected: "a finite number",
            });
        }
        let n = self.speed_fractions.len() * self.lateral_offsets.len();
        if n == 0 {
            return Err(PlanError::Parameter {
                name: "number of proposals",
                value: 0.0,
                expected: "at least one speed and one offset",
            });
        }
        Ok(())
    }

    /// Decisions of the driver between two states.
    pub(crate) fn n_decisions_per_state(&self) -> usize {
        (self.dt / DECISION).round().max(1.0) as usize
    }

    /// Seconds between states, whole decisions.
    fn spacing(&self) -> f64 {
        self.n_decisions_per_state() as f64 * DECISION
    }

    fn n_states(&self) -> usize {
        (self.horizon / self.spacing()).round().max(1.0) as usize
    }
}

/// What [`propose`] found.
#[derive(Clone, Debug, PartialEq)]
pub struct Proposals {
    /// The trajectories: offsets in the order of the configuration, within each all speeds.
    pub proposals: Vec<Proposal>,
    /// The way they follow, from behind the ego to past the horizon.
    pub way: Route,
}

/// Proposes what the ego might do: every desired speed on every line beside the centre of its way.
///
/// The way is the route, or the lane graph ahead where there is no route near. The ego leaves its
/// present pose smoothly towards its line. It keeps the driver model's distance to whoever is in
/// the strip it will sweep, all others forecast at constant velocity, and stops for red lights on
/// its way.
///
/// # Errors
/// [`PlanError::NoLaneAhead`] without a way, [`PlanError::NotFinite`] for broken states,
/// [`PlanError::Parameter`] for a broken configuration.
/// Source: the proposals of PDM (Dauner et al. 2023), from the ego's true pose and without the
/// standing obstacle that its generator sees in the first tenth of a second.
pub fn propose(scene: &SceneState<'_>, config: &ProposalConfig) -> Result<Proposals, PlanError> {
    config.check()?;
    check_finite(scene)?;
    let ego = scene.ego_now();
    let n_decisions = config.n_states() * config.n_decisions_per_state();
    let limit_reach = config.fallback_speed.max(ego.state.speed()) * config.horizon;
    let path = PathAhead::find(*scene, limit_reach + config.idm.look_ahead)?;
    let forecast = Forecast::new(*scene, &path, n_decisions, DECISION, config.idm.look_ahead);
    let stop = path.red_stop_line(*scene, path.ego_s + ego.length / 2.0);
    let limit = path.speed_limit.unwrap_or(config.fallback_speed);
    let mut proposals = Vec::new();
    for &lateral_offset in &config.lateral_offsets {
        let merge = Merge::new(&ego.state, &path, lateral_offset);
        for &speed_fraction in &config.speed_fractions {
            let driver = Driver {
                config,
                path: &path,
                merge,
                forecast: &forecast,
                stop,
                size: (ego.length, ego.width),
                desired_speed: limit * speed_fraction,
            };
            proposals.push(Proposal {
                kind: ProposalKind::Idm {
                    speed_fraction,
                    lateral_offset,
                },
                dt: config.spacing(),
                states: driver.drive(&ego.state, n_decisions),
            });
        }
    }
    let way = path.into_route();
    Ok(Proposals { proposals, way })
}

/// Braking straight along the present heading as hard as `config` allows.
///
/// # Errors
/// [`PlanError::NotFinite`] and [`PlanError::Parameter`] as for [`propose`].
pub fn emergency_brake(
    scene: &SceneState<'_>,
    config: &ProposalConfig,
) -> Result<Proposal, PlanError> {
    config.check()?;
    check_finite(scene)?;
    let ego = scene.ego_now().state;
    let forward = ego.pose.direction();
    let speed = ego.velocity.dot(forward);
    let deceleration = config.emergency_deceleration;
    let state = |i: usize| {
        // A vehicle that rolls backwards is braked too.
        let braked = (i as f64 * config.spacing()).min(speed.abs() / deceleration);
        let left = speed.abs() - deceleration * braked;
        let distance = (speed.abs() + left) / 2.0 * braked;
        AgentState {
            pose: Pose {
                position: ego.pose.position + forward * distance.copysign(speed),
                ..ego.pose
            },
            velocity: forward * left.copysign(speed),
        }
    };
    Ok(Proposal {
        kind: ProposalKind::EmergencyBrake,
        dt: config.spacing(),
        states: (1..=config.n_states()).map(state).collect(),
    })
}

fn check_finite(scene: &SceneState<'_>) -> Result<(), PlanError> {
    let mut agents = scene.now().agents().iter();
    match agents.find(|agent| !agent.state.is_finite()) {
        Some(agent) => Err(PlanError::NotFinite { agent: agent.id }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;
    use gump_geometry::angle_difference;
    use gump_scene::fixture;

    const STREET: &str = "lane 1: 0,0 150,0 400,0 speed 10\n";

    fn check(text: &str) -> Vec<Proposal> {
        let scenario = fixture::scenario(text).unwrap();
        let found = propose(&scenario.present(), &ProposalConfig::default()).unwrap();
        found.proposals
    }

    fn last(proposal: &Proposal) -> AgentState {
        *proposal.states.last().unwrap()
    }

    #[test]
    fn every_speed_is_proposed_on_every_line() {
        let proposals = check(&format!("{STREET} ego vehicle 0: 10,0 velocity 6,0"));
        assert_eq!(proposals.len(), 15);
        for (i, proposal) in proposals.iter().enumerate() {
            assert_eq!((proposal.states.len(), proposal.dt), (8, 0.5));
            let speed_fraction = [0.2, 0.4, 0.6, 0.8, 1.0][i % 5];
            let lateral_offset = [0.0, -1.0, 1.0][i / 5];
            let kind = ProposalKind::Idm {
                speed_fraction,
                lateral_offset,
            };
            assert_eq!(proposal.kind, kind);
            let end = last(proposal);
            // Slow ones have driven too little to be on their line yet.
            let off_line = if i % 5 < 2 { 0.6 } else { 0.2 };
            assert_abs_diff_eq!(end.pose.position.y, lateral_offset, epsilon = off_line);
            assert_abs_diff_eq!(end.speed(), 10.0 * speed_fraction, epsilon = 0.2);
        }
    }

    #[test]
    fn a_free_start_follows_the_law() {
        let proposals = check(&format!("{STREET} ego vehicle 0: 10,0"));
        let fastest = &proposals[4];
        // (v / 10)^10 is below 0.03 up to 7 m/s, so it is 1.5 m/s² nearly to the end.
        let after_2s = fastest.states[3];
        assert_abs_diff_eq!(after_2s.speed(), 3.0, epsilon = 1e-3);
        assert_abs_diff_eq!(after_2s.pose.position.x, 13.0, epsilon = 1e-3);
    }

    #[test]
    fn nobody_is_run_into() {
        for (others, speed) in [
            ("agent vehicle 1: 50,0", 12.0),
            ("agent vehicle 1: 30,0.5 velocity 4,0", 9.0),
            ("agent vehicle 1: 60,-18 velocity 0,5", 10.0),
        ] {
            let text = format!("{STREET} ego vehicle 0: 10,0 velocity {speed},0\n{others}");
            let scenario = fixture::scenario(&text).unwrap();
            let scene = scenario.present();
            let other = scene.now().agents()[1];
            for proposal in check(&text) {
                for (i, state) in proposal.states.iter().enumerate() {
                    let mut forecast = other.oriented_box();
                    forecast.pose.position += other.state.velocity * (i + 1) as f64 * proposal.dt;
                    let ego = scene.ego_now().with_state(*state);
                    assert!(!ego.oriented_box().overlaps(&forecast), "{others}");
                }
            }
        }
    }

    #[test]
    fn who_is_not_in_the_way_does_not_matter() {
        let ego = "ego vehicle 0: 20,0 velocity 6,0\n";
        let free = check(&format!("{STREET}{ego}"));
        for others in [
            "agent vehicle 1: 40,4",
            "agent vehicle 1: 10,0 velocity 6,0",
            "agent vehicle 1: 120,0 velocity 30,0",
            "agent pedestrian 1: 40,-9 velocity 0,1",
        ] {
            let found = check(&format!("{STREET}{ego}{others}"));
            assert_eq!(last(&found[4]), last(&free[4]), "{others}");
        }
    }

    #[test]
    fn a_red_light_is_stopped_for() {
        let text = format!("{STREET} light 1 red: 40,0\n ego vehicle 0: 10,0 velocity 8,0");
        for proposal in check(&text) {
            let end = last(&proposal);
            assert!(end.pose.position.x + 2.4 < 40.0);
        }
        let green = check(&text.replace("red", "green"));
        assert!(last(&green[4]).pose.position.x + 2.4 > 40.0);
    }

    #[test]
    fn proposals_leave_the_ego_smoothly() {
        let lanes = "lane 1: 0,0 30,0 60,10 90,40 speed 10\n";
        let text = format!("{lanes} ego vehicle 0: 10,1.2 heading 0.1 velocity 7.96,0.8");
        let scenario = fixture::scenario(&text).unwrap();
        let now = scenario.present().ego_now().state;
        for proposal in check(&text) {
            assert_eq!(proposal.state_at(&now, 0.0), now);
            let mut before = now;
            for i in 1..=80 {
                let state = proposal.state_at(&now, f64::from(i) * 0.05);
                let moved = (state.pose.position - before.pose.position) / 0.05;
                let middle = (state.velocity + before.velocity) / 2.0;
                assert!((moved - middle).length() < 0.05, "{moved} but {middle}");
                let turn = angle_difference(state.pose.heading, before.pose.heading);
                assert!(turn.abs() < 0.05);
                before = state;
            }
        }
    }

    #[test]
    fn a_standing_ego_that_stays_does_not_slide() {
        let text = format!(
            "{STREET} ego vehicle 0: 10,1.2 heading 0.1\n agent vehicle 1: 15.6,1 size 5,2"
        );
        let scenario = fixture::scenario(&text).unwrap();
        let now = scenario.present().ego_now().state;
        for proposal in check(&text) {
            assert!(proposal.states.iter().all(|state| state.pose == now.pose));
        }
    }

    #[test]
    fn the_emergency_brake_stops_where_physics_says() {
        let text = format!("{STREET} ego vehicle 0: 10,0 velocity 9,0");
        let scenario = fixture::scenario(&text).unwrap();
        let brake = emergency_brake(&scenario.present(), &ProposalConfig::default()).unwrap();
        // 9² / (2 * 6) = 6.75 m.
        let end = last(&brake);
        assert_abs_diff_eq!(end.pose.position.x, 16.75, epsilon = 1e-9);
        assert_eq!(end.speed(), 0.0);
        assert_abs_diff_eq!(brake.states[0].velocity.x, 6.0, epsilon = 1e-12);
    }

    #[test]
    fn turning_the_world_turns_the_proposals() {
        let straight = check(
            "lane 1: 0,0 200,0 speed 10\n ego vehicle 0: 10,0.5 velocity 6,0\n
             agent vehicle 1: 40,0 velocity 3,0",
        );
        let turned = check(
            "lane 1: 0,0 0,200 speed 10\n ego vehicle 0: -0.5,10 velocity 0,6\n
             agent vehicle 1: 0,40 velocity 0,3",
        );
        for (a, b) in straight.iter().zip(&turned) {
            for (a, b) in a.states.iter().zip(&b.states) {
                let there = a.pose.position.perp();
                assert_abs_diff_eq!(there.distance(b.pose.position), 0.0, epsilon = 1e-9);
            }
        }
    }

    #[test]
    fn parameters_out_of_range_are_refused() {
        let scenario = fixture::scenario("lane 1: 0,0 9,0\nego vehicle 0: 1,0").unwrap();
        let check = |config: ProposalConfig| {
            let error = propose(&scenario.present(), &config).unwrap_err();
            assert!(matches!(error, PlanError::Parameter { .. }), "{error}");
        };
        let config = ProposalConfig::default;
        check(ProposalConfig {
            dt: 0.0,
            ..config()
        });
        check(ProposalConfig {
            horizon: f64::NAN,
            ..config()
        });
        check(ProposalConfig {
            speed_fractions: vec![0.5, -1.0],
            ..config()
        });
        check(ProposalConfig {
            lateral_offsets: vec![f64::INFINITY],
            ..config()
        });
        check(ProposalConfig {
            lateral_offsets: vec![],
            ..config()
        });
    }
}
