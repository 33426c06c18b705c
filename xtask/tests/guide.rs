//! The guide is true: its commands run, what it shows of their output is there, the code it quotes
//! is what its source says, its links lead somewhere in the book, and commands that cannot run here
//! at least have flags that exist.
//!
//! Meaning of the fences of a chapter:
//!
//! | fence | meaning |
//! |---|---|
//! | `console` | `$ cargo xtask ...` is run, in order, in a folder of the chapter's own; every other line occurs in the output of the command above it, spaces aside |
//! | `LANGUAGE FILE` | written to that folder under this name |
//! | `sh`, `yaml` | not run: a cluster, a long job, data of one's own. Flags of `cargo xtask` are checked, shell syntax too; those of the page on clusters run with stand-ins for their schedulers |
//! | others | for reading |
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::{PermissionsExt as _, symlink};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A fenced block of a chapter.
struct Block {
    /// Info string of the fence, `console` for instance.
    info: String,
    /// Number of its first line, from 1.
    line: usize,
    lines: Vec<String>,
}

#[test]
fn every_command_runs() {
    let mut n_commands = 0;
    for chapter in chapters() {
        let place = tempfile::tempdir().unwrap();
        for shipped in ["datasets", "configs"] {
            symlink(root().join(shipped), place.path().join(shipped)).unwrap();
        }
        for block in blocks(&chapter) {
            if let Some((_, file)) = block.info.split_once(' ') {
                fs::write(place.path().join(file), block.lines.join("\n") + "\n").unwrap();
            } else if block.info == "console" {
                n_commands += run_session(&chapter, &block, place.path());
            }
        }
    }
    assert!(n_commands >= 10, "only {n_commands} commands found");
}

/// Runs the commands of a block and looks for the lines below them; how many commands there were.
fn run_session(chapter: &Path, block: &Block, place: &Path) -> usize {
    let (mut printed, mut n_commands) = (String::new(), 0);
    for (i, line) in block.lines.iter().enumerate() {
        let at = format!("{}:{}", chapter.display(), block.line + i);
        if let Some(command) = line.strip_prefix("$ ") {
            let words = command.strip_prefix("cargo xtask ");
            let words = words.unwrap_or_else(|| panic!("{at}: expected `$ cargo xtask ...`"));
            let output = xtask(words.split_whitespace(), place);
            let error = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(output.status.success(), "{at}: {command}: {error}");
            printed = squeezed(&(String::from_utf8_lossy(&output.stdout) + &*error));
            n_commands += 1;
        } else {
            let expected = squeezed(line);
            assert!(
                printed.contains(&expected),
                "{at}: {expected} does not occur in:\n{printed}"
            );
        }
    }
    n_commands
}

/// The text with one space wherever there were several.
fn squeezed(text: &str) -> String {
    let lines = text
        .lines()
        .map(|line| line.split_whitespace().collect::<Vec<_>>().join(" "));
    lines.collect::<Vec<_>>().join("\n")
}

#[test]
fn commands_that_are_not_run_have_flags_that_exist() {
    let mut flags = BTreeMap::new();
    let mut n_commands = 0;
    let mut pages = chapters();
    pages.extend(
        ["README.md", "CONTRIBUTING.md", "datasets/README.md"].map(|page| root().join(page)),
    );
    for page in pages {
        for block in blocks(&page)
            .iter()
            .filter(|block| ["sh", "yaml"].contains(&&*block.info))
        {
            for command in commands(block) {
                let words: Vec<&str> = command.split_whitespace().collect();
                let n_verbs = words.iter().take_while(|word| is_verb(word)).count();
                let known = flags
                    .entry(words[..n_verbs].join(" "))
                    .or_insert_with_key(|verb| flags_of(verb));
                let at = format!("{}:{}: {command}", page.display(), block.line);
                assert!(!known.is_empty(), "{at}: expected a verb");
                for flag in words.iter().filter(|word| word.starts_with("--")) {
                    let flag = flag.split('=').next().unwrap();
                    assert!(known.contains(flag), "{at}: there is no {flag}");
                }
                n_commands += 1;
            }
            if block.info == "sh" {
                let script = block.lines.join("\n");
                let checked = Command::new("bash")
                    .args(["-n", "-c", &script])
                    .output()
                    .unwrap();
                let error = String::from_utf8_lossy(&checked.stderr);
                assert!(
                    checked.status.success(),
                    "{}:{}: {error}",
                    page.display(),
                    block.line
                );
            }
        }
    }
    assert!(n_commands >= 20, "only {n_commands} commands found");
}

/// The driver, but with simple worlds and planners in place of networks, which take too long for a
/// test.
const QUICK_DRIVER: &str = r#"#!/bin/bash
words=("${@/#model:*/idm}")
words=("${words[@]/#idm,model:*/log,idm}")
words=("${words[@]/#pdm-closed,interactive/simple,idm}")
case "$2" in
wosac) words+=(--rollouts-per-scenario 1) ;;
closed-loop) words+=(--seconds 1 --films 0) ;;
esac
exec "$REAL_DRIVER" "${words[@]}"
"#;

/// Starts a script for every element of an array of two; runs the command of `--wrap` at once.
const SBATCH: &str = r#"#!/bin/bash
case "$*" in
*--wrap*) exec bash -c "${@: -1}" ;;
esac
export SLURM_ARRAY_TASK_MIN=1 SLURM_ARRAY_TASK_STEP=1 SLURM_ARRAY_TASK_COUNT=2
for element in 1 2; do
    SLURM_ARRAY_TASK_ID=$element SLURM_PROCID=0 bash "${@: -1}" >&2 || exit 1
done
echo 17
"#;

/// Runs a command in `SLURM_NTASKS` tasks at the same time.
const SRUN: &str = r#"#!/bin/bash
for ((k = 0; k < SLURM_NTASKS; k++)); do
    SLURM_PROCID=$k "$@" &
    tasks+=($!)
done
for task in "${tasks[@]}"; do wait "$task" || exit 1; done
"#;

/// Runs a command of `bash` in as many processes as `-n` says, one after another.
const MPIRUN: &str = r#"#!/bin/bash
n=$2
while [ "$1" != bash ]; do shift; done
for ((k = 0; k < n; k++)); do
    OMPI_COMM_WORLD_RANK=$k "$@" || exit 1
done
"#;

/// Calls tasks where they are made.
const RAY: &str = "\
def remote(**options):
    return lambda task: type('Task', (), {'remote': staticmethod(task)})


def init():
    pass


def get(results):
    return results
";

/// A folder with the programs of clusters and scenes, and the page that says how to use them.
struct Cluster {
    place: tempfile::TempDir,
    page: PathBuf,
    blocks: Vec<Block>,
}

impl Cluster {
    /// How many scenes there are.
    const N_SCENES: usize = 8;

    fn new() -> Self {
        let place = tempfile::tempdir().unwrap();
        let page = book().join("evaluate-over-a-cluster.md");
        let blocks = blocks(&page);
        let cluster = Self {
            place,
            page,
            blocks,
        };
        fs::create_dir(cluster.path("programs")).unwrap();
        for (name, script) in [
            ("gump", QUICK_DRIVER),
            ("sbatch", SBATCH),
            ("srun", SRUN),
            ("mpirun", MPIRUN),
        ] {
            let path = cluster.path("programs").join(name);
            fs::write(&path, script).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        }
        fs::write(cluster.path("ray.py"), RAY).unwrap();
        fs::create_dir(cluster.path("validation")).unwrap();
        let scenes = "sumo-peachtree.tfrecord.gz";
        let shipped = root().join("datasets/mini").join(scenes);
        fs::copy(shipped, cluster.path("validation").join(scenes)).unwrap();
        cluster
    }

    fn path(&self, name: &str) -> PathBuf {
        self.place.path().join(name)
    }

    /// The text of the only block of a language with this part.
    fn block(&self, info: &str, part: &str) -> String {
        let blocks = self.blocks.iter().filter(|block| block.info == info);
        let texts = blocks.map(|block| block.lines.join("\n"));
        let mut found: Vec<String> = texts.filter(|text| text.contains(part)).collect();
        assert_eq!(found.len(), 1, "{info} blocks with {part}");
        found.remove(0)
    }

    /// Runs a program in the environment that the page supposes, with `out` for results.
    fn run(&self, program: &str, words: &[&str], out: &str, variables: &[(&str, &str)]) {
        let path = std::env::var("PATH").unwrap();
        let programs = self.path("programs");
        let output = Command::new(program)
            .args(words)
            .current_dir(self.place.path())
            .env("PATH", format!("{}:{path}", programs.display()))
            .env("CARGO_MANIFEST_DIR", env!("CARGO_MANIFEST_DIR"))
            .env("REAL_DRIVER", env!("CARGO_BIN_EXE_xtask"))
            .env("XTASK", programs.join("gump"))
            .env("SCENES", self.path("validation"))
            .env("WEIGHTS", "w.safetensors")
            .env("OUT", self.path(out))
            .envs(variables.iter().copied())
            .output()
            .unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{program} {words:?}: {error}");
    }

    /// Checks that there are these shards and that all scenes are in their sum.
    fn check(&self, out: &str, shards: &[&str]) {
        let folders = fs::read_dir(self.path(out)).unwrap();
        let names = folders.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.collect();
        names.sort();
        assert_eq!(names, [&["merged"], shards].concat());
        let report = fs::read_to_string(self.path(out).join("merged/report.json")).unwrap();
        let report: serde_json::Value = serde_json::from_str(&report).unwrap();
        let scenarios = &report["results"]["rows"][0]["scenarios"];
        assert_eq!(*scenarios, Self::N_SCENES, "{out}");
    }
}

#[test]
fn scripts_for_slurm_keep_the_results_of_every_task() {
    let cluster = Cluster::new();
    let script = cluster.block("sh", "#SBATCH --array");
    fs::write(cluster.path("wosac.sh"), script).unwrap();
    let submit = cluster.block("sh", "sbatch --parsable");
    for (n, shards) in [
        ("1", &["shard-1-0", "shard-2-0"][..]),
        ("2", &["shard-1-0", "shard-1-1", "shard-2-0", "shard-2-1"]),
    ] {
        let variables = [("SLURM_NTASKS", n), ("SLURM_CPUS_PER_TASK", "1")];
        let out = format!("slurm-{n}");
        cluster.run("bash", &["-ec", &submit], &out, &variables);
        cluster.check(&out, shards);
    }
}

#[test]
fn pods_of_kubernetes_evaluate_their_shards() {
    let cluster = Cluster::new();
    let job = cluster.block("yaml", "kind: Job");
    assert!(job.contains("command: [bash, -c]"), "{job}");
    // The variable says what the job does.
    let (_, count) = job.split_once("completions: ").unwrap();
    let count = count.lines().next().unwrap();
    let variable = format!("{{ name: GUMP_SHARDS, value: \"{count}\" }}");
    assert!(job.contains(&variable), "expected {variable} in {job}");
    // A folded scalar: its lines with spaces between them, as far as they are indented.
    let (_, rest) = job.split_once("args:\n").unwrap();
    let mut lines = rest.lines().skip(1);
    let first = lines.next().unwrap();
    let is_inside =
        |line: &&str| line.starts_with(&first[..first.len() - first.trim_start().len()]);
    let words = lines.take_while(is_inside).map(str::trim);
    let command: Vec<&str> = [first.trim()].into_iter().chain(words).collect();
    let data = cluster.place.path().display().to_string();
    let here = |text: &str| text.replace("/data/", &format!("{data}/"));
    let command = here(&command.join(" "));
    for index in ["0", "1"] {
        let variables = [("JOB_COMPLETION_INDEX", index), ("GUMP_SHARDS", "2")];
        cluster.run("bash", &["-c", &command], "out", &variables);
    }
    let page = fs::read_to_string(&cluster.page).unwrap();
    let (_, merge) = page.split_once("`gump evaluate merge").unwrap();
    let merge = format!("gump evaluate merge{}", merge.split('`').next().unwrap());
    cluster.run("bash", &["-c", &here(&merge)], "out", &[]);
    cluster.check("out", &["shard-1", "shard-2"]);
}

#[test]
fn processes_of_mpi_and_tasks_of_ray_evaluate_their_shards() {
    let cluster = Cluster::new();
    let shards = ["shard-1", "shard-2"];
    let script = cluster
        .block("sh", "OMPI_COMM_WORLD_RANK")
        .replace("64", "2");
    cluster.run("bash", &["-ec", &script], "mpi", &[]);
    cluster.check("mpi", &shards);
    let program = cluster.block("python", "import ray");
    let program = format!(
        "import os\nXTASK, SCENES, WEIGHTS, OUT = (os.environ[name] for name in \
         ('XTASK', 'SCENES', 'WEIGHTS', 'OUT'))\n{}",
        program.replace("SHARDS = 64", "SHARDS = 2")
    );
    if Command::new("python3").arg("--version").output().is_err() {
        eprintln!("SKIPPED: no python3");
        return;
    }
    cluster.run("python3", &["-c", &program], "ray", &[]);
    cluster.check("ray", &shards);
}

/// The words after `cargo xtask`, or after the executable, of every command in a block.
fn commands(block: &Block) -> Vec<String> {
    let text = block.lines.join("\n").replace("\\\n", " ");
    let (text, starts) = match &*block.info {
        "yaml" => (text.replace('\n', " "), vec![" gump "]),
        _ => (
            text,
            vec!["cargo xtask ", "\"$XTASK\" ", "./gump ", " gump "],
        ),
    };
    let mut commands = Vec::new();
    for start in starts {
        for rest in text.lines().flat_map(|line| line.split(start).skip(1)) {
            let end = rest.split([';', '|', '\'']).next().unwrap_or_default();
            commands.push(end.split(" #").next().unwrap_or_default().trim().to_owned());
        }
    }
    commands.retain(|command| !command.is_empty());
    commands
}

/// True for what may name a verb: small letters and hyphens alone, no flag.
fn is_verb(word: &str) -> bool {
    !word.starts_with('-') && word.chars().all(|c| c.is_ascii_lowercase() || c == '-')
}

/// The flags that the help of a verb names; none if there is no such verb.
fn flags_of(verb: &str) -> BTreeSet<String> {
    let place = tempfile::tempdir().unwrap();
    let output = xtask(verb.split_whitespace().chain(["--help"]), place.path());
    if !output.status.success() {
        return BTreeSet::new();
    }
    let help = String::from_utf8(output.stdout).unwrap();
    let words = help.split(|c: char| !c.is_ascii_alphanumeric() && c != '-');
    words
        .filter(|word| word.starts_with("--"))
        .map(str::to_owned)
        .collect()
}

/// Chapters are also read as plain Markdown on the web, so they contain the text that they quote,
/// equal to its source. `UPDATE_GUIDE=1` updates it.
#[test]
fn quotes_are_what_their_sources_say() {
    let (mut n_quotes, mut stale) = (0, Vec::new());
    for chapter in chapters() {
        let text = fs::read_to_string(&chapter).unwrap();
        assert!(!text.contains("{{#"), "{}: an include", chapter.display());
        let mut written = String::new();
        let mut lines = text.lines();
        while let Some(line) = lines.next() {
            written += &format!("{line}\n");
            let quote = line.strip_prefix("<!-- from ");
            let Some(quote) = quote.and_then(|rest| rest.strip_suffix(" -->")) else {
                continue;
            };
            let fence = lines.next().unwrap_or_default();
            assert!(
                fence.starts_with("```"),
                "{quote}: expected a block, found {fence}"
            );
            assert!(
                lines.any(|line| line == "```"),
                "{quote}: the block does not end"
            );
            written += &format!("{fence}\n{}\n```\n", quoted(&chapter, quote));
            n_quotes += 1;
        }
        if written != text {
            stale.push(chapter.display().to_string());
            if std::env::var_os("UPDATE_GUIDE").is_some() {
                fs::write(&chapter, written).unwrap();
            }
        }
    }
    assert!(
        stale.is_empty(),
        "stale quotes, UPDATE_GUIDE=1 mends them: {stale:?}"
    );
    assert!(n_quotes >= 12, "only {n_quotes} quotes found");
}

/// `FILE`, or the part of `FILE` between the marks of an `ANCHOR`, without the common indent.
fn quoted(chapter: &Path, quote: &str) -> String {
    let (file, anchor) = quote.split_once(':').unwrap_or((quote, ""));
    let path = chapter.with_file_name(file);
    let text = fs::read_to_string(&path).unwrap_or_else(|_| panic!("{quote}: no such file"));
    let part = match anchor {
        "" => text.as_str(),
        anchor => {
            let (_, from) = text
                .split_once(&format!("// ANCHOR: {anchor}\n"))
                .unwrap_or_else(|| panic!("{quote}: no such mark"));
            let (part, _) = from
                .split_once(&format!("// ANCHOR_END: {anchor}\n"))
                .unwrap_or_else(|| panic!("{quote}: no end mark"));
            part.trim_end_matches(' ')
        }
    };
    let indent = |line: &str| line.len() - line.trim_start().len();
    let filled = part.lines().filter(|line| !line.trim().is_empty());
    let least = filled.map(indent).min().unwrap_or(0);
    let lines = part.lines().map(|line| line.get(least..).unwrap_or(""));
    let lines: Vec<&str> = lines.collect();
    lines.join("\n").trim_matches('\n').to_owned()
}

#[test]
fn links_stay_inside_the_book() {
    // Beyond the folder of the book there is nothing in its built pages.
    let inside = book().canonicalize().unwrap();
    let mut n_links = 0;
    for page in chapters().into_iter().chain([book().join("SUMMARY.md")]) {
        let text = fs::read_to_string(&page).unwrap();
        let code: BTreeSet<usize> = blocks(&page)
            .iter()
            .flat_map(|block| block.line..block.line + block.lines.len())
            .collect();
        let prose = text.lines().enumerate().map(|(i, line)| (i + 1, line));
        for (number, line) in prose.filter(|(number, _)| !code.contains(number)) {
            for target in line.split("](").skip(1) {
                let target = target.split(')').next().unwrap();
                let file = target.split('#').next().unwrap();
                if target.contains("://") || file.is_empty() {
                    continue;
                }
                let at = format!("{}:{number}: {target}", page.display());
                let file = page.with_file_name(file).canonicalize();
                let file = file.unwrap_or_else(|error| panic!("{at}: {error}"));
                assert!(file.starts_with(&inside), "{at} is outside of the book");
                n_links += 1;
            }
        }
    }
    assert!(n_links >= 12, "only {n_links} links found");
}

/// Every number of a paragraph or cell of the README that links to results stands in these results,
/// perhaps with more digits or in another unit.
#[test]
fn numbers_of_the_readme_are_those_of_the_results() {
    let readme = fs::read_to_string(root().join("README.md")).unwrap();
    let cells = readme.lines().flat_map(|line| match line.starts_with('|') {
        true => line.split(['|', ';']).collect(),
        false => vec![line],
    });
    let mut n_checked = 0;
    for cell in cells {
        let (text, targets) = without_links(cell);
        let results = targets
            .iter()
            .filter(|target| target.starts_with("docs/results/"));
        let pages = results.map(|target| {
            let file = target.split('#').next().unwrap();
            fs::read_to_string(root().join(file)).unwrap()
        });
        let measured: Vec<f64> = pages
            .flat_map(|page| numbers(&page))
            .filter_map(|number| number.parse().ok())
            .collect();
        if measured.is_empty() {
            continue;
        }
        for quoted in numbers(&text) {
            let stands = measured.iter().any(|&value| is_quoted_as(value, &quoted));
            assert!(
                stands,
                "README.md: {quoted} is in none of {targets:?}: {}",
                text.trim()
            );
            n_checked += 1;
        }
    }
    assert!(n_checked > 40, "only {n_checked} numbers");
    assert!(is_quoted_as(0.7204, "0.720") && !is_quoted_as(0.7212, "0.720"));
    assert!(is_quoted_as(19.6, "0.02") && is_quoted_as(4632.0, "4600"));
    assert!(!is_quoted_as(4732.0, "4600") && !is_quoted_as(2.2, "2.3"));
}

/// The text with the words of its links, and where these lead.
fn without_links(text: &str) -> (String, Vec<String>) {
    let (mut plain, mut targets) = (String::new(), Vec::new());
    let mut rest = text;
    while let Some((before, after)) = rest.split_once("](") {
        let Some((target, after)) = after.split_once(')') else {
            break;
        };
        plain.push_str(before);
        targets.push(target.to_owned());
        rest = after;
    }
    plain.push_str(rest);
    (plain, targets)
}

/// The numbers of a text, without separators of thousands; not those in names.
fn numbers(text: &str) -> Vec<String> {
    let is_part = |c: char| c.is_ascii_digit() || ",.".contains(c);
    let mut found = Vec::new();
    let mut before = ' ';
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let end = rest.find(|c| !is_part(c)).unwrap_or(rest.len());
        if first.is_ascii_digit() {
            let is_name = before.is_alphanumeric() || "_.`#/-".contains(before);
            // The x of "x38" multiplies.
            if !is_name || before == 'x' {
                let number = rest[..end].trim_end_matches(['.', ',']);
                found.push(number.replace(',', ""));
            }
            before = '0';
            rest = &rest[end..];
        } else {
            before = first;
            rest = &rest[first.len_utf8()..];
        }
    }
    found
}

/// True if a value has these digits once it is rounded to them, in its unit, in one a thousand times
/// larger or smaller, or in percent.
fn is_quoted_as(value: f64, quoted: &str) -> bool {
    let decimals = match quoted.split_once('.') {
        Some((_, fraction)) => fraction.len() as i32,
        None => -((quoted.len() - quoted.trim_end_matches('0').len()) as i32),
    };
    let unit = 10f64.powi(decimals);
    let number: f64 = quoted.parse().unwrap();
    [1.0, 1e3, 1e-3, 100.0]
        .iter()
        .any(|scale| ((value * scale * unit).round() - number * unit).abs() < 1e-6)
}

#[test]
fn every_chapter_is_in_the_summary() {
    let listed: BTreeSet<PathBuf> = chapters().into_iter().collect();
    let pages = fs::read_dir(book())
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let pages = pages.filter(|path| path.extension().is_some_and(|extension| extension == "md"));
    let there: BTreeSet<PathBuf> = pages.filter(|path| !path.ends_with("SUMMARY.md")).collect();
    assert_eq!(listed, there);
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .unwrap()
        .to_owned()
}

fn book() -> PathBuf {
    root().join("docs/guide/src")
}

/// The chapters in the order of the summary.
fn chapters() -> Vec<PathBuf> {
    let summary = fs::read_to_string(book().join("SUMMARY.md")).unwrap();
    let links = summary.split("](").skip(1);
    links
        .map(|rest| book().join(rest.split(')').next().unwrap()))
        .collect()
}

/// The fenced blocks of a page.
fn blocks(page: &Path) -> Vec<Block> {
    let text =
        fs::read_to_string(page).unwrap_or_else(|error| panic!("{}: {error}", page.display()));
    let mut blocks = Vec::new();
    let mut open: Option<Block> = None;
    for (i, line) in text.lines().enumerate() {
        match (line.strip_prefix("```"), &mut open) {
            (Some(info), None) => {
                let info = info.to_owned();
                open = Some(Block {
                    info,
                    line: i + 2,
                    lines: Vec::new(),
                });
            }
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (None, Some(block)) => block.lines.push(line.to_owned()),
            (None, None) => {}
        }
    }
    assert!(open.is_none(), "{}: a block does not end", page.display());
    blocks
}

fn xtask<'a>(words: impl Iterator<Item = &'a str>, place: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_xtask"))
        .args(words)
        .current_dir(place)
        .env("CARGO_MANIFEST_DIR", env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap()
}
