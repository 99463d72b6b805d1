//! Everything at once on data that the project generates: a street in several lights and a chair, both trained, meshed and composed under a
//! light that neither was photographed in.

mod page;

use super::compose;
use super::light::{LightOptions, Source};
use super::meshing::{self, MeshOptions};
use super::object::{self, scores::ObjectScores, synth::ObjectSynth};
use super::outdoor::scores::SceneScores;
use super::outdoor::{self, model::SceneModel};
use super::path_tracer::PathTracer;
use super::scenario::{self, Scenario, ScenarioOptions};
use super::synth::{self, Place, SynthOptions};
use super::{picture, scene_file, truth};
use crate::error::{PipelineError, Result};
use crate::run::RunFolder;
use crate::run::config::Configuration;
use crate::run::stages::Listeners;
use diorama_data::{DataError, atomic, environment, photo};
use diorama_engine::train::Event;
use diorama_geom::ImageU8;
use diorama_geom::capture::Split;
use diorama_mesh::extract::Method;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Samples per pixel of the composition, and of pictures of the object that are path-traced for its scores.
const COMPOSED_SAMPLES: u32 = 64;
const SCORED_SAMPLES: u32 = 16;
/// Rays per pixel and axis of pictures of the scene.
const RAYS: u32 = 2;
/// Size of the composition.
const COMPOSED_SIZE: (u32, u32) = (480, 270);
/// Cells along the street's mesh, its most faces, and the edge of its texture.
const MESH: (usize, usize, usize) = (192, 60_000, 1024);
/// Share of the scene's steps in which surfaces are learned.
const SURFACES: f32 = 0.85;
/// Albedo of the ground that the chair is photographed on: without it, what faces down or away from the sun is black.
const GROUND: f64 = 0.35;

/// How much is generated and trained.
#[derive(Clone, Debug)]
pub struct QuickstartOptions {
    pub street: SynthOptions,
    pub scene_steps: u64,
    pub chair_views: usize,
    pub chair_size: (u32, u32),
    pub object: object::config::Preset,
    /// Steps of each of the object's stages; none: those of its preset.
    pub object_steps: Option<u64>,
    /// Steps of its stage in which light is traced.
    pub traced_steps: u64,
}

impl Default for QuickstartOptions {
    /// Less than a quarter of an hour on two cores.
    fn default() -> Self {
        QuickstartOptions {
            street: SynthOptions { views: 20, lights: 4, size: (96, 54), samples: 48, seed: 0 },
            scene_steps: 3500,
            chair_views: 48,
            chair_size: (192, 192),
            object: object::config::Preset::Fast,
            object_steps: Some(400),
            traced_steps: 120,
        }
    }
}

/// Figures, and where everything is.
#[derive(Clone, Debug, Serialize)]
pub struct Made {
    pub folder: PathBuf,
    pub unseen_light_psnr: f64,
    pub albedo_psnr: f64,
    pub normal_median_deg: f64,
    pub object_psnr: f64,
    pub object_relight_psnr: f64,
    /// The object, and the street.
    pub glb: PathBuf,
    pub site_glb: PathBuf,
    pub composed: PathBuf,
    pub report: PathBuf,
    pub scene: SceneScores,
    pub object: ObjectScores,
    pub notes: Vec<String>,
}

/// Generates, trains, scores, meshes, composes and reports into `folder`; none when stopped. What is done already is kept: the same command
/// goes on after an interruption.
///
/// # Errors
/// When a stage fails, or the folder cannot be written.
pub fn quickstart(folder: &Path, o: &QuickstartOptions, stop: &AtomicBool, listeners: Listeners) -> Result<Option<Made>> {
    std::fs::create_dir_all(folder).map_err(DataError::io(folder, "create"))?;
    let Listeners { stage: note, share, events } = listeners;
    let mut q = Quickstart { folder, o, stop, notes: Vec::new(), share, events };
    note("photographing a street in four lights");
    if !q.street()? {
        return Ok(None);
    }
    note("training the scene: albedo, normals, shadow and light");
    let Some(model) = q.scene()? else { return Ok(None) };
    note("scoring the scene");
    let scene = q.score_scene(&model)?;
    note("photographing a chair");
    if !q.chair()? {
        return Ok(None);
    }
    note("training the chair: shape and materials");
    let Some((glb, object)) = q.object()? else { return Ok(None) };
    note("meshing the street");
    let Some(site_glb) = q.mesh(&model)? else { return Ok(None) };
    note("composing both under a light of no photograph");
    let Some(composed) = q.compose(&model, &site_glb, &glb)? else { return Ok(None) };
    let made = Made {
        folder: folder.to_path_buf(),
        unseen_light_psnr: scene.unseen_light_psnr,
        albedo_psnr: scene.albedo_psnr,
        normal_median_deg: scene.normal_median_deg,
        object_psnr: object.object_psnr,
        object_relight_psnr: object.truth.as_ref().map_or(f64::NAN, |t| t.object_relight_psnr),
        glb,
        site_glb,
        composed,
        report: folder.join("report.html"),
        scene,
        object,
        notes: q.notes,
    };
    atomic::write(&made.report, page::html(&made).as_bytes())?;
    Ok(Some(made))
}

struct Quickstart<'a> {
    folder: &'a Path,
    o: &'a QuickstartOptions,
    stop: &'a AtomicBool,
    notes: Vec<String>,
    share: &'a mut dyn FnMut(f64),
    events: &'a mut dyn FnMut(&Event),
}

impl Quickstart<'_> {
    fn at(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// A run folder, and whether it goes on with an earlier run.
    fn run(&self, name: &str) -> Result<(RunFolder, bool)> {
        let at = self.at(name);
        if at.exists() { Ok((RunFolder::open(&at)?.0, true)) } else { Ok((RunFolder::create(&at, false)?, false)) }
    }

    /// Whether the street is there.
    fn street(&mut self) -> Result<bool> {
        let (out, street) = (self.at("street"), &self.o.street);
        if out.join("transforms_train.json").exists() {
            return Ok(true);
        }
        let made = synth::generate(&out, &Place::street(street), street, false, self.stop, self.share)?;
        Ok(!made.interrupted)
    }

    fn scene(&mut self) -> Result<Option<SceneModel>> {
        let mut config = outdoor::config::Config::new(outdoor::config::Preset::Ci, self.at("street"));
        config.run.steps = self.o.scene_steps;
        (config.light.model, config.light.from) = ("sun".into(), SURFACES);
        config.check()?;
        let (mut folder, resume) = self.run("scene")?;
        let trained = outdoor::recipe::train(&config, &mut folder, resume, None, self.stop, self.events)?;
        Ok((!trained.summary.interrupted).then_some(trained.model))
    }

    /// Scores, with pictures of the held-out views and of their layers in `pictures/`.
    fn score_scene(&mut self, model: &SceneModel) -> Result<SceneScores> {
        let pictures = self.at("pictures");
        std::fs::create_dir_all(&pictures).map_err(DataError::io(&pictures, "create"))?;
        let mut rows = Vec::new();
        let look = &mut |_: &str, sheet: &outdoor::scores::Sheet| {
            rows.extend([&sheet.ours, &sheet.exact].map(|row| row.iter().map(three_channels).collect()));
            Ok(())
        };
        let scores = outdoor::scores::judge(model, &self.at("street"), RAYS, look, self.share)?;
        photo::save_png(&pictures.join("layers.png"), &tiled(&rows))?;
        Ok(scores)
    }

    /// Whether the photographs of the chair are there.
    fn chair(&mut self) -> Result<bool> {
        let out = self.at("chair");
        if out.join("transforms_train.json").exists() {
            return Ok(true);
        }
        let above_ground = |name: &str| -> Result<LightOptions> {
            let above = environment::read(&truth::light_file(&self.at("street"), name))?.environment.above_ground(GROUND);
            let file = self.at(&format!("chair-{name}.hdr"));
            environment::save_hdr(&file, &above)?;
            Ok(LightOptions::of(Source::File(file)))
        };
        let options = ObjectSynth {
            object: "chair".into(),
            views: self.o.chair_views,
            size: self.o.chair_size,
            samples: 48,
            light: above_ground("veiled")?,
            unseen: above_ground("unseen")?,
            shows_light: false,
            seed: 0,
        };
        Ok(!object::synth::generate(&out, &options, false, self.stop, self.share)?.interrupted)
    }

    fn object(&mut self) -> Result<Option<(PathBuf, ObjectScores)>> {
        let mut config = object::config::Config::new(self.o.object, self.at("chair"));
        self.o.object_steps.iter().for_each(|s| (config.run.topology_steps, config.run.texture_steps) = (*s, *s));
        config.run.traced_steps = self.o.traced_steps;
        config.check()?;
        let imported = object::capture::import(&config)?;
        let (mut folder, resume) = self.run("object")?;
        let trained = object::recipe::train(&config, &imported, &mut folder, resume, self.stop, self.events)?;
        if trained.summary.interrupted {
            return Ok(None);
        }
        let glb = self.at("chair.glb");
        object::recipe::export(&trained.model, &glb)?;
        let pictures = self.at("pictures");
        let scores = object::scores::judge(&trained.model, &trained.capture, SCORED_SAMPLES, &mut |name, image| {
            Ok(photo::save_png(&pictures.join(format!("chair_{name}.png")), image)?)
        })?;
        Ok(Some((glb, scores)))
    }

    fn mesh(&mut self, model: &SceneModel) -> Result<Option<PathBuf>> {
        let (resolution, target, bake) = MESH;
        let out = self.at("street.glb");
        let options = MeshOptions {
            out: out.clone(),
            method: Method::Cubes,
            resolution,
            level: None,
            interpolate: true,
            target,
            bake,
            lods: 0,
            quantize: false,
        };
        let made = meshing::mesh(model, &options, self.stop, &mut |_, i, n| (self.share)(i as f64 / n.max(1) as f64))?;
        Ok(made.map(|m| {
            self.notes.extend(m.notes);
            out
        }))
    }

    /// The chair in the street under the unseen light.
    fn compose(&mut self, model: &SceneModel, site: &Path, chair: &Path) -> Result<Option<PathBuf>> {
        let description = self.describe(model, site, chair)?;
        let file = scene_file::read(&description)?;
        let mut composition = compose::load(&file)?;
        self.notes.append(&mut composition.notes);
        let out = self.at("composed.png");
        let kept = picture::kept_beside(&out);
        let composed = compose::render(&mut composition, &file, &mut PathTracer::cpu(), &kept, self.stop, self.share)?;
        if composed.interrupted {
            return Ok(None);
        }
        picture::save(&out, &composed.rgba, file.render.exposure)?;
        picture::discard(&kept)?;
        Ok(Some(out))
    }

    /// Writes `scene.toml`: the first held-out camera that sees free ground, for the chair as it is, else for one that fits. Where the mesh of
    /// the trained street has no such ground, the generated street takes its place, which is said.
    fn describe(&mut self, model: &SceneModel, site: &Path, chair: &Path) -> Result<PathBuf> {
        let scenario = Scenario::named("real-in-synthetic")?;
        let options = ScenarioOptions {
            site: None,
            object: Some(chair.to_path_buf()),
            frame: None,
            hdri: Some(truth::light_file(&self.at("street"), "unseen")),
            rotate_deg: 0.0,
            scale: None,
            size: COMPOSED_SIZE,
            samples: COMPOSED_SAMPLES,
        };
        let frames = model.capture.indices(Split::Test);
        for (scale, frame) in [Some(1.0), None].into_iter().flat_map(|scale| frames.iter().map(move |f| (scale, *f))) {
            let frame = format!("{}:{}", self.at("scene").display(), model.capture.frames[frame].name);
            let options = ScenarioOptions { site: Some(site.to_path_buf()), frame: Some(frame), scale, ..options.clone() };
            match scenario::prepare(self.folder, &scenario, &options, true, self.stop) {
                Ok((description, _)) => return Ok(description),
                Err(PipelineError::Usage(_)) => {}
                Err(e) => return Err(e),
            }
        }
        let said = "the mesh of the trained street has no level, free ground; the picture shows the generated street instead";
        self.notes.push(said.into());
        Ok(scenario::prepare(self.folder, &scenario, &options, true, self.stop)?.0)
    }
}

fn three_channels(image: &ImageU8) -> ImageU8 {
    let data = image.data.chunks_exact(image.channels).flat_map(|p| [p[0], p[1], p[2]]).collect();
    ImageU8 { width: image.width, height: image.height, channels: 3, data }
}

/// Rows of pictures of one size, as one picture.
fn tiled(rows: &[Vec<ImageU8>]) -> ImageU8 {
    let Some(first) = rows.iter().flatten().next() else { return ImageU8 { width: 0, height: 0, channels: 3, data: Vec::new() } };
    let (w, h, columns) = (first.width, first.height, rows.iter().map(Vec::len).max().unwrap_or(0));
    let mut out = ImageU8 { width: w * columns, height: h * rows.len(), channels: 3, data: vec![0; 3 * w * columns * h * rows.len()] };
    for (r, row) in rows.iter().enumerate() {
        for (c, picture) in row.iter().enumerate() {
            for y in 0..h {
                let at = 3 * ((r * h + y) * out.width + c * w);
                out.data[at..at + 3 * w].copy_from_slice(&picture.data[3 * y * w..3 * (y + 1) * w]);
            }
        }
    }
    out
}
