//! The commands: one file each, with the command's options and its implementation.
//!
//! A command of the program is a variant of [`Command`]. Commands of applications other than the main one form a group, as those of
//! `bench` do: a file of its own with an enum of commands.

mod bench;
mod clip;
mod compare;
mod count;
mod doctor;
mod eval;
mod export;
mod info;
mod manual;
mod mask_flags;
mod prepare;
mod process;
mod quickstart;
mod relight;
mod render;
mod stages;
mod text;
mod train;
mod view;
mod work_flags;

use clap::{Parser, Subcommand};
use diorama_pipelines::Result;

/// A command: a struct of options parsed by clap, and what it does.
pub trait Verb {
    /// Whether results and errors are JSON objects on stdout.
    fn json(&self) -> bool {
        false
    }

    /// Runs the command and prints its results.
    ///
    /// # Errors
    /// If the request is wrong or the work failed.
    fn run(&self) -> Result<Outcome>;
}

/// How a command ended, other than by an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    Done,
    Interrupted,
}

/// Train radiance fields from photographs; render novel views, export meshes.
#[derive(Parser)]
#[command(
    name = "diorama",
    version,
    arg_required_else_help = true,
    after_help = "Exit codes: 0 done, 1 the work failed, 2 bad input or usage, 130 interrupted with a checkpoint written."
)]
pub struct Program {
    #[command(subcommand)]
    pub command: Command,
}

/// The commands and groups, in the order of the help.
#[derive(Subcommand)]
pub enum Command {
    Prepare(prepare::Prepare),
    Train(train::Train),
    Eval(eval::Eval),
    Render(render::Render),
    Export(export::Export),
    View(view::View),
    Compare(compare::Compare),
    Quickstart(quickstart::Quickstart),
    Info(info::Info),
    Doctor(doctor::Doctor),
    Completions(manual::Completions),
    Man(manual::Man),
    #[command(subcommand)]
    Relight(relight::Relight),
    #[command(subcommand)]
    Text(text::Text),
    #[command(subcommand)]
    Bench(bench::Bench),
}

impl Command {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Command::Prepare(v) => v,
            Command::Train(v) => v,
            Command::Eval(v) => v,
            Command::Render(v) => v,
            Command::Export(v) => v,
            Command::View(v) => v,
            Command::Compare(v) => v,
            Command::Quickstart(v) => v,
            Command::Info(v) => v,
            Command::Doctor(v) => v,
            Command::Completions(v) => v,
            Command::Man(v) => v,
            Command::Relight(noun) => noun.verb(),
            Command::Text(noun) => noun.verb(),
            Command::Bench(noun) => noun.verb(),
        }
    }
}
