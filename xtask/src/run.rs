//! One run of a verb: its output folder, seed, threads, phases and results.

use std::io::{IsTerminal as _, Write as _};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::Context as _;
use gump_eval::Monitor;
use gump_kernels::{Choice, Kernel};
use gump_scene::Seed;
use serde::Serialize;

use crate::cli::{self, WrongArguments};
use crate::machine;
use crate::progress::Progress;
use crate::report::Report;

/// Flags that every verb has.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct Common {
    /// Folder for the results [default: out/VERB]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Random seed [default: 0]
    #[arg(long, value_name = "N")]
    pub(crate) seed: Option<u64>,
    /// Read flags from a file; the command line overrides them
    #[arg(long, value_name = "FILE.toml")]
    pub(crate) config: Option<PathBuf>,
    /// Threads to use [default: all cores]
    #[arg(long, value_name = "N")]
    threads: Option<NonZeroUsize>,
    /// Compute device
    #[arg(long, value_enum, default_value_t = Device::Cpu)]
    device: Device,
    /// Matrix-product kernel: amx, avx512-bf16, avx512, avx2 or portable [default: the
    /// fastest that the processor has and that passes its test]
    #[arg(long, value_name = "NAME")]
    kernel: Option<String>,
    /// Print only errors, no progress and no table
    #[arg(long)]
    quiet: bool,
    /// Print tables in full width rather than that of the terminal; report.json always has them in
    /// full
    #[arg(long)]
    #[serde(skip)]
    wide: bool,
}

/// Compute device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Device {
    /// Main memory, all threads.
    Cpu,
    /// The first NVIDIA GPU.
    Cuda,
}

impl Device {
    /// Opens the device.
    ///
    /// Error: [`WrongArguments`] in a build without CUDA, or where there is no GPU or something that
    /// it takes is missing.
    fn open(self) -> anyhow::Result<gump_model::Device> {
        match self {
            Self::Cpu => Ok(gump_model::Device::Cpu),
            Self::Cuda if cfg!(feature = "cuda") => {
                let opened = quietly(|| gump_model::Device::new_cuda(0));
                opened.map_err(|why| {
                    let what = format!("--device cuda: cannot open the first NVIDIA GPU, {why}");
                    WrongArguments(what).into()
                })
            }
            Self::Cuda => {
                let why = "--device cuda needs a build with CUDA, this one has none: \
                           build with `--features cuda`";
                Err(WrongArguments(why.into()).into())
            }
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
        }
    }
}

/// Returns the result of `open`, or the reason for its failure in one line. The libraries of a GPU
/// are loaded on first use, which panics if one is missing.
fn quietly<T, E: std::fmt::Display>(open: impl FnOnce() -> Result<T, E>) -> Result<T, String> {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| ()));
    let found = std::panic::catch_unwind(std::panic::AssertUnwindSafe(open));
    std::panic::set_hook(hook);
    let why = match found {
        Ok(Ok(opened)) => return Ok(opened),
        Ok(Err(error)) => error.to_string(),
        Err(panic) => match (panic.downcast_ref::<String>(), panic.downcast_ref::<&str>()) {
            (Some(why), _) => why.clone(),
            (_, Some(why)) => (*why).to_owned(),
            _ => String::new(),
        },
    };
    let first = why.lines().map(str::trim).find(|line| !line.is_empty());
    Err(first.unwrap_or("it does not say why").to_owned())
}

/// Columns that tables fit into where there is no terminal: a usual wide one. Chosen by hand.
const WIDTH: usize = 120;
/// Columns that tables take at least: fewer hold no table. Chosen by hand.
const LEAST_WIDTH: usize = 40;

/// Columns that tables may take.
fn columns(wide: bool) -> usize {
    let terminal = || {
        let is_terminal = std::io::stdout().is_terminal();
        let columns = is_terminal.then(machine::terminal_columns).flatten();
        columns.map_or(WIDTH, |columns| columns.max(LEAST_WIDTH))
    };
    if wide { usize::MAX } else { terminal() }
}

/// The most threads that can be meant: a processor has fewer cores.
const MOST_THREADS: usize = 1024;

/// A run in progress.
pub(crate) struct Run {
    out: PathBuf,
    seed: Seed,
    quiet: bool,
    /// Columns that tables may take on the terminal.
    width: usize,
    threads: usize,
    device: gump_model::Device,
    /// False for a process that helps another one, which prints and writes for both.
    leads: bool,
    report: Report,
    began: Instant,
}

impl Run {
    /// Begins a run: creates the output folder.
    ///
    /// `settings` are the verb's arguments, which become the report's `config`.
    pub(crate) fn of(
        verb: &str,
        common: &Common,
        settings: &impl Serialize,
    ) -> anyhow::Result<Self> {
        if let Some(name) = &common.kernel {
            let forced = Kernel::named(name).and_then(Choice::force);
            forced.map_err(|why| WrongArguments(format!("--kernel: {why}")))?;
        }
        if let Some(found) = common
            .threads
            .filter(|threads| threads.get() > MOST_THREADS)
        {
            let wrong = format!("--threads: expected at most {MOST_THREADS}, found {found}");
            return Err(WrongArguments(wrong).into());
        }
        let device = common.device.open()?;
        let out = match &common.out {
            Some(out) => out.clone(),
            None => Path::new("out").join(verb.replace(' ', "-")),
        };
        std::fs::create_dir_all(&out)
            .with_context(|| format!("cannot create the folder {}", out.display()))?;
        let config = serde_json::to_value(settings)?;
        let seed = common.seed.unwrap_or_default();
        Ok(Self {
            seed: Seed(seed),
            quiet: common.quiet,
            width: columns(common.wide),
            threads: common
                .threads
                .map_or_else(machine::cores, NonZeroUsize::get),
            device,
            leads: true,
            report: Report::begin(verb, seed, config, common.device.name()),
            began: Instant::now(),
            out,
        })
    }

    /// Does the work on the requested number of threads, then writes and shows the report, also if
    /// the work failed.
    pub(crate) fn execute(
        mut self,
        work: impl FnOnce(&mut Self) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        // The global pool, and the work outside of it: a worker that waits for work which its own
        // pool is to do would wait for ever on a pool of one thread.
        rayon::ThreadPoolBuilder::new()
            .num_threads(self.threads)
            .build_global()
            .context("cannot start the worker threads")?;
        let mut done = work(&mut self);
        if !self.leads {
            return done;
        }
        done = done.and_then(|()| self.report.write_tables(&self.out));
        self.report.add_seconds("total", self.began.elapsed());
        self.report.error = done.as_ref().err().map(cli::sentence);
        let path = self.out.join("report.json");
        // Wrong arguments change nothing, the report of an earlier run included.
        let is_refused = done.as_ref().is_err_and(cli::is_about_arguments);
        let written = match is_refused && path.exists() {
            true => Ok(()),
            false => self.report.write(&path),
        };
        let has_something_to_show = done.is_ok() || self.report.has_something_to_show();
        if !self.quiet && has_something_to_show {
            print_line(&format!(
                "{}report: {}",
                self.report.text(self.width),
                path.display()
            ));
        }
        done.and(written)
    }

    /// Runs one phase and notes how long it took.
    pub(crate) fn phase<T>(
        &mut self,
        name: &str,
        work: impl FnOnce(&mut Self) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let began = Instant::now();
        let done = work(self);
        self.report.add_seconds(name, began.elapsed());
        done
    }

    /// Begins a progress bar of `total` units.
    pub(crate) fn progress(&self, what: &str, total: u64, unit: &'static str) -> Progress {
        Progress::begin(self.quiet, what, total, unit)
    }

    /// Begins to wait for work whose progress is not known.
    pub(crate) fn wait(&self, what: &str) -> Progress {
        Progress::wait(self.quiet, what)
    }

    /// Follows work that shows progress in parts only.
    pub(crate) fn monitor(&self) -> PartMonitor {
        PartMonitor { quiet: self.quiet }
    }

    /// Begins the progress bar of a simulation of so many frames; silent where nothing is simulated.
    pub(crate) fn simulating(&self, frames: Option<u64>) -> Progress {
        let quiet = self.quiet || frames.is_none();
        Progress::begin(quiet, "simulating", frames.unwrap_or(0), "frames")
    }

    /// Prints a message that is not a result.
    pub(crate) fn print(&self, line: &str) {
        if !self.quiet {
            print_line(line);
        }
    }

    /// Columns that tables may take on the terminal.
    pub(crate) fn width(&self) -> usize {
        self.width
    }

    /// Adds a result; keys keep the order in which they come.
    pub(crate) fn result(&mut self, key: &str, value: impl Serialize) -> anyhow::Result<()> {
        let value = serde_json::to_value(value)
            .with_context(|| format!("the result {key} cannot be written as JSON"))?;
        self.report.results.insert(key.into(), value);
        Ok(())
    }

    /// Adds a result that the terminal does not show because it is printed there in another form.
    pub(crate) fn result_hidden(&mut self, key: &str, value: impl Serialize) -> anyhow::Result<()> {
        self.report.hidden.insert(key.into());
        self.result(key, value)
    }

    /// Marks this process as a helper of another one, which prints and writes for both.
    pub(crate) fn follow(&mut self) {
        self.leads = false;
        self.quiet = true;
    }

    /// Takes the seed from elsewhere, where `--seed` is not given.
    pub(crate) fn reseed(&mut self, seed: u64) {
        self.seed = Seed(seed);
        self.report.seed = seed;
    }

    /// Replaces a setting of the report by what it was resolved to.
    pub(crate) fn setting(&mut self, key: &str, value: impl Serialize) -> anyhow::Result<()> {
        let value = serde_json::to_value(value)
            .with_context(|| format!("the setting {key} cannot be written as JSON"))?;
        if let serde_json::Value::Object(settings) = &mut self.report.config {
            settings.insert(key.into(), value);
        }
        Ok(())
    }

    /// A path in the output folder.
    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.out.join(name)
    }

    /// The output folder.
    pub(crate) fn out(&self) -> &Path {
        &self.out
    }

    /// Device of the tensors.
    pub(crate) fn device(&self) -> &gump_model::Device {
        &self.device
    }

    /// Threads to use.
    pub(crate) fn threads(&self) -> usize {
        self.threads
    }

    /// Seed of all randomness.
    pub(crate) fn seed(&self) -> Seed {
        self.seed
    }
}

/// Why a run that begins anew is refused in a folder with the file of an earlier one.
pub(crate) fn would_replace(file: &Path) -> String {
    format!(
        "--out: expected a folder without a run, found {}, which a new run would replace: continue \
         that run with --resume, or choose another --out",
        file.display()
    )
}

/// Prints a line; a closed standard output is not an error.
pub(crate) fn print_line(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// Prints a line to standard error; a closed stream is not an error.
pub(crate) fn print_error(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// True once Ctrl-C was pressed; long work ends soon after and leaves a state it can resume from.
pub(crate) fn interrupted() -> bool {
    INTERRUPTED.load(Ordering::Relaxed)
}

/// Ends work that has nothing to resume.
///
/// Error: after Ctrl-C.
pub(crate) fn stop_if_interrupted() -> anyhow::Result<()> {
    anyhow::ensure!(!interrupted(), "stopped by Ctrl-C");
    Ok(())
}

/// Hears of Ctrl-C for work without a progress bar.
pub(crate) struct Unseen;

impl Monitor for Unseen {
    fn advance(&self, _: u64) {}

    fn is_stopped(&self) -> bool {
        interrupted()
    }
}

/// Hears of Ctrl-C, and shows the progress of parts of the work.
pub(crate) struct PartMonitor {
    quiet: bool,
}

impl Monitor for PartMonitor {
    fn advance(&self, _: u64) {}

    fn is_stopped(&self) -> bool {
        interrupted()
    }

    fn part<'a>(&'a self, name: &str, total: u64, unit: &'static str) -> Box<dyn Monitor + 'a> {
        Box::new(Progress::begin(self.quiet, name, total, unit))
    }
}

/// Makes the first Ctrl-C a request and the second an end.
pub(crate) fn catch_interrupts() {
    let caught = ctrlc::set_handler(|| {
        if INTERRUPTED.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        print_error("\nstopping soon; press Ctrl-C again to stop now");
    });
    if caught.is_err() {
        print_error("warning: Ctrl-C cannot be caught and stops at once");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn libraries_that_panic_at_their_first_use_are_errors_of_one_line() {
        let check = |open: fn() -> Result<u8, String>, expected: Result<u8, &str>| {
            assert_eq!(quietly(open), expected.map_err(str::to_owned));
        };
        check(|| Ok(7), Ok(7));
        check(|| Err("\n no device\n at line 3".into()), Err("no device"));
        check(|| Err(String::new()), Err("it does not say why"));
        check(|| panic!("no library"), Err("no library"));
        check(|| panic!("no library {}", 3), Err("no library 3"));
    }
}
