//! Differences between two candidates, in words.

use gump_planner::{CandidateEvaluation, Decision, ProposalKind};
use gump_scene::{Agent, Rollout};

use super::{Deed, deed};
use crate::table::decimal;

// Chosen by hand, so that sentences tell differences that a reader would see.
/// Ends nearer than this are the same place, metres.
const SAME_PLACE: f64 = 2.0;
/// Parts of a score that differ by less are equal.
const SAME_PART: f64 = 0.005;
/// Closest distances to an agent that differ by less count as equal, metres.
const SAME_GAP: f64 = 1.0;
/// Maximum number of differences to list.
const MOST_DIFFERENCES: usize = 3;

/// The best candidate that was not chosen and is not the same drive under another name: one that
/// ends more than 2 m from the chosen one, or that is worth something else.
pub(super) fn best_alternative(decision: &Decision) -> Option<usize> {
    let chosen = &decision.candidates[decision.chosen];
    let differs = |evaluation: &CandidateEvaluation| match (end(evaluation), end(chosen)) {
        (Some(a), Some(b)) => a.distance(b) > SAME_PLACE,
        _ => (evaluation.value - chosen.value).abs() > SAME_PART,
    };
    let others = (0..decision.candidates.len()).filter(|&i| i != decision.chosen);
    let different = others.filter(|&i| differs(&decision.candidates[i]));
    different.max_by(|&a, &b| {
        let (a, b) = (&decision.candidates[a], &decision.candidates[b]);
        // Values of fewer futures do not compare.
        let futures = a.futures.len().cmp(&b.futures.len());
        futures.then(a.value.total_cmp(&b.value))
    })
}

/// The candidate of the ordinary driver: the Intelligent Driver Model at the speed limit in the
/// middle of the lane.
pub(super) fn ordinary(decision: &Decision) -> Option<usize> {
    decision.candidates.iter().position(|evaluation| {
        matches!(
            evaluation.kind,
            ProposalKind::Idm { speed_fraction, lateral_offset }
                if speed_fraction == 1.0 && lateral_offset == 0.0
        )
    })
}

/// Weight of a decision: the margin of the chosen candidate over the ordinary driver, plus a tenth
/// of its margin over the best alternative with another path. The tenth is chosen by hand.
pub(crate) fn weight(decision: &Decision) -> f64 {
    let chosen = decision.candidates[decision.chosen].value;
    let margin = |other: Option<usize>| {
        other.map_or(0.0, |i| (chosen - decision.candidates[i].value).max(0.0))
    };
    margin(ordinary(decision)) + 0.1 * margin(best_alternative(decision))
}

fn end(evaluation: &CandidateEvaluation) -> Option<gump_geometry::DVec2> {
    let last = evaluation.drives.first()?.last()?;
    Some(last.rear_axle.position)
}

/// Sentences on why `chosen` is worth more than `other`, the weightiest first. `near` are agents to
/// look at.
pub(super) fn between(
    chosen: &CandidateEvaluation,
    other: &CandidateEvaluation,
    near: &[&Agent],
) -> Vec<String> {
    let mut sentences = Vec::new();
    let (mine, theirs) = (chosen.collisions, other.collisions);
    if mine != theirs {
        sentences.push(format!(
            "With \"{}\" the ego is at fault in a collision in {theirs} of {} futures, with \"{}\" \
             in {mine} of {}.",
            other.kind,
            other.futures.len(),
            chosen.kind,
            chosen.futures.len(),
        ));
    }
    let parts = differing_parts(chosen, other);
    if !parts.is_empty() {
        sentences.push(format!("Of the score's parts, {}.", parts.join("; ")));
    }
    if let (Some(mine), Some(theirs)) = (&chosen.hedge, &other.hedge)
        && (mine.total - theirs.total).abs() > SAME_PART
    {
        sentences.push(format!(
            "Where the others keep their velocity, it scores {:.2} instead of {:.2}.",
            mine.total, theirs.total
        ));
    }
    let (mine, theirs) = (chosen.progress_m, other.progress_m);
    if (mine - theirs).abs() > SAME_GAP {
        sentences.push(format!(
            "It drives {} m along the way, the other {} m.",
            decimal(mine),
            decimal(theirs)
        ));
    }
    sentences.extend(approaches(chosen, other, near));
    if sentences.is_empty() {
        sentences.push("Nothing: both have the same score, and ties go to more progress.".into());
    }
    sentences
}

/// The parts that differ, those by most first.
fn differing_parts(chosen: &CandidateEvaluation, other: &CandidateEvaluation) -> Vec<String> {
    let pairs = chosen.score.parts().into_iter().zip(other.score.parts());
    let mut parts: Vec<(&str, f64, f64)> = pairs
        .map(|((name, mine), (_, theirs))| (name, mine, theirs))
        .filter(|(_, mine, theirs)| (mine - theirs).abs() > SAME_PART)
        .collect();
    let by = |part: &(&str, f64, f64)| (part.1 - part.2).abs();
    parts.sort_by(|a, b| by(b).total_cmp(&by(a)));
    let sentence = |(name, mine, theirs): &(&str, f64, f64)| {
        format!("{} is {mine:.2} instead of {theirs:.2}", words(name))
    };
    parts.iter().take(MOST_DIFFERENCES).map(sentence).collect()
}

/// Agents to which the ego comes much closer with one than with the other.
fn approaches(
    chosen: &CandidateEvaluation,
    other: &CandidateEvaluation,
    near: &[&Agent],
) -> Vec<String> {
    let closest = |evaluation: &CandidateEvaluation, agent: &Agent| {
        let deeds = evaluation
            .futures
            .iter()
            .filter_map(|f: &Rollout| deed(f, agent));
        let gaps = deeds.map(|deed: Deed| deed.closest);
        gaps.fold(f64::INFINITY, f64::min)
    };
    let mut sentences: Vec<(f64, String)> = Vec::new();
    for agent in near {
        let (mine, theirs) = (closest(chosen, agent), closest(other, agent));
        // Centres of cars that touch are at most 5 m apart; what is far from both decides nothing.
        if (mine - theirs).abs() > SAME_GAP && mine.min(theirs) < 12.0 {
            sentences.push((
                mine.min(theirs),
                format!(
                    "{} {} comes within {mine:.1} m of the ego, with the other within {theirs:.1} m \
                     (between centres).",
                    capital(agent.kind.name()),
                    agent.id,
                ),
            ));
        }
    }
    sentences.sort_by(|a, b| a.0.total_cmp(&b.0));
    sentences
        .into_iter()
        .take(2)
        .map(|(_, text)| text)
        .collect()
}

/// A part's name as a column of a table.
pub(super) fn short(name: &str) -> String {
    match name {
        "no_at_fault_collisions" => "no collision".into(),
        "drivable_area" => "on the road".into(),
        "driving_direction" => "direction".into(),
        "time_to_collision" => "TTC".into(),
        other => words(other),
    }
}

/// A part's name as words.
pub(super) fn words(name: &str) -> String {
    name.replace('_', " ")
}

fn capital(word: &str) -> String {
    let mut characters = word.chars();
    characters.next().map_or_else(String::new, |first| {
        first.to_uppercase().chain(characters).collect()
    })
}
