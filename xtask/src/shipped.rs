//! What the repository ships: a small data set and small weights.

use std::path::{Path, PathBuf};

use anyhow::Context as _;

use crate::dataset::{self, Split};
use crate::machine::repository;
use crate::worlds::WorldName;

/// The folder of the shipped data set.
pub(crate) fn data() -> PathBuf {
    from_here(&repository().join("datasets/mini"))
}

/// The shipped scenario that verbs use unless told otherwise: the last of the test split, a crossing
/// with traffic lights.
///
/// Error: the manifest of the shipped data cannot be read.
pub(crate) fn scenario() -> anyhow::Result<String> {
    let parts = dataset::parts(&data(), Split::Test)?;
    let first = parts
        .first()
        .context("the shipped data has no test split")?;
    Ok(format!("{}#{}", first.path.display(), first.scenes.start))
}

/// The shipped weights.
pub(crate) fn weights() -> PathBuf {
    from_here(&repository().join("datasets/weights/gump-tiny.safetensors"))
}

/// The shipped learned world.
pub(crate) fn world() -> WorldName {
    WorldName::Model(weights())
}

/// Makes sure that the shipped weights are there.
///
/// Error: they are not.
pub(crate) fn check_weights() -> anyhow::Result<()> {
    let path = weights();
    std::fs::metadata(&path).map(drop).with_context(|| {
        format!(
            "expected the shipped weights at {}; \
             `cargo xtask train --data datasets/mini` makes others",
            path.display()
        )
    })
}

/// The path as seen from the working directory where that is shorter: reports stay the same
/// wherever the checkout lies.
fn from_here(path: &Path) -> PathBuf {
    let here = std::env::current_dir().unwrap_or_default();
    path.strip_prefix(here).unwrap_or(path).to_owned()
}
