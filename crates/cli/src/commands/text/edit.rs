//! `diorama text edit`

use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_geom::color::linear_from_srgb;
use diorama_pipelines::Result;
use diorama_pipelines::text::edit::drawing::Blend;
use diorama_pipelines::text::edit::ground::Eraser;
use diorama_pipelines::text::edit::{self, Change, EditOptions};
use std::path::PathBuf;

/// Erase the writing of a run's text regions, or write something else there
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text edit runs/room --region 0 --text Café\n  diorama text edit runs/room --words 8\n  diorama text edit runs/room --region 1 --erase --eraser telea"
)]
pub struct Edit {
    /// Folder of the run, whose regions `diorama text label` has found
    run: PathBuf,
    /// Id of a region; may be repeated [default: all]
    #[arg(long)]
    region: Vec<u32>,
    /// What to write
    #[arg(long, conflicts_with_all = ["words", "erase"])]
    text: Option<String>,
    /// Write so many words of a list on each region, one edit each
    #[arg(long, conflicts_with = "erase")]
    words: Option<usize>,
    /// Leave nothing written
    #[arg(long)]
    erase: bool,
    /// Font file [default: one that diorama brings along, and those of this machine for characters that it lacks]
    #[arg(long)]
    font: Option<PathBuf>,
    /// patchmatch or telea
    #[arg(long, default_value = "patchmatch")]
    eraser: String,
    /// alpha or poisson
    #[arg(long, default_value = "alpha")]
    blend: String,
    /// Color of the writing, such as #203a80 [default: that of the ink that was there]
    #[arg(long)]
    color: Option<String>,
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Where the photographs are now
    #[arg(long)]
    data: Option<PathBuf>,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

/// Linear light of a color `#rrggbb`.
fn color(text: &str) -> Result<[f32; 3]> {
    let wrong = || usage(format!("color {text:?}: expected six hexadecimal digits, such as #203a80"));
    let digits = text.strip_prefix('#').unwrap_or(text);
    if digits.len() != 6 || !digits.is_ascii() {
        return Err(wrong());
    }
    let value =
        |k: usize| u8::from_str_radix(&digits[2 * k..2 * k + 2], 16).map(|v| linear_from_srgb(v as f32 / 255.0)).map_err(|_| wrong());
    Ok([value(0)?, value(1)?, value(2)?])
}

impl Edit {
    fn options(&self) -> Result<EditOptions> {
        let change = match (&self.text, self.words, self.erase) {
            (Some(text), ..) if text.trim().is_empty() => return Err(usage("text: give something to write, or --erase".into())),
            (Some(text), ..) => Change::Text(text.clone()),
            (None, Some(0), _) => return Err(usage("words: give a number from 1 on".into())),
            (None, Some(n), _) => Change::Words(n),
            (None, None, true) => Change::Erase,
            (None, None, false) => return Err(usage("give --text, --words or --erase".into())),
        };
        let blend = match &self.blend[..] {
            "alpha" => Blend::Alpha,
            "poisson" => Blend::Poisson,
            other => return Err(usage(format!("blend {other:?}: expected alpha or poisson"))),
        };
        Ok(EditOptions {
            regions: self.region.clone(),
            change,
            font: self.font.clone(),
            eraser: Eraser::named(&self.eraser)?,
            blend,
            color: self.color.as_deref().map(color).transpose()?,
            seed: self.seed,
        })
    }
}

impl Verb for Edit {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        let options = self.options()?;
        watch_interrupts();
        let mut shown = ShareShown::new();
        let done = edit::edit(&self.run, self.data.as_deref(), &options, &INTERRUPT, &mut |s, what| shown.show(s, what))?;
        shown.finish();
        done.notes.iter().for_each(|n| note(n));
        if self.json {
            println!("{}", serde_json::to_string(&done).expect("plain values"));
        } else {
            let folder = self.run.join("edits");
            done.edits.iter().for_each(|name| println!("{}", folder.join(name).display()));
        }
        Ok(if done.interrupted { Outcome::Interrupted } else { Outcome::Done })
    }
}
