//! `diorama render`

use super::clip::clip_or_crop;
use super::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use super::{Outcome, Verb};
use clap::Args;
use diorama_data::film::FilmFormat;
use diorama_pipelines::object::export::Size;
use diorama_pipelines::object::render::{self, Layer, RenderOptions};
use diorama_pipelines::object::{device, run_folder, viewing};
use diorama_pipelines::{Application, PipelineError, Result};
use std::path::PathBuf;
use std::time::Instant;

/// Render novel views along a camera path
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama render runs/chair --video orbit.mp4\n  diorama render runs/chair --path camera_path.json --layers rgb,depth,normal --images frames/"
)]
pub struct Render {
    /// Folder of the run
    run: PathBuf,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    device: String,
    /// orbit, spiral, interpolate, held-out, or a camera_path.json
    #[arg(long, default_value = "orbit")]
    path: String,
    /// Number of frames [default: 90, or all held-out views]
    #[arg(long)]
    frames: Option<usize>,
    /// WIDTHxHEIGHT [default: that of the run, or of the path's file]
    #[arg(long)]
    size: Option<String>,
    /// Horizontal field of view in degrees [default: that of the capture, or of the path's file]
    #[arg(long)]
    fov: Option<f64>,
    /// rgb, depth, normal, opacity, occupancy
    #[arg(long, default_value = "rgb", value_delimiter = ',')]
    layers: Vec<String>,
    /// Folder for PNG sequences [default: RUN/render unless --video is given]
    #[arg(long)]
    images: Option<PathBuf>,
    /// Video of the first layer: .mp4, or .gif with up to 50 frames per second
    #[arg(long)]
    video: Option<PathBuf>,
    /// [default: 30, or that of the path's file]
    #[arg(long)]
    fps: Option<u32>,
    /// File format of distances in the layer depth, besides its pictures: png (16 bit, one step for the sequence, in depth.json), exr or
    /// npy (floats)
    #[arg(long, default_value = "png")]
    depth: String,
    /// Meters per unit of the capture, for distances [default: from the length measured in the viewer, else unknown]
    #[arg(long)]
    scale: Option<f64>,
    /// Show only the inside of x0,y0,z0,x1,y1,z1 (the input's frame), or all [default: the crop box saved in the viewer, else all]
    #[arg(long, allow_hyphen_values = true)]
    clip: Option<String>,
    /// full, or fast for previews
    #[arg(long, default_value = "full")]
    quality: String,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Render {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        match Application::of_run(&self.run)? {
            Application::Object => self.object(),
            of @ Application::Relight => Err(of.refuse(&self.run, "diorama relight render")),
            of @ Application::RelightObject => Err(of.refuse(&self.run, "diorama relight turntable with its GLB")),
            of @ Application::Text => Err(of.refuse(&self.run, "diorama text eval, which draws its held-out views")),
            of @ Application::Detector => Err(of.refuse(&self.run, "diorama text eval-detector --weights")),
        }
    }
}

impl Render {
    /// Renders a run of the object application.
    fn object(&self) -> Result<Outcome> {
        let mut options = self.options()?;
        let (mut model, notes) = run_folder::load_model(&self.run)?;
        notes.iter().for_each(|n| note(n));
        device::accelerate(&mut model, &self.device, Box::new(note))?;
        options.clip = clip_or_crop(self.clip.as_deref(), "all", &self.run, &model)?;
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
        // An interrupted video keeps the frames so far; before the first frame nothing is written.
        let (images, video) = (options.images.filter(|_| frames > 0), options.video.filter(|_| frames > 0));
        if interrupted {
            match frames {
                0 => eprintln!("interrupted before the first frame: nothing was written"),
                n => eprintln!("interrupted: the output ends with frame {n}"),
            }
        }
        if self.json {
            println!(
                "{}",
                serde_json::json!({ "run": self.run, "frames": frames, "seconds": seconds, "images": images, "video": video, "interrupted": interrupted })
            );
        } else {
            println!("{frames} frames in {seconds:.1} s");
            images.iter().chain(&video).for_each(|p| println!("{}", p.display()));
        }
        Ok(if interrupted { Outcome::Interrupted } else { Outcome::Done })
    }

    /// The requested options, except the box, which depends on the model.
    fn options(&self) -> Result<RenderOptions> {
        let size = self.size.as_deref().map(parse_size).transpose()?;
        if self.frames == Some(0) || self.fps == Some(0) {
            return Err(PipelineError::Usage("--frames and --fps: must be at least 1".into()));
        }
        if self.fov.is_some_and(|f| !(f > 0.0 && f < 179.0)) {
            return Err(PipelineError::Usage("--fov: must lie between 0 and 179 degrees".into()));
        }
        let layers = self.layers.iter().map(|l| l.parse().map_err(usage)).collect::<Result<Vec<_>>>()?;
        let path = self.path.parse().map_err(usage)?;
        let quality = self.quality.parse().map_err(usage)?;
        self.video.as_deref().map(FilmFormat::of).transpose()?;
        let depth = self.depth.parse().map_err(usage)?;
        if self.scale.is_some_and(|s| !(s > 0.0 && s.is_finite())) {
            return Err(PipelineError::Usage("--scale: must be a number above 0".into()));
        }
        let scale = match (self.scale, layers.contains(&Layer::Depth)) {
            (None, true) => viewing::read_scale(&self.run)?.map(Size::meters_per_unit),
            (given, _) => given,
        };
        Ok(RenderOptions {
            path,
            frames: self.frames,
            size,
            fov: self.fov.map(f64::to_radians),
            layers,
            images: self.images.clone().or_else(|| self.video.is_none().then(|| self.run.join("render"))),
            video: self.video.clone(),
            fps: self.fps,
            clip: None,
            quality,
            depth,
            scale,
        })
    }
}

pub fn parse_size(text: &str) -> Result<(u32, u32)> {
    let bad = || PipelineError::Usage(format!("--size {text}: expected WIDTHxHEIGHT, each 16 to 8192"));
    let (w, h) = text.split_once('x').ok_or_else(bad)?;
    let side = |s: &str| s.parse::<u32>().ok().filter(|v| (16..=8192).contains(v)).ok_or_else(bad);
    Ok((side(w)?, side(h)?))
}
