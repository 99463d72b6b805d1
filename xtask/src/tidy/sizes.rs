//! Size limits: lines per file, lines per function.

use super::source::{code, functions};

/// Most lines of a file.
pub const MAX_LINES: usize = 500;
/// Most lines of a function.
pub const MAX_FUNCTION: usize = 80;

/// Longer files, and how long they may be: none may grow, none may be added, and one that is short enough must be removed.
const LONGER: [(&str, usize); 0] = [];

/// The same for functions.
const LONGER_FUNCTIONS: [(&str, &str, usize); 0] = [];

/// Violations in a source file.
pub fn check(name: &str, text: &str, breaches: &mut Vec<String>) {
    let lines = text.lines().count();
    let allowed = LONGER.iter().find(|l| l.0 == name).map(|l| l.1);
    breaches.extend(too_long(name.to_string(), lines, MAX_LINES, allowed));
    let mut listed: Vec<_> = LONGER_FUNCTIONS.iter().filter(|f| f.0 == name).collect();
    for f in functions(&code(text)) {
        let allowed = listed.iter().position(|l| l.1 == f.name && f.lines > MAX_FUNCTION).map(|i| listed.remove(i).2);
        breaches.extend(too_long(format!("{name}:{}: {}", f.line, f.name), f.lines, MAX_FUNCTION, allowed));
    }
    breaches
        .extend(listed.iter().map(|l| format!("{name}: {} is listed as long in tidy/sizes.rs but is not: remove it from the list", l.1)));
}

/// Listed files that do not exist.
pub fn check_lists(exists: impl Fn(&str) -> bool, breaches: &mut Vec<String>) {
    let names = LONGER.iter().map(|l| l.0).chain(LONGER_FUNCTIONS.iter().map(|l| l.0));
    breaches.extend(
        names
            .filter(|n| !exists(n))
            .map(|n| format!("{n}: is listed as long in tidy/sizes.rs but does not exist: remove it from the list")),
    );
}

fn too_long(what: String, lines: usize, most: usize, allowed: Option<usize>) -> Option<String> {
    match allowed {
        None if lines > most => Some(format!("{what}: {lines} lines, more than {most}")),
        Some(n) if lines > n => Some(format!("{what}: {lines} lines, more than the {n} that its exception allows")),
        Some(_) if lines <= most => Some(format!("{what}: {lines} lines; remove its exception from the list in tidy/sizes.rs")),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn breaches(text: &str) -> Vec<String> {
        let mut b = Vec::new();
        check("crates/geom/src/a.rs", text, &mut b);
        b
    }

    #[test]
    fn long_files_and_functions_are_found() {
        assert_eq!(breaches(&"//\n".repeat(MAX_LINES)), Vec::<String>::new());
        assert!(breaches(&"//\n".repeat(MAX_LINES + 1))[0].contains("501 lines, more than 500"));
        let function = |lines: usize| format!("fn long() {{\n{}}}\n", "a();\n".repeat(lines - 2));
        assert_eq!(breaches(&function(MAX_FUNCTION)), Vec::<String>::new());
        assert!(breaches(&function(MAX_FUNCTION + 1))[0].contains("a.rs:1: long: 81 lines"));
    }

    #[test]
    fn exceptions_bound_and_shrink() {
        let of = |lines: usize, allowed| too_long("a".into(), lines, 500, allowed).unwrap_or_default();
        assert_eq!(of(600, Some(600)), "");
        assert!(of(601, Some(600)).contains("more than the 600"));
        assert!(of(500, Some(600)).contains("remove its exception"));
        let mut b = Vec::new();
        check_lists(|_| false, &mut b);
        assert_eq!(b.len(), LONGER.len() + LONGER_FUNCTIONS.len());
    }
}
