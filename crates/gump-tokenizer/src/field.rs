//! The quantiser: bins and tokens of the numbers of a state, field by field.
//!
//! Grid points are the values of the bins, `low`, `low + step`, ..., `high - step`; a value is
//! rounded to the nearest, half to even. `state` combines the fields of a whole state.
//!
//! Source: the grids are the GUMP paper's (table of sub-vocabularies), with 200 bins per velocity
//! component because the paper's range of 0..25 m/s cannot represent signed velocities. In the
//! released code the upper edge of every field overflows into the next sub-vocabulary; here it is
//! clamped, and headings wrap.

use std::f64::consts::PI;
use std::ops::Range;

/// Tolerance outside the range, in steps: a value at the end of a grid may come back from the world
/// frame with a rounding error.
pub(crate) const SLACK: f64 = 1e-6;

/// A field of an object's state.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Field {
    /// Box centre, forward in the scene frame, metres.
    X,
    /// Box centre, left in the scene frame, metres.
    Y,
    /// Heading in the scene frame, radians.
    Heading,
    /// Velocity along the scene frame's x, metres per second; the ego's is not subtracted.
    VelocityX,
    /// Velocity along the scene frame's y, metres per second.
    VelocityY,
    /// Box width, metres.
    Width,
    /// Box length, metres.
    Length,
}

/// The result of quantising.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quantized {
    /// Index of the bin, below [`Field::n_bins`].
    pub bin: u16,
    /// True if the value lay outside the field's range; both ends and rounding errors are inside.
    pub clamped: bool,
}

impl Field {
    /// All fields, in the order of their sub-vocabularies.
    pub const ALL: [Self; 7] = [
        Self::X,
        Self::Y,
        Self::Heading,
        Self::VelocityX,
        Self::VelocityY,
        Self::Width,
        Self::Length,
    ];

    /// Number of bins.
    pub fn n_bins(self) -> usize {
        match self {
            Self::X | Self::Y => 1000,
            Self::Heading | Self::VelocityX | Self::VelocityY => 200,
            Self::Width => 14,
            Self::Length => 30,
        }
    }

    /// Value of the first bin.
    pub fn low(self) -> f64 {
        match self {
            Self::X | Self::Y => -100.0,
            Self::Heading => -PI,
            Self::VelocityX | Self::VelocityY => -25.0,
            Self::Width | Self::Length => 0.0,
        }
    }

    /// End of the range, one step beyond the value of the last bin.
    pub fn high(self) -> f64 {
        match self {
            Self::X | Self::Y => 100.0,
            Self::Heading => PI,
            Self::VelocityX | Self::VelocityY => 25.0,
            Self::Width => 7.0,
            Self::Length => 15.0,
        }
    }

    /// Distance between the values of neighbouring bins.
    pub fn step(self) -> f64 {
        (self.high() - self.low()) / self.n_bins() as f64
    }

    /// True if the last bin is next to the first.
    pub fn is_circular(self) -> bool {
        self == Self::Heading
    }

    /// Token of the first bin.
    pub fn first_token(self) -> u32 {
        match self {
            Self::X => 325,
            Self::Y => 1325,
            Self::Heading => 2325,
            Self::VelocityX => 2525,
            Self::VelocityY => 2725,
            Self::Width => 2925,
            Self::Length => 2939,
        }
    }

    /// The sub-vocabulary: all tokens of the field.
    pub fn tokens(self) -> Range<u32> {
        self.first_token()..self.first_token() + self.n_bins() as u32
    }

    /// Token of a bin; `bin` is below [`Self::n_bins`].
    pub fn token(self, bin: u16) -> u32 {
        debug_assert!(
            usize::from(bin) < self.n_bins(),
            "{self:?} has no bin {bin}"
        );
        self.first_token() + u32::from(bin)
    }

    /// The nearest bin, half to even.
    ///
    /// Headings wrap and are never clamped; all other values outside the range go to the nearest
    /// end of the grid. In the last half step of a range that does not wrap the error is up to a
    /// whole step, elsewhere up to half of one. NaN has no bin: it gives the first, `clamped`.
    pub fn quantize(self, value: f64) -> Quantized {
        let n = self.n_bins() as f64;
        let bin = ((value - self.low()) / self.step()).round_ties_even();
        if self.is_circular() {
            return Quantized {
                bin: bin.rem_euclid(n) as u16,
                clamped: !value.is_finite(),
            };
        }
        let slack = SLACK * self.step();
        Quantized {
            bin: bin.clamp(0.0, n - 1.0) as u16,
            clamped: !(self.low() - slack..=self.high() + slack).contains(&value),
        }
    }

    /// The value of a bin, in the field's unit.
    pub fn dequantize(self, bin: u16) -> f64 {
        self.low() + f64::from(bin) * self.step()
    }
}
