//! Compositions by the real program: shadows turn with the light, scenarios run from nothing, exports open elsewhere, wrong lights and
//! models are mended or refused in one line.

use diorama_data::{environment, photo};
use diorama_geom::Image;
use diorama_geom::environment::Environment;
use diorama_geom::glam::DVec3;
use std::path::Path;
use std::process::{Command, Output};

fn relight(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).arg("relight").args(arguments).current_dir(folder).output().unwrap()
}

#[track_caller]
fn done(folder: &Path, arguments: &[&str]) -> String {
    let o = relight(folder, arguments);
    let told = String::from_utf8_lossy(&o.stderr).into_owned();
    assert!(o.status.success(), "{arguments:?}: {told}");
    told
}

#[track_caller]
fn refused(folder: &Path, arguments: &[&str], expected: &[&str]) {
    let before = std::fs::read_dir(folder).unwrap().count();
    let o = relight(folder, arguments);
    let text = String::from_utf8_lossy(&o.stderr);
    let errors: Vec<&str> = text.lines().filter(|l| l.starts_with("diorama: ")).collect();
    assert!(o.status.code() == Some(2) && errors.len() == 1 && !text.contains("panicked"), "{arguments:?}: {text}");
    assert!(expected.iter().all(|e| errors[0].contains(e)), "{expected:?} are not all in {:?}", errors[0]);
    assert_eq!(std::fs::read_dir(folder).unwrap().count(), before, "{arguments:?} left something behind");
}

const FLOOR: &str = "v -9 0 -9\nv -9 0 9\nv 9 0 9\nv 9 0 -9\nf 1 2 3 4\n";
const POST: &str = "v -.1 0 -.1\nv .1 0 -.1\nv .1 0 .1\nv -.1 0 .1\nv -.1 1.2 -.1\nv .1 1.2 -.1\nv .1 1.2 .1\nv -.1 1.2 .1\n\
    f 1 2 3 4\nf 5 8 7 6\nf 1 5 6 2\nf 2 6 7 3\nf 3 7 8 4\nf 4 8 5 1\n";

fn scene(rotate_deg: f64) -> String {
    format!(
        "[scene]\nmesh = \"floor.obj\"\n[[object]]\nmesh = \"post.obj\"\n[light]\nhdri = \"lamp.hdr\"\nrotate_deg = {rotate_deg}\n\
         [camera]\neye = [0, 8, 0]\ntarget = [0, 0, 0]\nfov_deg = 40\n[render]\nsize = [96, 96]\nspp = 32\n"
    )
}

/// A lamp in a dim sky, and what it shines on.
fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let lamp = DVec3::new(0.5, 0.5, 0.7).normalize();
    let light = Environment::from_fn(64, |d| [if d.dot(lamp) > 0.995 { 60.0 } else { 0.05 }; 3]);
    environment::save_hdr(&dir.path().join("lamp.hdr"), &light).unwrap();
    for (name, text) in [("floor.obj", FLOOR), ("post.obj", POST), ("scene.toml", &scene(0.0))] {
        std::fs::write(dir.path().join(name), text).unwrap();
    }
    dir
}

/// Azimuth in degrees of the shadow around the center of a picture from above.
fn shadow(path: &Path) -> f64 {
    let image = photo::load(path).unwrap();
    let mut values: Vec<u8> = image.data.chunks_exact(image.channels).map(|p| p[1]).collect();
    let level = *values.clone().select_nth_unstable(values.len() / 2).1 as f64;
    let (mut x, mut y) = (0.0, 0.0);
    for (i, v) in values.drain(..).enumerate() {
        let [dx, dy] = [(i % image.width) as f64 - 47.5, 47.5 - (i / image.width) as f64];
        let dark = (0.8 * level - v as f64).max(0.0);
        if dx.hypot(dy) > 6.0 {
            (x, y) = (x + dark * dx, y + dark * dy);
        }
    }
    y.atan2(x).to_degrees()
}

#[test]
fn rotating_the_light_turns_the_shadow_as_much() {
    let dir = folder();
    let azimuth = |turn: f64| {
        std::fs::write(dir.path().join("turned.toml"), scene(turn)).unwrap();
        done(dir.path(), &["compose", "turned.toml", "--force", "-o", "turned.png"]);
        shadow(&dir.path().join("turned.png"))
    };
    let before = azimuth(0.0);
    // Away from the lamp.
    assert!((before + 135.0).abs() < 2.0, "{before}");
    for turn in [40.0, -75.0] {
        let after = azimuth(turn);
        let error = (after - before - turn + 180.0).rem_euclid(360.0) - 180.0;
        assert!(error.abs() < 2.0, "turned by {turn}: {before} {after}");
    }
}

#[test]
fn compositions_are_exported_for_blender_and_exports_are_not_overwritten() {
    let dir = folder();
    let export = ["compose", "scene.toml", "--spp", "1", "--export-blender", "blend", "-o", "a.png"];
    let told = done(dir.path(), &export);
    assert!(told.contains("blender") && told.contains("scene.py"), "{told}");
    let at = |name: &str| dir.path().join("blend").join(name);
    let described: serde_json::Value = serde_json::from_slice(&std::fs::read(at("scene.json")).unwrap()).unwrap();
    // Blender's camera looks along -z: from above, its axes are the world's.
    assert_eq!(described["camera"]["world_from_camera"][2], serde_json::json!([0.0, 0.0, 1.0, 8.0]));
    assert_eq!((&described["size"], described["bounces"].as_u64()), (&serde_json::json!([96, 96]), Some(8)));
    let model = diorama_data::model_file::read(&at("scene.glb")).unwrap().model;
    assert_eq!(model.face_count(), 14);
    let light = environment::read(&at("light.exr")).unwrap().environment;
    assert_eq!(light.image().height, 64);
    assert!(std::fs::read_to_string(at("scene.py")).unwrap().contains("bpy"));
    refused(dir.path(), &[&export[..7], &["b.png"]].concat(), &["blend", "--force"]);
    // Without Blender, the command says what to install, and renders all the same.
    let o = Command::new(env!("CARGO_BIN_EXE_diorama"))
        .arg("relight")
        .args(export)
        .arg("--force")
        .current_dir(dir.path())
        .env("PATH", "")
        .output();
    let o = o.unwrap();
    assert!(o.status.success() && String::from_utf8_lossy(&o.stderr).contains("install it"), "{}", String::from_utf8_lossy(&o.stderr));
}

#[test]
fn scenarios_are_composed_from_nothing() {
    let dir = folder();
    let small = ["--size", "96x64", "--spp", "4", "--json"];
    let run = |name: &str| {
        let o = relight(dir.path(), &[&["scenario", name, "-o", name], &small[..]].concat());
        assert!(o.status.success(), "{name}: {}", String::from_utf8_lossy(&o.stderr));
        let told: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
        assert!(told["thesis"].as_str().unwrap().contains("bring") && told["triangles"].as_u64().unwrap() > 100_000, "{told}");
        photo::load(&dir.path().join(name).join("composed.png")).unwrap()
    };
    assert_eq!((run("synthetic-in-synthetic").width, dir.path().join("synthetic-in-synthetic/object.glb").exists()), (96, true));
    let composed = run("real-in-real");
    let photograph = photo::load(&dir.path().join("real-in-real/photograph.png")).unwrap();
    // Most of the photograph stays as it is; the object and its shadow are seen.
    let changed = |least: i32| {
        let pairs = composed.data.chunks_exact(composed.channels).zip(photograph.data.chunks_exact(photograph.channels));
        pairs.filter(|(a, b)| (0..3).any(|k| (a[k] as i32 - b[k] as i32).abs() > least)).count() as f64 / (96.0 * 64.0)
    };
    let share = changed(24);
    assert!(share > 0.005 && share < 0.25, "{share}");
    refused(dir.path(), &["scenario", "real-in-fake"], &["real-in-fake", "real-in-real"]);
    refused(dir.path(), &["scenario", "real-in-real", "--site", "floor.obj", "-o", "x"], &["--frame"]);
    refused(dir.path(), &["scenario", "synthetic-in-synthetic", "--object", "no.glb", "-o", "x"], &["no.glb", "--object"]);
}

#[test]
fn wrong_lights_are_refused_or_mended_and_named() {
    let dir = folder();
    let at = dir.path();
    let bytes = std::fs::read(at.join("lamp.hdr")).unwrap();
    std::fs::write(at.join("cut.hdr"), &bytes[..bytes.len() / 2]).unwrap();
    let mut image = Image::zeros(16, 8, 3);
    image.data.fill(0.5);
    (image.data[3 * (2 * 16 + 5)], image.data[3 * (4 * 16 + 1)]) = (f32::NAN, -1.0);
    photo::save_exr(&at.join("holes.exr"), &image).unwrap();
    let exr = std::fs::read(at.join("holes.exr")).unwrap();
    std::fs::write(at.join("cut.exr"), &exr[..exr.len() / 2]).unwrap();
    std::fs::write(at.join("wide.txt"), "1 2 3 4\n".repeat(9)).unwrap();
    std::fs::write(at.join("word.txt"), format!("{}1 two 3\n", "1 2 3\n".repeat(8))).unwrap();
    let turn =
        |light: &'static str| ["turntable", "post.obj", "--frames", "1", "--size", "16x16", "--spp", "1", "-o", "turn", "--light", light];
    refused(at, &turn("cut.hdr"), &["cut.hdr", "copy it again"]);
    refused(at, &turn("cut.exr"), &["cut.exr", "copy it again"]);
    refused(at, &turn("wide.txt"), &["wide.txt", "row 1 has 4 columns"]);
    refused(at, &turn("word.txt"), &["word.txt", "row 9, column 2", "two"]);
    refused(at, &turn("none.hdr"), &["none.hdr"]);
    let told = done(at, &turn("holes.exr"));
    assert!(told.contains("2 pixels") && told.contains("column 5, row 2") && told.contains("black"), "{told}");
    // A mesh without a material and texture coordinates gets the default material, and is named.
    assert!(told.contains("\"post\"") && told.contains("default material"), "{told}");
}
