//! Flags, one place per flag; meaning lies in `commands`.

use crate::commands::{self, Outcome};
use crate::terminal;
use clap::{Args, Parser, Subcommand};
use std::path::PathBuf;
use std::process::ExitCode;

/// Photographs to radiance fields, novel views and meshes.
#[derive(Parser)]
#[command(name = "diorama", version, arg_required_else_help = true, after_help = "Exit codes: 0 done, 1 the work failed, 2 bad input or usage, 130 interrupted with a checkpoint written.")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Fit a field to photographs with poses
    #[command(after_help = "Examples:\n  diorama train capture/ -o runs/chair --seconds 120\n  diorama train lego/ -o runs/lego --method mlp --downscale 8 --background white\n  diorama train capture/ -o runs/chair --resume")]
    Train(TrainArgs),
    /// Score held-out views
    #[command(after_help = "Example:\n  diorama eval runs/chair --save-images --json")]
    Eval(EvalArgs),
}

/// Flags of `train`.
#[derive(Args, Clone, Debug)]
pub struct TrainArgs {
    /// Folder with photographs and transforms.json, transforms_train.json, a COLMAP model or poses_bounds.npy
    pub data: Option<PathBuf>,
    /// Folder of the run
    #[arg(short, long)]
    pub out: PathBuf,
    /// ngp, nerf, mlp or baseline [default: ngp]
    #[arg(long)]
    pub method: Option<String>,
    /// transforms, blender, colmap or llff, where a folder holds several
    #[arg(long)]
    pub format: Option<String>,
    /// Reduce the photographs N times
    #[arg(long)]
    pub downscale: Option<u32>,
    /// Stop after N steps
    #[arg(long)]
    pub steps: Option<u64>,
    /// Stop after S seconds of training
    #[arg(long)]
    pub seconds: Option<f64>,
    /// every:N, A:B:C (percent), file or all
    #[arg(long)]
    pub split: Option<String>,
    /// auto, white, black, random or learned
    #[arg(long)]
    pub background: Option<String>,
    /// auto or cpu
    #[arg(long)]
    pub device: Option<String>,
    #[arg(long)]
    pub threads: Option<usize>,
    #[arg(long)]
    pub seed: Option<u64>,
    /// `report`: the shortest side becomes 100 pixels
    #[arg(long)]
    pub preset: Option<String>,
    /// Override a configuration value, for example loss.distortion=0.01; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Start from a config.toml
    #[arg(long)]
    pub config: Option<PathBuf>,
    /// Go on from the last checkpoint
    #[arg(long)]
    pub resume: bool,
    /// Replace what the run folder holds
    #[arg(long)]
    pub force: bool,
    /// Print one JSON object on stdout
    #[arg(long)]
    pub json: bool,
}

/// Flags of `eval`.
#[derive(Args, Clone, Debug)]
pub struct EvalArgs {
    /// Folder of the run
    pub run: PathBuf,
    /// train, val or test
    #[arg(long, default_value = "test")]
    pub on: String,
    /// Write each render beside its photograph into RUN/eval
    #[arg(long)]
    pub save_images: bool,
    #[arg(long)]
    pub threads: Option<usize>,
    #[arg(long)]
    pub json: bool,
}

/// Parses, runs, reports.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(c) => c,
        Err(e) => {
            let _ = e.print();
            return ExitCode::from(if e.use_stderr() { terminal::USAGE } else { 0 });
        }
    };
    let json = match &cli.command {
        Command::Train(a) => a.json,
        Command::Eval(a) => a.json,
    };
    let result = match cli.command {
        Command::Train(a) => commands::train::run(&a),
        Command::Eval(a) => commands::eval::run(&a),
    };
    ExitCode::from(match result {
        Ok(Outcome::Done) => 0,
        Ok(Outcome::Interrupted) => terminal::INTERRUPTED,
        Err(e) => terminal::report(&e, json),
    })
}
