//! Labels of writing in the formats of annotation programs and benchmarks.
//!
//! | Format | File | Line or object |
//! |---|---|---|
//! | labelme | one JSON per image | `imagePath`, `shapes: [{label, points, group_id, shape_type}]`; `group_id` is the region's id |
//! | PPOCR | `Label.txt` | `PATH`, a tab, `[{"transcription", "points", "difficult"}]` |
//! | ICDAR 2013 | `gt_NAME.txt` | `left top right bottom "text"`, also with commas |
//! | ICDAR 2015 | `gt_NAME.txt` | `x1,y1,…,x4,y4,text` |
//! | MLT 2017 | `gt_NAME.txt` | `x1,y1,…,x4,y4,script,text` |
//!
//! Formats without ids: the k-th region with a text in one image is the k-th with that text in the others.

use super::{Kind, LIMIT, LabelledImage, LabelledRegion, UNREADABLE, check_polygon, known_texts};
use crate::error::{DataError, Result, read};
use serde::Deserialize;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

/// Formats that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    Labelme,
    Ppocr,
    Icdar13,
    Icdar15,
    Mlt17,
}

impl Format {
    pub const ALL: [Format; 5] = [Format::Labelme, Format::Ppocr, Format::Icdar13, Format::Icdar15, Format::Mlt17];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Format::Labelme => "labelme",
            Format::Ppocr => "ppocr",
            Format::Icdar13 => "icdar13",
            Format::Icdar15 => "icdar15",
            Format::Mlt17 => "mlt17",
        }
    }

    /// What a label looks like, for errors.
    fn example(self) -> &'static str {
        match self {
            Format::Labelme => {
                r#"{"imagePath": "001.png", "shapes": [{"label": "CAFE", "points": [[10,8],[90,10],[90,30],[10,28]], "group_id": 0}]}"#
            }
            Format::Ppocr => r#"001.png, a tab, [{"transcription": "CAFE", "points": [[10,8],[90,10],[90,30],[10,28]]}]"#,
            Format::Icdar13 => r#"10 8 90 30 "CAFE""#,
            Format::Icdar15 => "10,8,90,10,90,30,10,28,CAFE",
            Format::Mlt17 => "10,8,90,10,90,30,10,28,Latin,CAFE",
        }
    }

    /// The format of a name.
    pub fn named(name: &str) -> Option<Format> {
        Format::ALL.into_iter().find(|f| f.name() == name)
    }
}

/// A region as a file says it.
struct ParsedRegion {
    id: Option<u32>,
    polygon: Vec<[f64; 2]>,
    transcription: String,
    script: Option<String>,
    is_difficult: bool,
    /// Where it is said, for errors: a line or an object.
    at: String,
}

/// An image as a file says it.
struct ParsedImage {
    file: PathBuf,
    image: String,
    regions: Vec<ParsedRegion>,
}

/// An image that labels may belong to.
#[derive(Clone, Debug, PartialEq)]
pub struct Known {
    /// Path relative to the capture's folder.
    pub path: String,
    pub size: (u32, u32),
}

/// Reads labels of a file or folder for images of a capture.
///
/// # Errors
/// With file and line or object, when something is not of the format, an image is not one of `known`, a polygon is not simple or leaves its
/// image, one id has two texts, or nothing is labelled.
pub fn import(format: Format, path: &Path, known: &[Known]) -> Result<Vec<LabelledImage>> {
    let files = files(format, path)?;
    let mut said = Vec::new();
    for file in files {
        let bytes = read(&file, LIMIT)?;
        let images = super::utf8(&bytes).and_then(|text| said_in(format, &file, text));
        said.extend(images.map_err(|e| DataError::input(&file, e))?);
    }
    let most = said.iter().flat_map(|i| &i.regions).filter_map(|r| r.id).max();
    let mut next = most.map_or(Some(0), |id| id.checked_add(1));
    let mut ids: HashMap<(String, usize), u32> = HashMap::new();
    let (mut out, mut texts) = (BTreeMap::<String, (Vec<LabelledRegion>, HashMap<String, usize>)>::new(), HashMap::new());
    for image in said.into_iter().filter(|i| !i.regions.is_empty()) {
        let at = match_image(&image, known)?;
        let (regions, counts) = out.entry(at.path.clone()).or_default();
        for region in image.regions {
            let wrong = |e: String| DataError::input(&image.file, format!("{}: {e}", region.at));
            check_polygon(&region.polygon).map_err(wrong)?;
            inside(&region.polygon, at.size).map_err(wrong)?;
            let is_read = region.transcription != UNREADABLE && !region.transcription.is_empty();
            let count = counts.entry(region.transcription.clone()).or_default();
            *count += 1;
            let known_id = if is_read { ids.get(&(region.transcription.clone(), *count)).copied() } else { None };
            let id = match region.id.or(known_id) {
                Some(id) => id,
                None => {
                    let new = next.ok_or_else(|| wrong("an id is as large as ids can be; use smaller ones".into()))?;
                    next = new.checked_add(1);
                    new
                }
            };
            if is_read && region.id.is_none() {
                ids.insert((region.transcription.clone(), *count), id);
            }
            if regions.iter().any(|r| r.id == id) {
                return Err(wrong(format!("region {id} is labelled twice in {}; give each region an id of its own", at.path)));
            }
            let transcription = if is_read { region.transcription.clone() } else { UNREADABLE.into() };
            let place = format!("{}, {}", image.file.file_name().unwrap_or_default().to_string_lossy(), region.at);
            known_texts(&mut texts, id, &transcription, &place).map_err(|e| DataError::input(&image.file, e))?;
            let ignore = region.is_difficult || !is_read;
            let polygon = clockwise(region.polygon);
            regions.push(LabelledRegion { id, polygon, transcription, script: region.script, kind: Kind::Text, ignore });
        }
    }
    if out.is_empty() {
        let (name, example) = (format.name(), format.example());
        return Err(DataError::input(path, format!("holds no label of the format {name}; label at least one region, as in {example}")));
    }
    Ok(out.into_iter().map(|(image, (regions, _))| LabelledImage { image, regions }).collect())
}

/// Regions that a text of a format lists.
///
/// # Errors
/// With the line or object, when it is not of the format.
pub fn count(format: Format, text: &str) -> std::result::Result<usize, String> {
    Ok(said_in(format, Path::new("gt_0.txt"), text)?.iter().map(|i| i.regions.len()).sum())
}

/// Regions of one file of a format that has a file per image, in their order; ids count them from 0.
///
/// # Errors
/// With file and line, when something is not of the format or a polygon is not simple.
pub fn read_image(format: Format, file: &Path) -> Result<Vec<LabelledRegion>> {
    let bytes = read(file, LIMIT)?;
    let wrong = |e: String| DataError::input(file, e);
    let image = super::utf8(&bytes).and_then(|text| lines(format, file, text)).map_err(wrong)?;
    let of = |(id, r): (usize, ParsedRegion)| {
        check_polygon(&r.polygon).map_err(|e| wrong(format!("{}: {e}", r.at)))?;
        let is_read = r.transcription != UNREADABLE && !r.transcription.is_empty();
        let (polygon, transcription) = (clockwise(r.polygon), if is_read { r.transcription } else { UNREADABLE.into() });
        Ok(LabelledRegion { id: id as u32, polygon, transcription, script: r.script, kind: Kind::Text, ignore: !is_read })
    };
    image.regions.into_iter().enumerate().map(of).collect()
}

/// What a file says.
fn said_in(format: Format, file: &Path, text: &str) -> std::result::Result<Vec<ParsedImage>, String> {
    match format {
        Format::Labelme => labelme(file, text),
        Format::Ppocr => ppocr(file, text),
        _ => lines(format, file, text).map(|i| vec![i]),
    }
}

/// The files of a format at a path, sorted.
fn files(format: Format, path: &Path) -> Result<Vec<PathBuf>> {
    if path.is_file() {
        return Ok(vec![path.to_path_buf()]);
    }
    let entries = std::fs::read_dir(path).map_err(|e| DataError::input(path, format!("{e}; give a file or folder of labels")))?;
    let is_of = |p: &PathBuf| {
        let name = p.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        match format {
            Format::Labelme => name.ends_with(".json"),
            Format::Ppocr => name == "label.txt",
            _ => name.ends_with(".txt"),
        }
    };
    let all = entries.map(|e| e.map(|e| e.path())).collect::<std::io::Result<Vec<PathBuf>>>().map_err(DataError::io(path, "read"))?;
    let mut out: Vec<PathBuf> = all.into_iter().filter(is_of).collect();
    out.sort();
    if out.is_empty() {
        let wanted = match format {
            Format::Labelme => "*.json",
            Format::Ppocr => "Label.txt",
            _ => "gt_NAME.txt",
        };
        return Err(DataError::input(path, format!("holds no {wanted}, as {} has; give another folder or --format", format.name())));
    }
    Ok(out)
}

/// The capture's image that labels name: by its path, its file name, or its name without an extension.
fn match_image<'k>(image: &ParsedImage, known: &'k [Known]) -> Result<&'k Known> {
    let name = |p: &str| p.rsplit(['/', '\\']).next().unwrap_or(p).to_string();
    let stem = |p: &str| Path::new(&name(p)).file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let said = &image.image;
    let rules: [&dyn Fn(&Known) -> bool; 4] =
        [&|k| k.path == *said, &|k| name(&k.path) == name(said), &|k| stem(&k.path) == *said, &|k| stem(&k.path) == stem(said)];
    for rule in rules {
        match known.iter().filter(|k| rule(k)).collect::<Vec<_>>()[..] {
            [] => (),
            [one] => return Ok(one),
            [a, b, ..] => {
                let message = format!("labels {said:?}, which may be {:?} or {:?}; name the photograph by its path", a.path, b.path);
                return Err(DataError::input(&image.file, message));
            }
        }
    }
    let example = known.first().map_or("none", |k| &k.path[..]);
    let message = format!("labels {said:?}, which is no photograph of the capture; those are like {example:?}");
    Err(DataError::input(&image.file, message))
}

/// Whether all corners are in the image, up to a pixel.
fn inside(polygon: &[[f64; 2]], (w, h): (u32, u32)) -> std::result::Result<(), String> {
    let is_in = |p: &[f64; 2]| (-1.0..=w as f64 + 1.0).contains(&p[0]) && (-1.0..=h as f64 + 1.0).contains(&p[1]);
    match polygon.iter().position(|p| !is_in(p)) {
        Some(k) => Err(format!("vertex {k} at {}, {} is outside of the photograph of {w}×{h}", polygon[k][0], polygon[k][1])),
        None => Ok(()),
    }
}

/// The polygon clockwise (y down), from the same corner.
fn clockwise(mut polygon: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    let n = polygon.len();
    let area: f64 = (0..n).map(|k| polygon[k][0] * polygon[(k + 1) % n][1] - polygon[k][1] * polygon[(k + 1) % n][0]).sum();
    if area < 0.0 {
        polygon[1..].reverse();
    }
    polygon
}

#[derive(Deserialize)]
struct LabelmeFile {
    #[serde(rename = "imagePath")]
    image_path: String,
    shapes: Vec<LabelmeShape>,
}

#[derive(Deserialize)]
struct LabelmeShape {
    label: String,
    points: Vec<[f64; 2]>,
    group_id: Option<u32>,
    #[serde(default)]
    shape_type: Option<String>,
}

fn labelme(file: &Path, text: &str) -> std::result::Result<Vec<ParsedImage>, String> {
    let read: LabelmeFile = serde_json::from_str(text).map_err(|e| format!("{e}; expected labelme's imagePath and shapes"))?;
    let mut regions = Vec::new();
    for (k, shape) in read.shapes.into_iter().enumerate() {
        let polygon = match (shape.shape_type.as_deref().unwrap_or("polygon"), &shape.points[..]) {
            ("polygon", _) => shape.points,
            ("rectangle", [[x0, y0], [x1, y1]]) => {
                let ([x0, x1], [y0, y1]) = ([x0.min(*x1), x0.max(*x1)], [y0.min(*y1), y0.max(*y1)]);
                vec![[x0, y0], [x1, y0], [x1, y1], [x0, y1]]
            }
            (kind, _) => return Err(format!("shape {k} is a {kind} of {} points; expected polygons or rectangles", shape.points.len())),
        };
        let at = format!("shape {k}");
        regions.push(ParsedRegion { id: shape.group_id, polygon, transcription: shape.label, script: None, is_difficult: false, at });
    }
    Ok(vec![ParsedImage { file: file.into(), image: read.image_path, regions }])
}

#[derive(Deserialize)]
struct PpocrRegion {
    transcription: String,
    points: Vec<[f64; 2]>,
    #[serde(default)]
    difficult: bool,
}

fn ppocr(file: &Path, text: &str) -> std::result::Result<Vec<ParsedImage>, String> {
    let expected = r#"expected PATH, a tab and [{"transcription": "TEXT", "points": [[x, y], …]}]"#;
    let mut out = Vec::new();
    for (n, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let at = format!("line {}", n + 1);
        let (image, list) = line.split_once('\t').ok_or_else(|| format!("{at}: no tab; {expected}"))?;
        let list: Vec<PpocrRegion> = serde_json::from_str(list).map_err(|e| format!("{at}: {e}; {expected}"))?;
        let said = |(k, r): (usize, PpocrRegion)| ParsedRegion {
            id: None,
            polygon: r.points,
            transcription: r.transcription,
            script: None,
            is_difficult: r.difficult,
            at: format!("{at}, region {k}"),
        };
        let regions = list.into_iter().enumerate().map(said).collect();
        out.push(ParsedImage { file: file.into(), image: image.into(), regions });
    }
    Ok(out)
}

/// The formats of ICDAR, a region per line.
fn lines(format: Format, file: &Path, text: &str) -> std::result::Result<ParsedImage, String> {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let image = stem.strip_prefix("gt_").unwrap_or(&stem).to_string();
    let mut regions = Vec::new();
    for (n, line) in text.trim_start_matches('\u{feff}').lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let at = format!("line {}", n + 1);
        let said = if format == Format::Icdar13 { icdar13(line) } else { corners(line, format == Format::Mlt17) };
        let (polygon, script, transcription) = said.map_err(|e| format!("{at}: {e}"))?;
        regions.push(ParsedRegion { id: None, polygon, transcription, script, is_difficult: false, at });
    }
    Ok(ParsedImage { file: file.into(), image, regions })
}

type Line = (Vec<[f64; 2]>, Option<String>, String);

fn number(field: &str) -> std::result::Result<f64, String> {
    field.trim().parse().map_err(|_| format!("{field:?} is not a number"))
}

/// `left top right bottom "text"`
fn icdar13(line: &str) -> std::result::Result<Line, String> {
    let expected = || format!("{line:?}: expected left top right bottom \"text\"");
    let (numbers, quoted) = line.split_once('"').ok_or_else(expected)?;
    let text = quoted.rsplit_once('"').ok_or_else(expected)?.0;
    let fields: Vec<&str> = numbers.split([' ', ',', '\t']).filter(|f| !f.is_empty()).collect();
    let [left, top, right, bottom] = fields[..].try_into().map_err(|_| expected())?;
    let [x0, y0, x1, y1] = [number(left)?, number(top)?, number(right)?, number(bottom)?];
    Ok((vec![[x0, y0], [x1, y0], [x1, y1], [x0, y1]], None, text.into()))
}

/// `x1,y1,…,x4,y4[,script],text`; the text may hold commas.
fn corners(line: &str, has_script: bool) -> std::result::Result<Line, String> {
    let count = 9 + has_script as usize;
    let fields: Vec<&str> = line.splitn(count, ',').collect();
    if fields.len() < count {
        let script = if has_script { "script," } else { "" };
        return Err(format!("{} fields; expected x1,y1,x2,y2,x3,y3,x4,y4,{script}text", fields.len()));
    }
    let numbers = fields[..8].iter().map(|f| number(f)).collect::<std::result::Result<Vec<f64>, String>>()?;
    let polygon = numbers.chunks_exact(2).map(|p| [p[0], p[1]]).collect();
    let script = has_script.then(|| fields[8].trim().to_string());
    Ok((polygon, script, fields[count - 1].trim_end_matches('\r').to_string()))
}

#[cfg(test)]
#[path = "formats_tests.rs"]
mod tests;
