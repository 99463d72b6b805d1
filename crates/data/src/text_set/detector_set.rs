//! A folder of images with outlines of their writing, as detectors are trained and judged on: `images/` and `icdar15/gt_NAME.txt` for each
//! image, a line `x1,y1,…,x4,y4,text` per word. Where there is an `annotations.jsonl`, it tells the images' scenes and the words' poses.

use super::{ANNOTATIONS, SetImage, SetWord};
use crate::error::{DataError, Result};
use crate::text_labels::{self, Format, LabelledRegion};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Folder of the images.
pub const IMAGES: &str = "images";
/// Folder of the labels.
pub const LABELS: &str = "icdar15";
/// Endings of images that are read.
const ENDINGS: [&str; 3] = ["png", "jpg", "jpeg"];
/// Largest distance of a label's corner from the annotation's, in pixels: labels are rounded.
const SAME_CORNER_PX: f64 = 1.0;

/// An image and the outlines of its writing.
#[derive(Clone, Debug, PartialEq)]
pub struct DetectorImage {
    pub path: PathBuf,
    /// Told by the annotations, else by the name: what stands before the number at its end.
    pub scene: String,
    pub labels: Vec<DetectorLabel>,
}

/// A word of an image.
#[derive(Clone, Debug, PartialEq)]
pub struct DetectorLabel {
    pub region: LabelledRegion,
    /// Cluster of its pose, where it is known.
    pub cluster: Option<usize>,
    /// Rotation from the word to the camera as w, x, y, z, where it is known.
    pub quaternion: Option<[f64; 4]>,
}

/// Reads the labels of a data set; images are not opened. Sorted by name.
///
/// # Errors
/// When a folder is missing or empty, an image has no file of labels, or a line is wrong; the error names the file and the line.
pub fn read_set(folder: &Path) -> Result<Vec<DetectorImage>> {
    let images = images(&folder.join(IMAGES))?;
    let annotated = annotations(folder)?;
    images.into_iter().map(|path| image(folder, path, &annotated)).collect()
}

fn images(folder: &Path) -> Result<Vec<PathBuf>> {
    let wanted = "give a folder that holds images/ and icdar15/";
    let entries = std::fs::read_dir(folder).map_err(|e| DataError::input(folder, format!("{e}; {wanted}")))?;
    let all = entries.map(|e| e.map(|e| e.path())).collect::<std::io::Result<Vec<PathBuf>>>().map_err(DataError::io(folder, "read"))?;
    let is_image = |p: &PathBuf| ENDINGS.contains(&&*p.extension().unwrap_or_default().to_string_lossy().to_lowercase());
    let mut out: Vec<PathBuf> = all.into_iter().filter(is_image).collect();
    out.sort();
    if out.is_empty() {
        return Err(DataError::input(folder, format!("holds no image ({}); {wanted}", ENDINGS.join(", "))));
    }
    Ok(out)
}

fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

fn image(folder: &Path, path: PathBuf, annotated: &HashMap<String, SetImage>) -> Result<DetectorImage> {
    let stem = stem(&path);
    let file = folder.join(LABELS).join(format!("gt_{stem}.txt"));
    if !file.is_file() {
        return Err(DataError::input(file, format!("is missing; {} without writing has an empty file", path.display())));
    }
    let regions = text_labels::read_image(Format::Icdar15, &file)?;
    let known = annotated.get(&stem);
    let of = |region: LabelledRegion| {
        let far = |w: &SetWord| {
            let off = |(a, b): (&[f64; 2], &[f64; 2])| (a[0] - b[0]).abs().max((a[1] - b[1]).abs());
            region.polygon.iter().zip(&w.quad).map(off).fold(0.0, f64::max)
        };
        let words = known.iter().flat_map(|a| &a.words).filter(|w| far(w) <= SAME_CORNER_PX);
        let word = words.min_by(|a, b| far(a).total_cmp(&far(b)));
        let quaternion = word.and_then(|w| w.pose.as_ref()).map(|p| p.quaternion);
        DetectorLabel { cluster: word.and_then(|w| w.cluster), quaternion, region }
    };
    let scene = known.map_or_else(|| scene_of(&stem), |a| a.scene.clone());
    Ok(DetectorImage { labels: regions.into_iter().map(of).collect(), scene, path })
}

/// What stands before the number at the end of a name.
fn scene_of(stem: &str) -> String {
    let scene = stem.trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches(['-', '_', '.', ' ']);
    if scene.is_empty() { "all".into() } else { scene.into() }
}

/// Annotations by the names of images; none where there is no file.
fn annotations(folder: &Path) -> Result<HashMap<String, SetImage>> {
    if !folder.join(ANNOTATIONS).is_file() {
        return Ok(HashMap::new());
    }
    Ok(super::read(folder)?.into_iter().map(|a| (a.stem().to_string(), a)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn put(folder: &Path, name: &str, bytes: &[u8]) {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    #[test]
    fn labels_belong_to_images_and_annotations_tell_scene_and_pose() {
        let dir = tempfile::tempdir().unwrap();
        let d = dir.path();
        put(d, "images/b_002.png", b"");
        put(d, "images/a-1.JPG", b"");
        put(d, "images/notes.txt", b"");
        put(d, "icdar15/gt_a-1.txt", "\u{feff}1,2,11,2,11,6,1,6,A, B\r\n20,1,20,5,30,5,30,1,###\n".as_bytes());
        put(d, "icdar15/gt_b_002.txt", b"");
        let set = read_set(d).unwrap();
        assert_eq!(set.iter().map(|i| (&i.scene[..], i.labels.len())).collect::<Vec<_>>(), [("a", 2), ("b", 0)]);
        let [first, second] = &set[0].labels[..] else { panic!() };
        assert_eq!((&first.region.transcription[..], first.region.ignore, second.region.ignore), ("A, B", false, true));
        assert_eq!(second.region.polygon[1], [30.0, 1.0], "clockwise");
        let pose =
            r#"{"text_pose":[[1,0,0,0],[0,-1,0,0],[0,0,-1,3]],"quaternion":[0,1,0,0],"axis_angle":[3.141592653589793,0,0],"size":[1,1]}"#;
        let quad = "[[1.2,2.4],[11,2],[11,6],[1,6]]";
        let word = format!(r#"{{"id":0,"quad":{quad},"polygon":{quad},"transcription":"A","visibility":1,"cluster":5,"pose":{pose}}}"#);
        let line = format!(
            r#"{{"image":"images/a-1.JPG","width":40,"height":30,"intrinsic":[9,9,20,15],"world_from_camera":[[1,0,0,0],[0,1,0,0],[0,0,1,0]],"scene":"shop","words":[{word}]}}"#
        );
        put(d, ANNOTATIONS, line.as_bytes());
        let set = read_set(d).unwrap();
        assert_eq!((&set[0].scene[..], &set[1].scene[..]), ("shop", "b"));
        assert_eq!((set[0].labels[0].cluster, set[0].labels[1].cluster), (Some(5), None));
        assert_eq!(set[0].labels[0].quaternion, Some([0.0, 1.0, 0.0, 0.0]));
    }

    #[test]
    fn errors_name_file_line_and_cure() {
        let dir = tempfile::tempdir().unwrap();
        let d = dir.path();
        let error = || read_set(d).unwrap_err().to_string();
        assert!(error().contains("images") && error().contains("icdar15/"), "{}", error());
        std::fs::create_dir_all(d.join("images")).unwrap();
        assert!(error().contains("holds no image (png"), "{}", error());
        put(d, "images/a.png", b"");
        assert!(error().contains("gt_a.txt") && error().contains("has an empty file"), "{}", error());
        for (text, expected) in [
            ("1,2,3", "line 1: 3 fields; expected x1,y1"),
            ("0,0,4,0,4,2,0,2,A\n0,0,6,2,4,0,0,2,B", "line 2: the side after vertex 0 crosses"),
            ("0,0,4,0,4,x,0,2,A", "line 1: \"x\" is not a number"),
        ] {
            put(d, "icdar15/gt_a.txt", text.as_bytes());
            assert!(error().contains("gt_a.txt") && error().contains(expected), "{}", error());
        }
        put(d, "icdar15/gt_a.txt", b"");
        put(d, ANNOTATIONS, b"\n{}");
        assert!(error().contains("annotations.jsonl: line 2: missing field"), "{}", error());
        assert_eq!((scene_of("017"), scene_of("s-01 .9")), ("all".into(), "s-01".into()));
    }
}
