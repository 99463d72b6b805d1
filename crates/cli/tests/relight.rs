//! The relight commands: compositions and turntables are rendered, continued after an interruption to the same bits, and refused in one line.

use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.args(["relight"]).args(arguments).current_dir(folder);
    c
}

fn run(folder: &Path, arguments: &[&str]) -> Output {
    command(folder, arguments).output().unwrap()
}

const CUBE: &str = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nv -1 2 -1\nv 1 2 -1\nv 1 2 1\nv -1 2 1\n\
    f 1 2 3 4\nf 5 8 7 6\nf 1 5 6 2\nf 2 6 7 3\nf 3 7 8 4\nf 4 8 5 1\n";
const FLOOR: &str = "v -9 0 -9\nv -9 0 9\nv 9 0 9\nv 9 0 -9\nf 1 2 3 4\n";
const SCENE: &str = r#"
[scene]
mesh = "floor.obj"
[[object]]
mesh = "cube.obj"
translate = [0, 3, 0]
rotate_deg = [0, 30, 0]
scale = 0.5
snap = "ground"
[light]
sky = { elevation = 40, rotation = 60, intensity = 0.02 }
[camera]
eye = [0, 2, 6]
target = [0, 0.5, 0]
[render]
size = [96, 64]
spp = 32
"#;

fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for (name, text) in [("cube.obj", CUBE), ("floor.obj", FLOOR), ("scene.toml", SCENE)] {
        std::fs::write(dir.path().join(name), text).unwrap();
    }
    dir
}

#[track_caller]
fn refused(folder: &Path, arguments: &[&str], expected: &[&str]) {
    let before = std::fs::read_dir(folder).unwrap().count();
    let o = run(folder, arguments);
    let text = String::from_utf8_lossy(&o.stderr);
    let errors: Vec<&str> = text.lines().filter(|l| l.starts_with("diorama: ")).collect();
    assert!(o.status.code() == Some(2) && errors.len() == 1 && !text.contains("panicked"), "{arguments:?}: {text}");
    assert!(expected.iter().all(|e| errors[0].contains(e)), "{expected:?} are not all in {:?}", errors[0]);
    assert_eq!(std::fs::read_dir(folder).unwrap().count(), before, "{arguments:?} left something behind");
}

#[test]
fn an_object_stands_on_the_ground_and_casts_a_shadow() {
    let dir = folder();
    let o = run(dir.path(), &["compose", "scene.toml", "-o", "a.exr", "--json"]);
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    let told: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    assert_eq!((told["triangles"].as_u64(), &told["size"]), (Some(14), &serde_json::json!([96, 64])));
    // The same, sunk into the floor by hand, is refused; floating, it is another picture.
    let text = SCENE.replace("snap = \"ground\"", "").replace("[0, 3, 0]", "[0, -0.5, 0]");
    std::fs::write(dir.path().join("scene.toml"), text).unwrap();
    refused(dir.path(), &["compose", "scene.toml", "-o", "b.exr"], &["object 0", "overlap"]);
}

#[test]
fn what_passes_through_an_object_is_refused() {
    let dir = folder();
    // A thin post through the cube, beside the diagonals of its faces: no edge of the cube crosses it.
    let mut post = String::from(FLOOR);
    let first = FLOOR.lines().filter(|l| l.starts_with("v ")).count();
    for i in 0..8 {
        post += &format!("v {} {} {}\n", [0.23, 0.27][i & 1], [0.5, 3.0][i >> 1 & 1], [-0.14, -0.1][i >> 2]);
    }
    for face in [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]] {
        post += &format!("f {} {} {} {}\n", first + 1 + face[0], first + 1 + face[1], first + 1 + face[2], first + 1 + face[3]);
    }
    std::fs::write(dir.path().join("floor.obj"), post).unwrap();
    let text = SCENE.replace("snap = \"ground\"", "").replace("[0, 3, 0]", "[0, 1.2, 0]");
    std::fs::write(dir.path().join("scene.toml"), &text).unwrap();
    refused(dir.path(), &["compose", "scene.toml", "-o", "b.exr"], &["object 0", "edges of the scene", "overlap"]);
}

#[test]
fn an_object_inside_of_a_wall_is_refused() {
    let dir = folder();
    let first = FLOOR.lines().filter(|l| l.starts_with("v ")).count();
    let wall = |least: f64| {
        let scaled = |line: &str| {
            let numbers: Vec<f64> = line.split(' ').skip(1).map(|n| n.parse().unwrap()).collect();
            match &line[..1] {
                "v" => format!("v {} {} {}\n", 4.0 * numbers[0] + least, 3.0 * numbers[1], 4.0 * numbers[2]),
                _ => numbers.iter().fold("f".to_string(), |text, n| format!("{text} {}", n + first as f64)) + "\n",
            }
        };
        FLOOR.to_string() + &CUBE.lines().map(scaled).collect::<String>()
    };
    let text = SCENE.replace("snap = \"ground\"", "");
    std::fs::write(dir.path().join("scene.toml"), &text).unwrap();
    std::fs::write(dir.path().join("floor.obj"), wall(0.0)).unwrap();
    refused(dir.path(), &["compose", "scene.toml", "-o", "b.exr"], &["object 0", "inside of the closed surface", "overlap"]);
    // Beside it, nothing is wrong; nor where the user says so.
    std::fs::write(dir.path().join("floor.obj"), wall(8.0)).unwrap();
    assert!(run(dir.path(), &["compose", "scene.toml", "-o", "b.png"]).status.success());
    std::fs::write(dir.path().join("floor.obj"), wall(0.0)).unwrap();
    std::fs::write(dir.path().join("scene.toml"), text.replace("scale = 0.5", "scale = 0.5\noverlap = true")).unwrap();
    assert!(run(dir.path(), &["compose", "scene.toml", "-o", "c.png"]).status.success());
}

#[test]
fn what_does_not_fit_into_memory_is_refused_before_anything_is_written() {
    let dir = folder();
    let text = SCENE.replace("size = [96, 64]", "size = [4096, 4096]");
    assert_ne!(text, SCENE);
    std::fs::write(dir.path().join("scene.toml"), &text).unwrap();
    let o = command(dir.path(), &["compose", "scene.toml", "-o", "b.exr"]).env("DIORAMA_MEMORY", "1GiB").output().unwrap();
    let said = String::from_utf8_lossy(&o.stderr);
    assert!(o.status.code() == Some(1) && said.contains("out of memory: the picture") && said.contains("smaller size"), "{said}");
    assert!(!dir.path().join("b.exr").exists());
    for (call, left) in [
        (&["compose", "scene.toml", "-o", "b.exr", "--export-blender", "blend"][..], "blend"),
        (&["turntable", "cube.obj", "--size", "4096x4096", "--frames", "1", "-o", "turn"], "turn"),
    ] {
        let o = command(dir.path(), call).env("DIORAMA_MEMORY", "100MiB").output().unwrap();
        let said = String::from_utf8_lossy(&o.stderr);
        assert!(o.status.code() == Some(1) && said.contains("100 MiB are free") && !dir.path().join(left).exists(), "{said}");
    }
}

#[test]
fn bad_objects_are_refused_before_a_run_begins_and_lost_surfaces_begin_again() {
    let (dir, call) = (folder(), "synth --object cube.obj --views 16 --size 48x48 --spp 2 --light uniform --unseen-light uniform -o data");
    let at = dir.path();
    assert!(run(at, &call.split(' ').collect::<Vec<_>>()).status.success());
    std::fs::write(at.join("cut.hdr"), "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\nabc").unwrap();
    let object = |more: &[&'static str]| [&["object", "data", "--preset", "ci", "--run", "run", "-o", "o.glb"], more].concat();
    refused(at, &object(&["--set", "grid.scale=0.3"]), &[" pixels of the masks (", "grid.scale=1.", "auto"]);
    refused(at, &object(&["--fixed-light", "cut.hdr"]), &["cut.hdr", "copy it again"]);
    std::fs::write(at.join("bad.npz"), "no archive").unwrap();
    refused(at, &object(&["--set", "grid.file=bad.npz"]), &["bad.npz"]);
    let o = run(at, &object(&["--steps", "6", "--score-spp", "0", "--set", "optim.shape_rate=50"]));
    let text = String::from_utf8_lossy(&o.stderr);
    let again = text.lines().find(|l| l.contains("begins again")).unwrap_or_else(|| panic!("{text}"));
    assert!(again.starts_with("step ") && again.contains("half the rate"), "{again}");
    let image = diorama_data::photo::load(&at.join("data/images/003.png")).unwrap();
    let data = image.data.chunks_exact(image.channels).flat_map(|p| p[..3].to_vec()).collect();
    diorama_data::photo::save_png(&at.join("data/images/003.png"), &diorama_geom::ImageU8 { channels: 3, data, ..image }).unwrap();
    refused(at, &object(&["--force"]), &["003.png", "RGBA", "masks/"]);
}

#[test]
#[cfg(unix)]
fn an_interrupted_picture_goes_on_to_the_same_bits() {
    let dir = folder();
    let long = ["compose", "scene.toml", "--spp", "1024", "-o"];
    let whole = run(dir.path(), &[&long[..], &["whole.png"]].concat());
    assert!(whole.status.success());
    let parts = [&long[..], &["parts.png"]].concat();
    let mut interruptions = 0;
    while interruptions < 3 {
        let mut child = command(dir.path(), &parts).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(400));
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
        match child.wait().unwrap().code() {
            Some(130) => interruptions += 1,
            // Before the handler is there, the signal ends the program.
            code => assert!(code.is_none(), "{code:?}"),
        }
        assert!(!dir.path().join("parts.png").exists());
    }
    assert!(dir.path().join("parts.png.unfinished").exists());
    assert!(run(dir.path(), &parts).status.success());
    let read = |name: &str| std::fs::read(dir.path().join(name)).unwrap();
    assert_eq!(read("whole.png"), read("parts.png"));
    assert!(!dir.path().join("parts.png.unfinished").exists());
}

#[test]
fn a_turntable_writes_its_frames_and_keeps_those_that_are_there() {
    let dir = folder();
    let turn = ["turntable", "cube.obj", "--frames", "3", "--size", "32x24", "--spp", "4", "-o", "turn"];
    assert!(run(dir.path(), &turn).status.success());
    let frames: Vec<_> = (0..3).map(|i| dir.path().join(format!("turn/{i:04}.png"))).collect();
    let read = || frames.iter().map(|f| std::fs::read(f).unwrap()).collect::<Vec<_>>();
    let (whole, written) = (read(), || std::fs::metadata(&frames[0]).unwrap().modified().unwrap());
    let first = written();
    // What is missing is brightened as it was.
    std::fs::remove_file(&frames[1]).unwrap();
    assert!(run(dir.path(), &turn).status.success());
    assert!(read() == whole && written() == first);
    let other = turn.map(|a| if a == "32x24" { "24x24" } else { a });
    refused(dir.path(), &other, &["0000.png", "32×24", "24×24", "--force"]);
    assert!(read() == whole);
    assert!(run(dir.path(), &[&other[..], &["--force"]].concat()).status.success());
    assert!(read() != whole && !dir.path().join("turn/0003.png").exists());
}

#[test]
fn wrong_requests_are_refused_in_one_line() {
    let dir = folder();
    refused(dir.path(), &["compose", "scene.toml", "-o", "nowhere/a.png"], &["nowhere", "no such folder"]);
    refused(dir.path(), &["turntable", "cube.obj", "-o", "turn.avi"], &["turn.avi", ".mp4, .gif, or a folder"]);
    let at = dir.path();
    let scene = |name: &str, from: &str, to: &str| std::fs::write(at.join(name), SCENE.replace(from, to)).unwrap();
    scene("key.toml", "scale =", "scal =");
    scene("missing.toml", "cube.obj", "nothing.obj");
    scene("air.toml", "[0, 3, 0]", "[50, 3, 0]");
    scene("hdri.toml", "sky = { elevation = 40, rotation = 60, intensity = 0.02 }", "hdri = \"square.png\"");
    std::fs::write(at.join("short.txt"), "1 2 3\n1 2\n").unwrap();
    let square = diorama_geom::ImageU8 { width: 2, height: 2, channels: 3, data: vec![0; 12] };
    diorama_data::photo::save_png(&at.join("square.png"), &square).unwrap();
    let compose = |name: &'static str| vec!["compose", name, "-o", "x.png"];
    refused(at, &compose("key.toml"), &["key.toml", "line 8", "did you mean scale?"]);
    refused(at, &compose("missing.toml"), &["missing.toml", "line ", "nothing.obj", "object 0"]);
    let second = format!("{SCENE}\n[[object]]\nmesh = \"cube.obj\"\ntranslate = [1, 3, 0]\nscale = -1\n");
    std::fs::write(at.join("second.toml"), &second).unwrap();
    let line = format!("line {}", second.lines().position(|l| l == "scale = -1").unwrap() + 1);
    refused(at, &compose("second.toml"), &["second.toml", &line, "object.scale"]);
    refused(at, &compose("air.toml"), &["cube.obj", "no ground below"]);
    refused(at, &compose("hdri.toml"), &["square.png", "1.00 : 1"]);
    refused(at, &["compose", "scene.toml", "-o", "x.jpg"], &["x.jpg", ".exr"]);
    refused(at, &["compose", "scene.toml", "--denoise", "much"], &["--denoise", "atrous"]);
    refused(at, &["turntable", "cube.obj", "--light", "short.txt"], &["short.txt", "2"]);
    refused(at, &["turntable", "cube.obj", "--light", "sky:30"], &["--light", "sky:30,120"]);
    refused(at, &["turntable", "cube.obj", "--sun", "1,2"], &["--sun", "POWER"]);
    refused(at, &["turntable", "cube.stl"], &["cube.stl"]);
    refused(at, &["synth", "--size", "huge"], &["huge", "middle"]);
    for light in ["--light", "--unseen-light"] {
        refused(at, &["synth", light, "uniform"], &["--light", "--object", "street"]);
    }
    refused(at, &["train", "nowhere", "-o", "run"], &["nowhere"]);
    refused(at, &["train"], &["capture"]);
    refused(at, &["eval", "."], &["run folder"]);
    refused(at, &["render", ".", "--layers", "gloss"], &["--layers", "albedo"]);
}

#[test]
fn a_quickstart_needs_a_folder_of_its_own_and_can_be_interrupted() {
    let dir = folder();
    refused(dir.path(), &["quickstart", "-o", "."], &["holds no quickstart", "--out"]);
    let mut begun = command(dir.path(), &["quickstart", "-o", "q"]).spawn().unwrap();
    let street = dir.path().join("q/street/images");
    while !std::fs::read_dir(&street).is_ok_and(|mut d| d.next().is_some()) {
        assert!(begun.try_wait().unwrap().is_none(), "it ended before it photographed anything");
        std::thread::sleep(Duration::from_millis(100));
    }
    assert!(Command::new("kill").args(["-INT", &begun.id().to_string()]).status().unwrap().success());
    assert_eq!(begun.wait().unwrap().code(), Some(130));
    assert!(!dir.path().join("q/street/transforms_train.json").exists(), "what is unfinished does not look finished");
}
