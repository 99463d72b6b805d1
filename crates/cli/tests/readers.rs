//! Exported meshes and point clouds are opened by independent readers: Khronos's glTF validator, trimesh, usd-core, pycollada, laspy,
//! pye57 (`benches/readers.sh` installs them, `DIORAMA_READERS` names their folder).

use diorama_pipelines::object::quickstart::write_capture;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The folder of readers. Without it, prints that the test was skipped, or fails if `DIORAMA_REQUIRE_READERS` is set.
fn readers() -> Option<PathBuf> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/readers");
    let folder = std::env::var_os("DIORAMA_READERS").map_or(default, PathBuf::from);
    let missing = ["venv/bin/python", "node_modules/gltf-validator"].into_iter().find(|p| !folder.join(p).exists());
    if let Some(missing) = missing {
        let what = format!("{} is not there; run benches/readers.sh", folder.join(missing).display());
        assert!(std::env::var_os("DIORAMA_REQUIRE_READERS").is_none(), "{what}");
        println!("skipped: {what}");
        return None;
    }
    Some(folder)
}

#[track_caller]
fn works(c: &mut Command) -> String {
    let o = c.output().unwrap();
    let text = format!("{}{}", String::from_utf8_lossy(&o.stdout), String::from_utf8_lossy(&o.stderr));
    assert!(o.status.success(), "{c:?}: {text}");
    text
}

fn diorama(arguments: &[&str]) {
    works(Command::new(env!("CARGO_BIN_EXE_diorama")).args(arguments));
}

/// Prints the validator's counts as JSON; fails on errors or warnings.
const VALIDATE: &str = "
const report = (r) => { console.log(JSON.stringify(r.issues)); process.exit(r.issues.numErrors + r.issues.numWarnings ? 1 : 0) };
const bytes = new Uint8Array(require('fs').readFileSync(process.argv[1]));
require('gltf-validator').validateBytes(bytes).then(report, (e) => { console.error(e); process.exit(1) });
";

#[test]
fn every_export_is_read_by_foreign_readers() {
    let Some(readers) = readers() else { return };
    let dir = tempfile::tempdir().unwrap();
    let (capture, run) = (dir.path().join("capture"), dir.path().join("run"));
    write_capture(&capture, 24, 64).unwrap();
    let (capture, run) = (capture.to_str().unwrap(), run.to_str().unwrap());
    let small = ["--set", "field.log2_size=14", "--set", "field.finest=256"];
    diorama(&[&["train", capture, "-o", run, "--steps", "250", "--device", "cpu"], &small[..]].concat());
    let write = |file: &Path, more: &[&str]| {
        diorama(&[&["export", run, "-o", file.to_str().unwrap(), "--device", "cpu", "--force"], more].concat());
    };
    let export = |file: &Path, more: &[&str]| write(file, &[&["--resolution", "64", "--faces", "2000"], more].concat());
    let stem = dir.path().join("mesh");
    for format in ["glb", "obj", "usdz", "dae"] {
        export(&stem.with_extension(format), &["--texture", "128"]);
    }
    for format in ["ply", "stl"] {
        export(&stem.with_extension(format), &[]);
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../benches/formats.py");
    let (lit, plain) = (dir.path().join("lit.glb"), dir.path().join("plain.glb"));
    let lit_obj = lit.with_extension("obj");
    for file in [&lit, &lit_obj] {
        export(file, &["--texture", "128", "--normal-map"]);
    }
    export(&plain, &["--texture", "0"]);
    let formats = |arguments: &[&Path]| {
        let mut c = Command::new(readers.join("venv/bin/python"));
        c.arg(&script).args(arguments);
        c
    };
    println!("{}", works(&mut formats(&[&stem, &lit, &plain, &lit_obj])));
    let cloud = dir.path().join("cloud");
    for format in ["ply", "las", "e57"] {
        write(&cloud.with_extension(format), &["--format", "points", "--points", "3000"]);
    }
    println!("{}", works(&mut formats(&[Path::new("--points"), &cloud])));
    let validate = |file: &Path| {
        let mut c = Command::new("node");
        c.env("NODE_PATH", readers.join("node_modules")).arg("-e").arg(VALIDATE).arg(file);
        c
    };
    for file in [&stem.with_extension("glb"), &lit, &plain] {
        println!("{}: {}", file.display(), works(&mut validate(file)));
    }
    // Readers that accept anything would prove nothing: a face with an invalid vertex index, and a truncated file.
    let mut damaged = std::fs::read(&plain).unwrap();
    let last = damaged.len() - 1;
    damaged[last - 8..].fill(0xff);
    std::fs::write(&plain, &damaged).unwrap();
    assert!(!validate(&plain).output().unwrap().status.success());
    let obj = stem.with_extension("obj");
    let text = std::fs::read(&obj).unwrap();
    std::fs::write(&obj, &text[..text.len() / 3]).unwrap();
    assert!(!formats(&[&stem]).output().unwrap().status.success());
    for format in ["ply", "las", "e57"] {
        let file = cloud.with_extension(format);
        let whole = std::fs::read(&file).unwrap();
        std::fs::write(&file, &whole[..whole.len() / 3]).unwrap();
        assert!(!formats(&[Path::new("--points"), &cloud]).output().unwrap().status.success(), "a third of {format} is read");
        std::fs::write(&file, &whole).unwrap();
    }
}
