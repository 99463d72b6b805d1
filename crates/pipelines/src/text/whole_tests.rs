//! From a generated scene to data sets, on one run.

use super::edit::drawing::Blend;
use super::edit::ground::Eraser;
use super::edit::{self, Change, Edit, EditOptions};
use super::field::config::{Config, Preset};
use super::field::{model::TextModel, recipe, scores};
use super::label::fitting::FitOptions;
use super::label::{self, Cameras, LabelOptions, Labeler};
use super::make_scenes::{SceneOptions, generate};
use super::placed;
use super::styling::MaskMode;
use super::synth::dataset::{self, Synthesized};
use super::synth::journal::JOURNAL;
use super::synth::merging;
use super::synth::plan::{Scenes, Shard, SynthOptions};
use super::synth::sampling::Sampling;
use super::synth::{refusal_tests, styled_tests};
use super::viewing;
use crate::run::RunFolder;
use crate::run::viewing::ViewedModel;
use diorama_data::text_set::{self, SetFormat};
use diorama_geom::view_controls::{ControlValue, ControlValues, check_lists};
use diorama_geom::view_source::ViewRequest;
use std::path::Path;
use std::sync::atomic::AtomicBool;

static ON: AtomicBool = AtomicBool::new(false);

fn judge(model: &TextModel) -> scores::Scores {
    let mut seen = 0;
    let s = scores::evaluate(model, &mut |_, sheet| {
        assert_eq!((sheet.width, sheet.height), (4 * 96, 72));
        seen += 1;
        Ok(())
    });
    assert_eq!(seen, 2);
    s.unwrap()
}

/// Trains a run of a small room.
fn trained(folder: &Path) -> std::path::PathBuf {
    let made = generate(folder, &SceneOptions::named("ci").unwrap(), false, &ON, &mut |_| ()).unwrap();
    let mut config = Config::new(Preset::Ci, folder.join(&made.scenes[0]));
    config.device = "cpu".into();
    config.run.steps = 480;
    let path = folder.join("run");
    let mut run = RunFolder::create(&path, false).unwrap();
    let trained = recipe::train(&config, &mut run, false, &ON, &mut |_| ()).unwrap();
    let s = judge(&trained.model);
    assert!(s.psnr > 24.0 && s.ssim > 0.7 && s.miou.is_some_and(|m| m > 0.5) && s.depth_error.is_some_and(|d| d < 0.2), "{s:?}");
    let (again, _) = recipe::load(&path, None).unwrap();
    assert_eq!(judge(&again), s, "what was saved is what was trained");
    path
}

fn options(sampling: Sampling) -> SynthOptions {
    SynthOptions {
        count: 6,
        size: (160, 120),
        sampling,
        clusters: 3,
        only: Vec::new(),
        prior: None,
        formats: vec![SetFormat::Icdar15, SetFormat::Mmocr],
        seed: 5,
        styles: Vec::new(),
        mask: MaskMode::default(),
    }
}

fn set(out: &Path, run: &Path, o: &SynthOptions, shard: Shard) -> Synthesized {
    dataset::synthesize(out, (&Scenes::read(run).unwrap(), o, shard), false, &ON, &mut |_, _| ()).unwrap()
}

fn bytes(folder: &Path, file: &str) -> Vec<u8> {
    std::fs::read(folder.join(file)).unwrap_or_else(|e| panic!("{}: {file}: {e}", folder.display()))
}

#[test]
fn a_scene_becomes_labels_edits_and_data_sets() {
    let dir = tempfile::tempdir().unwrap();
    let early = edit::edit(&dir.path().join("none"), None, &edits(Change::Erase), &ON, &mut |_, _| ());
    assert!(early.unwrap_err().is_input());
    let run = trained(dir.path());
    let e = placed::read(&run).unwrap_err().to_string();
    assert!(e.contains("regions.json: is missing; run `diorama text label"), "{e}");
    // Labels of all photographs.
    let labels = LabelOptions {
        labeler: Labeler::Surfaces(FitOptions::default()),
        cameras: Cameras::All,
        formats: vec![SetFormat::Icdar15],
        out: dir.path().join("labels"),
    };
    let done = label::label(&run, None, &labels, &ON, &mut |_, _| ()).unwrap();
    let a = done.accuracy.clone().unwrap();
    assert!(done.images == 14 && done.regions == 2 && a.labelled > 10, "{done:?}");
    let within = |v: Option<f64>, most: f64| v.is_some_and(|v| v < most);
    assert!(within(a.corner_error_px, 1.5) && within(a.pose_error_deg, 8.0) && within(a.center_error, 0.05), "{a:?}");
    assert!(a.visibility_error < 0.25, "{a:?}");
    assert_eq!(text_set::read(&labels.out).unwrap().len(), 14);
    // The same from photograph to photograph, without regions in space.
    let stereo = LabelOptions { labeler: Labeler::Stereo, out: dir.path().join("stereo"), ..labels.clone() };
    let done = label::label(&run, None, &stereo, &ON, &mut |_, _| ()).unwrap();
    let a = done.accuracy.clone().unwrap();
    assert!(done.regions == 0 && a.labelled > 5 && within(a.corner_error_px, 2.0) && a.pose_error_deg.is_none(), "{done:?}");
    assert!(text_set::read(&stereo.out).unwrap().iter().flat_map(|i| &i.words).all(|w| w.pose.is_none()));
    // Edits: only what they cover changes.
    let made = edit::edit(&run, None, &edits(Change::Words(2)), &ON, &mut |_, _| ()).unwrap();
    assert!(made.edits.len() >= 2, "{made:?}");
    let edit = Edit::read(&run, &made.edits[0]).unwrap();
    assert!(edit.words.len() == 1 && !edit.words[0].characters.is_empty() && edit.colors.len() == edit.directions.len());
    let share = |k: usize| edit.shares.data.chunks_exact(2).map(|s| s[k]).sum::<f32>() / (edit.shares.data.len() / 2) as f32;
    assert!(share(0) > share(1) && share(1) > 0.02 && share(0) < 0.9, "{} {}", share(0), share(1));
    let texts = |text: &str| edit::edit(&run, None, &edits(Change::Text(text.into())), &ON, &mut |_, _| ()).unwrap().edits;
    let (first, second) = (texts("Oslo"), texts("Rome"));
    assert!(first != second && texts("Oslo") == first, "another text is another edit: {first:?} {second:?}");
    first.iter().chain(&second).for_each(|name| std::fs::remove_dir_all(run.join(edit::EDITS).join(name)).unwrap());
    let mut wrong = edits(Change::Erase);
    wrong.regions = vec![7];
    let e = edit::edit(&run, None, &wrong, &ON, &mut |_, _| ()).unwrap_err().to_string();
    assert!(e.contains("--region 7: the run has 0 ("), "{e}");
    in_the_viewer(&run);
    data_sets(dir.path(), &run);
    refusal_tests::check(dir.path(), &run, &options(Sampling::Balanced));
    styled_tests::check(dir.path(), &run, &options(Sampling::Balanced));
}

fn edits(change: Change) -> EditOptions {
    EditOptions { regions: Vec::new(), change, font: None, eraser: Eraser::PatchMatch, blend: Blend::Alpha, color: None, seed: 1 }
}

/// The viewer shows regions and other writing on them.
fn in_the_viewer(run: &Path) {
    let shown = viewing::open(run, recipe::load(run, None).unwrap().0).unwrap().model();
    let controls = shown.controls();
    check_lists(&shown.layers(), &controls).unwrap();
    let frame = &shown.capture().frames[0];
    let picture = |layer: &str, given: &[(&str, ControlValue)]| {
        let given = given.iter().map(|(id, v)| (id.to_string(), v.clone()));
        let values = ControlValues::checked(&controls, given).unwrap();
        let (camera, world_from_camera) = (frame.camera, frame.world_from_camera);
        shown.view(&ViewRequest { camera, world_from_camera, layer: layer.into(), values, clip: None }).unwrap().data
    };
    let off = ("outlines", ControlValue::Switch(false));
    let without = std::slice::from_ref(&off);
    let plain = picture("rgb", without);
    assert!(picture("rgb", &[]) != plain && picture("classes", without) != plain && picture("depth", without) != plain);
    let edits = Edit::names(run).unwrap();
    let control = format!("writing_{}", Edit::head(run, &edits[0]).unwrap().region);
    let edited = picture("rgb", &[off, (&control, ControlValue::Choice(edits[0].clone()))]);
    let changed = edited.chunks_exact(3).zip(plain.chunks_exact(3)).filter(|(a, b)| a != b).count();
    assert!(changed > 10 && changed < plain.len() / 6, "{changed}");
}

/// Data sets are the same in one piece, in shards, and after an interruption.
fn data_sets(dir: &Path, run: &Path) {
    let o = options(Sampling::Balanced);
    let whole = set(&dir.join("whole"), run, &o, Shard::WHOLE);
    assert!(whole.images == 6 && whole.misfits == 0 && whole.compared >= 6 && whole.words >= 6, "{whole:?}");
    let counts = whole.clusters.iter().filter(|n| **n > 0);
    assert!(counts.clone().max().unwrap() - counts.min().unwrap() <= 1, "{whole:?}");
    let shards: Vec<_> = (1..=3).map(|part| (dir.join(format!("shard-{part}")), Shard { part, of: 3 })).collect();
    shards.iter().for_each(|(out, shard)| assert_eq!(set(out, run, &o, *shard).images, 2));
    let folders: Vec<_> = shards.iter().map(|(out, _)| out.clone()).collect();
    let e = merging::merge(&dir.join("merged"), &folders[..2]).unwrap_err().to_string();
    assert!(e.contains("sample 4 of 6 is in none of the folders"), "{e}");
    merging::merge(&dir.join("merged"), &folders).unwrap();
    for file in ["annotations.jsonl", "mmocr/textdet.json", "icdar15/gt_00000003.txt", "images/00000004.png", JOURNAL] {
        assert!(bytes(&dir.join("merged"), file) == bytes(&dir.join("whole"), file), "{file}");
    }
    // A journal whose last line was cut, an image that was damaged, and one that was lost.
    let cut = dir.join("cut");
    set(&cut, run, &o, Shard::WHOLE);
    let journal = bytes(&cut, JOURNAL);
    std::fs::write(cut.join(JOURNAL), &journal[..journal.len() - 40]).unwrap();
    std::fs::write(cut.join("images/00000001.png"), b"damaged").unwrap();
    std::fs::remove_file(cut.join("images/00000002.png")).unwrap();
    std::fs::remove_file(cut.join("annotations.jsonl")).unwrap();
    set(&cut, run, &o, Shard::WHOLE);
    for file in ["annotations.jsonl", "images/00000001.png", "images/00000002.png", "images/00000005.png"] {
        assert!(bytes(&cut, file) == bytes(&dir.join("whole"), file), "{file}");
    }
    let other = SynthOptions { seed: 6, clusters: 2, ..o };
    let again = dataset::synthesize(&cut, (&Scenes::read(run).unwrap(), &other, Shard::WHOLE), false, &ON, &mut |_, _| ());
    let e = again.unwrap_err().to_string();
    assert!(e.contains("holds a data set of other options.clusters, options.seed; give --force"), "{e}");
    assert_eq!(set(&dir.join("random"), run, &options(Sampling::Random), Shard::WHOLE).images, 6);
}
