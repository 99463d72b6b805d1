//! Tables 1 and 4 of the thesis whose scenes and objects the relighting application makes: settings and time, and scores, of five objects.
//!
//! Its Egyptian chair was never published; the procedural chair stands for it, from as many sides. The other objects' photographs are the user's to bring.

use crate::error::{PipelineError, Result};
use crate::relight::light::{LightOptions, Source};
use crate::relight::object::capture::{self, ObjectPhoto};
use crate::relight::object::config::{Config, Preset};
use crate::relight::object::model::Stage;
use crate::relight::object::recipe::{self, Trained};
use crate::relight::object::synth::{self, ObjectSynth};
use crate::run::RunFolder;
use diorama_engine::metrics::lpips::Lpips;
use diorama_engine::metrics::{self, ImageScores};
use diorama_engine::train::Event;
use diorama_geom::capture::Split;
use diorama_geom::color::srgb_from_linear;
use diorama_geom::{Capture, Image};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// An object of the thesis.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ThesisObject {
    pub name: &'static str,
    /// What `--data` calls it.
    pub key: &'static str,
    /// Table 1: edge of the textures, grid, and iterations of each stage.
    pub texture: usize,
    pub grid: u32,
    pub steps: u64,
    /// Table 4.
    pub ssim: f64,
    pub psnr: f64,
    pub lpips: f64,
    /// Where its photographs come from.
    pub source: &'static str,
}

/// The rows of both tables.
pub const OBJECTS: [ThesisObject; 5] = [
    ThesisObject {
        name: "Ethiopian head (R)",
        key: "head",
        texture: 512,
        grid: 64,
        steps: 5000,
        ssim: 0.938303,
        psnr: 26.541,
        lpips: 0.06564,
        source: "66 photographs with masks and poses_bounds.npy, published with NeRD (CC BY-NC-SA)",
    },
    ThesisObject {
        name: "Gold cape (R)",
        key: "cape",
        texture: 512,
        grid: 128,
        steps: 5000,
        ssim: 0.884511,
        psnr: 24.048,
        lpips: 0.09305,
        source: "119 photographs with masks and poses_bounds.npy, published with NeRD (CC BY-NC-SA)",
    },
    ThesisObject {
        name: "Ficus (S)",
        key: "ficus",
        texture: 512,
        grid: 128,
        steps: 5000,
        ssim: 0.931895,
        psnr: 24.292,
        lpips: 0.07441,
        source: "the folder nerf_synthetic/ficus, published with NeRF",
    },
    ThesisObject {
        name: "Hotdog (S)",
        key: "hotdog",
        texture: 800,
        grid: 128,
        steps: 5000,
        ssim: 0.972516,
        psnr: 31.946,
        lpips: 0.04706,
        source: "the folder nerf_synthetic/hotdog, published with NeRF",
    },
    ThesisObject {
        name: "EgyptianChair (S)",
        key: CHAIR,
        texture: 2048,
        grid: 128,
        steps: 10_000,
        ssim: 0.982080,
        psnr: 32.776,
        lpips: 0.02423,
        source: "generated",
    },
];

const CHAIR: &str = "chair";
/// Photographs per step, as in the thesis.
const BATCH: usize = 4;
/// Every so many photographs one is held out, where a capture has no split of its own.
const HOLD_OUT: &str = "every:8";
/// Edge of the generated photographs, and their number; the same of the quick size with its steps, grid and textures.
const CHAIR_VIEWS: (u32, usize) = (512, 160);
const QUICK_VIEWS: (u32, usize) = (96, 24);
const QUICK: (u64, u32, usize) = (150, 32, 256);

/// What is measured, and where.
pub struct ThesisOptions {
    /// Folder of generated photographs and of runs, which are kept and gone on with.
    pub out: PathBuf,
    /// A small chair in about a minute instead of the sizes of the thesis.
    pub quick: bool,
    /// Captures of the user, by key.
    pub data: Vec<(String, PathBuf)>,
    pub lpips: Option<Lpips>,
}

/// What we measured of an object.
#[derive(Clone, Debug, Serialize)]
pub struct OurRow {
    pub texture: usize,
    pub grid: u32,
    pub steps: u64,
    pub views: usize,
    pub held_out: usize,
    pub triangles: usize,
    pub seconds: f64,
    pub ssim: f64,
    pub psnr: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    pub run: PathBuf,
}

/// A row of both tables; ours is absent where the user has to bring the data.
#[derive(Clone, Debug, Serialize)]
pub struct ThesisRow {
    pub thesis: ThesisObject,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ours: Option<OurRow>,
}

/// Trains the objects whose data is there, and scores them; none when interrupted, after which the same call goes on. `events` receives the
/// name of an object and what happens to it.
///
/// # Errors
/// When a key is unknown, a folder holds other work, or training fails.
pub fn measure(o: &ThesisOptions, stop: &AtomicBool, events: &mut dyn FnMut(&str, &Event)) -> Result<Option<Vec<ThesisRow>>> {
    if let Some((key, _)) = o.data.iter().find(|(key, _)| OBJECTS.iter().all(|t| t.key != key)) {
        let keys = OBJECTS.map(|t| t.key).join(", ");
        return Err(PipelineError::Usage(format!("--data {key}=…: there is no such object; expected one of {keys}")));
    }
    let mut rows = Vec::new();
    for thesis in OBJECTS {
        let given = o.data.iter().find(|(key, _)| key == thesis.key).map(|d| d.1.clone());
        let data = match given {
            None if thesis.key == CHAIR => chair(o, stop, events)?,
            given => given,
        };
        let ours = match data {
            Some(data) => Some(own(&thesis, &data, o, stop, events)?),
            None => None,
        };
        match ours {
            Some(None) => return Ok(None),
            ours => rows.push(ThesisRow { thesis, ours: ours.flatten() }),
        }
        if stop.load(std::sync::atomic::Ordering::Relaxed) {
            return Ok(None);
        }
    }
    Ok(Some(rows))
}

/// Photographs of the procedural chair; none when interrupted.
fn chair(o: &ThesisOptions, stop: &AtomicBool, events: &mut dyn FnMut(&str, &Event)) -> Result<Option<PathBuf>> {
    let ((edge, views), folder) = if o.quick { (QUICK_VIEWS, "chair-quick") } else { (CHAIR_VIEWS, "chair") };
    let data = o.out.join("data").join(folder);
    if data.join("transforms_train.json").is_file() {
        return Ok(Some(data));
    }
    events(CHAIR, &Event::Note(format!("photographing the procedural chair from {views} sides")));
    let sky = |elevation, rotation| LightOptions { strength: 0.02, ..LightOptions::of(Source::Sky { elevation, rotation }) };
    let options = ObjectSynth {
        object: CHAIR.into(),
        views,
        size: (edge, edge),
        samples: 32,
        light: sky(35.0, 140.0),
        unseen: sky(15.0, 300.0),
        shows_light: false,
        seed: 0,
    };
    let made = synth::generate(&data, &options, false, stop, &mut |_| {})?;
    Ok((!made.interrupted).then_some(data))
}

/// Settings of table 1.
fn settings(thesis: &ThesisObject, data: &Path, quick: bool) -> (Config, u32) {
    let (steps, grid, texture) = if quick { QUICK } else { (thesis.steps, thesis.grid, thesis.texture) };
    let mut config = Config::new(Preset::Fast, data.into());
    config.grid.cells = [(32, 13), (64, 26), (128, 52)].into_iter().find(|(g, _)| *g == grid).map_or(26, |(_, cells)| cells);
    (config.material.texture, config.run.batch) = (texture, if quick { 1 } else { BATCH });
    (config.run.topology_steps, config.run.texture_steps) = (steps, steps);
    (config, grid)
}

/// The capture of a configuration; every eighth photograph is held out where none is.
fn import(config: &mut Config) -> Result<Capture> {
    let imported = capture::import(config)?;
    if imported.frames.iter().any(|f| f.split == Split::Test) {
        return Ok(imported);
    }
    config.data.split = HOLD_OUT.into();
    capture::import(config)
}

/// Trains and scores an object; none when interrupted.
fn own(
    thesis: &ThesisObject,
    data: &Path,
    o: &ThesisOptions,
    stop: &AtomicBool,
    events: &mut dyn FnMut(&str, &Event),
) -> Result<Option<OurRow>> {
    let run = o.out.join(if o.quick { format!("{}-quick", thesis.key) } else { thesis.key.into() });
    let events = &mut |e: &Event| events(thesis.key, e);
    let ((mut config, grid), resume) = (settings(thesis, data, o.quick), run.exists());
    let (mut folder, imported) = if resume {
        let (folder, description) = RunFolder::open(&run)?;
        config = description.config::<Config>()?;
        let capture = folder.capture()?;
        (folder, capture)
    } else {
        let imported = import(&mut config)?;
        capture::load(&config, &imported)?;
        (RunFolder::create(&run, false)?, imported)
    };
    let trained = recipe::train(&config, &imported, &mut folder, resume, stop, events)?;
    if trained.summary.interrupted {
        return Ok(None);
    }
    recipe::export(&trained.model, &run.join("object.glb"))?;
    let (ssim, psnr, lpips) = scores(&trained, o.lpips.as_ref())?;
    let count = |split| trained.capture.indices(split).len();
    let Stage::Textured(textured) = &trained.model.stage else { unreachable!("training is over") };
    Ok(Some(OurRow {
        texture: config.material.texture,
        grid,
        steps: config.run.texture_steps,
        views: count(Split::Train),
        held_out: count(Split::Test),
        triangles: textured.layout.faces.len(),
        seconds: trained.summary.seconds,
        ssim,
        psnr,
        lpips,
        run,
    }))
}

/// Means over the held-out photographs, before white in sRGB.
fn scores(trained: &Trained, lpips: Option<&Lpips>) -> Result<(f64, f64, Option<f64>)> {
    let Stage::Textured(textured) = &trained.model.stage else { unreachable!("training is over") };
    let held_out: Vec<&ObjectPhoto> = trained.capture.indices(Split::Test).into_iter().map(|i| &trained.capture.photos[i]).collect();
    let (mut each, mut distance): (Vec<ImageScores>, Vec<f64>) = Default::default();
    for photo in held_out {
        let [ours, _] = textured.picture(&photo.view, &trained.model.probe);
        let [ours, right] = [&ours, &photo.rgba.data].map(|p| before_white(p, photo.view.size()));
        each.push(metrics::compare(&ours, &right, |_, _| true));
        if let Some(lpips) = lpips {
            distance.push(lpips.distance(&ours, &right).map_err(PipelineError::Usage)?);
        }
    }
    let mean = |of: &dyn Fn(&ImageScores) -> f64| each.iter().map(of).sum::<f64>() / each.len().max(1) as f64;
    Ok((mean(&|s| s.ssim), mean(&|s| s.psnr), lpips.map(|_| distance.iter().sum::<f64>() / distance.len().max(1) as f64)))
}

/// sRGB of linear light times opacity `[H, W, 4]`.
fn before_white(rgba: &[f32], [height, width]: [usize; 2]) -> Image {
    let pixel = |p: &[f32; 4]| [0, 1, 2].map(|k| srgb_from_linear((p[k] + 1.0 - p[3]).clamp(0.0, 1.0)));
    Image { width, height, channels: 3, data: rgba.as_chunks::<4>().0.iter().flat_map(pixel).collect() }
}
