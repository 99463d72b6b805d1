//! Runs the real program on a small capture with a short run. Each test file uses a part of this module.

#![allow(dead_code, reason = "each test program uses a part")]

use diorama_pipelines::object::quickstart::write_capture;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

pub const SMALL: [&str; 8] =
    ["--device", "cpu", "--set", "field.log2_size=12", "--set", "sampling.batch_samples=4096", "--set", "sampling.occupancy_points=2048"];

pub struct Good {
    _folder: tempfile::TempDir,
    pub capture: PathBuf,
    pub run: PathBuf,
}

/// A capture and a short run on it, made once.
pub fn good() -> &'static Good {
    static GOOD: OnceLock<Good> = OnceLock::new();
    GOOD.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let (capture, run) = (folder.path().join("capture"), folder.path().join("run"));
        write_capture(&capture, 16, 48).unwrap();
        works(folder.path(), &[&["train", s(&capture), "-o", s(&run), "--steps", "60"], &SMALL[..]].concat());
        Good { _folder: folder, capture, run }
    })
}

pub fn s(p: &Path) -> &str {
    p.to_str().unwrap()
}

/// Time limit of a call: `view` would serve forever.
pub const LIMIT: Duration = Duration::from_secs(300);

pub fn call(folder: &Path, arguments: &[&str]) -> Output {
    call_in(folder, &[], arguments)
}

/// A call with environment variables.
pub fn call_in(folder: &Path, variables: &[(&str, &str)], arguments: &[&str]) -> Output {
    let said = tempfile::tempdir().unwrap();
    let file = |name: &str| std::fs::File::create(said.path().join(name)).unwrap();
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.args(arguments).envs(variables.iter().copied());
    let mut child = c.current_dir(folder).stdout(file("out")).stderr(file("err")).spawn().unwrap();
    let begin = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if begin.elapsed() > LIMIT {
            child.kill().unwrap();
            child.wait().unwrap();
            panic!("{arguments:?} goes on after {LIMIT:?}");
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    let read = |name: &str| std::fs::read(said.path().join(name)).unwrap();
    Output { status, stdout: read("out"), stderr: read("err") }
}

/// The output of a call from `folder` that succeeds.
#[track_caller]
pub fn works(folder: &Path, arguments: &[&str]) -> String {
    let o = call(folder, arguments);
    assert!(o.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&o.stderr));
    String::from_utf8(o.stdout).unwrap()
}

/// Expects that a call fails with one line that contains all of `parts`; returns its output.
#[track_caller]
pub fn fails(folder: &Path, arguments: &[&str], code: i32, parts: &[&str]) -> String {
    let o = call(folder, arguments);
    let said = String::from_utf8_lossy(&o.stderr).into_owned();
    assert_eq!(o.status.code(), Some(code), "{arguments:?}: {said}");
    let errors: Vec<&str> = said.lines().filter(|l| l.starts_with("diorama: ")).collect();
    assert_eq!(errors.len(), 1, "{said}");
    parts.iter().for_each(|p| assert!(errors[0].contains(p), "{p:?} is not in {said}"));
    said
}

pub fn copy_all(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for e in from.read_dir().unwrap().flatten() {
        let target = to.join(e.file_name());
        if e.path().is_dir() {
            copy_all(&e.path(), &target);
        } else {
            std::fs::copy(e.path(), target).unwrap();
        }
    }
}

/// A copy of a folder for a test to damage.
pub fn copy_of(from: &Path) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let to = dir.path().join("copy");
    copy_all(from, &to);
    (dir, to)
}

/// A copy of the valid run for a test to damage.
pub fn copy() -> (tempfile::TempDir, PathBuf) {
    copy_of(&good().run)
}

/// A file system of one mebibyte; `None` if this user may not mount one.
pub struct Small(pub PathBuf);

impl Small {
    pub fn mount(at: &Path) -> Option<Small> {
        std::fs::create_dir_all(at).unwrap();
        let ok = Command::new("mount").args(["-t", "tmpfs", "-o", "size=1m", "tmpfs"]).arg(at).stderr(Stdio::null()).status();
        ok.is_ok_and(|s| s.success()).then(|| Small(at.to_path_buf()))
    }
}

impl Drop for Small {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(&self.0).status();
    }
}
