//! `diorama bench thesis`

use crate::commands::process::{INTERRUPT, note, usage, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::Progress;
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::bench::thesis::{self, OurRow, ThesisObject, ThesisOptions, ThesisRow};
use diorama_pipelines::run::perceptual;
use std::path::PathBuf;

/// Make the objects of the thesis with its settings, and print our figures beside its own
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama bench thesis 1 --quick\n  diorama bench thesis 4 --data hotdog=nerf_synthetic/hotdog --lpips alexnet.pth,lpips.pth"
)]
pub struct Thesis {
    /// 1: settings and time; 4: SSIM, PSNR and LPIPS
    table: u32,
    /// A small chair instead of the sizes of the thesis, in about a minute
    #[arg(long)]
    quick: bool,
    /// Capture of an object: head, cape, ficus or hotdog; may be repeated
    #[arg(long, value_name = "OBJECT=FOLDER")]
    data: Vec<String>,
    /// Weights of LPIPS: network and heads, in one file or several
    #[arg(long, value_name = "FILES", value_delimiter = ',')]
    lpips: Vec<PathBuf>,
    /// Folder of generated photographs and of runs, which are gone on with
    #[arg(short, long, default_value = "runs/thesis")]
    out: PathBuf,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON array on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Thesis {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if ![1, 4].contains(&self.table) {
            return Err(usage(format!("table {}: expected 1 or 4", self.table)));
        }
        let pair = |text: &String| {
            let (key, folder) = text.split_once('=').ok_or_else(|| usage(format!("data {text:?}: expected OBJECT=FOLDER")))?;
            Ok((key.to_string(), PathBuf::from(folder)))
        };
        let data = self.data.iter().map(pair).collect::<Result<Vec<_>>>()?;
        let lpips = if self.lpips.is_empty() { None } else { Some(perceptual::load_lpips(&self.lpips)?) };
        let options = ThesisOptions { out: self.out.clone(), quick: self.quick, data, lpips };
        watch_interrupts();
        let (mut progress, mut current) = (Progress::new(), String::new());
        let mut events = |key: &str, e: &diorama_engine::train::Event| {
            if key != current {
                current = key.into();
                note(key);
            }
            progress.event(e);
        };
        let Some(rows) = thesis::measure(&options, &INTERRUPT, &mut events)? else {
            note("interrupted; the same command goes on");
            return Ok(Outcome::Interrupted);
        };
        if self.json {
            println!("{}", serde_json::to_string(&rows).expect("plain values"));
            return Ok(Outcome::Done);
        }
        if self.quick {
            note("--quick: sizes are far below those of the thesis, so figures are not comparable with it");
        }
        if self.table == 1 {
            print_settings(&rows)
        } else {
            print_scores(&rows)
        }
        for ThesisRow { thesis: t, ours } in &rows {
            match ours {
                Some(ours) => println!("{}: {}", t.name, ours.run.join("object.glb").display()),
                None => println!("{}: bring {}: --data {}=FOLDER", t.name, t.source, t.key),
            }
        }
        println!("EgyptianChair was never published: ours is a procedural chair");
        Ok(Outcome::Done)
    }
}

/// Cells of ours, or as many dashes.
fn cells<const N: usize>(ours: &Option<OurRow>, of: impl Fn(&OurRow) -> [String; N]) -> String {
    ours.as_ref().map_or([const { String::new() }; N].map(|_| "–".into()), of).join(" | ")
}

fn print_settings(rows: &[ThesisRow]) {
    println!("Table 1: texture, grid and steps of the thesis (batches of 4, under an hour on an RTX 3060), and ours with our time");
    println!("| Object | Texture | Grid | Steps | Our texture | Grid | Steps per stage | Views | Triangles | Time | Held out |");
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    for ThesisRow { thesis: ThesisObject { name, texture, grid, steps, .. }, ours } in rows {
        let own = cells(ours, |o| {
            [
                o.texture.to_string(),
                o.grid.to_string(),
                o.steps.to_string(),
                o.views.to_string(),
                o.triangles.to_string(),
                format!("{:.0} s", o.seconds),
                format!("{:.2} dB", o.psnr),
            ]
        });
        println!("| {name} | {texture} | {grid} | {steps} | {own} |");
    }
}

fn print_scores(rows: &[ThesisRow]) {
    println!("Table 4: SSIM, PSNR and LPIPS of the thesis, and ours on held-out photographs");
    println!("| Object | SSIM | PSNR | LPIPS | Our SSIM | PSNR | LPIPS | Held out |");
    println!("|---|---|---|---|---|---|---|---|");
    for ThesisRow { thesis: t, ours } in rows {
        let own = cells(ours, |o| {
            let lpips = o.lpips.map_or("needs --lpips".into(), |l| format!("{l:.5}"));
            [format!("{:.6}", o.ssim), format!("{:.3}", o.psnr), lpips, o.held_out.to_string()]
        });
        println!("| {} | {:.6} | {:.3} | {:.5} | {own} |", t.name, t.ssim, t.psnr, t.lpips);
    }
}
