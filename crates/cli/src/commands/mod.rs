//! The verbs: one file each, which holds the verb's flags and what it does with them.
//!
//! A verb of the program is a variant of [`Command`]. Verbs of an application other than the main one stand behind a noun, as those of
//! `bench` do: a file of its own with an enum of verbs.

mod bench;
mod clip;
mod compare;
mod doctor;
mod eval;
mod export;
mod info;
mod manual;
mod mask_flags;
mod prepare;
mod process;
mod quickstart;
mod render;
mod train;
mod view;

use clap::{Parser, Subcommand};
use diorama_pipelines::Result;

/// A verb: a struct of flags, which clap parses, and what is done with them.
pub trait Verb {
    /// Whether results and errors are JSON objects on stdout.
    fn json(&self) -> bool {
        false
    }

    /// Does the work and prints its results.
    ///
    /// # Errors
    /// When the request is wrong or the work failed.
    fn run(&self) -> Result<Outcome>;
}

/// How a verb ended, errors apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    Done,
    Interrupted,
}

/// Photographs to radiance fields, novel views and meshes.
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

/// The verbs and nouns, in the order in which the help lists them.
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
    Bench(bench::Bench),
}

impl Command {
    /// The verb that was called.
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
            Command::Bench(noun) => noun.verb(),
        }
    }
}
