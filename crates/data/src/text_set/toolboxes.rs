//! Annotations for detection toolboxes: MMOCR 1.x (`TextDetDataset`) and docTR (`DetectionDataset`).

use super::geometry::{bounds, flat};
use super::{SetImage, SetWord, put_json};
use crate::error::{DataError, Result};
use rayon::prelude::*;
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};
use std::path::Path;

/// Writes `mmocr/textdet.json`; paths of images are relative to the data set's folder (`data_root`).
pub fn write_mmocr(folder: &Path, images: &[SetImage]) -> Result<()> {
    let word = |image: &SetImage, word: &SetWord| {
        let polygon = image.clamped(&word.polygon);
        json!({
            "polygon": flat(&polygon),
            "bbox": bounds(&polygon),
            "bbox_label": 0,
            "ignore": !word.is_read(),
            "text": word.transcription,
        })
    };
    let entry = |image: &SetImage| {
        let instances: Vec<Value> = image.words.iter().map(|w| word(image, w)).collect();
        json!({"img_path": image.image, "height": image.height, "width": image.width, "instances": instances})
    };
    let metainfo = json!({"dataset_type": "TextDetDataset", "task_name": "textdet", "category": [{"id": 0, "name": "text"}]});
    let data_list: Vec<Value> = images.iter().map(entry).collect();
    put_json(folder, "mmocr/textdet.json", &json!({"metainfo": metainfo, "data_list": data_list}))
}

/// Writes `doctr/labels.json`, with keys relative to `images/`.
///
/// docTR can ignore no words, so those that are not to be read are left out. Its reader fails on images without words, so those are left
/// out too. Its polygons have four corners each.
pub fn write_doctr(folder: &Path, images: &[SetImage]) -> Result<()> {
    let entry = |image: &SetImage| -> Result<Option<(String, Value)>> {
        let polygons: Vec<_> = image.words.iter().filter(|w| w.is_read()).map(|w| image.clamped(&w.quad)).collect();
        if polygons.is_empty() {
            return Ok(None);
        }
        let path = folder.join(&image.image);
        let cure = |e: std::io::Error| DataError::input(&path, format!("{e}; doctr holds hashes of images: write them first"));
        let hash = format!("{:x}", Sha256::digest(std::fs::read(&path).map_err(cure)?));
        let key = image.image.strip_prefix("images/").unwrap_or(&image.image);
        let labels = json!({"img_dimensions": [image.width, image.height], "img_hash": hash, "polygons": polygons});
        Ok(Some((key.into(), labels)))
    };
    let entries = images.par_iter().map(entry).collect::<Result<Vec<_>>>()?;
    let labels: Map<String, Value> = entries.into_iter().flatten().collect();
    put_json(folder, "doctr/labels.json", &Value::Object(labels))
}
