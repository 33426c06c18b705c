//! Colours by number: the fixed palette of a film.
//!
//! A palette made from the theme rather than from the pixels is the same for every frame, so that
//! nothing flickers, a pixel that stays the same can be left out, and no frame need be analysed.

use tiny_skia::Pixmap;

use crate::theme::{Colours, Rgb, mix};

/// The number that means "as in the frame before".
pub(crate) const UNCHANGED: u8 = 255;

/// Slots of the memory of colours already matched; a power of two, and many times the few hundred
/// colours of a film. Chosen by hand.
const MEMORY: usize = 1 << 14;

/// Up to 255 colours, and which of them is nearest to any other.
pub(crate) struct Palette {
    colours: Vec<Rgb>,
    /// The last colour met in each slot and its number; most pixels repeat a few hundred colours.
    memory: Vec<(Rgb, u8)>,
}

impl Palette {
    /// The colours of a theme and, for smooth borders, what lies between inks and grounds.
    pub(crate) fn new(colours: &Colours) -> Self {
        let mut all: Vec<Rgb> = Vec::new();
        let mut add = |colour: Rgb| {
            if all.len() < usize::from(UNCHANGED) && !all.contains(&colour) {
                all.push(colour);
            }
        };
        let (grounds, inks) = (colours.grounds(), colours.inks());
        grounds.into_iter().chain(inks).for_each(&mut add);
        for t in [0.5, 0.25, 0.75] {
            for ground in grounds {
                for ink in inks {
                    add(mix(ground, ink, t));
                }
            }
        }
        for t in [0.12, 0.37, 0.62, 0.87] {
            for ink in inks {
                add(mix(colours.road, ink, t));
            }
        }
        let nearest_to_black = nearest(&all, [0, 0, 0]);
        Self {
            memory: vec![([0, 0, 0], nearest_to_black); MEMORY],
            colours: all,
        }
    }

    /// The table of a GIF: red, green and blue of each number.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        let mut bytes = self.colours.concat();
        bytes.resize(256 * 3, 0);
        bytes
    }

    /// The number of the colour nearest to `colour`.
    pub(crate) fn index(&mut self, colour: Rgb) -> u8 {
        let [r, g, b] = colour.map(usize::from);
        let slot = (r * 0x9E3 + g * 0x1F35 + b * 0x2C1B) & (MEMORY - 1);
        if self.memory[slot].0 != colour {
            self.memory[slot] = (colour, nearest(&self.colours, colour));
        }
        self.memory[slot].1
    }

    /// Writes the numbers of a pixmap's pixels into `indices`, whose rows are `stride` long, with
    /// the top left corner at (`left`, `top`).
    pub(crate) fn blit(
        &mut self,
        pixmap: &Pixmap,
        indices: &mut [u8],
        stride: usize,
        (left, top): (usize, usize),
    ) {
        let width = pixmap.width() as usize;
        let mut last = ([0, 0, 0], self.index([0, 0, 0]));
        for (row, pixels) in pixmap.data().chunks_exact(width * 4).enumerate() {
            let start = (top + row) * stride + left;
            let target = &mut indices[start..start + width];
            for (index, pixel) in target.iter_mut().zip(pixels.chunks_exact(4)) {
                let colour = [pixel[0], pixel[1], pixel[2]];
                if colour != last.0 {
                    last = (colour, self.index(colour));
                }
                *index = last.1;
            }
        }
    }
}

fn nearest(colours: &[Rgb], colour: Rgb) -> u8 {
    let distance = |other: &Rgb| -> i32 {
        let squared = |i: usize| (i32::from(other[i]) - i32::from(colour[i])).pow(2);
        squared(0) + squared(1) + squared(2)
    };
    let best = colours
        .iter()
        .enumerate()
        .min_by_key(|(_, other)| distance(other));
    best.map_or(0, |(i, _)| i as u8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Theme;

    #[test]
    fn theme_colours_are_exact_and_others_near() {
        for theme in [Theme::Light, Theme::Dark] {
            let colours = theme.colours();
            let mut palette = Palette::new(colours);
            assert!(palette.colours.len() <= 255);
            for colour in colours.grounds().into_iter().chain(colours.inks()) {
                let i = palette.index(colour);
                assert_eq!(palette.colours[usize::from(i)], colour);
                assert_eq!(palette.index(colour), i, "the memory agrees");
            }
            for t in 0..=20 {
                let blend = mix(colours.road, colours.vehicle, t as f32 / 20.0);
                let i = palette.index(blend);
                let found = palette.colours[usize::from(i)];
                assert!((0..3).all(|i| found[i].abs_diff(blend[i]) < 20));
            }
        }
    }
}
