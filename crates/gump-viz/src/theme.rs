//! Colours.

use gump_scene::{AgentKind, LightState};

/// On which ground to draw.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Theme {
    /// Dark on light, for print and day.
    #[default]
    Light,
    /// Light on dark.
    Dark,
}

/// Red, green, blue.
pub(crate) type Rgb = [u8; 3];

/// The colours of one theme.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Colours {
    pub(crate) ground: Rgb,
    pub(crate) road: Rgb,
    pub(crate) route: Rgb,
    pub(crate) crosswalk: Rgb,
    /// Chevrons along lanes.
    pub(crate) direction: Rgb,
    pub(crate) white_line: Rgb,
    pub(crate) yellow_line: Rgb,
    pub(crate) edge: Rgb,
    pub(crate) text: Rgb,
    pub(crate) ego: Rgb,
    pub(crate) vehicle: Rgb,
    pub(crate) pedestrian: Rgb,
    pub(crate) bicycle: Rgb,
    pub(crate) other: Rgb,
    /// Borders and wedges of boxes.
    pub(crate) outline: Rgb,
    pub(crate) wedge: Rgb,
    pub(crate) red: Rgb,
    pub(crate) yellow: Rgb,
    /// Of lights; not the green of bicycles.
    pub(crate) green: Rgb,
}

const LIGHT: Colours = Colours {
    ground: [0xF6, 0xF5, 0xF2],
    road: [0xDF, 0xE1, 0xE4],
    route: [0xF3, 0xE0, 0xBA],
    crosswalk: [0xFA, 0xFA, 0xF8],
    direction: [0xC0, 0xC5, 0xCC],
    white_line: [0xFF, 0xFF, 0xFF],
    yellow_line: [0xE3, 0xC1, 0x55],
    edge: [0x9C, 0xA3, 0xAD],
    text: [0x3A, 0x3F, 0x47],
    ego: [0xE6, 0x9F, 0x00],
    vehicle: [0x00, 0x72, 0xB2],
    pedestrian: [0xCC, 0x79, 0xA7],
    bicycle: [0x00, 0x9E, 0x73],
    other: [0x8B, 0x90, 0x99],
    outline: [0x23, 0x28, 0x30],
    wedge: [0xFF, 0xFF, 0xFF],
    red: [0xD5, 0x5E, 0x00],
    yellow: [0xF0, 0xE4, 0x42],
    green: [0x35, 0xE0, 0x6E],
};

const DARK: Colours = Colours {
    ground: [0x11, 0x13, 0x17],
    road: [0x24, 0x28, 0x2F],
    route: [0x45, 0x39, 0x22],
    crosswalk: [0x56, 0x5D, 0x68],
    direction: [0x3C, 0x43, 0x4D],
    white_line: [0x78, 0x80, 0x8B],
    yellow_line: [0x97, 0x83, 0x3D],
    edge: [0x5B, 0x63, 0x6F],
    text: [0xC5, 0xCB, 0xD3],
    ego: [0xE6, 0x9F, 0x00],
    vehicle: [0x56, 0xB4, 0xE9],
    pedestrian: [0xCC, 0x79, 0xA7],
    bicycle: [0x00, 0x9E, 0x73],
    other: [0x7C, 0x82, 0x8C],
    outline: [0x0B, 0x0D, 0x10],
    wedge: [0x0B, 0x0D, 0x10],
    red: [0xD5, 0x5E, 0x00],
    yellow: [0xF0, 0xE4, 0x42],
    green: [0x35, 0xE0, 0x6E],
};

impl Theme {
    pub(crate) fn colours(self) -> &'static Colours {
        match self {
            Self::Light => &LIGHT,
            Self::Dark => &DARK,
        }
    }
}

impl Colours {
    pub(crate) fn kind(&self, kind: AgentKind) -> Rgb {
        match kind {
            AgentKind::Vehicle => self.vehicle,
            AgentKind::Pedestrian => self.pedestrian,
            AgentKind::Bicycle => self.bicycle,
            AgentKind::TrafficCone | AgentKind::Barrier | AgentKind::Sign | AgentKind::Other => {
                self.other
            }
        }
    }

    pub(crate) fn light(&self, state: LightState) -> Rgb {
        match state {
            LightState::Red => self.red,
            LightState::Yellow => self.yellow,
            LightState::Green => self.green,
            LightState::Unknown => self.other,
        }
    }

    /// Background colours.
    pub(crate) fn grounds(&self) -> [Rgb; 4] {
        [self.road, self.ground, self.route, self.crosswalk]
    }

    /// Colours drawn on the backgrounds, the most frequent first.
    pub(crate) fn inks(&self) -> [Rgb; 15] {
        [
            self.vehicle,
            self.ego,
            self.pedestrian,
            self.bicycle,
            self.other,
            self.outline,
            self.edge,
            self.white_line,
            self.text,
            self.direction,
            self.yellow_line,
            self.red,
            self.green,
            self.yellow,
            self.wedge,
        ]
    }
}

/// The colour a fraction `t` of the way from `a` to `b`.
pub(crate) fn mix(a: Rgb, b: Rgb, t: f32) -> Rgb {
    std::array::from_fn(|i| (f32::from(a[i]) * (1.0 - t) + f32::from(b[i]) * t).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lights_do_not_look_like_agents() {
        for theme in [Theme::Light, Theme::Dark] {
            let colours = theme.colours();
            let agents = [
                colours.ego,
                colours.vehicle,
                colours.pedestrian,
                colours.bicycle,
                colours.other,
            ];
            for light in [colours.red, colours.yellow, colours.green] {
                for agent in agents {
                    let apart: u32 = (0..3)
                        .map(|i| u32::from(light[i].abs_diff(agent[i])).pow(2))
                        .sum();
                    assert!(apart > 60 * 60, "{light:?} and {agent:?}");
                }
            }
        }
    }
}
