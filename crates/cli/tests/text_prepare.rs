//! `text prepare` chooses sharp frames and finds their poses; what is wrong is refused in one line. A stand-in for COLMAP returns the true
//! model, one for ffmpeg decodes nothing.
#![cfg(unix)]

mod colmap;

use colmap::{capture, stand_in};
use diorama_data::{import, photo, photo_import};
use diorama_geom::ImageU8;
use diorama_geom::capture::Split;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

const VIEWS: usize = 24;

/// Photographs, a model of them and a stand-in for COLMAP that returns it.
struct Shop {
    dir: tempfile::TempDir,
}

impl Shop {
    fn new() -> Shop {
        let shop = Shop { dir: tempfile::tempdir().unwrap() };
        capture(&shop.at("photos"), &shop.at("model"), VIEWS);
        stand_in(&shop.at("colmap"), &shop.at("model"));
        shop
    }

    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Exit code, messages and result of a call.
    fn prepare(&self, arguments: &[&str]) -> (Option<i32>, String, serde_json::Value) {
        let mut c = Command::new(env!("CARGO_BIN_EXE_diorama"));
        c.env("DIORAMA_COLMAP", self.at("colmap")).env("DIORAMA_FFMPEG", self.at("ffmpeg")).current_dir(self.dir.path());
        let o = c.args(["text", "prepare"]).args(arguments).arg("--json").output().unwrap();
        let said = String::from_utf8_lossy(&o.stderr).into_owned();
        (o.status.code(), said, serde_json::from_slice(&o.stdout).unwrap_or_default())
    }

    #[track_caller]
    fn fails(&self, arguments: &[&str], code: i32, parts: &[&str]) {
        let (ended, said, _) = self.prepare(arguments);
        let errors: Vec<&str> = said.lines().filter(|l| l.starts_with("diorama: ")).collect();
        assert!(ended == Some(code) && errors.len() == 1 && !said.contains("panicked"), "{ended:?}: {said}");
        parts.iter().for_each(|p| assert!(errors[0].contains(p), "{p:?} is not in {:?}", errors[0]));
    }
}

fn script(path: &Path, text: &str) {
    std::fs::write(path, format!("#!/bin/sh\n{text}\n")).unwrap();
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap();
}

/// Blurs a photograph over 9 × 9 pixels.
fn blur(folder: &Path, stem: &str) {
    let im = photo::load(&folder.join(format!("{stem}.jpg"))).unwrap();
    let (w, h, c) = (im.width as i64, im.height as i64, im.channels);
    let at = |x: i64, y: i64, k: usize| im.data[(y.clamp(0, h - 1) * w + x.clamp(0, w - 1)) as usize * c + k] as u32;
    let mean = |x: i64, y: i64, k: usize| ((0..81).map(|i| at(x + i % 9 - 4, y + i / 9 - 4, k)).sum::<u32>() / 81) as u8;
    let data = (0..w * h * c as i64).map(|i| mean(i / c as i64 % w, i / c as i64 / w, i as usize % c)).collect();
    photo_import::write(&ImageU8 { data, ..im }, folder, stem).unwrap();
}

#[test]
fn sharp_photographs_get_poses_and_fewer_than_usual_are_told() {
    let shop = Shop::new();
    for stem in ["view_05", "view_17"] {
        let copy = format!("{stem}_b");
        std::fs::copy(shop.at(&format!("photos/{stem}.jpg")), shop.at(&format!("photos/{copy}.jpg"))).unwrap();
        blur(&shop.at("photos"), &copy);
    }
    let (code, said, made) = shop.prepare(&["photos", "-o", "data"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("24 of 26 photographs are taken") && said.contains("only 24 sharp frames, 50 to 80 are usual; film longer"),
        "{said}"
    );
    assert_eq!((&made["images"], &made["registered"]), (&24.into(), &24.into()));
    assert!(!shop.at("data/images/view_05_b.jpg").exists() && !shop.at("data/images/view_17_b.jpg").exists());
    let given = import::import(&shop.at("data"), &Default::default()).unwrap();
    assert_eq!(given.frames.iter().filter(|f| f.split == Split::Test).count(), VIEWS.div_ceil(7));
    // A capture with poses is taken as it is.
    std::fs::remove_file(shop.at("colmap")).unwrap();
    let (code, said, made) = shop.prepare(&["data", "-o", "again"]);
    assert!(code == Some(0) && made["registered"] == 24, "{said}");
    shop.fails(&["photos", "-o", "new", "--sfm", "glomap"], 2, &["sfm \"glomap\": expected auto, colmap or none"]);
    shop.fails(&["photos", "-o", "new", "--frames", "19"], 2, &["frames 19: must be at least 20"]);
    assert!(!shop.at("new").exists());
}

#[test]
fn too_few_sharp_frames_are_refused_with_count_threshold_and_advice() {
    let shop = Shop::new();
    (0..VIEWS).step_by(4).for_each(|i| blur(&shop.at("photos"), &format!("view_{i:02}")));
    let expected = ["photos: 18 sharp frames are not enough; at least 20 are needed, 50 to 80 are usual; film longer, more slowly"];
    shop.fails(&["photos", "-o", "data"], 2, &expected);
}

#[test]
fn a_film_that_cannot_be_decoded_is_named_with_frame_and_decoders_words() {
    let shop = Shop::new();
    std::fs::write(shop.at("walk.mp4"), b"no film").unwrap();
    script(&shop.at("ffmpeg"), "[ \"$1\" = -version ] && echo 'ffmpeg version 7.1' && exit 0\necho 'moov atom not found' >&2\nexit 1");
    let expected = ["walk.mp4: its first frame cannot be decoded: ", "moov atom not found", "convert it to MP4"];
    shop.fails(&["walk.mp4", "-o", "data"], 2, &expected);
    // A film that ends in the middle of its second picture: too few frames, and where it ends.
    script(
        &shop.at("ffmpeg"),
        "[ \"$1\" = -version ] && echo 'ffmpeg version 7.1' && exit 0\nfor a; do last=$a; done\n\
         if [ \"$last\" = - ]; then printf 'P5\\n3 3\\n255\\nabcdefghiP5\\n3 3\\n255\\nabc'; echo 'partial file' >&2; exit 1; fi\n\
         cp photos/view_00.jpg \"$(printf \"$last\" 1)\"",
    );
    let (code, said, _) = shop.prepare(&["walk.mp4", "-o", "part"]);
    assert!(
        code == Some(2) && said.contains("can be decoded up to frame 1 only, the rest is missing") && said.contains("partial file"),
        "{said}"
    );
    assert!(said.contains("walk.mp4: 1 sharp frames are not enough"), "{said}");
}

#[test]
fn colmap_missing_or_failing_is_told_with_command_log_and_another_way() {
    let shop = Shop::new();
    script(&shop.at("colmap"), "[ \"$2\" = -h ] && exit 0\necho 'out of luck in line 7'\nexit 3");
    let expected = ["colmap: feature_extractor failed (exit status: 3): out of luck in line 7; see ", "colmap.log", "--sfm none"];
    shop.fails(&["photos", "-o", "data"], 1, &expected);
    std::fs::remove_file(shop.at("colmap")).unwrap();
    shop.fails(&["photos", "-o", "new"], 2, &["DIORAMA_COLMAP: no such program", "--sfm none"]);
    assert!(!shop.at("new").exists());
}

#[test]
fn photographs_without_poses_are_named_where_they_are_too_many() {
    let shop = Shop::new();
    for i in 0..8 {
        std::fs::copy(shop.at(&format!("photos/view_{i:02}.jpg")), shop.at(&format!("photos/view_{i:02}_b.jpg"))).unwrap();
    }
    let expected = ["COLMAP found poses for 24 of 32 photographs (75 %, at least 80 % are wanted)", "view_00_b.jpg, view_01_b.jpg"];
    shop.fails(&["photos", "-o", "data"], 1, &expected);
    let (code, said, made) = shop.prepare(&["photos", "-o", "data", "--resume", "--min-registered", "70"]);
    assert!(code == Some(0) && made["registered"] == 24, "{said}");
}
