//! The files of the repository and the code in them, for rules about sources.
//!
//! A plain reading of lines, not a parser: good enough to find a banned name, and easy to see
//! through. Comments end a line where `//` stands outside a string; what follows the first
//! `#[cfg(test)]` module of a file is its tests.

use std::path::{Path, PathBuf};

use crate::workspace;

/// Folders that are built or installed, never written by hand.
const MADE: [&str; 7] =
    [".git", "target", ".venv", "node_modules", "out", "sightline-demo", "__pycache__"];

/// Every file of the repository, relative to its top folder, sorted.
///
/// # Panics
/// When a folder cannot be read.
#[must_use]
pub fn files() -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![workspace::root().to_owned()];
    while let Some(folder) = open.pop() {
        let entries = std::fs::read_dir(&folder).unwrap_or_else(|e| panic!("{folder:?}: {e}"));
        for entry in entries {
            let entry = entry.expect("a folder's entries can be read");
            let is_folder = entry.file_type().is_ok_and(|t| t.is_dir());
            if !is_folder {
                found.push(entry.path());
            } else if !MADE.iter().any(|m| entry.file_name() == *m) {
                open.push(entry.path());
            }
        }
    }
    found.sort();
    let relative = |p: PathBuf| p.strip_prefix(workspace::root()).map(Path::to_owned);
    found.into_iter().map(|p| relative(p).expect("it is in the repository")).collect()
}

/// A line of code: where it stands, and its text without comments.
#[derive(Clone, Debug)]
pub struct Line {
    /// Relative to the top folder.
    pub file: PathBuf,
    /// From 1.
    pub number: usize,
    /// Without comments.
    pub code: String,
}

impl std::fmt::Display for Line {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}:{}: {}", self.file.display(), self.number, self.code.trim())
    }
}

/// True for sources that a library or a command is made of: neither tests, examples, benchmarks
/// nor build scripts.
#[must_use]
pub fn is_product(file: &Path) -> bool {
    let parts: Vec<_> = file.components().map(|c| c.as_os_str().to_string_lossy()).collect();
    file.extension().is_some_and(|e| e == "rs")
        && parts
            .first()
            .is_some_and(|p| ["crates", "coordinator", "worker", "proto"].contains(&&**p))
        && parts.iter().any(|p| p == "src")
}

/// The code lines of a Rust file up to its unit tests.
#[must_use]
pub fn code_of(file: &Path) -> Vec<Line> {
    let text = workspace::read(file);
    let product = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    let line = |(i, text)| Line {
        file: file.to_owned(),
        number: i + 1,
        code: without_comment(text).to_owned(),
    };
    product.lines().enumerate().map(line).collect()
}

/// The lines that have one of `words` as a whole word.
#[must_use]
pub fn lines_with(lines: &[Line], words: &[&str]) -> Vec<String> {
    let has = |l: &&Line| words.iter().any(|w| has_word(&l.code, w));
    lines.iter().filter(has).map(ToString::to_string).collect()
}

fn without_comment(line: &str) -> &str {
    let mut in_string = false;
    let mut before = ' ';
    for (i, c) in line.char_indices() {
        match c {
            '"' if before != '\\' && before != '\'' => in_string = !in_string,
            '/' if before == '/' && !in_string => return &line[..i - 1],
            _ => {}
        }
        before = c;
    }
    line
}

fn has_word(code: &str, word: &str) -> bool {
    let is_part = |c: char| c.is_alphanumeric() || c == '_';
    code.match_indices(word).any(|(at, _)| {
        let after = code[at + word.len()..].chars().next();
        let before = code[..at].chars().next_back();
        let word_ends = word.ends_with(|c| !is_part(c)) || !after.is_some_and(is_part);
        word_ends && !before.is_some_and(is_part)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_are_no_code() {
        assert_eq!(without_comment("let a = 1; // unsafe"), "let a = 1; ");
        assert_eq!(without_comment("/// dbg!"), "");
        assert_eq!(without_comment(r#"let u = "http://x"; // y"#), r#"let u = "http://x"; "#);
    }

    #[test]
    fn words_are_whole() {
        assert!(has_word("unsafe {", "unsafe"));
        assert!(!has_word("#![deny(unsafe_code)]", "unsafe"));
        assert!(has_word("use std::fs;", "std::fs"));
        assert!(has_word("std::fs::read(p)", "std::fs"));
        assert!(!has_word("eprintln!()", "println!"));
    }
}
