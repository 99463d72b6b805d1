//! `RUSTC_WORKSPACE_WRAPPER` of `.ci/run`: compiles a crate, then lints it with clippy and checks its documentation with rustdoc, warnings being
//! errors. So dependencies are read once: `cargo clippy` and `cargo doc` would check each of them anew.

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

fn main() -> ExitCode {
    let mut args = std::env::args().skip(1);
    let Some(rustc) = args.next() else {
        eprintln!("usage: lint-rustc RUSTC ARGUMENTS…");
        return ExitCode::from(2);
    };
    let args: Vec<String> = args.collect();
    let run = |command: &mut Command| match command.status() {
        Ok(status) => status.success(),
        Err(e) => {
            eprintln!("{}: {e}", command.get_program().to_string_lossy());
            false
        }
    };
    let mut ok = run(Command::new(&rustc).args(&args));
    if ok && compiles_a_file(&args) {
        let folder = std::env::temp_dir().join(format!("lint-rustc-{}", std::process::id()));
        let lint = checking(&args, &folder);
        ok = run(Command::new(beside(&rustc, "clippy-driver")).arg(&rustc).args(&lint).args(["--emit=metadata", "-Dwarnings"]));
        if is_documented(&args) {
            ok &= run(Command::new(beside(&rustc, "rustdoc")).args(&lint).arg("-Dwarnings"));
        }
        // What cannot be removed from a scratch folder stays there.
        let _ = std::fs::remove_dir_all(&folder);
    }
    if ok { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// A program of the same toolchain.
fn beside(rustc: &str, name: &str) -> PathBuf {
    Path::new(rustc).with_file_name(name)
}

/// Whether these are a crate's arguments, and no question to the compiler.
fn compiles_a_file(args: &[String]) -> bool {
    args.iter().any(|a| a.starts_with("--emit")) && args.iter().any(|a| a.ends_with(".rs"))
}

/// Whether `cargo doc` documents such a crate: libraries and programs, neither their tests nor build scripts.
fn is_documented(args: &[String]) -> bool {
    let after = |flag: &str| args.iter().position(|a| a == flag).and_then(|i| args.get(i + 1)).map(String::as_str);
    let is_example = args.iter().any(|a| a.ends_with(".rs") && a.contains("examples/"));
    let kind = matches!(after("--crate-type"), Some("lib" | "bin"));
    kind && !is_example && !args.iter().any(|a| a == "--test") && after("--crate-name") != Some("build_script_build")
}

/// The compiler's arguments for a look at the same source that leaves its results, in a `folder`, to nobody.
fn checking(args: &[String], folder: &Path) -> Vec<String> {
    let mut out: Vec<String> = Vec::new();
    let mut is_out_dir = false;
    for arg in args {
        if is_out_dir {
            out.push(folder.display().to_string());
        } else if arg.starts_with("--json=") {
            // Cargo would take these for the crate's.
            out.push(arg.replace(",artifacts", "").replace("artifacts,", ""));
        } else if !arg.starts_with("--emit") {
            out.push(arg.clone());
        }
        is_out_dir = arg == "--out-dir";
    }
    out
}
