//! `diorama text report`

use super::prior;
use crate::commands::process::{INTERRUPT, usage, use_threads, watch_interrupts};
use crate::commands::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::text::report::{self, RealLabels, ReportOptions};
use serde_json::json;
use std::path::PathBuf;

/// Write a page about data sets: where words are, how large and in what poses, what detectors miss, how good fields are
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  diorama text report --data data/set -o report.html\n  diorama text report --data ds/test --weights runs/db runs/east --run runs/room\n  diorama text report --data data/set --real icdar/images --labels icdar/gt --format icdar15"
)]
pub struct Report {
    /// Folders of data sets that `diorama text synth` or `diorama text label` wrote
    #[arg(long, num_args = 1.., required_unless_present = "run")]
    data: Vec<PathBuf>,
    /// Runs or files of detectors, each judged on each data set; these need icdar15/gt_NAME.txt for each image
    #[arg(long, num_args = 1.., requires = "data")]
    weights: Vec<PathBuf>,
    /// Runs of fields, judged on their held-out views
    #[arg(long, num_args = 1..)]
    run: Vec<PathBuf>,
    /// Also LPIPS of the held-out views with these weights: AlexNet or VGG16 and the linear heads, as safetensors or PyTorch's .pth, in one
    /// file or two
    #[arg(long, value_name = "FILE[,FILE]", value_delimiter = ',', requires = "run")]
    lpips: Vec<PathBuf>,
    /// Folder of photographs with labels to compare with
    #[arg(long, requires_all = ["labels", "format"])]
    real: Option<PathBuf>,
    /// Folder or file of their labels
    #[arg(long, requires = "real")]
    labels: Option<PathBuf>,
    /// labelme, ppocr, icdar13, icdar15 or mlt17
    #[arg(long, requires = "real")]
    format: Option<String>,
    /// The page
    #[arg(short, long, default_value = "report.html")]
    out: PathBuf,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Report {
    fn options(&self) -> Result<ReportOptions> {
        let real = match (&self.real, &self.labels, &self.format) {
            (Some(folder), Some(labels), Some(format)) => {
                let (images, sizes) = prior::labelled(folder, labels, format)?;
                Some(RealLabels { name: labels.display().to_string(), images, sizes })
            }
            _ => None,
        };
        let (sets, detectors) = (self.data.clone(), self.weights.clone());
        Ok(ReportOptions { sets, detectors, runs: self.run.clone(), lpips: self.lpips.clone(), real })
    }
}

impl Verb for Report {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        if self.out.is_dir() {
            return Err(usage(format!("out {:?}: is a folder; give a file such as report.html", self.out.display().to_string())));
        }
        let options = self.options()?;
        watch_interrupts();
        let mut shown = ShareShown::new();
        let contents = report::report(&self.out, &options, &INTERRUPT, &mut |s, what| shown.show(s, what))?;
        shown.finish();
        let Some(contents) = contents else { return Ok(Outcome::Interrupted) };
        if self.json {
            let mut summary = contents.summary();
            summary["report"] = json!(self.out);
            println!("{summary}");
            return Ok(Outcome::Done);
        }
        for set in &contents.sets {
            let g = &set.figures;
            println!("{}: {} images, {} words, {} not to be read", g.name, g.images, g.words, g.unreadable);
        }
        for f in &contents.detectors {
            let s = &f.judged.evaluation.instance;
            println!("{} on {}: precision {:.4}  recall {:.4}  F {:.4}", f.detector, f.set, s.precision, s.recall, s.f);
            f.command.iter().for_each(|c| println!("its weakest clusters: {c}"));
        }
        for f in &contents.fields {
            println!("{}: PSNR {:.2} dB  SSIM {:.3} of {} held-out views", f.run, f.scores.psnr, f.scores.ssim, f.scores.views);
        }
        println!("{}", self.out.display());
        Ok(Outcome::Done)
    }
}
