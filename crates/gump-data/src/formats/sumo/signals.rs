//! Signal states over time, as `SaveTLSSwitchStates` or `SaveTLSStates` write them.

use std::collections::BTreeMap;
use std::path::Path;

use gump_scene::{Light, LightState};

use super::roads::Roads;
use super::xml::Xml;
use crate::DataError;

/// State changes of each system: the time, seconds, and the states, a character per signal.
#[derive(Clone, Debug, Default)]
pub(super) struct Signals(BTreeMap<String, Vec<(f64, String)>>);

impl Signals {
    /// Adds the `tlsState` elements of a file; repeated states are kept once.
    pub(super) fn read(&mut self, path: &Path) -> Result<(), DataError> {
        let mut xml = Xml::open(path)?;
        while let Some(element) = xml.next()? {
            if element.name() != "tlsState" {
                continue;
            }
            let time = element.need_number("time")?;
            let state = element.need("state")?;
            let changes = self.0.entry(element.need("id")?.into_owned()).or_default();
            if changes.last().is_none_or(|(_, last)| *last != state) {
                changes.push((time, state.into_owned()));
            }
        }
        for changes in self.0.values_mut() {
            changes.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
        Ok(())
    }

    /// The lights at a time, seconds; systems that have not reported yet are dark.
    pub(super) fn at(&self, time: f64, roads: &Roads) -> Vec<Light> {
        let mut lights = Vec::new();
        for (system, changes) in &self.0 {
            // Times are written with two or three digits.
            let n = changes.partition_point(|(since, _)| *since <= time + 1e-4);
            let Some((_, states)) = n.checked_sub(1).map(|last| &changes[last]) else {
                continue;
            };
            for (index, code) in states.chars().enumerate() {
                let Some(state) = light_state(code) else {
                    continue;
                };
                let controlled = roads.controlled(system, index);
                lights.extend(controlled.iter().map(|&(lane, stop)| Light {
                    lane,
                    state,
                    stop_point: Some(stop),
                }));
            }
        }
        lights
    }
}

/// The colour of a code; `None` for a signal that is switched off.
///
/// Source: SUMO's documentation of signal state definitions. Red and yellow together (`u`) and a
/// green arrow after a stop (`s`) forbid driving on like red.
fn light_state(code: char) -> Option<LightState> {
    match code {
        'G' | 'g' => Some(LightState::Green),
        'y' | 'Y' => Some(LightState::Yellow),
        'r' | 'R' | 'u' | 's' => Some(LightState::Red),
        'o' | 'O' => None,
        _ => Some(LightState::Unknown),
    }
}
