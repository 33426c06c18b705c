//! A three-level hierarchy of bounding boxes over a list, for finding the first nearest item.

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

    /// Square of the distance from a point, 0 inside.
    #[inline]
    fn squared_distance(&self, p: [f32; 3]) -> f32 {
        let gap = |i: usize| (self.lo[i] - p[i]).max(p[i] - self.hi[i]).max(0.0);
        let (x, y, z) = (gap(0), gap(1), gap(2));
        x * x + y * y + z * z
    }
}

/// Items per box of the lowest level, then boxes per box of the levels above; neighbours in a
/// polyline are neighbours in the list, so boxes are tight. An item costs about three boxes. Three
/// levels are faster than two (docs/results/0002-wosac.md) and change no result.
const FANS: [usize; 3] = [3, 4, 8];

/// Boxes over consecutive items.
#[derive(Clone, Debug)]
pub(crate) struct Blocks {
    n_items: usize,
    /// From the boxes of items to the largest.
    levels: [Vec<Bounds>; 3],
}

impl Blocks {
    pub(crate) fn new(items: &[Bounds]) -> Self {
        let join = |parts: &[Bounds], fan: usize| -> Vec<_> {
            parts.chunks(fan).map(Bounds::join).collect()
        };
        let small = join(items, FANS[0]);
        let middle = join(&small, FANS[1]);
        let large = join(&middle, FANS[2]);
        Self {
            n_items: items.len(),
            levels: [small, middle, large],
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
        let [small, middle, large] = &self.levels;
        let parts = |whole: usize, fan: usize, n: usize| whole * fan..((whole + 1) * fan).min(n);
        // The bound alone: which item is first among equals is decided in order below.
        let mut limit = squared_limit(cost(hint.min(self.n_items - 1)));
        let (mut best, mut best_cost) = (None, f32::INFINITY);
        for (i, bounds) in large.iter().enumerate() {
            if bounds.squared_distance(point) > limit {
                continue;
            }
            for j in parts(i, FANS[2], middle.len()) {
                if middle[j].squared_distance(point) > limit {
                    continue;
                }
                for k in parts(j, FANS[1], small.len()) {
                    if small[k].squared_distance(point) > limit {
                        continue;
                    }
                    for item in parts(k, FANS[0], self.n_items) {
                        let found = cost(item);
                        if found < best_cost {
                            (best, best_cost) = (Some(item), found);
                            limit = limit.min(squared_limit(found));
                        }
                    }
                }
            }
        }
        Some((best?, best_cost))
    }
}

/// The square of a cost with a margin larger than rounding errors of distances: items whose cost
/// may be as small must not be skipped.
fn squared_limit(cost: f32) -> f32 {
    let limit = cost * 1.000_1 + 1e-3;
    limit * limit
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
            let cost = |i: usize| bounds[i].squared_distance(query).sqrt();
            let expected = (0..items.len()).min_by(|&a, &b| cost(a).total_cmp(&cost(b)));
            let found = blocks.nearest(query, hint, cost);
            assert_eq!(found.map(|(i, _)| i), expected);
        }
        assert!(Blocks::new(&[]).nearest([0.0; 3], 0, |_| 0.0).is_none());
    }
}
