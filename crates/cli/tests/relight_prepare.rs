//! `relight prepare` of captures that have poses: NeRF-OSR's folders, and what is wrong with them.

use diorama_data::{import, photo};
use diorama_geom::ImageU8;
use diorama_geom::capture::Split;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Pose};
use std::path::Path;
use std::process::Command;

/// Six photographs to train on and two to test on, of two mornings, in NeRF-OSR's folders; cameras stand `radius` around the origin.
fn osr(root: &Path, radius: f64) {
    let camera = Camera::pinhole(32, 24, 0.9);
    for i in 0..8 {
        let part = root.join(if i < 6 { "train" } else { "test" });
        let name = format!("0{}-08_07_30_IMG_{i}", 1 + i % 2);
        let file = |folder: &str, extension: &str| {
            std::fs::create_dir_all(part.join(folder)).unwrap();
            part.join(folder).join(format!("{name}.{extension}"))
        };
        let im = ImageU8 { width: 32, height: 24, channels: 3, data: (0..32 * 24 * 3).map(|k| (k * (i + 3) % 251) as u8).collect() };
        photo::save_png(&file("rgb", "png"), &im).unwrap();
        // What moved, glass, and the rest.
        let data = (0..32 * 24).map(|k| [0, 192, 255, 255][k % 32 / 8]).collect();
        photo::save_png(&file("mask", "png"), &ImageU8 { channels: 1, data, ..im }).unwrap();
        let a = i as f64 * 0.3;
        let p = Pose::look_at(radius * DVec3::new(a.cos(), 0.2, a.sin()), DVec3::ZERO, DVec3::Y);
        let (r, t) = (p.rotation, p.translation);
        let row = |k: usize| format!("{} {} {} {}\n", r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]);
        std::fs::write(file("pose", "txt"), format!("{}{}{}0 0 0 1\n", row(0), row(1), row(2))).unwrap();
        let k = format!("{} 0 16 0\n0 {} 12 0\n0 0 1 0\n0 0 0 1\n", camera.fx, camera.fy);
        std::fs::write(file("intrinsics", "txt"), k).unwrap();
    }
}

fn prepare(source: &Path, out: &Path, more: &[&str]) -> (Option<i32>, String, serde_json::Value) {
    let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
    c.args(["relight", "prepare"]).arg(source).arg("-o").arg(out).args(["--sfm", "none", "--json"]).args(more);
    let o = c.output().unwrap();
    (o.status.code(), String::from_utf8_lossy(&o.stderr).into_owned(), serde_json::from_slice(&o.stdout).unwrap_or_default())
}

#[test]
fn nerf_osr_folders_become_a_data_set() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("site"), dir.path().join("data"));
    osr(&source, 0.7);
    let (code, text, made) = prepare(&source, &out, &[]);
    assert_eq!(code, Some(0), "{text}");
    assert_eq!((&made["photographs"], &made["sessions"], &made["held_out"]), (&8.into(), &2.into(), &2.into()));
    assert_eq!((&made["static_share"], &made["glass_share"]), (&0.75.into(), &0.25.into()));
    let read = import::import(&out, &Default::default()).unwrap();
    assert_eq!(read.frames.iter().filter(|f| f.split == Split::Test).count(), 2);
    // Up was y there.
    assert!(read.frames.iter().all(|f| (-f.world_from_camera.rotation.y_axis).z > 0.9), "{:?}", read.frames[0].world_from_camera);
    assert!(
        read.frames.iter().all(|f| (f.world_from_camera.translation.length() - 0.7 * (1.04f64).sqrt()).abs() < 1e-6 && f.mask.is_some())
    );
    let mask = photo::load(read.frames[0].mask.as_ref().unwrap()).unwrap();
    assert_eq!([4, 12, 20].map(|x| mask.pixel(x, 5)[0]), [0, 192, 255]);
    // Once more: only with leave.
    let (code, text, _) = prepare(&source, &out, &[]);
    assert!(code == Some(2) && text.contains("--force"), "{text}");
    let (code, text, _) = prepare(&source, &out, &["--force", "--up", "0,0,1", "--max-side", "16"]);
    assert!(code == Some(2) && text.contains("max-side"), "{text}");
    let (code, text, _) = prepare(&source, &out, &["--force", "--up", "0,0"]);
    assert!(code == Some(2) && text.contains("up"), "{text}");
    let (code, text, _) = prepare(&source, &out, &["--force", "--up", "0,1,0"]);
    assert_eq!(code, Some(0), "{text}");
    let turned = import::import(&out, &Default::default()).unwrap();
    assert!((turned.frames[0].world_from_camera.translation.z - 0.14).abs() < 1e-9, "{}", turned.frames[0].world_from_camera.translation);
}

#[test]
fn what_does_not_fit_is_named_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("site"), dir.path().join("data"));
    osr(&source, 1.6);
    let (code, text, _) = prepare(&source, &out, &[]);
    assert!(code == Some(2) && text.contains("1.63") && text.contains("--rescale") && text.contains("IMG_0"), "{text}");
    assert!(!out.exists());
    let pose = source.join("train/pose/01-08_07_30_IMG_4.txt");
    let kept = std::fs::read(&pose).unwrap();
    std::fs::remove_file(&pose).unwrap();
    let (code, text, _) = prepare(&source, &out, &["--rescale"]);
    assert!(code == Some(2) && text.contains("5 files for 6 photographs") && text.contains("IMG_4"), "{text}");
    std::fs::write(&pose, kept).unwrap();
    let mask = source.join("train/mask/01-08_07_30_IMG_2.png");
    photo::save_png(&mask, &ImageU8 { width: 32, height: 24, channels: 1, data: vec![0; 32 * 24] }).unwrap();
    let (code, text, _) = prepare(&source, &out, &["--rescale"]);
    assert!(code == Some(2) && text.contains("IMG_2.png") && text.contains("100 %") && text.contains("255 is static"), "{text}");
    photo::save_png(&mask, &ImageU8 { width: 32, height: 20, channels: 1, data: vec![255; 640] }).unwrap();
    let (code, text, _) = prepare(&source, &out, &["--rescale"]);
    assert!(code == Some(2) && text.contains("32×20") && text.contains("32×24"), "{text}");
    std::fs::remove_file(&mask).unwrap();
    let (code, text, _) = prepare(&source, &out, &["--rescale"]);
    assert!(code == Some(2) && text.contains("5 files for 6 photographs") && text.contains("IMG_2"), "{text}");
    for i in 0..8 {
        let file = format!("{}/mask/0{}-08_07_30_IMG_{i}.png", if i < 6 { "train" } else { "test" }, 1 + i % 2);
        let data = (0..32 * 24).map(|k| if k % 32 < 8 { 255 } else { 0 }).collect();
        photo::save_png(&source.join(file), &ImageU8 { width: 32, height: 24, channels: 1, data }).unwrap();
    }
    let (code, text, _) = prepare(&source, &out, &["--rescale"]);
    assert!(code == Some(2) && text.contains("75 %") && text.contains("inverted"), "{text}");
    assert!(!out.exists());
}

/// Paints a bluish sky onto the upper third of all photographs, of which the masks say that nothing moved.
fn paint_sky(root: &Path) {
    for part in ["train", "test"] {
        for entry in std::fs::read_dir(root.join(part).join("rgb")).unwrap().flatten() {
            let mut im = photo::load(&entry.path()).unwrap();
            im.data[..32 * 8 * 3].chunks_exact_mut(3).enumerate().for_each(|(i, p)| p.copy_from_slice(&[150, 185, 225 + (i / 32) as u8]));
            photo::save_png(&entry.path(), &im).unwrap();
            let mask = ImageU8 { width: 32, height: 24, channels: 1, data: vec![255; 32 * 24] };
            photo::save_png(&root.join(part).join("mask").join(entry.file_name()), &mask).unwrap();
        }
    }
}

#[test]
fn the_sky_is_marked_in_masks() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("site"), dir.path().join("data"));
    osr(&source, 0.7);
    paint_sky(&source);
    let (code, text, made) = prepare(&source, &out, &[]);
    assert_eq!(code, Some(0), "{text}");
    assert!((made["sky_share"].as_f64().unwrap() - 1.0 / 3.0).abs() < 0.05 && made["without_sky"] == 0, "{made}");
    let read = import::import(&out, &Default::default()).unwrap();
    assert_eq!(read.masks.meaning, diorama_geom::capture::MaskMeaning::Classes);
    for frame in &read.frames {
        let mask = photo::load(frame.mask.as_ref().unwrap()).unwrap();
        assert_eq!([2, 18].map(|y| mask.pixel(16, y)[0]), [160, 255], "{}", frame.name);
    }
    let (code, text, made) = prepare(&source, &out, &["--force", "--sky", "none"]);
    assert!(code == Some(0) && made["sky_share"].is_null(), "{text}");
    let read = import::import(&out, &Default::default()).unwrap();
    assert_eq!(photo::load(read.frames[0].mask.as_ref().unwrap()).unwrap().pixel(16, 2)[0], 255);
}
