//! Eight futures from one moment, in which the network drives all agents.

use gump_metrics::overlapping;
use gump_scene::{AgentId, Frame, SceneState, Seed};

use crate::engine::{LiveFuture, RelativeWorld};
use crate::game::{STRIDE, is_off_road};
use crate::signals::Signals;

/// Number of futures: as many as can be told apart on the page. Chosen by eye.
pub const FUTURES: usize = 8;
/// Half seconds of each future: eight seconds, the horizon of Waymo's challenges.
pub const STEPS: usize = 16;
/// Separates the randomness of futures from that of the drive.
const STREAM: u64 = 1 << 32;

/// Futures from one moment of a drive.
#[derive(Clone, Debug)]
pub struct Branches {
    /// Half seconds before the moment.
    knot: usize,
    temperature: f64,
    present: Frame,
    entangled: Vec<AgentId>,
    branches: Vec<Branch>,
}

/// One of the futures, half second by half second.
#[derive(Clone, Debug)]
pub struct Branch {
    live: LiveFuture,
    /// The moment, then one frame for each half second.
    pub frames: Vec<Frame>,
    /// Metres that the ego has driven.
    pub metres: f64,
    /// Half seconds until the ego first overlapped another agent.
    pub collided: Option<usize>,
    /// Half seconds until the ego first left the road.
    pub off_road: Option<usize>,
}

impl Branches {
    pub(crate) fn new(
        live: &LiveFuture,
        frames: &[Frame],
        seed: u64,
        knot: usize,
        temperature: f64,
    ) -> Self {
        let present = frames.last().cloned().unwrap_or_default();
        let moment = Seed(seed).fork(STREAM + knot as u64);
        let branch = |k: usize| Branch {
            live: live.fork(moment.fork(k as u64)),
            frames: vec![present.clone()],
            metres: 0.0,
            collided: None,
            off_road: None,
        };
        Self {
            knot,
            temperature,
            branches: (0..FUTURES).map(branch).collect(),
            entangled: Vec::new(),
            present,
        }
    }

    pub(crate) fn temperature(&self) -> f64 {
        self.temperature
    }

    /// Frames of the drive before the moment.
    pub fn from_frame(&self) -> usize {
        self.knot * STRIDE
    }

    /// The futures.
    pub fn all(&self) -> &[Branch] {
        &self.branches
    }

    /// Half seconds simulated so far, over all futures, and their final number.
    pub fn progress(&self) -> (usize, usize) {
        let done = self.branches.iter().map(|branch| branch.frames.len() - 1);
        (done.sum(), FUTURES * STEPS)
    }

    /// Advances the shortest future by half a second; false once all are done.
    pub(crate) fn step(
        &mut self,
        world: &RelativeWorld,
        signals: &Signals,
        scene: SceneState<'_>,
    ) -> bool {
        if self.entangled.is_empty()
            && let Some(ego) = self.present.agent(scene.ego)
        {
            self.entangled = overlapping(&self.present, ego).collect();
        }
        let behind = self.branches.iter_mut().min_by_key(|b| b.frames.len());
        let Some(branch) = behind.filter(|branch| branch.frames.len() <= STEPS) else {
            return false;
        };
        let n = branch.frames.len();
        branch.live.show(&signals.at((self.knot + n) * STRIDE));
        branch.live.decide(world, None);
        let next = branch.live.go_on(world, None);
        let lights = signals.at((self.knot + n) * STRIDE);
        let frame = Frame::new(next.agents().to_vec(), lights);
        let before = branch.frames.last().and_then(|f| f.agent(scene.ego));
        if let (Some(before), Some(ego)) = (before, frame.agent(scene.ego)) {
            let step = ego.state.pose.position - before.state.pose.position;
            branch.metres += step.length();
            let hit = overlapping(&frame, ego).any(|other| !self.entangled.contains(&other));
            if hit {
                branch.collided.get_or_insert(n);
            }
            let now = SceneState {
                history: std::slice::from_ref(&frame),
                ..scene
            };
            if is_off_road(&now) {
                branch.off_road.get_or_insert(n);
            }
        }
        branch.frames.push(frame);
        true
    }
}
