//! Every op on a GPU against its reference.

use crate::{PipelineError, Result};

/// One comparison.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Line {
    pub op: &'static str,
    pub result: &'static str,
    pub shape: String,
    /// Largest error over value plus root mean square; null where it failed.
    pub error: Option<f64>,
    pub fault: Option<String>,
}

/// What a check found.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Report {
    pub device: &'static str,
    pub name: String,
    pub software: bool,
    /// Whether the device adds f32 atomically.
    pub native_atomics: bool,
    /// Largest error allowed.
    pub tolerance: f64,
    pub seconds: f64,
    pub lines: Vec<Line>,
}

/// Runs the table on the named device.
///
/// # Errors
/// When the device is unknown, not part of the build, absent or lost; wrong results are lines with a fault.
#[cfg(feature = "gpu")]
pub fn run(device: &str) -> Result<Report> {
    use diorama_kernels::gpu::{Gpu, GpuError, check};
    let begin = std::time::Instant::now();
    let told = |e: GpuError| match e {
        GpuError::Lost(..) => PipelineError::Device(e.to_string()),
        _ => PipelineError::Usage(e.to_string()),
    };
    let gpu = Gpu::open(device.parse().map_err(PipelineError::Usage)?).map_err(told)?;
    let mut rows = check::run(&gpu).map_err(told)?;
    rows.extend(diorama_engine::on_gpu::check::run(&gpu).map_err(told)?);
    let line =
        |r: check::Row| Line { op: r.op, result: r.result, shape: r.shape, error: r.error.is_finite().then_some(r.error), fault: r.fault };
    Ok(Report {
        device: gpu.api.name(),
        native_atomics: gpu.has_native_atomics(),
        name: gpu.name,
        software: gpu.software,
        tolerance: check::TOLERANCE,
        seconds: begin.elapsed().as_secs_f64(),
        lines: rows.into_iter().map(line).collect(),
    })
}

/// This build has no GPU kernels.
///
/// # Errors
/// Always.
#[cfg(not(feature = "gpu"))]
pub fn run(device: &str) -> Result<Report> {
    Err(not_built(device))
}

/// What a build without GPU kernels says of a device.
#[cfg(not(feature = "gpu"))]
pub fn not_built(device: &str) -> PipelineError {
    PipelineError::Usage(match device.parse::<diorama_kernels::device::Api>() {
        Ok(api) => api.not_built(),
        Err(e) => e,
    })
}
