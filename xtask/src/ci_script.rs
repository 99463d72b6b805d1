//! Checks `.ci/run`: it must install what tests need before they run, and turn its absence into a failure.

/// Packages without which tests would be skipped.
const INSTALLED: [&str; 8] =
    ["mesa-vulkan-drivers", "g++", "chromium", "npm", "ffmpeg", "python3-venv", "python3-torch", "build-essential"];
/// Variables that make a test fail, or run, instead of being skipped.
const REQUIRED: [&str; 6] = [
    "DIORAMA_REQUIRE_READERS=1",
    "DIORAMA_REQUIRE_FFMPEG=1",
    "DIORAMA_REQUIRE_GPU=1",
    "DIORAMA_READERS=",
    "DIORAMA_TORCH_PYTHON=",
    "DIORAMA_NEW_FFMPEG=",
];
/// Checks that need a device or a browser.
const CHECKS: [&str; 3] = ["cargo xtask gpu-check vulkan", "cargo xtask gpu-check webgpu,cuda", "cargo xtask viewer-check"];

/// Faults of a script, one line each.
fn faults(script: &str) -> Vec<String> {
    let lines: Vec<&str> = script.lines().map(str::trim).filter(|l| !l.starts_with('#')).collect();
    let Some(tests) = lines.iter().position(|l| *l == "cargo xtask ci") else { return vec!["it runs no tests".into()] };
    let (before, after) = lines.split_at(tests);
    let mut out = Vec::new();
    if !lines.iter().any(|l| l.starts_with("set -e") && l.contains("pipefail")) {
        out.push("it continues after a failure".into());
    }
    let words = |start: &str| -> Vec<&str> { before.iter().filter(|l| l.starts_with(start)).flat_map(|l| l.split_whitespace()).collect() };
    let (needed, exported) = (words("need '"), words("export "));
    let position = |part: &str| before.iter().position(|l| l.contains(part));
    let last_need = before.iter().rposition(|l| l.starts_with("need '"));
    match (last_need, position("apt-get install")) {
        (Some(need), Some(install)) if need < install && before[install].contains("${missing[@]}") => {}
        _ => out.push("nothing is installed before the tests".into()),
    }
    if position("benches/readers.sh").is_none() {
        out.push("readers of exports are not installed before the tests".into());
    }
    out.extend(INSTALLED.iter().filter(|p| !needed.contains(p)).map(|p| format!("{p} is not installed before the tests")));
    let is_set = |v: &&&str| exported.iter().any(|e| e.starts_with(**v) && e.len() > v.len() - v.ends_with('1') as usize);
    out.extend(REQUIRED.iter().filter(|v| !is_set(v)).map(|v| format!("{v} is not exported before the tests")));
    out.extend(CHECKS.iter().filter(|c| !after.contains(c)).map(|c| format!("{c} does not run")));
    out
}

#[test]
fn the_script_installs_before_it_tests_and_lets_nothing_be_skipped() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let script = std::fs::read_to_string(root.join(".ci/run")).unwrap();
    assert_eq!(faults(&script), Vec::<String>::new());
    // Each of these changes would skip tests.
    let tests = "\ncargo xtask ci\n";
    let without_tests = script.replace(tests, "\n");
    let (head, rest) = without_tests.split_once("\nmissing=()").unwrap();
    assert!(!faults(&format!("{head}{tests}missing=(){rest}")).is_empty(), "tests before the installation");
    for (what, with) in [
        (tests, "\n"),
        ("need 'ls /usr/share/vulkan", "# need 'ls /usr/share/vulkan"),
        ("apt-get install", "apt-get download"),
        ("benches/readers.sh", "echo"),
        (" DIORAMA_REQUIRE_GPU=1", ""),
        (" DIORAMA_REQUIRE_FFMPEG=1", ""),
        ("DIORAMA_NEW_FFMPEG=", "NEW_FFMPEG="),
        ("DIORAMA_REQUIRE_READERS=1", "DIORAMA_REQUIRE_READERS="),
        (" DIORAMA_TORCH_PYTHON=/usr/bin/python3", ""),
        ("ffmpeg\n", "\n"),
        ("set -euo pipefail", ""),
        ("cargo xtask gpu-check vulkan\n", ""),
        ("cargo xtask viewer-check", "true"),
    ] {
        assert!(script.contains(what), "{what:?}");
        assert!(!faults(&script.replace(what, with)).is_empty(), "without {what:?}");
    }
}
