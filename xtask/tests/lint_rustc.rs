//! `lint-rustc` compiles as the compiler does, and refuses what clippy or rustdoc warn of.

use std::path::Path;
use std::process::{Command, Output};

/// Compiles a library of this text in a folder.
fn compile(folder: &Path, text: &str) -> Output {
    std::fs::write(folder.join("sample.rs"), text).unwrap();
    // The compiler itself: clippy and rustdoc are beside it, while rustup's stand-in may be elsewhere.
    let sysroot = Command::new("rustc").args(["--print", "sysroot"]).output().unwrap();
    let rustc = Path::new(String::from_utf8(sysroot.stdout).unwrap().trim()).join("bin/rustc");
    let mut wrapper = Command::new(env!("CARGO_BIN_EXE_lint-rustc"));
    wrapper.arg(rustc).args(["--crate-name", "sample", "--edition=2024", "sample.rs", "--crate-type", "lib"]);
    wrapper.args(["--error-format=json", "--json=diagnostic-rendered-ansi,artifacts", "--emit=metadata,link", "--out-dir"]).arg(folder);
    wrapper.current_dir(folder).output().unwrap()
}

#[test]
fn what_clippy_or_rustdoc_warn_of_is_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let said = |text: &str| {
        let out = compile(dir.path(), text);
        (out.status.success(), String::from_utf8(out.stderr).unwrap())
    };
    let (ok, clean) = said("//! A [`two`].\n/// Two.\npub fn two() -> u8 {\n    2\n}\n");
    assert!(ok && dir.path().join("libsample.rlib").exists(), "{clean}");
    assert_eq!(clean.matches("\"emit\":\"metadata\"").count(), 1, "only the compiler's results are told: {clean}");
    let (ok, lint) = said("/// Two.\npub fn two() -> u8 {\n    return 2;\n}\n");
    assert!(!ok && lint.contains("needless_return"), "{lint}");
    let (ok, link) = said("/// Two, or [`three`].\npub fn two() -> u8 {\n    2\n}\n");
    assert!(!ok && link.contains("unresolved link"), "{link}");
    let (ok, unused) = said("fn two() -> u8 {\n    2\n}\n");
    assert!(!ok && unused.contains("never used"), "{unused}");
    let (ok, wrong) = said("pub fn two() -> u8 {\n    \"\"\n}\n");
    assert!(!ok && wrong.contains("mismatched types"), "{wrong}");
}
