//! `diorama text prepare`

use crate::commands::prepare::carry_out;
use crate::commands::process::{usage, use_threads};
use crate::commands::work_flags::WorkFlags;
use crate::commands::{Outcome, Verb};
use clap::Args;
use diorama_data::import;
use diorama_data::masks::MaskOptions;
use diorama_data::split::SplitRule;
use diorama_data::video::Choice;
use diorama_pipelines::Result;
use diorama_pipelines::run::prepare::{Finish, Matcher, PrepareOptions, Sfm, Wanted};
use std::path::PathBuf;

/// One photograph in so many is held out.
const HELD_OUT: usize = 7;
/// Most features per photograph.
const FEATURES: usize = 8192;

/// Turn a film or photographs of a scene with writing into a data set: sharp frames with poses
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text prepare walk.mp4 -o data/shop\n  diorama text prepare photos/ -o data/shop --frames 80 --max-side 1600\n  diorama text prepare walk.mp4 -o data/shop --resume --min-registered 70\n\nCOLMAP (and ffmpeg for films) must be installed; set DIORAMA_COLMAP or DIORAMA_FFMPEG to use programs outside PATH."
)]
pub struct Prepare {
    /// A film, or a folder of photographs in the order in which they were taken
    input: PathBuf,
    /// Folder of the data set
    #[arg(short, long)]
    out: PathBuf,
    /// Largest number of frames: the sharpest of each of so many equal parts is taken, without those that are blurred
    #[arg(long, default_value_t = 65)]
    frames: usize,
    /// Source of the poses: auto (those of the folder where it has some, else COLMAP's), colmap, or none for a capture that has them
    #[arg(long, default_value = "auto")]
    sfm: String,
    /// Reduce photographs whose longest side is larger
    #[arg(long, value_name = "PIXELS")]
    max_side: Option<u32>,
    /// COLMAP's camera model: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or OPENCV_FISHEYE
    #[arg(long, default_value = "OPENCV")]
    lens: String,
    /// Pairs that COLMAP compares: auto, exhaustive or sequential
    #[arg(long, default_value = "auto")]
    matcher: String,
    /// Fail if fewer than this percentage of the photographs find a pose
    #[arg(long, default_value_t = 80.0)]
    min_registered: f64,
    /// Leave out photographs that cannot be decoded, and list them
    #[arg(long)]
    skip_broken: bool,
    #[command(flatten)]
    work: WorkFlags,
}

impl Prepare {
    fn options(&self) -> Result<PrepareOptions> {
        if self.frames < Wanted::SHARP.least {
            return Err(usage(format!("frames {}: must be at least {}", self.frames, Wanted::SHARP.least)));
        }
        if self.max_side.is_some_and(|s| s < 64) {
            return Err(usage("max-side: must be at least 64".into()));
        }
        if !(0.0..=100.0).contains(&self.min_registered) {
            return Err(usage("min-registered: must be 0 to 100".into()));
        }
        let has_poses = || self.input.is_dir() && import::detect(&self.input).is_ok();
        let sfm = match &self.sfm[..] {
            "auto" if has_poses() => Sfm::None,
            "auto" | "colmap" => Sfm::Colmap,
            "none" => Sfm::None,
            other => return Err(usage(format!("sfm {other:?}: expected auto, colmap or none"))),
        };
        Ok(PrepareOptions {
            input: self.input.clone(),
            out: self.out.clone(),
            sfm,
            format: None,
            masks: MaskOptions::default(),
            choice: Choice::Sharp(self.frames),
            wanted: Wanted::SHARP,
            every: 1,
            max_side: self.max_side.unwrap_or(u32::MAX),
            matcher: self.matcher.parse::<Matcher>().map_err(usage)?,
            features: FEATURES,
            lens: self.lens.to_uppercase(),
            finish: Finish::default(),
            split: if sfm == Sfm::None { SplitRule::File } else { SplitRule::Every(HELD_OUT) },
            seed: 0,
            min_registered: self.min_registered,
            threads: self.work.threads,
            resume: self.work.resume,
            force: self.work.force,
            skip_broken: self.skip_broken,
        })
    }
}

impl Verb for Prepare {
    fn json(&self) -> bool {
        self.work.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.work.threads)?;
        let out = self.out.display();
        let next = format!("label one to three photographs of {out}/images, then diorama text annotate {out} LABELS --format labelme");
        carry_out(&self.options()?, &next, self.work.json)
    }
}
