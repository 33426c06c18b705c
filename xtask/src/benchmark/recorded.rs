//! Recorded scenes of a list: where they are, and whether they are what the list says.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use sha2::{Digest, Sha256};

use super::{List, Recorded, RecordedScene};

/// The files of a part below the folder of recorded data, each once, held to their sums.
///
/// Error: a file that is missing or differs.
pub(crate) fn check_recorded(
    list: &List,
    part: &Recorded,
    data: &Path,
) -> anyhow::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for line in &part.scenes {
        crate::run::stop_if_interrupted()?;
        let scene = RecordedScene::parse(line)
            .with_context(|| format!("expected \"SHA256 FILE [ID]\", found \"{line}\""))?;
        let path = data.join(&part.folder).join(scene.file);
        anyhow::ensure!(
            path.is_file(),
            "expected the recorded scene {} of the list {}, found no file {}; \
             GUMP_RECORDED names the folder of recorded data",
            scene.id.unwrap_or(scene.file),
            list.name,
            path.display()
        );
        let found = sha256(&path)?;
        anyhow::ensure!(
            found == scene.sha256,
            "expected SHA-256 {} as {} says, found {found}: {}",
            scene.sha256,
            list.path.display(),
            path.display()
        );
        files.push(path);
    }
    Ok(files)
}

/// SHA-256 of a file, lower-case hexadecimal.
pub(super) fn sha256(path: &Path) -> anyhow::Result<String> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let digest = Sha256::digest(bytes);
    Ok(digest.iter().map(|byte| format!("{byte:02x}")).collect())
}
