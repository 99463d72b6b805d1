//! `diorama text`: a group of commands.

mod annotate;
mod eval;
mod make_scenes;
mod train;

use super::Verb;
use clap::Subcommand;

/// Turn scenes with writing into labelled images
#[derive(Subcommand)]
pub enum Text {
    Annotate(annotate::Annotate),
    Eval(eval::Eval),
    MakeScenes(make_scenes::MakeScenes),
    Train(train::Train),
}

impl Text {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Text::Annotate(v) => v,
            Text::Eval(v) => v,
            Text::MakeScenes(v) => v,
            Text::Train(v) => v,
        }
    }
}
