//! `diorama text synth` and `diorama text merge`

use super::label::formats;
use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::render::parse_size;
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_data::text_set::{self, tar_shards};
use diorama_pipelines::Result;
use diorama_pipelines::text::styling::MaskMode;
use diorama_pipelines::text::styling::style::PLAIN;
use diorama_pipelines::text::synth::dataset::{self, Synthesized};
use diorama_pipelines::text::synth::merging;
use diorama_pipelines::text::synth::plan::{Scenes, Shard, SynthOptions};
use diorama_pipelines::text::synth::sampling::Sampling;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

/// Render a data set of labelled images from trained scenes
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text synth runs/room --count 500 --size 160x120 -o data/set\n  diorama text synth scenes.toml --count 12520 --size 640x360 --shard 3/8 --formats icdar15,mmocr,ppocr -o data/set-3\n  diorama text synth runs/room --style none,winter,evening,rain --tar 1000 -o data/seasons"
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
    /// Number of clusters of text poses; or, with commas, the numbers of those of 16 that are drawn, such as 3,7
    #[arg(long, default_value = "16", value_delimiter = ',')]
    clusters: Vec<usize>,
    /// Numbers of the clusters that are drawn [default: all]
    #[arg(long, value_delimiter = ',')]
    only: Vec<usize>,
    /// Where text is in images and how large, as `diorama text prior` has found [default: mostly around the middle, 0.3 to 15 % of the image]
    #[arg(long)]
    prior: Option<PathBuf>,
    /// Looks, of which each image takes one: autumn, winter, night, rain, evening, an image file (PNG, JPEG) whose colors and detail are taken, none
    #[arg(long, value_delimiter = ',', default_value = "none")]
    style: Vec<String>,
    /// What keeps its own detail under a style: text (writing, and what few photographs show), paper (what few photographs show), off (nothing)
    #[arg(long, default_value = "text")]
    mask: String,
    /// Also write shards/000000.tar and so on, of so many images each, for WebDataset
    #[arg(long, value_name = "IMAGES")]
    tar: Option<NonZeroUsize>,
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

/// Clusters where `--clusters` lists some of them.
const CLUSTERS: usize = 16;

impl Synth {
    /// The number of clusters, and the numbers of those that are drawn; none: all.
    fn clusters(&self) -> Result<(usize, Vec<usize>)> {
        match &self.clusters[..] {
            [number] => Ok((*number, self.only.clone())),
            _ if !self.only.is_empty() => Err(usage("only: leave it out where --clusters lists the clusters that are drawn".into())),
            list => Ok((CLUSTERS, list.to_vec())),
        }
    }

    fn options(&self) -> Result<SynthOptions> {
        let sampling = match &self.sampling[..] {
            "balanced" => Sampling::Balanced,
            "random" => Sampling::Random,
            other => return Err(usage(format!("sampling {other:?}: expected balanced or random"))),
        };
        let mask = MaskMode::named(&self.mask).ok_or_else(|| usage(format!("mask {:?}: expected text, paper or off", self.mask)))?;
        let is_plain = self.style.iter().all(|s| s == PLAIN);
        let (clusters, only) = self.clusters()?;
        Ok(SynthOptions {
            count: self.count,
            size: parse_size(&self.size).map_err(|_| usage(format!("size {:?}: expected WIDTHxHEIGHT, each 16 to 8192", self.size)))?,
            sampling,
            clusters,
            only,
            prior: self.prior.clone(),
            formats: formats(&self.formats)?,
            seed: self.seed,
            styles: if is_plain { Vec::new() } else { self.style.clone() },
            mask,
        })
    }
}

/// Writes the shards that were asked for.
fn shards(out: &Path, per_shard: Option<NonZeroUsize>) -> Result<()> {
    let Some(n) = per_shard else { return Ok(()) };
    tar_shards::write(out, &text_set::read(out)?, n)?;
    Ok(())
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
    if made.styled > 0 {
        println!("{} images in a style, {:.0} % of the time", made.styled, 100.0 * made.styling_share);
    }
    let Synthesized { compared, misfits, largest_misfit_px: largest, .. } = made;
    println!("{misfits} of {compared} labels of new words more than 2 px from their glyphs, the farthest {largest:.2} px");
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
        if !made.interrupted {
            shards(&self.out, self.tar)?;
        }
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
    /// Also write shards/000000.tar and so on, of so many images each, for WebDataset
    #[arg(long, value_name = "IMAGES")]
    tar: Option<NonZeroUsize>,
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
        shards(&self.out, self.tar)?;
        print(&made, &self.out, self.json);
        Ok(Outcome::Done)
    }
}
