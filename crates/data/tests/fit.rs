//! Photographs that differ from the file with their poses: other sizes, other frames, broken photographs, depth maps.

use diorama_data::import::{self, ImportOptions};
use diorama_data::{DataError, colmap, photo, photo_check, transforms_json};
use diorama_geom::capture::{ColorSpace, Frame, Split};
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Capture, Image, ImageU8, Lens, Pose, SceneBox};
use serde_json::{Value, json};
use std::path::Path;

const LENS: Lens = Lens::Brown { k: [0.05, -0.01, 0.0, 0.0, 0.0, 0.0], p: [1e-3, -2e-3] };

fn save(path: &Path, w: usize, h: usize) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    photo::save_png(path, &ImageU8 { width: w, height: h, channels: 3, data: (0..w * h * 3).map(|i| (i * 7) as u8).collect() }).unwrap();
}

/// Six photographs of `size` in `folder`, with cameras of 200×120 around the origin.
fn capture(root: &Path, folder: &str, size: (usize, usize)) -> Capture {
    let frames = (0..6)
        .map(|i| {
            let image = root.join(folder).join(format!("a{i}.png"));
            save(&image, size.0, size.1);
            let camera = Camera { cx: 97.0, cy: 61.5, lens: LENS, ..Camera::pinhole(200, 120, 0.9) };
            let a = i as f64;
            let pose = Pose::look_at(DVec3::new(3.0 * a.cos(), 3.0 * a.sin(), 1.0), DVec3::ZERO, DVec3::Z);
            Frame { split: if i == 4 { Split::Test } else { Split::Train }, ..Frame::new(format!("a{i}"), image, camera, pose) }
        })
        .collect();
    let scene = SceneBox { center: DVec3::ZERO, half: 1.25, aabb_scale: 2 };
    Capture::new(frames, scene)
}

fn write(root: &Path, c: &Capture) {
    transforms_json::write(&root.join("transforms.json"), root, c, None).unwrap();
}

fn read(root: &Path) -> Result<Capture, DataError> {
    import::import(root, &ImportOptions::default())
}

/// Edits the capture's file.
fn edit(root: &Path, change: impl FnOnce(&mut Value)) {
    let file = root.join("transforms.json");
    let mut json = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    change(&mut json);
    std::fs::write(file, json.to_string()).unwrap();
}

fn refusal(root: &Path) -> String {
    let e = read(root).unwrap_err();
    let text = e.to_string();
    assert!(e.is_input() && !text.contains('\n'), "{text}");
    text
}

#[test]
fn intrinsics_follow_resized_photographs_and_a_note_says_so() {
    // Sides may be rounded up or down.
    for size in [(100, 60), (50, 30), (66, 40), (67, 40), (23, 14), (400, 240)] {
        let dir = tempfile::tempdir().unwrap();
        let c = capture(dir.path(), "images_4", size);
        write(dir.path(), &c);
        let got = read(dir.path()).unwrap();
        let (sx, sy) = (size.0 as f64 / 200.0, size.1 as f64 / 120.0);
        for (f, want) in got.frames.iter().zip(&c.frames) {
            assert_eq!((f.camera.width as usize, f.camera.height as usize), size);
            for (x, y) in [(0.5, 0.5), (150.5, 20.5), (199.5, 119.5)] {
                // The center of a pixel of the large photograph, in the small one.
                let d = f.camera.direction(x * sx, y * sy);
                assert!((d - want.camera.direction(x, y)).length() < 1e-9);
            }
        }
        let note = got.notes.iter().find(|n| n.contains("scaled")).expect("a note");
        assert!(note.contains("6 photographs") && note.contains(&format!("{}×{}", size.0, size.1)) && note.contains("200×120"), "{note}");
    }
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &capture(dir.path(), "images", (200, 120)));
    assert!(read(dir.path()).unwrap().notes.is_empty(), "nothing to say where they fit");
}

#[test]
fn another_aspect_is_an_error_with_both_sizes() {
    for size in [(100, 100), (120, 200), (100, 63), (60, 200)] {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), &capture(dir.path(), "images", size));
        let text = refusal(dir.path());
        assert!(text.contains("a0.png") && text.contains(&format!("{}×{}", size.0, size.1)) && text.contains("200×120"), "{text}");
    }
}

#[test]
fn colmap_models_take_reduced_photographs() {
    let dir = tempfile::tempdir().unwrap();
    let c = capture(dir.path(), "images_4", (50, 30));
    colmap::write_text(&dir.path().join("sparse/0"), &c).unwrap();
    let got = read(dir.path()).unwrap();
    assert_eq!(got.frames.len(), 6);
    assert!((got.frames[0].camera.fx - c.frames[0].camera.fx / 4.0).abs() < 1e-9);
    assert!(got.notes.iter().any(|n| n.contains("50×30") && n.contains("200×120")), "{:?}", got.notes);
}

#[test]
fn llff_takes_reduced_photographs() {
    let dir = tempfile::tempdir().unwrap();
    let mut values = Vec::new();
    for i in 0..4 {
        save(&dir.path().join(format!("images_4/{i}.png")), 50, 30);
        let row = [0.0, 1.0, 0.0, i as f64, 120.0, 1.0, 0.0, 0.0, 6.0, 200.0, 0.0, 0.0, -1.0, 7.0, 180.0, 0.1, 9.0];
        values.extend(row.iter().flat_map(|v: &f64| v.to_le_bytes()));
    }
    std::fs::write(dir.path().join("poses_bounds.npy"), npy("4, 17", "<f8", &values)).unwrap();
    let got = read(dir.path()).unwrap();
    let camera = got.frames[1].camera;
    assert_eq!((camera.width, camera.height, camera.fx, camera.cx), (50, 30, 45.0, 25.0));
}

fn npy(shape: &str, kind: &str, values: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}\n");
    [b"\x93NUMPY\x01\0", &(header.len() as u16).to_le_bytes()[..], header.as_bytes(), values].concat()
}

#[test]
fn what_nerfstudio_did_to_the_poses_is_undone_for_meshes() {
    let dir = tempfile::tempdir().unwrap();
    let c = capture(dir.path(), "images", (200, 120));
    write(dir.path(), &c);
    // As `ns-process-data` rotates COLMAP's world, at half its size.
    let rows = [[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, 1.0, -2.0], [0.0, -1.0, 0.0, 3.0]];
    edit(dir.path(), |j| {
        j["applied_transform"] = json!(rows);
        j["applied_scale"] = json!(0.5);
    });
    let got = read(dir.path()).unwrap();
    // The poses stay as given.
    assert!((got.frames[2].world_from_camera.translation - c.frames[2].world_from_camera.translation).length() < 1e-9);
    let in_colmap = DVec3::new(7.0, -4.0, 2.0);
    let in_file = 0.5 * DVec3::new(7.0 + 0.5, 2.0 - 2.0, 4.0 + 3.0);
    assert!((got.world_from_capture.point(in_colmap) - in_file).length() < 1e-12);
    assert!((got.world_from_capture.inverse().point(in_file) - in_colmap).length() < 1e-12);
    // A scale inside the matrix counts as a scale; a mirror is refused.
    edit(dir.path(), |j| j["applied_transform"] = json!(rows.map(|r| r.map(|v| 3.0 * v))));
    let larger = read(dir.path()).unwrap().world_from_capture;
    assert!((larger.scale - 1.5).abs() < 1e-12 && (larger.point(in_colmap) - 3.0 * in_file).length() < 1e-12);
    edit(dir.path(), |j| j["applied_transform"][0][0] = json!(-3.0));
    let text = refusal(dir.path());
    assert!(text.contains("applied_transform") && text.contains("transforms.json"), "{text}");
}

#[test]
fn equirectangular_photographs_need_no_focal_length() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &capture(dir.path(), "images", (200, 100)));
    edit(dir.path(), |j| {
        j["camera_model"] = json!("EQUIRECTANGULAR");
        for f in j["frames"].as_array_mut().unwrap() {
            let keep = ["file_path", "transform_matrix"].map(|k| (k.to_string(), f[k].clone()));
            *f = Value::Object(keep.into_iter().collect());
        }
    });
    let got = read(dir.path()).unwrap();
    let c = got.frames[0].camera;
    assert_eq!((c.lens, c.width, c.height), (Lens::Equirectangular, 200, 100));
    assert!((c.direction(0.0, 50.0) + DVec3::Z).length() < 1e-9, "the left edge looks back");
    edit(dir.path(), |j| j["camera_model"] = json!("OPENCV"));
    assert!(refusal(dir.path()).contains("fl_x"), "other cameras still need one");
}

#[test]
fn depth_maps_are_checked_and_said_to_be_unused() {
    let dir = tempfile::tempdir().unwrap();
    let c = capture(dir.path(), "images", (200, 120));
    write(dir.path(), &c);
    std::fs::create_dir_all(dir.path().join("depth")).unwrap();
    image::DynamicImage::new_luma16(100, 60).save(dir.path().join("depth/0.png")).unwrap();
    std::fs::write(dir.path().join("depth/1.npy"), npy("60, 100", "<f4", &[0; 24000])).unwrap();
    edit(dir.path(), |j| {
        j["frames"][0]["depth_file_path"] = json!("depth/0.png");
        j["frames"][1]["depth_file_path"] = json!("depth/1.npy");
    });
    let got = read(dir.path()).unwrap();
    assert_eq!(got.frames.iter().map(|f| f.depth.is_some()).collect::<Vec<_>>(), [true, true, false, false, false, false]);
    assert!(got.notes.iter().any(|n| n.contains("2 depth maps") && n.contains("not used")), "{:?}", got.notes);
    for (name, bytes, word) in [
        ("depth/2.npy", npy("60, 60", "<f4", &[0; 14400]), "60×60"),
        ("depth/3.txt", b"1 2 3".to_vec(), "NPY"),
        ("depth/4.png", std::fs::read(&c.frames[0].image).unwrap(), "8 bits"),
    ] {
        std::fs::write(dir.path().join(name), bytes).unwrap();
        edit(dir.path(), |j| j["frames"][2]["depth_file_path"] = json!(name));
        let text = refusal(dir.path());
        assert!(text.contains(name) && text.contains(word), "{text}");
    }
}

#[test]
fn broken_photographs_are_named_or_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let c = capture(dir.path(), "images", (200, 120));
    write(dir.path(), &c);
    let cut = |i: usize, n: usize| {
        let bytes = std::fs::read(&c.frames[i].image).unwrap();
        std::fs::write(&c.frames[i].image, &bytes[..n]).unwrap();
    };
    // One without a header, one without an end.
    cut(0, 0);
    cut(4, 900);
    let text = refusal(dir.path());
    assert!(text.contains("a0.png") && text.contains("--skip-broken"), "{text}");
    let mut got = import::import(dir.path(), &ImportOptions { skip_broken: true, ..ImportOptions::default() }).unwrap();
    assert_eq!(got.notes, ["1 broken photograph is left out: a0.png"]);
    photo_check::leave_out_broken(&mut got).unwrap();
    assert_eq!(got.notes[1], "1 broken photograph is left out: a4.png");
    assert_eq!(got.frames.iter().map(|f| f.image.file_stem().unwrap().to_str().unwrap()).collect::<Vec<_>>(), ["a1", "a2", "a3", "a5"]);
    // With too few photographs nothing can be learned.
    for i in [1, 2, 3] {
        cut(i, 900);
    }
    let e = photo_check::leave_out_broken(&mut got).unwrap_err();
    assert!(e.is_input() && e.to_string().contains("1 training views"), "{e}");
}

#[test]
fn light_is_of_one_kind_and_known_from_the_files() {
    let dir = tempfile::tempdir().unwrap();
    let mut c = capture(dir.path(), "images", (200, 120));
    let bright = Image { width: 200, height: 120, channels: 3, data: vec![9.0; 200 * 120 * 3] };
    for f in &mut c.frames {
        f.image.set_extension("exr");
        photo::save_exr(&f.image, &bright).unwrap();
    }
    write(dir.path(), &c);
    let got = read(dir.path()).unwrap();
    assert!(got.frames.iter().all(|f| f.color_space == ColorSpace::Linear));
    edit(dir.path(), |j| j["frames"][3]["file_path"] = json!("images/a3.png"));
    let text = refusal(dir.path());
    assert!(text.contains("a0.exr") && text.contains("a3.png") && text.contains("one kind"), "{text}");
}

#[test]
fn a_thousand_photographs_are_looked_at_fast() {
    let dir = tempfile::tempdir().unwrap();
    let mut c = capture(dir.path(), "images", (200, 120));
    // Large sparse files: reading them completely would take minutes.
    let first = c.frames[0].clone();
    std::fs::File::options().write(true).open(&first.image).unwrap().set_len(1 << 30).unwrap();
    c.frames = (0..1000).map(|i| Frame { name: i.to_string(), ..first.clone() }).collect();
    for (i, f) in c.frames.iter_mut().enumerate() {
        f.world_from_camera.translation.x += i as f64;
    }
    let start = std::time::Instant::now();
    photo_check::fit(&mut c.frames, false).unwrap();
    let took = start.elapsed().as_secs_f64();
    println!("1000 heads in {took:.3} s");
    assert!(took < 10.0, "{took} s");
}
