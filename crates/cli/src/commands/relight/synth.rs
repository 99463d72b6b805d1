//! `diorama relight synth`

use super::light_flags::LightFlags;
use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::render::parse_size;
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_pipelines::relight::light::LightOptions;
use diorama_pipelines::relight::object::synth::{self as object_synth, ObjectSynth};
use diorama_pipelines::relight::synth::{self, Place, SynthOptions};
use diorama_pipelines::{PipelineError, Result};
use std::path::PathBuf;
use std::time::Instant;

/// Light of an object's held-out views.
const UNSEEN: &str = "sky:15,300";

/// Generate a street photographed in several lights, or an object from all sides, with what is exact of them
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama relight synth --size ci -o data/street\n  diorama relight synth --object chair --views 60 --size 256x256 --light a.hdr --unseen-light b.hdr -o data/chair"
)]
pub struct Synth {
    /// ci (10 views of 64×48), middle (60 of 320×180) or gpu (88 of 640×360); of objects WIDTHxHEIGHT
    #[arg(long, default_value = "ci")]
    size: String,
    /// An object in place of the street: chair, still-life, or the file of a model
    #[arg(long)]
    object: Option<String>,
    #[command(flatten)]
    light: LightFlags,
    /// Light of an object's held-out views besides their own, as --light
    #[arg(long, default_value = UNSEEN)]
    unseen_light: String,
    /// Photographs of an object show the light behind it and are opaque, as photographs without masks are
    #[arg(long, requires = "object")]
    show_light: bool,
    /// Views [default: by size; of objects 60]
    #[arg(long)]
    views: Option<usize>,
    /// Width and height of the photographs, for example 160x90 [default: by size]
    #[arg(long)]
    pixels: Option<String>,
    /// Lights of training, 1 to 4; one more is held out
    #[arg(long, default_value_t = 4)]
    lights: usize,
    /// Samples per pixel [default: by size; of objects 64]
    #[arg(long)]
    spp: Option<u32>,
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder for the capture
    #[arg(short, long, default_value = "data/street")]
    out: PathBuf,
    /// Replace an earlier capture
    #[arg(long)]
    force: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Synth {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if let Some(object) = &self.object {
            return self.object(object);
        }
        if self.light.is_given() || self.unseen_light != UNSEEN {
            return Err(usage("light: the street has lights of its own, as many as --lights says; only --object takes others".into()));
        }
        let mut options = SynthOptions::named(&self.size)?;
        (options.lights, options.seed) = (self.lights, self.seed);
        self.views.iter().for_each(|v| options.views = *v);
        if let Some(pixels) = &self.pixels {
            let numbers = pixels.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
            options.size = numbers
                .filter(|(w, h)| (8..=8192).contains(w) && (8..=8192).contains(h))
                .ok_or_else(|| PipelineError::Usage(format!("--pixels {pixels:?}: expected WIDTHxHEIGHT, each from 8 to 8192")))?;
        }
        self.spp.iter().for_each(|s| options.samples = *s);
        if options.samples == 0 {
            return Err(PipelineError::Usage("--spp: must be at least 1".into()));
        }
        watch_interrupts();
        let (start, mut shown) = (Instant::now(), ShareShown::new());
        let made =
            synth::generate(&self.out, &Place::street(&options), &options, self.force, &INTERRUPT, &mut |s| shown.show(s, "photographs"))?;
        shown.finish();
        if self.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
        } else {
            let seconds = start.elapsed().as_secs_f64();
            println!("{} photographs, {} held out, of {} triangles in {seconds:.1} s", made.photographs, made.held_out, made.triangles);
            println!("{}", self.out.display());
        }
        Ok(if made.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }
}

impl Synth {
    /// Photographs of an object.
    fn object(&self, object: &str) -> Result<Outcome> {
        let size = if self.size == "ci" { (64, 64) } else { parse_size(&self.size)? };
        let unseen = self.unseen_light.parse().map_err(|e: String| usage(format!("unseen-light {e}")))?;
        let options = ObjectSynth {
            object: object.into(),
            views: self.views.unwrap_or(60),
            size,
            samples: self.spp.unwrap_or(64),
            light: self.light.options()?,
            unseen: LightOptions::of(unseen),
            shows_light: self.show_light,
            seed: self.seed,
        };
        watch_interrupts();
        let (start, mut shown) = (Instant::now(), ShareShown::new());
        let made = object_synth::generate(&self.out, &options, self.force, &INTERRUPT, &mut |s| shown.show(s, "photographs"))?;
        shown.finish();
        made.notes.iter().for_each(|n| note(n));
        if self.json {
            println!("{}", serde_json::to_string(&made).expect("plain values"));
        } else {
            let seconds = start.elapsed().as_secs_f64();
            println!("{} photographs, {} held out, of {} triangles in {seconds:.1} s", made.photographs, made.held_out, made.triangles);
            println!("{}", self.out.display());
        }
        Ok(if made.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }
}
