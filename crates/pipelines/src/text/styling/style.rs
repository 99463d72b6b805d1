//! Styles as users name them: a season or climate, an image whose look is taken, or none.

use super::presets::Preset;
use super::transfer::Moments;
use crate::error::{PipelineError, Result};
use crate::text::fnv;
use diorama_data::{DataError, error, photo};
use std::path::Path;

/// Name of the style that leaves images as they are.
pub const PLAIN: &str = "none";

/// A look that images take.
#[derive(Clone, Debug, PartialEq)]
pub struct Style {
    /// Name in annotations: the preset's, or that of the image's file without its extension.
    pub name: String,
    /// None: images stay as they are.
    pub moments: Option<Moments>,
    /// Hash of the image's file; empty where there is none.
    pub hash: String,
}

impl Style {
    /// The style of a name, or of an image file, which is reduced to at most `side` pixels a side so that its detail is of the same scale as
    /// that of images of this size.
    ///
    /// # Errors
    /// When the text names neither, or the file is no image.
    pub fn read(text: &str, side: usize) -> Result<Style> {
        if text == PLAIN {
            return Ok(Style { name: PLAIN.into(), moments: None, hash: String::new() });
        }
        if let Some(preset) = Preset::named(text) {
            return Ok(Style { name: text.into(), moments: Some(preset.moments()), hash: String::new() });
        }
        let path = Path::new(text);
        if !path.is_file() {
            return Err(PipelineError::Usage(format!("--style {text:?}: neither a style nor an image file; styles are {}", known())));
        }
        let wrong = || DataError::input(path, format!("cannot be read as an image; give a PNG or JPEG file, or one of {}", known()));
        let hash = format!("{:016x}", fnv::hash(error::read(path, u64::MAX)?));
        let image = photo::load_small(path, side).map_err(|e| if e.is_input() { wrong() } else { e })?;
        let moments = Moments::of(&[image.to_f32()]).ok_or_else(wrong)?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Style { name, moments: Some(moments), hash })
    }

    /// All styles of a list; one that stands in it twice is taken twice as often.
    ///
    /// # Errors
    /// As [`Style::read`], and when two different ones have the same name.
    pub fn read_all(texts: &[String], side: usize) -> Result<Vec<Style>> {
        let all = texts.iter().map(|t| Style::read(t, side)).collect::<Result<Vec<_>>>()?;
        for (i, style) in all.iter().enumerate() {
            if let Some(k) = (0..i).find(|k| all[*k].name == style.name && texts[*k] != texts[i]) {
                let (a, b, name) = (&texts[k], &texts[i], &style.name);
                return Err(PipelineError::Usage(format!(
                    "--style: {a} and {b} would both be named {name:?} in annotations; rename a file"
                )));
            }
        }
        Ok(all)
    }
}

/// Names that are no files.
fn known() -> String {
    Preset::ALL.map(Preset::name).join(", ") + ", " + PLAIN
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::ImageU8;

    fn save(path: &Path, color: [u8; 3]) {
        let data = (0..64 * 48).flat_map(|i| color.map(|c| if i % 9 == 0 { c / 2 } else { c })).collect();
        photo::save_png(path, &ImageU8 { width: 64, height: 48, channels: 3, data }).unwrap();
    }

    #[test]
    fn presets_images_and_none_are_styles() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("red hall.png");
        save(&file, [250, 40, 30]);
        let texts = ["winter".to_string(), "none".into(), file.display().to_string(), "none".into()];
        let all = Style::read_all(&texts, 160).unwrap();
        assert_eq!(all.iter().map(|s| s.name.as_str()).collect::<Vec<_>>(), ["winter", "none", "red hall", "none"]);
        assert_eq!(all[0].moments, Some(Preset::Winter.moments()));
        assert!(all[1].moments.is_none() && all[0].hash.is_empty() && all[2].hash.len() == 16);
        let mean = all[2].moments.as_ref().unwrap().mean;
        assert!(mean[0] > 0.8 && mean[1] < 0.2, "{mean}");
        save(&file, [30, 40, 250]);
        assert_ne!(Style::read(&texts[2], 160).unwrap().hash, all[2].hash);
    }

    #[test]
    fn names_nobody_knows_and_files_that_are_no_images_are_told() {
        let dir = tempfile::tempdir().unwrap();
        let told = |text: &str| {
            let e = Style::read(text, 160).unwrap_err();
            assert!(e.is_input() && !e.to_string().contains('\n'), "{e}");
            e.to_string()
        };
        let e = told("spring");
        assert!(e.contains("\"spring\": neither") && e.contains("autumn, winter, night, rain, evening, none"), "{e}");
        for bytes in [&b"not an image"[..], b"", b"\x89PNG\r\n\x1a\n"] {
            let file = dir.path().join("notes.png");
            std::fs::write(&file, bytes).unwrap();
            let e = told(&file.display().to_string());
            assert!(e.contains("notes.png: cannot be read as an image; give a PNG or JPEG"), "{e}");
        }
        let files = ["a", "b"].map(|sub| dir.path().join(sub).join("sea.png"));
        for file in &files {
            std::fs::create_dir(file.parent().unwrap()).unwrap();
            save(file, [9, 90, 200]);
        }
        let e = Style::read_all(&files.map(|f| f.display().to_string()), 160).unwrap_err().to_string();
        assert!(e.contains("named \"sea\" in annotations"), "{e}");
    }
}
