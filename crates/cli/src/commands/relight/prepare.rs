//! `diorama relight prepare`

use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::work_flags::WorkFlags;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_geom::glam::DVec3;
use diorama_pipelines::Result;
use diorama_pipelines::relight::prepare::{self, PrepareOptions, Prepared};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Turn photographs of a place in several lights into a data set: poses, sessions, masks
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama relight prepare photos/ -o data/site --sessions exif\n  diorama relight prepare landmark/ -o data/site --sessions each --masks masks/\n  diorama relight prepare NeRF-OSR/Data/site1/final -o data/site1 --sfm none --rescale"
)]
pub struct Prepare {
    /// Folder of photographs; with --sfm none, a capture that has poses (transforms.json, COLMAP model, NeRF-OSR's folders)
    input: PathBuf,
    /// Folder of the data set
    #[arg(short, long)]
    out: PathBuf,
    /// Source of the poses: colmap or none
    #[arg(long, default_value = "colmap")]
    sfm: String,
    /// Folder with a mask NAME.png for each photograph: 255 is static, 192 glass, 160 sky, 0 transient (people, cars, leaves)
    #[arg(long)]
    masks: Option<PathBuf>,
    /// auto: find the sky of each photograph and mark it in its mask, which may then be edited; none
    #[arg(long, default_value = "auto", value_parser = ["auto", "none"])]
    sky: String,
    /// exif (pauses of 30 minutes), names (before the number), folders, each, or a file with lines PHOTOGRAPH SESSION [default: as the
    /// capture says, else names]
    #[arg(long)]
    sessions: Option<String>,
    /// Reduce photographs whose longest side is larger
    #[arg(long, value_name = "PIXELS", default_value_t = 1280)]
    max_side: u32,
    /// Pairs to compare: auto, exhaustive or sequential
    #[arg(long, default_value = "auto")]
    matcher: String,
    /// COLMAP's camera model: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV
    #[arg(long, default_value = "SIMPLE_RADIAL")]
    lens: String,
    /// Largest number of features per photograph
    #[arg(long, default_value_t = 8192)]
    features: usize,
    /// Fail if fewer than this percentage of the photographs find a pose
    #[arg(long, default_value_t = 80.0)]
    min_registered: f64,
    /// every:N, A:B:C (percent), all, or file: as in the capture's files, else every:8
    #[arg(long, default_value = "file")]
    split: String,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Up direction x,y,z in the coordinates of the poses [default: across the cameras' horizontal axes]
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    up: Option<String>,
    /// Move and scale given poses so that the cameras lie in the unit sphere (poses of COLMAP always are)
    #[arg(long)]
    rescale: bool,
    /// Leave out photographs that cannot be decoded
    #[arg(long)]
    skip_broken: bool,
    #[command(flatten)]
    work: WorkFlags,
}

impl Verb for Prepare {
    fn json(&self) -> bool {
        self.work.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.work.threads)?;
        let options = self.options()?;
        watch_interrupts();
        let (mut last, mut stage) = (Instant::now(), String::new());
        let mut show = |text: &str| {
            // New stages are printed at once, counts within a stage every two seconds.
            let begins = text.split(':').next().unwrap_or(text);
            if begins != stage || last.elapsed() > Duration::from_secs(2) {
                (last, stage) = (Instant::now(), begins.to_string());
                eprintln!("{text}");
            }
        };
        let Some(made) = prepare::prepare(&options, &INTERRUPT, &mut show)? else {
            eprintln!("interrupted; give the same command with --resume to continue");
            return Ok(Outcome::Interrupted);
        };
        made.notes.iter().for_each(|n| note(n));
        if self.work.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
        } else {
            print(&made);
        }
        Ok(Outcome::Done)
    }
}

impl Prepare {
    fn options(&self) -> Result<PrepareOptions> {
        let least = |flag: &str, ok: bool, what: &str| if ok { Ok(()) } else { Err(usage(format!("{flag}: must be {what}"))) };
        least("max-side", self.max_side >= 64, "at least 64")?;
        least("features", self.features >= 256, "at least 256")?;
        least("min-registered", (0.0..=100.0).contains(&self.min_registered), "0 to 100")?;
        let vector = |text: &String| {
            let numbers = text.split(',').map(|v| v.trim().parse::<f64>().ok()).collect::<Option<Vec<f64>>>();
            let up = numbers.and_then(|n| <[f64; 3]>::try_from(n).ok()).map(DVec3::from).filter(|v| v.is_finite() && v.length() > 0.0);
            up.ok_or_else(|| usage(format!("up {text:?}: expected x,y,z, not all 0")))
        };
        Ok(PrepareOptions {
            input: self.input.clone(),
            out: self.out.clone(),
            sfm: self.sfm.parse().map_err(usage)?,
            masks: self.masks.clone(),
            sky: self.sky == "auto",
            sessions: self.sessions.as_deref().map(str::parse).transpose().map_err(usage)?,
            max_side: self.max_side,
            matcher: self.matcher.parse().map_err(usage)?,
            lens: self.lens.to_uppercase(),
            features: self.features,
            min_registered: self.min_registered,
            split: self.split.parse().map_err(usage)?,
            seed: self.seed,
            up: self.up.as_ref().map(vector).transpose()?,
            rescale: self.rescale,
            threads: self.work.threads,
            skip_broken: self.skip_broken,
            resume: self.work.resume,
            force: self.work.force,
        })
    }
}

fn print(made: &Prepared) {
    let mut masks = made.static_share.map_or(String::new(), |s| format!(", masks leave {:.0} %", 100.0 * s));
    made.glass_share.filter(|s| *s > 0.0).iter().for_each(|s| masks += &format!(", {:.1} % glass", 100.0 * s));
    if let Some(share) = made.sky_share {
        let without = if made.without_sky > 0 { format!(" ({} photographs without)", made.without_sky) } else { String::new() };
        masks += &format!(", {:.0} % sky{without}", 100.0 * share);
    }
    println!(
        "{}: {} photographs of {} sessions, {} held out, {} undistorted, {} points{masks}",
        made.folder.display(),
        made.photographs,
        made.sessions,
        made.held_out,
        made.undistorted,
        made.points
    );
    if !made.lost.is_empty() {
        println!("without a pose: {}", made.lost.join(", "));
    }
    let name = made.folder.file_name().unwrap_or_default().to_string_lossy();
    println!("next: diorama relight train {} -o runs/{name}", made.folder.display());
}
