//! Photographs with labels of the user's: a folder with `images/` and `icdar15/`, or one with MMOCR's `textdet*.json`.

use crate::error::Result;
use diorama_data::text_labels::{Kind, LabelledRegion, UNREADABLE, check_polygon};
use diorama_data::text_set::detector_set::{self, DetectorImage, DetectorLabel};
use diorama_data::{DataError, error};
use serde::Deserialize;
use std::path::{Path, PathBuf};

const LIMIT: u64 = 1 << 30;
/// Name of the only scene of MMOCR's sets, which tell none.
const SCENE: &str = "real";

#[derive(Deserialize)]
struct List {
    data_list: Vec<Entry>,
}

#[derive(Deserialize)]
struct Entry {
    img_path: String,
    instances: Vec<Instance>,
}

#[derive(Deserialize)]
struct Instance {
    /// x and y in turn.
    polygon: Vec<f64>,
    #[serde(default)]
    ignore: bool,
}

/// Images of a folder and the outlines of their writing.
///
/// # Errors
/// When it holds neither layout, or a file of it is missing or wrong.
pub fn read(folder: &Path) -> Result<Vec<DetectorImage>> {
    match list_of(folder)? {
        Some(file) if !folder.join(detector_set::LABELS).is_dir() => mmocr(folder, &file),
        _ => Ok(crate::text::detectors::recipe::labelled(folder)?),
    }
}

/// The first `textdet*.json` of a folder by name.
fn list_of(folder: &Path) -> Result<Option<PathBuf>> {
    let entries =
        std::fs::read_dir(folder).map_err(|e| DataError::input(folder, format!("{e}; give --real a folder of labelled images")))?;
    let all = entries.map(|e| e.map(|e| e.path())).collect::<std::io::Result<Vec<PathBuf>>>().map_err(DataError::io(folder, "read"))?;
    let is_list = |p: &PathBuf| {
        let name = p.file_name().unwrap_or_default().to_string_lossy().into_owned();
        name.starts_with("textdet") && name.ends_with(".json")
    };
    Ok(all.into_iter().filter(is_list).min())
}

fn mmocr(folder: &Path, file: &Path) -> Result<Vec<DetectorImage>> {
    let wrong = |what: String| DataError::input(file, format!("{what}; expected MMOCR's TextDetDataset with data_list"));
    let list: List = serde_json::from_slice(&error::read(file, LIMIT)?).map_err(|e| wrong(e.to_string()))?;
    let label = |entry: &Entry, (id, instance): (usize, &Instance)| {
        let place = || format!("{}: instance {id}", entry.img_path);
        if !instance.polygon.len().is_multiple_of(2) {
            return Err(wrong(format!("{}: {} numbers are no corners", place(), instance.polygon.len())));
        }
        let mut polygon: Vec<[f64; 2]> = instance.polygon.chunks_exact(2).map(|p| [p[0], p[1]]).collect();
        check_polygon(&polygon).map_err(|e| wrong(format!("{}: {e}", place())))?;
        if crate::text::label::in_view::area(&polygon) < 0.0 {
            polygon[1..].reverse();
        }
        let transcription = if instance.ignore { UNREADABLE } else { "?" }.into();
        let region = LabelledRegion { id: id as u32, polygon, transcription, script: None, kind: Kind::Text, ignore: instance.ignore };
        Ok(DetectorLabel { region, cluster: None, quaternion: None })
    };
    let image = |entry: &Entry| {
        let path = folder.join(&entry.img_path);
        if !path.is_file() {
            return Err(wrong(format!("{} is missing", path.display())));
        }
        let labels = entry.instances.iter().enumerate().map(|i| label(entry, i)).collect::<std::result::Result<_, _>>()?;
        Ok(DetectorImage { path, scene: SCENE.into(), labels })
    };
    let images = list.data_list.iter().map(image).collect::<std::result::Result<Vec<_>, DataError>>()?;
    match images.iter().any(|i| i.labels.iter().any(|l| !l.region.ignore)) {
        true => Ok(images),
        false => Err(wrong("labels no word that counts".into()).into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_layouts_are_read_and_wrong_lists_named() {
        let dir = tempfile::tempdir().unwrap();
        let put = |name: &str, text: &str| {
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        let list = |polygon: &str| {
            let first = format!(r#"{{"polygon":{polygon},"bbox":[1,2,3,4],"bbox_label":0,"ignore":false}}"#);
            let second = r#"{"polygon":[0,0,4,0,4,4,0,4],"ignore":true}"#;
            format!(r#"{{"metainfo":{{}},"data_list":[{{"img_path":"imgs/a.jpg","height":9,"width":9,"instances":[{first},{second}]}}]}}"#)
        };
        put("textdet_test.json", &list("[20,1,20,5,30,5,30,1]"));
        assert!(read(dir.path()).unwrap_err().to_string().contains("imgs/a.jpg is missing"));
        put("imgs/a.jpg", "");
        let images = read(dir.path()).unwrap();
        assert_eq!(images.len(), 1);
        assert_eq!(images[0].labels[0].region.polygon[1], [30.0, 1.0], "clockwise");
        assert!(!images[0].labels[0].region.ignore && images[0].labels[1].region.ignore);
        for (polygon, expected) in
            [("[1,2,3]", "imgs/a.jpg: instance 0: 3 numbers"), ("[0,0,4,4,4,0,0,4]", "instance 0: "), ("7", "expected")]
        {
            put("textdet_test.json", &list(polygon));
            let e = read(dir.path()).unwrap_err();
            assert!(e.is_input() && e.to_string().contains(expected), "{e}");
        }
        put("images/b.png", "");
        put("icdar15/gt_b.txt", "1,2,11,2,11,6,1,6,A\n");
        assert!(read(dir.path()).unwrap()[0].path.ends_with("images/b.png"));
        assert!(read(&dir.path().join("none")).unwrap_err().to_string().contains("--real"));
    }
}
