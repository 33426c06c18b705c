//! What a scene lacks for lights, arrivals and departures, counted.

use std::collections::BTreeMap;

use gump_scene::{Frame, SceneState};

use crate::gates::leads_anywhere;
use crate::living::{LightControl, LivingConfig};
use crate::signals::SignalPlan;

/// A property of a map or of observed lights that leaves lights, arrivals or departures undefined.
/// Simulations go on, as its [meaning](Note::meaning) says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Note {
    /// A light is on a lane that the map does not have.
    UnmappedLight,
    /// A light is at the end of a lane that leads nowhere.
    UnconnectedLight,
    /// A light showed another colour than the others of its approach.
    UngroupedLight,
    /// Two lights whose traffic crosses were green together.
    ContradictingLights,
    /// No lane begins in the window of arrivals or leads into it.
    NoEntry,
}

impl Note {
    /// All, in the order of reports.
    pub const ALL: [Self; 5] = [
        Self::UnmappedLight,
        Self::UnconnectedLight,
        Self::UngroupedLight,
        Self::ContradictingLights,
        Self::NoEntry,
    ];

    /// Name in reports, `snake_case`.
    pub fn name(self) -> &'static str {
        match self {
            Self::UnmappedLight => "unmapped_light",
            Self::UnconnectedLight => "unconnected_light",
            Self::UngroupedLight => "ungrouped_light",
            Self::ContradictingLights => "contradicting_lights",
            Self::NoEntry => "no_entry",
        }
    }

    /// The note with this name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|note| note.name() == name)
    }

    /// What is counted, and how simulations go on.
    pub fn meaning(self) -> &'static str {
        match self {
            Self::UnmappedLight => {
                "lights of lanes that the map does not have: they keep their colour"
            }
            Self::UnconnectedLight => {
                "lights at the end of lanes that lead nowhere: they take turns, but conflict with no \
                 other light, because the paths behind them are not known"
            }
            Self::UngroupedLight => {
                "lights that showed another colour than the others of their approach: they are not \
                 in one signal group"
            }
            Self::ContradictingLights => {
                "pairs of lights that were green together although their traffic crosses: only \
                 recorded lights are shown so"
            }
            Self::NoEntry => {
                "scenes in which no lane begins in the window of arrivals or leads into it: no agent \
                 enters or leaves"
            }
        }
    }
}

/// Number of cases of each note, and of the scenes with any.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Notes(BTreeMap<Note, NoteCount>);

/// How often a note applies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NoteCount {
    /// Number of lights, pairs of lights, or scenes.
    pub cases: usize,
    /// Number of scenes with at least one.
    pub scenes: usize,
}

impl Notes {
    /// The notes of one scene.
    pub(crate) fn of(config: &LivingConfig, scene: &SceneState<'_>) -> Self {
        let mut notes = match &config.lights {
            LightControl::Hold => Self::default(),
            LightControl::Signals => SignalPlan::of(scene.map, scene.history, scene.dt).notes(),
            // Recorded lights need no plan, but may contradict one another at any time.
            LightControl::Recorded(lights) => {
                let shown = lights
                    .frames()
                    .map(|lights| Frame::new(Vec::new(), lights.to_vec()));
                let frames: Vec<Frame> = scene.history.iter().cloned().chain(shown).collect();
                let plan = SignalPlan::of(scene.map, &frames, scene.dt);
                let mut notes = Self::default();
                notes.add(Note::ContradictingLights, plan.contradictions());
                notes
            }
        };
        let is_closed = |arrivals| !leads_anywhere(arrivals, *scene);
        let closed = config.arrivals.as_ref().is_some_and(is_closed);
        notes.add(Note::NoEntry, usize::from(closed));
        notes
    }

    /// Adds the cases of one scene; none change nothing.
    pub fn add(&mut self, note: Note, cases: usize) {
        if cases > 0 {
            let count = self.0.entry(note).or_default();
            count.cases += cases;
            count.scenes += 1;
        }
    }

    /// Adds the notes of other scenes.
    pub fn merge(&mut self, other: &Self) {
        for (note, count) in other.iter() {
            let sum = self.0.entry(note).or_default();
            sum.cases += count.cases;
            sum.scenes += count.scenes;
        }
    }

    /// The notes that apply, in the order of reports.
    pub fn iter(&self) -> impl Iterator<Item = (Note, NoteCount)> + '_ {
        self.0.iter().map(|(&note, &count)| (note, count))
    }

    /// Number of cases of a note.
    pub fn cases(&self, note: Note) -> usize {
        self.0.get(&note).map_or(0, |count| count.cases)
    }

    /// Whether no note applies.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_read_as_they_are_written_and_counts_add_up() {
        for note in Note::ALL {
            assert_eq!(Note::of_name(note.name()), Some(note));
        }
        assert_eq!(Note::of_name("fog"), None);
        let mut one = Notes::default();
        one.add(Note::NoEntry, 0);
        assert!(one.is_empty());
        one.add(Note::UnmappedLight, 3);
        let mut sum = one.clone();
        sum.merge(&one);
        let count = NoteCount {
            cases: 6,
            scenes: 2,
        };
        assert_eq!(
            sum.iter().collect::<Vec<_>>(),
            [(Note::UnmappedLight, count)]
        );
        assert_eq!(
            (sum.cases(Note::UnmappedLight), sum.cases(Note::NoEntry)),
            (6, 0)
        );
    }
}
