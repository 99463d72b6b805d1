//! Masks in training and in scores: what they leave out, and how it can be set.

use diorama_data::photo;
use diorama_engine::renderers::volume::Quality;
use diorama_engine::train::Event;
use diorama_geom::ImageU8;
use diorama_geom::capture::{MaskMeaning, Split};
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::evaluate::{self, Report};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::quickstart::write_capture;
use diorama_pipelines::object::recipe;
use diorama_pipelines::object::run_folder;
use diorama_pipelines::run::RunFolder;
use std::path::Path;
use std::sync::atomic::AtomicBool;

const SIDE: usize = 32;

/// Photographs without alpha, and masks that keep a disc in the middle of each, never quite the same.
fn capture(dir: &Path) {
    write_capture(dir, 10, SIDE as u32).unwrap();
    std::fs::create_dir(dir.join("masks")).unwrap();
    let mut images: Vec<_> = std::fs::read_dir(dir.join("images")).unwrap().flatten().map(|e| e.path()).collect();
    images.sort();
    for (n, image) in images.iter().enumerate() {
        let im = photo::load(image).unwrap();
        let data = im.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
        photo::save_png(image, &ImageU8 { channels: 3, data, ..im }).unwrap();
        let data = (0..SIDE * SIDE).map(|i| 255 * disc(n, i % SIDE, i / SIDE) as u8).collect();
        let mask = ImageU8 { width: SIDE, height: SIDE, channels: 1, data };
        photo::save_png(&dir.join("masks").join(image.file_name().unwrap()), &mask).unwrap();
    }
}

fn disc(n: usize, x: usize, y: usize) -> bool {
    (x as f64 - 14.0 - 0.4 * n as f64).hypot(y as f64 - 16.0) < 9.0
}

/// A short run, and what it said.
fn train(data: &Path, out: &Path, overrides: &[(&str, &str)]) -> (ObjectModel, String) {
    let mut c = Config::new(Method::Ngp, data.to_path_buf());
    for (k, v) in [
        ("field.log2_size", "11"),
        ("field.levels", "4"),
        ("sampling.batch_samples", "2048"),
        ("sampling.occupancy_resolution", "16"),
        ("device", "cpu"),
        ("run.steps", "6"),
    ] {
        c.set(k, v).unwrap();
    }
    overrides.iter().for_each(|(k, v)| c.set(k, v).unwrap());
    let mut folder = RunFolder::create(out, true).unwrap();
    let mut notes = String::new();
    let mut hear = |e: &Event| {
        if let Event::Note(n) = e {
            notes += n;
        }
    };
    let made = recipe::train(&c, &mut folder, false, None, &AtomicBool::new(false), &mut hear).unwrap();
    (made.model, notes)
}

fn parameters(mut model: ObjectModel) -> Vec<u32> {
    model.entries().0.iter().flat_map(|e| e.data).map(|v| v.to_bits()).collect()
}

fn scores(model: &ObjectModel) -> Report {
    evaluate::evaluate(model, Split::Test, Quality::Full, &mut |_, _| Ok(())).unwrap()
}

#[test]
fn training_follows_each_use_and_meaning_and_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("run"));
    capture(&data);
    let (model, notes) = train(&data, &out, &[]);
    assert!(notes.contains("masks for 10 of 10") && notes.contains("empty space") && notes.contains("--mask-meaning"), "{notes}");
    assert!(model.has_alpha && model.capture.masks.meaning == MaskMeaning::Object);
    let auto = parameters(model);
    let with = |key: &str, value: &str| parameters(train(&data, &out, &[(key, value)]).0);
    assert!(auto == with("data.mask_meaning", "object"), "one object, cut out");
    let unknown = with("data.mask_meaning", "unknown");
    let [inverted, ignored] = ["invert", "ignore"].map(|v| with("data.mask", v));
    let all = [auto, unknown, inverted, ignored];
    (0..4).for_each(|i| (0..i).for_each(|j| assert!(all[i] != all[j], "{i} and {j}")));
    // A run keeps what was decided.
    let (kept, _) = train(&data, &out, &[("data.mask_meaning", "unknown")]);
    let read = run_folder::load_model(&out).unwrap().0;
    assert_eq!((read.capture.masks, read.config), (kept.capture.masks, kept.config));
}

#[test]
fn scores_count_what_masks_keep() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("run"));
    capture(&data);
    // Changes held-out photographs inside or outside of their masks.
    let spoil = |model: &ObjectModel, inside: bool| {
        for i in model.capture.indices(Split::Test) {
            let file = &model.capture.frames[i].image;
            let im = photo::load(file).unwrap();
            let change = |p: usize| disc(i, p % SIDE, p / SIDE) == inside;
            let data = im.data.iter().enumerate().map(|(k, v)| if change(k / 3) { 255 - *v } else { *v }).collect();
            photo::save_png(file, &ImageU8 { data, ..im }).unwrap();
        }
    };
    for (key, value, outside_counts) in
        [("data.mask_meaning", "unknown", false), ("data.mask_meaning", "object", false), ("data.mask", "ignore", true)]
    {
        let (model, _) = train(&data, &out, &[(key, value)]);
        let before = scores(&model);
        spoil(&model, false);
        let after = scores(&model);
        for (a, b) in [(before.psnr, after.psnr), (before.ssim, after.ssim), (before.psnr_affine, after.psnr_affine)] {
            assert_eq!((a - b).abs() > 1e-6, outside_counts, "{value}: {a} {b}");
        }
        spoil(&model, true);
        let inside = scores(&model);
        assert!((inside.psnr - after.psnr).abs() > 0.1 && (inside.ssim - after.ssim).abs() > 1e-3, "{value}");
        // As it was.
        spoil(&model, true);
        spoil(&model, false);
        assert_eq!(scores(&model).psnr, before.psnr);
    }
}

#[test]
fn an_unreadable_mask_is_an_error_that_names_it() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("run"));
    capture(&data);
    let (model, _) = train(&data, &out, &[]);
    let held_out = model.capture.indices(Split::Test)[0];
    let mask = model.capture.frames[held_out].mask.clone().unwrap();
    std::fs::write(&mask, b"no picture").unwrap();
    let e = evaluate::evaluate(&model, Split::Test, Quality::Fast, &mut |_, _| Ok(())).unwrap_err();
    assert!(e.is_input() && e.to_string().contains(mask.file_name().unwrap().to_str().unwrap()), "{e}");
    // One of another shape is not that photograph's.
    photo::save_png(&mask, &ImageU8 { width: 20, height: 30, channels: 1, data: vec![255; 600] }).unwrap();
    let e = evaluate::evaluate(&model, Split::Test, Quality::Fast, &mut |_, _| Ok(())).unwrap_err().to_string();
    assert!(e.contains("20×30") && e.contains("32×32"), "{e}");
}
