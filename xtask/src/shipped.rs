//! Files shipped with the driver: a small data set and small weights.

use std::path::{Path, PathBuf};

use gump_eval::worlds::WorldName;

use crate::installed::home;

/// The folder of the shipped data set.
pub(crate) fn data() -> PathBuf {
    from_here(&home().join("datasets/mini"))
}

/// The shipped scenario that verbs use by default: a crossing with traffic lights, which the
/// shipped weights were not trained on.
pub(crate) fn scenario() -> String {
    format!("{}#20", data().join("procedural.tfrecord.gz").display())
}

/// The scene of the demo: a signalized crossing with turns and people, of no split.
pub(crate) fn demo() -> String {
    let path = home().join("datasets/demo/crossing.tfrecord.gz");
    format!("{}#0", from_here(&path).display())
}

/// The shipped weights of the sequence network, which generates scenes and spawns and removes
/// agents.
pub(crate) fn weights() -> PathBuf {
    from_here(&home().join("datasets/weights/gump-tiny.safetensors"))
}

/// The shipped weights of the relative network, which drives the agents of a scene.
pub(crate) fn traffic() -> PathBuf {
    from_here(&home().join("datasets/weights/gump-relative.safetensors"))
}

/// The shipped learned world.
pub(crate) fn world() -> WorldName {
    WorldName::Model(traffic())
}

/// The shipped learned world of the sequence network, in which everything about decoding can be
/// turned.
pub(crate) fn sequence_world() -> WorldName {
    WorldName::Model(weights())
}

/// Makes sure that the shipped weights are there.
///
/// Error: they are not.
pub(crate) fn check_weights() -> anyhow::Result<()> {
    for path in [weights(), traffic()] {
        anyhow::ensure!(
            path.is_file(),
            "expected the shipped weights at {}; \
             GUMP_HOME names the folder that holds datasets, and \
             `cargo xtask train --data datasets/mini` makes others",
            path.display()
        );
    }
    Ok(())
}

/// The path as seen from the working directory where that is shorter: reports stay the same
/// wherever the files lie.
fn from_here(path: &Path) -> PathBuf {
    let here = std::env::current_dir().unwrap_or_default();
    path.strip_prefix(here).unwrap_or(path).to_owned()
}
