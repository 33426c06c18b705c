//! The relative network without the tensor library: one frame of one future at a time.
//!
//! Keys and values of a node never change once they are computed, so a frame costs only its own
//! nodes. The state of a future is stored with its agents; the map is computed once and shared.

use gump_kernels::edge_attention::{Heads, attend};
use gump_kernels::gelu::gelu_row;
use gump_kernels::gru::gru_row;
use gump_kernels::norm::NORM_EPS;
use gump_kernels::norm::normalize_row;
use gump_kernels::panels::{Panels, Precision, Scratch};
use gump_kernels::wide;
use gump_model::ModelError;
use gump_model::relative::graph::{EDGE_NUMBERS, NODE_NUMBERS, PAST, Shown, View};
use gump_model::relative::grid::{ALL_BINS, BINS, FIELDS, STANDS, first_bin, quantize_ahead};
use gump_model::relative::map::{PIECE_NUMBERS, VectorMap};
use gump_model::relative::{RelativeConfig, RelativeWeights};
use gump_model::steps::TOKEN_DT;
use gump_scene::{AgentKind, Seed};

use crate::expressible::expressible;
use crate::nucleus::{least_kept, uniform};

/// Number of frames kept of an agent: the present and all that the network attends to.
pub(super) const KEPT: usize = PAST + 1;

/// The network with packed weights.
#[derive(Debug)]
pub struct RelativeEngine {
    config: RelativeConfig,
    nodes: [Panels; 2],
    pieces: [Panels; 2],
    edges: [Panels; 2],
    layers: Vec<Layer>,
    norm: Norm,
    /// Input products of the gates for every bin that enters, `[ALL_BINS, 3C]`, and for every step,
    /// bias included, `[FIELDS, 3C]`.
    bin_gates: Vec<f32>,
    step_gates: Vec<f32>,
    hidden: Panels,
    /// By field.
    heads: Vec<Panels>,
}

#[derive(Debug)]
struct Layer {
    norm: Norm,
    queries: Panels,
    sources: Panels,
    piece_sources: Panels,
    out: Panels,
    norm_mlp: Norm,
    mlp_in: Panels,
    mlp_out: Panels,
}

#[derive(Debug)]
struct Norm {
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Norm {
    fn apply(&self, x: &[f32], y: &mut Vec<f32>) {
        let c = self.weight.len();
        y.resize(x.len(), 0.0);
        wide(
            #[inline(always)]
            || {
                for (x, y) in x.chunks_exact(c).zip(y.chunks_exact_mut(c)) {
                    normalize_row(x, &self.weight, &self.bias, NORM_EPS as f32, y);
                }
            },
        );
    }
}

/// Keys and values of the pieces of a map, by layer, `[pieces, 2C]`.
#[derive(Debug)]
pub struct MapMemory {
    layers: Vec<Vec<f32>>,
}

/// Keys and values of an agent's last frames, `[layers, KEPT, 2C]`; frame `t` lies at `t % KEPT`.
#[derive(Clone, Debug)]
pub(super) struct AgentMemory(Vec<f32>);

/// Working memory.
#[derive(Debug, Default)]
pub struct Workspace {
    panels: Scratch,
    x: Vec<f32>,
    normed: Vec<f32>,
    wide: Vec<f32>,
    queries: Vec<f32>,
    attended: Vec<f32>,
    features: Vec<f32>,
    raw: Vec<f32>,
    scores: Vec<f32>,
}

/// An agent of the frame to compute.
pub struct Present<'a> {
    pub(super) numbers: [f32; NODE_NUMBERS],
    pub(super) past: Vec<[f32; EDGE_NUMBERS]>,
    /// Neighbours are counted among all agents that are computed together.
    pub(super) view: View,
    pub(super) memory: &'a mut AgentMemory,
    /// The map that its view is of.
    pub(super) map: &'a MapMemory,
    /// Index of the frame within its future.
    pub(super) t: usize,
}

/// Settings of draws.
#[derive(Clone, Copy, Debug)]
pub struct Draw {
    /// Divides the logits.
    pub temperature: f64,
    /// Nucleus of the distance ahead: draws are among the most likely bins that together have this
    /// probability.
    pub top_p: f64,
}

/// What is drawn of an agent's next half second, by how it moves now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reach {
    /// The greatest bin ahead.
    most: u16,
    /// Whether standing is drawn however unlikely it is.
    is_slow: bool,
}

/// Below this speed vehicles and bicycles may stand in the next half second, however unlikely that is, m/s;
/// above it the tail is cut off as it is off the distance ahead: 2.4 % of the raw futures of vehicles above 22 m/s
/// stopped within half a second at some time in 8 s (result 51).
const SLOW_MPS: f64 = 2.5;
/// Greatest acceleration of wheels, m/s²: twice that of a quick car, as speeds of recorded boxes are not exact.
const SPEEDS_UP: f64 = 8.0;

impl Reach {
    /// Every move.
    pub const ANY: Self = Self {
        most: BINS[1] as u16 - 1,
        is_slow: true,
    };

    /// Of an agent that moves like this; of people every move is.
    pub fn of(agent: &Shown) -> Self {
        let speed = agent.velocity().dot(agent.pose.direction());
        if agent.body.kind == AgentKind::Pedestrian || speed < SLOW_MPS {
            return Self::ANY;
        }
        Self {
            most: quantize_ahead((speed + SPEEDS_UP * TOKEN_DT) * TOKEN_DT),
            is_slow: false,
        }
    }
}

/// Of the tail that is cut off the distance ahead, the share that is cut off sideways moves and turns.
/// Changes of lane and turns of people begin with a move that is rare. Less makes them more frequent,
/// and alone agents collide more (result 42).
const SIDEWAYS: f64 = 0.4;

impl Draw {
    /// The settings of a field. The choice of who is slow whether to stand is not truncated: rare starts
    /// must still occur.
    fn of_field(self, field: usize, reach: Reach) -> Self {
        let top_p = match field {
            0 if reach.is_slow => 1.0,
            0 | 1 => self.top_p,
            _ => 1.0 - SIDEWAYS * (1.0 - self.top_p),
        };
        Self { top_p, ..self }
    }
}

impl RelativeEngine {
    /// Packs the weights.
    ///
    /// # Errors
    /// Weights with a missing parameter, or with a number that the precision cannot express.
    pub fn new(weights: &RelativeWeights, precision: Precision) -> Result<Self, ModelError> {
        let config = weights.config().clone();
        let c = config.width;
        let get = |name: &str| {
            let found = weights.find(name);
            found.ok_or_else(|| ModelError::MissingTensor {
                name: name.to_owned(),
            })
        };
        let linear_in = |name: &str, n_in: usize, precision: Precision| {
            let name_of_weight = format!("{name}.weight");
            let weight = get(&name_of_weight)?;
            expressible(&name_of_weight, weight, precision)?;
            let bias = weights.find(&format!("{name}.bias"));
            Ok::<_, ModelError>(Panels::new(weight, n_in, bias, precision))
        };
        let linear = |name: &str, n_in: usize| linear_in(name, n_in, precision);
        // What enters first is in numbers of many sizes, and cheap: full precision.
        let mlp = |name: &str, n_in: usize, hidden: usize| {
            let first = linear_in(&format!("{name}.first"), n_in, Precision::F32)?;
            let second = linear_in(&format!("{name}.second"), hidden, Precision::F32)?;
            Ok::<_, ModelError>([first, second])
        };
        let norm = |name: &str| {
            Ok::<_, ModelError>(Norm {
                weight: get(&format!("{name}.weight"))?.to_vec(),
                bias: get(&format!("{name}.bias"))?.to_vec(),
            })
        };
        let layer = |i: usize| {
            let part = |part: &str| format!("layers.{i}.{part}");
            Ok::<_, ModelError>(Layer {
                norm: norm(&part("norm"))?,
                queries: linear(&part("queries"), c)?,
                sources: linear(&part("sources"), c)?,
                piece_sources: linear(&part("piece_sources"), c)?,
                out: linear(&part("out"), c + config.heads * config.edge_width)?,
                norm_mlp: norm(&part("norm_mlp"))?,
                mlp_in: linear(&part("mlp_in"), c)?,
                mlp_out: linear(&part("mlp_out"), 4 * c)?,
            })
        };
        let weight = get("decoder.input.weight")?;
        let bias = get("decoder.input.bias")?;
        let gates = |bias: Option<&[f32]>, x: &[f32]| {
            let panels = Panels::new(weight, c, bias, Precision::F32);
            let mut y = vec![0.0; 3 * x.len()];
            panels.apply(x, &mut y, &mut Scratch::default());
            y
        };
        let head = get("decoder.head.weight")?;
        expressible("decoder.head.weight", head, precision)?;
        let of_field = |field: usize| {
            let rows = &head[first_bin(field) * c..(first_bin(field) + BINS[field]) * c];
            Panels::new(rows, c, None, precision)
        };
        Ok(Self {
            nodes: mlp("nodes", NODE_NUMBERS, 2 * c)?,
            pieces: mlp("pieces", PIECE_NUMBERS, c)?,
            edges: mlp("edges", EDGE_NUMBERS, config.edge_hidden)?,
            layers: (0..config.layers).map(layer).collect::<Result<_, _>>()?,
            norm: norm("norm")?,
            bin_gates: gates(None, get("decoder.table")?),
            step_gates: gates(Some(bias), get("decoder.slots")?),
            hidden: linear("decoder.hidden", c)?,
            heads: (0..FIELDS).map(of_field).collect(),
            config,
        })
    }

    /// Numbers of a hidden vector.
    pub(super) fn width(&self) -> usize {
        self.config.width
    }

    fn heads_of(&self) -> Heads {
        Heads {
            n: self.config.heads,
            d: self.config.width / self.config.heads,
            f: self.config.edge_width,
        }
    }

    /// The keys and values of a map.
    pub fn remember(&self, map: &VectorMap) -> MapMemory {
        let (c, m) = (self.config.width, map.pieces.len());
        let mut room = Workspace::default();
        apply_mlp(
            &self.pieces,
            &map.numbers,
            &mut room.wide,
            &mut room.x,
            &mut room.panels,
        );
        let layers = self.layers.iter().map(|layer| {
            let mut sources = vec![0.0; m * 2 * c];
            layer
                .piece_sources
                .apply(&room.x, &mut sources, &mut room.panels);
            sources
        });
        MapMemory {
            layers: layers.collect(),
        }
    }

    /// The memory of an agent without observations.
    pub(super) fn blank(&self) -> AgentMemory {
        AgentMemory(vec![0.0; self.layers.len() * KEPT * 2 * self.config.width])
    }

    /// Computes frames, of one future or of several: the hidden vectors of their agents,
    /// `[agents, C]`, into `out`. A row does not depend on the other rows, bit for bit.
    pub fn read(&self, agents: &mut [Present<'_>], room: &mut Workspace, out: &mut Vec<f32>) {
        let (c, f, heads) = (self.config.width, self.config.edge_width, self.heads_of());
        let n = agents.len();
        room.raw.clear();
        agents
            .iter()
            .for_each(|agent| room.raw.extend(agent.numbers));
        apply_mlp(
            &self.nodes,
            &room.raw,
            &mut room.wide,
            &mut room.x,
            &mut room.panels,
        );
        // Edges agent by agent: the past, the neighbours, the pieces.
        room.raw.clear();
        let mut firsts = Vec::with_capacity(n + 1);
        for agent in agents.iter() {
            firsts.push(room.raw.len() / EDGE_NUMBERS);
            agent.past.iter().for_each(|row| room.raw.extend(row));
            agent
                .view
                .neighbours
                .iter()
                .for_each(|(_, row)| room.raw.extend(row));
            agent
                .view
                .pieces
                .iter()
                .for_each(|(_, row)| room.raw.extend(row));
        }
        let mut features = std::mem::take(&mut room.features);
        apply_mlp(
            &self.edges,
            &room.raw,
            &mut room.wide,
            &mut features,
            &mut room.panels,
        );
        let attended = c + heads.n * f;
        for (l, layer) in self.layers.iter().enumerate() {
            layer.norm.apply(&room.x, &mut room.normed);
            room.wide.resize(n * 2 * c, 0.0);
            layer
                .sources
                .apply(&room.normed, &mut room.wide, &mut room.panels);
            let rows = room.wide.chunks_exact(2 * c);
            for (agent, row) in agents.iter_mut().zip(rows) {
                let t = agent.t % KEPT;
                agent.memory.0[(l * KEPT + t) * 2 * c..][..2 * c].copy_from_slice(row);
            }
            room.queries.resize(n * attended, 0.0);
            layer
                .queries
                .apply(&room.normed, &mut room.queries, &mut room.panels);
            room.attended.resize(n * attended, 0.0);
            for (i, agent) in agents.iter().enumerate() {
                let (past, view, t) = (agent.past.len(), &agent.view, agent.t);
                let near = past + view.neighbours.len();
                let at = |agent: usize, t: usize| {
                    &agents[agent].memory.0[(l * KEPT + t % KEPT) * 2 * c..][..2 * c]
                };
                let source = |e: usize| {
                    if e < past {
                        at(i, t - e)
                    } else if e < near {
                        at(view.neighbours[e - past].0, t)
                    } else {
                        let piece = view.pieces[e - near].0 as usize;
                        &agent.map.layers[l][piece * 2 * c..][..2 * c]
                    }
                };
                let first = firsts[i];
                let feature = |e: usize| &features[(first + e) * f..][..f];
                let query = &room.queries[i * attended..][..attended];
                let out = &mut room.attended[i * attended..][..attended];
                let n_edges = near + view.pieces.len();
                let scores = &mut room.scores;
                wide(
                    #[inline(always)]
                    || attend(heads, query, n_edges, source, feature, scores, out),
                );
            }
            room.normed.resize(n * c, 0.0);
            layer
                .out
                .apply(&room.attended, &mut room.normed, &mut room.panels);
            add(&mut room.x, &room.normed);
            layer.norm_mlp.apply(&room.x, &mut room.normed);
            room.wide.resize(n * 4 * c, 0.0);
            layer
                .mlp_in
                .apply(&room.normed, &mut room.wide, &mut room.panels);
            gelu_row(&mut room.wide);
            layer
                .mlp_out
                .apply(&room.wide, &mut room.normed, &mut room.panels);
            add(&mut room.x, &room.normed);
        }
        room.features = features;
        self.norm.apply(&room.x, out);
    }

    /// Draws the next moves of agents with these hidden vectors, `[n, C]`, each from its own
    /// stream and within its reach.
    pub fn decide(
        &self,
        hidden: &[f32],
        (streams, reach): (&[Seed], &[Reach]),
        draw: Draw,
        room: &mut Workspace,
    ) -> Vec<[u16; FIELDS]> {
        let (n, c) = (streams.len(), self.config.width);
        let mut moves = vec![[0; FIELDS]; n];
        let states = &mut room.x;
        states.clear();
        states.extend_from_slice(hidden);
        for field in 0..FIELDS {
            room.wide.resize(3 * n * c, 0.0);
            self.hidden.apply(states, &mut room.wide, &mut room.panels);
            let of_step = &self.step_gates[field * 3 * c..][..3 * c];
            for (i, h) in states.chunks_exact_mut(c).enumerate() {
                room.raw.clear();
                room.raw.extend_from_slice(of_step);
                if let Some(before) = field.checked_sub(1) {
                    let row = first_bin(before) + usize::from(moves[i][before]);
                    add(&mut room.raw, &self.bin_gates[row * 3 * c..][..3 * c]);
                }
                let (x, g) = (&room.raw, &room.wide[i * 3 * c..][..3 * c]);
                wide(
                    #[inline(always)]
                    || gru_row(x, g, h),
                );
            }
            room.queries.resize(n * BINS[field], 0.0);
            self.heads[field].apply(states, &mut room.queries, &mut room.panels);
            for (i, logits) in room.queries.chunks_exact(BINS[field]).enumerate() {
                let stands = field > 0 && moves[i][0] == STANDS;
                let last = match field {
                    1 => usize::from(reach[i].most),
                    _ => BINS[field] - 1,
                };
                moves[i][field] = match stands {
                    true => 0,
                    false => choose(
                        &logits[..=last],
                        uniform(streams[i].fork(field as u64)),
                        draw.of_field(field, reach[i]),
                        &mut room.scores,
                    ),
                };
            }
        }
        debug_assert!(ALL_BINS == self.bin_gates.len() / (3 * c));
        moves
    }
}

fn apply_mlp(
    [first, second]: &[Panels; 2],
    x: &[f32],
    between: &mut Vec<f32>,
    y: &mut Vec<f32>,
    room: &mut Scratch,
) {
    let rows = x.len() / first.n_in();
    between.resize(rows * first.n_out(), 0.0);
    first.apply(x, between, room);
    gelu_row(between);
    y.resize(rows * second.n_out(), 0.0);
    second.apply(between, y, room);
}

fn add(x: &mut [f32], y: &[f32]) {
    wide(
        #[inline(always)]
        || x.iter_mut().zip(y).for_each(|(x, y)| *x += y),
    );
}

/// The bin at which the cumulative tempered distribution, truncated to its nucleus, exceeds
/// `uniform`.
fn choose(logits: &[f32], uniform: f64, draw: Draw, weights: &mut Vec<f32>) -> u16 {
    let best = |logits: &[f32]| {
        let best = logits.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1));
        best.map_or(0, |(i, _)| i) as u16
    };
    if draw.temperature <= 0.0 {
        return best(logits);
    }
    let peak = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let inverse = (1.0 / draw.temperature) as f32;
    weights.clear();
    weights.extend(logits.iter().map(|logit| ((logit - peak) * inverse).exp()));
    let mut total: f64 = weights.iter().map(|w| f64::from(*w)).sum();
    if draw.top_p < 1.0 {
        let least = least_kept(&mut weights.clone(), draw.top_p);
        weights
            .iter_mut()
            .filter(|w| **w < least)
            .for_each(|w| *w = 0.0);
        total = weights.iter().map(|w| f64::from(*w)).sum();
    }
    let mut left = uniform * total;
    for (i, weight) in weights.iter().enumerate() {
        left -= f64::from(*weight);
        if left < 0.0 {
            return i as u16;
        }
    }
    best(logits)
}

#[cfg(test)]
mod tests {
    use gump_geometry::{DVec2, Pose};
    use gump_model::relative::graph::Body;

    use super::*;

    #[test]
    fn less_is_cut_off_sideways_moves_than_off_the_distance() {
        let draw = |top_p| Draw {
            temperature: 1.0,
            top_p,
        };
        let cut =
            |top_p| [0, 1, 2, 3].map(|field| 1.0 - draw(top_p).of_field(field, Reach::ANY).top_p);
        let [stands, ahead, side, turn] = cut(0.95);
        assert!(stands == 0.0 && (ahead - 0.05).abs() < 1e-9);
        assert!(side > 0.0 && side < ahead && side == turn);
        assert_eq!(cut(1.0), [0.0; 4]);
    }

    #[test]
    fn who_drives_does_not_stand_at_once_unless_that_is_likely() {
        let moving = |kind, speed: f64| {
            let body = Body {
                kind,
                length: 4.0,
                width: 2.0,
                sized: true,
            };
            Shown::first(
                body,
                Pose::new(3.0, 1.0, 0.6),
                DVec2::from_angle(0.6) * speed,
            )
        };
        let draw = Draw {
            temperature: 1.0,
            top_p: 0.95,
        };
        // Drives on, or stands.
        let count = |agent: &Shown, stands: f32| {
            let draw = draw.of_field(0, Reach::of(agent));
            let logits = [(1.0 - stands).ln(), stands.ln()];
            let all = (0..4000).map(|i| uniform(Seed(i)));
            all.filter(|u| choose(&logits, *u, draw, &mut Vec::new()) == STANDS)
                .count()
        };
        for kind in [AgentKind::Vehicle, AgentKind::Bicycle] {
            assert_eq!(count(&moving(kind, 12.0), 0.02), 0);
            assert!(count(&moving(kind, 12.0), 0.3) > 1000);
            assert!(count(&moving(kind, 1.0), 0.02) > 40);
            // 12 m/s and 4 more within half a second.
            assert_eq!(Reach::of(&moving(kind, 12.0)).most, quantize_ahead(8.0));
        }
        assert_eq!(Reach::of(&moving(AgentKind::Pedestrian, 3.0)), Reach::ANY);
    }

    #[test]
    fn draws_follow_the_distribution_and_leave_its_tail_out() {
        let logits = [0.0, (3.0f32).ln(), f32::NEG_INFINITY, (0.01f32).ln()];
        let count = |draw: Draw, wanted: u16| {
            let mut room = Vec::new();
            let all = (0..4000).map(|i| uniform(Seed(i)));
            all.filter(|u| choose(&logits, *u, draw, &mut room) == wanted)
                .count()
        };
        let free = Draw {
            temperature: 1.0,
            top_p: 1.0,
        };
        assert!((2900..3100).contains(&count(free, 1)), "{}", count(free, 1));
        assert!(count(free, 3) > 0 && count(free, 2) == 0);
        assert_eq!(
            count(
                Draw {
                    top_p: 0.99,
                    ..free
                },
                3
            ),
            0
        );
        assert_eq!(
            count(
                Draw {
                    temperature: 0.0,
                    ..free
                },
                1
            ),
            4000
        );
    }

    #[cfg(feature = "tensors")]
    #[test]
    fn weights_without_end_are_refused_by_name() {
        use candle_core::{Device, Tensor};
        use gump_model::relative::RelativeNetwork;

        let config = RelativeConfig {
            width: 16,
            layers: 1,
            heads: 2,
            edge_width: 8,
            edge_hidden: 16,
        };
        let network = RelativeNetwork::random(config, Seed(1), &Device::Cpu).unwrap();
        for name in ["layers.0.queries.weight", "decoder.head.weight"] {
            let weight = network.parameters().find(name).unwrap();
            let plain = weight.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let build = |number: f32, precision| {
                let mut numbers = plain.clone();
                numbers[7] = number;
                let tensor = Tensor::from_slice(&numbers, weight.shape(), weight.device());
                weight.set(&tensor.unwrap()).unwrap();
                let built = RelativeEngine::new(&RelativeWeights::of(&network).unwrap(), precision);
                built.map(|_| ()).map_err(|error| error.to_string())
            };
            for (precision, form) in [(Precision::Bf16, "bfloat16"), (Precision::Int8, "8 bits")] {
                let why = build(f32::INFINITY, precision).unwrap_err();
                assert!(
                    why.contains(name) && why.contains("inf") && why.contains(form),
                    "{why}"
                );
            }
            // The largest f32 is beyond the largest bfloat16.
            assert!(build(f32::MAX, Precision::Bf16).is_err());
            assert!(build(f32::MAX, Precision::Int8).is_ok());
            assert!(build(plain[7], Precision::Bf16).is_ok());
        }
    }
}
