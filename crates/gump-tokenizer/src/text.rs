//! Tokens as readable text: for messages, snapshots and inspection.

use std::fmt;

use gump_scene::{LightState, ScenarioTag};

use crate::{Field, Key, QuantizedState, Slot, TokenAgent, TokenLight, TokenSequence};

/// One slot or pair of slots per line, values in metres, radians and metres per second.
impl fmt::Display for TokenSequence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for prompt in self.prompts() {
            writeln!(f, "{}", Slot::Prompt(*prompt))?;
        }
        for frame in self.frames() {
            writeln!(f, "BEGIN")?;
            for light in &frame.lights {
                writeln!(f, "  {}", Slot::Light(*light))?;
            }
            writeln!(f, "LIGHTS_END")?;
            for agent in &frame.tracked {
                writeln!(f, "  {agent}")?;
            }
            writeln!(f, "NEWBORN")?;
            for agent in &frame.newborn {
                writeln!(f, "  {agent}")?;
            }
        }
        Ok(())
    }
}

impl fmt::Display for Slot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Prompt(prompt) => {
                let name = prompt.map_or("none", ScenarioTag::name);
                write!(f, "PROMPT {name}")
            }
            Self::Begin => f.write_str("BEGIN"),
            Self::Light(light) => write!(f, "{light}"),
            Self::LightsEnd => f.write_str("LIGHTS_END"),
            Self::Key(key) => write!(f, "{key}"),
            Self::Value(state) => write!(f, "{state}"),
            Self::Newborn => f.write_str("NEWBORN"),
            Self::Pad => f.write_str("PAD"),
        }
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.id {
            0 => write!(f, "ego({})", self.kind.name()),
            id => write!(f, "{id}({})", self.kind.name()),
        }
    }
}

impl fmt::Display for TokenAgent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.key, self.state)
    }
}

impl fmt::Display for QuantizedState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y, heading, vx, vy, width, length] = self.values();
        write!(f, "at {x:.1},{y:.1} heading {heading:.3} ")?;
        write!(f, "velocity {vx:.2},{vy:.2} size {length:.1},{width:.1}")
    }
}

impl fmt::Display for TokenLight {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = match self.state {
            LightState::Green => "green",
            LightState::Yellow => "yellow",
            LightState::Red => "red",
            LightState::Unknown => "unknown",
        };
        let (x, y) = (Field::X.dequantize(self.x), Field::Y.dequantize(self.y));
        let heading = Field::Heading.dequantize(self.heading);
        let index = self.index;
        write!(
            f,
            "light {index} {state} at {x:.1},{y:.1} heading {heading:.3}"
        )
    }
}
