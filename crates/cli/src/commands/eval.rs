//! `diorama eval`

use super::process::{note, usage, use_threads};
use super::{Outcome, Verb};
use crate::terminal::ShareShown;
use clap::Args;
use diorama_data::{DataError, photo};
use diorama_engine::metrics::lpips::Lpips;
use diorama_geom::ImageU8;
use diorama_geom::capture::Split;
use diorama_pipelines::object::depth_error::DepthError;
use diorama_pipelines::object::evaluate::{self, EvaluationProgress, Report};
use diorama_pipelines::object::model::ObjectModel;
use diorama_pipelines::object::scored_view::ScoredView;
use diorama_pipelines::object::seen_by::{SeenBy, Sights};
use diorama_pipelines::object::{device, run_folder};
use diorama_pipelines::run::kept_capture;
use diorama_pipelines::run::perceptual;
use diorama_pipelines::{Application, Result};
use std::cell::RefCell;
use std::path::{Path, PathBuf};

/// Score held-out views
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  diorama eval runs/chair --save-images --json")]
pub struct Eval {
    /// Folder of the run
    run: PathBuf,
    /// Where the photographs are now, if they moved
    #[arg(long, value_name = "FOLDER")]
    data: Option<PathBuf>,
    /// auto, cpu, cuda, vulkan, metal or webgpu
    #[arg(long, default_value = "auto")]
    device: String,
    /// train, val or test
    #[arg(long, default_value = "test")]
    on: String,
    /// full, or fast as used for previews
    #[arg(long, default_value = "full")]
    quality: String,
    /// Also compute LPIPS with these weights: AlexNet or VGG16 and the linear heads, as safetensors or PyTorch's .pth, in one file or two
    #[arg(long, value_name = "FILE[,FILE]", value_delimiter = ',')]
    lpips: Vec<PathBuf>,
    /// Write each render beside its photograph into RUN/eval
    #[arg(long)]
    save_images: bool,
    /// Also report how many training views see what each view shows, and the PSNR where two or more do; maps in RUN/eval: purple none, red
    /// 1, orange 2, yellow 3, green 4 or more, gray no surface
    #[arg(long)]
    explain: bool,
    /// Number of CPU threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

impl Verb for Eval {
    fn json(&self) -> bool {
        self.json
    }

    fn run(&self) -> Result<Outcome> {
        use_threads(self.threads)?;
        match Application::of_run(&self.run)? {
            Application::Object => self.object(),
            of @ Application::Relight => Err(of.refuse(&self.run, "diorama relight eval")),
            of @ Application::RelightObject => Err(of.refuse(&self.run, "diorama relight eval")),
            of @ Application::Text => Err(of.refuse(&self.run, "diorama text eval")),
            of @ Application::Detector => Err(of.refuse(&self.run, "diorama text eval-detector --weights")),
        }
    }
}

/// Result of evaluating a run of the object application.
struct Judgement {
    model: ObjectModel,
    report: Report,
    lpips: Option<Lpips>,
    /// How many training views see what each view shows; empty unless requested.
    seen_by: Vec<SeenBy>,
    /// Number of training views that were tested for this.
    asked: usize,
    /// Folder of the pictures and maps.
    folder: PathBuf,
}

impl Eval {
    /// Evaluates a run of the object application.
    fn object(&self) -> Result<Outcome> {
        let split = match &self.on[..] {
            "train" => Split::Train,
            "val" => Split::Val,
            "test" => Split::Test,
            other => return Err(usage(format!("on {other}: expected train, val or test"))),
        };
        let quality = self.quality.parse().map_err(usage)?;
        let lpips = if self.lpips.is_empty() { None } else { Some(perceptual::load_lpips(&self.lpips)?) };
        let model = self.open()?;
        let folder = self.run.join("eval");
        if self.save_images || self.explain {
            std::fs::create_dir_all(&folder).map_err(DataError::io(&folder, "create"))?;
        }
        // Printed before the training views are rendered.
        evaluate::judged(&model, split)?;
        let sights = self.explain.then(|| sights(&model));
        let shown = RefCell::new(ShareShown::new());
        let mut seen_by = Vec::new();
        let mut each = |name: &str, v: &ScoredView| -> Result<()> {
            shown.borrow().line(&format!("{name}: psnr {:.2} ssim {:.3}", v.scores.psnr, v.scores.ssim));
            if self.save_images {
                photo::save_png(&file(&folder, name, ""), &beside(v))?;
            }
            if let (Some(sights), Some(frame)) = (&sights, model.capture.frames.iter().position(|f| f.name == name)) {
                let (seen, map) = sights.explain(&model, frame, v);
                photo::save_png(&file(&folder, name, ".seen"), &map)?;
                seen_by.push(seen);
            }
            Ok(())
        };
        let mut progress = |p: EvaluationProgress<'_>| {
            let (done, all) = p.views;
            shown.borrow_mut().show(p.share, &format!("view {} of {all} ({}): {}", done + 1, p.view, p.doing.name()));
        };
        let report = evaluate::evaluate_with_training(&model, split, quality, lpips.as_ref(), &mut each, &mut progress);
        shown.borrow().finish();
        let (report, asked) = (report?, sights.as_ref().map_or(0, Sights::len));
        drop(sights);
        let judgement = Judgement { report, lpips, seen_by, asked, folder, model };
        if self.json {
            println!("{}", judgement.json(self.explain));
        } else {
            judgement.print();
        }
        Ok(Outcome::Done)
    }

    /// Loads the model with the capture's points, on the device.
    fn open(&self) -> Result<ObjectModel> {
        let (mut model, notes) = run_folder::load_model_of(&self.run, self.data.as_deref())?;
        let no_points = run_folder::add_points(&mut model, &self.run, self.data.as_deref())?;
        notes.iter().chain(&no_points).for_each(|n| note(n));
        kept_capture::require_photographs(&model.capture)?;
        device::accelerate(&mut model, &self.device, Box::new(note))?;
        Ok(model)
    }
}

/// Traces where the rays of the training views end.
fn sights(model: &ObjectModel) -> Sights {
    let mut shown = ShareShown::new();
    let mut progress = |done: usize, all: usize| {
        shown.show(done as f64 / all as f64, &format!("training view {} of {all}: tracing where its rays end", done + 1));
    };
    let sights = Sights::of(model, &mut progress);
    shown.finish();
    sights
}

/// File of a view's picture.
fn file(folder: &Path, name: &str, what: &str) -> PathBuf {
    folder.join(format!("{}{what}.png", name.replace(['/', '\\'], "_")))
}

/// A render with its photograph to the right of it.
fn beside(v: &ScoredView) -> ImageU8 {
    let (r, p) = (v.view.rgb.to_u8(), v.photo.to_u8());
    let rows = r.data.chunks_exact(r.width * 3).zip(p.data.chunks_exact(p.width * 3));
    let data = rows.flat_map(|(a, b)| [a, b].concat()).collect();
    ImageU8 { width: r.width + p.width, height: r.height, channels: 3, data }
}

impl Judgement {
    fn json(&self, explain: bool) -> serde_json::Value {
        let report = &self.report;
        let mut object = serde_json::to_value(report).expect("a report is JSON");
        object["gap"] = serde_json::json!(report.gap());
        object["advice"] = serde_json::json!(report.advice());
        object["depth_advice"] = serde_json::json!(report.depth.as_ref().and_then(DepthError::advice));
        if explain {
            object["seen_by"] = serde_json::json!(self.seen_by);
            object["seen_by_of"] = serde_json::json!(self.asked);
        }
        object
    }

    fn print(&self) {
        let report = &self.report;
        println!(
            "{} views: psnr {:.2} dB (worst {:.2}, affine {:.2}), ssim {:.4}, mse {:.5}",
            report.views, report.psnr, report.psnr_min, report.psnr_affine, report.ssim, report.mse
        );
        if let (Some(l), Some(network)) = (report.lpips, &self.lpips) {
            println!("lpips {l:.4} ({})", network.network());
        }
        if let Some(t) = &report.training {
            println!("{} training views: psnr {:.2} dB, ssim {:.4}", t.views, t.psnr, t.ssim);
        }
        report.depth.iter().for_each(|d| println!("{d}"));
        report.depth.iter().filter_map(DepthError::advice).for_each(|a| println!("{a}"));
        report.advice().into_iter().for_each(|a| println!("{a}"));
        if let fog @ [_, ..] = &report.behind_fog()[..] {
            println!("behind fog: {}", fog.join(", "));
        }
        if !self.seen_by.is_empty() {
            print_seen_by(&self.seen_by, self.asked, self.model.train.len(), &self.folder);
        }
        if self.model.is_linear() {
            println!("scored in {}: the photographs hold linear light", report.scored_in);
        }
        if let Some(p) = report.psnr_mean_image {
            println!("for comparison, the mean training image scores {p:.2} dB");
        }
    }
}

/// Prints which share of each view's light comes from surfaces that given numbers of training views see, and which views see those that
/// few see.
fn print_seen_by(views: &[SeenBy], asked: usize, all: usize, folder: &Path) {
    let of = if asked < all { format!("of {asked} of the {all} training views, those") } else { "training views".into() };
    println!("{of} that see what a view shows, in percent of its light (maps in {}):", folder.display());
    println!("{:>6}{:>6}{:>6}{:>6}{:>6}  psnr where two or more see it", "none", "1", "2", "3", "more");
    for v in views {
        let shares: String = v.shares.iter().map(|s| format!("{:>6.1}", 100.0 * s)).collect();
        let sources: Vec<String> = v.sources.iter().map(|s| format!("{} {:.1}", s.name, 100.0 * s.share)).collect();
        let of_few =
            if sources.is_empty() { String::new() } else { format!("; parts that one or two see come from {}", sources.join(", ")) };
        let psnr = v.psnr_where_seen.map_or("-".into(), |p| format!("{p:.2}"));
        println!("{shares}  {psnr:>5}  {}{of_few}", v.name);
    }
    let known: Vec<f64> = views.iter().filter_map(|v| v.psnr_where_seen).collect();
    if !known.is_empty() {
        let (mean, worst) = (known.iter().sum::<f64>() / known.len() as f64, known.iter().copied().fold(f64::INFINITY, f64::min));
        let of = if known.len() < views.len() { format!(", in {} of {} views", known.len(), views.len()) } else { String::new() };
        println!("where two or more training views see it: psnr {mean:.2} dB (worst {worst:.2}{of})");
    }
}
