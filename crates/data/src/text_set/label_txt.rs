//! `Label.txt` of PaddleOCR, a line per image: the path, a tab, and a JSON list of words; with poses and `meta.json` it is the layout of
//! the TextNeRF data set (Cui et al., CVPR 2024).

use super::{SetImage, SetWord, put, put_json};
use crate::error::Result;
use serde_json::{Map, Value, json};
use std::path::Path;

const LABELS: &str = "Label.txt";

/// Writes PaddleOCR's `Label.txt`.
pub fn write_ppocr(folder: &Path, images: &[SetImage]) -> Result<()> {
    write_labels(folder, images, ppocr_word)
}

/// Writes `Label.txt` with the words' poses, and `meta.json` with each image's camera, style and seed.
pub fn write_textnerf(folder: &Path, images: &[SetImage]) -> Result<()> {
    write_labels(folder, images, textnerf_word)?;
    let meta: Map<String, Value> = images.iter().map(|i| (i.image.clone(), image_meta(i))).collect();
    put_json(folder, "meta.json", &Value::Object(meta))
}

fn write_labels(folder: &Path, images: &[SetImage], word: fn(&SetImage, &SetWord) -> Value) -> Result<()> {
    let line = |image: &SetImage| {
        let words: Vec<Value> = image.words.iter().map(|w| word(image, w)).collect();
        // JSON escapes tabs and breaks of lines in transcriptions.
        format!("{}\t{}\n", image.image, Value::Array(words))
    };
    put(folder, LABELS, images.iter().map(line).collect::<String>().as_bytes())
}

/// PaddleOCR ignores words by their text alone; PPOCRLabel shows `difficult`.
fn ppocr_word(image: &SetImage, word: &SetWord) -> Value {
    json!({"transcription": word.text(), "points": image.clamped(&word.quad), "difficult": !word.is_read()})
}

fn textnerf_word(image: &SetImage, word: &SetWord) -> Value {
    let pose = word.pose.as_ref();
    let mut out = ppocr_word(image, word);
    out["text_pose"] = json!(pose.map(|p| p.text_pose));
    out["quaternion"] = json!(pose.map(|p| p.quaternion));
    out["axis_angle"] = json!(pose.map(|p| p.axis_angle));
    out["size"] = json!(pose.map(|p| p.size));
    out["visibility"] = json!(word.visibility);
    out["cluster"] = json!(word.cluster);
    out
}

fn image_meta(image: &SetImage) -> Value {
    let [fx, fy, cx, cy] = image.intrinsic;
    json!({
        "intrinsic": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "image_wh": [image.width, image.height],
        "pose": image.world_from_camera,
        "style": image.style,
        "scene": image.scene,
        "seed": image.seed,
    })
}
