//! The rules of ARCHITECTURE.md and CONTRIBUTING.md, as tests.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use sightline_tests::sources::{self, Line};
use sightline_tests::workspace::{self, Workspace};

/// Modules that may hold unsafe code: two call what is compiled for AVX2, once the processor has
/// said that it has it; one reads arrays that others hold, one maps files.
const UNSAFE_MODULES: [&str; 4] = [
    "crates/geometry/src/array.rs",
    "crates/geometry/src/raycast.rs",
    "crates/scene/src/memory/map.rs",
    "crates/solver/src/tile.rs",
];

/// Crates that are plain functions of their arguments.
const PURE: [&str; 4] = ["geometry", "solver", "quality", "jobs"];

/// What keeps a crate a plain function of its arguments.
const ASYNC_FILES_AND_FORMATS: [&str; 8] =
    ["tokio", "tonic", "prost", "gltf", "parquet", "arrow-array", "object_store", "rand"];

/// Who a crate may depend on.
#[derive(Debug, PartialEq)]
enum Reach {
    Everything,
    Only(BTreeSet<String>),
}

/// The arrows of ARCHITECTURE.md, by crate: clauses `a <- b, c` (b and c may know a) and
/// `a = b + c` (a may know b and c), divided by lines or semicolons, remarks in parentheses.
fn documented_arrows(page: &str) -> BTreeMap<String, Reach> {
    let section = page.split("## Who may know whom").nth(1).expect("the section is there");
    let block = section.split("```").nth(1).expect("the section has a block");
    let mut arrows: BTreeMap<String, Reach> = BTreeMap::new();
    let mut add = |from: &str, to: &str| {
        let reach = arrows.entry(from.into()).or_insert_with(|| Reach::Only(BTreeSet::new()));
        match reach {
            _ if to == "everything" => *reach = Reach::Everything,
            Reach::Only(known) => _ = known.insert(to.into()),
            Reach::Everything => {}
        }
    };
    for clause in without_remarks(block).split(['\n', ';']).map(str::trim) {
        if let Some((known, by)) = clause.split_once("<-") {
            by.split(',').for_each(|b| add(b.trim(), known.trim()));
        } else if let Some((knower, known)) = clause.split_once('=') {
            known.split('+').for_each(|k| add(knower.trim(), k.trim()));
        } else {
            assert!(clause.is_empty(), "`{clause}` is no arrow");
        }
    }
    arrows
}

fn without_remarks(text: &str) -> String {
    let mut depth = 0;
    let keep = |c: &char| {
        depth += i32::from(*c == '(');
        let kept = depth == 0;
        depth -= i32::from(*c == ')');
        kept
    };
    text.chars().filter(keep).collect()
}

/// `geometry` for `sightline-geometry`.
fn short(name: &str) -> &str {
    name.strip_prefix("sightline-").unwrap_or(name)
}

#[test]
fn crates_know_only_whom_the_map_lets_them_know() {
    let arrows = documented_arrows(&workspace::read("ARCHITECTURE.md"));
    let workspace = Workspace::get();
    let nothing = Reach::Only(BTreeSet::new());
    let mut added = Vec::new();
    for package in workspace.members() {
        let Reach::Only(known) = arrows.get(short(&package.name)).unwrap_or(&nothing) else {
            continue;
        };
        let others = package.dependencies.iter().map(|id| &workspace.packages[id]);
        for other in others.filter(|o| o.is_member && !known.contains(short(&o.name))) {
            added.push(format!("{} -> {}", short(&package.name), short(&other.name)));
        }
    }
    assert!(added.is_empty(), "arrows that ARCHITECTURE.md does not have: {added:?}");
}

#[test]
fn the_map_names_crates_that_exist() {
    let arrows = documented_arrows(&workspace::read("ARCHITECTURE.md"));
    let members: BTreeSet<&str> = Workspace::get().members().map(|p| short(&p.name)).collect();
    for (knower, reach) in &arrows {
        assert!(members.contains(knower.as_str()), "{knower}");
        if let Reach::Only(known) = reach {
            assert!(known.iter().all(|k| members.contains(k.as_str())), "{knower}: {known:?}");
        }
    }
}

#[test]
fn arrows_are_read_as_they_are_written() {
    let page = "## Who may know whom\n```\na <- b, c\nd = a + b (of (all) things)\ne = everything; f = a\n```\n";
    let only = |known: &[&str]| Reach::Only(known.iter().map(|k| (*k).to_owned()).collect());
    let arrows = documented_arrows(page);
    assert_eq!(arrows["b"], only(&["a"]));
    assert_eq!(arrows["d"], only(&["a", "b"]));
    assert_eq!(arrows["e"], Reach::Everything);
    assert_eq!(arrows["f"], only(&["a"]));
    assert!(!arrows.contains_key("a"));
}

#[test]
fn kernels_and_scheduling_reach_neither_async_nor_files_nor_formats() {
    let workspace = Workspace::get();
    for name in PURE {
        let package = workspace.members().find(|p| short(&p.name) == name);
        let reach = workspace.reach_of(package.expect("the crate exists"));
        let wrong: Vec<_> =
            ASYNC_FILES_AND_FORMATS.iter().filter(|b| reach.contains(**b)).collect();
        assert!(wrong.is_empty(), "{name} reaches {wrong:?}");
    }
}

#[test]
fn every_crate_follows_the_lints_of_the_workspace() {
    for package in Workspace::get().members() {
        let manifest: toml::Table = std::fs::read_to_string(package.folder.join("Cargo.toml"))
            .expect("a member has a manifest")
            .parse()
            .expect("a manifest is TOML");
        let follows = manifest.get("lints").and_then(|l| l.get("workspace"));
        assert_eq!(follows, Some(&toml::Value::Boolean(true)), "{}", package.name);
    }
}

/// Code of the product whose file passes `choose`.
fn product(choose: impl Fn(&Path) -> bool) -> Vec<Line> {
    let files = sources::files().into_iter().filter(|f| sources::is_product(f) && choose(f));
    let lines: Vec<Line> = files.flat_map(|f| sources::code_of(&f)).collect();
    assert!(!lines.is_empty(), "there are sources to look at");
    lines
}

#[test]
fn unsafe_code_is_only_in_named_modules() {
    let lines = product(|f| !UNSAFE_MODULES.iter().any(|m| f == Path::new(m)));
    let found = sources::lines_with(&lines, &["unsafe", "allow(unsafe_code)"]);
    assert!(found.is_empty(), "{found:#?}");
}

#[test]
fn libraries_do_not_print() {
    let lines = product(|f| f.file_name().is_some_and(|n| n != "main.rs"));
    let macros = ["println!", "eprintln!", "print!", "eprint!", "dbg!"];
    let found = sources::lines_with(&lines, &macros);
    assert!(found.is_empty(), "{found:#?}");
}

#[test]
fn libraries_do_not_end_the_process() {
    // The command may: a second Ctrl-C does not wait for what is in flight.
    let lines = product(|f| !f.starts_with("crates/cli") && !f.ends_with("main.rs"));
    let found = sources::lines_with(&lines, &["process::exit", "process::abort"]);
    assert!(found.is_empty(), "{found:#?}");
}

#[test]
fn kernels_and_scheduling_have_no_clock_no_io_and_no_randomness() {
    let lines = product(|f| PURE.iter().any(|p| f.starts_with(format!("crates/{p}"))));
    let clocks = ["SystemTime", "Instant", "std::thread"];
    let io = ["std::fs", "std::io", "std::net", "std::env", "std::process"];
    let chance = ["rand", "RandomState"];
    let found = sources::lines_with(&lines, &[&clocks[..], &io, &chance].concat());
    assert!(found.is_empty(), "{found:#?}");
}

#[test]
fn datasets_do_not_depend_on_the_maths_library_of_the_platform() {
    // VI-3: IEEE 754 rounds + - * / and sqrt alike everywhere, but these only nearly.
    let functions = [
        "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sin_cos", "sinh", "cosh", "tanh",
        "exp", "exp2", "exp_m1", "ln", "ln_1p", "log2", "log10", "powf", "cbrt", "hypot",
    ];
    let calls: Vec<String> = functions.iter().map(|f| format!(".{f}(")).collect();
    let lines = product(|f| !f.starts_with("crates/cli"));
    let found: Vec<String> = lines
        .iter()
        .filter(|l| calls.iter().any(|c| l.code.contains(c.as_str())))
        .map(ToString::to_string)
        .collect();
    assert!(found.is_empty(), "libm computes these alike on every machine: {found:#?}");
}

#[test]
fn a_type_lives_where_it_has_a_meaning() {
    let vague = ["util", "utils", "common", "misc", "helper", "helpers"];
    let is_vague = |f: &PathBuf| {
        let parts = f.components().map(|c| c.as_os_str().to_string_lossy().into_owned());
        parts
            .map(|p| p.split('.').next().unwrap_or_default().to_owned())
            .any(|p| vague.contains(&&*p))
    };
    let found: Vec<PathBuf> = sources::files().into_iter().filter(is_vague).collect();
    assert!(found.is_empty(), "{found:?}");
}

#[test]
fn every_source_says_on_top_what_it_is() {
    let is_rust = |f: &PathBuf| f.extension().is_some_and(|e| e == "rs");
    let is_silent = |f: &PathBuf| !workspace::read(f).starts_with("//!");
    let found: Vec<_> = sources::files().into_iter().filter(is_rust).filter(is_silent).collect();
    assert!(found.is_empty(), "{found:?}");
}

#[test]
fn invariants_are_quoted_by_numbers_that_exist() {
    let mut defined = BTreeSet::new();
    let mut quoted: BTreeMap<String, PathBuf> = BTreeMap::new();
    for file in sources::files().into_iter().filter(|f| sources::is_product(f)) {
        let text = workspace::read(&file);
        for line in text.lines() {
            if let Some(item) = line.strip_prefix("//! - ") {
                defined.extend(numbered(item).filter(|n| item.starts_with(&format!("{n}: "))));
            }
            quoted.extend(numbered(line).map(|name| (name, file.clone())));
        }
    }
    let series: BTreeSet<&str> =
        defined.iter().filter_map(|d| Some(d.split_once('-')?.0)).collect();
    assert!(["VI", "JB"].iter().all(|s| series.contains(s)), "{series:?}");
    let is_unknown = |name: &str| {
        name.split_once('-').is_some_and(|(s, _)| series.contains(s)) && !defined.contains(name)
    };
    let unknown: Vec<_> = quoted.iter().filter(|(name, _)| is_unknown(name)).collect();
    assert!(unknown.is_empty(), "quoted, but on no module's list: {unknown:?}");
}

/// Words such as VI-1: two capital letters, a dash and a number.
fn numbered(line: &str) -> impl Iterator<Item = String> + '_ {
    let words = line.split(|c: char| !c.is_ascii_alphanumeric() && c != '-');
    let is_numbered = |word: &&str| {
        word.split_once('-').is_some_and(|(series, number)| {
            series.len() == 2
                && series.bytes().all(|b| b.is_ascii_uppercase())
                && !number.is_empty()
                && number.bytes().all(|b| b.is_ascii_digit())
        })
    };
    words.filter(is_numbered).map(str::to_owned)
}

#[test]
fn lock_files_name_no_place_to_download_from() {
    for file in sources::files() {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match name.as_str() {
            "Cargo.lock" => {
                let text = workspace::read(&file);
                let sources: BTreeSet<&str> =
                    text.lines().filter(|l| l.starts_with("source = ")).collect();
                assert_eq!(sources.len(), 1, "one registry: {sources:?}");
                let is_registry = sources.iter().all(|s| s.starts_with("source = \"registry+"));
                assert!(is_registry, "{sources:?}");
            }
            "package-lock.json" | "npm-shrinkwrap.json" => {
                let has_place = workspace::read(&file).contains("\"resolved\"");
                assert!(
                    !has_place,
                    "{}: npm needs omit-lockfile-registry-resolved",
                    file.display()
                );
            }
            "requirements.txt" | ".npmrc" | "pip.conf" => {
                let has_place = workspace::read(&file).contains("://");
                assert!(!has_place, "{} names a host", file.display());
            }
            _ => {}
        }
    }
}
