//! Images of fields against words pasted onto photographs (after Cui et al. 2024, Table 1): detectors are trained on images of both kinds of
//! the same scenes, and judged on photographs of a family of scenes that neither saw, and on the user's own.

use super::pasted::{self, Ground};
use super::table::{self, Trial, many};
use super::work::{SceneStage, SetStage, Test, Work, usable};
use super::{Common, Studied, real};
use crate::error::{PipelineError, Result};
use crate::run::stages::Listeners;
use crate::text::fnv;
use crate::text::lettering::Fonts;
use crate::text::make_scenes::SceneOptions;
use crate::text::synth::plan::place;
use crate::text::synth::sampling::{Sampling, sample_seed};
use crate::text::truth;
use diorama_data::text_set::detector_set::{DetectorImage, DetectorLabel};
use diorama_data::text_set::{self, SetFormat, SetImage};
use diorama_data::{DataError, atomic, import, photo, text_labels};
use diorama_geom::capture::Split;
use diorama_scenes::signs::Family;
use rayon::prelude::*;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Sets, in the order of the table.
const PASTED: &str = "pasted";
const OURS: &str = "ours";
/// Tests, and photographs of each scene of the first.
const GENERATED: &str = "generated";
const REAL: &str = "real";
const TEST_VIEWS: usize = 20;
/// Images that are pasted between looks at interrupts.
const CHUNK: usize = 32;

/// A study of pasting.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PastingOptions {
    #[serde(flatten)]
    pub common: Common,
    /// Family of the photographs that detectors are tested on; the others are trained on.
    pub test_family: String,
    pub test_images: usize,
    /// Labelled photographs that detectors are tested on too.
    pub real: Option<PathBuf>,
}

/// Does the study in a folder, or goes on with it; none after an interrupt. Writes `study.json` and `study.md`.
///
/// # Errors
/// When an option cannot be or differs from those of the folder's study, or a stage fails.
pub fn study((out, force): (&Path, bool), o: &PastingOptions, stop: &AtomicBool, listeners: Listeners) -> Result<Option<Studied>> {
    let families = families(o)?;
    let real = o.real.as_deref().map(real_test).transpose()?;
    let mut options = serde_json::to_value(o).expect("plain values");
    options["study"] = "pasting".into();
    let mut work = Work::begin((out, force), &options, &o.common, stop, listeners)?;
    // Words are pasted in pixels of the photographs, so these have the size of all images.
    let photographs = SceneOptions { size: o.common.size, ..o.common.photographs(families, o.common.scenes)? };
    let Some(names) = work.scenes("scenes", &photographs)? else { return Ok(None) };
    let Some(test) = generated_test(&mut work, o)? else { return Ok(None) };
    let Some(fields) = work.fields("scenes", &names)? else { return Ok(None) };
    let (scenes, notes) = usable(&fields)?;
    let balanced = (Sampling::Balanced, o.common.images, o.common.seed);
    let Some(ours) = work.drawn(OURS, &scenes, balanced)? else { return Ok(None) };
    let Some(pasted) = paste(&mut work, &scenes)? else { return Ok(None) };
    let (sets, tests) = (vec![pasted, ours], [Some(test), real].into_iter().flatten().collect::<Vec<Test>>());
    let Some(trials) = work.trials(&[PASTED, OURS], &tests)? else { return Ok(None) };
    let text = text(o, &scenes, &sets, (&tests, &trials), &notes);
    let studied = Studied { study: "pasting", options, scenes, test_scenes: Vec::new(), sets, trials, text, notes };
    atomic::write(&out.join("study.json"), &serde_json::to_vec_pretty(&studied).expect("plain values"))?;
    atomic::write(&out.join("study.md"), studied.text.as_bytes())?;
    Ok(Some(studied))
}

/// Families that detectors are trained on.
fn families(o: &PastingOptions) -> Result<Vec<String>> {
    let names = || Family::ALL.iter().map(|f| f.name().to_string());
    if Family::named(&o.test_family).is_none() {
        let names = names().collect::<Vec<_>>().join(", ");
        return Err(PipelineError::Usage(format!("--test-family {:?}: expected {names}", o.test_family)));
    }
    if o.test_images == 0 {
        return Err(PipelineError::Usage("--test-images 0: expected 1 or more".into()));
    }
    Ok(names().filter(|f| *f != o.test_family).collect())
}

/// The user's photographs.
fn real_test(folder: &Path) -> Result<Test> {
    let at = std::path::absolute(folder).unwrap_or_else(|_| folder.to_path_buf());
    let key = format!("{REAL}-{:016x}", fnv::hash(at.to_string_lossy().bytes()));
    Ok(Test { name: REAL, key, images: real::read(&at)? })
}

/// Photographs of the other family, with exact labels.
fn generated_test(work: &mut Work, o: &PastingOptions) -> Result<Option<Test>> {
    let c = &o.common;
    let options = c.photographs(vec![o.test_family.clone()], o.test_images.div_ceil(TEST_VIEWS))?;
    let options = SceneOptions { size: c.size, views: TEST_VIEWS, seed: c.seed.wrapping_add(1), ..options };
    let Some(names) = work.scenes("test-scenes", &options)? else { return Ok(None) };
    let mut images = Vec::new();
    for name in names {
        let scene = work.at("test-scenes").join(&name);
        for image in text_labels::load(&truth::file(&scene, "labels.jsonl"))? {
            let label = |region| DetectorLabel { region, cluster: None, quaternion: None };
            let labels = image.regions.into_iter().map(label).collect();
            images.push(DetectorImage { path: scene.join(&image.image), scene: name.clone(), labels });
        }
    }
    images.truncate(o.test_images);
    Ok(Some(Test { name: GENERATED, key: GENERATED.into(), images }))
}

/// The training photographs of a scene without their writing.
fn grounds(folder: &Path, scene: &str) -> Result<Vec<Ground>> {
    let capture = import::import(folder, &import::ImportOptions::default())?;
    let ground = |frame: &usize| {
        let f = &capture.frames[*frame];
        let name = f.image.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let ink = photo::load_mask(&truth::file(folder, &format!("{name}_ink.png")))?;
        let picture = pasted::erased(&photo::load(&f.image)?, &ink)?;
        Ok(Ground { scene: scene.into(), picture, camera: f.camera, world_from_camera: f.world_from_camera })
    };
    capture.indices(Split::Train).par_iter().map(ground).collect()
}

/// Pastes words onto photographs of scenes, as many images of each as are drawn of its field.
fn paste(work: &mut Work, scenes: &[SceneStage]) -> Result<Option<SetStage>> {
    let (count, seed) = (work.common.images * scenes.len(), work.common.seed);
    (work.listeners.stage)(&format!("{PASTED}: {count} images of {} scenes", scenes.len()));
    let (out, photographs) = (work.set(PASTED), work.at("scenes"));
    let Work { folder, stop, listeners, .. } = work;
    folder.once(&format!("set-{PASTED}"), &out.join(text_set::ANNOTATIONS), || {
        let all = scenes.iter().map(|s| grounds(&photographs.join(&s.scene), &s.scene)).collect::<Result<Vec<_>>>()?;
        let Some(images) = pasted_set(&out, &all, (count, seed), stop, listeners.share)? else { return Ok(None) };
        let words = images.iter().map(|i| i.words.len()).sum();
        Ok(Some(SetStage { set: PASTED.into(), images: count, words, unreadable: 0, clusters: Vec::new(), notes: Vec::new() }))
    })
}

/// Writes a set of pasted images; none after an interrupt. The same seed gives the same set.
///
/// # Errors
/// When a file cannot be written.
fn pasted_set(
    out: &Path,
    grounds: &[Vec<Ground>],
    (count, seed): (usize, u64),
    stop: &AtomicBool,
    share: &mut dyn FnMut(f64),
) -> Result<Option<Vec<SetImage>>> {
    let folder = out.join("images");
    std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
    let faces = Fonts::shipped().latin();
    let image = |fonts: &mut Fonts, sample: usize| -> Result<SetImage> {
        let (scene, index) = place(sample, count, grounds.len());
        let ground = &grounds[scene][index % grounds[scene].len()];
        let own = sample_seed(seed, &ground.scene, index);
        let made = pasted::paste(&ground.picture, fonts, &faces, own)?;
        let record = pasted::record(&format!("{sample:08}"), ground, made.words, own);
        text_set::check(&record).map_err(|e| PipelineError::Usage(format!("image {sample}: {e}")))?;
        photo::save_png(&out.join(&record.image), &made.picture)?;
        Ok(record)
    };
    let samples: Vec<usize> = (0..count).collect();
    let mut images = Vec::new();
    for chunk in samples.chunks(CHUNK) {
        if stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
        share(images.len() as f64 / count as f64);
        images.extend(chunk.par_iter().map_init(Fonts::shipped, |fonts, k| image(fonts, *k)).collect::<Result<Vec<_>>>()?);
    }
    text_set::write(out, &images, &[SetFormat::Icdar15])?;
    text_set::save(out, &images)?;
    Ok(Some(images))
}

/// The table and what it is of.
fn text(o: &PastingOptions, scenes: &[SceneStage], sets: &[SetStage], (tests, trials): (&[Test], &[Trial]), notes: &[String]) -> String {
    let c = &o.common;
    let mut out = format!(
        "# Images of fields against pasted words\n\n{} of families other than `{}` with {} each, {}. Detectors (`tiny`) learn {}. Percent: \
mean (least to greatest) over seeds; differences are of the same seeds.\n",
        many(scenes.len(), "scene"),
        o.test_family,
        many(c.images, "image"),
        many(c.seeds as usize, "seed"),
        c.length(),
    );
    for test in tests {
        let what = match test.name {
            GENERATED => format!("photographs of generated scenes of the family `{}`", o.test_family),
            _ => o.real.as_deref().map(|r| r.display().to_string()).unwrap_or_default(),
        };
        out += &format!("\nTested on {} ({what}):\n\n{}", many(test.images.len(), "image"), table::HEADS);
        for model in &c.models {
            let name = model.name().to_uppercase();
            let [less, more] = [PASTED, OURS].map(|set| table::trials(trials, *model, set, test.name));
            out += &table::row(&format!("{name} pasted"), &less);
            out += &table::row(&format!("{name} ours"), &more);
            out += &table::difference_row(&format!("{name} ours − pasted"), &more, &less);
        }
    }
    out += "\nThe paper (Table 1) compares 10,000 images of each data set by F on ICDAR 2013, ICDAR 2015 and MLT 2017: words on photographs \
(VISD) 68.81, 62.08, 44.49 with DB and 68.78, 64.96, 43.41 with EAST; TextNeRF 70.21, 66.41, 53.72 and 70.13, 68.73, 53.22.\n\n";
    out += table::EMPTY;
    for set in sets {
        out += &format!("- `{}`: {}, {}, {} not to be read\n", set.set, many(set.images, "image"), many(set.words, "word"), set.unreadable);
    }
    notes.iter().chain(sets.iter().flat_map(|s| &s.notes)).for_each(|n| out += &format!("- {n}\n"));
    out
}

#[cfg(test)]
mod tests {
    use super::super::Limit;
    use super::super::table::tests::trial;
    use super::*;
    use crate::text::detectors::config::Kind;
    use crate::text::make_scenes;
    use diorama_geom::glam::{DMat3, DVec3};
    use diorama_geom::{Camera, ImageU8, Lens, Pose};

    fn ground(scene: &str) -> Ground {
        let camera = Camera { width: 96, height: 72, fx: 90.0, fy: 90.0, cx: 48.0, cy: 36.0, lens: Lens::Pinhole };
        Ground {
            scene: scene.into(),
            picture: ImageU8 { width: 96, height: 72, channels: 3, data: (0..96 * 72 * 3).map(|i| (i / 300 % 256) as u8).collect() },
            camera,
            world_from_camera: Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO },
        }
    }

    #[test]
    fn a_pasted_set_is_the_same_for_the_same_seed() {
        let make = |seed: u64| {
            let dir = tempfile::tempdir().unwrap();
            let grounds = [vec![ground("a"), ground("a")], vec![ground("b")]];
            let images = pasted_set(dir.path(), &grounds, (5, seed), &AtomicBool::new(false), &mut |_| ()).unwrap().unwrap();
            assert_eq!(images.iter().map(|i| &i.scene[..]).collect::<Vec<_>>(), ["a", "a", "b", "b", "b"]);
            assert_eq!(text_set::read(dir.path()).unwrap(), images);
            let set = crate::text::detectors::recipe::labelled(dir.path()).unwrap();
            assert_eq!(set.iter().map(|i| i.labels.len()).sum::<usize>(), images.iter().map(|i| i.words.len()).sum::<usize>());
            let bytes: Vec<Vec<u8>> = images.iter().map(|i| std::fs::read(dir.path().join(&i.image)).unwrap()).collect();
            (bytes, std::fs::read(dir.path().join(text_set::ANNOTATIONS)).unwrap())
        };
        let first = make(4);
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert!(one.install(|| make(4)) == first, "also on one thread");
        assert!(make(5) != first);
        let dir = tempfile::tempdir().unwrap();
        assert!(pasted_set(dir.path(), &[vec![ground("a")]], (2, 0), &AtomicBool::new(true), &mut |_| ()).unwrap().is_none());
    }

    #[test]
    fn grounds_are_training_photographs_without_their_ink() {
        let dir = tempfile::tempdir().unwrap();
        let ci = SceneOptions::named("ci").unwrap();
        let o = SceneOptions { families: vec!["shelf".into()], views: 8, size: (96, 72), samples: 1, ..ci };
        let made = make_scenes::generate(dir.path(), &o, false, &AtomicBool::new(false), &mut |_| ()).unwrap();
        let scene = dir.path().join(&made.scenes[0]);
        let names: Vec<String> = truth::Truth::read(&scene).unwrap().views.into_iter().filter(|v| !v.held_out).map(|v| v.name).collect();
        let grounds = grounds(&scene, "a").unwrap();
        assert_eq!((grounds.len(), names.len()), (7, 7));
        let (mut inked, mut changed) = (0, 0);
        for (ground, name) in grounds.iter().zip(names) {
            let photograph = photo::load(&scene.join(format!("images/{name}.png"))).unwrap();
            let ink = photo::load_mask(&truth::file(&scene, &format!("{name}_ink.png"))).unwrap();
            let off = |i: usize| (0..3).any(|c| ground.picture.data[3 * i + c].abs_diff(photograph.data[3 * i + c]) > 12);
            let near =
                |i: usize| (0..ink.data.len()).any(|k| ink.data[k] > 0 && (k % 96).abs_diff(i % 96).max((k / 96).abs_diff(i / 96)) <= 2);
            assert!((0..ink.data.len()).filter(|i| off(*i)).all(near), "photograph {name} is changed away from its ink");
            let strong = (0..ink.data.len()).filter(|i| ink.data[*i] > 200);
            inked += strong.clone().count();
            changed += strong.filter(|i| off(*i)).count();
        }
        assert!(inked > 100 && changed * 10 > inked * 8, "{changed} of {inked} pixels of ink are gone");
    }

    fn options() -> PastingOptions {
        let common = Common::small(Kind::East, 1, Limit { steps: 0, seconds: 2.5 });
        PastingOptions { common, test_family: "street".into(), test_images: 4, real: None }
    }

    #[test]
    fn the_table_has_both_sets_and_their_difference() {
        let trials = [(PASTED, 20.0), (OURS, 45.0)].map(|(set, f)| Trial { test: GENERATED, ..trial(Kind::East, set, 0, [f; 3]) });
        let scene = SceneStage { scene: "room-000".into(), psnr: 25.0, miou: None, corner_error_px: Some(1.0), left_out: None };
        let tests = [Test { name: GENERATED, key: GENERATED.into(), images: Vec::new() }];
        let text = text(&options(), &[scene], &[], (&tests, &trials), &[]);
        for expected in [
            "1 scene of families other than `street` with 3 images each, 1 seed. Detectors (`tiny`) learn for 2.5 s.",
            "(photographs of generated scenes of the family `street`)",
            "| EAST pasted | 20.0 (20.0 to 20.0) |",
            "| EAST ours − pasted | +25.0 (+25.0 to +25.0) |",
        ] {
            assert!(text.contains(expected), "{expected:?} is not in\n{text}");
        }
    }

    #[test]
    fn families_are_others_than_the_tests() {
        assert_eq!(families(&options()).unwrap(), ["room", "corridor", "shelf", "pillar"]);
        let e = families(&PastingOptions { test_family: "cave".into(), ..options() }).unwrap_err();
        assert!(e.to_string().contains("--test-family \"cave\": expected room, corridor, street, shelf, pillar"), "{e}");
    }
}
