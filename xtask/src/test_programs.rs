//! The workspace's tests: built once, run two programs at a time, and counted.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::time::Instant;

/// Test programs that run at the same time: most wait for one thread, for programs that they start, or for the clock.
const AT_ONCE: usize = 2;

/// Results of tests; one that prints a line `skipped: …` is skipped.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Counts {
    pub passed: usize,
    pub failed: usize,
    pub skipped: usize,
}

impl std::ops::Add for Counts {
    type Output = Counts;

    fn add(self, b: Counts) -> Counts {
        Counts { passed: self.passed + b.passed, failed: self.failed + b.failed, skipped: self.skipped + b.skipped }
    }
}

/// A program with tests, and the instruction set that it runs with.
#[derive(Clone, Debug, PartialEq)]
pub struct Program {
    path: PathBuf,
    /// Folder of its crate, in which it runs.
    folder: PathBuf,
    is_library: bool,
    /// `DIORAMA_SIMD`; the machine's best where there is none.
    level: Option<&'static str>,
}

/// Builds the tests of the whole workspace; `None` where that fails.
pub fn build() -> Option<Vec<Program>> {
    let args = ["test", "--release", "--workspace", "--no-run", "--message-format=json-render-diagnostics"];
    println!("\n$ cargo {}", args.join(" "));
    let out = Command::new("cargo").args(args).stderr(Stdio::inherit()).output().ok()?;
    let programs: Vec<Program> = String::from_utf8_lossy(&out.stdout).lines().filter_map(program).collect();
    (out.status.success() && !programs.is_empty()).then_some(programs)
}

/// The test program of a line of cargo's messages.
fn program(line: &str) -> Option<Program> {
    let text = |name: &str| line.split_once(&format!("\"{name}\":\"")).and_then(|(_, rest)| rest.split('"').next());
    let is_test = line.contains("\"reason\":\"compiler-artifact\"") && line.contains("\"test\":true},\"features\"");
    let folder = Path::new(text("manifest_path")?).parent()?.to_path_buf();
    is_test.then_some(Program { path: text("executable")?.into(), folder, is_library: line.contains("\"kind\":[\"lib\"]"), level: None })
}

/// The library tests of some crates, to be run with a lower instruction set than the machine's best; `None` if a crate has no tests.
pub fn at_level(programs: &[Program], level: &'static str, crates: &[&str]) -> Option<Vec<Program>> {
    let of = |name: &&str| programs.iter().find(|p| p.is_library && p.folder.ends_with(format!("crates/{name}")));
    crates.iter().map(|name| of(name).map(|p| Program { level: Some(level), ..p.clone() })).collect()
}

/// Runs the tests of programs, then those in the documentation of the workspace's crates.
pub fn run(programs: &[Program]) -> Counts {
    let (next, counts) = (Mutex::new(programs.iter()), Mutex::new(Counts::default()));
    let work = || {
        loop {
            let Some(program) = next.lock().unwrap().next() else { break };
            let begin = Instant::now();
            let mut command = Command::new(&program.path);
            command.arg("--show-output").current_dir(&program.folder).env("CARGO_MANIFEST_DIR", &program.folder);
            command.envs(program.level.map(|l| ("DIORAMA_SIMD", l)));
            let (text, ok) = output(&mut command);
            let mut counts = counts.lock().unwrap();
            let name = program.path.file_name().unwrap_or_default().to_string_lossy();
            let level = program.level.map(|l| format!(" with DIORAMA_SIMD={l}")).unwrap_or_default();
            println!("\n{name}{level}: {:.0} s", begin.elapsed().as_secs_f64());
            *counts = *counts + shown(&text, ok);
        }
    };
    std::thread::scope(|scope| (0..AT_ONCE).for_each(|_| drop(scope.spawn(work))));
    let args = ["test", "--release", "--workspace", "--doc", "--no-fail-fast"];
    println!("\n$ cargo {}", args.join(" "));
    let (text, ok) = output(Command::new("cargo").args(args));
    counts.into_inner().unwrap() + shown(&text, ok)
}

/// What a command printed, with what it said of errors if it failed, and whether it succeeded.
fn output(command: &mut Command) -> (String, bool) {
    match command.output() {
        Ok(out) => {
            let mut text = String::from_utf8_lossy(&out.stdout).into_owned();
            if !out.status.success() {
                text += &format!("{}\n{}\n", String::from_utf8_lossy(&out.stderr), out.status);
            }
            (text, out.status.success())
        }
        Err(e) => (format!("{}: {e}\n", command.get_program().to_string_lossy()), false),
    }
}

/// Prints what a program's tests printed, whole if it failed, and counts them.
fn shown(text: &str, ok: bool) -> Counts {
    for line in text.lines() {
        if !ok || line.starts_with("test ") || line.starts_with("skipped:") {
            println!("{line}");
        }
    }
    counted(text, ok)
}

/// Counts the results in the output of a test program, or of several.
fn counted(text: &str, ok: bool) -> Counts {
    let mut of = Counts::default();
    for line in text.lines() {
        of.skipped += line.starts_with("skipped:") as usize;
        if let Some(rest) = line.strip_prefix("test result:") {
            let count = |word: &str| {
                let part = rest.split(';').find(|p| p.contains(word))?;
                part.split_whitespace().filter_map(|w| w.parse::<usize>().ok()).next_back()
            };
            of.passed += count("passed").unwrap_or(0);
            of.failed += count("failed").unwrap_or(0);
        }
    }
    if !ok && of.failed == 0 {
        of.failed = 1;
    }
    of.passed = of.passed.saturating_sub(of.skipped);
    of
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIBRARY: &str = r#"{"reason":"compiler-artifact","package_id":"path+file:///w/crates/nets#diorama-nets@0.1.0","manifest_path":"/w/crates/nets/Cargo.toml","target":{"kind":["lib"],"crate_types":["lib"],"name":"diorama_nets","src_path":"/w/crates/nets/src/lib.rs","edition":"2024","doc":true,"doctest":true,"test":true},"profile":{"opt_level":"3","debuginfo":0,"debug_assertions":false,"overflow_checks":false,"test":true},"features":[],"filenames":["/w/target/release/deps/diorama_nets-0a"],"executable":"/w/target/release/deps/diorama_nets-0a","fresh":true}"#;

    #[test]
    fn test_programs_are_found_in_what_cargo_says() {
        let of = |line: &str| program(line).map(|p| (p.path.display().to_string(), p.folder.display().to_string(), p.is_library));
        assert_eq!(of(LIBRARY), Some(("/w/target/release/deps/diorama_nets-0a".into(), "/w/crates/nets".into(), true)));
        assert_eq!(of(&LIBRARY.replace("[\"lib\"]", "[\"test\"]")).map(|p| p.2), Some(false));
        assert_eq!(of(&LIBRARY.replace("\"executable\":\"/w/target/release/deps/diorama_nets-0a\"", "\"executable\":null")), None);
        // The program itself, which tests start.
        assert_eq!(of(&LIBRARY.replace("\"overflow_checks\":false,\"test\":true", "\"overflow_checks\":false,\"test\":false")), None);
        assert_eq!(of("{\"reason\":\"build-finished\",\"success\":true}"), None);
        let all = [program(LIBRARY).unwrap()];
        assert_eq!(at_level(&all, "portable", &["nets"]).map(|p| p[0].level), Some(Some("portable")));
        assert_eq!(at_level(&all, "portable", &["nets", "engine"]), None);
    }

    #[test]
    fn results_are_counted_and_a_crash_is_a_failure() {
        let text =
            "test a ... ok\nskipped: no data\ntest result: ok. 3 passed; 0 failed; 0 ignored;\ntest result: FAILED. 1 passed; 2 failed;\n";
        assert_eq!(counted(text, false), Counts { passed: 3, failed: 2, skipped: 1 });
        assert_eq!(counted("running 3 tests\n", false), Counts { passed: 0, failed: 1, skipped: 0 });
        let (text, ok) = output(Command::new("cargo").arg("no-such-verb"));
        assert!(!ok && text.contains("no-such-verb"), "{text}");
    }
}
