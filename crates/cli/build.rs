//! Lets the linker that comes with Rust merge functions with identical machine code, which saves a twentieth of the program's size.

use std::path::PathBuf;
use std::process::Command;

/// Target on which that linker is the default.
const TARGET: &str = "x86_64-unknown-linux-gnu";

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_LINKER");
    let Some(folder) = linkers_folder() else { return };
    // Rust guarantees no distinct addresses of functions, and none of the C libraries here compares them.
    for argument in [&format!("-B{}", folder.display())[..], "-fuse-ld=lld", "-Wl,--icf=all"] {
        println!("cargo:rustc-link-arg-bins={argument}");
    }
}

/// Folder of the linker that comes with Rust; `None` for other targets, for debug builds, or if another linker was chosen.
fn linkers_folder() -> Option<PathBuf> {
    let is = |name: &str, value: &str| std::env::var(name).is_ok_and(|v| v == value);
    let names_linker = std::env::var("CARGO_ENCODED_RUSTFLAGS").is_ok_and(|flags| flags.contains("link"));
    if !is("TARGET", TARGET)
        || !is("HOST", TARGET)
        || !is("PROFILE", "release")
        || names_linker
        || std::env::var_os("RUSTC_LINKER").is_some()
    {
        return None;
    }
    let o = Command::new(std::env::var_os("RUSTC")?).args(["--print", "sysroot"]).output().ok()?;
    let programs = PathBuf::from(String::from_utf8(o.stdout).ok()?.trim()).join("lib/rustlib").join(TARGET).join("bin");
    let folder = programs.join("gcc-ld");
    (folder.join("ld.lld").exists() && programs.join("rust-lld").exists()).then_some(folder)
}
