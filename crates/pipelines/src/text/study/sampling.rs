//! Cameras that cover text poses evenly against random ones (Cui et al. 2024, Table 2): detectors are trained on images of both kinds of the
//! same scenes, and judged on images of other scenes that cover text poses evenly.

use super::table::{self, Percent, Trial, many};
use super::work::{SceneStage, SetStage, Test, Work, usable};
use super::{Common, Studied};
use crate::error::{PipelineError, Result};
use crate::run::stages::Listeners;
use crate::text::detectors::config::Kind;
use crate::text::detectors::recipe as detection;
use crate::text::synth::sampling::Sampling;
use diorama_data::atomic;
use diorama_scenes::signs::Family;
use serde::Serialize;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Sets, in the order of the table.
const RANDOM: &str = "random";
const BALANCED: &str = "balanced";
const TEST: &str = "test";
/// Table 2: by instance and by scene.
const PAPER: [(Kind, &str, [Percent; 2]); 4] = [
    (Kind::Db, RANDOM, [[73.25, 57.22, 64.25], [71.57, 48.62, 57.90]]),
    (Kind::Db, BALANCED, [[89.89, 75.53, 82.09], [85.70, 70.36, 77.28]]),
    (Kind::East, RANDOM, [[68.13, 58.14, 62.74], [61.51, 50.08, 55.21]]),
    (Kind::East, BALANCED, [[87.39, 74.90, 80.66], [83.66, 68.22, 75.16]]),
];

/// A study of cameras.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SamplingOptions {
    #[serde(flatten)]
    pub common: Common,
    /// Scenes that detectors are tested on, and images of each.
    pub test_scenes: usize,
    pub test_images: usize,
}

/// Does the study in a folder, or goes on with it; none after an interrupt. Writes `study.json` and `study.md`.
///
/// # Errors
/// When an option cannot be or differs from those of the folder's study, or a stage fails.
pub fn study((out, force): (&Path, bool), o: &SamplingOptions, stop: &AtomicBool, listeners: Listeners) -> Result<Option<Studied>> {
    if o.test_scenes == 0 || o.test_images == 0 {
        return Err(PipelineError::Usage("--test-scenes, --test-images: expected 1 or more".into()));
    }
    let mut options = serde_json::to_value(o).expect("plain values");
    options["study"] = "sampling".into();
    let mut work = Work::begin((out, force), &options, &o.common, stop, listeners)?;
    let families = Family::ALL.iter().map(|f| f.name().to_string()).collect();
    let photographs = o.common.photographs(families, o.common.scenes + o.test_scenes)?;
    let Some(names) = work.scenes("scenes", &photographs)? else { return Ok(None) };
    let Some(fields) = work.fields("scenes", &names)? else { return Ok(None) };
    let (scenes, mut notes) = usable(&fields[..o.common.scenes])?;
    let (test_scenes, more) = usable(&fields[o.common.scenes..])?;
    notes.extend(more);
    let mut sets = Vec::new();
    for (name, sampling) in [(RANDOM, Sampling::Random), (BALANCED, Sampling::Balanced)] {
        let Some(set) = work.drawn(name, &scenes, (sampling, o.common.images, o.common.seed))? else { return Ok(None) };
        sets.push(set);
    }
    let of_test = (Sampling::Balanced, o.test_images, o.common.seed.wrapping_add(1));
    let Some(set) = work.drawn(TEST, &test_scenes, of_test)? else { return Ok(None) };
    sets.push(set);
    let test = Test { name: TEST, key: TEST.into(), images: detection::labelled(&work.set(TEST))? };
    let Some(trials) = work.trials(&[RANDOM, BALANCED], &[test])? else { return Ok(None) };
    let text = text(o, (&scenes, &test_scenes), &sets, &trials, &notes);
    let studied = Studied { study: "sampling", options, scenes, test_scenes, sets, trials, text, notes };
    atomic::write(&out.join("study.json"), &serde_json::to_vec_pretty(&studied).expect("plain values"))?;
    atomic::write(&out.join("study.md"), studied.text.as_bytes())?;
    Ok(Some(studied))
}

/// The table and what it is of.
fn text(
    o: &SamplingOptions,
    (scenes, test_scenes): (&[SceneStage], &[SceneStage]),
    sets: &[SetStage],
    trials: &[Trial],
    notes: &[String],
) -> String {
    let c = &o.common;
    let mut out = format!(
        "# Balanced against random cameras\n\n{} for training with {} each, {} for testing with {} in all that cover text poses evenly, {}. Random cameras \
are like those of the photographs. Detectors (`tiny`) learn {}. Percent: mean (least to greatest) over seeds; differences are of the same seeds.\n\n{}",
        many(scenes.len(), "scene"),
        many(c.images, "image"),
        many(test_scenes.len(), "scene"),
        many(sets.last().map_or(0, |s| s.images), "image"),
        many(c.seeds as usize, "seed"),
        c.length(),
        table::HEADS,
    );
    for model in &c.models {
        let name = model.name().to_uppercase();
        let [random, balanced] = [RANDOM, BALANCED].map(|set| table::trials(trials, *model, set, TEST));
        let paper = |set: &str| PAPER.iter().find(|p| p.0 == *model && p.1 == set).map(|p| p.2).expect("both models and sets are listed");
        let [few, even] = [RANDOM, BALANCED].map(paper);
        out += &table::row(&format!("{name} random"), &random);
        out += &table::paper_row(&format!("{name} random, paper"), few);
        out += &table::row(&format!("{name} balanced"), &balanced);
        out += &table::paper_row(&format!("{name} balanced, paper"), even);
        out += &table::difference_row(&format!("{name} balanced − random"), &balanced, &random);
        out += &table::paper_difference_row(&format!("{name} balanced − random, paper"), even, few);
    }
    out += "\nThe paper (Table 2) has 270 scenes for training and 30 for testing, 16 images of each, and networks on ResNet-50.\n\n";
    out += table::EMPTY;
    for set in sets {
        out += &format!(
            "- `{}`: {}, {}, {} not to be read; images of each cluster of text poses: {:?}\n",
            set.set,
            many(set.images, "image"),
            many(set.words, "word"),
            set.unreadable,
            set.clusters
        );
    }
    let mean = |f: &dyn Fn(&SceneStage) -> Option<f64>| {
        let known: Vec<f64> = scenes.iter().chain(test_scenes).filter_map(f).collect();
        known.iter().sum::<f64>() / known.len() as f64
    };
    out += &format!(
        "- fields of the scenes that are used, means where they are known: {:.1} dB, mIoU {:.2}, corners of labels {:.2} px off\n",
        mean(&|s| Some(s.psnr)),
        mean(&|s| s.miou),
        mean(&|s| s.corner_error_px)
    );
    notes.iter().chain(sets.iter().flat_map(|s| &s.notes)).for_each(|n| out += &format!("- {n}\n"));
    out
}

#[cfg(test)]
mod tests {
    use super::super::Limit;
    use super::super::table::tests::trial;
    use super::*;
    use crate::error::PipelineError;
    use std::cell::Cell;

    fn options() -> SamplingOptions {
        let common = Common::small(Kind::Db, 2, Limit { steps: 4, seconds: 0.0 });
        SamplingOptions { common, test_scenes: 1, test_images: 4 }
    }

    fn stage(scene: &str, left_out: Option<&str>) -> SceneStage {
        SceneStage { scene: scene.into(), psnr: 25.0, miou: Some(0.5), corner_error_px: Some(1.0), left_out: left_out.map(String::from) }
    }

    fn set(name: &str) -> SetStage {
        SetStage { set: name.into(), images: 6, words: 9, unreadable: 1, clusters: vec![3, 3], notes: Vec::new() }
    }

    #[test]
    fn the_table_stands_beside_the_papers_and_says_what_it_is_of() {
        let trials = [(RANDOM, 0, 40.0), (RANDOM, 1, 50.0), (BALANCED, 0, 60.0), (BALANCED, 1, 54.0)];
        let trials: Vec<Trial> = trials.map(|(set, seed, f)| trial(Kind::Db, set, seed, [f; 3])).into();
        let sets = [set(RANDOM), set(BALANCED), set(TEST)];
        let (scenes, test) = (vec![stage("room-000", None), stage("street-001", None)], [stage("shelf-002", None)]);
        let text = text(&options(), (&scenes, &test), &sets, &trials, &["pillar-003 is left out: fog".into()]);
        for expected in [
            "2 scenes for training with 3 images each, 1 scene for testing with 6 images in all that cover text poses evenly, 2 seeds.",
            "learn for 4 steps",
            "| DB random | 45.0 (40.0 to 50.0) |",
            "| DB random, paper | 73.25 | 57.22 | 64.25 | 71.57 | 48.62 | 57.90 |",
            "| DB balanced − random | +12.0 (+4.0 to +20.0) |",
            "| DB balanced − random, paper | +16.64 | +18.31 | +17.84 | +14.13 | +21.74 | +19.38 |",
            "- pillar-003 is left out: fog",
        ] {
            assert!(text.contains(expected), "{expected:?} is not in\n{text}");
        }
        assert!(!text.contains("EAST"));
    }

    #[test]
    fn scenes_without_cameras_are_left_out_and_told() {
        let (kept, notes) = usable(&[stage("a", None), stage("b", Some("fog"))]).unwrap();
        assert_eq!((kept.len(), &notes[..]), (1, &["b is left out: fog".to_string()][..]));
        let e = usable(&[stage("b", Some("fog"))]).unwrap_err();
        assert!(e.is_input() && e.to_string().contains("no scene") && e.to_string().contains("fog"), "{e}");
    }

    #[test]
    fn wrong_and_changed_options_are_named_before_any_work() {
        let dir = tempfile::tempdir().unwrap();
        let stages = Cell::new(0);
        let call = |o: &SamplingOptions, stop: bool| {
            let listeners = Listeners { stage: &mut |_| stages.set(stages.get() + 1), share: &mut |_| (), events: &mut |_| () };
            study((dir.path(), false), o, &AtomicBool::new(stop), listeners)
        };
        let refused = |change: &dyn Fn(&mut SamplingOptions), expected: &str| {
            let mut o = options();
            change(&mut o);
            let e = call(&o, false).map(|_| ()).unwrap_err();
            assert!(matches!(e, PipelineError::Usage(_)) && e.to_string().contains(expected), "{e}");
        };
        refused(&|o| o.test_scenes = 0, "--test-scenes");
        refused(&|o| o.common.limit.steps = 0, "--seconds: expected a number above 0");
        refused(&|o| o.common.scenes = 0, "--scenes 0");
        assert!(call(&options(), true).unwrap().is_none(), "interrupted");
        assert_eq!(stages.get(), 1);
        refused(&|o| (o.common.images, o.test_images) = (5, 7), "holds a study of other images, test_images");
        assert_eq!(stages.get(), 1);
        let mut more = options();
        (more.common.seeds, more.common.models) = (3, vec![Kind::East]);
        assert!(call(&more, true).unwrap().is_none(), "more detectors may be asked for");
    }
}
