//! House rules over the files of the repository.
//!
//! A new rule is one function and one line in [`RULES`]. Old offenders may be listed in
//! [`PARDONED`], a list that may only shrink: an entry that no longer offends is itself a finding.

use std::path::{Path, PathBuf};

use anyhow::Context as _;

/// Files that may break a rule for now: the rule's name and the path.
const PARDONED: [(&str, &str); 0] = [];

/// The largest file that belongs into a repository; clones stay quick.
const MAX_BYTES: u64 = 4 << 20;

/// Files that may be larger, and how large.
const LARGE: [(&str, u64); 1] = [("datasets/weights/gump-tiny.safetensors", 8 << 20)];

/// Folders that hold no sources.
const SKIPPED: [&str; 3] = [".git", "target", "out"];

/// Endings of files that hold text.
const TEXT: [&str; 8] = ["rs", "toml", "md", "txt", "css", "html", "yml", "run"];

/// A rule checks one file and returns a sentence per offence.
type Rule = fn(&File) -> Vec<String>;

const RULES: [(&str, Rule); 8] = [
    ("small files", small_files),
    ("clean lines", clean_lines),
    ("module docs", module_docs),
    ("nothing unfinished", nothing_unfinished),
    ("no unwrap", no_unwrap),
    ("no machine paths", no_machine_paths),
    ("links lead somewhere", links),
    ("examples are tested", examples_are_tested),
];

/// A file of the repository.
struct File {
    /// Root of the repository.
    root: PathBuf,
    /// Path from the root, with `/`.
    path: String,
    bytes: u64,
    /// Its text; empty if it holds something else.
    text: String,
}

/// Result of [`check`].
pub(crate) struct Tidied {
    /// Files looked at.
    pub(crate) files: usize,
    /// Every offence as a sentence with its path.
    pub(crate) problems: Vec<String>,
}

/// Applies every rule to every file.
///
/// Error: the repository cannot be read.
pub(crate) fn check(repository: &Path) -> anyhow::Result<Tidied> {
    let mut paths = Vec::new();
    list(repository, &mut paths)?;
    let mut problems = Vec::new();
    for path in &paths {
        let file = File::read(repository, path)?;
        for (rule, check) in RULES {
            let found = check(&file);
            let pardoned = PARDONED.contains(&(rule, file.path.as_str()));
            if pardoned && found.is_empty() {
                problems.push(format!(
                    "{}: no longer breaks \"{rule}\", remove it from the pardoned",
                    file.path
                ));
            } else if !pardoned {
                problems.extend(found.iter().map(|what| format!("{}: {what}", file.path)));
            }
        }
    }
    Ok(Tidied {
        files: paths.len(),
        problems,
    })
}

fn list(folder: &Path, files: &mut Vec<PathBuf>) -> anyhow::Result<()> {
    let entries = std::fs::read_dir(folder);
    let entries = entries.with_context(|| format!("cannot list {}", folder.display()))?;
    let mut paths = Vec::new();
    for entry in entries {
        paths.push(entry?.path());
    }
    paths.sort();
    for path in paths {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if SKIPPED.contains(&&*name) || name.ends_with(".partial") || path.is_symlink() {
            continue;
        }
        if path.is_dir() {
            list(&path, files)?;
        } else {
            files.push(path);
        }
    }
    Ok(())
}

impl File {
    fn read(root: &Path, path: &Path) -> anyhow::Result<Self> {
        let cannot = || format!("cannot read {}", path.display());
        let bytes = std::fs::metadata(path).with_context(cannot)?.len();
        let ending = path.extension().or(path.file_name()).unwrap_or_default();
        let is_text = bytes <= MAX_BYTES && TEXT.contains(&&*ending.to_string_lossy());
        let relative = path.strip_prefix(root).unwrap_or(path);
        Ok(Self {
            root: root.to_owned(),
            path: relative.to_string_lossy().replace('\\', "/"),
            bytes,
            text: if is_text {
                std::fs::read_to_string(path).with_context(cannot)?
            } else {
                String::new()
            },
        })
    }

    fn is_rust(&self) -> bool {
        self.path.ends_with(".rs")
    }

    /// Lines with their numbers from 1.
    fn lines(&self) -> impl Iterator<Item = (usize, &str)> {
        self.text.lines().enumerate().map(|(i, line)| (i + 1, line))
    }
}

fn small_files(file: &File) -> Vec<String> {
    let large = LARGE.iter().find(|(path, _)| *path == file.path);
    let most = large.map_or(MAX_BYTES, |&(_, most)| most);
    let mb = file.bytes as f64 / f64::from(1 << 20);
    let too_large = file.bytes > most;
    let problem = format!("expected at most {} MB, found {mb:.1} MB", most >> 20);
    too_large.then_some(problem).into_iter().collect()
}

fn clean_lines(file: &File) -> Vec<String> {
    let trailing = file.lines().filter(|(_, line)| line.ends_with([' ', '\t']));
    let mut found: Vec<_> = trailing
        .map(|(number, _)| format!("line {number}: space at the end"))
        .collect();
    if !file.text.is_empty() && !file.text.ends_with('\n') {
        found.push("the last line does not end".into());
    }
    if file.text.contains('\r') {
        found.push("expected lines to end with \\n, found \\r".into());
    }
    found
}

fn module_docs(file: &File) -> Vec<String> {
    let documented = !file.is_rust() || file.text.starts_with("//!");
    let problem = "expected a module comment (//!) in the first line";
    (!documented).then(|| problem.into()).into_iter().collect()
}

fn nothing_unfinished(file: &File) -> Vec<String> {
    // Assembled, so that this file does not find itself.
    let words = [
        concat!("todo", "!("),
        concat!("unimplemented", "!("),
        concat!("FIX", "ME"),
        concat!("TO", "DO"),
        concat!("XX", "X:"),
    ];
    occurrences(file.lines(), &words)
}

fn no_unwrap(file: &File) -> Vec<String> {
    let in_source = file.path.starts_with("crates/") || file.path.starts_with("xtask/");
    let is_test = ["/tests/", "/benches/", "/examples/", "tests.rs"];
    if !file.is_rust() || !in_source || is_test.iter().any(|part| file.path.contains(part)) {
        return Vec::new();
    }
    let production = file
        .lines()
        .take_while(|(_, line)| !line.trim_start().starts_with("#[cfg(test)]"))
        .filter(|(_, line)| !line.trim_start().starts_with("//"));
    occurrences(production, &[concat!(".unw", "rap()")])
}

fn no_machine_paths(file: &File) -> Vec<String> {
    let words = [
        concat!("/ho", "me/"),
        concat!("/Us", "ers/"),
        concat!("/wo", "rk/"),
        concat!("/ro", "ot/"),
    ];
    occurrences(file.lines(), &words)
}

/// Relative links of Markdown files.
fn links(file: &File) -> Vec<String> {
    let mut found = Vec::new();
    if !file.path.ends_with(".md") {
        return found;
    }
    let folder = file.root.join(&file.path);
    let folder = folder.parent().unwrap_or(&file.root);
    for (number, line) in file.lines() {
        for rest in line.split("](").skip(1) {
            let target = rest.split([')', '#', ' ']).next().unwrap_or_default();
            let outside = target.is_empty() || target.contains(':');
            if !outside && !folder.join(target).exists() {
                found.push(format!("line {number}: the link to {target} leads nowhere"));
            }
        }
    }
    found
}

/// Checks that each Rust example of a crate's README is also in the crate's documentation, where it
/// is tested.
fn examples_are_tested(file: &File) -> Vec<String> {
    let Some(of_crate) = file.path.strip_suffix("/README.md") else {
        return Vec::new();
    };
    let library = file.root.join(of_crate).join("src/lib.rs");
    let (true, Ok(library)) = (
        of_crate.starts_with("crates/"),
        std::fs::read_to_string(library),
    ) else {
        return Vec::new();
    };
    let documented = library.lines().map_while(|line| line.strip_prefix("//!"));
    let documented = documented.map(|line| line.strip_prefix(' ').unwrap_or(line));
    // Lines that rustdoc hides.
    let is_shown = |line: &&str| *line != "#" && !line.starts_with("# ");
    let documented: Vec<&str> = documented.filter(is_shown).collect();
    let documented = documented.join("\n");
    let shown = file.text.split("```rust\n").skip(1);
    let shown = shown.filter_map(|rest| rest.split_once("\n```"));
    let untested = shown.filter(|(code, _)| !documented.contains(&format!("```\n{code}\n```")));
    untested
        .map(|(code, _)| {
            let first = code.lines().next().unwrap_or_default();
            format!("expected the example in the documentation of src/lib.rs, found {first}")
        })
        .collect()
}

fn occurrences<'a>(lines: impl Iterator<Item = (usize, &'a str)>, words: &[&str]) -> Vec<String> {
    let mut found = Vec::new();
    for (number, line) in lines {
        for word in words.iter().filter(|word| line.contains(**word)) {
            found.push(format!("line {number}: found {word}"));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_repository_is_tidy() {
        let tidied = check(&crate::machine::repository()).unwrap();
        assert!(tidied.files > 50, "only {} files seen", tidied.files);
        let problems = tidied.problems.join("\n");
        assert!(tidied.problems.is_empty(), "{problems}");
    }

    fn found(path: &str, text: &str) -> Vec<String> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(path);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, text).unwrap();
        check(folder.path()).unwrap().problems
    }

    #[test]
    fn every_rule_finds_its_offence() {
        let check = |path: &str, text: &str, expected: &str| {
            assert_eq!(found(path, text), [format!("{path}: {expected}")]);
        };
        let source = "crates/a/src/a.rs";
        check(source, "//! A. \n", "line 1: space at the end");
        check(source, "//! A.", "the last line does not end");
        check(
            source,
            "fn a() {}\n",
            "expected a module comment (//!) in the first line",
        );
        let text = format!("//! A.\nfn a() {{ {} }}\n", concat!("b.unw", "rap();"));
        check(
            source,
            &text,
            &format!("line 2: found {}", concat!(".unw", "rap()")),
        );
        let text = concat!("//! FIX", "ME\n");
        check(
            source,
            text,
            &format!("line 1: found {}", concat!("FIX", "ME")),
        );
        let text = concat!("//! /ho", "me/me\n");
        check(
            source,
            text,
            &format!("line 1: found {}", concat!("/ho", "me/")),
        );
        check(
            "docs/a.md",
            "[b](b.md) and [c](https://example.org)\n",
            "line 1: the link to b.md leads nowhere",
        );
        let large = "a".repeat(5 << 20);
        check("a.bin", &large, "expected at most 4 MB, found 5.0 MB");
    }

    #[test]
    fn a_page_shows_what_is_tested() {
        let folder = tempfile::tempdir().unwrap();
        let library = "//! A.\n//!\n//! ```\n//! # hidden();\n//! shown();\n//! ```\n";
        let of = |shown: &str| format!("# a\n\n```rust\n{shown}\n```\n");
        let write = |path: &str, text: &str| std::fs::write(folder.path().join(path), text);
        std::fs::create_dir_all(folder.path().join("crates/a/src")).unwrap();
        write("crates/a/src/lib.rs", library).unwrap();
        write("crates/a/README.md", &of("shown();")).unwrap();
        assert_eq!(check(folder.path()).unwrap().problems, [""; 0]);
        write("crates/a/README.md", &of("other();")).unwrap();
        let problem = "crates/a/README.md: expected the example in the documentation of \
                       src/lib.rs, found other();";
        assert_eq!(check(folder.path()).unwrap().problems, [problem]);
    }

    #[test]
    fn tests_may_unwrap() {
        let unwrap = concat!("a.unw", "rap()");
        let text = format!("//! A.\n\n#[cfg(test)]\nmod tests {{ {unwrap} }}\n");
        assert_eq!(found("crates/a/src/a.rs", &text), [""; 0]);
    }
}
