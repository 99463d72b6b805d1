//! Everything at once on a capture that the project generates itself.

use super::config::{Config, Method};
use super::evaluate::{self, Report};
use super::export::{self, ExportOptions, Exported, Format, Size};
use super::recipe::{self, Trained};
use super::render::{self, Layer, PathKind, RenderOptions};
use super::report;
use super::scored_view::ScoredView;
use crate::error::Result;
use crate::run::RunFolder;
use diorama_data::{DataError, photo, transforms_json};
use diorama_engine::renderers::volume::Quality;
use diorama_engine::train::{Event, Summary};
use diorama_geom::capture::{Frame, Split};
use diorama_geom::{Capture, ImageU8};
use diorama_scenes::still_life;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// What the quickstart made.
#[derive(Clone, Debug, Serialize)]
pub struct Made {
    pub folder: PathBuf,
    pub psnr: f64,
    pub ssim: f64,
    pub train_seconds: f64,
    pub steps: u64,
    pub mesh: Exported,
    /// None where it was interrupted before its first frame.
    pub video: Option<PathBuf>,
    pub report: PathBuf,
    pub interrupted: bool,
}

/// Writes the still life as a capture with `transforms.json` into `folder`: `views` photographs of `size` pixels a side.
pub fn write_capture(folder: &Path, views: usize, size: u32) -> Result<()> {
    let images = folder.join("images");
    std::fs::create_dir_all(&images).map_err(DataError::io(&images, "create"))?;
    let mut frames = Vec::new();
    for (i, p) in still_life::photographs(views, size).into_iter().enumerate() {
        let image = images.join(format!("{}.png", p.name));
        photo::save_png(&image, &p.image)?;
        let split = if i % 8 == 0 { Split::Test } else { Split::Train };
        frames.push(Frame { split, ..Frame::new(p.name, image, p.camera, p.world_from_camera) });
    }
    let capture = Capture::new(frames, still_life::scene_box());
    Ok(transforms_json::write(&folder.join("transforms.json"), folder, &capture, None)?)
}

/// Generates, trains, scores, films, exports and reports, all into `folder`.
pub fn quickstart(
    folder: &Path,
    seconds: f64,
    force: bool,
    interrupt: &AtomicBool,
    note: &mut dyn FnMut(&str),
    events: &mut dyn FnMut(&Event),
) -> Result<Made> {
    let mut run = RunFolder::create(folder, force)?;
    note("rendering the still life");
    let data = folder.join("capture");
    write_capture(&data, still_life::VIEWS, still_life::SIZE)?;
    let mut config = Config::new(Method::Ngp, data);
    config.run.steps = 0;
    config.run.seconds = seconds;
    config.run.log_every = 20;
    // A small scene: a smaller table is as sharp and trains faster.
    config.field.log2_size = 17;
    config.field.finest = 512;
    let Trained { model, summary, device } = recipe::train(&config, &mut run, false, None, interrupt, events)?;
    note("scoring held-out views");
    let mut pairs: Vec<Vec<ImageU8>> = vec![Vec::new(), Vec::new()];
    let mut keep = |_: &str, v: &ScoredView| -> Result<()> {
        if pairs[0].len() < 4 {
            pairs[0].push(v.photo.to_u8());
            pairs[1].push(v.view.rgb.to_u8());
        }
        Ok(())
    };
    let scores = evaluate::evaluate_with_training(&model, Split::Test, Quality::Full, None, &mut keep, &mut |_| {})?;
    photo::save_png(&folder.join("held_out.png"), &super::compare::tile(&pairs))?;
    note("filming a turntable");
    let video = folder.join("turntable.mp4");
    let options = RenderOptions {
        path: PathKind::Orbit,
        frames: Some(60),
        size: None,
        fov: None,
        layers: vec![Layer::Rgb],
        images: None,
        video: Some(video.clone()),
        fps: Some(20),
        clip: None,
        quality: Quality::Full,
        depth: Default::default(),
        scale: None,
    };
    let (filmed, _) = render::render(&model, &options, interrupt, &mut |_, _| {})?;
    note("extracting the mesh");
    let options = ExportOptions {
        format: Format::Glb,
        out: folder.join("still_life.glb"),
        method: Default::default(),
        resolution: 192,
        level: None,
        faces: Some(40_000),
        texture: Some(1024),
        normal_map: false,
        watertight: false,
        size: Size::Unknown,
        unit_m: 1.0,
        clip: None,
        floaters: 0.05,
        keep_unseen: false,
    };
    let mesh = export::export(&model, &options, note, &mut |_, _, _| {})?;
    let page = folder.join("report.html");
    report::write(&page, &summary, &device, &scores, &mesh, filmed > 0)?;
    Ok(made(folder, summary, scores, mesh, Some(video).filter(|_| filmed > 0), page))
}

fn made(folder: &Path, summary: Summary, scores: Report, mesh: Exported, video: Option<PathBuf>, report: PathBuf) -> Made {
    Made {
        folder: folder.to_path_buf(),
        psnr: scores.psnr,
        ssim: scores.ssim,
        train_seconds: summary.seconds,
        steps: summary.step,
        mesh,
        video,
        report,
        interrupted: summary.interrupted,
    }
}
