//! The workspace's examples: all are built, and those in a list are run, each in its own folder.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Examples that are run with a folder as argument, and the files that each must write there. Further arguments follow the name.
const RUN: [(&str, &[&str]); 10] = [
    ("characters --short", &["latest.safetensors", "samples.png", "mistakes.png"]),
    ("cube", &["cube.glb", "cube.obj", "cube.ply", "cube.stl", "cube.usdz", "cube.dae"]),
    ("custom_loss", &["squares.png", "cauchy.png"]),
    ("custom_ray_code", &["sun_0.png", "sun_1.png", "sun_2.png"]),
    ("mesh_formula", &["gyroid.glb"]),
    ("points_and_depth", &["points.ply", "depth.png"]),
    ("read_capture", &["sparse/0/images.txt"]),
    ("read_checkpoint", &["checkpoints/latest.safetensors"]),
    ("render_path", &["orbit.gif"]),
    ("train_from_code", &["view.png", "run/summary.json"]),
];

/// Examples that are only built, with the reason.
const BUILT: [(&str, &str); 6] = [
    ("density-gradient-speed", "measures for minutes"),
    ("graph-check", "needs a device; `cargo xtask gpu-check` runs it"),
    ("ops-check", "needs a device; `cargo xtask gpu-check` runs it"),
    ("ops-speed", "measures for minutes"),
    ("own_picture", "serves until it is stopped; `cargo xtask viewer-check` opens its page"),
    ("photographs", "renders a large capture"),
];

/// Longest example that is run, in lines, and the time limit of a run.
const LINES: usize = 150;
const TIME_LIMIT: Duration = Duration::from_secs(180);

/// Builds all examples and runs those in the list; returns whether all succeeded.
pub fn run() -> bool {
    let mut breaches = check(&sources(Path::new("crates")));
    let built = crate::cargo(&crate::PROGRAMS);
    if !built {
        breaches.push("the examples do not build".into());
    }
    let folder = std::env::temp_dir().join(format!("diorama-examples-{}", std::process::id()));
    let begin = Instant::now();
    for (name, files) in RUN.iter().filter(|_| built) {
        let start = Instant::now();
        let result = run_one(name, &folder.join(program(name)), files);
        println!("{name}: {:.1} s", start.elapsed().as_secs_f64());
        breaches.extend(result.err().map(|why| format!("{name}: {why}")));
    }
    println!("{} examples ran in {:.0} s, {} were only built", RUN.len(), begin.elapsed().as_secs_f64(), BUILT.len());
    let _ = std::fs::remove_dir_all(&folder);
    breaches.iter().for_each(|b| println!("{b}"));
    breaches.is_empty()
}

/// The name of an example, without its arguments.
fn program(name: &str) -> &str {
    name.split(' ').next().unwrap_or_default()
}

/// Runs an example and checks the files that it writes.
fn run_one(name: &str, folder: &Path, files: &[&str]) -> Result<(), String> {
    std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    let mut command = Command::new(Path::new("target/release/examples").join(program(name)));
    let mut child =
        command.arg(folder).args(name.split(' ').skip(1)).stdout(Stdio::null()).spawn().map_err(|e| format!("cannot be started: {e}"))?;
    let start = Instant::now();
    let status = loop {
        match child.try_wait() {
            Ok(Some(status)) => break status,
            Ok(None) if start.elapsed() < TIME_LIMIT => std::thread::sleep(Duration::from_millis(20)),
            Ok(None) => {
                let _ = child.kill();
                let _ = child.wait();
                return Err(format!("takes more than {} s", TIME_LIMIT.as_secs()));
            }
            Err(e) => return Err(e.to_string()),
        }
    };
    if !status.success() {
        return Err(format!("ended with {status}"));
    }
    let lacks = files.iter().find(|f| !std::fs::metadata(folder.join(f)).is_ok_and(|m| m.len() > 0));
    lacks.map_or(Ok(()), |f| Err(format!("did not write {f}")))
}

/// Name and text of every example below `crates`, and of the other files of those that are folders.
fn sources(crates: &Path) -> Vec<(String, String)> {
    let entries = |folder: &Path| -> Vec<PathBuf> { std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect() };
    let examples: Vec<PathBuf> = entries(crates).into_iter().flat_map(|krate| entries(&krate.join("examples"))).collect();
    let files = examples.iter().flat_map(|e| if e.is_dir() { entries(e) } else { vec![e.clone()] });
    let stem = |f: &Path| f.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let name = |f: &Path| match f.parent().filter(|folder| !folder.ends_with("examples")) {
        Some(folder) if f.ends_with("main.rs") => stem(folder),
        Some(folder) => format!("{}/{}", stem(folder), stem(f)),
        None => stem(f),
    };
    let mut found: Vec<(String, String)> = files
        .filter(|f| f.extension().is_some_and(|e| e == "rs"))
        .map(|f| (name(&f), std::fs::read_to_string(&f).unwrap_or_default()))
        .collect();
    found.sort();
    found
}

/// Examples in no list, listed names without an example, and examples that are too long or lack a first line of description.
fn check(sources: &[(String, String)]) -> Vec<String> {
    let run = || RUN.iter().map(|r| program(r.0));
    let listed = || run().chain(BUILT.iter().map(|b| b.0));
    let mut breaches = Vec::new();
    for (name, text) in sources {
        let example = name.split('/').next().unwrap_or_default();
        if !listed().any(|l| l == example) {
            breaches.push(format!("{name}: add it to a list of xtask/src/examples.rs"));
        }
        let is_run = run().any(|r| r == example);
        if is_run && text.lines().count() > LINES {
            breaches.push(format!("{name}: {} lines, more than {LINES}", text.lines().count()));
        }
        if !text.starts_with("//! ") {
            breaches.push(format!("{name}: its first line must say what it shows"));
        }
    }
    let gone = listed().filter(|l| !sources.iter().any(|s| s.0 == *l));
    breaches.extend(gone.map(|l| format!("{l}: is listed in xtask/src/examples.rs but does not exist")));
    breaches
}

#[cfg(test)]
mod tests {
    use super::*;

    fn workspace() -> Vec<(String, String)> {
        sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../crates"))
    }

    #[test]
    fn every_example_is_listed_short_and_says_what_it_shows() {
        assert_eq!(check(&workspace()), Vec::<String>::new());
    }

    #[test]
    fn breaches_are_found() {
        let mut s = workspace();
        s.retain(|(name, _)| name != "cube");
        s.push(("stranger".into(), "//! Shows nothing.\n".into()));
        s.push(("characters/more".into(), "//! More.\n".repeat(LINES + 2)));
        let mesh = s.iter_mut().find(|(name, _)| name == "mesh_formula").unwrap();
        mesh.1 = "fn main() {}\n".repeat(LINES + 1);
        let b = check(&s).join("\n");
        for what in
            ["stranger: add it", "mesh_formula: 151 lines", "mesh_formula: its first line", "cube: is listed", "characters/more: 152 lines"]
        {
            assert!(b.contains(what), "{what}: {b}");
        }
    }

    #[test]
    fn an_example_that_fails_is_noticed() {
        let folder = std::env::temp_dir().join(format!("diorama-no-example-{}", std::process::id()));
        let why = run_one("no_such_example", &folder, &[]).unwrap_err();
        assert!(why.contains("cannot be started"), "{why}");
        let _ = std::fs::remove_dir_all(folder);
    }
}
