//! Labels of a capture from files of annotation programs.

use crate::error::{PipelineError, Result};
use diorama_data::import::{ImportOptions, import};
use diorama_data::text_labels::{self, Format, Known};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// File of a capture's labels, in its folder.
pub const LABELS: &str = "labels.jsonl";
/// Photographs in which a region should be labelled at most, so that time is not wasted on labels that follow from others.
const ENOUGH: usize = 3;

/// What was imported.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Annotated {
    pub file: PathBuf,
    pub images: usize,
    /// Different regions, and labels of them that nobody can read.
    pub regions: usize,
    pub ignored: usize,
    /// What looks odd but may be meant.
    pub notes: Vec<String>,
}

/// Reads labels for the photographs of a capture, checks them, and writes `labels.jsonl` beside them.
///
/// # Errors
/// When the capture has labels that are not replaced by `force`, or the capture or the labels are wrong.
pub fn annotate(capture: &Path, labels: &Path, format: Format, force: bool) -> Result<Annotated> {
    if capture.extension().is_some_and(|e| e.eq_ignore_ascii_case("zip")) {
        return Err(PipelineError::Usage(format!("{}: unpack it first; labels are written beside the photographs", capture.display())));
    }
    let folder = if capture.is_file() { capture.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")) } else { capture };
    let file = folder.join(LABELS);
    if file.exists() && !force {
        return Err(PipelineError::Usage(format!("{}: is there already; give --force to replace it", file.display())));
    }
    let frames = import(capture, &ImportOptions::default())?.frames;
    let known: Vec<Known> = frames
        .iter()
        .map(|f| Known {
            path: f.image.strip_prefix(folder).unwrap_or(&f.image).to_string_lossy().into_owned(),
            size: (f.camera.width, f.camera.height),
        })
        .collect();
    let images = text_labels::import(format, labels, &known)?;
    let mut times: BTreeMap<u32, (usize, String)> = BTreeMap::new();
    for region in images.iter().flat_map(|i| &i.regions) {
        let entry = times.entry(region.id).or_insert((0, String::new()));
        entry.0 += 1;
        if !region.ignore {
            entry.1.clone_from(&region.transcription);
        }
    }
    let often = times.iter().filter(|(_, (n, _))| *n > ENOUGH);
    let notes =
        often.map(|(id, (n, text))| format!("region {id} ({text:?}) is labelled in {n} photographs; {ENOUGH} are enough")).collect();
    text_labels::save(&file, &images)?;
    let ignored = images.iter().flat_map(|i| &i.regions).filter(|r| r.ignore).count();
    Ok(Annotated { file, images: images.len(), regions: times.len(), ignored, notes })
}
