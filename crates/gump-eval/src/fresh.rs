//! Synthetic scenes that are made while a training run uses them, each for a while: `fresh:PROFILE`.
//!
//! Scenes form an endless stream: number `k` comes from the stream's seed and `k` alone. Step `s`
//! of a training run draws its samples from a window of the stream that moves on with `s`, so a
//! resumed run continues exactly where it was, and nothing about the stream is saved. A thread
//! makes scenes ahead of the window; a scene that is not ready is made by the caller.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use gump_scene::{Scenario, Seed};
use gump_synthesis::{Profile, SynthesisConfig};
use rayon::prelude::*;

use crate::{ArgumentError, EvalError};

/// The beginning of a stream's name.
pub const PREFIX: &str = "fresh:";
/// Scenes that samples of one step are drawn from: enough that a batch shows as many scenes, few
/// enough to be held (about 1.5 MB each).
const WINDOW: usize = 128;
/// Samples that a scene gives on average before it is left behind: they have other egos, other
/// presents and other augmentations.
const USES: usize = 8;
/// Forks of the seed: scenes to learn from, and scenes to validate on.
const TRAIN: u64 = 0;
/// See [`TRAIN`].
const VALIDATE: u64 = 1;

/// A stream of scenes in use: a window of it is held, and a thread makes scenes ahead.
pub struct FreshScenes {
    stream: SceneStream,
    shared: Arc<Shared>,
    /// Scenes by which the window moves on in a step, times [`USES`].
    batch: usize,
}

/// An endless stream of scenes: a profile and a seed.
#[derive(Clone, Debug)]
pub struct SceneStream {
    profile: Profile,
    config: SynthesisConfig,
    seed: Seed,
}

/// State shared by the thread that makes scenes and the threads that use them.
struct Shared {
    held: Mutex<Held>,
    /// Notified when the window moves on.
    moved: Condvar,
    ends: AtomicBool,
    n_generated: AtomicUsize,
}

/// The window.
#[derive(Default)]
struct Held {
    first: usize,
    scenes: BTreeMap<usize, Arc<Scenario>>,
}

impl SceneStream {
    /// The stream of this name, `fresh:PROFILE` or `fresh:PROFILE:SEED`; `None` for other names.
    ///
    /// # Errors
    /// [`ArgumentError::NoSuchProfile`], or [`ArgumentError::StreamSeed`].
    pub fn of_name(name: &Path) -> Result<Option<Self>, EvalError> {
        let Some(rest) = name.to_str().and_then(|name| name.strip_prefix(PREFIX)) else {
            return Ok(None);
        };
        let (profile, seed) = rest.split_once(':').unwrap_or((rest, "0"));
        let profile = profile_of_name(profile)?;
        let seed = seed.parse().map_err(|_| {
            let stream = rest.into();
            ArgumentError::StreamSeed { stream }
        })?;
        Ok(Some(Self {
            profile,
            config: profile.config(),
            seed: Seed(seed),
        }))
    }

    /// Scene `k` to learn from.
    fn scene(&self, k: usize) -> Scenario {
        let seed = self.seed.fork(TRAIN).fork(k as u64);
        self.profile.synthesize(&self.config, seed)
    }

    /// `n` scenes to validate on, which are none of those to learn from.
    pub fn validation(&self, n: usize) -> Vec<Scenario> {
        let seed = self.seed.fork(VALIDATE);
        let scene = |k: usize| self.profile.synthesize(&self.config, seed.fork(k as u64));
        (0..n).into_par_iter().map(scene).collect()
    }
}

/// The profile of this name.
///
/// # Errors
/// [`ArgumentError::NoSuchProfile`].
pub fn profile_of_name(name: &str) -> Result<Profile, EvalError> {
    Profile::of_name(name).ok_or_else(|| {
        let found = name.into();
        ArgumentError::NoSuchProfile { found }.into()
    })
}

impl FreshScenes {
    /// Starts to make the scenes that steps of `batch` samples are drawn from.
    pub fn start(stream: SceneStream, batch: usize) -> Self {
        let shared = Arc::new(Shared {
            held: Mutex::default(),
            moved: Condvar::new(),
            ends: AtomicBool::new(false),
            n_generated: AtomicUsize::new(0),
        });
        let fresh = Self {
            stream,
            shared,
            batch: batch.max(1),
        };
        let (stream, shared) = (fresh.stream.clone(), Arc::clone(&fresh.shared));
        std::thread::spawn(move || make_ahead(&stream, &shared));
        fresh
    }

    /// Number of scenes to draw from at any step.
    #[expect(clippy::len_without_is_empty, reason = "a stream is never empty")]
    pub fn len(&self) -> usize {
        WINDOW
    }

    /// The index of the scene that a draw of a step means; moves the window on.
    pub fn pick(&self, step: usize, draw: u64) -> usize {
        let first = step * self.batch / USES;
        self.shared.move_to(first);
        first + (draw % WINDOW as u64) as usize
    }

    /// A scene of the stream.
    pub fn get(&self, index: usize) -> Cow<'_, Scenario> {
        if let Some(scene) = self.shared.lock().scenes.get(&index) {
            return Cow::Owned(Scenario::clone(scene));
        }
        let scene = Arc::new(self.stream.scene(index));
        self.shared.keep(index, &scene);
        Cow::Owned(Arc::unwrap_or_clone(scene))
    }

    /// The stream by name and seed.
    pub(crate) fn identity(&self) -> String {
        let SceneStream { profile, seed, .. } = &self.stream;
        format!("{PREFIX}{}:{}", profile.name(), seed.0)
    }

    /// Scenes generated so far, by any thread.
    #[cfg(test)]
    fn n_generated(&self) -> usize {
        self.shared.n_generated.load(Ordering::Relaxed)
    }
}

impl Drop for FreshScenes {
    fn drop(&mut self) {
        // Under the lock, so that the thread cannot begin to wait in between.
        let _held = self.shared.lock();
        self.shared.ends.store(true, Ordering::Relaxed);
        self.shared.moved.notify_all();
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Held> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Moves the window on, never back: samples of the step before may still be drawn.
    fn move_to(&self, first: usize) {
        let mut held = self.lock();
        if first > held.first {
            held.first = first;
            held.scenes = held.scenes.split_off(&first);
            drop(held);
            self.moved.notify_all();
        }
    }

    /// Keeps a scene while it is in the window.
    fn keep(&self, index: usize, scene: &Arc<Scenario>) {
        self.n_generated.fetch_add(1, Ordering::Relaxed);
        let mut held = self.lock();
        if (held.first..held.first + 2 * WINDOW).contains(&index) {
            held.scenes.insert(index, Arc::clone(scene));
        }
    }
}

/// Makes the scenes of the window, and as many again after it, until the stream is dropped.
fn make_ahead(stream: &SceneStream, shared: &Shared) {
    // Starts with the first window; the first request of a resumed run moves it on.
    let mut held = shared.lock();
    while !shared.ends.load(Ordering::Relaxed) {
        let first = held.first;
        let missing = (first..first + WINDOW + WINDOW / 4).find(|k| !held.scenes.contains_key(k));
        let Some(k) = missing else {
            held = shared
                .moved
                .wait(held)
                .unwrap_or_else(PoisonError::into_inner);
            continue;
        };
        drop(held);
        let scene = Arc::new(stream.scene(k));
        shared.keep(k, &scene);
        held = shared.lock();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stream(name: &str) -> SceneStream {
        SceneStream::of_name(Path::new(name)).unwrap().unwrap()
    }

    #[test]
    fn names_are_understood_or_refused() {
        assert!(
            SceneStream::of_name(Path::new("some/folder"))
                .unwrap()
                .is_none()
        );
        assert_eq!(stream("fresh:recorded-like").profile, Profile::RecordedLike);
        assert_eq!(stream("fresh:plain:7").seed, Seed(7));
        let error = |name: &str| {
            SceneStream::of_name(Path::new(name))
                .unwrap_err()
                .to_string()
        };
        assert!(error("fresh:real").contains("plain, recorded-like, found \"real\""));
        assert!(error("fresh:plain:x").contains("a whole number as seed in fresh:plain:x"));
    }

    #[test]
    fn a_position_in_the_stream_is_all_that_counts() {
        let batch = 16;
        let [one, two] = [(); 2].map(|()| FreshScenes::start(stream("fresh:plain:3"), batch));
        // The second begins in the middle, as a resumed run does.
        let draws = [5_u64, 130, 999];
        for step in [0, 1, 40] {
            for draw in draws {
                let index = one.pick(step, draw);
                assert!((step * batch / USES..).contains(&index));
                if step == 40 {
                    assert_eq!(two.pick(step, draw), index);
                    let [a, b] = [&one, &two].map(|fresh| fresh.get(index).into_owned());
                    assert_eq!((a.id, a.log), (b.id, b.log));
                }
            }
        }
        assert!(one.n_generated() > 0);
    }

    #[test]
    fn what_the_window_has_left_is_not_held_and_never_picked_again() {
        let fresh = FreshScenes::start(stream("fresh:plain:1"), 8 * USES);
        let old = fresh.pick(0, 0);
        assert!(!fresh.get(old).log.is_empty());
        let later = WINDOW / 8 + 1;
        assert!((0..500).all(|draw| fresh.pick(later, draw) > old));
        assert!(!fresh.shared.lock().scenes.contains_key(&old));
        // Drives of the network ask for scenes of the past: they are made again.
        assert!(fresh.get(old).id.ends_with(&format!("{:016x}", {
            fresh.stream.seed.fork(TRAIN).fork(old as u64).0
        })));
    }

    #[test]
    fn scenes_to_validate_on_are_others() {
        let stream = stream("fresh:plain");
        let validation = stream.validation(2);
        let ids: Vec<String> = (0..2).map(|k| stream.scene(k).id).collect();
        assert!(validation.iter().all(|scene| !ids.contains(&scene.id)));
    }
}
