//! `diorama text`: a group of commands.

mod annotate;
mod eval;
mod eval_detector;
mod make_scenes;
mod train;
mod train_detector;

use super::Verb;
use clap::Subcommand;

/// Turn scenes with writing into labelled images
#[derive(Subcommand)]
pub enum Text {
    Annotate(annotate::Annotate),
    Eval(eval::Eval),
    EvalDetector(eval_detector::EvalDetector),
    MakeScenes(make_scenes::MakeScenes),
    Train(train::Train),
    TrainDetector(train_detector::TrainDetector),
}

impl Text {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Text::Annotate(v) => v,
            Text::Eval(v) => v,
            Text::EvalDetector(v) => v,
            Text::MakeScenes(v) => v,
            Text::Train(v) => v,
            Text::TrainDetector(v) => v,
        }
    }
}
