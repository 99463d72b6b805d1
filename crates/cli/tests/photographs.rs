//! Truncated, resized and linear photographs, through the whole program.

use diorama_data::photo::{self, Photo};
use diorama_data::photo_import;
use diorama_geom::color::{linear_from_srgb, srgb_from_linear};
use diorama_geom::{Image, ImageU8};
use diorama_pipelines::object::quickstart::write_capture;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

fn diorama(args: &[&str]) -> (Option<i32>, String, Value) {
    let o = Command::new(env!("CARGO_BIN_EXE_diorama")).args(args).output().unwrap();
    let text = String::from_utf8_lossy(&o.stderr).into_owned();
    (o.status.code(), text, serde_json::from_slice(&o.stdout).unwrap_or_default())
}

fn text(p: &Path) -> &str {
    p.to_str().unwrap()
}

fn photographs(data: &Path) -> Vec<PathBuf> {
    photo_import::list(&data.join("images")).unwrap()
}

const SMALL: [&str; 10] = [
    "--device",
    "cpu",
    "--split",
    "every:8",
    "--set",
    "field.log2_size=14",
    "--set",
    "field.levels=8",
    "--set",
    "sampling.batch_samples=16384",
];

fn train(data: &Path, run: &Path, more: &[&str]) -> (Option<i32>, String, Value) {
    diorama(&[&["train", text(data), "-o", text(run), "--json"][..], &SMALL, more].concat())
}

fn eval(run: &Path) -> Value {
    let (code, said, report) = diorama(&["eval", text(run), "--device", "cpu", "--json"]);
    assert_eq!(code, Some(0), "{said}");
    report
}

/// Converts each photograph to another file format, and updates the file with the poses.
fn convert(data: &Path, extension: &str, encode: impl Fn(&ImageU8, &Path)) {
    for p in photographs(data) {
        let im = photo::load(&p).unwrap();
        std::fs::remove_file(&p).unwrap();
        encode(&im, &p.with_extension(extension));
    }
    let file = data.join("transforms.json");
    let json = std::fs::read_to_string(&file).unwrap().replace(".png\"", &format!(".{extension}\""));
    std::fs::write(file, json).unwrap();
}

fn opaque(im: &ImageU8) -> ImageU8 {
    let over = |p: &[u8]| [0, 1, 2].map(|k| ((p[k] as u32 * p[3] as u32 + 255 * (255 - p[3] as u32)) / 255) as u8);
    ImageU8 { channels: 3, data: im.data.chunks_exact(4).flat_map(over).collect(), ..im.clone() }
}

#[test]
fn photographs_that_were_cut_off_are_refused_or_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let (data, run) = (dir.path().join("data"), dir.path().join("run"));
    write_capture(&data, 16, 48).unwrap();
    convert(&data, "jpg", |im, to| {
        photo_import::write(&opaque(im), to.parent().unwrap(), to.file_stem().unwrap().to_str().unwrap()).unwrap();
    });
    let photos = photographs(&data);
    // One training photograph and one held-out photograph.
    for i in [3, 8] {
        let bytes = std::fs::read(&photos[i]).unwrap();
        std::fs::write(&photos[i], &bytes[..bytes.len() * 9 / 10]).unwrap();
    }
    let name = |i: usize| photos[i].file_name().unwrap().to_str().unwrap().to_string();
    let (code, said, _) = train(&data, &run, &["--steps", "20"]);
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains(&name(3)) && said.contains("ends early") && said.contains("--skip-broken"), "{said}");
    assert!(!run.exists(), "nothing is left behind");
    let (code, said, _) = train(&data, &run, &["--steps", "20", "--skip-broken"]);
    assert_eq!(code, Some(0), "{said}");
    let note = format!("2 broken photographs are left out: {}, {}", name(3), name(8));
    assert!(said.contains(&note), "{said}");
    // They are not part of the run: the first and the ninth would have been held out.
    assert_eq!(eval(&run)["views"], 1);
    let (code, said, _) = diorama(&["train", "--resume", "-o", text(&run), "--device", "cpu", "--steps", "30", "--skip-broken"]);
    assert_eq!(code, Some(0), "{said}");
}

#[test]
fn resized_photographs_train_and_are_scored() {
    let dir = tempfile::tempdir().unwrap();
    let (data, run) = (dir.path().join("data"), dir.path().join("run"));
    write_capture(&data, 16, 64).unwrap();
    for p in photographs(&data) {
        photo::save_png(&p, &photo::load(&p).unwrap().downsampled(32, 32)).unwrap();
    }
    let (code, said, _) = train(&data, &run, &["--steps", "300"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("32×32") && said.contains("64×64") && said.contains("scaled"), "{said}");
    let psnr = eval(&run)["psnr"].as_f64().unwrap();
    assert!(psnr > 20.0, "{psnr}");
    let (code, said, _) = diorama(&["doctor", text(&data), "--json"]);
    assert_eq!(code, Some(0), "{said}");
    for p in photographs(&data) {
        photo::save_png(&p, &photo::load(&p).unwrap().downsampled(32, 24)).unwrap();
    }
    for verb in [&["doctor", text(&data)][..], &["train", text(&data), "-o", text(&dir.path().join("no"))]] {
        let (code, said, _) = diorama(verb);
        assert_eq!(code, Some(2), "{said}");
        assert!(said.contains("32×24") && said.contains("64×64"), "{said}");
    }
}

/// Linear light of a photograph of the still life, a thousand times as bright as a screen.
fn lit(im: &ImageU8) -> Image {
    let light = |p: &[u8]| [0, 1, 2].map(|k| 1000.0 * linear_from_srgb(p[k] as f32 / 255.0).powi(2) + 2.0);
    let data = im.data.chunks_exact(4).flat_map(|p| [&light(p)[..], &[p[3] as f32 / 255.0]].concat()).collect();
    Image { width: im.width, height: im.height, channels: 4, data }
}

#[test]
fn linear_light_is_learned_beyond_white_and_rendered_with_it() {
    let dir = tempfile::tempdir().unwrap();
    let (data, run, out) = (dir.path().join("data"), dir.path().join("run"), dir.path().join("out"));
    write_capture(&data, 24, 48).unwrap();
    convert(&data, "exr", |im, to| photo::save_exr(to, &lit(im)).unwrap());
    let (code, said, _) = train(&data, &run, &["--steps", "1000"]);
    assert_eq!(code, Some(0), "{said}");
    let report = eval(&run);
    assert!(report["scored_in"].as_str().unwrap().contains("linear light"), "{report}");
    assert!(report["psnr"].as_f64().unwrap() > 20.0, "{report}");
    let (code, said, _) = diorama(&["render", text(&run), "--device", "cpu", "--path", "held-out", "--images", text(&out)]);
    assert_eq!(code, Some(0), "{said}");
    let Photo::Linear(got) = photo::load_full(&out.join("0000.exr")).unwrap() else { panic!("linear light") };
    let Photo::Linear(want) = photo::load_full(&photographs(&data)[0]).unwrap() else { panic!("linear light") };
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
    let white: f32 = config.lines().find_map(|l| l.strip_prefix("white = ")).unwrap().parse().unwrap();
    assert!((50.0..1003.0).contains(&white), "{white}");
    // Where the photograph is bright, far above 1, the render is as bright.
    let both = want.data.chunks_exact(4).zip(got.data.chunks_exact(3)).filter(|(p, _)| p[3] == 1.0);
    let bright: Vec<(f32, f32)> = both.flat_map(|(p, q)| [0, 1, 2].map(|k| (p[k], q[k]))).filter(|(want, _)| *want > 0.2 * white).collect();
    assert!(bright.len() > 50, "{}", bright.len());
    let ratio = bright.iter().map(|v| v.1).sum::<f32>() / bright.iter().map(|v| v.0).sum::<f32>();
    assert!((ratio - 1.0).abs() < 0.2, "{ratio}");
    // The PNG shows the same light along the sRGB curve, up to white.
    let png = photo::load(&out.join("0000.png")).unwrap();
    for (p, v) in png.data.iter().zip(&got.data) {
        assert!((*p as f32 - 255.0 * srgb_from_linear((v / white).clamp(0.0, 1.0))).abs() <= 0.51, "{p} {v}");
    }
}

#[test]
fn a_nan_is_told_with_file_and_pixel_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let (data, run) = (dir.path().join("data"), dir.path().join("run"));
    write_capture(&data, 8, 32).unwrap();
    convert(&data, "exr", |im, to| {
        let mut light = lit(im);
        if to.file_stem().unwrap().to_str().unwrap().ends_with('5') {
            light.data[(7 * 32 + 9) * 4] = f32::NAN;
        }
        photo::save_exr(to, &light).unwrap();
    });
    let (code, said, _) = train(&data, &run, &["--steps", "20"]);
    assert_eq!(code, Some(2), "{said}");
    let line = said.lines().last().unwrap();
    assert!(line.contains("5.exr") && line.contains("(9, 7)") && line.contains("not a number"), "{line}");
    assert!(!run.exists());
}
