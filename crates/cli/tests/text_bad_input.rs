//! Bad input of the text commands after `prepare`: one line that names what is wrong, and an exit code.

mod program;

use program::{copy_of, fails, works};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// A generated scene and a run of four steps on it, made once.
struct Made {
    folder: tempfile::TempDir,
}

const SMALL: [&str; 6] = ["--set", "field.log2_size=8", "--set", "sampling.occupancy_points=2048", "--set", "sampling.max_samples=128"];
const TRAIN: [&str; 8] = ["text", "train", "signs/shelf-000", "--preset", "ci", "--device", "cpu", "-o"];

fn made() -> &'static Path {
    static MADE: OnceLock<Made> = OnceLock::new();
    MADE.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let make = ["text", "make-scenes", "--family", "shelf", "--views", "8", "--pixels", "64x48", "--spp", "2"];
        works(folder.path(), &[&make[..], &["--fonts", "shipped", "-o", "signs"]].concat());
        works(folder.path(), &[&TRAIN[..], &["run", "--steps", "4"], &SMALL].concat());
        Made { folder }
    })
    .folder
    .path()
}

/// A copy for a test to damage.
fn copy() -> (tempfile::TempDir, PathBuf) {
    copy_of(made())
}

#[test]
fn labels_that_are_no_text_and_ids_with_two_texts_are_named() {
    let (_kept, dir) = copy();
    let annotate = |format: &'static str| ["text", "annotate", "signs/shelf-000", "gt", "--force", "--format", format];
    std::fs::create_dir(dir.join("gt")).unwrap();
    let gt = dir.join("gt/gt_002.txt");
    std::fs::write(&gt, b"4,4,30,4,30,12,4,12,CAFE\n4,20,30,20,30,28,4,28,CAF\xc9\n").unwrap();
    fails(&dir, &annotate("icdar15"), 2, &["gt_002.txt: line 2: not UTF-8 at byte 50; save it as UTF-8"]);
    std::fs::write(&gt, "4,4,30,4,30,12,CAFE\n").unwrap();
    fails(&dir, &annotate("icdar15"), 2, &["gt_002.txt: line 1: 7 fields; expected x1,y1,x2,y2,x3,y3,x4,y4,text"]);
    std::fs::write(&gt, "4,4,30,12,30,4,4,12,CAFE\n").unwrap();
    fails(&dir, &annotate("icdar15"), 2, &["gt_002.txt: line 1: the side after vertex 0 crosses the side after vertex 2"]);
    std::fs::rename(&gt, dir.join("gt/gt_099.txt")).unwrap();
    fails(&dir, &annotate("icdar15"), 2, &["gt_099.txt", "\"099\"", "images/000.png"]);
    std::fs::write(dir.join("gt/gt_099.txt"), "").unwrap();
    fails(&dir, &annotate("icdar15"), 2, &["gt: holds no label", "as in 10,8,90,10,90,30,10,28,CAFE"]);
    std::fs::remove_file(dir.join("gt/gt_099.txt")).unwrap();
    for (image, text) in [("001", "OPEN"), ("002", "SHUT")] {
        let shape = format!(r#"{{"label":"{text}","points":[[4,4],[30,4],[30,12]],"group_id":5}}"#);
        let json = format!(r#"{{"imagePath":"{image}.png","shapes":[{shape}]}}"#);
        std::fs::write(dir.join(format!("gt/{image}.json")), json).unwrap();
    }
    fails(&dir, &annotate("labelme"), 2, &["002.json, shape 0: region 5 is \"SHUT\", at 001.json, shape 0 it is \"OPEN\""]);
    std::fs::write(dir.join("gt/002.json"), "{\"imagePath\": ").unwrap();
    fails(&dir, &annotate("labelme"), 2, &["002.json: ", "line 1"]);
    let labels = |folder: &Path| std::fs::read(folder.join("signs/shelf-000/labels.jsonl")).unwrap();
    assert_eq!(labels(&dir), labels(made()), "labels that were there stay");
}

#[test]
fn captures_without_labels_get_an_example_and_unknown_cameras_a_list() {
    let (_kept, dir) = copy();
    let train = [&TRAIN[..], &["new", "--steps", "4"]].concat();
    let labels = dir.join("signs/shelf-000/labels.jsonl");
    std::fs::write(&labels, "{\"image\":\"images/001.png\",\"regions\":[]}\n").unwrap();
    fails(
        &dir,
        &train,
        2,
        &["labels.jsonl: holds no region; label at least one, as in {\"image\": \"images/001.png\", \"regions\": [{\"id\": 0"],
    );
    let scene = dir.join("signs/shelf-000");
    std::fs::remove_file(scene.join("transforms.json")).unwrap();
    std::fs::create_dir_all(scene.join("sparse/0")).unwrap();
    std::fs::write(scene.join("sparse/0/cameras.txt"), "1 SPHERE_9 64 48 50 32 24\n").unwrap();
    std::fs::write(scene.join("sparse/0/images.txt"), "1 1 0 0 0 0 0 0 1 000.png\n\n").unwrap();
    std::fs::write(scene.join("sparse/0/points3D.txt"), "").unwrap();
    fails(&dir, &train, 2, &["cameras.txt", "camera model SPHERE_9 is not supported; use one of SIMPLE_PINHOLE, PINHOLE"]);
    assert!(!dir.join("new").exists());
}

#[test]
fn regions_that_no_view_shows_are_named_with_their_points() {
    let (_kept, dir) = copy();
    let expected = ["run: no region has a surface; region ", "(\"", "points in ", "views, of which 50 in 2 are needed; label a photograph"];
    fails(&dir, &["text", "label", "run"], 2, &expected);
    assert!(!dir.join("run/regions.json").exists());
}

#[test]
fn losses_that_are_not_finite_end_the_run_at_the_last_good_checkpoint() {
    let (_kept, dir) = copy();
    // Classes come last, so that all steps here are of the scene.
    works(&dir, &[&TRAIN[..], &["scene", "--steps", "4", "--set", "labels.share=0.01"], &SMALL].concat());
    let resume = ["text", "train", "--resume", "--steps", "20", "--set", "optim.rate=1e30", "-o", "scene"];
    let checkpoint = dir.join("scene/checkpoints/latest.safetensors");
    let before = std::fs::read(&checkpoint).unwrap();
    let expected = ["the loss was not finite at step ", "latest.safetensors is the last good checkpoint", "lower --set optim.rate"];
    fails(&dir, &resume, 1, &expected);
    assert!(std::fs::read(&checkpoint).unwrap() == before);
}

#[test]
fn a_run_goes_on_with_what_it_was_begun_with() {
    let (_kept, dir) = copy();
    let resume = ["text", "train", "--resume", "--steps", "5", "-o", "run"];
    let other = ["--set", "field.levels=4", "--set", "labels.width=48", "--seed", "9"];
    let expected = ["--resume: run was begun with other ", "field.levels", "labels.width", "seed", "; leave them out, or begin a new run"];
    fails(&dir, &[&resume[..], &other].concat(), 2, &expected);
    works(&dir, &[&resume[..], &["--set", "optim.rate=0.001"]].concat());
}
