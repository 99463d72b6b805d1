//! Report of the time that each stage of a training step takes.

use serde::Serialize;

/// Share of one stage in a step.
#[derive(Clone, Debug, Serialize)]
pub struct StageFigure {
    pub stage: &'static str,
    pub share: f64,
    /// Milliseconds per step.
    pub ms: f64,
}

/// Stages and speed of training steps.
#[derive(Clone, Debug, Serialize)]
pub struct TrainReport {
    pub threads: usize,
    pub simd: &'static str,
    /// `cpu`, or what the GPU calls itself.
    pub device: String,
    pub steps: u64,
    pub seconds: f64,
    /// Rays that were trained on, per second; a device leaves out those whose samples find no room.
    pub rays_per_s: f64,
    /// Samples that were marched to, per second.
    pub marched_per_s: f64,
    /// Samples that went back through the network, per second.
    pub trained_per_s: f64,
    /// Of all rays.
    pub marched_per_ray: f64,
    /// Of rays that were trained on.
    pub trained_per_ray: f64,
    /// Share of occupied cells.
    pub occupied: Option<f64>,
    pub stages: Vec<StageFigure>,
}
