//! What may follow what; the one definition that constructor, parser and sampler share.
//!
//! ```text
//! prompt* (BEGIN light* LIGHTS_END (key value)* NEWBORN (key value)*)*
//! ```
//!
//! The ego comes first in every frame, others in the order of class and id; an id is used once per
//! frame and never for two classes; the first frame has no newborn agents; light indices ascend.

use std::collections::BTreeMap;
use std::fmt;

use gump_scene::AgentKind;

use crate::{AGENT_KEYS, Key, MAX_LIGHTS, Slot};

/// A place where a sequence breaks the grammar.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("slot {position}: expected {expected}, found {found}")]
pub struct GrammarError {
    /// Index of the slot.
    pub position: usize,
    /// What could have stood there.
    pub expected: String,
    /// What stands there.
    pub found: String,
}

/// Reads slots one by one and says what may come next.
#[derive(Clone, Debug, Default)]
pub struct Grammar {
    place: Place,
    position: usize,
    frame: usize,
    last_light: u16,
    last_key: Option<Key>,
    /// Ids of the present frame, true for those a value has followed.
    present: BTreeMap<u16, ()>,
    previous: BTreeMap<u16, ()>,
    kinds: BTreeMap<u16, AgentKind>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Place {
    #[default]
    Start,
    Lights,
    Tracked,
    TrackedKey,
    Newborn,
    NewbornKey,
}

/// Which slots may come next.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Allowed {
    /// A prompt.
    pub prompt: bool,
    /// BEGIN; also true where the sequence may end.
    pub begin: bool,
    /// A light, of at least this index.
    pub light_from: Option<u16>,
    /// LIGHTS_END.
    pub lights_end: bool,
    /// Ids of keys.
    pub keys: Vec<u16>,
    /// A value.
    pub value: bool,
    /// NEWBORN.
    pub newborn: bool,
}

impl fmt::Display for Allowed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut names = Vec::new();
        for (may, name) in [
            (self.prompt, "a prompt"),
            (self.begin, "BEGIN"),
            (self.light_from.is_some(), "a light of a higher index"),
            (self.lights_end, "LIGHTS_END"),
            (self.value, "a value"),
            (self.newborn, "NEWBORN"),
        ] {
            if may {
                names.push(name.to_owned());
            }
        }
        match self.keys.as_slice() {
            [] => {}
            [0] => names.push("the ego's key".into()),
            keys => names.push(format!("one of {} keys", keys.len())),
        }
        f.write_str(&names.join(" or "))
    }
}

impl Grammar {
    /// What may come next.
    pub fn allowed(&self) -> Allowed {
        let none = Allowed::default();
        match self.place {
            Place::Start => Allowed {
                prompt: true,
                begin: true,
                ..none
            },
            Place::Lights => Allowed {
                light_from: (usize::from(self.last_light) < MAX_LIGHTS)
                    .then_some(self.last_light + 1),
                lights_end: true,
                ..none
            },
            Place::TrackedKey | Place::NewbornKey => Allowed {
                value: true,
                ..none
            },
            Place::Tracked if self.present.is_empty() => Allowed {
                keys: vec![0],
                ..none
            },
            Place::Tracked => {
                let known = |id: &u16| self.frame == 1 || self.previous.contains_key(id);
                Allowed {
                    keys: self.free(known),
                    newborn: true,
                    ..none
                }
            }
            Place::Newborn => {
                let unknown = |id: &u16| self.frame > 1 && !self.previous.contains_key(id);
                Allowed {
                    keys: self.free(unknown),
                    begin: true,
                    ..none
                }
            }
        }
    }

    /// Reads the next slot.
    ///
    /// # Errors
    /// [`GrammarError`] if it may not stand here; the grammar is then unchanged.
    pub fn advance(&mut self, slot: &Slot) -> Result<(), GrammarError> {
        let next = self.after(slot).ok_or_else(|| self.error(slot.name()))?;
        match *slot {
            Slot::Begin => {
                self.previous = std::mem::take(&mut self.present);
                self.frame += 1;
                (self.last_light, self.last_key) = (0, None);
            }
            Slot::Light(light) => self.last_light = light.index,
            Slot::Key(key) => {
                self.last_key = Some(key);
                self.present.insert(key.id, ());
                self.kinds.insert(key.id, key.kind);
            }
            Slot::Newborn => self.last_key = None,
            _ => {}
        }
        self.place = next;
        self.position += 1;
        Ok(())
    }

    /// Ends the sequence.
    ///
    /// # Errors
    /// [`GrammarError`] if the last frame is not complete.
    pub fn finish(&self) -> Result<(), GrammarError> {
        match self.place {
            Place::Start | Place::Newborn => Ok(()),
            _ => Err(self.error("the end".into())),
        }
    }

    /// The state after `slot`, `None` if it may not stand here.
    fn after(&self, slot: &Slot) -> Option<Place> {
        match (self.place, slot) {
            (Place::Start, Slot::Prompt(_)) => Some(Place::Start),
            (Place::Start | Place::Newborn, Slot::Begin) => Some(Place::Lights),
            (Place::Lights, Slot::Light(light)) => {
                let in_order =
                    self.last_light < light.index && usize::from(light.index) <= MAX_LIGHTS;
                in_order.then_some(Place::Lights)
            }
            (Place::Lights, Slot::LightsEnd) => Some(Place::Tracked),
            (Place::Tracked, Slot::Key(key)) => {
                self.may_be_tracked(*key).then_some(Place::TrackedKey)
            }
            (Place::Newborn, Slot::Key(key)) => {
                self.may_be_newborn(*key).then_some(Place::NewbornKey)
            }
            (Place::TrackedKey, Slot::Value(_)) => Some(Place::Tracked),
            (Place::NewbornKey, Slot::Value(_)) => Some(Place::Newborn),
            (Place::Tracked, Slot::Newborn) => (!self.present.is_empty()).then_some(Place::Newborn),
            _ => None,
        }
    }

    fn may_be_tracked(&self, key: Key) -> bool {
        let known = self.frame == 1 || self.previous.contains_key(&key.id);
        let ego_first = self.present.is_empty() == (key.id == 0);
        // The ego may return to a window it was never in before: it is always tracked.
        ego_first && (known || key.id == 0) && self.fits(key)
    }

    fn may_be_newborn(&self, key: Key) -> bool {
        self.frame > 1 && key.id != 0 && !self.previous.contains_key(&key.id) && self.fits(key)
    }

    /// In canonical order, once per frame, of the class it always had.
    fn fits(&self, key: Key) -> bool {
        key.kind != AgentKind::Other
            && u32::from(key.id) <= *AGENT_KEYS.end()
            && !self.present.contains_key(&key.id)
            && self.kinds.get(&key.id).is_none_or(|&kind| kind == key.kind)
            && self.last_key.is_none_or(|last| last.order() < key.order())
    }

    /// Ids of which some key could come next.
    fn free(&self, may: impl Fn(&u16) -> bool) -> Vec<u16> {
        let ids = (*AGENT_KEYS.start() as u16)..=(*AGENT_KEYS.end() as u16);
        let possible = |id: &u16| {
            let kinds = AgentKind::MOVING.into_iter();
            kinds
                .map(|kind| Key { id: *id, kind })
                .any(|key| self.fits(key))
        };
        ids.filter(|id| may(id) && possible(id)).collect()
    }

    fn error(&self, found: String) -> GrammarError {
        GrammarError {
            position: self.position,
            expected: self.allowed().to_string(),
            found,
        }
    }
}
