//! Dependencies between modules: none between applications, none from shared code to an application, and no circles inside a crate.

use super::source::{code, paths, without_tests};
use std::collections::{BTreeMap, BTreeSet};

/// The applications, as modules of `pipelines`.
const APPLICATIONS: [&str; 5] = ["object", "text", "world", "head", "relight"];
/// The module that all applications share; it depends on none of them.
const SHARED: &str = "run";
/// The folders of `pipelines` beside these.
const OTHERS: [&str; 1] = ["bench"];

/// Dependencies that close a circle today: (crate, from module, to module). One that no longer exists must be removed.
const CIRCLES: [(&str, &str, &str); 0] = [];

/// A source file of a crate.
pub struct Source {
    /// Path of the module from the crate's root; empty for the root itself.
    module: Vec<String>,
    /// Paths that it names, from the crate's root, with their line numbers.
    names: Vec<(usize, Vec<String>)>,
    file: String,
}

impl Source {
    /// The module of a file such as `crates/geom/src/a/b.rs`, without its tests; `None` for files that are not modules.
    pub fn of(file: &str, text: &str) -> Option<(String, Source)> {
        let (krate, inner) = file.strip_prefix("crates/").unwrap_or(file).split_once("/src/")?;
        let module: Vec<String> = inner.strip_suffix(".rs")?.split('/').map(String::from).collect();
        let mut module = module;
        if ["mod", "lib", "main"].contains(&module.last()?.as_str()) {
            module.pop();
        }
        if module.last().is_some_and(|m| m == "tests" || m.ends_with("_tests")) {
            return None;
        }
        let names = paths(&without_tests(&code(text))).into_iter().filter_map(|(line, p)| Some((line, absolute(&module, &p)?))).collect();
        Some((krate.to_string(), Source { module, names, file: file.to_string() }))
    }
}

/// Resolves a path from the crate's root; `None` if `super` leads out of the crate.
fn absolute(module: &[String], path: &[String]) -> Option<Vec<String>> {
    let mut at: Vec<String> = if path[0] == "crate" { Vec::new() } else { module.to_vec() };
    for part in path {
        match &part[..] {
            "crate" | "self" => {}
            "super" => drop(at.pop()?),
            name => at.push(name.to_string()),
        }
    }
    Some(at)
}

/// Violations in a crate, given by its name.
pub fn check(krate: &str, sources: &[Source], breaches: &mut Vec<String>) {
    if krate == "pipelines" {
        applications(sources, breaches);
    }
    circles(krate, sources, &CIRCLES, breaches);
}

fn applications(sources: &[Source], breaches: &mut Vec<String>) {
    let known = |m: &&String| APPLICATIONS.contains(&m.as_str()) || *m == SHARED || OTHERS.contains(&m.as_str());
    let folders: BTreeSet<&String> = sources.iter().filter(|s| s.module.len() > 1).map(|s| &s.module[0]).collect();
    for folder in folders.iter().filter(|m| !known(m)) {
        breaches.push(format!("pipelines: {folder} is not in the list of applications in tidy/arrows.rs"));
    }
    for s in sources {
        let Some(from) = s.module.first().filter(|m| APPLICATIONS.contains(&m.as_str()) || *m == SHARED) else { continue };
        for (line, to) in s.names.iter().filter_map(|(line, p)| Some((line, p.first()?))) {
            if to != from && APPLICATIONS.contains(&to.as_str()) {
                breaches.push(format!("{}:{line}: {from} may not import {to}", s.file));
            }
        }
    }
}

/// Reports every circle among the modules of one folder.
fn circles(krate: &str, sources: &[Source], listed: &[(&str, &str, &str)], breaches: &mut Vec<String>) {
    let modules: BTreeSet<&[String]> = sources.iter().flat_map(|s| (0..=s.module.len()).map(|n| &s.module[..n])).collect();
    // Dependencies between sibling modules, and one source location of each.
    let mut arrows: BTreeMap<(String, String), String> = BTreeMap::new();
    for s in sources {
        for (line, name) in &s.names {
            let known = (0..=name.len()).rev().find(|n| modules.contains(&name[..*n])).unwrap_or(0);
            let to = &name[..known];
            let shared = s.module.iter().zip(to).take_while(|(a, b)| a == b).count();
            if shared < s.module.len() && shared < to.len() {
                let arrow = (s.module[..=shared].join("::"), to[..=shared].join("::"));
                arrows.entry(arrow).or_insert_with(|| format!("{}:{line}", s.file));
            }
        }
    }
    for (_, from, to) in listed.iter().filter(|c| c.0 == krate) {
        if arrows.remove(&(from.to_string(), to.to_string())).is_none() {
            breaches.push(format!("{krate}: {from} no longer imports {to}: remove it from the list in tidy/arrows.rs"));
        }
    }
    while let Some(circle) = circle(&arrows) {
        let places: Vec<String> =
            circle.windows(2).map(|a| format!("{} -> {} ({})", a[0], a[1], arrows[&(a[0].clone(), a[1].clone())])).collect();
        breaches.push(format!("{krate}: a circle of modules: {}", places.join(", ")));
        arrows.remove(&(circle[0].clone(), circle[1].clone()));
    }
}

/// A shortest circle; its first module is repeated at the end.
fn circle(arrows: &BTreeMap<(String, String), String>) -> Option<Vec<String>> {
    let begins: BTreeSet<&String> = arrows.keys().map(|(from, _)| from).collect();
    begins.into_iter().filter_map(|b| way_back(arrows, b)).min_by_key(Vec::len)
}

/// The shortest path from a module back to itself.
fn way_back(arrows: &BTreeMap<(String, String), String>, from: &String) -> Option<Vec<String>> {
    let mut came: BTreeMap<&String, &String> = BTreeMap::new();
    let mut edge = vec![from];
    while !edge.is_empty() {
        let mut next = Vec::new();
        for at in edge {
            for (_, to) in arrows.keys().filter(|(f, _)| f == at) {
                if to == from {
                    let mut way = vec![from.clone(), at.clone()];
                    let mut back = at;
                    while back != from {
                        back = came[back];
                        way.push(back.clone());
                    }
                    way.reverse();
                    return Some(way);
                }
                if !came.contains_key(to) {
                    came.insert(to, at);
                    next.push(to);
                }
            }
        }
        edge = next;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sources(krate: &str, files: &[(&str, &str)]) -> Vec<Source> {
        files.iter().filter_map(|(f, text)| Source::of(&format!("crates/{krate}/src/{f}"), text)).map(|(_, s)| s).collect()
    }

    fn breaches(krate: &str, files: &[(&str, &str)]) -> Vec<String> {
        let mut b = Vec::new();
        if krate == "pipelines" {
            applications(&sources(krate, files), &mut b);
        }
        circles(krate, &sources(krate, files), &[], &mut b);
        b
    }

    #[test]
    fn listed_circles_are_allowed_until_they_are_gone() {
        let listed = [("geom", "b", "a")];
        let of = |files: &[(&str, &str)]| {
            let mut b = Vec::new();
            circles("geom", &sources("geom", files), &listed, &mut b);
            b
        };
        assert_eq!(of(&[("a.rs", "use crate::b;\n"), ("b.rs", "use crate::a;\n")]), Vec::<String>::new());
        assert_eq!(
            of(&[("a.rs", "use crate::b;\n"), ("b.rs", "")]),
            ["geom: b no longer imports a: remove it from the list in tidy/arrows.rs"]
        );
    }

    #[test]
    fn applications_do_not_know_each_other_and_what_they_share_knows_none() {
        let sideways = [("text/mod.rs", ""), ("head/mod.rs", "use crate::run;\nuse crate::text::recipe;\n"), ("run/mod.rs", "")];
        let b = breaches("pipelines", &sideways);
        assert_eq!(b, ["crates/pipelines/src/head/mod.rs:2: head may not import text"]);
        let upward = [("object/mod.rs", ""), ("run/folder.rs", "fn f() { crate::object::config::new() }\n")];
        assert_eq!(breaches("pipelines", &upward), ["crates/pipelines/src/run/folder.rs:1: run may not import object"]);
        let good = [("object/mod.rs", "use crate::run::folder;\n"), ("run/folder.rs", ""), ("bench.rs", "use crate::object;\n")];
        assert_eq!(breaches("pipelines", &good), Vec::<String>::new());
        let unlisted = [("fog/mod.rs", ""), ("fog/recipe.rs", "use crate::object;\n"), ("object/mod.rs", ""), ("bench/nets.rs", "")];
        assert_eq!(breaches("pipelines", &unlisted), ["pipelines: fog is not in the list of applications in tidy/arrows.rs"]);
    }

    #[test]
    fn circles_are_found_at_every_level() {
        let pair = [("a.rs", "use crate::b::c;\n"), ("b/mod.rs", ""), ("b/c.rs", "\nuse crate::a;\n")];
        let b = breaches("geom", &pair);
        assert!(b.len() == 1 && b[0].contains("a -> b (crates/geom/src/a.rs:1), b -> a (crates/geom/src/b/c.rs:2)"), "{b:?}");
        let three = [("o/mod.rs", ""), ("o/a.rs", "use super::b;\n"), ("o/b.rs", "use super::{c::d};\n"), ("o/c.rs", "use super::a::X;\n")];
        let b = breaches("geom", &three);
        assert!(b.len() == 1 && b[0].contains("o::a -> o::b") && b[0].contains("o::c -> o::a"), "{b:?}");
    }

    #[test]
    fn parents_tests_and_comments_close_no_circle() {
        let good = [
            ("lib.rs", "pub use a::X;\n"),
            ("a.rs", "use crate::{X, b};\n"),
            ("b/mod.rs", "use self::c::Y;\n// use crate::a;\n#[cfg(test)]\nmod tests {\n    use crate::a;\n}\n"),
            ("b/c.rs", "use super::Z;\n"),
            ("b/tests.rs", "use crate::a;\n"),
        ];
        assert_eq!(breaches("geom", &good), Vec::<String>::new());
    }
}
