//! The driver outside of a checkout: its name, the folder of the files shipped with it, and the
//! environment variables that cargo would have set.
//!
//! An archive holds the driver under the name `gump`, beside the folders `datasets` and `configs`
//! (`.ci/release` packs it). Started by that name it behaves as `cargo xtask` does in a checkout.
//! Start with [`home`].

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use crate::machine::repository;

/// The name of the driver in an archive.
const NAME: &str = "gump";

/// Subfolder that marks a folder of shipped files.
const MARK: &str = "datasets/weights";

/// Environment variables that `.cargo/config.toml` sets for `cargo xtask`; that file gives the
/// reasons.
const SETTINGS: [(&str, &str); 2] = [("CANDLE_NUM_THREADS", "1"), ("MIMALLOC_PURGE_DELAY", "-1")];

/// The folder of the shipped files: the one that `GUMP_HOME` names, the checkout that cargo runs the
/// driver in, the folder of the driver or `../share/gump` from there, the checkout it was built in.
pub(crate) fn home() -> PathBuf {
    let program = std::env::current_exe().ok();
    home_of(
        std::env::var_os("GUMP_HOME"),
        std::env::var_os("CARGO_MANIFEST_DIR").is_some(),
        program.as_deref(),
    )
    .unwrap_or_else(repository)
}

/// The folder of the shipped files; `None` if it is the checkout.
fn home_of(named: Option<OsString>, by_cargo: bool, program: Option<&Path>) -> Option<PathBuf> {
    if let Some(named) = named.filter(|named| !named.is_empty()) {
        return Some(named.into());
    }
    let folder = program.filter(|_| !by_cargo)?.parent()?;
    let above = folder.parent().unwrap_or(folder);
    let places = [folder.to_owned(), above.join("share/gump")];
    places.into_iter().find(|place| place.join(MARK).is_dir())
}

/// True if the driver was started as the program of an archive.
pub(crate) fn is_installed() -> bool {
    std::env::args_os()
        .next()
        .is_some_and(|word| names_it(&word))
}

fn names_it(word: &OsStr) -> bool {
    Path::new(word).file_stem().is_some_and(|stem| stem == NAME)
}

/// The name of the driver where a single word is needed.
pub(crate) fn name() -> &'static str {
    if is_installed() { NAME } else { "xtask" }
}

/// Restarts an installed driver with those of [`SETTINGS`] that the environment does not set yet,
/// if any: the allocator reads its variable before `main` begins.
#[cfg(unix)]
pub(crate) fn settle() {
    use std::os::unix::process::CommandExt as _;

    let is_unset = |(name, _): &(&str, &str)| std::env::var_os(name).is_none();
    let missing: Vec<_> = SETTINGS.into_iter().filter(is_unset).collect();
    if !is_installed() || missing.is_empty() {
        return;
    }
    let Ok(program) = std::env::current_exe() else {
        return;
    };
    let mut words = std::env::args_os();
    let mut command = std::process::Command::new(program);
    // The program may be a link of this name to a file of another one.
    command.arg0(words.next().unwrap_or_else(|| NAME.into()));
    // Returns if it fails; the work is then done without the settings, more slowly.
    let _ = command.args(words).envs(missing).exec();
}

/// Does nothing: other systems cannot replace the program of a running process.
#[cfg(not(unix))]
pub(crate) fn settle() {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_looked_for_beside_the_driver() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let home = |program: &str| home_of(None, false, Some(&root.join(program)));
        assert_eq!(home("gump"), None);
        std::fs::create_dir_all(root.join("share/gump").join(MARK)).unwrap();
        assert_eq!(home("bin/gump"), Some(root.join("share/gump")));
        std::fs::create_dir_all(root.join(MARK)).unwrap();
        assert_eq!(home("gump"), Some(root.to_owned()));
    }

    #[test]
    fn who_says_where_files_are_is_believed_and_cargo_before_the_neighbours() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder.path().join(MARK)).unwrap();
        let program = folder.path().join("gump");
        let home = |named: &str, by_cargo| home_of(Some(named.into()), by_cargo, Some(&program));
        assert_eq!(home("elsewhere", true), Some("elsewhere".into()));
        assert_eq!(home("", false), Some(folder.path().to_owned()));
        assert_eq!(home("", true), None);
    }

    #[test]
    fn an_archive_calls_it_gump() {
        let names = |word: &str| names_it(OsStr::new(word));
        assert!(names("gump") && names("./gump") && names("bin/gump.exe"));
        assert!(!names("xtask") && !names("target/debug/xtask") && !names("gump-wosac"));
    }

    #[test]
    fn the_settings_are_those_of_cargo() {
        let text = include_str!("../../.cargo/config.toml");
        let (_, set) = text.split_once("[env]\n").unwrap();
        let set: Vec<&str> = set.lines().filter(|line| line.contains(" = ")).collect();
        assert_eq!(
            set,
            SETTINGS.map(|(name, value)| format!("{name} = {value:?}"))
        );
    }
}
