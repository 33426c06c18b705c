//! Body of every target: reads each input with the reader of that name.

#[path = "../../crates/gump-data/tests/common/hostile.rs"]
mod hostile;

use std::sync::Once;

use tempfile::TempDir;

const TESTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../crates/gump-data/tests");

thread_local! {
    /// One folder for all inputs of a process: the last one's file is written over.
    static FOLDER: std::cell::OnceCell<TempDir> = const { std::cell::OnceCell::new() };
}

/// Reads the bytes to the end.
pub(crate) fn read(name: &str, bytes: &[u8]) {
    static HOOK: Once = Once::new();
    // The fuzzer's hook would count panics of the table crates, which the reader catches. Whatever
    // is not caught still ends the process.
    HOOK.call_once(|| {
        if ["argoverse2", "argoverse2_log"].contains(&name) {
            std::panic::set_hook(Box::new(|_| {}));
        }
    });
    let target = hostile::target(name);
    FOLDER.with(|folder| target.read(folder.get_or_init(|| target.folder()), bytes));
}
