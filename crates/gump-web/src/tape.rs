//! Inputs of a drive, one per tenth of a second, and their encoding in a link.
//!
//! The code is unpadded URL-safe base64: a version, then runs of equal inputs, each as its length
//! (two bytes, low first), the driver, the pedal, the wheel and the temperature. Version 2 adds the
//! gear, 1 for reverse; drives without it are written as version 1.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;

use crate::{GameError, LinkError};

/// Driver of the ego.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum EgoDriver {
    /// The player.
    #[default]
    Hand,
    /// The network, as it drives everyone else.
    Network,
    /// The Intelligent Driver Model along the route.
    Idm,
    /// The planner PDM-Closed.
    Pdm,
}

impl EgoDriver {
    /// All of them, by number.
    pub const ALL: [Self; 4] = [Self::Hand, Self::Network, Self::Idm, Self::Pdm];

    /// Its name on the page.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hand => "You",
            Self::Network => "The network",
            Self::Idm => "IDM",
            Self::Pdm => "PDM-Closed",
        }
    }
}

/// One tenth of a second of driving, in whole numbers so that a link replays it exactly.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Input {
    /// The driver; a change takes effect at the next half second.
    pub driver: EgoDriver,
    /// From -100, the hardest braking, to 100, the hardest acceleration; in reverse, from -100, the
    /// hardest acceleration backwards, to 100, the hardest braking.
    pub pedal: i8,
    /// From -100, the sharpest turn to the right, to 100, to the left.
    pub wheel: i8,
    /// The temperature of the world in twentieths; a change takes effect at the next half second.
    pub temperature: u8,
    /// Whether the car is in reverse gear.
    pub reverse: bool,
}

impl Default for Input {
    fn default() -> Self {
        Self {
            driver: EgoDriver::Hand,
            pedal: 0,
            wheel: 0,
            temperature: Self::PER_UNIT as u8,
            reverse: false,
        }
    }
}

impl Input {
    /// Steps of the temperature in 1.
    pub const PER_UNIT: f64 = 20.0;

    /// Clamps the input to its ranges: a page or a link may send any number.
    pub(crate) fn held(self) -> Self {
        Self {
            pedal: self.pedal.clamp(-100, 100),
            wheel: self.wheel.clamp(-100, 100),
            temperature: self.temperature.clamp(1, 60),
            ..self
        }
    }
}

/// Versions without and with a gear, and the bytes of a run in each.
const FORWARD: (u8, usize) = (1, 6);
const GEARED: (u8, usize) = (2, 7);

/// Encodes the inputs for a link.
pub fn encode(inputs: &[Input]) -> String {
    let is_geared = inputs.iter().any(|input| input.reverse);
    let (version, _) = if is_geared { GEARED } else { FORWARD };
    let mut bytes = vec![version];
    for run in inputs.chunk_by(|a, b| a == b) {
        for part in run.chunks(usize::from(u16::MAX)) {
            let input = part[0];
            bytes.extend((part.len() as u16).to_le_bytes());
            bytes.extend([
                input.driver as u8,
                input.pedal as u8,
                input.wheel as u8,
                input.temperature,
            ]);
            bytes.extend(is_geared.then_some(u8::from(input.reverse)));
        }
    }
    URL_SAFE_NO_PAD.encode(bytes)
}

/// Decodes at most `limit` inputs of a link.
///
/// # Errors
/// [`GameError::Link`] for anything that [`encode`] does not write.
pub fn decode(code: &str, limit: usize) -> Result<Vec<Input>, GameError> {
    let bytes = URL_SAFE_NO_PAD
        .decode(code.trim())
        .map_err(|_| LinkError::Damaged)?;
    let versions = [FORWARD, GEARED];
    let known = bytes.split_first().and_then(|(version, runs)| {
        let found = versions.iter().find(|(known, _)| known == version);
        Some((runs, found?.1))
    });
    let (runs, n_bytes) = known.ok_or(LinkError::OtherVersion)?;
    if !runs.len().is_multiple_of(n_bytes) {
        return Err(LinkError::CutOff.into());
    }
    let mut inputs = Vec::new();
    for run in runs.chunks(n_bytes) {
        let (n, input) = decode_run(run)?;
        if inputs.len() + n > limit {
            return Err(LinkError::TooLong.into());
        }
        inputs.extend(std::iter::repeat_n(input, n));
    }
    Ok(inputs)
}

/// Decodes a run: the number of repetitions, and the input.
fn decode_run(run: &[u8]) -> Result<(usize, Input), GameError> {
    let &[low, high, driver, pedal, wheel, temperature, ref gear @ ..] = run else {
        return Err(LinkError::CutOff.into());
    };
    let driver = EgoDriver::ALL.get(usize::from(driver));
    let driver = *driver.ok_or(LinkError::NoSuchDriver)?;
    let reverse = match gear {
        [] | [0] => false,
        [1] => true,
        _ => return Err(LinkError::NoSuchGear.into()),
    };
    let input = Input {
        driver,
        pedal: pedal as i8,
        wheel: wheel as i8,
        temperature,
        reverse,
    };
    Ok((usize::from(u16::from_le_bytes([low, high])), input.held()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn inputs() -> Vec<Input> {
        let first = Input {
            pedal: 100,
            wheel: -37,
            ..Input::default()
        };
        let second = Input {
            driver: EgoDriver::Pdm,
            temperature: 26,
            ..Input::default()
        };
        [vec![first; 70], vec![second; 3], vec![first]].concat()
    }

    #[test]
    fn a_code_gives_back_the_inputs() {
        let code = encode(&inputs());
        assert_eq!(code.len(), 26);
        assert_eq!(decode(&code, 74).unwrap(), inputs());
        assert_eq!(decode(&encode(&[]), 0).unwrap(), []);
    }

    #[test]
    fn a_gear_costs_a_byte_where_there_is_one() {
        let mut inputs = inputs();
        inputs[73].reverse = true;
        let geared = encode(&inputs);
        assert_eq!(decode(&geared, 74).unwrap(), inputs);
        assert_eq!(geared.len(), 30);
    }

    #[test]
    fn damaged_codes_are_refused() {
        let code = encode(&inputs());
        let check = |code: &str, expected: &str| {
            let error = decode(code, 74).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        };
        check("", "another version");
        check("%%%", "changed on its way");
        check(&code[..code.len() - 4], "cut off");
        assert!(
            decode(&code, 73)
                .unwrap_err()
                .to_string()
                .contains("longer")
        );
    }
}
