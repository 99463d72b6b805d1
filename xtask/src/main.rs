//! Development tasks: `cargo xtask ci`, `examples`, `gpu-check`, `viewer-check` and `tidy`.

#[cfg(test)]
mod ci_script;
mod devices;
mod examples;
#[cfg(test)]
mod named_tests;
mod test_programs;
mod tidy;

use std::process::{Command, ExitCode, Stdio};

fn main() -> ExitCode {
    let verb = std::env::args().nth(1).unwrap_or_default();
    let ok = match &verb[..] {
        "ci" => ci(),
        "examples" => step("examples", examples::run()),
        "gpu-check" => devices::check(&std::env::args().nth(2).unwrap_or("vulkan".into())),
        "viewer-check" => viewer_check(),
        "tidy" => step("tidy", tidy::run()),
        _ => {
            eprintln!("usage: cargo xtask ci | examples | gpu-check [vulkan|metal|webgpu|cuda|webgpu,cuda] | viewer-check | tidy");
            false
        }
    };
    if ok { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn step(name: &str, ok: bool) -> bool {
    println!("{} {name}", if ok { "ok    " } else { "FAILED" });
    ok
}

fn cargo(args: &[&str]) -> bool {
    println!("\n$ cargo {}", args.join(" "));
    Command::new("cargo").args(args).env("RUSTDOCFLAGS", "-D warnings").status().is_ok_and(|s| s.success())
}

fn installed(tool: &str) -> bool {
    Command::new("cargo").args([tool, "--version"]).stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success())
}

/// Crates whose results depend on the instruction set.
const SIMD_CRATES: [&str; 3] = ["kernels", "engine", "nets"];

#[cfg(target_arch = "x86_64")]
fn has_avx512() -> bool {
    std::arch::is_x86_feature_detected!("avx512f")
}

#[cfg(not(target_arch = "x86_64"))]
fn has_avx512() -> bool {
    false
}

/// Runs every parser with mutated inputs.
fn fuzz(runs: &str) -> bool {
    cargo(&PROGRAMS) && Command::new("target/release/diorama-fuzz").arg(runs).status().is_ok_and(|s| s.success())
}

/// Builds all programs and examples out of what the tests were built from: one package alone, or programs without examples, which need what
/// tests need, select other features of dependencies and rebuild them.
const PROGRAMS: [&str; 5] = ["build", "--release", "--workspace", "--bins", "--examples"];

/// Everything that must pass before a change lands.
fn ci() -> bool {
    let mut ok = step("tidy", tidy::run());
    ok &= step("format", cargo(&["fmt", "--all", "--check"]));
    let is_linted = std::env::var_os("RUSTC_WORKSPACE_WRAPPER").is_some_and(|w| std::path::Path::new(&w).ends_with("lint-rustc"));
    if is_linted {
        println!("every build lints what it compiles and checks its documentation");
    } else {
        ok &= step("clippy", cargo(&["clippy", "--release", "--workspace", "--all-targets", "--", "-D", "warnings"]));
    }
    let mut programs = test_programs::build().unwrap_or_default();
    ok &= step("build", !programs.is_empty());
    // The tests run at the machine's best level, those of these crates at each lower one as well.
    let levels: &[&str] = if has_avx512() { &["portable", "avx2"] } else { &["portable"] };
    for level in levels {
        let lower = test_programs::at_level(&programs, level, &SIMD_CRATES);
        ok &= step(level, lower.is_some());
        programs.extend(lower.unwrap_or_default());
    }
    let test_programs::Counts { passed, failed, skipped } = test_programs::run(&programs);
    ok &= step("tests", failed == 0 && passed > 0);
    ok &= step("examples", examples::run());
    ok &= step("fuzz", fuzz("5000"));
    if !is_linted {
        ok &= step("docs", cargo(&["doc", "--release", "--workspace", "--no-deps"]));
    }
    for (tool, args) in [("deny", &["deny", "check", "licenses", "bans", "sources"][..]), ("typos", &["typos"][..])] {
        if installed(tool) {
            ok &= step(tool, cargo(args));
        } else {
            println!("skipped {tool}: not installed");
        }
    }
    println!("\n{passed} tests ran, {skipped} skipped because data or tools are missing; GPU cases are run by `cargo xtask gpu-check`");
    println!("{passed} passed, {failed} failed, {skipped} skipped");
    ok
}

/// The viewer's page: type checks, a bundle that matches its sources, and all page checks in headless Chromium.
fn viewer_check() -> bool {
    let web = std::path::Path::new("crates/viewer/web");
    let npm = |args: &[&str]| {
        println!("\n$ npm {}", args.join(" "));
        Command::new("npm").args(args).current_dir(web).status().is_ok_and(|s| s.success())
    };
    let read = || ["app.js", "app.css", "index.html"].map(|f| std::fs::read(web.join("dist").join(f)).unwrap_or_default());
    // esbuild's program is part of its package; install scripts of packages are not run.
    let mut ok = step("packages", npm(&["ci", "--ignore-scripts", "--no-audit", "--no-fund"]));
    ok &= step("types", npm(&["run", "check"]));
    let before = read();
    ok &= step("bundle", npm(&["run", "build"]) && read() == before);
    let run = std::env::temp_dir().join(format!("diorama-viewer-check-{}", std::process::id()));
    let diorama = "target/release/diorama";
    // The page is also tested with a source whose layers and controls no run has.
    let made = cargo(&PROGRAMS)
        && Command::new(diorama)
            .args(["quickstart", "--seconds", "6", "--out"])
            .arg(&run)
            .stdout(Stdio::null())
            .status()
            .is_ok_and(|s| s.success());
    let absolute = std::path::absolute(diorama).unwrap_or_default();
    let seen = Command::new("node").arg("test/viewer.mjs").arg(absolute).arg(&run).current_dir(web).status().is_ok_and(|s| s.success());
    let _ = std::fs::remove_dir_all(&run);
    ok & step("viewer", made && seen)
}
