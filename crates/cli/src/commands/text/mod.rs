//! `diorama text`: a group of commands.

mod annotate;
mod edit;
mod eval;
mod eval_detector;
mod label;
mod make_scenes;
mod prepare;
mod prior;
mod quickstart;
mod report;
mod study;
mod synth;
mod train;
mod train_detector;

use super::Verb;
use clap::Subcommand;

/// Turn scenes with writing into labelled images
#[derive(Subcommand)]
pub enum Text {
    Annotate(annotate::Annotate),
    Edit(edit::Edit),
    Eval(eval::Eval),
    Label(label::Label),
    EvalDetector(eval_detector::EvalDetector),
    MakeScenes(make_scenes::MakeScenes),
    Merge(synth::Merge),
    Prepare(prepare::Prepare),
    Prior(prior::PriorCommand),
    Quickstart(quickstart::Quickstart),
    Report(report::Report),
    Study(study::Study),
    Synth(synth::Synth),
    Train(train::Train),
    TrainDetector(train_detector::TrainDetector),
}

impl Text {
    /// The chosen command.
    pub fn verb(&self) -> &dyn Verb {
        match self {
            Text::Annotate(v) => v,
            Text::Edit(v) => v,
            Text::Eval(v) => v,
            Text::Label(v) => v,
            Text::EvalDetector(v) => v,
            Text::MakeScenes(v) => v,
            Text::Merge(v) => v,
            Text::Prepare(v) => v,
            Text::Prior(v) => v,
            Text::Quickstart(v) => v,
            Text::Report(v) => v,
            Text::Study(v) => v,
            Text::Synth(v) => v,
            Text::Train(v) => v,
            Text::TrainDetector(v) => v,
        }
    }
}
