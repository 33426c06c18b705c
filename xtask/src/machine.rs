//! The machine that the work ran on, and the memory that it took.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;

use gump_kernels::Choice;
use serde::Serialize;

/// The machine as a report names it.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Machine {
    /// Model name of the processor; "unknown" where the system does not report it.
    pub(crate) cpu: String,
    /// Threads the system grants this process.
    pub(crate) cores: usize,
    /// Main memory, GB; null where the system does not report it.
    pub(crate) memory_gb: Option<f64>,
    /// Device of the tensors.
    pub(crate) device: String,
    /// Kernel of matrix products on the processor.
    pub(crate) kernel: Choice,
    /// Operating system and architecture.
    pub(crate) system: String,
}

impl Machine {
    /// Asks the system.
    pub(crate) fn here(device: &str) -> Self {
        Self {
            cpu: field("/proc/cpuinfo", "model name").unwrap_or_else(|| "unknown".into()),
            cores: cores(),
            memory_gb: memory_bytes().map(|bytes| (bytes / 1e8).round() / 10.0),
            device: device.into(),
            kernel: Choice::current().clone(),
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
        }
    }
}

/// Threads the system grants this process, at least 1.
pub(crate) fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

/// Main memory, bytes; `None` where the system does not report it.
pub(crate) fn memory_bytes() -> Option<f64> {
    let kib = kibibytes(&field("/proc/meminfo", "MemTotal")?)?;
    Some(kib * 1024.0)
}

/// Columns of the terminal; `None` where the system does not report them.
pub(crate) fn terminal_columns() -> Option<usize> {
    let terminal = File::open("/dev/tty").ok()?;
    let output = Command::new("stty").arg("size").stdin(terminal).output();
    let output = output.ok().filter(|output| output.status.success())?;
    second_number(&String::from_utf8(output.stdout).ok()?)
}

/// The columns in "ROWS COLUMNS"; 0 stands for an unknown number.
fn second_number(text: &str) -> Option<usize> {
    let columns = text.split_whitespace().nth(1)?.parse().ok()?;
    (columns > 0).then_some(columns)
}

/// Peak main memory of this process, MB; `None` where the system does not report it.
pub(crate) fn peak_rss_mb() -> Option<f64> {
    let kib = kibibytes(&field("/proc/self/status", "VmHWM")?)?;
    Some((kib * 1024.0 / 1e5).round() / 10.0)
}

/// Seconds of processor time this process has used, over all threads, to a hundredth; `None` where
/// the system does not report it.
pub(crate) fn cpu_seconds() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The second field is a name in parentheses, which may hold spaces; user and system time are
    // the 14th and 15th, in hundredths of a second on every Linux.
    let mut fields = text.rsplit_once(')')?.1.split_whitespace().skip(11);
    let user: f64 = fields.next()?.parse().ok()?;
    let system: f64 = fields.next()?.parse().ok()?;
    Some((user + system) / 100.0)
}

/// The commit of the checkout, with `-modified` if files differ from it; "unknown" without git. A
/// driver that was built for distribution reports the commit it was built from.
pub(crate) fn commit() -> String {
    if let Some(commit) = option_env!("GUMP_COMMIT") {
        return commit.into();
    }
    let git = |arguments: &[&str]| {
        let output = Command::new("git")
            .arg("-C")
            .arg(repository())
            .args(arguments)
            .output()
            .ok()?;
        let text = String::from_utf8(output.stdout).ok()?;
        output.status.success().then(|| text.trim().to_owned())
    };
    let Some(commit) = git(&["rev-parse", "HEAD"]) else {
        return "unknown".into();
    };
    match git(&["status", "--porcelain", "--untracked-files=no"]) {
        Some(changes) if !changes.is_empty() => format!("{commit}-modified"),
        _ => commit,
    }
}

/// The root of the checkout this driver belongs to.
pub(crate) fn repository() -> PathBuf {
    let manifest = std::env::var_os("CARGO_MANIFEST_DIR")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")), PathBuf::from);
    manifest.parent().unwrap_or(Path::new(".")).to_owned()
}

/// The first `name: value` of a proc file.
fn field(path: &str, name: &str) -> Option<String> {
    let text = std::fs::read_to_string(path).ok()?;
    text.lines()
        .filter_map(|line| line.split_once(':'))
        .find(|(key, _)| key.trim() == name)
        .map(|(_, value)| value.trim().to_owned())
}

fn kibibytes(text: &str) -> Option<f64> {
    text.strip_suffix("kB")?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn linux_tells_memory() {
        assert!(peak_rss_mb().unwrap() > 0.5);
        assert!((0.0..1e6).contains(&cpu_seconds().unwrap()));
        assert!(Machine::here("cpu").memory_gb.unwrap() > 0.1);
    }

    #[test]
    fn columns_are_the_second_number() {
        assert_eq!(second_number("50 200\n"), Some(200));
        assert_eq!(second_number("0 0\n"), None);
        assert_eq!(second_number("size?"), None);
    }

    #[test]
    fn the_repository_holds_this_file() {
        assert!(repository().join("xtask/src/machine.rs").is_file());
    }
}
