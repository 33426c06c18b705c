//! The rule-based policies among which the planner chooses.

use gump_rollout::worlds::IdmConfig;

use super::InteractiveDriverConfig;
use crate::ProposalKind;
use crate::pdm::lane_change::Change;

/// A policy: a line, a desired speed and a car-following law.
#[derive(Clone, Debug)]
pub(super) struct Policy {
    pub(super) kind: ProposalKind,
    /// Index of the line.
    pub(super) line: usize,
    /// Metres per second.
    pub(super) desired_speed: f64,
    pub(super) law: IdmConfig,
    /// Deducted from its value.
    pub(super) cost: f64,
}

// Chosen by hand to add what PDM's fifteen lack (decisions 22 and 23): result 9 has their effect
// together, none was tuned by itself.

/// Shares of the limit that brisk drivers desire.
const BRISK: [f64; 2] = [0.7, 1.0];
/// Fraction of the limit desired by a driver that keeps a long distance.
const YIELDING: f64 = 0.8;
/// Value, of 1, that a change of lane without need has to gain, so that the ego does not change back
/// and forth.
const CHANGE_COST: f64 = 0.02;
/// Shares of the limit at which lanes are changed.
const CHANGING: [f64; 2] = [0.6, 1.0];
/// Share of the limit at which a driver creeps forward: 1 m/s of 50 km/h.
const CREEPING: f64 = 0.07;

/// All policies: PDM's lateral offsets one after another, within each the speeds; then drivers with
/// other driving styles along the centre, if that is a line and they are requested; then changes of
/// lane, along the lines of these indices. `speeds` are PDM's.
pub(super) fn all<'a>(
    config: &InteractiveDriverConfig,
    speeds: &[f64],
    changes: impl Iterator<Item = (usize, &'a Change)>,
) -> Vec<Policy> {
    let proposals = &config.proposals;
    let offsets = proposals.lateral_offsets.iter().enumerate();
    let of_line = |(line, &lateral_offset)| {
        let speeds = proposals.speed_fractions.iter().zip(speeds);
        speeds.map(move |(&speed_fraction, &desired_speed)| Policy {
            kind: ProposalKind::Idm {
                speed_fraction,
                lateral_offset,
            },
            line,
            desired_speed,
            law: proposals.law.clone(),
            cost: 0.0,
        })
    };
    let mut policies: Vec<Policy> = offsets.flat_map(of_line).collect();
    let limit = speeds[0] / proposals.speed_fractions[0];
    let centre = proposals.lateral_offsets.iter().position(|&y| y == 0.0);
    if let Some(line) = centre.filter(|_| config.driving_styles) {
        let policy = |kind, fraction: f64, law| Policy {
            kind,
            line,
            desired_speed: fraction * limit,
            law,
            cost: 0.0,
        };
        let usual = &proposals.law;
        policies.extend(BRISK.map(|speed_fraction| {
            let kind = ProposalKind::Brisk { speed_fraction };
            policy(kind, speed_fraction, brisk(usual))
        }));
        for speed_fraction in [YIELDING, CREEPING] {
            let kind = ProposalKind::Yielding { speed_fraction };
            policies.push(policy(kind, speed_fraction, yielding(usual)));
        }
    }
    for (line, change) in changes {
        policies.extend(CHANGING.map(|speed_fraction| Policy {
            kind: ProposalKind::LaneChange {
                speed_fraction,
                side: change.side,
            },
            line,
            desired_speed: speed_fraction * limit,
            law: proposals.law.clone(),
            cost: if change.is_due { 0.0 } else { CHANGE_COST },
        }));
    }
    policies
}

/// Two thirds of the headway; accelerates at just below nuPlan's comfort bound (2.4 m/s²).
fn brisk(usual: &IdmConfig) -> IdmConfig {
    IdmConfig {
        headway: usual.headway * 2.0 / 3.0,
        max_acceleration: 2.2,
        ..usual.clone()
    }
}

/// Twice the headway, a car's length at standstill, gentle acceleration and braking.
fn yielding(usual: &IdmConfig) -> IdmConfig {
    IdmConfig {
        headway: usual.headway * 2.0,
        min_gap: 4.0,
        max_acceleration: 1.0,
        max_deceleration: 2.5,
        ..usual.clone()
    }
}
