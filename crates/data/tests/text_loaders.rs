//! Data sets of writing, read by PaddleOCR's and MMOCR's own loaders, which `benches/text_readers.sh` installs.

use diorama_data::photo;
use diorama_data::text_set::{self, SetFormat, SetImage, SetWord};
use diorama_geom::ImageU8;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

const SIZE: [usize; 2] = [80, 60];

/// A Python that has both loaders; `None` if there is none, unless one is required.
fn python() -> Option<PathBuf> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/text-readers");
    let python = std::env::var_os("DIORAMA_TEXT_READERS").map_or(default, PathBuf::from).join("venv/bin/python");
    let find = "import importlib.util as u; exit(not all(u.find_spec(n) for n in ['mmocr', 'paddleocr']))";
    if Command::new(&python).args(["-c", find]).output().is_ok_and(|o| o.status.success()) {
        return Some(python);
    }
    let what = format!("{} has no mmocr and paddleocr; run benches/text_readers.sh", python.display());
    assert!(std::env::var_os("DIORAMA_REQUIRE_TEXT_READERS").is_none(), "{what}");
    println!("skipped: {what}");
    None
}

fn word(id: u32, quad: [[f64; 2]; 4], transcription: &str) -> SetWord {
    SetWord {
        id,
        quad,
        polygon: quad.to_vec(),
        transcription: transcription.into(),
        script: None,
        ignore: transcription == "###",
        visibility: 1.0,
        pose: None,
        cluster: None,
        characters: Vec::new(),
    }
}

/// Words of several scripts, one that nobody can read, a bent one, one at the border, and an image without words.
fn images() -> Vec<SetImage> {
    let mut bent = word(2, [[10.0, 40.0], [50.0, 40.0], [50.0, 52.0], [10.0, 52.0]], "\"quoted\", tab\tand line");
    bent.polygon = vec![[10.0, 40.0], [30.0, 36.5], [50.0, 40.0], [50.0, 52.0], [30.0, 48.25], [10.0, 52.0]];
    let image = |k: usize, words: Vec<SetWord>| SetImage {
        image: format!("images/{k:08}.png"),
        width: SIZE[0] as u32,
        height: SIZE[1] as u32,
        intrinsic: [70.0, 70.0, 40.0, 30.0],
        world_from_camera: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        scene: "shop".into(),
        style: None,
        seed: None,
        words,
    };
    let first = vec![
        word(0, [[4.125, 4.0], [40.0, 5.5], [39.0, 16.0], [5.0, 15.0]], "Café"),
        word(1, [[60.0, 0.0], [80.0, 2.0], [80.0, 20.0], [61.0, 21.0]], "###"),
        bent,
    ];
    vec![image(0, first), image(1, Vec::new()), image(2, vec![word(0, [[1.0, 1.0], [70.0, 2.0], [70.0, 59.5], [2.0, 60.0]], "カフェ")])]
}

/// What a loader reads of a data set.
fn read(python: &Path, toolbox: &str, folder: &Path) -> Vec<Value> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../benches/peers/text_set_loaders.py");
    let o = Command::new(python).arg(script).arg(toolbox).arg(folder).output().unwrap();
    assert!(o.status.success(), "{toolbox}: {}", String::from_utf8_lossy(&o.stderr));
    let text = String::from_utf8(o.stdout).unwrap();
    serde_json::from_str(text.lines().last().unwrap()).unwrap_or_else(|e| panic!("{toolbox}: {e}: {text}"))
}

/// Checks an image as a loader has it against the words that were written, with `outline` and `text` as the format has them.
fn check(got: &Value, image: &SetImage, outline: impl Fn(&SetWord) -> Vec<[f64; 2]>, text: impl Fn(&SetWord) -> String) {
    assert_eq!((&got["image"], &got["height"], &got["width"]), (&image.image.clone().into(), &SIZE[1].into(), &SIZE[0].into()));
    let words = got["words"].as_array().unwrap();
    assert_eq!(words.len(), image.words.len(), "{got}");
    for (read, word) in words.iter().zip(&image.words) {
        let flat: Vec<f64> = read[0].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        let wanted: Vec<f64> = outline(word).into_iter().flatten().collect();
        assert!(flat.len() == wanted.len() && flat.iter().zip(&wanted).all(|(a, b)| (a - b).abs() < 1e-4), "{flat:?} is not {wanted:?}");
        assert_eq!((&read[1], &read[2]), (&text(word).into(), &word.ignore.into()));
    }
}

#[test]
fn loaders_of_paddleocr_and_mmocr_read_what_was_written() {
    let Some(python) = python() else { return };
    let dir = tempfile::tempdir().unwrap();
    let images = images();
    std::fs::create_dir(dir.path().join("images")).unwrap();
    for image in &images {
        let data = (0..3 * SIZE[0] * SIZE[1]).map(|i| (i % 251) as u8).collect();
        photo::save_png(&dir.path().join(&image.image), &ImageU8 { width: SIZE[0], height: SIZE[1], channels: 3, data }).unwrap();
    }
    text_set::write(dir.path(), &images, &[SetFormat::Ppocr, SetFormat::Mmocr]).unwrap();
    let of_ppocr = read(&python, "ppocr", dir.path());
    assert_eq!(of_ppocr.len(), 2, "an image without words is passed over");
    for (got, image) in of_ppocr.iter().zip([&images[0], &images[2]]) {
        check(got, image, |w| w.quad.to_vec(), |w| w.transcription.clone());
    }
    let of_mmocr = read(&python, "mmocr", dir.path());
    assert_eq!(of_mmocr.len(), 3);
    of_mmocr.iter().zip(&images).for_each(|(got, image)| check(got, image, |w| w.polygon.clone(), |w| w.transcription.clone()));
    // What is written of `textnerf` beside it reads the same.
    text_set::write(dir.path(), &images, &[SetFormat::Ppocr, SetFormat::TextNerf]).unwrap();
    assert_eq!(read(&python, "ppocr", dir.path()), of_ppocr);
}
