//! Importers: round trips, agreement between formats, and real captures.

use diorama_data::import::{self, Format, ImportOptions};
use diorama_data::{colmap, photo, transforms_json};
use diorama_geom::capture::{Frame, Split};
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Capture, ImageU8, Lens, Pose, SceneBox};
use std::path::{Path, PathBuf};

fn capture(root: &Path) -> Capture {
    std::fs::create_dir_all(root.join("images")).unwrap();
    let frames = (0..6)
        .map(|i| {
            let image = root.join(format!("images/a {i}.png"));
            photo::save_png(&image, &ImageU8 { width: 20, height: 16, channels: 3, data: vec![40 * i as u8; 960] }).unwrap();
            let a = i as f64;
            let lens = [Lens::Pinhole, Lens::Brown { k: [0.05, -0.01, 0.002, 0.0, 0.0, 0.0], p: [1e-3, -2e-3] }][i % 2];
            let camera = Camera { cx: 9.5, lens, ..Camera::pinhole(20, 16, 0.9) };
            let pose = Pose::look_at(DVec3::new(3.0 * a.cos(), 3.0 * a.sin(), 1.0), DVec3::ZERO, DVec3::Z);
            let split = if i == 4 { Split::Test } else { Split::Train };
            Frame { split, ..Frame::new(format!("images/a {i}"), image, camera, pose) }
        })
        .collect();
    let scene = SceneBox { center: DVec3::new(0.1, 0.2, 0.3), half: 1.25, aabb_scale: 2 };
    Capture::new(frames, scene)
}

fn same_pose(a: &Pose, b: &Pose) {
    assert!((a.translation - b.translation).length() < 1e-6, "{a:?} {b:?}");
    for (x, y) in a.rotation.to_cols_array().iter().zip(b.rotation.to_cols_array()) {
        assert!((x - y).abs() < 1e-6);
    }
}

#[test]
fn transforms_json_round_trips() {
    let dir = tempfile::tempdir().unwrap();
    let want = capture(dir.path());
    transforms_json::write(&dir.path().join("transforms.json"), dir.path(), &want, None).unwrap();
    let got = import::import(dir.path(), &ImportOptions::default()).unwrap();
    assert_eq!(got.frames.len(), 6);
    for (a, b) in got.frames.iter().zip(&want.frames) {
        same_pose(&a.world_from_camera, &b.world_from_camera);
        assert_eq!((a.camera, a.split, &a.name), (b.camera, b.split, &b.name));
    }
    assert!((got.scene.center - want.scene.center).length() < 1e-9 && (got.scene.half - 1.25).abs() < 1e-9);
    assert_eq!(got.scene.aabb_scale, 2);
}

#[test]
fn colmap_text_round_trips_up_to_the_turn_of_the_world() {
    let dir = tempfile::tempdir().unwrap();
    let want = capture(dir.path());
    colmap::write_text(&dir.path().join("sparse/0"), &want).unwrap();
    let got = import::import(dir.path(), &ImportOptions::default()).unwrap();
    let back = got.world_from_capture.inverse();
    for (a, b) in got.frames.iter().zip(&want.frames) {
        same_pose(&back.pose(&a.world_from_camera), &b.world_from_camera);
        let (d, e) = (a.camera.direction(3.0, 14.0), b.camera.direction(3.0, 14.0));
        assert!((d - e).length() < 1e-9);
    }
    // Up is the cameras' mean up direction.
    let up: DVec3 = got.frames.iter().map(|f| -f.world_from_camera.rotation.y_axis).sum();
    assert!(up.normalize().z > 0.999);
}

#[test]
fn transforms_json_wins_and_the_format_flag_overrides() {
    let dir = tempfile::tempdir().unwrap();
    let c = capture(dir.path());
    colmap::write_text(&dir.path().join("sparse"), &c).unwrap();
    transforms_json::write(&dir.path().join("transforms.json"), dir.path(), &c, None).unwrap();
    let read = |format| import::import(dir.path(), &ImportOptions { format, ..ImportOptions::default() }).unwrap();
    assert_eq!(read(None).scene.aabb_scale, 2);
    assert_eq!(read(Some(Format::Colmap)).scene.aabb_scale, 8, "COLMAP states no box");
}

#[test]
fn a_description_that_cannot_be_read_names_the_others() {
    let dir = tempfile::tempdir().unwrap();
    let c = capture(dir.path());
    colmap::write_text(&dir.path().join("sparse"), &c).unwrap();
    let file = dir.path().join("transforms.json");
    transforms_json::write(&file, dir.path(), &c, None).unwrap();
    let elsewhere = std::fs::read_to_string(&file).unwrap().replace("images/", "/home/somebody/images/");
    std::fs::write(&file, elsewhere).unwrap();
    let error = |data: &Path, format| {
        let e = import::import(data, &ImportOptions { format, ..ImportOptions::default() }).unwrap_err();
        assert!(e.is_input());
        e.to_string()
    };
    let e = error(dir.path(), None);
    assert!(e.contains("leads out of the dataset folder") && e.ends_with("; or read what else is there: --format colmap"), "{e}");
    for chosen in [error(dir.path(), Some(Format::Transforms)), error(&file, None)] {
        assert!(!chosen.contains("--format"), "{chosen}");
    }
}

#[test]
fn photographs_that_a_model_does_not_hold_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let mut c = capture(dir.path());
    let notes = |c: &Capture| {
        colmap::write_text(&dir.path().join("sparse"), c).unwrap();
        import::import(dir.path(), &ImportOptions { min_views: 1, ..ImportOptions::default() }).unwrap().notes
    };
    assert!(!notes(&c).iter().any(|n| n.contains("no pose")));
    c.frames.retain(|f| !["images/a 1", "images/a 3"].contains(&&*f.name));
    let notes = notes(&c);
    assert!(notes.iter().any(|n| n.starts_with("2 photographs ") && n.ends_with("left out (a 1.png, a 3.png)")), "{notes:?}");
}

#[test]
fn blender_sets_keep_their_split_and_complete_extensions() {
    let dir = tempfile::tempdir().unwrap();
    for (name, n) in [("train", 3), ("test", 2)] {
        std::fs::create_dir(dir.path().join(name)).unwrap();
        let frames: Vec<serde_json::Value> = (0..n)
            .map(|i| {
                let file = dir.path().join(format!("{name}/r_{i}.png"));
                photo::save_png(&file, &ImageU8 { width: 8, height: 8, channels: 4, data: vec![9; 256] }).unwrap();
                let m = [[1.0, 0.0, 0.0, i as f64], [0.0, 0.0, -1.0, -4.0], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0]];
                serde_json::json!({ "file_path": format!("./{name}/r_{i}"), "transform_matrix": m })
            })
            .collect();
        let json = serde_json::json!({ "camera_angle_x": 0.69, "frames": frames });
        std::fs::write(dir.path().join(format!("transforms_{name}.json")), json.to_string()).unwrap();
    }
    let c = import::import(dir.path(), &ImportOptions::default()).unwrap();
    assert_eq!((c.indices(Split::Train).len(), c.indices(Split::Test).len()), (3, 2));
    assert!((c.frames[0].camera.fx - 4.0 / (0.345f64).tan()).abs() < 1e-9);
    // Blender's camera looks along −z with y up. This one looks along +y of the world, and its right is +x.
    let r = c.frames[0].world_from_camera.rotation;
    assert!((r.z_axis - DVec3::Y).length() < 1e-9 && (r.x_axis - DVec3::X).length() < 1e-9 && (r.y_axis + DVec3::Z).length() < 1e-9);
}

#[test]
fn a_mask_of_instant_ngp_hides_what_is_not_black() {
    let dir = tempfile::tempdir().unwrap();
    let c = capture(dir.path());
    transforms_json::write(&dir.path().join("transforms.json"), dir.path(), &c, None).unwrap();
    let photo_file = &c.frames[1].image;
    let mask = photo_file.with_file_name(format!("dynamic_mask_{}.png", photo_file.file_stem().unwrap().to_str().unwrap()));
    let data = (0..20 * 16).flat_map(|i| if i % 20 < 5 { [0, 90, 0] } else { [0; 3] }).collect();
    photo::save_png(&mask, &ImageU8 { width: 20, height: 16, channels: 3, data }).unwrap();
    let read = import::import(dir.path(), &ImportOptions::default()).unwrap();
    assert_eq!(read.frames.iter().filter(|f| f.mask.is_some()).count(), 1);
    let m = photo::load_mask(read.frames[1].mask.as_ref().unwrap()).unwrap();
    assert_eq!((m.pixel(4, 3)[0], m.pixel(5, 3)[0]), (0, 255));
}

/// The folder of real captures; without one, prints that the test was skipped.
fn data(name: &str) -> Option<PathBuf> {
    let found = std::env::var("DIORAMA_TEST_DATA").ok().map(|d| PathBuf::from(d).join(name)).filter(|d| d.is_dir());
    if found.is_none() {
        assert!(std::env::var("DIORAMA_REQUIRE_DATA").is_err(), "DIORAMA_TEST_DATA/{name} is required");
        println!("skipped: no test data");
    }
    found
}

#[test]
fn fox_has_fifty_photographs_and_says_what_it_skipped() {
    let Some(fox) = data("fox") else { return };
    let options = ImportOptions { split: "every:8".parse().unwrap(), ..ImportOptions::default() };
    let c = import::import(&fox, &options).unwrap();
    assert_eq!((c.frames.len(), c.indices(Split::Test).len()), (50, 7));
    assert!(c.notes[0].starts_with("17 listed images"));
    assert_eq!((c.frames[0].camera.width, c.frames[0].camera.height), (1080, 1920));
    // Its COLMAP model is the same capture up to a similarity: ratios of camera distances agree.
    let m = import::import(&fox, &ImportOptions { format: Some(Format::Colmap), ..options }).unwrap();
    assert_eq!(m.frames.len(), 50);
    let span = |c: &Capture, a: &str, b: &str| {
        let at = |n: &str| c.frames.iter().find(|f| f.name.ends_with(n)).unwrap().world_from_camera.translation;
        (at(a) - at(b)).length()
    };
    let ratio = |c: &Capture| span(c, "0001", "0110") / span(c, "0042", "0073");
    assert!((ratio(&c) / ratio(&m) - 1.0).abs() < 0.05, "{} {}", ratio(&c), ratio(&m));
}

#[test]
fn lego_and_buddha_are_read() {
    let Some(lego) = data("lego") else { return };
    let c = import::import(&lego, &ImportOptions::default()).unwrap();
    assert_eq!((c.indices(Split::Train).len(), c.indices(Split::Test).len()), (70, 10));
    let buddha = import::import(&lego.with_file_name("buddha"), &ImportOptions::default()).unwrap();
    assert_eq!(buddha.frames.len(), 67);
}
