//! Assignment of ids.

use std::collections::BTreeSet;

use gump_scene::Seed;

use super::*;

/// Ids as `agent:id` in the order of ids.
fn check(identities: &Identities, expected: &str) {
    let found: Vec<String> = identities
        .iter()
        .map(|(id, agent)| format!("{agent}:{id}"))
        .collect();
    assert_eq!(found.join(" "), expected);
    for (id, agent) in identities.iter() {
        assert_eq!(
            (identities.key(agent), identities.agent(id)),
            (Some(id), Some(agent))
        );
    }
}

const SCENE: &str = "
    ego vehicle 0: 0,0
    agent bicycle 1: 1,0
    agent vehicle 8: 30,0
    agent vehicle 3: -20,0
    agent vehicle 2: 0,20
    agent other 40: 2,0
    agent pedestrian 5: 90,0";

/// A crowd of `n` vehicles; number `i` is `i` metres away.
fn crowd(n: usize) -> (Scenario, Pose) {
    let mut text = String::from("ego vehicle 0: 0,0\n");
    for i in 1..=n {
        text += &format!("agent vehicle {i}: {i},0\n");
    }
    scenario(&text)
}

#[test]
fn ranks_go_by_class_then_distance_then_agent() {
    let (scenario, pose) = scenario(SCENE);
    let frames = scenario.present().strided_history(5, 2);
    check(
        &Identities::ranked(&frames, EGO, pose),
        "0:0 2:1 3:2 8:3 5:4 1:5",
    );
}

#[test]
fn the_last_sight_of_an_agent_ranks_it() {
    let (scenario, pose) = scenario(
        "ego vehicle 0: 0,0
         agent vehicle 1: 30,0 velocity -20,0
         agent vehicle 2: 25,0",
    );
    let log = |i: usize| &scenario.log[i];
    check(
        &Identities::ranked(&[log(0), log(10)], EGO, pose),
        "0:0 2:1 1:2",
    );
    check(
        &Identities::ranked(&[log(10), log(20)], EGO, pose),
        "0:0 1:1 2:2",
    );
}

#[test]
fn of_too_many_agents_the_nearest_have_ids() {
    let (scenario, pose) = crowd(330);
    let frames = scenario.present().strided_history(5, 1);
    let identities = Identities::ranked(&frames, EGO, pose);
    assert_eq!(identities.iter().count(), 321);
    assert_eq!(identities.key(AgentId(320)), Some(320));
    assert_eq!(identities.key(AgentId(321)), None);
    let shuffled = Identities::shuffled(&frames, EGO, pose, &mut Seed(1).rng());
    assert_eq!(
        shuffled.key(AgentId(321)),
        None,
        "who has an id does not depend on chance"
    );
    assert_eq!(identities.clone().newborn(), None);
    assert_eq!(identities.clone().allocate(AgentId(321)), None);
}

#[test]
fn shuffled_ids_are_an_injection_that_the_seed_fixes() {
    let (scenario, pose) = crowd(20);
    let frames = scenario.present().strided_history(5, 1);
    let draw = |seed: u64| Identities::shuffled(&frames, EGO, pose, &mut Seed(seed).rng());
    assert_eq!(draw(3), draw(3));
    let mut used = BTreeSet::new();
    for seed in 0..200 {
        let identities = draw(seed);
        assert_eq!(identities.key(EGO), Some(0));
        assert_eq!(identities.iter().count(), 21);
        used.extend(identities.iter().map(|(id, _)| id));
    }
    assert_eq!(used, (0..=320).collect(), "every id is trained");
}

#[test]
fn an_id_is_never_handed_on_unless_freed() {
    let (scenario, pose) = scenario(SCENE);
    let frames = scenario.present().strided_history(5, 1);
    let mut identities = Identities::ranked(&frames, EGO, pose);
    // 41: above every agent of the scene, the cone included.
    assert_eq!(identities.newborn(), Some((6, AgentId(41))));
    assert_eq!(identities.newborn(), Some((7, AgentId(42))));
    assert_eq!(identities.allocate(AgentId(40)), Some(8));
    assert_eq!(
        identities.allocate(AgentId(2)),
        Some(1),
        "who has an id keeps it"
    );
    identities.retain(|id| id != 3 && id != 0);
    check(&identities, "0:0 2:1 3:2 5:4 1:5 41:6 42:7 40:8");
    // Where ids must ascend, the one that is free below is passed over.
    let later = identities.clone().newborn_after(4);
    assert_eq!(later, Some((9, AgentId(43))));
    assert_eq!(identities.newborn(), Some((3, AgentId(43))));
}
