use super::super::truth::{Truth, ViewTruth, file};
use super::*;
use diorama_data::{photo, text_labels};
use diorama_geom::glam::{DVec2, DVec3};
use std::collections::BTreeMap;

static ON: AtomicBool = AtomicBool::new(false);

fn small(families: &[&str], boards: usize) -> SceneOptions {
    SceneOptions {
        families: families.iter().map(|f| f.to_string()).collect(),
        scenes: families.len(),
        views: 8,
        boards: [boards; 2],
        size: (160, 120),
        samples: 4,
        words: 2,
        closer: 0.0,
        ..SceneOptions::named("ci").unwrap()
    }
}

/// Whether a point is in a convex quadrilateral, clockwise with y down, with a margin in pixels.
fn inside(quad: &[[f64; 2]; 4], p: DVec2, margin: f64) -> bool {
    (0..4).all(|k| {
        let (a, b) = (DVec2::from(quad[k]), DVec2::from(quad[(k + 1) % 4]));
        (b - a).normalize_or_zero().perp_dot(p - a) >= -margin
    })
}

/// Checks a view against its layers and its camera; returns the ink outside and inside of regions.
fn check_view(scene: &Path, truth: &Truth, view: &ViewTruth, frame: &serde_json::Value) -> [f64; 2] {
    let at = format!("{} {}", scene.display(), view.name);
    let read = |layer: &str| photo::load(&file(scene, &format!("{}_{layer}.png", view.name))).unwrap();
    let (classes, ink) = (read("classes"), read("ink"));
    let mut inked = [0.0; 2];
    let mut areas: BTreeMap<usize, f64> = BTreeMap::new();
    for i in 0..classes.width * classes.height {
        let class = classes.data[classes.channels * i] as usize;
        let pixel = DVec2::new((i % classes.width) as f64 + 0.5, (i / classes.width) as f64 + 0.5);
        inked[(class > 0) as usize] += ink.data[ink.channels * i] as f64 / 255.0;
        *areas.entry(class).or_default() += 1.0;
        // A class is only where the region's outline is.
        let shown = view.regions.iter().find(|s| s.id + 1 == class && s.polygon.len() == 4);
        assert!(shown.is_none_or(|s| inside(&s.quad, pixel, 0.01)), "{at}: class {class} at {pixel}");
    }
    let number = |key: &str| frame[key].as_f64().unwrap();
    let project = |p: DVec3| DVec2::new(number("fl_x") * p.x / p.z + number("cx"), number("fl_y") * p.y / p.z + number("cy"));
    for s in &view.regions {
        assert!(s.visibility >= 0.1 && s.characters.len() == truth.regions[s.id].characters.len());
        let pose = s.pose();
        assert!(pose.rotation.z_axis.dot(pose.translation) < 0.0 || s.polygon.len() > 4, "{at}: z points to the reader");
        if s.polygon.len() > 4 {
            continue;
        }
        // The upper left corner by the pose alone: left of the middle in reading direction, and up.
        let corner = pose.translation + pose.rotation * DVec3::new(-0.5 * s.size[0], 0.5 * s.size[1], 0.0);
        assert!((project(corner) - DVec2::from(s.quad[0])).length() < 1e-6);
        let area: f64 = (0..4).map(|k| DVec2::from(s.quad[k]).perp_dot(DVec2::from(s.quad[(k + 1) % 4]))).sum::<f64>() / 2.0;
        assert!(area > 0.0, "{at}: clockwise with y down");
        // What is wholly visible covers as many pixels as its outline.
        let covered = *areas.get(&(s.id + 1)).unwrap_or(&0.0);
        assert!(s.visibility < 1.0 || (covered - area).abs() < 0.1 * area + 12.0, "{at}: {covered} pixels of {area}");
    }
    inked
}

#[test]
fn regions_classes_ink_and_poses_of_every_family_agree() {
    let folder = tempfile::tempdir().unwrap();
    let names: Vec<&str> = Family::ALL.iter().map(|f| f.name()).collect();
    let made = generate(folder.path(), &small(&names, 4), false, &ON, &mut |_| ()).unwrap();
    assert!(made.scenes.len() == 5 && made.photographs == 40 && !made.interrupted);
    for name in &made.scenes {
        let scene = folder.path().join(name);
        let truth = Truth::read(&scene).unwrap();
        let transforms: serde_json::Value = serde_json::from_slice(&std::fs::read(scene.join("transforms.json")).unwrap()).unwrap();
        let mut inked = [0.0; 2];
        for (view, frame) in truth.views.iter().zip(transforms["frames"].as_array().unwrap()) {
            let more = check_view(&scene, &truth, view, frame);
            (0..2).for_each(|k| inked[k] += more[k]);
        }
        assert!(truth.views.iter().map(|v| v.regions.len()).sum::<usize>() > 20, "{name}");
        // All ink is in regions, but for its rim.
        assert!(inked[1] > 50.0 && inked[0] < 0.12 * inked[1], "{name}: {inked:?}");
        let labels = text_labels::load(&scene.join("labels.jsonl")).unwrap();
        assert!(labels.len() == 2 && labels.iter().any(|l| l.regions.iter().any(|r| !r.ignore)), "{name}");
        let held_out: Vec<String> = truth.views.iter().filter(|v| v.held_out).map(|v| format!("images/{}.png", v.name)).collect();
        assert!(held_out.len() == 1 && labels.iter().all(|l| !held_out.contains(&l.image)));
        let all = text_labels::load(&file(&scene, "labels.jsonl")).unwrap();
        let corners = all.iter().flat_map(|l| &l.regions).flat_map(|r| &r.polygon);
        assert!(all.len() == 8 && corners.into_iter().all(|p| (0.0..=160.0).contains(&p[0]) && (0.0..=120.0).contains(&p[1])));
    }
}

#[test]
fn an_interrupted_call_goes_on_to_the_same_bits_and_other_options_are_refused() {
    let (whole, parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let options = SceneOptions { size: (48, 36), ..small(&["shelf"], 2) };
    generate(whole.path(), &options, false, &ON, &mut |_| ()).unwrap();
    let stop = AtomicBool::new(false);
    let mut done = 0;
    let made = generate(parts.path(), &options, false, &stop, &mut |_| {
        done += 1;
        stop.store(done == 3, std::sync::atomic::Ordering::Relaxed);
    });
    assert!(made.unwrap().interrupted && !parts.path().join("shelf-000/transforms.json").exists());
    generate(parts.path(), &options, false, &ON, &mut |_| ()).unwrap();
    for name in ["transforms.json", "labels.jsonl", "images/005.png", "truth/truth.json", "truth/001_depth.exr", "truth/007_ink.png"] {
        let [a, b] = [&whole, &parts].map(|f| std::fs::read(f.path().join("shelf-000").join(name)).unwrap());
        // Paths are relative, so that both folders hold the same.
        assert!(a == b, "{name}");
    }
    // What is complete stays as it is: labels that a user put there as well.
    let labels = parts.path().join("shelf-000/labels.jsonl");
    std::fs::write(&labels, "mine").unwrap();
    let made = generate(parts.path(), &options, false, &ON, &mut |_| ()).unwrap();
    assert!(made.photographs == 8 && made.regions > 0 && std::fs::read(&labels).unwrap() == b"mine");
    let not_ours = parts.path().join("street-mine/truth");
    std::fs::create_dir_all(&not_ours).unwrap();
    let other = SceneOptions { seed: 1, views: 9, ..options.clone() };
    let error = generate(parts.path(), &other, false, &ON, &mut |_| ()).unwrap_err().to_string();
    assert!(error.contains("made with other views, seed; give --force"), "{error}");
    assert!(generate(parts.path(), &other, true, &ON, &mut |_| ()).unwrap().photographs == 9);
    assert!(parts.path().join("shelf-000/images/008.png").exists() && not_ours.is_dir());
}

#[test]
fn options_that_cannot_be_are_refused_before_anything_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("scenes");
    let good = small(&["room"], 2);
    for (options, expected) in [
        (SceneOptions { families: vec!["cave".into()], ..good.clone() }, "family \"cave\": expected room, corridor, street, shelf, pillar"),
        (SceneOptions { views: 3, ..good.clone() }, "at least 8 views"),
        (SceneOptions { labelled: 8, ..good.clone() }, "--labelled 8: expected 1 to 7"),
        (SceneOptions { boards: [3, 2], ..good.clone() }, "--signs 3-2"),
        (SceneOptions { boards: [3, 20], ..good.clone() }, "from 1 to 8"),
    ] {
        let error = generate(&out, &options, false, &ON, &mut |_| ()).unwrap_err().to_string();
        assert!(error.contains(expected) && !out.exists(), "{error}");
    }
    let missing = SceneOptions { fonts: FontSource::Files(vec![folder.path().join("no.ttf")]), ..good };
    assert!(generate(&out, &missing, false, &ON, &mut |_| ()).unwrap_err().to_string().contains("no.ttf") && !out.exists());
}
