//! Whether a scene is what was asked for, clause by clause.

use std::fmt;

use gump_metrics::{Metric as _, OffRoad, overlapping, tags};
use gump_scene::{AgentKind, Scenario, ScenarioTag};

use crate::Counts;

/// One thing that was asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct Clause {
    /// In words.
    pub clause: String,
    /// Whether it holds; `None` if states and maps do not tell.
    pub holds: Option<bool>,
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

/// The verdict on the present of a scenario: every prompt, every count, no overlap, nobody off the
/// road.
///
/// Prompts about what is beginning are decided by the frames after the present.
pub fn verdict(
    scenario: &Scenario,
    prompts: &[ScenarioTag],
    counts: Option<&Counts>,
) -> Vec<Clause> {
    let mut clauses: Vec<Clause> = prompts
        .iter()
        .map(|tag| Clause {
            clause: tag.name().into(),
            holds: tags::holds(*tag, scenario),
        })
        .collect();
    let present = scenario.present();
    for kind in AgentKind::MOVING {
        let Some(asked) = counts.map(|counts| counts.of(kind)) else {
            continue;
        };
        let agents = present.now().agents().iter();
        let found = agents.filter(|agent| agent.kind == kind && agent.id != scenario.ego);
        clauses.push(Clause {
            clause: format!("{} {asked}", kind.name()),
            holds: Some(found.count() == asked),
        });
    }
    clauses.push(Clause {
        clause: "nobody overlaps".into(),
        holds: Some(overlaps(scenario) == 0),
    });
    clauses.push(Clause {
        clause: "vehicles are on the road".into(),
        holds: Some(off_road(scenario) == 0),
    });
    clauses
}

/// How many agents overlap another at the present.
pub fn overlaps(scenario: &Scenario) -> usize {
    let present = scenario.present();
    let frame = present.now();
    let hit = |agent: &&gump_scene::Agent| overlapping(frame, agent).next().is_some();
    frame.agents().iter().filter(hit).count()
}

/// How many vehicles have a corner off the road at the present.
pub fn off_road(scenario: &Scenario) -> usize {
    let present = scenario.present();
    let off = |agent: &&gump_scene::Agent| OffRoad.at(&present, agent) == Some(1.0);
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
        let clauses = verdict(&scenario, &prompts, Some(&counts));
        let holds: Vec<_> = clauses.iter().map(|clause| clause.holds).collect();
        let (yes, no) = (Some(true), Some(false));
        assert_eq!(holds, [yes, no, None, yes, no, yes, no, no]);
        assert_eq!((overlaps(&scenario), off_road(&scenario)), (2, 2));
    }
}
