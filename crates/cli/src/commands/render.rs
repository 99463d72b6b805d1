//! `diorama render`

use super::{INTERRUPT, Outcome, clip_or_crop, note, use_threads, watch_interrupts};
use crate::arguments::RenderArgs;
use diorama_data::film::FilmFormat;
use diorama_pipelines::object::export::Size;
use diorama_pipelines::object::render::{self, Layer, RenderOptions};
use diorama_pipelines::object::{device, run_folder, viewing};
use diorama_pipelines::{PipelineError, Result};
use std::time::Instant;

pub fn run(a: &RenderArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let usage = |e: String| PipelineError::Usage(format!("--{e}"));
    let size = a.size.as_deref().map(parse_size).transpose()?;
    if a.frames == Some(0) || a.fps == Some(0) {
        return Err(PipelineError::Usage("--frames and --fps: must be at least 1".into()));
    }
    if a.fov.is_some_and(|f| !(f > 0.0 && f < 179.0)) {
        return Err(PipelineError::Usage("--fov: must lie between 0 and 179 degrees".into()));
    }
    let layers = a.layers.iter().map(|l| l.parse().map_err(usage)).collect::<Result<Vec<_>>>()?;
    let path = a.path.parse().map_err(usage)?;
    let quality = a.quality.parse().map_err(usage)?;
    a.video.as_deref().map(FilmFormat::of).transpose()?;
    let depth = a.depth.parse().map_err(usage)?;
    if a.scale.is_some_and(|s| !(s > 0.0 && s.is_finite())) {
        return Err(PipelineError::Usage("--scale: must be a number above 0".into()));
    }
    let scale = match (a.scale, layers.contains(&Layer::Depth)) {
        (None, true) => viewing::read_scale(&a.run)?.map(Size::meters_per_unit),
        (given, _) => given,
    };
    let (mut model, notes) = run_folder::load_model(&a.run)?;
    notes.iter().for_each(|n| note(n));
    device::accelerate(&mut model, &a.device, Box::new(note))?;
    let images = a.images.clone().or_else(|| a.video.is_none().then(|| a.run.join("render")));
    let clip = clip_or_crop(a.clip.as_deref(), "all", &a.run, &model)?;
    let options = RenderOptions {
        path,
        frames: a.frames,
        size,
        fov: a.fov.map(f64::to_radians),
        layers,
        images: images.clone(),
        video: a.video.clone(),
        fps: a.fps,
        clip,
        quality,
        depth,
        scale,
    };
    watch_interrupts();
    let start = Instant::now();
    let mut last = Instant::now();
    let (frames, interrupted) = render::render(&model, &options, &INTERRUPT, &mut |i, n| {
        if last.elapsed().as_secs() >= 5 || i == n {
            last = Instant::now();
            eprintln!("frame {i} of {n}");
        }
    })?;
    let seconds = start.elapsed().as_secs_f64();
    // Of a film that was interrupted there are the frames so far; before the first there is none.
    let (images, video) = (images.filter(|_| frames > 0), a.video.clone().filter(|_| frames > 0));
    if interrupted {
        match frames {
            0 => eprintln!("interrupted before the first frame: nothing was written"),
            n => eprintln!("interrupted: what was written ends with frame {n}"),
        }
    }
    if a.json {
        println!(
            "{}",
            serde_json::json!({ "run": a.run, "frames": frames, "seconds": seconds, "images": images, "video": video, "interrupted": interrupted })
        );
    } else {
        println!("{frames} frames in {seconds:.1} s");
        images.iter().chain(&video).for_each(|p| println!("{}", p.display()));
    }
    Ok(if interrupted { Outcome::Interrupted } else { Outcome::Done })
}

fn parse_size(text: &str) -> Result<(u32, u32)> {
    let bad = || PipelineError::Usage(format!("--size {text}: expected WIDTHxHEIGHT, each 16 to 8192"));
    let (w, h) = text.split_once('x').ok_or_else(bad)?;
    let side = |s: &str| s.parse::<u32>().ok().filter(|v| (16..=8192).contains(v)).ok_or_else(bad);
    Ok((side(w)?, side(h)?))
}
