//! The report against sets of known numbers.

use super::charts::{self, Series, Spread};
use super::failures::{self, Judging};
use super::gathered::{Gathered, facing, slope};
use super::page;
use super::{Contents, FieldQuality, LabelledSet, ReportOptions, report};
use crate::text::detectors::config::{Backbone, Config, Kind};
use crate::text::detectors::evaluation::{ClusterScore, Evaluation, Score};
use crate::text::detectors::judge::Judged;
use crate::text::detectors::network::Detector;
use crate::text::field::scores::{Scores, ViewScore};
use diorama_data::photo;
use diorama_data::text_labels::{Kind as RegionKind, LabelledImage, LabelledRegion};
use diorama_data::text_set::{self, SetImage, SetWord, WordPose};
use diorama_geom::ImageU8;
use diorama_geom::glam::{DMat3, DQuat, DVec3};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// A board that faces the camera, turned about the upright axis.
fn turned(degrees: f64) -> DMat3 {
    DMat3::from_rotation_y(degrees.to_radians()) * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0))
}

/// A word of a place and size, of a turn and a cluster.
fn word([x, y, w, h]: [f64; 4], text: &str, visibility: f64, (degrees, cluster): (f64, Option<usize>)) -> SetWord {
    let r = turned(degrees);
    let pose = [0, 1, 2].map(|k| [r.x_axis[k], r.y_axis[k], r.z_axis[k], 2.0 * (k == 2) as u8 as f64]);
    let quad = [[x, y], [x + w, y], [x + w, y + h], [x, y + h]];
    SetWord {
        id: 0,
        quad,
        polygon: quad.to_vec(),
        transcription: text.into(),
        script: None,
        ignore: text == "###",
        visibility,
        pose: Some(WordPose::new(pose, [0.9, 0.3])),
        cluster,
        characters: Vec::new(),
    }
}

fn image(number: usize, scene: &str, words: Vec<SetWord>) -> SetImage {
    SetImage {
        image: format!("images/{number:03}.png"),
        width: 100,
        height: 50,
        intrinsic: [80.0, 80.0, 50.0, 25.0],
        world_from_camera: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        scene: scene.into(),
        style: None,
        seed: None,
        words,
    }
}

/// Two images of two scenes, four words, one of them not to be read.
fn images(clusters: [Option<usize>; 2]) -> Vec<SetImage> {
    let [front, side] = clusters;
    let first = vec![
        word([0.0, 0.0, 50.0, 10.0], "CAFE", 1.0, (0.0, front)),
        word([60.0, 30.0, 10.0, 5.0], "<b>", 0.55, (4.0, front)),
        word([80.0, 40.0, 10.0, 5.0], "###", 0.2, (41.0, side)),
    ];
    vec![image(0, "a", first), image(1, "b", vec![word([0.0, 0.0, 50.0, 10.0], "Ночь", 1.0, (40.0, side))])]
}

/// The set in a folder, with gray images and labels for detectors.
fn written(folder: &Path, images: &[SetImage]) {
    std::fs::create_dir_all(folder.join("images")).unwrap();
    for image in images {
        let gray = ImageU8 { width: 100, height: 50, channels: 3, data: vec![128; 15_000] };
        photo::save_png(&folder.join(&image.image), &gray).unwrap();
    }
    text_set::write(folder, images, &[text_set::SetFormat::Icdar15]).unwrap();
    text_set::save(folder, images).unwrap();
}

#[test]
fn numbers_of_a_set_are_counted() {
    let g = Gathered::of_set("s", &images([Some(3), Some(7)]));
    assert_eq!((g.images, g.words, g.unreadable, g.scenes, g.aspect), (2, 4, 1, 2, 2.0));
    assert_eq!(g.visibility.as_deref().unwrap(), [0, 0, 1, 0, 0, 1, 0, 0, 0, 2]);
    let named = |name: &str, n: usize| (name.to_string(), n);
    assert_eq!(g.scripts, [named("Latin", 2), named("Cyrillic", 1), named("###", 1)]);
    assert_eq!((g.prior.regions, &g.prior.areas[..]), (3, &[0.01, 0.1, 0.1][..]));
    // Middles: 25, 5 twice, and 65, 32.5, of 100 × 50 in 32 cells.
    assert_eq!((g.prior.centers[3 * 32 + 8], g.prior.centers[20 * 32 + 20]), (2.0, 1.0));
    let clusters: Vec<_> = g.clusters.iter().map(|c| (c.number, c.words, c.unreadable, c.example)).collect();
    assert_eq!(clusters, [(3, 2, 0, (0, 0)), (7, 2, 1, (1, 0))], "readable words stand for clusters");
    assert!(g.are_told && g.normals.len() == 4);
    let [right, up] = facing(g.clusters[0].mean);
    assert!((right + 2.0).abs() < 1e-6 && up.abs() < 1e-6 && slope(g.clusters[0].mean).abs() < 1e-6, "{right} {up}");
    assert!((g.clusters[1].aspect - 3.0).abs() < 1e-9);
}

#[test]
fn clusters_that_are_not_told_are_found() {
    let g = Gathered::of_set("s", &images([None, None]));
    assert!(!g.are_told);
    assert_eq!(g.clusters.iter().map(|c| c.words).sum::<usize>(), 4);
    let mut unposed = images([None, None]);
    unposed.iter_mut().flat_map(|i| &mut i.words).for_each(|w| w.pose = None);
    assert!(Gathered::of_set("s", &unposed).clusters.is_empty());
}

#[test]
fn labels_of_photographs_are_counted_alike() {
    let region = |x: f64, text: &str, ignore: bool| LabelledRegion {
        id: 0,
        polygon: vec![[x, 0.0], [x + 20.0, 0.0], [x + 20.0, 10.0], [x, 10.0]],
        transcription: text.into(),
        script: None,
        kind: RegionKind::Text,
        ignore,
    };
    let labelled = LabelledImage { image: "a.png".into(), regions: vec![region(0.0, "12", false), region(40.0, "###", true)] };
    let g = Gathered::of_labels("real", &[labelled], &HashMap::from([("a.png".to_string(), (100, 100))]));
    assert_eq!((g.images, g.words, g.unreadable, &g.prior.areas[..]), (1, 2, 1, &[0.02][..]));
    assert_eq!(g.scripts, [("digits and signs".to_string(), 1), ("###".to_string(), 1)]);
    assert!(g.visibility.is_none() && g.clusters.is_empty());
}

#[test]
fn directions_are_those_that_a_reader_would_tell() {
    let of = |m: DMat3| DQuat::from_mat3(&m);
    // The right half of the board is nearer: it faces left.
    let [right, up] = facing(of(turned(30.0)));
    assert!((right + 30.0).abs() < 1e-9 && up.abs() < 1e-9);
    let tilted = DMat3::from_rotation_x(0.5) * turned(0.0);
    // Its upper half is nearer: it faces down.
    assert!((tilted * DVec3::Y).z < 0.0);
    let [right, up] = facing(of(tilted));
    assert!(right.abs() < 1e-9 && (up + 0.5f64.to_degrees()).abs() < 1e-9);
    assert!((slope(of(DMat3::from_rotation_z(0.3) * turned(0.0))) - 0.3f64.to_degrees()).abs() < 1e-9);
}

#[test]
fn bins_are_by_the_logarithm_and_keep_all_values() {
    // Four bins a decade: 1 to 1.78, 1.78 to 3.16, …
    assert_eq!(charts::log_bins(&[1.0, 1.7, 1.8, 9.9, 10.0, 99.0, 1e-9, 1e9, 0.0], [0, 2], 4), [3, 1, 0, 1, 1, 0, 0, 2]);
    let ticks = charts::log_ticks([-2, 1], 4);
    assert_eq!(ticks, [(0.0, "0.01".to_string()), (4.0, "0.1".into()), (8.0, "1".into()), (12.0, "10".into())]);
}

#[test]
fn histograms_draw_shares_above_their_bins() {
    let svg = charts::histogram(&[0, 3, 1], vec![(0.0, "0".into()), (3.0, "30".into())], "size, px", "h");
    assert_eq!(svg.matches("<rect").count(), 2, "empty bins have no bar");
    assert!(svg.contains("75.0 %") && svg.contains("25.0 %") && svg.contains("size, px") && svg.contains("share of words, %"));
    // Areas from pixel 56 to 328, of three bins: the second bar begins at 56 + 272 / 3.
    assert!(svg.contains("x=\"147.2\""), "{svg}");
}

#[test]
fn box_plots_have_the_quartiles_of_their_values() {
    let s = Spread::of(&[5.0, 1.0, 2.0, 4.0, 3.0, 100.0, f64::NAN]).unwrap();
    assert_eq!((s.quartiles, s.whiskers, &s.outliers[..]), ([2.25, 3.5, 4.75], [1.0, 5.0], &[100.0][..]));
    let one = Spread::of(&[7.0]).unwrap();
    assert_eq!((one.quartiles, one.whiskers), ([7.0; 3], [7.0; 2]));
    let svg = charts::boxes(&[("run".into(), vec![7.0])], "PSNR, dB", "b");
    assert!(svg.contains("PSNR, dB") && svg.contains(">run<") && !svg.contains("NaN"));
    let dots = |n: usize| charts::boxes(&[("run".into(), (0..n).map(|k| k as f64).collect())], "x", "x").matches("<circle").count();
    assert_eq!((dots(10), dots(11)), (10, 0), "few values are all drawn");
}

#[test]
fn nothing_is_said_to_be_nothing_and_one_value_is_drawn() {
    let none = [
        charts::heat_map(&[0.0; 4], 2, 1.0, "x"),
        charts::histogram(&[0, 0], Vec::new(), "x", "x"),
        charts::bars(&[], &[], (None, "x", 0), "x"),
        charts::boxes(&[("run".into(), vec![f64::NAN])], "x", "x"),
        charts::scatter(&[], &[], ["x", "y"], "x"),
    ];
    assert!(none.iter().all(|svg| svg.contains("no data")));
    let bars = charts::bars(&["a".into()], &[Series { name: "n", color: "#000", values: vec![0.0] }], (None, "words", 0), "x");
    assert!(bars.contains(">0<") && !bars.contains("NaN"));
    let heat = charts::heat_map(&[0.0, 2.0, 0.0, 0.0], 2, 1.0, "x");
    assert!(heat.contains("100.00 % of the words") && heat.contains("% of the width"));
}

fn evaluation(clusters: &[(usize, usize, f64)]) -> Evaluation {
    let clusters =
        clusters.iter().map(|(cluster, labels, f)| ClusterScore { cluster: *cluster, labels: *labels, score: Score::of(*f, *f) });
    Evaluation {
        images: 1,
        labels: 9,
        detections: 9,
        instance: Score::of(0.6, 0.6),
        scene: Score::of(0.6, 0.6),
        scenes: Vec::new(),
        clusters: clusters.collect(),
    }
}

#[test]
fn weak_clusters_are_below_all_words_and_have_enough() {
    let e = evaluation(&[(0, 9, 0.5), (1, 9, 0.7), (2, 4, 0.0), (3, 9, 0.1), (4, 9, 0.4), (5, 9, 0.3)]);
    assert_eq!(failures::weakest(&e), [3, 5, 4]);
    assert!(failures::weakest(&evaluation(&[(0, 9, 0.6)])).is_empty());
}

const MANIFEST: &str = r#"{"options":{"count":9,"size":[160,120],"sampling":"balanced","clusters":16,"seed":4,"of a later version":1},
    "scenes":[["room","00"]],"shard":{"part":1,"of":1}}"#;

#[test]
fn weak_clusters_are_filled_with_new_images_of_the_same_scenes() {
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(failures::filling(dir.path(), &[3, 7], &[], 1).unwrap(), None, "no set of text synth");
    std::fs::write(dir.path().join("synth.json"), MANIFEST).unwrap();
    let seed = failures::unused_seed(&[dir.path()]).unwrap();
    assert_eq!(seed, 5);
    let command = |runs: &[PathBuf]| failures::filling(dir.path(), &[3, 7], runs, seed).unwrap().unwrap();
    let expected = "diorama text synth scenes.toml --clusters 16 --only 3,7 --size 160x120 --seed 5 -o data/weak";
    assert_eq!(command(&[]), expected);
    assert_eq!(command(&["runs/other".into(), "runs/room".into()]), expected.replace("scenes.toml", "runs/room"));
    assert_eq!(failures::filling(dir.path(), &[], &[], 1).unwrap(), None);
    std::fs::write(dir.path().join("synth.json"), "{}").unwrap();
    let e = failures::unused_seed(&[dir.path()]).unwrap_err();
    assert!(e.is_input() && e.to_string().contains("synth.json"), "{e}");
}

#[test]
fn the_page_has_all_parts_and_needs_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("a & b");
    let images = images([Some(3), Some(7)]);
    written(&folder, &images);
    std::fs::write(folder.join("synth.json"), MANIFEST).unwrap();
    let (detector, config) = (Detector::new(Kind::Db, Backbone::Tiny, 0), Config::new(Kind::Db, Backbone::Tiny, folder.clone()));
    let judging = Judging { detector: (&detector, &config), name: "runs/db", set: &folder, runs: &[], seed: 5 };
    let judged = Judged { evaluation: evaluation(&[(3, 9, 0.5), (7, 9, 0.9)]), det_eval: Score::of(0.5, 0.5), images_per_s: 1.0 };
    let view = |psnr: f64| ViewScore { name: "v".into(), psnr, ssim: 0.9, lpips: Some(0.25) };
    let scores = Scores { views: 2, psnr: 31.0, ssim: 0.9, per_view: vec![view(30.0), view(32.0)], ..Scores::default() };
    let contents = Contents {
        sets: vec![LabelledSet::read(&folder).unwrap()],
        real: Some(Gathered::of_labels("photographs", &[], &HashMap::new())),
        detectors: vec![judging.failures(judged, true).unwrap()],
        fields: vec![FieldQuality { run: "runs/room".into(), scores }],
    };
    let html = page::html("t", "<h1>t</h1>", &contents, "").unwrap();
    for part in ["a &amp; b", "&lt;b&gt;", "photographs", "cluster 3 (9 words)", "learned from", "--only 3 ", "31.00", "0.250"] {
        assert!(html.contains(part), "{part:?} is not on the page");
    }
    assert_eq!(html.matches("data:image/png;base64,").count(), 4, "two clusters, two images");
    let foreign = ["<script", "src=\"", "<link", "@import", "url(", "NaN"];
    assert!(foreign.iter().all(|f| !html.contains(f)));
    assert!(html.matches("http").count() == html.matches("xmlns=\"http").count(), "nothing is loaded");
    assert!(html.contains("very images that it has learned from") && html.contains("None of the words is of cluster 0, 1, 2, 4, 5, 6."));
    assert_eq!(contents.summary()["detectors"][0]["weakest"], serde_json::json!([3]));
    assert_eq!(contents.summary()["fields"][0]["lpips"], 0.25);
}

#[test]
fn detectors_are_judged_by_the_clusters_that_the_set_tells() {
    let dir = tempfile::tempdir().unwrap();
    written(dir.path(), &images([Some(3), Some(7)]));
    let (detector, config) = (Detector::new(Kind::Db, Backbone::Tiny, 0), Config::new(Kind::Db, Backbone::Tiny, PathBuf::new()));
    let judging = Judging { detector: (&detector, &config), name: "db", set: dir.path(), runs: &[], seed: 1 };
    let found = judging.judge(&AtomicBool::new(false), &mut |_| ()).unwrap().unwrap();
    let clusters: Vec<_> = found.judged.evaluation.clusters.iter().map(|c| (c.cluster, c.labels)).collect();
    assert_eq!(clusters, [(3, 2), (7, 1)]);
    assert!(!found.is_trained_on && found.learned_from.is_empty() && found.command.is_none());
    assert!(judging.judge(&AtomicBool::new(true), &mut |_| ()).unwrap().is_none());
    // Nothing is written after an interrupt, or without a set.
    let out = dir.path().join("report.html");
    let options = ReportOptions { sets: vec![dir.path().join("images")], ..ReportOptions::default() };
    let e = report(&out, &options, &AtomicBool::new(false), &mut |_, _| ()).unwrap_err();
    assert!(e.is_input() && e.to_string().contains("holds no annotations.jsonl") && !out.exists(), "{e}");
}
