//! Signal groups, conflicts and phases of every junction of a map, derived from its lanes and from
//! the observed states of its lights.

use std::collections::BTreeMap;

use gump_geometry::angle_difference;
use gump_scene::{Frame, LaneId, Light, LightState, MapGraph};

use super::movement::{Movement, Relation};
use super::timing::{Age, yellow_s};
use crate::notes::{Note, Notes};

/// The coordination of lights: which junctions there are, which of their lights show the same
/// colour, which are never green together, and the order of phases.
///
/// By construction no two lights of a phase conflict. Movements from roads that cross conflict if
/// their paths cross or join. A left turn from its own lane conflicts with the oncoming traffic
/// that it crosses, unless both were seen green together.
#[derive(Clone, Debug)]
pub struct SignalPlan {
    /// Every known light, by lane, in its present state; unknown if it is not observed.
    pub(super) lights: Vec<Light>,
    pub(super) movements: Vec<Option<Movement>>,
    pub(super) junctions: Vec<Junction>,
    contradictions: usize,
    ungrouped: usize,
}

#[derive(Clone, Debug)]
pub(super) struct Junction {
    pub(super) groups: Vec<Group>,
    /// At least two, in the order of their turns.
    pub(super) phases: Vec<Phase>,
    /// The present phase, and how far it has progressed.
    pub(super) phase: usize,
    pub(super) stage: Begun,
    /// Seconds of yellow.
    pub(super) yellow: f64,
}

/// Lights that always show the same colour.
#[derive(Clone, Debug)]
pub(super) struct Group {
    /// Indices of lights.
    pub(super) members: Vec<usize>,
    is_left_only: bool,
}

/// Groups that are green together; a phase without groups serves movements whose light is not
/// known.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Phase {
    pub(super) green: Vec<bool>,
    pub(super) is_left: bool,
}

/// Progress of the present phase.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Begun {
    Green(Age),
    Yellow,
    Red,
}

impl SignalPlan {
    /// From frames of a scene, `dt` seconds apart; the last one is the present.
    ///
    /// Lights of lanes that are not on the map never change.
    pub fn of(map: &MapGraph, frames: &[Frame], dt: f64) -> Self {
        let seen = Seen::new(frames, dt);
        let lights = &seen.lights;
        let of = |light: &Light| Some(Movement::of(map, map.lane(light.lane)?, light));
        let movements: Vec<Option<Movement>> = lights.iter().map(of).collect();
        let (mut contradictions, mut ungrouped) = (0, 0);
        let junctions = together(&movements)
            .into_iter()
            .map(|members| {
                let draft = Draft::new(&movements, &seen, &members);
                contradictions += draft.contradictions;
                ungrouped += draft.ungrouped;
                draft.junction()
            })
            .collect();
        Self {
            movements,
            junctions,
            contradictions,
            ungrouped,
            lights: seen.lights,
        }
    }

    /// Whether any lights alternate.
    pub fn is_empty(&self) -> bool {
        self.junctions.is_empty()
    }

    /// The junctions: for each, its signal groups, as lanes whose lights show the same.
    pub fn groups(&self) -> Vec<Vec<Vec<LaneId>>> {
        let lanes = |group: &Group| {
            let members = group.members.iter();
            members.map(|&light| self.lights[light].lane).collect()
        };
        let junctions = self.junctions.iter();
        junctions
            .map(|junction| junction.groups.iter().map(lanes).collect())
            .collect()
    }

    /// Pairs of lights that were seen green together although their traffic comes from crossing
    /// roads and meets behind them.
    pub fn contradictions(&self) -> usize {
        self.contradictions
    }

    /// What could not be derived from the lights and the map, as the notes of one scene.
    pub fn notes(&self) -> Notes {
        let unmapped = self.movements.iter().filter(|movement| movement.is_none());
        let mapped = self.movements.iter().flatten();
        let unconnected = mapped.filter(|movement| !movement.leads_on());
        let mut notes = Notes::default();
        notes.add(Note::UnmappedLight, unmapped.count());
        notes.add(Note::UnconnectedLight, unconnected.count());
        notes.add(Note::UngroupedLight, self.ungrouped);
        notes.add(Note::ContradictingLights, self.contradictions);
        notes
    }
}

/// Observed states of the lights.
struct Seen {
    lights: Vec<Light>,
    /// By light, then by frame.
    states: Vec<Vec<LightState>>,
    dt: f64,
}

impl Seen {
    fn new(frames: &[Frame], dt: f64) -> Self {
        let mut lights: BTreeMap<LaneId, Light> = BTreeMap::new();
        for light in frames.iter().flat_map(Frame::lights) {
            lights.insert(light.lane, *light);
        }
        let state = |frame: &Frame, lane: LaneId| {
            let light = frame.light(lane);
            light.map_or(LightState::Unknown, |light| light.state)
        };
        let states: Vec<Vec<LightState>> = lights
            .keys()
            .map(|&lane| frames.iter().map(|frame| state(frame, lane)).collect())
            .collect();
        let mut lights: Vec<Light> = lights.into_values().collect();
        for (light, states) in lights.iter_mut().zip(&states) {
            light.state = states.last().copied().unwrap_or(LightState::Unknown);
        }
        Self { lights, states, dt }
    }

    fn now(&self, light: usize) -> LightState {
        self.lights[light].state
    }

    /// Whether two lights never showed different colours.
    fn agree(&self, a: usize, b: usize) -> bool {
        let mut pairs = self.states[a].iter().zip(&self.states[b]);
        let unknown = LightState::Unknown;
        pairs.all(|(a, b)| a == b || *a == unknown || *b == unknown)
    }

    fn green_together(&self, a: usize, b: usize) -> bool {
        let mut pairs = self.states[a].iter().zip(&self.states[b]);
        pairs.any(|pair| pair == (&LightState::Green, &LightState::Green))
    }

    /// Returns the time that a light has been in its present state.
    fn age(&self, light: usize) -> Age {
        let states = &self.states[light];
        let now = self.now(light);
        let shown = states
            .iter()
            .rev()
            .take_while(|state| **state == now)
            .count();
        let age = shown.saturating_sub(1) as f64 * self.dt;
        match states.iter().rev().nth(shown) {
            Some(before) if *before != LightState::Unknown => Age::Exactly(age),
            _ => Age::AtLeast(age),
        }
    }
}

/// The lights of each junction, by index.
fn together(movements: &[Option<Movement>]) -> Vec<Vec<usize>> {
    let n = movements.len();
    let mut root: Vec<usize> = (0..n).collect();
    for i in 0..n {
        for j in 0..i {
            let (Some(a), Some(b)) = (&movements[i], &movements[j]) else {
                continue;
            };
            if root[i] != root[j] && a.shares_junction(b) {
                let (from, to) = (root[i].max(root[j]), root[i].min(root[j]));
                root.iter_mut()
                    .filter(|r| **r == from)
                    .for_each(|r| *r = to);
            }
        }
    }
    let mut junctions: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (i, movement) in movements.iter().enumerate() {
        if movement.is_some() {
            junctions.entry(root[i]).or_default().push(i);
        }
    }
    junctions.into_values().collect()
}

/// A junction under construction.
struct Draft<'a> {
    movements: Vec<&'a Movement>,
    seen: &'a Seen,
    /// Index of the light of each movement.
    lights: &'a [usize],
    groups: Vec<Group>,
    /// Pairs of groups that must not be green together, row by row.
    conflicts: Vec<Vec<bool>>,
    contradictions: usize,
    /// Number of lights that form another group than an earlier one of their approach, because they
    /// showed another colour.
    ungrouped: usize,
}

impl<'a> Draft<'a> {
    fn new(all: &'a [Option<Movement>], seen: &'a Seen, lights: &'a [usize]) -> Self {
        let movements = lights.iter().filter_map(|&light| all[light].as_ref());
        let mut this = Self {
            movements: movements.collect(),
            seen,
            lights,
            groups: Vec::new(),
            conflicts: Vec::new(),
            contradictions: 0,
            ungrouped: 0,
        };
        this.find_groups();
        this.find_conflicts();
        this
    }

    /// A group's movements, as indices of this junction's.
    fn within(&self, group: &Group) -> Vec<usize> {
        let lights = self.lights;
        let at = |light: &usize| lights.iter().position(|known| known == light);
        group.members.iter().filter_map(at).collect()
    }

    fn find_groups(&mut self) {
        for (i, &light) in self.lights.iter().enumerate() {
            let own = self.movements[i];
            let is_beside = |group: &Group| {
                let mut members = self.within(group).into_iter();
                group.is_left_only == own.is_left_only
                    && members.all(|j| own.shares_approach(self.movements[j]))
            };
            let fits = |group: &Group| {
                let mut members = group.members.iter();
                is_beside(group) && members.all(|&other| self.seen.agree(light, other))
            };
            match self.groups.iter().position(fits) {
                Some(group) => self.groups[group].members.push(light),
                None => {
                    self.ungrouped += usize::from(self.groups.iter().any(is_beside));
                    self.groups.push(Group {
                        members: vec![light],
                        is_left_only: own.is_left_only,
                    });
                }
            }
        }
    }

    fn find_conflicts(&mut self) {
        let n = self.groups.len();
        let inside: Vec<Vec<usize>> = self.groups.iter().map(|g| self.within(g)).collect();
        let mut conflicts = vec![vec![false; n]; n];
        for g in 0..n {
            for h in 0..g {
                let pairs = inside[g]
                    .iter()
                    .flat_map(|&i| inside[h].iter().map(move |&j| (i, j)));
                let mut meets = false;
                let (mut opposes, mut goes_together) = (false, false);
                for (i, j) in pairs {
                    let both = self.seen.green_together(self.lights[i], self.lights[j]);
                    goes_together |= both;
                    match self.movements[i].relation(self.movements[j]) {
                        Relation::Across => {
                            meets = true;
                            self.contradictions += usize::from(both);
                        }
                        Relation::Opposing => opposes = true,
                        Relation::Free => {}
                    }
                }
                let is_left = self.groups[g].is_left_only != self.groups[h].is_left_only;
                let conflict = meets || (opposes && is_left && !goes_together);
                conflicts[g][h] = conflict;
                conflicts[h][g] = conflict;
            }
        }
        self.conflicts = conflicts;
    }

    /// The present state of a group: that of most of its known lights.
    fn now(&self, group: usize) -> LightState {
        let members = &self.groups[group].members;
        let count = |state| {
            members
                .iter()
                .filter(|&&i| self.seen.now(i) == state)
                .count()
        };
        let known = [LightState::Green, LightState::Yellow, LightState::Red];
        let most = known.into_iter().rev().max_by_key(|state| count(*state));
        most.filter(|state| count(*state) > 0)
            .unwrap_or(LightState::Unknown)
    }

    /// Adds groups to `set` that conflict with none in it, in this order.
    fn fill(&self, set: &mut Vec<usize>, candidates: impl Iterator<Item = usize>) {
        for group in candidates {
            let is_free = set.iter().all(|&other| !self.conflicts[group][other]);
            if is_free && !set.contains(&group) {
                set.push(group);
            }
        }
    }

    fn phase(&self, set: &[usize]) -> Phase {
        let n = self.groups.len();
        Phase {
            green: (0..n).map(|group| set.contains(&group)).collect(),
            is_left: !set.is_empty() && set.iter().all(|&g| self.groups[g].is_left_only),
        }
    }

    fn heading(&self, group: usize) -> f64 {
        self.movements[self.within(&self.groups[group])[0]]
            .line
            .heading
    }

    /// Whether two groups use the same road, from either end.
    fn shares_road(&self, a: usize, b: usize) -> bool {
        let between = angle_difference(self.heading(a), self.heading(b)).abs();
        !(std::f64::consts::FRAC_PI_4..=3.0 * std::f64::consts::FRAC_PI_4).contains(&between)
    }

    fn junction(self) -> Junction {
        let n = self.groups.len();
        let shows = |group: usize, state| self.now(group) == state;
        let mut open = Vec::new();
        self.fill(&mut open, (0..n).filter(|&g| shows(g, LightState::Green)));
        // Yellow beside green is the end of another phase, which fades.
        let is_yellow = open.is_empty() && (0..n).any(|g| shows(g, LightState::Yellow));
        if is_yellow {
            self.fill(&mut open, (0..n).filter(|&g| shows(g, LightState::Yellow)));
        }
        let lit = open.clone();
        if !open.is_empty() {
            // Whose lights are not seen goes with the road that is open.
            let along = |&g: &usize| lit.iter().any(|&other| self.shares_road(g, other));
            let unseen = (0..n).filter(|&g| shows(g, LightState::Unknown));
            self.fill(&mut open, unseen.filter(along));
        }
        let mut phases = vec![self.phase(&open)];
        let mut left: Vec<usize> = (0..n).filter(|g| !open.contains(g)).collect();
        // Other roads first, then this one; left turns before the rest of their road.
        left.sort_by_key(|&g| {
            let own_road = lit.iter().any(|&other| self.shares_road(g, other));
            (own_road, !self.groups[g].is_left_only)
        });
        while let Some(&first) = left.first() {
            let mut set = vec![first];
            let is_like = |&g: &usize| {
                self.groups[g].is_left_only == self.groups[first].is_left_only
                    && self.shares_road(g, first)
            };
            self.fill(&mut set, left.iter().copied().filter(is_like));
            self.fill(&mut set, left.iter().copied());
            left.retain(|g| !set.contains(g));
            phases.push(self.phase(&set));
        }
        let is_shut = phases[0].green.iter().all(|green| !green);
        // Red for a moment only is between two phases; for longer, another road has green, unless
        // the lights of all roads are seen.
        let just_now = self.lights.iter().any(|&light| {
            let age = self.seen.age(light);
            matches!(age, Age::Exactly(age) if age < super::timing::CLEARANCE_S)
        });
        let crosses = |g: usize, h: usize| self.conflicts[g][h] && !self.shares_road(g, h);
        let all_seen = (0..n).all(|g| !shows(g, LightState::Unknown))
            && (0..n).any(|g| (0..g).any(|h| crosses(g, h)));
        let is_known = (0..n).any(|g| !shows(g, LightState::Unknown));
        let is_between = is_shut && (just_now || all_seen || !is_known) && phases.len() > 1;
        if is_between {
            phases.remove(0);
        }
        let stage = if is_yellow {
            Begun::Yellow
        } else if is_between && is_known {
            Begun::Red
        } else {
            let green = (0..n).filter(|&g| phases[0].green[g] || is_shut);
            let members = green.flat_map(|g| &self.groups[g].members);
            let known = members.filter(|&&l| self.seen.now(l) != LightState::Unknown);
            let age = known.map(|&light| self.seen.age(light)).min_by(|a, b| {
                let number = |age: &Age| match *age {
                    Age::Exactly(age) | Age::AtLeast(age) => age,
                };
                number(a).total_cmp(&number(b))
            });
            Begun::Green(age.unwrap_or(Age::AtLeast(0.0)))
        };
        if phases.len() == 1 {
            // Others, on the cross street or on foot, have no known light.
            phases.push(self.phase(&[]));
        }
        let limits = self.movements.iter().map(|movement| movement.limit);
        Junction {
            yellow: yellow_s(limits.fold(0.0, f64::max)),
            groups: self.groups,
            // Between two phases the next one is the first.
            phase: match stage {
                Begun::Red => phases.len() - 1,
                _ => 0,
            },
            phases,
            stage,
        }
    }
}
