//! `diorama text study`

use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::render::parse_size;
use crate::commands::{Outcome, Verb, stages};
use clap::{Args, Subcommand};
use diorama_pipelines::Result;
use diorama_pipelines::text::detectors::config::Kind;
use diorama_pipelines::text::study::pasting::{self, PastingOptions};
use diorama_pipelines::text::study::sampling::{self, SamplingOptions};
use diorama_pipelines::text::study::{Common, Limit, Studied};
use std::path::PathBuf;

/// Seconds of training of each detector where nothing is said.
const SECONDS: f64 = 120.0;

/// Measure on generated scenes what images are worth to detectors
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text study sampling -o runs/sampling\n  diorama text study pasting --scenes 8 --images 64 --real data/icdar -o runs/pasting\n\nAfter an interruption, the same command goes on."
)]
pub struct Study {
    #[command(subcommand)]
    study: Which,
}

#[derive(Subcommand, Clone, Debug)]
enum Which {
    Sampling(Sampling),
    Pasting(Pasting),
}

/// Compare cameras that cover text poses evenly with random ones
#[derive(Args, Clone, Debug)]
struct Sampling {
    #[command(flatten)]
    shared: Shared,
    /// Scenes for testing, which detectors do not learn from
    #[arg(long, default_value_t = 2)]
    test_scenes: usize,
    /// Images of each of them
    #[arg(long, default_value_t = 16)]
    test_images: usize,
}

/// Compare images of fields with words that are pasted onto photographs
#[derive(Args, Clone, Debug)]
struct Pasting {
    #[command(flatten)]
    shared: Shared,
    /// Family of the photographs for testing: room, corridor, street, shelf or pillar; detectors learn from the others
    #[arg(long, default_value = "street")]
    test_family: String,
    /// Photographs of it
    #[arg(long, default_value_t = 200)]
    test_images: usize,
    /// Folder of labelled photographs to test on too: images/ and icdar15/, or MMOCR's textdet*.json
    #[arg(long)]
    real: Option<PathBuf>,
}

#[derive(Args, Clone, Debug)]
struct Shared {
    /// Folder for all results
    #[arg(short, long)]
    out: PathBuf,
    /// Scenes that detectors learn from
    #[arg(long, default_value_t = 8)]
    scenes: usize,
    /// Images of each of them
    #[arg(long, default_value_t = 16)]
    images: usize,
    /// Words that are written on each sign
    #[arg(long, default_value_t = 8)]
    words: usize,
    /// Width and height of the images
    #[arg(long, default_value = "160x120")]
    size: String,
    /// Clusters of text poses
    #[arg(long, default_value_t = 16)]
    clusters: usize,
    /// Steps of each field
    #[arg(long, default_value_t = 800)]
    field_steps: u64,
    /// Detectors: db, east; more may be asked for later
    #[arg(long, value_delimiter = ',', default_value = "db,east")]
    models: Vec<String>,
    /// Detectors of each kind on each set; more may be asked for later
    #[arg(long, default_value_t = 3)]
    seeds: u64,
    /// Seconds of training of each detector [default: 120, without --steps]
    #[arg(long)]
    seconds: Option<f64>,
    /// Steps of each detector
    #[arg(long)]
    steps: Option<u64>,
    /// Of scenes and images
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Where fields are trained: auto, cpu, or a GPU
    #[arg(long, default_value = "auto")]
    device: String,
    /// Begin again in place of an earlier study
    #[arg(long)]
    force: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Shared {
    fn common(&self) -> Result<Common> {
        Ok(Common {
            scenes: self.scenes,
            images: self.images,
            words: self.words,
            size: parse_size(&self.size).map_err(|_| usage(format!("size {:?}: expected WIDTHxHEIGHT, each 16 to 8192", self.size)))?,
            clusters: self.clusters,
            field_steps: self.field_steps,
            device: self.device.clone(),
            models: self.models.iter().map(|m| Kind::named(m)).collect::<Result<_>>()?,
            seeds: self.seeds,
            limit: Limit {
                steps: self.steps.unwrap_or(0),
                seconds: self.seconds.unwrap_or(if self.steps.is_some() { 0.0 } else { SECONDS }),
            },
            seed: self.seed,
        })
    }
}

impl Study {
    fn shared(&self) -> &Shared {
        match &self.study {
            Which::Sampling(s) => &s.shared,
            Which::Pasting(s) => &s.shared,
        }
    }

    fn studied(&self) -> Result<Option<Studied>> {
        let (shared, common) = (self.shared(), self.shared().common()?);
        let place = (shared.out.as_path(), shared.force);
        match &self.study {
            Which::Sampling(s) => {
                let o = SamplingOptions { common, test_scenes: s.test_scenes, test_images: s.test_images };
                stages::shown(|l| sampling::study(place, &o, &INTERRUPT, l))
            }
            Which::Pasting(s) => {
                let (test_family, real) = (s.test_family.clone(), s.real.clone());
                let o = PastingOptions { common, test_family, test_images: s.test_images, real };
                stages::shown(|l| pasting::study(place, &o, &INTERRUPT, l))
            }
        }
    }
}

impl Verb for Study {
    fn json(&self) -> bool {
        self.shared().json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.shared().threads)?;
        watch_interrupts();
        let Some(studied) = self.studied()? else {
            note("interrupted: the same command goes on");
            return Ok(Outcome::Interrupted);
        };
        if self.shared().json {
            println!("{}", serde_json::to_string(&studied).expect("plain values"));
        } else {
            print!("{}", studied.text);
            println!("\n{}", self.shared().out.join("study.md").display());
        }
        Ok(Outcome::Done)
    }
}
