//! Runs COLMAP (Schönberger and Frahm, CVPR 2016) step by step; marks each finished step, so that an interrupted run can resume.

use super::{IMAGES, PrepareOptions, SEEN, WORK};
use crate::error::{PipelineError, Result};
use diorama_data::process::{self, Ended};
use diorama_data::{DataError, atomic, colmap};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;

/// Which pairs of photographs are matched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Matcher {
    /// Sequential for videos and for very many photographs, then exhaustive if too few of them get a pose; else exhaustive.
    Auto,
    Exhaustive,
    Sequential,
}

impl std::str::FromStr for Matcher {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s {
            "auto" => Ok(Matcher::Auto),
            "exhaustive" => Ok(Matcher::Exhaustive),
            "sequential" => Ok(Matcher::Sequential),
            _ => Err(format!("matcher {s:?}: expected auto, exhaustive or sequential")),
        }
    }
}

/// Most photographs that [`Matcher::Auto`] matches exhaustively from the start.
const EXHAUSTIVE: usize = 400;
/// [`Matcher::Auto`] repeats sequential matching with all pairs if the model has less than this share of the photographs.
const FEW: f64 = 0.9;
/// Folder of the photographs that COLMAP reads.
fn seen_images(o: &PrepareOptions) -> std::path::PathBuf {
    let own = o.out.join(WORK).join(SEEN);
    if own.is_dir() { own } else { o.out.join(IMAGES) }
}

/// Supported COLMAP camera models.
pub const LENSES: [&str; 6] = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"];

/// What to do without COLMAP.
const WITHOUT: &str = "captures that have poses need no COLMAP: --sfm none";

/// Path of COLMAP.
///
/// # Errors
/// If it is not installed.
pub fn program() -> Result<PathBuf> {
    let found = process::find("colmap", "DIORAMA_COLMAP", "Debian: apt install colmap; others: colmap.github.io/install.html");
    Ok(found.map_err(|e| match e {
        DataError::Input { path, message } => DataError::input(path, format!("{message}; {WITHOUT}")),
        other => other,
    })?)
}

/// Photographs that need poses.
pub struct Photographs<'a> {
    pub names: &'a [String],
    pub is_video: bool,
    /// Whether all have the same size, so that they share one camera.
    pub one_size: bool,
    /// Focal length over the longer side, if the EXIF data has it.
    pub focal_ratio: Option<f64>,
}

/// One run of COLMAP over a data set.
struct Sfm<'a> {
    program: &'a Path,
    images: PathBuf,
    work: PathBuf,
    threads: Option<usize>,
    interrupt: &'a AtomicBool,
}

/// Reconstructs the poses and copies the largest model to `sparse/0`; returns that folder, or none when interrupted.
///
/// # Errors
/// When the lens is unknown, a COLMAP step fails, or no model is found.
pub fn reconstruct(
    program: &Path,
    o: &PrepareOptions,
    photos: &Photographs,
    interrupt: &AtomicBool,
    note: &mut dyn FnMut(&str),
) -> Result<Option<PathBuf>> {
    if !LENSES.contains(&&*o.lens) {
        return Err(PipelineError::Usage(format!("--lens {}: expected one of {}", o.lens, LENSES.join(", "))));
    }
    let sfm = Sfm { program, images: seen_images(o), work: o.out.join(WORK), threads: o.threads, interrupt };
    let (names, is_video) = (photos.names, photos.is_video);
    if !sfm.features(o, photos, note)? {
        return Ok(None);
    }
    let neighbours = o.matcher == Matcher::Sequential || (o.matcher == Matcher::Auto && (is_video || names.len() > EXHAUSTIVE));
    let Some(mut best) = sfm.attempt(neighbours, names.len(), note)? else { return Ok(None) };
    if neighbours && o.matcher == Matcher::Auto && best.1 < FEW * names.len() as f64 {
        note(&format!("{} of {} photographs found a pose among their neighbours; comparing all pairs", best.1, names.len()));
        let Some(again) = sfm.attempt(false, names.len(), note)? else { return Ok(None) };
        if again.1 > best.1 {
            best = again;
        }
    }
    let target = o.out.join("sparse").join("0");
    std::fs::create_dir_all(&target).map_err(DataError::io(&target, "create"))?;
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        let source = best.0.join(file);
        let bytes = std::fs::read(&source).map_err(DataError::io(&source, "read"))?;
        atomic::write(&target.join(file), &bytes)?;
    }
    Ok(Some(target))
}

impl Sfm<'_> {
    fn database(&self) -> PathBuf {
        self.work.join("database.db")
    }

    fn is_done(&self, step: &str) -> bool {
        self.work.join(format!("{step}.done")).exists()
    }

    fn mark(&self, step: &str) -> Result<()> {
        Ok(atomic::write(&self.work.join(format!("{step}.done")), b"")?)
    }

    /// Runs a COLMAP command; returns false when interrupted.
    fn run(&self, arguments: &[(&str, String)], command: &str, on_line: &mut dyn FnMut(&str)) -> Result<bool> {
        let mut c = Command::new(self.program);
        c.arg(command);
        // No display is needed, and some builds look for one.
        c.env("QT_QPA_PLATFORM", "offscreen");
        for (name, value) in arguments {
            c.arg(format!("--{name}")).arg(value);
        }
        let ended = process::run(&mut c, &self.work.join("colmap.log"), self.interrupt, on_line).map_err(|e| match e {
            DataError::Failed { program, message } => DataError::failed(program, format!("{command} {message}; {WITHOUT}")),
            other => other,
        })?;
        Ok(ended == Ended::Done)
    }

    /// The name of an option in the installed version of COLMAP: `names` is (new, old).
    fn option(&self, command: &str, names: [&'static str; 2]) -> &'static str {
        let help = Command::new(self.program).args([command, "-h"]).env("QT_QPA_PLATFORM", "offscreen").output();
        let text = help.map(|o| [o.stdout, o.stderr].concat()).unwrap_or_default();
        let text = String::from_utf8_lossy(&text).into_owned();
        if text.contains(&format!("--{}", names[0])) { names[0] } else { names[1] }
    }

    fn features(&self, o: &PrepareOptions, photos: &Photographs, note: &mut dyn FnMut(&str)) -> Result<bool> {
        let n = photos.names.len();
        if self.is_done("features") {
            return Ok(true);
        }
        // Discard the incomplete database of an interrupted run.
        let _ = std::fs::remove_file(self.database());
        let gpu = self.option("feature_extractor", ["FeatureExtraction.use_gpu", "SiftExtraction.use_gpu"]);
        let threads = self.option("feature_extractor", ["FeatureExtraction.num_threads", "SiftExtraction.num_threads"]);
        let mut arguments = vec![
            ("database_path", self.database().display().to_string()),
            ("image_path", self.images.display().to_string()),
            ("ImageReader.camera_model", o.lens.clone()),
            ("ImageReader.single_camera", (photos.one_size as u8).to_string()),
            ("SiftExtraction.max_num_features", o.features.to_string()),
            (gpu, "0".into()),
            (threads, self.threads.map_or(-1, |t| t as i64).to_string()),
        ];
        if let Some(f) = photos.focal_ratio {
            arguments.push(("ImageReader.default_focal_length_factor", f.to_string()));
        }
        let done = self.run(&arguments, "feature_extractor", &mut |l| {
            if let Some(at) = l.split("Processed file [").nth(1).and_then(|r| r.split('/').next()) {
                note(&format!("features: {at} of {n}"));
            }
        })?;
        if done {
            self.mark("features")?;
        }
        Ok(done)
    }

    /// Matches and maps; returns the largest model and its number of photographs, or none when interrupted.
    fn attempt(&self, neighbours: bool, n: usize, note: &mut dyn FnMut(&str)) -> Result<Option<(PathBuf, f64)>> {
        let (command, label) = if neighbours { ("sequential_matcher", "sequential") } else { ("exhaustive_matcher", "exhaustive") };
        if !self.is_done(label) {
            let gpu = self.option(command, ["FeatureMatching.use_gpu", "SiftMatching.use_gpu"]);
            let threads = self.option(command, ["FeatureMatching.num_threads", "SiftMatching.num_threads"]);
            let mut arguments = vec![
                ("database_path", self.database().display().to_string()),
                (gpu, "0".into()),
                (threads, self.threads.map_or(-1, |t| t as i64).to_string()),
            ];
            if neighbours {
                arguments.push(("SequentialMatching.overlap", "15".into()));
            } else {
                // Small blocks report progress more often; the pairs are the same.
                arguments.push(("ExhaustiveMatching.block_size", "10".into()));
            }
            note(&format!("matching ({label})"));
            let (mut blocks, of) = (0, if neighbours { n } else { n.div_ceil(10).pow(2) });
            let done = self.run(&arguments, command, &mut |l| {
                if l.contains("Matching block [") || l.contains("Matching image [") {
                    blocks += 1;
                    note(&format!("matching: {} %", (100 * blocks / of.max(1)).min(100)));
                }
            })?;
            if !done {
                return Ok(None);
            }
            self.mark(label)?;
        }
        let models = self.work.join(format!("models_{label}"));
        let mapped = format!("mapped_{label}");
        if !self.is_done(&mapped) {
            let _ = std::fs::remove_dir_all(&models);
            std::fs::create_dir_all(&models).map_err(DataError::io(&models, "create"))?;
            let arguments = [
                ("database_path", self.database().display().to_string()),
                ("image_path", self.images.display().to_string()),
                ("output_path", models.display().to_string()),
                ("Mapper.num_threads", self.threads.map_or(-1, |t| t as i64).to_string()),
            ];
            note("finding poses");
            let ended = self.run(&arguments, "mapper", &mut |l| {
                if let Some(count) = l.split("Registering image #").nth(1).and_then(|r| r.split('(').nth(1)?.split(')').next()) {
                    note(&format!("poses: {count} of {n}"));
                }
            });
            match ended {
                Ok(true) => self.mark(&mapped)?,
                Ok(false) => return Ok(None),
                // COLMAP fails if no pair is good enough to initialize a model.
                Err(e) if largest(&models).is_none() => {
                    let why = "no two photographs show enough of the same thing to begin with; take them with more overlap, sharper, and with more texture in view";
                    return Err(DataError::failed(&models, format!("{why} ({e})")).into());
                }
                Err(e) => return Err(e),
            }
        }
        match largest(&models) {
            Some((model, images)) => Ok(Some((model, images as f64))),
            None => Err(DataError::failed(
                &models,
                "COLMAP made no model: no two photographs show enough of the same thing; take them with more overlap, sharper, and with more texture in view",
            )
            .into()),
        }
    }
}

/// The model with the most photographs, and their number.
fn largest(models: &Path) -> Option<(PathBuf, usize)> {
    let folders = models.read_dir().ok()?.flatten().map(|e| e.path());
    let counted = folders.filter_map(|p| colmap::registered(&p).ok().map(|r| (p, r.len())));
    counted.max_by(|a, b| a.1.cmp(&b.1).then(b.0.cmp(&a.0)))
}
