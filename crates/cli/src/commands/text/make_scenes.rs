//! `diorama text make-scenes`

use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::render::parse_size;
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::text::make_scenes::{self, FontSource, SceneOptions};
use std::path::PathBuf;
use std::time::Instant;

/// Generate scenes with writing: photographs of a walk past signs, with exact labels, poses and visibility
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text make-scenes --size ci -o data/signs\n  diorama text make-scenes --family street,pillar --scenes 4 --views 60 --pixels 320x240 --signs 3-6 -o data/signs"
)]
pub struct MakeScenes {
    /// ci (a room in 14 views of 96×72 with 2 signs of a word each, filmed close by) or gpu (60 scenes of 60 views of 960×540 with 3 to 8 signs)
    #[arg(long, default_value = "ci")]
    size: String,
    /// Families, taken in turns: room, corridor, street, shelf, pillar [default: by size]
    #[arg(long, value_delimiter = ',')]
    family: Vec<String>,
    /// Scenes [default: by size]
    #[arg(long)]
    scenes: Option<usize>,
    /// Photographs of each scene, of which 15 % are held out [default: by size]
    #[arg(long)]
    views: Option<usize>,
    /// Photographs of each scene that labels.jsonl labels [default: 2]
    #[arg(long)]
    labelled: Option<usize>,
    /// Signs of each scene: a number, or FROM-TO [default: by size]
    #[arg(long)]
    signs: Option<String>,
    /// Most words on a sign: 1 or 2 [default: by size]
    #[arg(long)]
    words: Option<usize>,
    /// Film from nearer by this share of the distance, with signs next to each other: 0 to 0.8 [default: by size]
    #[arg(long)]
    closer: Option<f64>,
    /// Width and height of the photographs, for example 320x240 [default: by size]
    #[arg(long)]
    pixels: Option<String>,
    /// Samples per pixel [default: by size]
    #[arg(long)]
    spp: Option<u32>,
    /// Fonts: shipped (the same scenes on every machine), installed (these and what this machine has), or files
    #[arg(long, value_delimiter = ',', default_value = "installed")]
    fonts: Vec<String>,
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder for the scenes, each in a folder of its own
    #[arg(short, long, default_value = "data/signs")]
    out: PathBuf,
    /// Replace earlier scenes
    #[arg(long)]
    force: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl MakeScenes {
    fn options(&self) -> Result<SceneOptions> {
        let mut o = SceneOptions::named(&self.size)?;
        if !self.family.is_empty() {
            o.families.clone_from(&self.family);
        }
        self.scenes.iter().for_each(|v| o.scenes = *v);
        self.views.iter().for_each(|v| o.views = *v);
        self.labelled.iter().for_each(|v| o.labelled = *v);
        self.words.iter().for_each(|v| o.words = *v);
        self.closer.iter().for_each(|v| o.closer = *v);
        self.spp.iter().for_each(|v| o.samples = *v);
        if let Some(signs) = &self.signs {
            let number = |s: &str| s.parse::<usize>().ok();
            let range = match signs.split_once('-') {
                Some((from, to)) => number(from).zip(number(to)),
                None => number(signs).map(|n| (n, n)),
            };
            let (from, to) = range.ok_or_else(|| usage(format!("signs {signs:?}: expected a number or FROM-TO, such as 3-8")))?;
            o.boards = [from, to];
        }
        if let Some(pixels) = &self.pixels {
            o.size = parse_size(pixels).map_err(|_| usage(format!("pixels {pixels:?}: expected WIDTHxHEIGHT, each 16 to 8192")))?;
        }
        o.fonts = match &self.fonts[..] {
            [one] if one == "shipped" => FontSource::Shipped,
            [one] if one == "installed" => FontSource::Installed,
            files => FontSource::Files(files.iter().map(PathBuf::from).collect()),
        };
        o.seed = self.seed;
        Ok(o)
    }
}

impl Verb for MakeScenes {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let options = self.options()?;
        watch_interrupts();
        let (start, mut shown) = (Instant::now(), ShareShown::new());
        let made = make_scenes::generate(&self.out, &options, self.force, &INTERRUPT, &mut |s| shown.show(s, "photographs"))?;
        shown.finish();
        if self.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
        } else {
            let seconds = start.elapsed().as_secs_f64();
            println!("{} scenes, {} photographs, {} text regions in {seconds:.1} s", made.scenes.len(), made.photographs, made.regions);
            println!("{}", self.out.display());
        }
        if made.interrupted {
            note("interrupted: the same command goes on");
            return Ok(Outcome::Interrupted);
        }
        Ok(Outcome::Done)
    }
}
