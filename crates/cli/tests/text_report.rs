//! `diorama text report`: the page of a small data set, and requests that are refused in one line.

use diorama_data::photo;
use diorama_data::text_set::{self, SetImage, SetWord, WordPose};
use diorama_geom::ImageU8;
use std::path::Path;
use std::process::{Command, Output};

fn run(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_diorama")).args(["text", "report"]).args(arguments).current_dir(folder).output().unwrap()
}

#[track_caller]
fn refused(folder: &Path, arguments: &[&str], expected: &str) {
    let o = run(folder, arguments);
    let text = String::from_utf8_lossy(&o.stderr);
    let errors: Vec<&str> = text.lines().filter(|l| l.starts_with("diorama: ")).collect();
    assert!(o.status.code() == Some(2) && errors.len() == 1 && !text.contains("panicked"), "{arguments:?}: {text}");
    assert!(errors[0].contains(expected), "{expected:?} is not in {:?}", errors[0]);
}

/// A data set of two gray images with three words, one of them not to be read.
fn written(folder: &Path) {
    let word = |x: f64, text: &str| {
        let quad = [[x, 4.0], [x + 20.0, 4.0], [x + 20.0, 12.0], [x, 12.0]];
        let pose = WordPose::new([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 2.0]], [0.5, 0.2]);
        SetWord {
            id: 0,
            quad,
            polygon: quad.to_vec(),
            transcription: text.into(),
            script: None,
            ignore: text == "###",
            visibility: 1.0,
            pose: Some(pose),
            cluster: Some(4),
            characters: Vec::new(),
        }
    };
    let image = |number: usize, words: Vec<SetWord>| SetImage {
        image: format!("images/{number}.png"),
        width: 64,
        height: 32,
        intrinsic: [50.0, 50.0, 32.0, 16.0],
        world_from_camera: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        scene: "room".into(),
        style: None,
        seed: None,
        words,
    };
    let images = [image(0, vec![word(2.0, "CAFE"), word(40.0, "###")]), image(1, vec![word(30.0, "OPEN")])];
    std::fs::create_dir_all(folder.join("images")).unwrap();
    for i in &images {
        let gray = ImageU8 { width: 64, height: 32, channels: 3, data: vec![128; 3 * 64 * 32] };
        photo::save_png(&folder.join(&i.image), &gray).unwrap();
    }
    text_set::save(folder, &images).unwrap();
}

#[test]
fn the_page_has_the_counts_of_data_and_of_real_labels() {
    let dir = tempfile::tempdir().unwrap();
    written(&dir.path().join("set"));
    std::fs::create_dir(dir.path().join("gt")).unwrap();
    std::fs::write(dir.path().join("gt/gt_0.txt"), "4,4,30,4,30,12,4,12,CAFE\n").unwrap();
    let real = ["--real", "set/images", "--labels", "gt", "--format", "icdar15"];
    let o = run(dir.path(), &[&["--data", "set", "-o", "page.html", "--json"][..], &real].concat());
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    let json: serde_json::Value = serde_json::from_slice(&o.stdout).unwrap();
    let set = &json["sets"][0];
    assert!(set["images"] == 2 && set["words"] == 3 && set["unreadable"] == 1, "{json}");
    assert_eq!(set["clusters"], serde_json::json!([{ "cluster": 4, "words": 3 }]));
    assert!(json["real"]["words"] == 1 && json["report"] == "page.html", "{json}");
    let page = std::fs::read_to_string(dir.path().join("page.html")).unwrap();
    assert!(page.contains("<td>set</td><td>2</td><td>1</td><td>3</td><td>1</td>"), "images, scenes, words, those not to be read");
    assert!(page.contains("<td>gt</td>") && page.contains("Cluster 4: 3 words, 1 of them ###") && !page.contains("<script"));
}

#[test]
fn what_holds_no_data_is_refused_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("empty")).unwrap();
    refused(
        dir.path(),
        &["--data", "empty"],
        "empty: holds no annotations.jsonl; give the folder of a data set that `diorama text synth` wrote",
    );
    assert!(!dir.path().join("report.html").exists());
    written(&dir.path().join("set"));
    refused(dir.path(), &["--data", "set", "-o", "empty"], "--out \"empty\": is a folder; give a file");
    refused(
        dir.path(),
        &["--data", "set", "--real", "set/images", "--labels", "gt", "--format", "voc"],
        "expected labelme, ppocr, icdar13",
    );
    refused(dir.path(), &["--run", "empty"], "empty");
    refused(dir.path(), &["--data", "set", "--weights", "empty"], "empty");
    std::fs::remove_file(dir.path().join("set/images/1.png")).unwrap();
    refused(dir.path(), &["--data", "set"], "1.png");
}
