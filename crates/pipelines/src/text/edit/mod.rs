//! Other writing on the regions of a run: frontal views without ink ([`ground`]), new letters on them ([`drawing`]), and rays that take their
//! colors ([`replacement`]). Edits are folders in `edits/` of the run.

mod directions;
pub mod drawing;
pub mod frontal;
pub mod ground;
pub mod replacement;
mod texture;

use super::field::model::TextModel;
use super::field::recipe;
use super::label::in_view::{self, Lettered, OnSurface};
use super::lettering::{Face, Fonts};
use super::placed::{self, PlacedRegion};
use super::words::WORDS;
use crate::error::{PipelineError, Result};
use diorama_data::{DataError, atomic, error, photo};
use diorama_engine::renderers::volume::Quality;
use diorama_geom::glam::{DVec2, DVec3};
use diorama_geom::rng::Rng;
use diorama_geom::{Image, ImageU8};
use diorama_kernels::ops::ray_generation::PosedCamera;
use drawing::{Blend, Writing};
use ground::Eraser;
use replacement::Overlay;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::SystemTime;
use unicode_script::{Script, UnicodeScript};

/// Folder of a run's edits, and the file of one, which is written last.
pub(super) const EDITS: &str = "edits";
const EDIT: &str = "edit.json";
const LIMIT: u64 = 1 << 24;
/// Stream of random numbers of words and fonts.
const WORDS_STREAM: u64 = 91;

/// Other writing on a region.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Edit {
    /// Region's id.
    pub region: u32,
    /// Empty: erased.
    pub text: String,
    pub font: String,
    pub blend: Blend,
    pub words: Vec<EditedWord>,
    /// Reading coordinates of the lower left and the upper right corner of the images.
    pub frame: [[f64; 2]; 2],
    /// Unit directions of sight in the world, one per image.
    pub directions: Vec<DVec3>,
    /// The region from each direction, in the field's colors.
    #[serde(skip)]
    pub colors: Vec<Image>,
    /// Share that is replaced, and share that is a glyph, `[H, W, 2]`.
    #[serde(skip, default = "nothing")]
    pub shares: Image,
}

fn nothing() -> Image {
    Image::zeros(0, 0, 2)
}

/// A word of an edit and its characters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EditedWord {
    pub whole: Lettered,
    pub characters: Vec<Lettered>,
}

impl EditedWord {
    /// The word on the rectangle of its region.
    pub fn on<'a>(&'a self, region: &'a PlacedRegion) -> Option<OnSurface<'a>> {
        let all = OnSurface::of(region)?;
        // Signs and digits are of no script of their own.
        let scripts = self.whole.text.chars().map(|c| c.script());
        let script = scripts.into_iter().find(|s| !matches!(s, Script::Common | Script::Inherited)).map(|s| s.full_name());
        Some(OnSurface { bounds: self.whole.bounds, transcription: &self.whole.text, script, characters: &self.characters, ..all })
    }
}

impl Edit {
    /// Writes it to `edits/NAME` of a run.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save(&self, run: &Path, name: &str) -> Result<PathBuf> {
        let folder = run.join(EDITS).join(name);
        std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
        for (k, color) in self.colors.iter().enumerate() {
            photo::save_png(&folder.join(format!("{k}.png")), &color.to_u8())?;
        }
        let shares = self.shares.data.chunks_exact(2).flat_map(|s| [s[0], s[1], 0.0]).collect();
        let shares = Image { channels: 3, data: shares, ..self.shares };
        photo::save_png(&folder.join("shares.png"), &shares.to_u8())?;
        atomic::write(&folder.join(EDIT), &serde_json::to_vec_pretty(self).expect("plain values"))?;
        Ok(folder)
    }

    /// Reads one of a run without its images.
    ///
    /// # Errors
    /// When it is missing or damaged.
    pub fn head(run: &Path, name: &str) -> Result<Edit> {
        let file = run.join(EDITS).join(name).join(EDIT);
        let bytes = error::read(&file, LIMIT)?;
        Ok(serde_json::from_slice(&bytes).map_err(|e| DataError::input(&file, format!("{e}; make the edit again")))?)
    }

    /// When one of a run was made.
    ///
    /// # Errors
    /// When it is missing.
    pub fn time(run: &Path, name: &str) -> Result<SystemTime> {
        let file = run.join(EDITS).join(name).join(EDIT);
        Ok(file.metadata().and_then(|m| m.modified()).map_err(DataError::io(&file, "read"))?)
    }

    /// Reads one of a run.
    ///
    /// # Errors
    /// When it is missing or damaged.
    pub fn read(run: &Path, name: &str) -> Result<Edit> {
        let mut edit = Edit::head(run, name)?;
        let folder = run.join(EDITS).join(name);
        let file = folder.join(EDIT);
        let load = |name: String| -> Result<Image> {
            let image = photo::load(&folder.join(name))?;
            let data = image.data.chunks_exact(image.channels).flat_map(|p| [0, 1, 2].map(|k| p[k.min(p.len() - 1)] as f32 / 255.0));
            Ok(Image { width: image.width, height: image.height, channels: 3, data: data.collect() })
        };
        edit.colors = (0..edit.directions.len()).map(|k| load(format!("{k}.png"))).collect::<Result<_>>()?;
        let shares = load("shares.png".into())?;
        let is_sound = edit.colors.iter().all(|c| (c.width, c.height) == (shares.width, shares.height)) && !edit.colors.is_empty();
        if !is_sound {
            return Err(DataError::input(&file, "its images differ in size; make the edit again").into());
        }
        let data = shares.data.chunks_exact(3).flat_map(|p| [p[0], p[1]]).collect();
        edit.shares = Image { channels: 2, data, ..shares };
        Ok(edit)
    }

    /// Files of all edits of a run that images depend on, in order.
    ///
    /// # Errors
    /// As [`Edit::names`].
    pub fn files(run: &Path) -> Result<Vec<PathBuf>> {
        let mut out = Vec::new();
        for name in Edit::names(run)? {
            let folder = run.join(EDITS).join(name);
            out.extend([folder.join(EDIT), folder.join("shares.png")]);
            out.extend((0..).map(|k| folder.join(format!("{k}.png"))).take_while(|f| f.exists()));
        }
        Ok(out)
    }

    /// Names of the edits of a run, in order.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn names(run: &Path) -> Result<Vec<String>> {
        let folder = run.join(EDITS);
        if !folder.exists() {
            return Ok(Vec::new());
        }
        let mut out = Vec::new();
        for entry in std::fs::read_dir(&folder).map_err(DataError::io(&folder, "read"))? {
            let path = entry.map_err(DataError::io(&folder, "read"))?.path();
            if path.join(EDIT).exists() {
                out.extend(path.file_name().map(|n| n.to_string_lossy().into_owned()));
            }
        }
        out.sort();
        Ok(out)
    }
}

/// What to write on which regions.
#[derive(Clone, Debug)]
pub struct EditOptions {
    /// Ids; none: all that have a surface.
    pub regions: Vec<u32>,
    pub change: Change,
    /// A font file; none: one that the program brings along, drawn for each word.
    pub font: Option<PathBuf>,
    pub eraser: Eraser,
    pub blend: Blend,
    /// Linear.
    pub color: Option<[f32; 3]>,
    pub seed: u64,
}

/// Kinds of edits.
#[derive(Clone, Debug, PartialEq)]
pub enum Change {
    /// No writing.
    Erase,
    Text(String),
    /// So many edits of each region, with words of a list.
    Words(usize),
}

/// What was edited.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Edited {
    /// Names of the edits.
    pub edits: Vec<String>,
    pub notes: Vec<String>,
    pub interrupted: bool,
}

/// Edits regions of a run. `look` receives each edit's name and a picture, before and after.
///
/// # Errors
/// When the run or its regions cannot be read, a region does not exist or has no surface, no font has a character, or a file cannot be
/// written.
pub fn edit(run: &Path, data: Option<&Path>, o: &EditOptions, stop: &AtomicBool, progress: &mut dyn FnMut(f64, &str)) -> Result<Edited> {
    let mut fonts = Fonts::shipped();
    let mut faces = fonts.latin();
    if let Some(file) = &o.font {
        faces = vec![fonts.add(file)?];
    }
    // Writing of other scripts falls back to fonts of this machine.
    fonts = fonts.with_installed();
    let (model, notes) = recipe::load(run, data)?;
    let regions = chosen(run, &o.regions)?;
    let mut out = Edited { notes, ..Edited::default() };
    for (k, region) in regions.iter().enumerate() {
        if stop.load(Ordering::Relaxed) {
            out.interrupted = true;
            return Ok(out);
        }
        progress(k as f64 / regions.len() as f64, "edits");
        let rectangle = region.rectangle.as_ref().expect("regions with a surface");
        let ground = ground::erased(&model, rectangle, o.eraser, o.seed)
            .map_err(|e| PipelineError::Usage(format!("region {} ({:?}): {e}", region.id, region.transcription)))?;
        out.notes.extend(ground.notes.iter().map(|n| format!("region {} ({:?}): {n}", region.id, region.transcription)));
        for (name, text, face) in texts(run, region, o, &faces)? {
            let writing = Writing { text: &text, face, blend: o.blend, color: o.color, seed: o.seed };
            let edit = drawing::written(region.id, &ground, rectangle, &mut fonts, &writing)?;
            let folder = edit.save(run, &name)?;
            photo::save_png(&folder.join("preview.png"), &preview(&model, region, edit))?;
            out.edits.push(name);
        }
    }
    Ok(out)
}

/// The regions of ids, which have a surface.
fn chosen(run: &Path, ids: &[u32]) -> Result<Vec<PlacedRegion>> {
    let all = placed::read(run)?;
    let listed = || all.iter().map(|r| format!("{} ({:?})", r.id, r.transcription)).collect::<Vec<_>>().join(", ");
    for id in ids {
        match all.iter().find(|r| r.id == *id) {
            None => return Err(PipelineError::Usage(format!("--region {id}: the run has {}", listed()))),
            Some(r) if r.rectangle.is_none() => {
                return Err(PipelineError::Usage(format!("--region {id}: it is on no surface, so that nothing can be written on it")));
            }
            Some(_) => {}
        }
    }
    let out: Vec<PlacedRegion> = all.into_iter().filter(|r| r.rectangle.is_some() && (ids.is_empty() || ids.contains(&r.id))).collect();
    if out.is_empty() {
        return Err(PipelineError::Usage(format!("{}: no region has a surface to write on", run.display())));
    }
    Ok(out)
}

/// Names, texts and faces of the edits of a region.
fn texts<'a>(run: &Path, region: &PlacedRegion, o: &EditOptions, faces: &'a [Face]) -> Result<Vec<(String, String, &'a Face)>> {
    let rng = Rng::new(o.seed.wrapping_mul(1009).wrapping_add(region.id as u64), WORDS_STREAM);
    let face = |k: u64| &faces[rng.below(4 * k + 1, faces.len() as u64) as usize];
    Ok(match &o.change {
        Change::Erase => vec![(format!("{}-erased", region.id), String::new(), face(0))],
        Change::Text(text) => vec![(named(run, region.id, text)?, text.clone(), face(0))],
        Change::Words(n) => {
            let word = |k: usize| {
                let word = WORDS[rng.below(4 * k as u64, WORDS.len() as u64) as usize];
                if rng.uniform(4 * k as u64 + 2) < 0.5 { word.to_uppercase() } else { word.to_string() }
            };
            (0..*n).map(|k| (format!("{}-word-{k:03}", region.id), word(k), face(k as u64))).collect()
        }
    })
}

/// Name of the edit of a text: that of the earlier one with it, else the first that is free.
fn named(run: &Path, region: u32, text: &str) -> Result<String> {
    let (names, name) = (Edit::names(run)?, |k: usize| format!("{region}-text-{k:03}"));
    for k in 0.. {
        if !names.contains(&name(k)) || Edit::head(run, &name(k))?.text == text {
            return Ok(name(k));
        }
    }
    unreachable!("some number is free")
}

/// The training photograph's view that shows a region largest, before and after an edit, side by side.
fn preview(model: &TextModel, region: &PlacedRegion, edit: Edit) -> ImageU8 {
    let rectangle = region.rectangle.expect("regions with a surface");
    let middle = rectangle.reading_point(DVec2::ZERO);
    let distance = |frame: &usize| model.capture.frames[*frame].world_from_camera.translation.distance(middle);
    let shows = |frame: &usize| {
        let f = &model.capture.frames[*frame];
        OnSurface::of(region)
            .and_then(|w| in_view::labelled(model, &w, &f.camera, &f.world_from_camera))
            .is_some_and(|w| w.visibility > 0.9)
    };
    let nearest = |a: &usize, b: &usize| distance(a).total_cmp(&distance(b));
    let whole = model.train.iter().copied().filter(shows).min_by(nearest);
    let frame = whole.or_else(|| model.train.iter().copied().min_by(nearest)).expect("training frames");
    let posed: PosedCamera = model.posed(frame);
    let before = model.tracer(Quality::Full).view(&posed, &mut |_| ());
    let mut after = before.clone();
    let pose = model.capture.frames[frame].world_from_camera;
    let overlay = Overlay::new(edit, region).expect("regions with a surface");
    overlay.put(model, &posed.camera, &pose, &mut after);
    let (w, h) = (before.rgb.width, before.rgb.height);
    let [a, b] = [before.rgb.to_u8(), after.rgb.to_u8()];
    let rows = (0..h).flat_map(|y| [&a.data[3 * w * y..3 * w * (y + 1)], &b.data[3 * w * y..3 * w * (y + 1)]].concat()).collect();
    ImageU8 { width: 2 * w, height: h, channels: 3, data: rows }
}
