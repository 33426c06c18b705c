//! Sizes of vehicles, bicycles and pedestrians.

use gump_scene::Rng;
use rand::Rng as _;

/// Shares of a distribution and the values that they do not exceed.
type Quantiles<const N: usize> = [(f64, f64); N];

/// Lengths and widths of vehicles on the road, metres.
///
/// Source, as of the other sizes: the quantiles of `configs/targets/waymo-like.toml`.
const VEHICLE_LENGTHS: Quantiles<8> = [
    (0.0, 3.7),
    (0.05, 4.23),
    (0.25, 4.42),
    (0.5, 4.61),
    (0.75, 4.85),
    (0.95, 5.66),
    (0.99, 7.9),
    (1.0, 12.5),
];
/// See [`VEHICLE_LENGTHS`].
const VEHICLE_WIDTHS: Quantiles<8> = [
    (0.0, 1.75),
    (0.05, 1.91),
    (0.25, 2.0),
    (0.5, 2.06),
    (0.75, 2.16),
    (0.95, 2.4),
    (0.99, 2.8),
    (1.0, 2.95),
];
/// Lengths and widths of people, metres.
const PERSON_SIZES: [Quantiles<6>; 2] = [
    [
        (0.0, 0.6),
        (0.05, 0.75),
        (0.25, 0.81),
        (0.5, 0.89),
        (0.95, 1.17),
        (1.0, 1.27),
    ],
    [
        (0.0, 0.6),
        (0.05, 0.71),
        (0.25, 0.8),
        (0.5, 0.85),
        (0.95, 0.99),
        (1.0, 1.1),
    ],
];
/// Lengths and widths of bicycles with their riders, metres.
const BICYCLE_SIZES: [Quantiles<6>; 2] = [
    [
        (0.0, 1.4),
        (0.05, 1.55),
        (0.25, 1.75),
        (0.5, 1.84),
        (0.95, 2.09),
        (1.0, 2.25),
    ],
    [
        (0.0, 0.65),
        (0.05, 0.72),
        (0.25, 0.81),
        (0.5, 0.85),
        (0.95, 0.98),
        (1.0, 1.05),
    ],
];

/// The value at a share of a distribution, between its quantiles.
fn quantile<const N: usize>(quantiles: &Quantiles<N>, share: f64) -> f64 {
    let last = N - 1;
    let upper = quantiles
        .iter()
        .position(|(q, _)| share < *q)
        .unwrap_or(last);
    let ((q, a), (r, b)) = (quantiles[upper.max(1) - 1], quantiles[upper.max(1)]);
    a + (b - a) * ((share - q) / (r - q)).clamp(0.0, 1.0)
}

/// Length, width and height of a vehicle as they are met on the road, metres.
pub(crate) fn draw_real_size(rng: &mut Rng) -> [f64; 3] {
    // Long vehicles are wide and high, but not strictly. Heights, which no target states, are
    // chosen by hand, here and below.
    let big: f64 = rng.random_range(0.0..1.0);
    let share = |rng: &mut Rng| (big + rng.random_range(-0.22..0.22)).clamp(0.0, 0.9999);
    let width = quantile(&VEHICLE_WIDTHS, share(rng));
    let height = 1.45 + 0.45 * share(rng) + rng.random_range(0.0..0.15);
    let length = quantile(&VEHICLE_LENGTHS, big);
    [
        length,
        width,
        height + 0.35 * (length - 5.6).clamp(0.0, 4.0),
    ]
}

/// Length, width and height of a person, metres.
pub(crate) fn draw_person_size(rng: &mut Rng) -> [f64; 3] {
    let [length, width] = PERSON_SIZES.map(|sizes| quantile(&sizes, rng.random_range(0.0..1.0)));
    [length, width, rng.random_range(1.45..1.95)]
}

/// Length, width and height of a bicycle with its rider, metres.
pub(super) fn draw_bicycle_size(rng: &mut Rng) -> [f64; 3] {
    let [length, width] = BICYCLE_SIZES.map(|sizes| quantile(&sizes, rng.random_range(0.0..1.0)));
    [length, width, rng.random_range(1.6..1.9)]
}

/// Length, width and height of a vehicle, metres: mostly cars, some vans, few trucks and buses, in
/// shares and sizes chosen by hand.
pub(super) fn draw_size(rng: &mut Rng) -> [f64; 3] {
    match rng.random_range(0..100) {
        0..=86 => {
            let length = 4.0 + rng.random_range(0.0..0.55) + rng.random_range(0.0..0.7);
            [
                length,
                rng.random_range(1.75..2.05),
                rng.random_range(1.4..1.8),
            ]
        }
        87..=96 => {
            let length = rng.random_range(5.2..6.3);
            [
                length,
                rng.random_range(1.95..2.2),
                rng.random_range(1.8..2.6),
            ]
        }
        _ => {
            let length = rng.random_range(7.2..11.9);
            [
                length,
                rng.random_range(2.3..2.55),
                rng.random_range(2.7..3.4),
            ]
        }
    }
}
