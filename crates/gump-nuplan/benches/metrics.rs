//! The time of scoring 15 s at 10 Hz among 50 agents, in closed loop and one filter alone.
//!
//! The road has what nuPlan's maps have: lanes with outlines in roadblocks, intersections between
//! them, and drivable polygons. The official time for the closed-loop metrics of such a scenario
//! is 169 ms of processor time and 504 ms on the clock (18 agents, see `docs/results/0004-nuplan.md`).

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use gump_geometry::{Polygon, Polyline, Pose, dvec2};
use gump_nuplan::metrics::{Sample, SavitzkyGolay, SimulationHistory, score};
use gump_scene::{
    Agent, AgentId, AgentKind, AgentState, Area, AreaKind, EgoState, Frame, Lane, LaneId, MapGraph,
    MapParts, Roadblock, RoadblockId, VehicleParameters,
};

const N_SAMPLES: i64 = 150;
const N_AGENTS: i64 = 50;
/// Length of a roadblock, metres; every third one is an intersection.
const BLOCK: f64 = 60.0;

fn rectangle(from: f64, to: f64, low: f64, high: f64) -> Polygon {
    let ring = vec![
        dvec2(from, low),
        dvec2(to, low),
        dvec2(to, high),
        dvec2(from, high),
    ];
    Polygon::new(ring).expect("four corners")
}

/// Six lanes, twelve roadblocks long.
fn road() -> MapGraph {
    let mut parts = MapParts::default();
    for block in 0..12i64 {
        let (from, to) = (block as f64 * BLOCK, (block + 1) as f64 * BLOCK);
        let in_intersection = block % 3 == 2;
        let outline = rectangle(from, to, 0.0, 21.0);
        if in_intersection {
            let area = Area::new(1000 + block, AreaKind::Intersection, outline.clone());
            parts.areas.push(area);
        }
        parts.drivable.push(outline.clone());
        parts.roadblocks.push(Roadblock {
            id: RoadblockId(block),
            outline,
            in_intersection,
            predecessors: vec![RoadblockId(block - 1)],
            successors: vec![RoadblockId(block + 1)],
        });
        for row in 0..6i64 {
            let y = row as f64 * 3.5 + 1.75;
            let points = (0..=60).map(|i| dvec2(from + BLOCK / 60.0 * f64::from(i), y));
            let centerline = Polyline::new(points.collect()).expect("61 points");
            parts.lanes.push(Lane {
                in_intersection,
                speed_limit: Some(15.0),
                outline: Some(rectangle(from, to, y - 1.75, y + 1.75)),
                roadblock: Some(RoadblockId(block)),
                predecessors: vec![LaneId((block - 1) * 10 + row)],
                successors: vec![LaneId((block + 1) * 10 + row)],
                ..Lane::new(LaneId(block * 10 + row), centerline, vec![0.0; 61])
            });
        }
    }
    MapGraph::new(parts).expect("a road")
}

fn ego(k: i64, speed: f64) -> EgoState {
    let t = k as f64 * 0.1;
    EgoState {
        time_us: k * 100_000,
        rear_axle: Pose::new(20.0 + speed * t, 8.75 + (0.3 * t).sin(), 0.0),
        velocity: dvec2(speed, 0.0),
        acceleration: dvec2((0.5 * t).sin(), 0.0),
        ..EgoState::default()
    }
}

/// Traffic in all lanes, a little slower and faster than the ego.
fn frame(k: i64) -> Frame {
    let agent = |id: i64| {
        let speed = 10.0 + (id % 7) as f64 - 3.0;
        let x = (id / 6) as f64 * 22.0 - 10.0 + speed * k as f64 * 0.1;
        Agent {
            id: AgentId(id),
            kind: AgentKind::Vehicle,
            length: 4.7,
            width: 2.0,
            height: 1.6,
            elevation: 0.0,
            state: AgentState {
                pose: Pose::new(x, (id % 6) as f64 * 3.5 + 1.75, 0.0),
                velocity: dvec2(speed, 0.0),
            },
        }
    };
    Frame::new((0..N_AGENTS).map(agent).collect(), Vec::new())
}

fn bench(c: &mut Criterion) {
    let map = road();
    let samples: Vec<Sample> = (0..N_SAMPLES)
        .map(|k| Sample {
            ego: ego(k, 10.0),
            frame: frame(k),
            plan: Vec::new(),
        })
        .collect();
    let expert: Vec<EgoState> = (0..=N_SAMPLES).map(|k| ego(k, 11.0)).collect();
    let drive = SimulationHistory {
        samples: &samples,
        expert: &expert,
        map: &map,
        ego: None,
        vehicle: VehicleParameters::PACIFICA,
    };
    c.bench_function("closed-loop score, 150 samples, 50 agents", |b| {
        b.iter(|| score(black_box(&drive)).expect("a drive"));
    });
    let jerk = SavitzkyGolay {
        window: 15,
        polynomial: 2,
        derivative: 1,
        delta: 0.1,
    };
    let series: Vec<f64> = (0..N_SAMPLES).map(|k| (k as f64 * 0.1).sin()).collect();
    c.bench_function("Savitzky-Golay, 150 samples", |b| {
        b.iter(|| jerk.filter(black_box(&series)));
    });
}

criterion_group!(benches, bench);
criterion_main!(benches);
