//! `diorama prepare`

use super::mask_flags::MaskFlags;
use super::process::{INTERRUPT, usage, use_threads, watch_interrupts};
use super::work_flags::WorkFlags;
use super::{Outcome, Verb};
use clap::Args;
use diorama_data::split::SplitRule;
use diorama_data::video::Choice;
use diorama_pipelines::Result;
use diorama_pipelines::run::prepare::{self, Finish, PrepareOptions, Prepared, Sfm, Wanted};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Turn photographs or a video into a data set, with poses from COLMAP or from the capture
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama prepare photos/ -o data/chair\n  diorama prepare chair.mp4 -o data/chair --frames 120\n  diorama prepare photos/ -o data/chair --resume --remove-background auto\n  diorama prepare posed/ -o data/chair --sfm none --remove-background auto\n\nCOLMAP (and ffmpeg for videos) must be installed; set DIORAMA_COLMAP or DIORAMA_FFMPEG to use programs outside PATH."
)]
pub struct Prepare {
    /// Folder of photographs, or a video; with --sfm none, a capture that has poses
    input: PathBuf,
    /// Folder of the data set
    #[arg(short, long)]
    out: PathBuf,
    /// Source of the poses: colmap, or none for a capture that has them (transforms.json, COLMAP model, poses_bounds.npy)
    #[arg(long, default_value = "colmap")]
    sfm: String,
    /// With --sfm none: transforms, blender, colmap or llff, if the folder contains several
    #[arg(long)]
    format: Option<String>,
    #[command(flatten)]
    masks: MaskFlags,
    /// Largest number of frames from a video; the sharpest of each interval is taken
    #[arg(long, default_value_t = 150, conflicts_with = "fps")]
    frames: usize,
    /// Frames per second of a video, instead of --frames
    #[arg(long)]
    fps: Option<f64>,
    /// Take every N-th photograph
    #[arg(long, default_value_t = 1)]
    every: usize,
    /// Reduce photographs whose longest side is larger
    #[arg(long, value_name = "PIXELS")]
    max_side: Option<u32>,
    /// Pairs to compare: auto, exhaustive or sequential
    #[arg(long, default_value = "auto")]
    matcher: String,
    /// Largest number of features per photograph; matching time grows with its square
    #[arg(long, default_value_t = 8192)]
    features: usize,
    /// COLMAP's camera model: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or OPENCV_FISHEYE
    #[arg(long, default_value = "OPENCV")]
    lens: String,
    /// Keep only some photographs: diverse:N keeps the N that differ most in position, direction and appearance
    #[arg(long, value_name = "diverse:N")]
    select: Option<String>,
    /// Crop the photographs once their poses are known: square, or x,y,width,height in pixels
    #[arg(long)]
    crop: Option<String>,
    /// Remove noise (non-local means; the strength follows the measured noise)
    #[arg(long)]
    denoise: bool,
    /// Equalize exposure and white balance, by points that several photographs show
    #[arg(long)]
    normalize_exposure: bool,
    /// off, auto (by the points on what the cameras look at), or a segmentation network: NETWORK.onnx
    #[arg(long, default_value = "off")]
    remove_background: String,
    /// every:N, A:B:C (percent), all, or file: as in the capture's files [default: every:8; with --sfm none file]
    #[arg(long)]
    split: Option<String>,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Leave out photographs that cannot be decoded, for example because they are truncated, and list them
    #[arg(long)]
    skip_broken: bool,
    /// Fail if fewer than this percentage of the photographs find a pose
    #[arg(long, default_value_t = 80.0)]
    min_registered: f64,
    #[command(flatten)]
    work: WorkFlags,
}

impl Verb for Prepare {
    fn json(&self) -> bool {
        self.work.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.work.threads)?;
        self.check_numbers()?;
        let name = self.out.file_name().unwrap_or_default().to_string_lossy();
        let next = format!("diorama train {} -o runs/{name}", self.out.display());
        carry_out(&self.options()?, &next, self.work.json)
    }
}

/// Prepares a data set, prints progress and what was made, and `next`, what to do then.
pub fn carry_out(options: &PrepareOptions, next: &str, json: bool) -> Result<Outcome> {
    watch_interrupts();
    let (mut last, mut stage) = (Instant::now(), String::new());
    let mut note = |text: &str| {
        // New stages are printed at once, counts within a stage every two seconds.
        let begins = text.split(':').next().unwrap_or(text);
        if begins != stage || last.elapsed() > Duration::from_secs(2) {
            (last, stage) = (Instant::now(), begins.to_string());
            eprintln!("{text}");
        }
    };
    let Some(made) = prepare::prepare(options, &INTERRUPT, &mut note)? else {
        eprintln!("interrupted: the same command goes on with --resume added");
        return Ok(Outcome::Interrupted);
    };
    if json {
        println!("{}", serde_json::to_string(&made).expect("plain values"));
        return Ok(Outcome::Done);
    }
    print(&made, next);
    Ok(Outcome::Done)
}

impl Prepare {
    /// # Errors
    /// If a number is outside its range.
    fn check_numbers(&self) -> Result<()> {
        let least = |flag: &str, ok: bool, what: &str| if ok { Ok(()) } else { Err(usage(format!("{flag}: must be {what}"))) };
        least("frames", self.frames >= 3, "at least 3")?;
        least("fps", self.fps.is_none_or(|f| f > 0.0 && f.is_finite()), "above 0")?;
        least("every", self.every >= 1, "at least 1")?;
        least("features", self.features >= 256, "at least 256")?;
        least("max-side", self.max_side.is_none_or(|s| s >= 64), "at least 64")?;
        least("min-registered", (0.0..=100.0).contains(&self.min_registered), "0 to 100")
    }

    /// The requested options.
    fn options(&self) -> Result<PrepareOptions> {
        let sfm: Sfm = self.sfm.parse().map_err(usage)?;
        if sfm == Sfm::Colmap
            && let Some(flag) = [("format", &self.format), ("mask", &self.masks.mask), ("mask-meaning", &self.masks.mask_meaning)]
                .iter()
                .find(|f| f.1.is_some())
        {
            return Err(usage(format!("{}: is only for captures that have poses; give --sfm none too", flag.0)));
        }
        let split: Option<SplitRule> = self.split.as_deref().map(str::parse).transpose().map_err(usage)?;
        let diverse = |text: &String| {
            let n = text.strip_prefix("diverse:").and_then(|n| n.parse::<usize>().ok()).filter(|n| *n >= 3);
            n.ok_or_else(|| usage(format!("select {text}: expected diverse:N with N of at least 3")))
        };
        let finish = Finish {
            crop: self.crop.as_deref().map(str::parse).transpose().map_err(usage)?,
            diverse: self.select.as_ref().map(diverse).transpose()?,
            denoise: self.denoise,
            normalize_exposure: self.normalize_exposure,
            background: self.remove_background.parse().map_err(usage)?,
        };
        Ok(PrepareOptions {
            finish,
            input: self.input.clone(),
            out: self.out.clone(),
            sfm,
            format: self.format.as_deref().map(str::parse).transpose().map_err(usage)?,
            masks: self.masks.options()?,
            choice: self.fps.map_or(Choice::Count(self.frames), Choice::PerSecond),
            wanted: Wanted::ANY,
            every: self.every,
            max_side: self.max_side.unwrap_or(u32::MAX),
            matcher: self.matcher.parse().map_err(usage)?,
            features: self.features,
            lens: self.lens.to_uppercase(),
            split: split.unwrap_or(SplitRule::File),
            seed: self.seed,
            min_registered: self.min_registered,
            threads: self.work.threads,
            resume: self.work.resume,
            force: self.work.force,
            skip_broken: self.skip_broken,
        })
    }
}

fn print(made: &Prepared, next: &str) {
    println!(
        "{}: {} of {} photographs have poses, {} points, {} held out, scene {} times the inner cube{}",
        made.folder.display(),
        made.registered,
        made.images,
        made.points,
        made.held_out,
        made.aabb_scale,
        if made.floor { ", leveled by the floor" } else { "" }
    );
    if !made.lost.is_empty() {
        println!("without a pose: {}", made.lost.join(", "));
    }
    if !made.broken.is_empty() {
        println!("broken, left out: {}", made.broken.join(", "));
    }
    let f = &made.finished;
    if f.left_out > 0 {
        println!("left out: {} photographs that are similar to others", f.left_out);
    }
    if let Some([dark, bright]) = f.exposure_stops {
        println!("exposures equalized: they were {dark:+.2} to {bright:+.2} stops from the median");
    }
    if let Some(sigma) = f.noise {
        println!("noise removed: {sigma:.1} of 255 in the median photograph");
    }
    if let Some(share) = f.foreground {
        println!("background removed: {:.0} % of the pixels are left", 100.0 * share);
    }
    println!("look at: {}", made.sheet.display());
    println!("next: {next}");
}
