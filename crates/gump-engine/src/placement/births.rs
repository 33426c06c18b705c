//! New agents: keys and departures decided from the network's logits of the successor of a token.

use std::collections::BTreeSet;

use gump_model::decoder::CONTROL_KEYS;
use gump_scene::{AgentKind, Seed};
use gump_tokenizer::{AGENT_KEYS, Key, class_index};

use crate::cpu::Successor;
use crate::nucleus::uniform;

/// Index of BEGIN among the control logits, after the keys; NEWBORN follows.
pub(crate) const BEGIN_AT: usize = CONTROL_KEYS;
/// Index of NEWBORN among the control logits.
pub const NEWBORN_AT: usize = CONTROL_KEYS + 1;

/// Draws the key of a new agent, or `None` for no further one.
///
/// `stop` is the mark that ends the list, `used` the ids in use, `last` the previous key in the
/// list. Classes ascend within a list, and ids within a class, which limits the keys that may
/// follow. The odds of a further agent are multiplied by `pace`.
pub fn next_key(
    successor: &Successor,
    stop: usize,
    used: &BTreeSet<u16>,
    last: Option<Key>,
    seed: Seed,
    pace: f64,
) -> Option<Key> {
    let peak = successor.control.iter().copied().fold(f32::MIN, f32::max);
    let weight = |i: usize| f64::from((successor.control[i] - peak).exp());
    let free = AGENT_KEYS
        .map(|id| id as u16)
        .filter(|id| !used.contains(id));
    let fresh: f64 = pace * free.map(|id| weight(usize::from(id))).sum::<f64>();
    if uniform(seed.fork(0)) * (fresh + weight(stop)) < weight(stop) {
        return None;
    }
    let keys: Vec<Vec<Key>> = AgentKind::MOVING
        .into_iter()
        .map(|kind| keys_of(kind, used, last))
        .collect();
    let class = |kind: AgentKind| {
        let logit = successor.classes[class_index(kind)];
        let is_open = !keys[class_index(kind)].is_empty();
        if is_open { f64::from(logit).exp() } else { 0.0 }
    };
    let weights: Vec<f64> = AgentKind::MOVING.into_iter().map(class).collect();
    let keys = &keys[pick(&weights, uniform(seed.fork(1)))?];
    let weights: Vec<f64> = keys.iter().map(|key| weight(usize::from(key.id))).collect();
    // All of them may be so unlikely that none has a weight; then any will do.
    let found = pick(&weights, uniform(seed.fork(2))).unwrap_or(0);
    Some(keys[found])
}

/// The keys of a class that may follow `last`.
fn keys_of(kind: AgentKind, used: &BTreeSet<u16>, last: Option<Key>) -> Vec<Key> {
    let keys = AGENT_KEYS.map(|id| Key {
        id: id as u16,
        kind,
    });
    keys.filter(|key| !used.contains(&key.id) && last.is_none_or(|last| last < *key))
        .collect()
}

/// The probability that an agent is still present, from the logits before its key: those of its own
/// key, of the later tracked agents and of the end of their list.
pub(crate) fn stays(successor: &Successor, id: u16, later: &[u16]) -> f64 {
    let weight = |i: usize| f64::from(successor.control[i]);
    let others = later.iter().map(|id| weight(usize::from(*id)));
    let others = others.chain([weight(NEWBORN_AT)]);
    let own = weight(usize::from(id));
    1.0 / (1.0 + others.map(|other| (other - own).exp()).sum::<f64>())
}

/// The index at which the sum of weights exceeds `uniform` of their total; `None` if that is 0.
pub(crate) fn pick(weights: &[f64], uniform: f64) -> Option<usize> {
    let total: f64 = weights.iter().sum();
    let mut left = uniform * total;
    let last = weights.iter().rposition(|weight| *weight > 0.0)?;
    let found = weights.iter().position(|weight| {
        left -= weight;
        left < 0.0
    });
    Some(found.unwrap_or(last))
}

#[cfg(test)]
mod tests {
    use gump_model::decoder::N_LIGHT_STATES;

    use super::*;

    fn successor(likely: &[(usize, f32)]) -> Successor {
        let mut control = vec![-30.0; CONTROL_KEYS + 3];
        for (i, logit) in likely {
            control[*i] = *logit;
        }
        Successor {
            control,
            lights: [0.0; N_LIGHT_STATES],
            classes: [0.0, 0.0, -30.0],
        }
    }

    fn vehicle(id: u16) -> Key {
        Key {
            id,
            kind: AgentKind::Vehicle,
        }
    }

    #[test]
    fn the_end_and_new_keys_have_their_shares() {
        let successor = successor(&[(BEGIN_AT, 0.0), (7, 3f32.ln())]);
        let none = BTreeSet::new();
        let draw = |pace: f64| -> Vec<Option<Key>> {
            let seeds = (0..4000).map(Seed);
            seeds
                .map(|seed| next_key(&successor, BEGIN_AT, &none, None, seed, pace))
                .collect()
        };
        let drawn = draw(1.0);
        let n = |f: &dyn Fn(&Key) -> bool| drawn.iter().flatten().filter(|k| f(k)).count() as i64;
        // Three quarters come, half of them on foot; standard deviations are below 32.
        assert!((n(&|k| k.id == 7) - 3000).abs() < 130);
        assert!((n(&|k| k.kind == AgentKind::Pedestrian) - 1500).abs() < 130);
        assert_eq!(n(&|k| k.kind == AgentKind::Bicycle), 0);
        // At a third of the odds of three to one, one half comes.
        let slow = draw(1.0 / 3.0).iter().flatten().count() as i64;
        assert!((slow - 2000).abs() < 130, "{slow}");
        assert_eq!(draw(0.0).iter().flatten().count(), 0);
    }

    #[test]
    fn lists_ascend_and_ids_are_used_once() {
        let successor = successor(&[(7, 5.0), (3, 5.0), (9, 0.0)]);
        let used = BTreeSet::from([7]);
        for i in 0..200 {
            let key =
                next_key(&successor, BEGIN_AT, &used, Some(vehicle(5)), Seed(i), 1.0).unwrap();
            assert!(vehicle(5) < key && key.id != 7, "{key}");
        }
    }

    #[test]
    fn who_is_skipped_has_left() {
        let successor = successor(&[(4, 0.0), (6, 3f32.ln())]);
        assert!((stays(&successor, 4, &[6]) - 0.25).abs() < 1e-6);
        assert!(stays(&successor, 6, &[]) > 0.999);
    }
}
