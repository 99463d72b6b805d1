//! Generated scenes with writing: photographs of a walk past it, with exact regions, classes, ink, poses and visibility.
//!
//! Each scene is a folder: a capture (`transforms.json`, `images/`), labels of a few photographs (`labels.jsonl`), and a `truth/` that
//! training never reads. A scene whose `transforms.json` is there is complete; an interrupted call goes on with what is missing.

mod pictures;
mod staged;

use super::lettering::Fonts;
use super::truth::Truth;
use crate::error::{PipelineError, Result};
use diorama_data::{DataError, atomic, error};
use diorama_geom::rng::Rng;
use diorama_scenes::signs::{Family, Stage};
use serde::{Deserialize, Serialize};
use staged::Staged;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// File in which a folder says how its scenes were made.
const MANIFEST: &str = "make-scenes.json";
const MANIFEST_LIMIT: u64 = 1 << 20;
/// File of a scene's capture, which is written last.
const CAPTURE: &str = "transforms.json";
/// Stream of random numbers of boards' pictures.
const PAINT: u64 = 71;
/// Share by which the walk of small scenes is nearer, so that words are a dozen pixels high.
const CLOSE_BY: f64 = 0.5;
const MOST_CLOSER: f64 = 0.8;
/// Share of the views that is held out.
const HELD_OUT: f64 = 0.15;

/// Scenes to make.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneOptions {
    /// Names of families, taken in turns.
    pub families: Vec<String>,
    pub scenes: usize,
    /// Photographs of each scene, and how many of them are labelled.
    pub views: usize,
    pub labelled: usize,
    /// Boards of each scene, from one number to another, and the most words on one.
    pub boards: [usize; 2],
    pub words: usize,
    /// Share of the distance to the boards by which the walk is nearer; above 0, boards are next to each other.
    pub closer: f64,
    pub size: (u32, u32),
    /// Samples per pixel.
    pub samples: u32,
    pub seed: u64,
    pub fonts: FontSource,
}

/// Fonts that writing is set in.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FontSource {
    /// Those that the program brings along.
    Shipped,
    /// These, and all of this machine that have Latin letters.
    Installed,
    /// Files.
    Files(Vec<PathBuf>),
}

impl SceneOptions {
    /// The options of a size: `ci` (a room in 14 views of 96×72, filmed close by) or `gpu` (60 of 960×540).
    ///
    /// # Errors
    /// When the name is not that of a size.
    pub fn named(name: &str) -> Result<SceneOptions> {
        let families = Family::ALL.iter().map(|f| f.name().to_string()).collect();
        let of = |scenes, views, boards, size, samples| SceneOptions {
            families,
            scenes,
            views,
            labelled: 2,
            boards,
            words: 2,
            closer: 0.0,
            size,
            samples,
            seed: 0,
            fonts: FontSource::Shipped,
        };
        match name {
            "ci" => {
                let families = vec![Family::Room.name().into()];
                Ok(SceneOptions { families, words: 1, closer: CLOSE_BY, ..of(1, 14, [2, 2], (96, 72), 64) })
            }
            "gpu" => Ok(of(60, 60, [3, 8], (960, 540), 128)),
            _ => Err(PipelineError::Usage(format!("size {name:?}: expected ci or gpu"))),
        }
    }

    /// # Errors
    /// With what cannot be, and what can.
    fn check(&self) -> Result<Vec<Family>> {
        let usage = |m: String| Err(PipelineError::Usage(m));
        let most = staged::held_out(self.views).iter().filter(|h| !**h).count();
        if self.scenes == 0 || self.views < 8 || self.samples == 0 {
            return usage("scenes need at least 8 views and one sample per pixel".into());
        }
        if !(1..=most).contains(&self.labelled) {
            return usage(format!("--labelled {}: expected 1 to {most}, the photographs that are not held out", self.labelled));
        }
        if !(1..=2).contains(&self.words) || !(0.0..=MOST_CLOSER).contains(&self.closer) {
            return usage(format!("--words must be 1 or 2, and --closer from 0 to {MOST_CLOSER}"));
        }
        let family = |name: &String| {
            let names: Vec<&str> = Family::ALL.iter().map(|f| f.name()).collect();
            Family::named(name).ok_or_else(|| PipelineError::Usage(format!("family {name:?}: expected {}", names.join(", "))))
        };
        let families = self.families.iter().map(family).collect::<Result<Vec<Family>>>()?;
        let ([from, to], room) = (self.boards, families.iter().map(|f| f.most_boards()).min().unwrap_or(0));
        if from == 0 || from > to || to > room {
            return usage(format!("--signs {from}-{to}: expected a number or FROM-TO, from 1 to {room}"));
        }
        Ok(families)
    }
}

/// What was made.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct MadeScenes {
    pub scenes: Vec<String>,
    pub photographs: usize,
    /// Text regions of all scenes.
    pub regions: usize,
    pub interrupted: bool,
}

/// Makes scenes in a folder. `progress` receives the share of the photographs that is done.
///
/// # Errors
/// When the folder holds scenes of other options and is not replaced by `force`, a font cannot be read or lacks letters, or a file cannot be
/// written.
pub fn generate(out: &Path, options: &SceneOptions, force: bool, stop: &AtomicBool, progress: &mut dyn FnMut(f64)) -> Result<MadeScenes> {
    let families = options.check()?;
    let mut fonts = Fonts::shipped();
    let faces = match &options.fonts {
        FontSource::Shipped => fonts.latin(),
        FontSource::Installed => {
            fonts = fonts.with_installed();
            fonts.latin()
        }
        FontSource::Files(files) => files.iter().map(|f| fonts.add_latin(f)).collect::<Result<_>>()?,
    };
    begin(out, options, fonts.fingerprint(&faces), force)?;
    let mut made = MadeScenes::default();
    for s in 0..options.scenes {
        let family = families[s % families.len()];
        let name = format!("{}-{s:03}", family.name());
        let folder = out.join(&name);
        if folder.join(CAPTURE).exists() {
            let truth = Truth::read(&folder)?;
            made.photographs += truth.views.len();
            made.regions += truth.regions.len();
            made.scenes.push(name);
            progress((s + 1) as f64 / options.scenes as f64);
            continue;
        }
        let seed = options.seed.wrapping_mul(1000).wrapping_add(s as u64);
        let boards = options.boards[0] + Rng::new(seed, PAINT).below(0, (options.boards[1] - options.boards[0] + 1) as u64) as usize;
        let stage = match options.closer > 0.0 {
            true => Stage::closer(family, seed, boards, options.closer),
            false => Stage::of(family, seed, boards),
        };
        let staged = Staged::new(stage, (seed, options.words), &mut fonts, &faces)?;
        let done = staged.photograph(&folder, options, stop, &mut |share: f64| progress((s as f64 + share) / options.scenes as f64))?;
        made.photographs += done;
        made.regions += staged.regions();
        made.scenes.push(name);
        if done < options.views {
            made.interrupted = true;
            break;
        }
    }
    Ok(made)
}

/// Writes how the scenes are made, or checks that those of the folder are made so.
fn begin(out: &Path, options: &SceneOptions, fonts: u64, force: bool) -> Result<()> {
    let path = out.join(MANIFEST);
    let mut now = serde_json::to_value(options).expect("plain values");
    now["fonts on this machine"] = format!("{fonts:016x}").into();
    if path.exists() {
        let bytes = error::read(&path, MANIFEST_LIMIT)?;
        let before: serde_json::Value =
            serde_json::from_slice(&bytes).map_err(|e| DataError::input(&path, format!("{e}; give --force to make the scenes anew")))?;
        let keys = now.as_object().into_iter().flatten().map(|(k, _)| k);
        let differing: Vec<&str> = keys.filter(|k| before.get(k.as_str()) != now.get(k.as_str())).map(String::as_str).collect();
        if !differing.is_empty() && !force {
            let differing = differing.join(", ");
            let message =
                format!("{}: holds scenes made with other {differing}; give --force to replace them, or another --out", out.display());
            return Err(PipelineError::Usage(message));
        }
        if force {
            remove_scenes(out)?;
        }
    }
    std::fs::create_dir_all(out).map_err(DataError::io(out, "create"))?;
    Ok(atomic::write(&path, &serde_json::to_vec_pretty(&now).expect("plain values"))?)
}

/// Removes the scenes of a folder: subfolders named after a family and a number that hold a truth. Others are not ours.
fn remove_scenes(out: &Path) -> Result<()> {
    let is_scene = |p: &Path| {
        let parts = p.file_name().and_then(|n| n.to_str()).and_then(|n| n.rsplit_once('-'));
        parts.is_some_and(|(family, n)| Family::named(family).is_some() && n.parse::<usize>().is_ok()) && p.join("truth").is_dir()
    };
    for entry in std::fs::read_dir(out).map_err(DataError::io(out, "read"))? {
        let path = entry.map_err(DataError::io(out, "read"))?.path();
        if is_scene(&path) {
            std::fs::remove_dir_all(&path).map_err(DataError::io(&path, "remove"))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
