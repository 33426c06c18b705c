//! Check of a scene against its request, clause by clause. The clauses of constraints on single
//! objects are in `object_check`.

use std::fmt;

use gump_metrics::{Metric as _, OffRoad, overlapping, tags};
use gump_scene::{AgentKind, Frame, Scenario, ScenarioTag, SceneState};

use crate::Counts;
pub use crate::object_check::check_objects;

/// Sampling interval of futures, seconds: a step of the networks. Contacts in between are missed.
pub(crate) const LOOK_S: f64 = 0.5;

/// The clause that no agents overlap.
pub const NOBODY_OVERLAPS: &str = "nobody overlaps";

/// The clause that no vehicle is off the road.
pub const VEHICLES_ON_ROAD: &str = "vehicles are on the road";

/// One clause of a request.
#[derive(Clone, Debug, PartialEq)]
pub struct Clause {
    /// As text.
    pub clause: String,
    /// Whether it holds; `None` if states and maps do not decide it.
    pub holds: Option<bool>,
    /// Whether it also holds at every instant after the present; `None` for clauses about an
    /// instant, or without a rollout. See [`through_time`].
    pub holds_throughout: Option<bool>,
    /// Share of the instants from the present on at which it holds, of prompts too; `None` without a
    /// rollout, or if it cannot be decided. See [`through_time`].
    pub share_of_time: Option<f64>,
}

impl Clause {
    pub(crate) fn new(clause: String, holds: Option<bool>) -> Self {
        Self {
            clause,
            holds,
            holds_throughout: None,
            share_of_time: None,
        }
    }
}

impl fmt::Display for Clause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = match self.holds {
            Some(true) => "holds",
            Some(false) => "does not hold",
            None => "cannot be decided",
        };
        write!(f, "{}: {word}", self.clause)
    }
}

/// The check of the present of a scenario: every prompt, every count, no overlap, no agent off the
/// road.
///
/// Prompts about what is beginning are decided by the frames after the present.
pub fn check_clauses(
    scenario: &Scenario,
    prompts: &[ScenarioTag],
    counts: Option<&Counts>,
) -> Vec<Clause> {
    let mut clauses: Vec<Clause> = prompts
        .iter()
        .map(|tag| Clause::new(tag.name().into(), tags::holds(*tag, scenario)))
        .collect();
    clauses.extend(standing(&scenario.present(), counts));
    clauses
}

/// Checks the clauses of [`check_clauses`] throughout the scenario's future, twice a second.
///
/// Prompts are about an instant, so that only the share of instants at which they hold is of
/// interest. A prompt about what begins is decided by the frames that are left, and therefore
/// rarely holds near the end.
pub fn through_time(clauses: &mut [Clause], scenario: &Scenario, counts: Option<&Counts>) {
    let stride = (LOOK_S / scenario.dt).round().max(1.0) as usize;
    let instants = (scenario.now..scenario.log.len()).step_by(stride);
    if instants.len() < 2 {
        return;
    }
    let mut held = vec![Some(0_usize); clauses.len()];
    let mut count = |i: usize, holds: Option<bool>| {
        held[i] = held[i].zip(holds).map(|(n, holds)| n + usize::from(holds));
    };
    // Clauses of any instant come last, after the prompts.
    let n_prompts = clauses.len() - standing(&scenario.present(), counts).len();
    let prompts = clauses[..n_prompts].iter();
    let prompts: Vec<Option<ScenarioTag>> = prompts.map(|c| c.clause.parse().ok()).collect();
    let mut later = scenario.clone();
    for k in instants.clone() {
        later.now = k;
        for (i, tag) in prompts.iter().enumerate() {
            count(i, tag.and_then(|tag| tags::holds(tag, &later)));
        }
        for (i, now) in standing(&scenario.at(k), counts).into_iter().enumerate() {
            count(n_prompts + i, now.holds);
            let clause = &mut clauses[n_prompts + i];
            let before = clause.holds_throughout.or(clause.holds);
            clause.holds_throughout = before.zip(now.holds).map(|(a, b)| a && b);
        }
    }
    for (clause, held) in clauses.iter_mut().zip(held) {
        clause.share_of_time = held.map(|n| n as f64 / instants.len() as f64);
    }
}

/// Clauses that apply to any instant.
fn standing(present: &SceneState<'_>, counts: Option<&Counts>) -> Vec<Clause> {
    let mut clauses = Vec::new();
    for kind in AgentKind::MOVING {
        let Some(requested) = counts.map(|counts| counts.of(kind)) else {
            continue;
        };
        let agents = present.now().agents().iter();
        let found = agents.filter(|agent| agent.kind == kind && agent.id != present.ego);
        let clause = format!("{} {requested}", kind.name());
        clauses.push(Clause::new(clause, Some(found.count() == requested)));
    }
    let clear = overlaps_in(present.now()) == 0;
    clauses.push(Clause::new(NOBODY_OVERLAPS.into(), Some(clear)));
    let on_road = off_road_in(present) == 0;
    clauses.push(Clause::new(VEHICLES_ON_ROAD.into(), Some(on_road)));
    clauses
}

/// Number of agents that overlap another at the present.
pub fn overlaps(scenario: &Scenario) -> usize {
    overlaps_in(scenario.present().now())
}

pub(crate) fn overlaps_in(frame: &Frame) -> usize {
    let hit = |agent: &&gump_scene::Agent| overlapping(frame, agent).next().is_some();
    frame.agents().iter().filter(hit).count()
}

/// Number of vehicles with a corner off the road at the present.
pub fn off_road(scenario: &Scenario) -> usize {
    off_road_in(&scenario.present())
}

fn off_road_in(present: &SceneState<'_>) -> usize {
    let off = |agent: &&gump_scene::Agent| OffRoad.at(present, agent) == Some(1.0);
    present.now().agents().iter().filter(off).count()
}

#[cfg(test)]
mod tests {
    use gump_scene::fixture;

    use super::*;

    #[test]
    fn every_clause_has_a_verdict() {
        let scenario = fixture::scenario(
            "lane 1: -50,0 50,0\nedge: -50,-2 50,-2\nego vehicle 0: 0,0 velocity 0.8,0\n\
             agent bicycle 1: 9,0 velocity 0.8,0\nagent vehicle 2: -20,-1.5\nagent vehicle 3: -21,-1.5",
        )
        .unwrap();
        let tag = |name: &str| name.parse::<ScenarioTag>().unwrap();
        let prompts = [
            tag("behind_bike"),
            tag("high_magnitude_speed"),
            tag("on_pickup_dropoff"),
        ];
        let counts = Counts {
            vehicles: 2,
            pedestrians: 1,
            bicycles: 1,
        };
        let clauses = check_clauses(&scenario, &prompts, Some(&counts));
        let holds: Vec<_> = clauses.iter().map(|clause| clause.holds).collect();
        let (yes, no) = (Some(true), Some(false));
        assert_eq!(holds, [yes, no, None, yes, no, yes, no, no]);
        assert_eq!((overlaps(&scenario), off_road(&scenario)), (2, 2));
    }

    #[test]
    fn a_prompt_holds_for_a_share_of_the_time() {
        // The gap to the bicycle is 16.7 m and shrinks by 2 m a second: below 10 m from 3.5 s on.
        let scenario = fixture::scenario(
            "lane 1: -50,0 90,0\nego vehicle 0: 0,0 velocity 4,0\n\
             agent bicycle 1: 20,0 velocity 2,0",
        )
        .unwrap();
        let prompts = ["behind_bike", "on_pickup_dropoff"];
        let prompts = prompts.map(|name| name.parse::<ScenarioTag>().unwrap());
        let mut clauses = check_clauses(&scenario, &prompts, None);
        through_time(&mut clauses, &scenario, None);
        let found: Vec<_> = clauses[..2]
            .iter()
            .map(|c| (c.holds, c.share_of_time))
            .collect();
        assert_eq!(found, [(Some(false), Some(10.0 / 17.0)), (None, None)]);
    }

    #[test]
    fn what_holds_now_need_not_hold_later() {
        // In four seconds the ego has reached the standing vehicle.
        let scenario = fixture::scenario(
            "lane 1: -50,0 90,0\nego vehicle 0: 0,0 velocity 8,0\nagent vehicle 1: 36,0",
        )
        .unwrap();
        let counts = Counts {
            vehicles: 1,
            ..Counts::default()
        };
        let prompts = ["high_magnitude_speed".parse::<ScenarioTag>().unwrap()];
        let mut clauses = check_clauses(&scenario, &prompts, Some(&counts));
        assert!(
            clauses
                .iter()
                .all(|clause| clause.holds_throughout.is_none())
        );
        through_time(&mut clauses, &scenario, Some(&counts));
        let throughout: Vec<_> = clauses.iter().map(|c| c.holds_throughout).collect();
        let (yes, no) = (Some(true), Some(false));
        assert_eq!(throughout, [None, yes, yes, yes, no, yes]);
        assert_eq!(clauses[4].holds, yes);
        // They overlap at three of 17 instants, from 4 s to 5 s; 8 m/s are no high speed.
        let shares: Vec<_> = clauses.iter().map(|c| c.share_of_time).collect();
        let (all, clear) = (Some(1.0), Some(14.0 / 17.0));
        assert_eq!(shares, [Some(0.0), all, all, all, clear, all]);
        let mut alone = scenario.clone();
        alone.log.truncate(alone.now + 1);
        let mut clauses = check_clauses(&alone, &[], None);
        through_time(&mut clauses, &alone, None);
        assert!(
            clauses
                .iter()
                .all(|clause| clause.holds_throughout.is_none())
        );
    }
}
