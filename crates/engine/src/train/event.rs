//! What a run tells the terminal, the metrics file and the viewer.

/// What one step did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    pub loss: f64,
    /// Mean squared colour error of the step's rays.
    pub mse: f64,
    pub rays: u64,
    pub samples: u64,
}

/// Something that happened in a run.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The run begins or goes on at `step`.
    Started {
        step: u64,
        steps: Option<u64>,
        seconds: Option<f64>,
    },
    /// Means since the last such event; totals are from the start of the run.
    Progress {
        step: u64,
        seconds: f64,
        progress: f64,
        loss: f64,
        mse: f64,
        psnr: f64,
        rays: u64,
        samples: u64,
        rays_per_s: f64,
    },
    /// Held-out pixels were judged.
    Evaluated {
        step: u64,
        seconds: f64,
        psnr: f64,
        mse: f64,
        /// PSNR of each view, named by its frame.
        views: Vec<(usize, f64)>,
    },
    Saved {
        step: u64,
    },
    /// What went wrong at `step`; the run goes on from `to_step`.
    Recovered {
        step: u64,
        to_step: u64,
        why: String,
    },
    Note(String),
    Finished {
        step: u64,
        seconds: f64,
        interrupted: bool,
    },
}
