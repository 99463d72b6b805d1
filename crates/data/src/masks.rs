//! Masks: where they are found beside photographs, what they leave out, and how they are read.

use crate::error::{DataError, Result};
use crate::photo::{self, Photo};
use diorama_geom::capture::{Frame, MaskMeaning, MaskRule};
use diorama_geom::{Image, ImageU8};
use rayon::prelude::*;
use std::collections::HashMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// Folder names that may contain masks.
const FOLDERS: [&str; 2] = ["masks", "mask"];
/// Most masks that are decoded to choose their meaning, and the side in pixels at which they are examined.
const EXAMINED_MASKS: usize = 16;
const EXAMINED_PX: usize = 96;
/// What masks of [`MaskMeaning::Classes`] mark: what stays, glass, and the sky.
pub const STATIC_CLASS: u8 = 255;
pub const GLASS_CLASS: u8 = 192;
pub const SKY_CLASS: u8 = 160;
/// Mask values from this on are kept.
pub const COUNTS: u8 = 128;
/// Mask values of glass, which masks mark with 192: it is kept as a surface, but what it mirrors and lets through tells nothing about the
/// light on it. Around 192, because masks are resampled.
pub const GLASS: RangeInclusive<u8> = 176..=208;
/// Mask values of the sky, which masks of [`MaskMeaning::Classes`] mark with 160: it is empty space. Between it and what is static lies glass, so
/// that borders in resampled masks count as surfaces.
pub const SKY: RangeInclusive<u8> = 144..=175;
/// Masks show one object if they keep at most this share of the picture and at most this share of its border.
const OBJECT: (f64, f64) = (0.6, 0.1);
/// Masks are considered identical if at most this share of their pixels differs.
const SAME: f64 = 0.01;
/// Largest difference between the aspect ratios of a mask and its photograph.
const ASPECT: f64 = 0.01;

/// What to do with masks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MaskUse {
    /// Black pixels are left out.
    #[default]
    Use,
    /// White pixels are left out.
    Invert,
    /// Masks are ignored.
    Ignore,
}

impl std::str::FromStr for MaskUse {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s {
            "use" => Ok(MaskUse::Use),
            "invert" => Ok(MaskUse::Invert),
            "ignore" => Ok(MaskUse::Ignore),
            _ => Err(format!("mask {s:?}: expected use, invert or ignore")),
        }
    }
}

/// Options for the masks of a capture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MaskOptions {
    pub usage: MaskUse,
    /// `None`: chosen from what the masks cover.
    pub meaning: Option<MaskMeaning>,
}

/// Parses a meaning; `None` for `auto`.
///
/// # Errors
/// If the text is not auto, object, unknown or classes.
pub fn parse_meaning(s: &str) -> std::result::Result<Option<MaskMeaning>, String> {
    match s {
        "auto" => Ok(None),
        "object" => Ok(Some(MaskMeaning::Object)),
        "unknown" => Ok(Some(MaskMeaning::Unknown)),
        "classes" => Ok(Some(MaskMeaning::Classes)),
        _ => Err(format!("mask meaning {s:?}: expected auto, object, unknown or classes")),
    }
}

/// Assigns masks that lie beside the photographs to frames that name none, and chooses what masks mean: as in the options, else as
/// `stated` in the capture's file, else from what they cover. The choice is added to `notes`.
///
/// # Errors
/// If a mask that is examined cannot be decoded, or has another aspect ratio than its photograph.
pub fn assign(
    root: &Path,
    frames: &mut [Frame],
    options: &MaskOptions,
    stated: Option<MaskMeaning>,
    notes: &mut Vec<String>,
) -> Result<MaskRule> {
    let mut finder = Finder { root, folders: HashMap::new() };
    for f in frames.iter_mut().filter(|f| f.mask.is_none()) {
        f.mask = finder.find(&f.image);
    }
    let with: Vec<&Frame> = frames.iter().filter(|f| f.mask.is_some()).collect();
    if with.is_empty() {
        notes.extend(finder.unused());
        return Ok(MaskRule::default());
    }
    let count = format!("{} of {} photographs", with.len(), frames.len());
    if options.usage == MaskUse::Ignore {
        notes.push(format!("masks of {count} are ignored (--mask ignore)"));
        frames.iter_mut().for_each(|f| f.mask = None);
        return Ok(MaskRule::default());
    }
    let inverted = options.usage == MaskUse::Invert;
    let (meaning, why) = match (options.meaning, stated) {
        (Some(m), _) => (m, "as --mask-meaning says".to_string()),
        (None, Some(m)) if !inverted => (m, "as the capture's file says".to_string()),
        _ => choose_meaning(&with, frames.len(), inverted)?,
    };
    let place = with[0].mask.as_ref().and_then(|m| m.parent()).unwrap_or(root).display();
    let read = if inverted { ", white left out (--mask invert)" } else { "" };
    notes.push(match meaning {
        MaskMeaning::Object => format!(
            "masks for {count} (in {place}{read}): what they leave out is empty space, {why}; \
             --mask-meaning unknown leaves it open, --mask invert keeps the rest instead, --mask ignore uses none"
        ),
        MaskMeaning::Unknown => format!(
            "masks for {count} (in {place}{read}): what they leave out is neither trained on nor scored, {why}; \
             --mask-meaning object makes it empty space, --mask invert keeps the rest instead, --mask ignore uses none"
        ),
        MaskMeaning::Classes => format!(
            "masks for {count} (in {place}{read}): 255 is static, 192 glass, 160 sky, which is empty space, and 0 is neither trained on nor \
             scored, {why}; --mask ignore uses none"
        ),
    });
    Ok(MaskRule { meaning, inverted })
}

/// Finds mask files; the files of each folder are indexed by lower-case name.
struct Finder<'a> {
    root: &'a Path,
    folders: HashMap<PathBuf, HashMap<String, PathBuf>>,
}

impl Finder<'_> {
    /// The mask of a photograph: `dynamic_mask_NAME.png` beside it, or `NAME.png`, `NAME.jpg.png` and the like in a mask folder beside the
    /// folder of photographs or below the root.
    fn find(&mut self, image: &Path) -> Option<PathBuf> {
        let stem = image.file_stem()?.to_string_lossy().to_lowercase();
        let whole = image.file_name()?.to_string_lossy().to_lowercase();
        let folder = image.parent()?;
        if let Some(found) = self.named(folder, &format!("{}{stem}", photo::DYNAMIC_MASK)) {
            return Some(found);
        }
        let inside = folder.strip_prefix(self.root).unwrap_or(Path::new(""));
        let parts: Vec<_> = inside.components().collect();
        let mut candidates = Vec::new();
        for name in FOLDERS {
            // Nearest folder first: the masks of `a/images/b` may be in `a/images/masks`, `a/masks/b` or `masks/images/b`.
            for k in (0..parts.len()).rev() {
                let (before, after): (PathBuf, PathBuf) = (parts[..k].iter().collect(), parts[k + 1..].iter().collect());
                let called = parts[k].as_os_str().to_string_lossy();
                // `masks_4` belongs to `images_4`.
                let suffix = called.strip_prefix("images").unwrap_or("");
                if !suffix.is_empty() {
                    candidates.push(self.root.join(&before).join(format!("{name}{suffix}")).join(&after));
                }
                candidates.push(self.root.join(&before).join(name).join(&after));
            }
            candidates.push(self.root.join(name).join(inside));
            candidates.push(self.root.join(name));
            candidates.push(folder.join(name));
        }
        candidates.into_iter().find_map(|c| self.named(&c, &whole).or_else(|| self.named(&c, &stem)))
    }

    /// Finds an image file in a folder by its name without extension.
    fn named(&mut self, folder: &Path, name: &str) -> Option<PathBuf> {
        let files = self.folders.entry(folder.to_path_buf()).or_insert_with(|| {
            let entries = folder.read_dir().into_iter().flatten().flatten().map(|e| e.path()).filter(|p| p.is_file());
            entries.map(|p| (p.file_name().unwrap_or_default().to_string_lossy().to_lowercase(), p)).collect()
        });
        ["png", "jpg", "jpeg", "webp", "tif", "tiff"].iter().find_map(|e| files.get(&format!("{name}.{e}")).cloned())
    }

    /// A note on a mask folder in which no photograph has a mask.
    fn unused(&self) -> Option<String> {
        let is_folder = |p: &&PathBuf| p.file_name().is_some_and(|n| FOLDERS.contains(&&*n.to_string_lossy()));
        let with_files = self.folders.iter().filter(|(_, files)| !files.is_empty()).map(|(p, _)| p);
        let folder = with_files.filter(is_folder).min()?;
        Some(format!("no file in {} is named after a photograph, so none is a mask; name them NAME.png or NAME.jpg.png", folder.display()))
    }
}

/// Chooses the meaning of some frames' masks, with the reason.
fn choose_meaning(with: &[&Frame], frames: usize, inverted: bool) -> Result<(MaskMeaning, String)> {
    let is_dynamic = |f: &&Frame| f.mask.as_ref().is_some_and(|m| marks_ignored(m));
    if with.iter().all(is_dynamic) {
        return Ok((MaskMeaning::Unknown, format!("as {}* files mean", photo::DYNAMIC_MASK)));
    }
    if with.len() < frames {
        return Ok((MaskMeaning::Unknown, "because some photographs have none".into()));
    }
    let step = with.len().div_ceil(EXAMINED_MASKS);
    let opened: Vec<&&Frame> = with.iter().step_by(step).collect();
    let rule = MaskRule { meaning: MaskMeaning::Unknown, inverted };
    let looks: Vec<Vec<bool>> = opened.par_iter().map(|f| look(f, &rule)).collect::<Result<_>>()?;
    let share = |of: &dyn Fn(&[bool]) -> f64| looks.iter().map(|l| of(l)).sum::<f64>() / looks.len() as f64;
    let kept = share(&kept_share);
    let says = |what: &str| format!("because they keep {:.0} % of the pictures{what}", 100.0 * kept);
    let differ = |a: &[bool], b: &[bool]| a.iter().zip(b).filter(|(a, b)| a != b).count() as f64 / a.len() as f64;
    if looks.len() > 1 && looks.iter().all(|l| differ(l, &looks[0]) <= SAME) {
        return Ok((MaskMeaning::Unknown, says(", the same part of each")));
    }
    let shows_object = |l: &Vec<bool>| kept_share(l) <= OBJECT.0 && border_share(l) <= OBJECT.1;
    // In a few photographs the object may be cut off by the border.
    let showing = looks.iter().filter(|l| shows_object(l)).count();
    if kept > 0.001 && showing * 10 >= looks.len() * 9 {
        Ok((MaskMeaning::Object, says(", away from their borders: one object is cut out")))
    } else {
        Ok((MaskMeaning::Unknown, says("")))
    }
}

/// Which pixels of a mask are kept, at [`EXAMINED_PX`] squared.
fn look(f: &Frame, rule: &MaskRule) -> Result<Vec<bool>> {
    let c = &f.camera;
    let Some(mask) = of_frame(f, rule, (c.width as usize, c.height as usize))? else { return Ok(vec![true; EXAMINED_PX * EXAMINED_PX]) };
    Ok(mask.downsampled(EXAMINED_PX, EXAMINED_PX).data.iter().map(|v| *v >= COUNTS).collect())
}

fn kept_share(l: &[bool]) -> f64 {
    l.iter().filter(|v| **v).count() as f64 / l.len() as f64
}

fn border_share(l: &[bool]) -> f64 {
    let n = EXAMINED_PX;
    let rim = (0..n * n).filter(|i| [i % n, i / n].iter().any(|v| *v == 0 || *v == n - 1));
    let (kept, all) = rim.fold((0, 0), |(kept, all), i| (kept + l[i] as usize, all + 1));
    kept as f64 / all as f64
}

/// Whether a mask marks the pixels to leave out, as instant-ngp's do, instead of those to keep.
fn marks_ignored(mask: &Path) -> bool {
    mask.file_name().is_some_and(|n| n.to_string_lossy().starts_with(photo::DYNAMIC_MASK))
}

/// The mask of a frame at the size of its photograph, if it has one: 255 for kept pixels, 0 for the others.
///
/// # Errors
/// If it cannot be decoded, or has another aspect ratio than the photograph.
pub fn of_frame(frame: &Frame, rule: &MaskRule, (width, height): (usize, usize)) -> Result<Option<ImageU8>> {
    let Some(path) = &frame.mask else { return Ok(None) };
    let mut mask = photo::load_mask(path)?;
    let (mw, mh) = (mask.width as f64, mask.height as f64);
    // Sizes are whole pixels, so the aspect ratio of small pictures is inexact.
    let (by_width, by_height) = (width as f64 * mh / mw, height as f64);
    if (by_width - by_height).abs() > (ASPECT * by_height).max(1.0 + mh / mw) {
        return Err(DataError::input(
            path,
            format!(
                "the mask is {}×{} but the photograph {} is {width}×{height}: their shapes differ; give the mask of this photograph",
                mask.width,
                mask.height,
                frame.image.display()
            ),
        ));
    }
    // Masks may hold class numbers instead of gray values: 1 is kept.
    if mask.data.iter().all(|v| *v <= 1) {
        mask.data.iter_mut().for_each(|v| *v *= 255);
    }
    if rule.inverted {
        mask.data.iter_mut().for_each(|v| *v = 255 - *v);
    }
    Ok(Some(mask.downsampled(width, height)))
}

/// A photograph whose pixels outside the mask are transparent, at its full range of values.
pub fn cut_out(photo: &Photo, mask: &ImageU8) -> Photo {
    let in_floats = |im: &Image| {
        let data = rgba(&im.data, im.channels, 1.0, mask, |alpha, m| alpha * m as f32 / 255.0);
        Image { channels: 4, data, ..*im }
    };
    match photo {
        Photo::Eight(im) => {
            let data = rgba(&im.data, im.channels, 255, mask, |alpha, m| ((alpha as u32 * m as u32 + 127) / 255) as u8);
            Photo::Eight(ImageU8 { channels: 4, data, ..*im })
        }
        Photo::Sixteen(im) => Photo::Sixteen(in_floats(im)),
        Photo::Linear(im) => Photo::Linear(in_floats(im)),
    }
}

/// Pixels with new alpha, which `through` computes from their own alpha and the mask.
fn rgba<T: Copy>(data: &[T], channels: usize, opaque: T, mask: &ImageU8, through: impl Fn(T, u8) -> T) -> Vec<T> {
    let pixels = data.chunks_exact(channels).zip(&mask.data).flat_map(|(p, m)| {
        let at = |k: usize| p[k.min(p.len() - 1)];
        let alpha = if p.len() == 4 { p[3] } else { opaque };
        [at(0), at(1), at(2), through(alpha, *m)]
    });
    pixels.collect()
}

/// A photograph with its mask applied: transparent pixels if masks mean an object, else the mask itself, and a transparent sky where masks mark it.
///
/// # Errors
/// As [`of_frame`].
pub fn apply(frame: &Frame, rule: &MaskRule, photo: Photo) -> Result<(Photo, Option<ImageU8>)> {
    match of_frame(frame, rule, photo.size())? {
        None => Ok((photo, None)),
        Some(mask) if rule.meaning == MaskMeaning::Object => Ok((cut_out(&photo, &mask), None)),
        Some(mask) if rule.meaning == MaskMeaning::Classes && mask.data.iter().any(|v| SKY.contains(v)) => {
            let matter = mask.data.iter().map(|v| if SKY.contains(v) { 0 } else { 255 }).collect();
            Ok((cut_out(&photo, &ImageU8 { data: matter, ..mask.clone() }), Some(mask)))
        }
        Some(mask) => Ok((photo, Some(mask))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::{Camera, Pose};

    const SIZE: (usize, usize) = (60, 40);

    /// Frames with photographs at `images` (without pixels) and masks as `inside` says, in `masks`.
    fn frames(root: &Path, n: usize, inside: impl Fn(usize, f64, f64) -> bool) -> Vec<Frame> {
        let (w, h) = SIZE;
        std::fs::create_dir_all(root.join("images")).unwrap();
        std::fs::create_dir_all(root.join("masks")).unwrap();
        (0..n)
            .map(|i| {
                let image = root.join(format!("images/P_{i}.JPG"));
                std::fs::write(&image, b"").unwrap();
                let at = |p: usize| ((p % w) as f64 / w as f64, (p / w) as f64 / h as f64);
                let data = (0..w * h).map(|p| if inside(i, at(p).0, at(p).1) { 255 } else { 0 }).collect();
                let mask = ImageU8 { width: w, height: h, channels: 1, data };
                photo::save_png(&root.join(format!("masks/p_{i}.png")), &mask).unwrap();
                Frame::new(format!("P_{i}"), image, Camera::pinhole(w as u32, h as u32, 1.0), Pose::IDENTITY)
            })
            .collect()
    }

    fn settled(root: &Path, frames: &mut [Frame], options: MaskOptions) -> (MaskRule, String) {
        let mut notes = Vec::new();
        let rule = assign(root, frames, &options, None, &mut notes).unwrap();
        (rule, notes.join("\n"))
    }

    fn in_the_middle(i: usize, x: f64, y: f64) -> bool {
        (x - 0.4 - 0.02 * i as f64).hypot(y - 0.5) < 0.3
    }

    #[test]
    fn what_masks_cover_tells_what_they_mean() {
        let meaning = |inside: &dyn Fn(usize, f64, f64) -> bool| {
            let dir = tempfile::tempdir().unwrap();
            let mut f = frames(dir.path(), 6, inside);
            let (rule, note) = settled(dir.path(), &mut f, MaskOptions::default());
            assert!(f.iter().all(|f| f.mask.is_some()) && note.contains("6 of 6"), "{note}");
            (rule.meaning, note)
        };
        let (thing, note) = meaning(&in_the_middle);
        assert!(thing == MaskMeaning::Object && note.contains("empty space") && note.contains("--mask-meaning unknown"), "{note}");
        let passer_by = |i: usize, x: f64, y: f64| !in_the_middle(i, x, y);
        assert_eq!(meaning(&passer_by).0, MaskMeaning::Unknown);
        let lens = |_: usize, x: f64, y: f64| (x - 0.5).hypot(y - 0.5) < 0.3;
        let (same, note) = meaning(&lens);
        assert!(same == MaskMeaning::Unknown && note.contains("the same part"), "{note}");
        let sky = |i: usize, _: f64, y: f64| y > 0.5 + 0.01 * i as f64;
        assert_eq!(meaning(&sky).0, MaskMeaning::Unknown);
    }

    #[test]
    fn usage_and_meaning_can_be_set() {
        let dir = tempfile::tempdir().unwrap();
        let all = frames(dir.path(), 5, in_the_middle);
        let with = |usage, meaning| {
            let mut f = all.clone();
            let (rule, note) = settled(dir.path(), &mut f, MaskOptions { usage, meaning });
            (f, rule, note)
        };
        let (f, rule, _) = with(MaskUse::Use, Some(MaskMeaning::Unknown));
        assert_eq!((rule.meaning, rule.inverted), (MaskMeaning::Unknown, false));
        let mask = |rule| of_frame(&f[0], &rule, SIZE).unwrap().unwrap();
        assert_eq!((mask(rule).pixel(24, 20), mask(rule).pixel(1, 1)), (&[255][..], &[0][..]));
        let (_, rule, note) = with(MaskUse::Invert, None);
        assert!(rule.inverted && rule.meaning == MaskMeaning::Unknown && note.contains("invert"), "{note}");
        assert_eq!(mask(rule).pixel(1, 1), [255]);
        let (f, _, note) = with(MaskUse::Ignore, None);
        assert!(f.iter().all(|f| f.mask.is_none()) && note.contains("ignored"), "{note}");
    }

    #[test]
    fn masks_are_found_where_people_put_them() {
        for (photo, mask) in [
            ("images/a.jpg", "masks/a.png"),
            ("images/a.JPG", "masks/a.jpg"),
            ("images/a.jpg", "masks/a.jpg.png"),
            ("images/in/a.jpg", "masks/in/a.jpg.png"),
            ("images_4/a.png", "masks_4/a.png"),
            ("images_4/a.png", "masks/a.png"),
            ("a.png", "mask/a.png"),
            ("train/rgb/a.png", "train/masks/a.png"),
            ("train/a.png", "train/dynamic_mask_a.png"),
            ("images/a.jpeg", "images/dynamic_mask_a.jpg"),
        ] {
            let dir = tempfile::tempdir().unwrap();
            for file in [photo, mask] {
                let file = dir.path().join(file);
                std::fs::create_dir_all(file.parent().unwrap()).unwrap();
                std::fs::write(file, b"").unwrap();
            }
            let mut finder = Finder { root: dir.path(), folders: HashMap::new() };
            assert_eq!(finder.find(&dir.path().join(photo)), Some(dir.path().join(mask)), "{photo}");
            assert_eq!(finder.find(&dir.path().join(photo).with_file_name("b.jpg")), None, "{photo}");
        }
        let dir = tempfile::tempdir().unwrap();
        let mut f = frames(dir.path(), 3, in_the_middle);
        f.iter_mut().for_each(|f| f.image = f.image.with_file_name(format!("other_{}.jpg", f.name)));
        let (_, note) = settled(dir.path(), &mut f, MaskOptions::default());
        assert!(note.contains("named after a photograph"), "{note}");
    }

    #[test]
    fn other_sizes_are_scaled_and_other_shapes_refused() {
        let dir = tempfile::tempdir().unwrap();
        let f = &mut frames(dir.path(), 1, |_, x, _| x < 0.5)[0];
        f.mask = Some(dir.path().join("masks/p_0.png"));
        let rule = MaskRule::default();
        for (w, h) in [(30, 20), (120, 80), (121, 80)] {
            let m = of_frame(f, &rule, (w, h)).unwrap().unwrap();
            assert_eq!((m.width, m.height, m.pixel(w / 2 - 2, 3)[0], m.pixel(w / 2 + 2, 3)[0]), (w, h, 255, 0));
        }
        let e = of_frame(f, &rule, (40, 60)).unwrap_err();
        assert!(e.is_input() && e.to_string().contains("60×40") && e.to_string().contains("40×60"), "{e}");
        std::fs::write(f.mask.as_ref().unwrap(), b"no picture").unwrap();
        assert!(of_frame(f, &rule, SIZE).unwrap_err().to_string().contains("p_0.png"));
    }

    #[test]
    fn a_sky_is_cut_out_where_masks_mark_classes() {
        let dir = tempfile::tempdir().unwrap();
        let f = &mut frames(dir.path(), 1, |_, x, _| x < 0.5)[0];
        let path = dir.path().join("masks/p_0.png");
        photo::save_png(&path, &ImageU8 { width: 4, height: 1, channels: 1, data: vec![255, 192, 160, 0] }).unwrap();
        f.mask = Some(path);
        let gray = ImageU8 { width: 4, height: 1, channels: 3, data: vec![9; 12] };
        let of = |meaning| apply(f, &MaskRule { meaning, inverted: false }, Photo::Eight(gray.clone())).unwrap();
        let (Photo::Eight(cut), Some(mask)) = of(MaskMeaning::Classes) else { panic!("8 bits and a mask") };
        assert_eq!(cut.data.chunks_exact(4).map(|p| (p[0], p[3])).collect::<Vec<_>>(), [(9, 255), (9, 255), (9, 0), (9, 255)]);
        assert_eq!(mask.data.iter().map(|v| *v >= COUNTS).collect::<Vec<_>>(), [true, true, true, false]);
        // The same shade means nothing where masks do not mark classes.
        assert_eq!(of(MaskMeaning::Unknown).0, Photo::Eight(gray.clone()));
    }

    #[test]
    fn an_object_is_cut_out_and_classes_count_as_shades() {
        let dir = tempfile::tempdir().unwrap();
        let f = &mut frames(dir.path(), 1, |_, x, _| x < 0.5)[0];
        let path = dir.path().join("masks/p_0.png");
        let classes = ImageU8 { width: 4, height: 1, channels: 1, data: vec![0, 1, 1, 0] };
        photo::save_png(&path, &classes).unwrap();
        f.mask = Some(path);
        let gray = ImageU8 { width: 4, height: 1, channels: 3, data: vec![9; 12] };
        let rule = MaskRule { meaning: MaskMeaning::Object, inverted: false };
        let (cut, mask) = apply(f, &rule, Photo::Eight(gray)).unwrap();
        assert!(mask.is_none());
        let Photo::Eight(cut) = cut else { panic!("8 bits stay 8 bits") };
        assert_eq!(cut.data.chunks_exact(4).map(|p| (p[0], p[3])).collect::<Vec<_>>(), [(9, 0), (9, 255), (9, 255), (9, 0)]);
        // Transparent pixels stay transparent.
        let (cut, _) = apply(f, &rule, Photo::Eight(ImageU8 { channels: 4, data: vec![9; 16], ..cut })).unwrap();
        let Photo::Eight(cut) = cut else { panic!("8 bits stay 8 bits") };
        assert_eq!((cut.pixel(0, 0)[3], cut.pixel(1, 0)[3]), (0, 9));
        // 16-bit values and light brighter than white keep their range.
        let bright = Image { width: 4, height: 1, channels: 3, data: vec![7.5; 12] };
        for photo in [Photo::Sixteen(bright.clone()), Photo::Linear(bright)] {
            let (cut, _) = apply(f, &rule, photo.clone()).unwrap();
            assert_eq!(std::mem::discriminant(&cut), std::mem::discriminant(&photo));
            let (Photo::Sixteen(cut) | Photo::Linear(cut)) = cut else { panic!("floats stay floats") };
            assert_eq!(
                cut.data.chunks_exact(4).map(|p| (p[0], p[3])).collect::<Vec<_>>(),
                [(7.5, 0.0), (7.5, 1.0), (7.5, 1.0), (7.5, 0.0)]
            );
        }
    }
}
