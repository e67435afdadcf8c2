//! Every dependency may be used under a licence that `deny.toml` allows.

use std::collections::BTreeSet;

use sightline_tests::workspace::{self, Package, Workspace};
use spdx::{Expression, ParseMode};

fn allowed() -> BTreeSet<String> {
    let rules: toml::Table = workspace::read("deny.toml").parse().expect("deny.toml is TOML");
    let list = rules["licenses"]["allow"].as_array().expect("licenses.allow is a list");
    list.iter().map(|l| l.as_str().expect("a licence is a text").to_owned()).collect()
}

/// What is wrong with an SPDX expression, if anything.
fn problem(expression: &str, allowed: &BTreeSet<String>) -> Option<String> {
    // Lax: older packages write `/` for `OR`.
    match Expression::parse_mode(expression, ParseMode::LAX) {
        Err(error) => Some(format!("`{expression}` cannot be read: {error}")),
        Ok(e) if e.evaluate(|licence| allowed.contains(&licence.to_string())) => None,
        Ok(_) => Some(format!("`{expression}` asks for a licence that is not allowed")),
    }
}

#[test]
fn every_dependency_has_an_allowed_licence() {
    let allowed = allowed();
    let judge = |p: &Package| {
        let problem = match &p.licence {
            None => Some("states no licence".to_owned()),
            Some(expression) => problem(expression, &allowed),
        };
        problem.map(|what| format!("{} {}: {what}", p.name, p.version))
    };
    let refused: Vec<String> = Workspace::get().packages.values().filter_map(judge).collect();
    assert!(refused.is_empty(), "{refused:#?}");
}

#[test]
fn expressions_are_weighed_not_searched() {
    let allowed = allowed();
    let is_fine = |e| problem(e, &allowed).is_none();
    assert!(is_fine("MIT OR GPL-3.0-only"));
    assert!(is_fine("(MIT OR Apache-2.0) AND Unicode-3.0"));
    assert!(is_fine("Apache-2.0 / MIT"));
    assert!(is_fine("Apache-2.0 WITH LLVM-exception"));
    assert!(!is_fine("MIT AND GPL-3.0-only"));
    assert!(!is_fine("GPL-3.0-only WITH Classpath-exception-2.0"));
    assert!(!is_fine("no licence at all"));
}

#[test]
fn the_workspace_ships_the_licences_it_names() {
    for package in Workspace::get().members() {
        assert_eq!(package.licence.as_deref(), Some("MIT OR Apache-2.0"), "{}", package.name);
    }
    assert!(workspace::read("LICENSE-MIT").contains("Permission is hereby granted"));
    assert!(workspace::read("LICENSE-APACHE").contains("Version 2.0, January 2004"));
}
