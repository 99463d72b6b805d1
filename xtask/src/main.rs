//! Development tasks: `cargo xtask ci`, `examples`, `gpu-check`, `viewer-check` and `tidy`.

#[cfg(test)]
mod ci_script;
mod examples;
#[cfg(test)]
mod named_tests;
mod tidy;

use std::process::{Command, ExitCode, Stdio};

fn main() -> ExitCode {
    let verb = std::env::args().nth(1).unwrap_or_default();
    let ok = match &verb[..] {
        "ci" => ci(),
        "examples" => step("examples", examples::run()),
        "gpu-check" => gpu_check(&std::env::args().nth(2).unwrap_or("vulkan".into())),
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

/// Runs the library tests of these crates with a lower instruction set than this machine's best, as they were built with the whole workspace.
fn libraries_at(level: &str) -> bool {
    let args = ["test", "--release", "--workspace", "--lib", "--no-run"];
    println!("\n$ cargo {}, then {} with DIORAMA_SIMD={level}", args.join(" "), SIMD_CRATES.join(", "));
    let Ok(out) = Command::new("cargo").args(args).output() else { return false };
    let said = String::from_utf8_lossy(&out.stderr).into_owned();
    let run = |name: &&str| {
        let Some(Ok(program)) = tests_of(&said, name).map(std::path::absolute) else {
            println!("{said}\ncargo named no tests of {name}");
            return false;
        };
        let mut tests = Command::new(program);
        tests.arg("--quiet").env("DIORAMA_SIMD", level).current_dir(format!("crates/{name}"));
        tests.status().is_ok_and(|s| s.success())
    };
    out.status.success() && SIMD_CRATES.iter().all(run)
}

/// The test program of a crate's library in what cargo said of a build.
fn tests_of<'a>(said: &'a str, name: &str) -> Option<&'a str> {
    said.split(['(', ')']).find(|part| part.contains(&format!("/diorama_{name}-")))
}

/// Runs every parser with mutated inputs. Built with the whole workspace, so that the test build is reused.
fn fuzz(runs: &str) -> bool {
    let built = cargo(&["build", "--release", "--quiet", "--workspace", "--bin", "diorama-fuzz"]);
    built && Command::new("target/release/diorama-fuzz").arg(runs).status().is_ok_and(|s| s.success())
}

/// Builds the program with the whole workspace, as its tests do: one package alone selects other features of dependencies and rebuilds them.
const PROGRAM: [&str; 5] = ["build", "--release", "--workspace", "--bin", "diorama"];

/// Builds once for devices, separated by commas, and compares every op on each with its reference. Builds other than the default one
/// contain burn's GPU backend; there, ops in burn's graph are compared too.
fn gpu_check(devices: &str) -> bool {
    // The default build includes Vulkan (Metal on macOS), so these devices need no other build.
    let features: Vec<&str> = devices.split(',').map(|d| if ["vulkan", "metal"].contains(&d) { "native" } else { d }).collect();
    let features = features.join(",");
    let with_graph = features != "native";
    let other = ["build", "--release", "--package", "diorama", "--bin", "diorama", "--package", "diorama-nets", "--example", "graph-check"];
    let built = match with_graph {
        true => cargo(&[&other[..], &["--no-default-features", "--features", &features]].concat()),
        false => cargo(&PROGRAM),
    };
    if !step("build", built) {
        return false;
    }
    // Training is compared on a real capture if there is one, by the default build alone: finding distances takes longer there than on the still life.
    let fox = std::env::var("DIORAMA_TEST_DATA").map(|d| format!("{d}/fox")).unwrap_or_default();
    let mut ok = true;
    for device in devices.split(',') {
        let mut args = vec!["bench", "check", "--device", device];
        if !with_graph && std::path::Path::new(&fox).is_dir() {
            args.extend(["--data", &fox]);
        }
        ok &= step(device, on_device(device, "target/release/diorama", &args));
        if with_graph {
            ok &= step(&format!("{device}, burn's graph"), on_device(device, "target/release/examples/graph-check", &[device]));
        }
    }
    ok
}

/// Runs a check, with CUDA emulated on the CPU if there is no such device.
fn on_device(device: &str, program: &str, args: &[&str]) -> bool {
    println!("\n$ {program} {}", args.join(" "));
    let mut check = Command::new(program);
    check.args(args);
    let ready = device != "cuda" || has_nvidia() || emulate_cuda(&mut check);
    ready && check.status().is_ok_and(|s| s.success())
}

fn has_nvidia() -> bool {
    Command::new("nvidia-smi").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success())
}

/// Sets a command up to use the CPU emulation of CUDA's driver and compiler; returns whether they could be built.
fn emulate_cuda(command: &mut Command) -> bool {
    let (source, to) = (std::path::absolute("stubs/cuda-on-cpu"), std::path::absolute("target/cuda-on-cpu"));
    let (Ok(source), Ok(to)) = (source, to) else { return false };
    println!("no NVIDIA driver found: CUDA is emulated on the CPU");
    // Kernels cached by an earlier build of the emulation must not be used.
    let _ = std::fs::remove_dir_all(&to);
    let library = to.join("libcuda.so");
    command.env("CUDA_PATH", &source).env("LD_LIBRARY_PATH", &to);
    command.env("CUDA_ON_CPU_CACHE", to.join("kernels")).env("XDG_CACHE_HOME", to.join("cache"));
    let mut compile = Command::new("g++");
    compile.args(["-O2", "-U_FORTIFY_SOURCE", "-shared", "-fPIC", "-pthread"]).arg(source.join("driver.cpp"));
    compile.arg("-o").arg(&library).arg("-ldl");
    std::fs::create_dir_all(&to).is_ok()
        && compile.status().is_ok_and(|s| s.success())
        && std::fs::copy(&library, to.join("libnvrtc.so")).is_ok()
}

/// Everything that must pass before a change lands.
fn ci() -> bool {
    let mut ok = step("tidy", tidy::run());
    ok &= step("format", cargo(&["fmt", "--all", "--check"]));
    ok &= step("clippy", cargo(&["clippy", "--release", "--workspace", "--all-targets", "--", "-D", "warnings"]));
    let (passed, failed, skipped) = tests();
    ok &= step("tests", failed == 0 && passed > 0);
    // The tests have run at the machine's best level.
    ok &= step("portable", libraries_at("portable"));
    if has_avx512() {
        ok &= step("avx2", libraries_at("avx2"));
    } else {
        println!("skipped avx2: no level of this machine is above it");
    }
    ok &= step("examples", examples::run());
    ok &= step("fuzz", fuzz("5000"));
    ok &= step("docs", cargo(&["doc", "--release", "--workspace", "--no-deps"]));
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

/// Runs the tests and counts the results; a test that prints a line `skipped: …` counts as skipped.
fn tests() -> (usize, usize, usize) {
    let args = ["test", "--release", "--workspace", "--no-fail-fast", "--", "--show-output"];
    println!("\n$ cargo {}", args.join(" "));
    let Ok(out) = Command::new("cargo").args(args).stderr(Stdio::inherit()).output() else { return (0, 1, 0) };
    let text = String::from_utf8_lossy(&out.stdout);
    let (mut passed, mut failed, mut skipped) = (0, 0, 0);
    for line in text.lines() {
        let shown = line.starts_with("test ") || line.starts_with("skipped:") || line.contains("panicked") || line.starts_with("running");
        if shown || !out.status.success() {
            println!("{line}");
        }
        skipped += line.starts_with("skipped:") as usize;
        if let Some(rest) = line.strip_prefix("test result:") {
            let count = |word: &str| {
                let at = rest.split(';').find(|p| p.contains(word))?;
                at.split_whitespace().filter_map(|w| w.parse::<usize>().ok()).next_back()
            };
            passed += count("passed").unwrap_or(0);
            failed += count("failed").unwrap_or(0);
        }
    }
    if !out.status.success() && failed == 0 {
        failed = 1;
    }
    (passed.saturating_sub(skipped), failed, skipped)
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
    let made = cargo(&PROGRAM)
        && cargo(&["build", "--release", "--workspace", "--example", "own_picture"])
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn test_programs_are_found_in_what_cargo_says() {
        let said = "    Finished `release` profile [optimized] target(s) in 1s\n  Executable unittests src/lib.rs (target/release/deps/diorama_nets-0a)\n  \
            Executable unittests src/lib.rs (target/release/deps/diorama_kernels-1b)\n";
        assert_eq!(tests_of(said, "kernels"), Some("target/release/deps/diorama_kernels-1b"));
        assert_eq!(tests_of(said, "engine"), None);
    }
}
