//! Check of a scene against its request, clause by clause.

use std::fmt;

use gump_metrics::{Metric as _, OffRoad, overlapping, tags};
use gump_scene::{AgentKind, Frame, Scenario, ScenarioTag, SceneState};

use crate::Counts;

/// Sampling interval of futures, seconds: a step of the networks. Contacts in between are missed.
pub(crate) const LOOK_S: f64 = 0.5;

/// The clause that no agents overlap.
pub const NOBODY_OVERLAPS: &str = "nobody overlaps";

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
}

impl Clause {
    fn new(clause: String, holds: Option<bool>) -> Self {
        Self {
            clause,
            holds,
            holds_throughout: None,
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

/// Checks the clauses of [`check_clauses`] about numbers, overlaps and the road throughout the
/// scenario's future, twice a second. Prompts are about an instant and not checked.
pub fn through_time(clauses: &mut [Clause], scenario: &Scenario, counts: Option<&Counts>) {
    let stride = (LOOK_S / scenario.dt).round().max(1.0) as usize;
    for k in (scenario.now..scenario.log.len()).step_by(stride).skip(1) {
        let now = standing(&scenario.at(k), counts);
        // They come last, after the prompts.
        for (clause, now) in clauses.iter_mut().rev().zip(now.into_iter().rev()) {
            let before = clause.holds_throughout.or(clause.holds);
            clause.holds_throughout = before.zip(now.holds).map(|(a, b)| a && b);
        }
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
    clauses.push(Clause::new(
        "vehicles are on the road".into(),
        Some(on_road),
    ));
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
