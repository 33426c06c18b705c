//! Rules over the network's draws: what would run into somebody or off the road is drawn again, and
//! what no vehicle can do is held back.
//!
//! They are those of the sequence network (`rejection`, `kinematic_limits`). That says three poses at
//! once; here
//! the second half of what is looked at, a second, goes on as the move that was drawn.

use gump_geometry::Pose;
use gump_model::local_context::Survey;
use gump_model::relative::graph::Shown;
use gump_model::steps::TOKEN_DT;
use gump_scene::{AgentKind, AgentState};

use crate::kinematic_limits::Limits;
use crate::rejection::{BRAKING, Footprints, Member, POSES, Way, way};

/// Slower than this nobody brakes, metres per second.
const CREEPING: f64 = 0.5;

/// Draws the moves of agents, given by number, anew for an attempt.
pub(super) type Again<'a> = dyn FnMut(&[usize], usize) -> Vec<Pose> + 'a;

/// What is held back of a move, told in the frame of the agent that makes it.
pub(super) fn held_back(now: &Shown, step: Pose) -> Pose {
    let Some(limits) = Limits::of(now.body.kind) else {
        return step;
    };
    let said = AgentState {
        pose: now.pose * step,
        velocity: step.position / TOKEN_DT,
    };
    let kept = limits.keep(now.pose, said).pose;
    if kept == said.pose {
        return step;
    }
    now.pose.inverse() * kept
}

/// Replaces moves that are not clear, up to `redraws` times each; who finds no clear way brakes.
pub fn settle(
    agents: &[Shown],
    driven: Option<usize>,
    survey: &Survey,
    redraws: usize,
    moves: &mut [Pose],
    again: &mut Again<'_>,
) {
    let members = agents
        .iter()
        .zip(&*moves)
        .enumerate()
        .map(|(i, (now, step))| {
            let mut member = Member::new(
                [now.body.length, now.body.width],
                Some(now.pose),
                now.velocity().length(),
                ahead(now.pose, *step),
                driven == Some(i),
            );
            if now.body.kind == AgentKind::Vehicle && driven != Some(i) {
                member.look_for_edges(survey);
            }
            member
        });
    let mut crowd = Footprints::new(members.collect());
    for attempt in 0..redraws {
        let unclear = crowd.unclear(0);
        if unclear.is_empty() {
            return;
        }
        for (&i, step) in unclear.iter().zip(again(&unclear, attempt)) {
            if crowd.improve(i, &ahead(agents[i].pose, step)) {
                moves[i] = step;
            }
        }
    }
    for i in crowd.unclear(0) {
        let Some((step, way)) = braking(&agents[i], moves[i]) else {
            continue;
        };
        if crowd.improve(i, &way) {
            moves[i] = step;
        }
    }
}

/// The way of who goes on as in the next half second.
fn ahead(from: Pose, step: Pose) -> Way {
    let mut at = from;
    let poses: [Pose; POSES] = std::array::from_fn(|_| {
        at = at * step;
        at
    });
    way(Some(from), poses)
}

/// The move of who brakes on its way, and that way.
fn braking(now: &Shown, step: Pose) -> Option<(Pose, Way)> {
    let (speed, length) = (now.velocity().length(), step.position.length());
    if speed < CREEPING || length < 1e-6 {
        return None;
    }
    let stop = speed / BRAKING;
    let metres = |t: f64| {
        let t = t.min(stop);
        speed * t - 0.5 * BRAKING * t * t
    };
    // Along the arc of the move: so many moves, and a part of one.
    let along = |metres: f64| {
        let moves = metres / length;
        let whole = (0..moves as usize).fold(Pose::IDENTITY, |at, _| at * step);
        whole * Pose::IDENTITY.interpolate(step, moves.fract())
    };
    let poses: [Pose; POSES] =
        std::array::from_fn(|i| now.pose * along(metres(TOKEN_DT * (i + 1) as f64)));
    Some((along(metres(TOKEN_DT)), way(Some(now.pose), poses)))
}

#[cfg(test)]
mod tests {
    use gump_geometry::DVec2;
    use gump_model::relative::graph::Body;

    use super::*;

    fn car(x: f64, step: f64) -> Shown {
        let body = Body {
            kind: AgentKind::Vehicle,
            length: 4.0,
            width: 2.0,
            sized: true,
        };
        Shown::first(
            body,
            Pose::new(x - step, 0.0, 0.0),
            DVec2::new(2.0 * step, 0.0),
        )
        .then(Pose::new(x, 0.0, 0.0))
    }

    fn straight(step: f64) -> Pose {
        Pose::new(step, 0.0, 0.0)
    }

    #[test]
    fn who_would_run_into_another_is_drawn_again() {
        let agents = [car(0.0, 4.0), car(9.0, 0.0)];
        let mut moves = [straight(4.0), Pose::IDENTITY];
        let mut asked = Vec::new();
        let survey = Survey::default();
        settle(
            &agents,
            None,
            &survey,
            4,
            &mut moves,
            &mut |who, attempt| {
                asked.push((who.to_vec(), attempt));
                who.iter()
                    .map(|_| straight([4.5, 1.0][attempt.min(1)]))
                    .collect()
            },
        );
        assert_eq!(asked, [(vec![0], 0), (vec![0], 1)]);
        assert_eq!(moves, [straight(1.0), Pose::IDENTITY]);
    }

    #[test]
    fn who_finds_no_way_brakes_and_the_driven_are_left_alone() {
        let agents = [car(0.0, 4.0), car(9.0, 0.0)];
        let survey = Survey::default();
        let settled = |driven| {
            let mut moves = [straight(4.0), Pose::IDENTITY];
            settle(&agents, driven, &survey, 2, &mut moves, &mut |who, _| {
                who.iter().map(|_| straight(4.0)).collect()
            });
            moves
        };
        // 8 m/s, braking at 5 m/s² for half a second.
        let braked = settled(None)[0].position.x;
        assert!((braked - 3.375).abs() < 1e-9, "{braked}");
        assert_eq!(settled(Some(0))[0], straight(4.0));
    }

    #[test]
    fn nobody_slips_sideways_or_turns_on_the_spot() {
        let kept = held_back(&car(0.0, 1.0), Pose::new(1.0, 2.0, 1.0));
        assert!(kept.position.y < 0.5 && kept.heading < 0.3, "{kept:?}");
        let fine = Pose::new(4.0, 0.1, 0.05);
        assert_eq!(held_back(&car(0.0, 4.0), fine), fine);
    }
}
