//! `diorama text synth` and `diorama text merge`

use super::label::formats;
use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::render::parse_size;
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::text::synth::dataset::{self, Synthesized};
use diorama_pipelines::text::synth::merging;
use diorama_pipelines::text::synth::plan::{Scenes, Shard, SynthOptions};
use diorama_pipelines::text::synth::sampling::Sampling;
use std::path::{Path, PathBuf};

/// Render a data set of labelled images from trained scenes
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text synth runs/room --count 500 --size 160x120 -o data/set\n  diorama text synth scenes.toml --count 12520 --size 640x360 --shard 3/8 --formats icdar15,mmocr,ppocr -o data/set-3"
)]
pub struct Synth {
    /// A run, or a scenes.toml with a table named scene for each run, whose key run is its folder
    scenes: PathBuf,
    /// Images of the whole data set
    #[arg(long, default_value_t = 1000)]
    count: usize,
    /// Width and height of the images
    #[arg(long, default_value = "640x360")]
    size: String,
    /// balanced (all clusters of text poses in equal numbers) or random (like the photographs)
    #[arg(long, default_value = "balanced")]
    sampling: String,
    /// Clusters of text poses
    #[arg(long, default_value_t = 16)]
    clusters: usize,
    /// Numbers of the clusters that are drawn [default: all]
    #[arg(long, value_delimiter = ',')]
    only: Vec<usize>,
    /// Where text is in images and how large, as `diorama text prior` has found [default: mostly around the middle, 0.3 to 15 % of the image]
    #[arg(long)]
    prior: Option<PathBuf>,
    /// Part of the data set, such as 3/8
    #[arg(long, default_value = "1/1")]
    shard: String,
    /// icdar13, icdar15, mlt17, ppocr, mmocr, doctr, coco, cocotext, textocr, textnerf
    #[arg(long, value_delimiter = ',', default_value = "icdar15")]
    formats: Vec<String>,
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder for the data set; the same command goes on with what is missing
    #[arg(short, long, default_value = "data/set")]
    out: PathBuf,
    /// Replace an earlier data set
    #[arg(long)]
    force: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Synth {
    fn options(&self) -> Result<SynthOptions> {
        let sampling = match &self.sampling[..] {
            "balanced" => Sampling::Balanced,
            "random" => Sampling::Random,
            other => return Err(usage(format!("sampling {other:?}: expected balanced or random"))),
        };
        Ok(SynthOptions {
            count: self.count,
            size: parse_size(&self.size).map_err(|_| usage(format!("size {:?}: expected WIDTHxHEIGHT, each 16 to 8192", self.size)))?,
            sampling,
            clusters: self.clusters,
            only: self.only.clone(),
            prior: self.prior.clone(),
            formats: formats(&self.formats)?,
            seed: self.seed,
        })
    }
}

/// Prints what was made.
fn print(made: &Synthesized, out: &Path, json: bool) {
    made.notes.iter().for_each(|n| note(n));
    if json {
        println!("{}", serde_json::to_string(made).expect("plain values"));
        return;
    }
    println!("{} images, {} words, {} not to be read", made.images, made.words, made.unreadable);
    if made.images_per_s > 0.0 {
        println!("{:.1} images/s", made.images_per_s);
    }
    println!("{} labels more than 2 px from their glyphs, the farthest {:.2} px", made.misfits, made.largest_misfit_px);
    println!("{}", out.display());
}

impl Verb for Synth {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let (options, shard, scenes) = (self.options()?, Shard::parse(&self.shard)?, Scenes::read(&self.scenes)?);
        watch_interrupts();
        let mut shown = ShareShown::new();
        let made = dataset::synthesize(&self.out, (&scenes, &options, shard), self.force, &INTERRUPT, &mut |s, what| shown.show(s, what))?;
        shown.finish();
        print(&made, &self.out, self.json);
        if made.interrupted {
            note("interrupted: the same command goes on");
            return Ok(Outcome::Interrupted);
        }
        Ok(Outcome::Done)
    }
}

/// Join the shards of a data set
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama text merge data/set-1 data/set-2 data/set-3 -o data/set")]
pub struct Merge {
    /// Folders of all shards
    #[arg(required = true)]
    shards: Vec<PathBuf>,
    /// Folder for the data set
    #[arg(short, long, default_value = "data/set")]
    out: PathBuf,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Merge {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        let made = merging::merge(&self.out, &self.shards)?;
        print(&made, &self.out, self.json);
        Ok(Outcome::Done)
    }
}
