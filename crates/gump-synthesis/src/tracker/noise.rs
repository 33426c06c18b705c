//! Errors of pose, velocity and size.

use gump_geometry::{DVec2, wrap_angle};
use gump_scene::{Agent, AgentKind, AgentState, Rng, Seed, standard_normal};
use rand::Rng as _;

use super::stands;

// Errors, here, in `level` and in `Noise::step`, were fitted by hand to
// `configs/targets/waymo-like.toml` (docs/results/0017-recorded-like.md) and to second differences of
// recorded places and headings (docs/results/0049-how-vehicles-go-on.md). The bounds keep the worst
// tracks plausible; they were chosen by hand and not varied.
/// Correlation time of errors of position, seconds.
const MEMORY_S: f64 = 0.6;
/// The same for errors of velocity.
const VELOCITY_MEMORY_S: f64 = 0.18;
/// Largest error of a velocity, m/s.
const MOST_VELOCITY: f64 = 1.2;
/// Largest error of a heading, radians.
const MOST_HEADING: f64 = 0.5;
/// The worst errors of heading, as a multiple of the typical ones.
const WORST_HEADING: f64 = 3.0;
/// Share of standing vehicles whose boxes are not exactly still.
const RESTLESS: f64 = 0.05;

/// Standard deviations of the errors of a kind that moves, for a typical agent.
struct Level {
    /// Along the path, metres.
    position: f64,
    /// Across the path, as a share of that.
    across: f64,
    /// Radians.
    heading: f64,
    /// Correlation time of errors of heading, seconds.
    heading_memory_s: f64,
    /// Metres per second.
    velocity: f64,
    /// Standard deviation of the logarithm of all these over agents: a few are much worse than
    /// most.
    spread: f64,
}

fn level(kind: AgentKind) -> Level {
    match kind {
        AgentKind::Pedestrian => Level {
            position: 0.019,
            across: 1.0,
            heading: 0.014,
            heading_memory_s: 0.6,
            velocity: 0.09,
            spread: 0.8,
        },
        AgentKind::Bicycle => Level {
            position: 0.03,
            across: 1.0,
            heading: 0.012,
            heading_memory_s: 0.6,
            velocity: 0.3,
            spread: 0.6,
        },
        _ => Level {
            position: 0.03,
            across: 0.35,
            heading: 0.002,
            heading_memory_s: 0.2,
            velocity: 0.13,
            spread: 1.0,
        },
    }
}

/// The errors of one agent, which change from step to step.
pub(super) struct Noise {
    rng: Rng,
    level: Level,
    /// Multiplies the errors of this agent.
    scale: f64,
    /// True for a standing vehicle whose box moves all the same.
    is_restless: bool,
    position: DVec2,
    heading: f64,
    velocity: DVec2,
}

impl Noise {
    /// The errors of an agent; `noise` multiplies them all.
    pub(super) fn new(agent: &Agent, is_ego: bool, noise: f64, seed: Seed) -> Self {
        let mut rng = seed.rng();
        let level = level(agent.kind);
        // The ego knows its own motion.
        let own = if is_ego { 0.15 } else { 1.0 };
        let scale = noise * own * (level.spread * standard_normal(&mut rng)).exp().min(6.0);
        Self {
            is_restless: rng.random_bool(RESTLESS) || agent.kind != AgentKind::Vehicle,
            rng,
            level,
            scale,
            position: DVec2::ZERO,
            heading: 0.0,
            velocity: DVec2::ZERO,
        }
    }

    /// The agent as it is seen `distance` metres away, `dt` seconds after the last call.
    pub(super) fn step(&mut self, agent: &Agent, distance: f64, dt: f64) -> Agent {
        let slow = (-dt / MEMORY_S).exp();
        let fast = (-dt / VELOCITY_MEMORY_S).exp();
        let turning = (-dt / self.level.heading_memory_s).exp();
        let rng = &mut self.rng;
        let mut vector = || DVec2::new(standard_normal(rng), standard_normal(rng));
        self.position = self.position * slow + vector() * (1.0 - slow * slow).sqrt();
        self.velocity = self.velocity * fast + vector() * (1.0 - fast * fast).sqrt();
        self.heading =
            self.heading * turning + standard_normal(rng) * (1.0 - turning * turning).sqrt();
        if self.scale == 0.0 {
            return *agent;
        }
        let far = 0.6 + distance / 60.0;
        let still = match (stands(agent), agent.kind) {
            // Boxes of parked vehicles do not move in recordings, but for a few.
            (true, AgentKind::Vehicle) if !self.is_restless => return *agent,
            (true, AgentKind::Vehicle) => 0.15,
            _ => 1.0,
        };
        // The heading of a standing person is hard to measure.
        let unsure = match (stands(agent), agent.kind) {
            (true, AgentKind::Pedestrian | AgentKind::Bicycle) => 12.0,
            _ => 1.0,
        };
        let scale = self.scale * far * still;
        let Level {
            position,
            across,
            heading,
            velocity,
            ..
        } = self.level;
        let pose = agent.state.pose;
        let turned = self.heading * heading * scale.min(WORST_HEADING) * unsure;
        let turned = turned.clamp(-MOST_HEADING, MOST_HEADING);
        let pushed = (self.velocity * velocity * scale).clamp_length_max(MOST_VELOCITY);
        // Places are known better than speeds: paths do not wave however bad the velocity.
        let error = self.position * DVec2::new(1.0, across) * position * scale.min(2.0);
        let moved = pose.rotate(error).clamp_length_max(0.3);
        let state = AgentState {
            pose: gump_geometry::Pose {
                position: pose.position + moved,
                heading: wrap_angle(pose.heading + turned),
            },
            velocity: agent.state.velocity + pushed,
        };
        agent.with_state(state)
    }
}
