//! `diorama text`: a group of commands.

mod annotate;
mod make_scenes;

use super::Verb;
use clap::Subcommand;

/// Turn scenes with writing into labelled images
#[derive(Subcommand)]
pub enum Text {
    Annotate(annotate::Annotate),
    MakeScenes(make_scenes::MakeScenes),
}

impl Text {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Text::Annotate(v) => v,
            Text::MakeScenes(v) => v,
        }
    }
}
