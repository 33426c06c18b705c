//! A two-level hierarchy of bounding boxes over a list, for finding the first nearest item.

/// An axis-aligned box in space.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds {
    lo: [f32; 3],
    hi: [f32; 3],
}

impl Bounds {
    /// The smallest box around two points.
    pub(crate) fn of(a: [f32; 3], b: [f32; 3]) -> Self {
        Self {
            lo: std::array::from_fn(|i| a[i].min(b[i])),
            hi: std::array::from_fn(|i| a[i].max(b[i])),
        }
    }

    fn join(all: &[Self]) -> Self {
        all.iter().skip(1).fold(all[0], |a, b| Self {
            lo: std::array::from_fn(|i| a.lo[i].min(b.lo[i])),
            hi: std::array::from_fn(|i| a.hi[i].max(b.hi[i])),
        })
    }

    /// Distance from a point, 0 inside.
    fn distance(&self, p: [f32; 3]) -> f32 {
        let gap = |i: usize| (self.lo[i] - p[i]).max(p[i] - self.hi[i]).max(0.0);
        let (x, y, z) = (gap(0), gap(1), gap(2));
        (x * x + y * y + z * z).sqrt()
    }
}

/// Items per small box, small boxes per large one; neighbours in a polyline are neighbours in the
/// list, so boxes are tight.
const FAN: usize = 12;

/// Boxes over consecutive items.
#[derive(Clone, Debug)]
pub(crate) struct Blocks {
    n_items: usize,
    small: Vec<Bounds>,
    large: Vec<Bounds>,
}

impl Blocks {
    pub(crate) fn new(items: &[Bounds]) -> Self {
        let small: Vec<_> = items.chunks(FAN).map(Bounds::join).collect();
        let large = small.chunks(FAN).map(Bounds::join).collect();
        Self {
            n_items: items.len(),
            small,
            large,
        }
    }

    /// The first item of the smallest `cost` and the cost; `None` without items.
    ///
    /// `cost` is at least the distance to the item's bounds, up to rounding; `hint` is an item
    /// likely near.
    pub(crate) fn nearest(
        &self,
        point: [f32; 3],
        hint: usize,
        cost: impl Fn(usize) -> f32,
    ) -> Option<(usize, f32)> {
        if self.n_items == 0 {
            return None;
        }
        // The bound alone: which item is first among equals is decided in order below.
        let mut limit = with_margin(cost(hint.min(self.n_items - 1)));
        let (mut best, mut best_cost) = (None, f32::INFINITY);
        for (i, large) in self.large.iter().enumerate() {
            if large.distance(point) > limit {
                continue;
            }
            let end = ((i + 1) * FAN).min(self.small.len());
            for j in i * FAN..end {
                if self.small[j].distance(point) > limit {
                    continue;
                }
                for k in j * FAN..((j + 1) * FAN).min(self.n_items) {
                    let found = cost(k);
                    if found < best_cost {
                        (best, best_cost) = (Some(k), found);
                        limit = limit.min(with_margin(found));
                    }
                }
            }
        }
        Some((best?, best_cost))
    }
}

/// A margin larger than rounding errors of distances: items whose cost may be as small must not be
/// skipped.
fn with_margin(cost: f32) -> f32 {
    cost * 1.000_1 + 1e-3
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_scene::Seed;
    use rand::Rng as _;

    #[test]
    fn boxes_find_what_looking_at_all_finds() {
        let mut rng = Seed(3).rng();
        // Coarse numbers, so that equal costs are common.
        let mut point = || std::array::from_fn(|_| rng.random_range(-20..20) as f32);
        let items: Vec<[f32; 3]> = (0..500).map(|_| point()).collect();
        let bounds: Vec<_> = items.iter().map(|&p| Bounds::of(p, p)).collect();
        let blocks = Blocks::new(&bounds);
        for hint in 0..300 {
            let query = point();
            let cost = |i: usize| bounds[i].distance(query);
            let expected = (0..items.len()).min_by(|&a, &b| cost(a).total_cmp(&cost(b)));
            let found = blocks.nearest(query, hint, cost);
            assert_eq!(found.map(|(i, _)| i), expected);
        }
        assert!(Blocks::new(&[]).nearest([0.0; 3], 0, |_| 0.0).is_none());
    }
}
