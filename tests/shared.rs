//! Recorded data for tests: `../shared` beside the checkout, which the repository must not hold.
//!
//! Every test that wants it includes this file (`#[path = "../../../tests/shared.rs"] mod shared;`),
//! so that all of them skip, and fail, alike.

use std::path::{Path, PathBuf};

/// A file or folder under `../shared`.
///
/// Where it is absent, `None`, said aloud; with `REQUIRE_SHARED=1` in the environment a failure, so
/// that tests are not skipped by accident where the data should be.
///
/// # Panics
/// If the file is absent although it is required.
pub(crate) fn shared(name: &str) -> Option<PathBuf> {
    let mut above = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let root = above.find(|folder| folder.join("Cargo.lock").is_file());
    let root = root.expect("tests run in a checkout, which has a Cargo.lock");
    let path = root.join("../shared").join(name);
    if path.exists() {
        return Some(path);
    }
    let required = std::env::var_os("REQUIRE_SHARED").is_some_and(|value| value == "1");
    assert!(
        !required,
        "REQUIRE_SHARED=1, but ../shared/{name} is not beside the repository"
    );
    eprintln!("SKIPPED: ../shared/{name} is not beside the repository");
    None
}
