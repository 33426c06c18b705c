//! `completions` and `manual`: the command line for shells and for `man`.

use std::io::Write as _;
use std::path::PathBuf;

use anyhow::Context as _;
use clap::Command;
use clap_complete::Shell;

use crate::installed;
use crate::run::print_line;

/// Arguments of `completions`.
#[derive(Debug, clap::Args)]
pub(crate) struct Completions {
    /// Shell
    shell: Shell,
}

impl Completions {
    /// Prints the script that completes words of the driver.
    ///
    /// Error: a closed standard output.
    pub(crate) fn execute(&self, mut root: Command) -> anyhow::Result<()> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut root, installed::name(), &mut script);
        std::io::stdout()
            .write_all(&script)
            .context("cannot print the completions")
    }
}

/// Arguments of `manual`.
#[derive(Debug, clap::Args)]
pub(crate) struct Manual {
    /// Folder for the pages, one per verb
    #[arg(long, short, value_name = "DIR", default_value = "out/man")]
    out: PathBuf,
}

impl Manual {
    /// Writes a page for the whole and one for every verb.
    ///
    /// Error: a folder that cannot be written to.
    pub(crate) fn execute(&self, root: Command) -> anyhow::Result<()> {
        let out = &self.out;
        std::fs::create_dir_all(out)
            .with_context(|| format!("cannot create the folder {}", out.display()))?;
        // Pages are named after the program, which is one word where it is installed.
        let name = installed::name();
        let root = root.name(name).bin_name(name);
        clap_mangen::generate_to(root, out)
            .with_context(|| format!("cannot write pages into {}", out.display()))?;
        print_line(&format!(
            "pages: {0}, read one with man {0}/{name}.1",
            out.display()
        ));
        Ok(())
    }
}
