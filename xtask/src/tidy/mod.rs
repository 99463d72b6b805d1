//! The rules of the code base that a script can check: the import table, dependencies and circles between modules, sizes, names, where
//! `unsafe` is allowed, and that the paths named in ARCHITECTURE.md exist.

mod arrows;
mod sizes;
mod source;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Which crates each crate may import (ARCHITECTURE.md).
const IMPORTS: [(&str, &[&str]); 11] = [
    ("geom", &[]),
    ("kernels", &["geom"]),
    ("nets", &["geom", "kernels"]),
    ("engine", &["geom", "kernels"]),
    ("mesh", &["geom", "kernels"]),
    ("data", &["geom"]),
    ("scenes", &["geom", "mesh"]),
    ("pipelines", &["geom", "kernels", "engine", "nets", "mesh", "data", "scenes"]),
    ("cli", &["geom", "kernels", "engine", "nets", "mesh", "data", "scenes", "pipelines", "viewer"]),
    ("testkit", &["geom"]),
    ("viewer", &["geom"]),
];

const MAX_BYTES: u64 = 2 << 20;
const BANNED: [&str; 6] = ["utils", "common", "helpers", "misc", "manager", "legacy"];
const UNSAFE: [&str; 2] = ["crates/kernels/", "crates/data/"];
/// The only crate that may use burn, so that the others build in parallel with it.
const BURN: &str = "nets";
/// Dependencies with another name in the sources, and those that are listed only for their features.
const NAMED_ELSE: [(&str, &str); 2] = [("kamadak-exif", "exif"), ("cubecl-native", "")];

/// Prints every violation; returns whether there are none.
pub fn run() -> bool {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the workspace");
    let mut breaches = Vec::new();
    let mut files = Vec::new();
    collect(root, &mut files);
    for f in &files {
        check_file(root, f, &mut breaches);
    }
    sizes::check_lists(|name| root.join(name).is_file(), &mut breaches);
    check_arrows(root, &files, &mut breaches);
    check_manifests(root, &files, &mut breaches);
    check_architecture(root, &mut breaches);
    breaches.iter().for_each(|b| println!("tidy: {b}"));
    breaches.is_empty()
}

fn collect(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in folder.read_dir().into_iter().flatten().flatten() {
        let path = entry.path();
        let name = entry.file_name();
        if path.is_dir() {
            if ![".git", "target", "runs", "node_modules", ".carry"].contains(&&*name.to_string_lossy()) {
                collect(&path, out);
            }
        } else {
            out.push(path);
        }
    }
}

/// A file's path from the workspace's root.
fn name_of(root: &Path, path: &Path) -> String {
    path.strip_prefix(root).unwrap_or(path).to_string_lossy().replace('\\', "/")
}

/// Dependencies between the modules of each crate.
fn check_arrows(root: &Path, files: &[PathBuf], breaches: &mut Vec<String>) {
    let mut crates: BTreeMap<String, Vec<arrows::Source>> = BTreeMap::new();
    for file in files.iter().filter(|f| f.extension().is_some_and(|e| e == "rs")) {
        let Ok(text) = std::fs::read_to_string(file) else { continue };
        let name = name_of(root, file);
        if let Some((krate, source)) = arrows::Source::of(&name, &text).filter(|_| !name.starts_with("stubs/")) {
            crates.entry(krate).or_default().push(source);
        }
    }
    crates.iter().for_each(|(krate, sources)| arrows::check(krate, sources, breaches));
}

fn check_file(root: &Path, path: &Path, breaches: &mut Vec<String>) {
    let name = name_of(root, path);
    if std::fs::metadata(path).is_ok_and(|m| m.len() > MAX_BYTES) {
        breaches.push(format!("{name}: larger than 2 MiB"));
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let extension = path.extension().unwrap_or_default().to_string_lossy().into_owned();
    if ["rs", "ts"].contains(&&*extension) && BANNED.contains(&&*stem) {
        breaches.push(format!("{name}: the file name says nothing about its content"));
    }
    if extension != "rs" {
        return;
    }
    let Ok(text) = std::fs::read_to_string(path) else { return };
    sizes::check(&name, &text, breaches);
    if !text.trim_start().starts_with("//!") && !name.ends_with("tests.rs") {
        breaches.push(format!("{name}: must begin with a description (//!)"));
    }
    let this = name.split('/').nth(1).unwrap_or_default().to_string();
    let is_tidy = name.starts_with("xtask/src/tidy/");
    for (i, line) in text.lines().enumerate() {
        let at = format!("{name}:{}", i + 1);
        let code = line.split("//").next().unwrap_or_default();
        if code.contains("unsafe ") && !is_tidy && !UNSAFE.iter().any(|u| name.starts_with(u)) {
            breaches.push(format!("{at}: unsafe outside of kernels and data"));
        }
        if (code.contains("unsafe {") || code.contains("unsafe impl")) && !is_tidy {
            let above: Vec<&str> = text.lines().skip(i.saturating_sub(6)).take(7).collect();
            if !above.iter().any(|l| l.contains("SAFETY")) {
                breaches.push(format!("{at}: unsafe without a SAFETY line"));
            }
        }
        if !is_tidy && (code.contains("todo!(") || code.contains("unimplemented!(")) {
            breaches.push(format!("{at}: unfinished").to_string());
        }
        if is_tidy || !name.starts_with("crates/") {
            continue;
        }
        if (code.contains("use burn::") || code.contains(" burn::")) && this != BURN {
            breaches.push(format!("{at}: {this} may not use burn"));
        }
        let Some((_, allowed)) = IMPORTS.iter().find(|(c, _)| *c == this) else { continue };
        for (other, _) in IMPORTS {
            // Tests of any crate may use the testkit.
            let free = other == this || other == "testkit" || allowed.contains(&other);
            if !free && code.contains(&format!("diorama_{other}::")) {
                breaches.push(format!("{at}: {this} may not import {other}"));
            }
        }
    }
}

/// Every dependency must be used by its crate, and only one crate may use burn.
fn check_manifests(root: &Path, files: &[PathBuf], breaches: &mut Vec<String>) {
    for manifest in files.iter().filter(|f| f.ends_with("Cargo.toml")) {
        let folder = manifest.parent().unwrap_or(root);
        let name = name_of(root, manifest);
        if !name.starts_with("crates/") && !name.starts_with("fuzz/") {
            continue;
        }
        let Ok(text) = std::fs::read_to_string(manifest) else { continue };
        let sources = files.iter().filter(|f| f.starts_with(folder) && f.extension().is_some_and(|e| e == "rs"));
        let code: String = sources.filter_map(|f| std::fs::read_to_string(f).ok()).collect();
        for dependency in dependencies(&text) {
            if ["burn", "burn-cubecl"].contains(&dependency) && !name.starts_with(&format!("crates/{BURN}/")) {
                breaches.push(format!("{name}: only {BURN} may use {dependency}"));
            }
            let known = NAMED_ELSE.iter().find(|(d, _)| *d == dependency).map(|(_, n)| n.to_string());
            let used = known.unwrap_or_else(|| dependency.replace('-', "_"));
            if !mentions(&code, &used) {
                breaches.push(format!("{name}: {dependency} is not used"));
            }
        }
    }
}

/// Names in a manifest's dependency tables.
fn dependencies(manifest: &str) -> impl Iterator<Item = &str> {
    let mut within = false;
    manifest.lines().filter_map(move |line| {
        if line.starts_with('[') {
            within = line.ends_with("dependencies]");
        }
        let name = line.split(['=', '.', ' ']).next()?;
        (within && !name.is_empty() && !name.starts_with(['[', '#'])).then_some(name)
    })
}

/// Whether code names a crate as a whole word, outside comments.
fn mentions(code: &str, name: &str) -> bool {
    let part = |c: char| c.is_alphanumeric() || c == '_';
    code.lines().map(|l| l.split("//").next().unwrap_or_default()).any(|line| {
        line.match_indices(name).any(|(at, _)| {
            let after = &line[at + name.len()..];
            let is_path = after.starts_with("::") || (line.trim_start().starts_with("use ") && !after.starts_with(part));
            is_path && !line[..at].ends_with(part)
        })
    })
}

/// Every `crates/…` path in backticks must exist.
fn check_architecture(root: &Path, breaches: &mut Vec<String>) {
    let Ok(text) = std::fs::read_to_string(root.join("ARCHITECTURE.md")) else {
        breaches.push("ARCHITECTURE.md is missing".into());
        return;
    };
    for name in text.split('`').skip(1).step_by(2) {
        let is_path = ["crates/", "xtask/", "docs/", ".ci/"].iter().any(|p| name.starts_with(p)) && !name.contains(' ');
        if is_path && !root.join(name).exists() {
            breaches.push(format!("ARCHITECTURE.md: {name} does not exist"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn breaches_are_found() {
        let dir = std::env::temp_dir().join(format!("tidy-{}", std::process::id()));
        let file = dir.join("crates/geom/src/utils.rs");
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        let bad = "use diorama_engine::fields;\nuse burn::tensor::Tensor;\nfn f() { unsafe { g() } }\n";
        std::fs::write(&file, bad.to_string() + &"// x\n".repeat(900)).unwrap();
        let mut b = Vec::new();
        check_file(&dir, &file, &mut b);
        check_architecture(&dir, &mut b);
        std::fs::remove_dir_all(&dir).unwrap();
        for what in [
            "says nothing",
            "more than 500",
            "must begin",
            "may not import engine",
            "geom may not use burn",
            "unsafe outside",
            "SAFETY",
            "ARCHITECTURE.md is missing",
        ] {
            assert!(b.iter().any(|l| l.contains(what)), "{what}: {b:?}");
        }
    }

    #[test]
    fn idle_and_misplaced_dependencies_are_found() {
        let dir = std::env::temp_dir().join(format!("tidy-manifests-{}", std::process::id()));
        let (manifest, source) = (dir.join("crates/mesh/Cargo.toml"), dir.join("crates/mesh/src/lib.rs"));
        std::fs::create_dir_all(source.parent().unwrap()).unwrap();
        let lists = "[package]\nname = \"x\"\n[dependencies]\nburn.workspace = true\nserde = \"1\"\nrayon = \"1\"\n# none\n[dev-dependencies]\nlas = \"0\"\n";
        std::fs::write(&manifest, lists).unwrap();
        std::fs::write(&source, "use burn::tensor;\nuse rayon::prelude;\n// serde::de\nfn f() { las::read(); my_serde::g() }\n").unwrap();
        let mut b = Vec::new();
        check_manifests(&dir, &[manifest, source], &mut b);
        std::fs::remove_dir_all(&dir).unwrap();
        assert_eq!(b, ["crates/mesh/Cargo.toml: only nets may use burn", "crates/mesh/Cargo.toml: serde is not used"]);
    }

    #[test]
    fn the_project_is_tidy() {
        assert!(run());
    }
}
