//! Commands on a capture and a run, with the real program.

use diorama_pipelines::object::quickstart::write_capture;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

/// A capture and a short run on it, made once.
struct Good {
    _folder: tempfile::TempDir,
    capture: PathBuf,
    run: PathBuf,
}

fn good() -> &'static Good {
    static GOOD: OnceLock<Good> = OnceLock::new();
    GOOD.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let (capture, run) = (folder.path().join("capture"), folder.path().join("run"));
        write_capture(&capture, 24, 64).unwrap();
        let small = ["--set", "field.log2_size=14", "--set", "field.finest=256"];
        works(&[&["train", s(&capture), "-o", s(&run), "--steps", "400", "--device", "cpu"], &small[..]].concat());
        Good { _folder: folder, capture, run }
    })
}

fn s(p: &Path) -> &str {
    p.to_str().unwrap()
}

fn diorama(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).args(arguments).output().unwrap()
}

/// The output of a call that succeeds.
#[track_caller]
fn works(arguments: &[&str]) -> String {
    let o = diorama(arguments);
    assert!(o.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&o.stderr));
    String::from_utf8(o.stdout).unwrap()
}

fn export(file: &Path, more: &[&str]) -> serde_json::Value {
    let all = [&["export", s(&good().run), "-o", s(file), "--resolution", "64", "--device", "cpu", "--json"], more].concat();
    serde_json::from_str(&works(&all)).unwrap()
}

/// Whether each edge of an STL, whose vertices have no indices, has two faces.
fn is_closed(stl: &[u8]) -> bool {
    let mut edges: HashMap<([u8; 12], [u8; 12]), i32> = HashMap::new();
    for f in stl[84..].chunks_exact(50) {
        let v: [[u8; 12]; 3] = std::array::from_fn(|k| f[12 + 12 * k..24 + 12 * k].try_into().unwrap());
        (0..3).for_each(|k| *edges.entry((v[k], v[(k + 1) % 3])).or_default() += 1);
    }
    !edges.is_empty() && edges.iter().all(|((a, b), n)| *n == 1 && edges.get(&(*b, *a)) == Some(&1))
}

#[test]
fn watertight_meshes_are_closed_by_place() {
    let dir = tempfile::tempdir().unwrap();
    for (name, more) in
        [("all", &["--faces", "0"][..]), ("few", &["--faces", "1500"]), ("tetrahedra", &["--faces", "3000", "--extract", "mt"])]
    {
        let file = dir.path().join(name).with_extension("stl");
        let made = export(&file, &[&["--watertight"], more].concat());
        assert_eq!(made["watertight"], true, "{name}");
        assert!(is_closed(&std::fs::read(&file).unwrap()), "{name}");
    }
}

#[test]
fn marching_tetrahedra_make_the_same_thing_of_more_faces() {
    let dir = tempfile::tempdir().unwrap();
    let [mc, mt] = ["mc", "mt"].map(|m| export(&dir.path().join(m).with_extension("ply"), &["--faces", "0", "--extract", m]));
    let faces = |v: &serde_json::Value| v["faces"].as_f64().unwrap();
    assert!((1.4..3.5).contains(&(faces(&mt) / faces(&mc))), "{} {}", faces(&mc), faces(&mt));
    for k in 0..3 {
        let extent = |v: &serde_json::Value| v["extent_m"][k].as_f64().unwrap();
        assert!((extent(&mc) / extent(&mt) - 1.0).abs() < 0.02);
    }
}

#[test]
fn a_normal_map_comes_with_tangents_and_a_material_that_is_lit() {
    let dir = tempfile::tempdir().unwrap();
    let glb = dir.path().join("a.glb");
    export(&glb, &["--normal-map", "--texture", "256", "--faces", "2000"]);
    let bytes = std::fs::read(&glb).unwrap();
    let n = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let root: serde_json::Value = serde_json::from_slice(&bytes[20..20 + n]).unwrap();
    assert!(root["meshes"][0]["primitives"][0]["attributes"]["TANGENT"].is_u64());
    assert!(root["materials"][0]["normalTexture"].is_object() && root["materials"][0]["extensions"].is_null());
    assert_eq!(root["images"].as_array().unwrap().len(), 2);
    let obj = dir.path().join("b.obj");
    export(&obj, &["--normal-map", "--texture", "256", "--faces", "2000"]);
    assert!(std::fs::read_to_string(dir.path().join("b.mtl")).unwrap().contains("norm b.normal.png"));
    assert!(dir.path().join("b.normal.png").exists());
    let refused = diorama(&["export", s(&good().run), "-o", s(&dir.path().join("c.ply")), "--normal-map"]);
    assert_eq!(refused.status.code(), Some(2));
}

#[test]
fn a_path_of_a_file_takes_another_size_and_rate() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("path.json");
    let camera = serde_json::json!({
        "camera_to_world": [1, 0, 0, 0, 0, 0, -1, -3, 0, 1, 0, 0, 0, 0, 0, 1], "fov": 40, "aspect": 1.0
    });
    let json = serde_json::json!({ "render_width": 40, "render_height": 30, "fps": 5, "camera_path": [camera] });
    std::fs::write(&path, json.to_string()).unwrap();
    for (more, size) in [(&[][..], (40, 30)), (&["--size", "32x48", "--fov", "50"], (32, 48))] {
        let images = dir.path().join(format!("{}", size.0));
        let all = ["render", s(&good().run), "--path", s(&path), "--images", s(&images), "--device", "cpu"];
        works(&[&all[..], more].concat());
        let first = std::fs::read_dir(&images).unwrap().flatten().next().unwrap().path();
        let first = if first.is_dir() { std::fs::read_dir(first).unwrap().flatten().next().unwrap().path() } else { first };
        assert_eq!(diorama_data::photo::size(&first).unwrap(), size);
    }
}

#[test]
fn doctor_judges_a_capture() {
    let text = works(&["doctor", s(&good().capture)]);
    for subject in ["views", "camera", "poses", "scale", "exposure", "sharpness", "memory"] {
        assert!(text.contains(subject), "{text}");
    }
    let json: serde_json::Value = serde_json::from_str(&works(&["doctor", s(&good().capture), "--json"])).unwrap();
    assert!(json["findings"].as_array().unwrap().iter().all(|f| f["grade"] != "trouble"), "{json}");
    assert_eq!(diorama(&["doctor", "no/such/folder"]).status.code(), Some(2));
}

#[test]
fn shells_and_man_learn_every_verb() {
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let text = works(&["completions", shell]);
        assert!(text.contains("quickstart") && text.contains("remove-background"), "{shell}");
    }
    let dir = tempfile::tempdir().unwrap();
    works(&["man", s(dir.path())]);
    for page in ["diorama", "diorama-train", "diorama-bench-ops"] {
        let text = std::fs::read_to_string(dir.path().join(page).with_extension("1")).unwrap();
        assert!(text.contains(".TH") && text.contains("SYNOPSIS"), "{page}");
    }
}
