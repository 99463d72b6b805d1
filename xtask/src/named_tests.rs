//! Checks that every test named in TESTING.md's table of defects exists.

use std::path::Path;

/// Files and tests in the table's rows: `` `FILE` `::TEST`, `::TEST` ``.
fn named(text: &str) -> Vec<(String, String)> {
    let rows = text.lines().skip_while(|l| *l != "## Defects and their tests").filter(|l| l.starts_with("| "));
    let mut out = Vec::new();
    for row in rows {
        let mut file = "";
        for quoted in row.split('`').skip(1).step_by(2) {
            match quoted.strip_prefix("::") {
                Some(test) => out.push((file.to_string(), test.to_string())),
                None => file = quoted,
            }
        }
    }
    out
}

#[test]
fn every_test_of_the_table_of_defects_is_there() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let all = named(&std::fs::read_to_string(root.join("TESTING.md")).unwrap());
    assert!(all.len() > 50, "{} tests", all.len());
    for (file, test) in all {
        let path = if file.starts_with("xtask/") { root.join(&file) } else { root.join("crates").join(&file) };
        let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{file}: {e}"));
        let at = text.find(&format!("fn {test}()")).unwrap_or_else(|| panic!("{file} has no test {test}"));
        assert!(text[..at].rfind("#[test]").is_some_and(|t| !text[t..at].contains('}')), "{file}: {test} is no test");
    }
}
