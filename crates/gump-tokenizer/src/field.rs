//! The quantiser: what a number becomes in each field of a state.

use std::f64::consts::PI;
use std::ops::Range;

/// A field of an object's state.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Field {
    /// Forward in the scene frame, metres.
    X,
    /// Left in the scene frame, metres.
    Y,
    /// Heading in the scene frame, radians.
    Heading,
    /// Velocity along x, metres per second.
    VelocityX,
    /// Velocity along y, metres per second.
    VelocityY,
    /// Box width, metres.
    Width,
    /// Box length, metres.
    Length,
}

/// A bin, and whether the value lay outside the field's range.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quantized {
    /// Index of the bin, below [`Field::n_bins`].
    pub bin: u16,
    /// True if the value was beyond the grid by more than rounding.
    pub clamped: bool,
}

impl Field {
    /// All fields, in the order of a value token.
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

    /// Distance between bins.
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

    /// All tokens of the field.
    pub fn tokens(self) -> Range<u32> {
        self.first_token()..self.first_token() + self.n_bins() as u32
    }

    /// Token of a bin.
    pub fn token(self, bin: u16) -> u32 {
        self.first_token() + u32::from(bin)
    }

    /// The nearest bin, half to even; headings wrap, everything else is clamped to the grid.
    ///
    /// `value` must be finite: an absent state is absent, never NaN.
    pub fn quantize(self, value: f64) -> Quantized {
        let n = self.n_bins() as f64;
        let bin = ((value - self.low()) / self.step()).round_ties_even();
        if self.is_circular() {
            return Quantized {
                bin: bin.rem_euclid(n) as u16,
                clamped: false,
            };
        }
        Quantized {
            bin: bin.clamp(0.0, n - 1.0) as u16,
            // The upper edge itself belongs to the last bin; only what lies beyond is a loss.
            clamped: value < self.low() || self.high() < value,
        }
    }

    /// The value a bin stands for.
    pub fn dequantize(self, bin: u16) -> f64 {
        self.low() + f64::from(bin) * self.step()
    }
}
