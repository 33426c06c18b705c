//! Our plane geometry beside parry2d's on the same shapes: first whether they agree, then how long
//! each takes.
//!
//! `cargo run --release --manifest-path crates/gump-geometry/benches/parry2d/Cargo.toml
//! --target-dir target/parry2d`. The figures and what follows from them are in decision 25. Two
//! functions of `gump-nuplan` are repeated here, the convex hull and the times of contact.

use std::hint::black_box;

use criterion::{BatchSize, BenchmarkId, Criterion};
use gump_geometry::{
    BoxIndex, DVec2, LineIndex, OrientedBox, Polygon, Polyline, Pose, Quad, SegmentIndex, dvec2,
};
use parry2d_f64::bounding_volume::Aabb;
use parry2d_f64::math::Pose2;
use parry2d_f64::partitioning::{Bvh, BvhBuildStrategy};
use parry2d_f64::query::{
    PointQuery as _, ShapeCastOptions, cast_shapes, distance, intersection_test,
};
use parry2d_f64::shape::{ConvexPolygon, Cuboid, Shape, TriMesh};
use parry2d_f64::transformation::convex_hull;

/// Pairs of boxes, and places that are looked up.
const N: usize = 1000;

/// Numbers from -1 to 1, the same in every run: SplitMix64.
struct Draws(u64);

impl Draws {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    fn point(&mut self, reach: f64) -> DVec2 {
        dvec2(self.next() * reach, self.next() * reach)
    }

    /// A vehicle somewhere in a square of that half side.
    fn vehicle(&mut self, reach: f64) -> Vehicle {
        let (at, heading) = (self.point(reach), self.next() * 3.1);
        let (length, width) = (4.5 + self.next(), 2.0 + 0.2 * self.next());
        let velocity = DVec2::from_angle(heading) * (6.0 + 6.0 * self.next());
        Vehicle::new(Pose::new(at.x, at.y, heading), length, width, velocity)
    }
}

/// A vehicle in the forms of both libraries.
struct Vehicle {
    ours: OrientedBox,
    quad: Quad,
    pose: Pose2,
    cuboid: Cuboid,
    /// In the world frame.
    convex: ConvexPolygon,
    velocity: DVec2,
}

impl Vehicle {
    fn new(pose: Pose, length: f64, width: f64, velocity: DVec2) -> Self {
        let ours = OrientedBox {
            pose,
            length,
            width,
        };
        let corners = ours.corners().to_vec();
        Self {
            quad: Quad::from(&ours),
            pose: Pose2::new(pose.position, pose.heading),
            cuboid: Cuboid::new(dvec2(length, width) / 2.0),
            convex: ConvexPolygon::from_convex_polyline(corners).expect("four corners"),
            ours,
            velocity,
        }
    }
}

/// The hull as `gump-nuplan` has it.
fn our_hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    let chain = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut chain: Vec<DVec2> = Vec::new();
        for point in points {
            while let [.., a, b] = chain[..] {
                if (b - a).perp_dot(point - b) > 0.0 {
                    break;
                }
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut hull = chain(&mut points.iter().copied());
    hull.extend(chain(&mut points.iter().rev().copied()));
    hull
}

/// Overlap by half extents along the four axes, as parry tests boxes: no corners.
fn half_extents_overlap(a: &OrientedBox, b: &OrientedBox) -> bool {
    let offset = b.pose.position - a.pose.position;
    let axes = |shape: &OrientedBox| {
        let forward = shape.pose.direction();
        [forward, forward.perp()]
    };
    let (of_a, of_b) = (axes(a), axes(b));
    let reach = |shape: &OrientedBox, [forward, left]: [DVec2; 2], axis: DVec2| {
        let (along, across) = (forward.dot(axis), left.dot(axis));
        (shape.length * along.abs() + shape.width * across.abs()) / 2.0
    };
    of_a.into_iter()
        .chain(of_b)
        .all(|axis| offset.dot(axis).abs() < reach(a, of_a, axis) + reach(b, of_b, axis))
}

/// Distance by the corners of each box in the frame of the other one.
fn in_frames_distance(a: &OrientedBox, b: &OrientedBox) -> f64 {
    if half_extents_overlap(a, b) {
        return 0.0;
    }
    let nearest = |from: &OrientedBox, to: &OrientedBox| {
        let to_from_world = to.pose.inverse();
        let half = dvec2(to.length, to.width) / 2.0;
        let squares = from.corners().map(|corner| {
            let beyond = (to_from_world * corner).abs() - half;
            beyond.max(DVec2::ZERO).length_squared()
        });
        squares.into_iter().fold(f64::INFINITY, f64::min)
    };
    nearest(a, b).min(nearest(b, a)).sqrt()
}

/// Time at which two boxes first touch, by the method of `gump-nuplan`.
fn our_contact(a: &Vehicle, b: &Vehicle) -> Option<f64> {
    let offset = b.ours.pose.position - a.ours.pose.position;
    let velocity = b.velocity - a.velocity;
    let forward = [&a.ours, &b.ours].map(|shape| shape.pose.direction());
    let reach = |shape: &OrientedBox, forward: DVec2, axis: DVec2| {
        let (along, across) = (forward.dot(axis), forward.perp().dot(axis));
        (shape.length * along.abs() + shape.width * across.abs()) / 2.0
    };
    let mut span = (0.0f64, f64::INFINITY);
    for axis in [forward[0], forward[0].perp(), forward[1], forward[1].perp()] {
        let reach = reach(&a.ours, forward[0], axis) + reach(&b.ours, forward[1], axis) + 1e-9;
        let (gap, closing) = (offset.dot(axis), velocity.dot(axis));
        if closing == 0.0 {
            if gap.abs() > reach {
                return None;
            }
            continue;
        }
        let (t0, t1) = ((-reach - gap) / closing, (reach - gap) / closing);
        span = (span.0.max(t0.min(t1)), span.1.min(t0.max(t1)));
        if span.0 > span.1 {
            return None;
        }
    }
    Some(span.0)
}

fn their_distance(a: &Pose2, x: &dyn Shape, b: &Pose2, y: &dyn Shape) -> f64 {
    let found = distance(a, x, b, y).expect("both shapes are supported");
    found.distance
}

fn their_overlap(a: &Pose2, x: &dyn Shape, b: &Pose2, y: &dyn Shape) -> bool {
    let found = intersection_test(a, x, b, y).expect("both shapes are supported");
    found.intersecting
}

fn their_contact(a: &Vehicle, b: &Vehicle) -> Option<f64> {
    let options = ShapeCastOptions::default();
    let hit = cast_shapes(
        &a.pose, a.velocity, &a.cuboid, &b.pose, b.velocity, &b.cuboid, options,
    );
    let hit = hit.expect("boxes are supported");
    hit.map(|hit| hit.time_of_impact)
}

/// Prints how often two answers differ by more than a micrometre (or a microsecond), and the
/// largest difference.
fn compare(what: &str, pairs: impl Iterator<Item = (Option<f64>, Option<f64>)>) {
    let (mut n, mut other, mut far, mut most) = (0, 0, 0, 0.0f64);
    for (ours, theirs) in pairs {
        n += 1;
        match (ours, theirs) {
            (Some(a), Some(b)) => {
                far += usize::from((a - b).abs() > 1e-6);
                most = most.max((a - b).abs());
            }
            (None, None) => {}
            _ => other += 1,
        }
    }
    println!(
        "{what}: {n} cases, {other} decided otherwise, {far} off by over 1e-6, at most {most:.1e}"
    );
}

fn main() {
    let mut draws = Draws(7);
    let pairs: Vec<[Vehicle; 2]> = (0..N)
        .map(|_| [draws.vehicle(4.0), draws.vehicle(4.0)])
        .collect();
    let apart: Vec<[Vehicle; 2]> = (0..N)
        .map(|_| [draws.vehicle(25.0), draws.vehicle(25.0)])
        .collect();
    // A junction's area: a star of 60 corners, some 40 m across.
    let corner = |i: usize, jitter: f64| {
        let reach = 14.0 + 6.0 * (i as f64 * 0.63).sin() + jitter;
        DVec2::from_angle(i as f64 / 60.0 * std::f64::consts::TAU) * reach
    };
    let ring: Vec<DVec2> = (0..60).map(|i| corner(i, draws.next())).collect();
    let area = Polygon::new(ring.clone()).expect("60 corners");
    let mesh = TriMesh::from_polygon(ring).expect("a simple polygon");
    // A lane of 400 points, and the boxes of 2,000 pieces of road over 400 m.
    let line: Vec<DVec2> = (0..400)
        .map(|i| dvec2(i as f64, 20.0 * (i as f64 / 50.0).sin()))
        .collect();
    let boxes: Vec<(DVec2, DVec2)> = (0..2000)
        .map(|_| {
            let (at, size) = (draws.point(200.0), draws.point(4.0).abs());
            (at - size, at + size)
        })
        .collect();
    let places: Vec<DVec2> = (0..N).map(|_| draws.point(200.0)).collect();
    let clouds: Vec<Vec<DVec2>> = (0..N)
        .map(|_| (0..12).map(|_| draws.point(10.0)).collect())
        .collect();

    let identity = Pose2::IDENTITY;
    let bit = |answer: bool| answer.then_some(0.0);
    compare(
        "box overlap",
        pairs.iter().map(|[a, b]| {
            let theirs = their_overlap(&a.pose, &a.cuboid, &b.pose, &b.cuboid);
            (bit(a.ours.overlaps(&b.ours)), bit(theirs))
        }),
    );
    compare(
        "box overlap by half extents",
        pairs.iter().map(|[a, b]| {
            let by_extents = half_extents_overlap(&a.ours, &b.ours);
            (bit(a.ours.overlaps(&b.ours)), bit(by_extents))
        }),
    );
    compare(
        "box distance in frames",
        apart.iter().map(|[a, b]| {
            let in_frames = in_frames_distance(&a.ours, &b.ours);
            (Some(a.quad.distance(&b.quad)), Some(in_frames))
        }),
    );
    compare(
        "box distance",
        apart.iter().map(|[a, b]| {
            let theirs = their_distance(&a.pose, &a.cuboid, &b.pose, &b.cuboid);
            (Some(a.quad.distance(&b.quad)), Some(theirs))
        }),
    );
    compare(
        "polygon distance",
        apart.iter().map(|[a, _]| {
            let theirs = their_distance(&a.pose, &a.cuboid, &identity, &mesh);
            (Some(a.quad.distance_to_polygon(&area)), Some(theirs))
        }),
    );
    compare(
        "time of contact",
        apart
            .iter()
            .map(|[a, b]| (our_contact(a, b), their_contact(a, b))),
    );
    let bvh = Bvh::from_iter(
        BvhBuildStrategy::Binned,
        boxes
            .iter()
            .map(|&(min, max)| Aabb::new(min, max))
            .enumerate(),
    );
    let rstar = BoxIndex::new(boxes.iter().enumerate().map(|(i, &(a, b))| (a, b, i)));
    let around = |p: DVec2| (p - 5.0, p + 5.0);
    compare(
        "boxes nearby, their number",
        places.iter().map(|&p| {
            let (min, max) = around(p);
            let theirs = bvh.intersect_aabb(&Aabb::new(min, max)).count();
            let ours = rstar.intersecting(min, max).count();
            (Some(ours as f64), Some(theirs as f64))
        }),
    );
    let lane = Polyline::new(line.clone()).expect("400 points");
    let index = LineIndex::new(&lane);
    let segments = SegmentIndex::new(line.windows(2).map(|w| (w[0], w[1], ())));
    let their_line = parry2d_f64::shape::Polyline::new(line.clone(), None);
    let on_line = |p: DVec2| p + dvec2(200.0, 0.0);
    let nearest = |p: DVec2| segments.nearest(on_line(p)).next().map(|(_, d)| d);
    compare(
        "nearest point of a line",
        places.iter().map(|&p| {
            let theirs = their_line.distance_to_local_point(on_line(p), true);
            (nearest(p), Some(theirs))
        }),
    );
    compare(
        "corners of a hull",
        clouds.iter().map(|cloud| {
            let (ours, theirs) = (our_hull(cloud.clone()), convex_hull(cloud));
            (Some(ours.len() as f64), Some(theirs.len() as f64))
        }),
    );

    let mut criterion = Criterion::default();
    let mut group = criterion.benchmark_group("per_thousand");
    let id = |library: &str, what: &str| BenchmarkId::new(what, library);
    macro_rules! time {
        ($what:literal, $library:literal, $cases:expr, $answer:expr) => {
            group.bench_function(id($library, $what), |b| {
                b.iter(|| {
                    $cases.iter().for_each(|case| {
                        black_box($answer(black_box(case)));
                    })
                });
            });
        };
    }
    type Pair = [Vehicle; 2];
    time!("overlap", "ours", pairs, |[a, b]: &Pair| a
        .ours
        .overlaps(&b.ours));
    time!("overlap", "ours_quads", pairs, |[a, b]: &Pair| a
        .quad
        .intersects(&b.quad));
    time!("overlap", "half_extents", pairs, |[a, b]: &Pair| {
        half_extents_overlap(&a.ours, &b.ours)
    });
    time!("overlap", "parry", pairs, |[a, b]: &Pair| {
        their_overlap(&a.pose, &a.cuboid, &b.pose, &b.cuboid)
    });
    time!("overlap", "parry_convex", pairs, |[a, b]: &Pair| {
        their_overlap(&identity, &a.convex, &identity, &b.convex)
    });
    time!("distance", "ours", apart, |[a, b]: &Pair| a
        .quad
        .distance(&b.quad));
    time!("distance", "in_frames", apart, |[a, b]: &Pair| {
        in_frames_distance(&a.ours, &b.ours)
    });
    time!("distance", "parry", apart, |[a, b]: &Pair| {
        their_distance(&a.pose, &a.cuboid, &b.pose, &b.cuboid)
    });
    time!("polygon_distance", "ours", apart, |[a, _]: &Pair| a
        .quad
        .distance_to_polygon(&area));
    time!("polygon_distance", "parry", apart, |[a, _]: &Pair| {
        their_distance(&a.pose, &a.cuboid, &identity, &mesh)
    });
    time!("contact", "ours", apart, |[a, b]: &Pair| our_contact(a, b));
    time!("contact", "parry", apart, |[a, b]: &Pair| their_contact(
        a, b
    ));
    time!("boxes_nearby", "ours_rstar", places, |&p: &DVec2| {
        let (min, max) = around(p);
        rstar.intersecting(min, max).count()
    });
    time!("boxes_nearby", "parry", places, |&p: &DVec2| {
        let (min, max) = around(p);
        bvh.intersect_aabb(&Aabb::new(min, max)).count()
    });
    time!("on_a_line", "ours_rstar", places, |&p: &DVec2| nearest(p));
    time!("on_a_line", "ours_line_index", places, |&p: &DVec2| index
        .project(&lane, on_line(p)));
    time!("on_a_line", "parry", places, |&p: &DVec2| {
        their_line.distance_to_local_point(on_line(p), true)
    });
    time!("hull", "ours", clouds, |cloud: &Vec<DVec2>| our_hull(
        cloud.clone()
    ));
    time!("hull", "parry", clouds, |cloud: &Vec<DVec2>| convex_hull(
        cloud
    ));
    group.bench_function(id("ours_rstar", "build_tree"), |b| {
        b.iter_batched(
            || boxes.clone(),
            |boxes| BoxIndex::new(boxes.into_iter().enumerate().map(|(i, (a, b))| (a, b, i))),
            BatchSize::SmallInput,
        );
    });
    group.bench_function(id("parry", "build_tree"), |b| {
        b.iter(|| {
            let leaves = boxes
                .iter()
                .map(|&(min, max)| Aabb::new(min, max))
                .enumerate();
            Bvh::from_iter(BvhBuildStrategy::Binned, leaves)
        });
    });
    group.finish();
}
