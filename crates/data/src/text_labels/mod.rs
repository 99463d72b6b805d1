//! Labels of writing in images: one JSON object per line,
//! `{"image", "regions": [{"id", "polygon", "transcription", "script", "kind", "ignore"}]}`.
//!
//! Polygons are in pixels, clockwise from the upper left in reading order; one `id` is the same region in all images. The transcription
//! `###` means that nobody can read it.

mod formats;

use crate::atomic;
use crate::error::{DataError, Result, read};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;

pub use formats::{Format, Known, count, import, read_image};

/// Transcription of what is not to be read.
pub const UNREADABLE: &str = "###";
const LIMIT: u64 = 1 << 30;
/// Twice the area in square pixels below which a polygon has none.
const LEAST_AREA: f64 = 1e-6;
/// What a line looks like, for errors.
pub const EXAMPLE: &str =
    r#"{"image": "images/001.png", "regions": [{"id": 0, "polygon": [[10,8],[90,10],[90,30],[10,28]], "transcription": "CAFE"}]}"#;

/// An image and its regions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelledImage {
    /// Path relative to the labels' folder.
    pub image: String,
    pub regions: Vec<LabelledRegion>,
}

/// A region of an image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelledRegion {
    pub id: u32,
    pub polygon: Vec<[f64; 2]>,
    pub transcription: String,
    /// Unicode's name of the script, as far as it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub script: Option<String>,
    #[serde(default)]
    pub kind: Kind,
    /// Whether it counts neither as found nor as missed.
    #[serde(default)]
    pub ignore: bool,
}

/// What a region holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    #[default]
    Text,
    /// Drawn by hand, to be treated like text.
    Custom,
}

/// Reads labels and checks each polygon: at least three corners, finite, around an area, and no two sides that cross.
///
/// # Errors
/// With the line, and where it is a polygon the vertex, when the file cannot be read or holds something else; when one id has two
/// transcriptions.
pub fn load(path: &Path) -> Result<Vec<LabelledImage>> {
    let bytes = read(path, LIMIT)?;
    let text = utf8(&bytes).map_err(|e| DataError::input(path, e))?;
    parse(text).map_err(|message| DataError::input(path, message))
}

/// The text of a file, or where it is none.
fn utf8(bytes: &[u8]) -> std::result::Result<&str, String> {
    std::str::from_utf8(bytes).map_err(|e| {
        let line = 1 + bytes[..e.valid_up_to()].iter().filter(|b| **b == b'\n').count();
        format!("line {line}: not UTF-8 at byte {}; save it as UTF-8", e.valid_up_to())
    })
}

/// Keeps what the region of an id says and where it is said first.
///
/// # Errors
/// When the id said something else before.
fn known_texts(known: &mut HashMap<u32, (String, String)>, id: u32, text: &str, at: &str) -> std::result::Result<(), String> {
    if text == UNREADABLE {
        return Ok(());
    }
    let (said, first) = known.entry(id).or_insert_with(|| (text.into(), at.into()));
    if said != text {
        return Err(format!("{at}: region {id} is {text:?}, at {first} it is {said:?}; one id is one text"));
    }
    Ok(())
}

/// The labels of a text.
///
/// # Errors
/// As [`load`].
pub fn parse(text: &str) -> std::result::Result<Vec<LabelledImage>, String> {
    let mut out: Vec<LabelledImage> = Vec::new();
    let mut known = HashMap::new();
    for (n, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let at = format!("line {}", n + 1);
        let image: LabelledImage = serde_json::from_str(line).map_err(|e| format!("{at}: {e}; expected a line such as {EXAMPLE}"))?;
        for region in &image.regions {
            check_polygon(&region.polygon).map_err(|e| format!("{at}: region {}: {e}", region.id))?;
            known_texts(&mut known, region.id, &region.transcription, &at)?;
        }
        out.push(image);
    }
    if out.iter().all(|i| i.regions.is_empty()) {
        return Err(format!("holds no region; label at least one, as in {EXAMPLE}"));
    }
    Ok(out)
}

/// Whether a polygon is a simple one.
///
/// # Errors
/// With the vertex or the sides at fault.
pub fn check_polygon(polygon: &[[f64; 2]]) -> std::result::Result<(), String> {
    let n = polygon.len();
    if n < 3 {
        return Err(format!("{n} corners; a polygon has at least 3"));
    }
    if let Some(k) = polygon.iter().position(|p| p.iter().any(|v| !v.is_finite())) {
        return Err(format!("vertex {k} is not a number"));
    }
    let turn = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    let side = |k: usize| (polygon[k], polygon[(k + 1) % n]);
    for i in 0..n {
        for j in i + 2..n {
            if (j + 1) % n == i {
                continue;
            }
            let ((a, b), (c, d)) = (side(i), side(j));
            if turn(a, b, c) * turn(a, b, d) < 0.0 && turn(c, d, a) * turn(c, d, b) < 0.0 {
                return Err(format!("the side after vertex {i} crosses the side after vertex {j}; order the corners clockwise"));
            }
        }
    }
    let area: f64 = (0..n).map(|k| polygon[k][0] * polygon[(k + 1) % n][1] - polygon[k][1] * polygon[(k + 1) % n][0]).sum();
    if area.abs() < LEAST_AREA {
        return Err("its corners enclose no area; draw around the writing".into());
    }
    Ok(())
}

/// Writes labels.
///
/// # Errors
/// When the file cannot be written.
pub fn save(path: &Path, images: &[LabelledImage]) -> Result<()> {
    let lines: Vec<String> = images.iter().map(|i| serde_json::to_string(i).expect("plain values") + "\n").collect();
    atomic::write(path, lines.concat().as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn region(id: u32, polygon: &[[f64; 2]], transcription: &str) -> LabelledRegion {
        LabelledRegion {
            id,
            polygon: polygon.to_vec(),
            transcription: transcription.into(),
            script: None,
            kind: Kind::Text,
            ignore: transcription == UNREADABLE,
        }
    }

    const SQUARE: [[f64; 2]; 4] = [[1.0, 1.0], [9.5, 1.0], [9.0, 5.0], [1.0, 5.25]];

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("labels.jsonl");
        let mut custom = region(7, &SQUARE[..3], "カフェ \"x\"");
        (custom.kind, custom.script) = (Kind::Custom, Some("Katakana".into()));
        let images = vec![
            LabelledImage { image: "images/a.png".into(), regions: vec![region(0, &SQUARE, "OPEN"), custom] },
            LabelledImage { image: "images/b.png".into(), regions: vec![region(0, &SQUARE, UNREADABLE)] },
        ];
        save(&file, &images).unwrap();
        assert_eq!(load(&file).unwrap(), images);
    }

    #[test]
    fn errors_name_line_vertex_and_what_is_expected() {
        let line = |polygon: &str, text: &str| {
            format!(r#"{{"image":"a.png","regions":[{{"id":3,"polygon":{polygon},"transcription":"{text}"}}]}}"#)
        };
        let good = line("[[0,0],[4,0],[4,2],[0,2]]", "A");
        for (text, expected) in [
            (format!("{good}\n{}", line("[[0,0],[4,0]]", "A")), "line 2: region 3: 2 corners; a polygon has at least 3"),
            (line("[[0,0],[4,0],[9,0],[2,0]]", "A"), "line 1: region 3: its corners enclose no area"),
            (line("[[0,0],[6,2],[4,0],[0,2]]", "A"), "line 1: region 3: the side after vertex 0 crosses the side after vertex 2"),
            (format!("{good}\n\n{}", line("[[0,0],[4,0],[4,2],[0,2]]", "B")), "line 3: region 3 is \"B\", at line 1 it is \"A\""),
            (line("[[0,0],[4,0],[4,2],[0,\"x\"]]", "A"), "expected a line such as {\"image\""),
            ("{\"image\":\"a.png\"}".into(), "missing field `regions`"),
            ("{\"image\":\"a.png\",\"regions\":[]}".into(), "holds no region; label at least one"),
            (String::new(), "holds no region"),
        ] {
            let error = parse(&text).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("labels.jsonl");
        std::fs::write(&file, [good.as_bytes(), b"\n\xff"].concat()).unwrap();
        assert!(load(&file).unwrap_err().to_string().contains("labels.jsonl: line 2: not UTF-8 at byte"));
    }
}
