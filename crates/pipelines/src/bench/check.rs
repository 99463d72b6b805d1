//! `diorama bench check`: every op on a GPU compared with its reference.

#[cfg(feature = "gpu")]
use crate::object::config::Method;
use crate::{PipelineError, Result};
use std::path::Path;

/// One comparison.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Line {
    pub op: &'static str,
    pub result: &'static str,
    pub shape: String,
    /// Largest error over value plus root mean square; null where it failed.
    pub error: Option<f64>,
    pub fault: Option<String>,
    /// Time that the comparison took, with the reference and the building of kernels; 0 for a further result of the same steps.
    pub seconds: f64,
}

/// Result of a check.
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

/// Runs the table on the named device, then trains there and on the CPU and compares the losses.
///
/// # Errors
/// When the device is unknown, not part of the build, absent or lost; wrong results are lines with a fault.
#[cfg(feature = "gpu")]
pub fn run(device: &str, data: Option<&Path>) -> Result<Report> {
    use diorama_kernels::check;
    use diorama_kernels::gpu::{Gpu, GpuError};
    use diorama_kernels::ops::fused_mlp::gpu::fused::tensor_element;
    let begin = std::time::Instant::now();
    let to_pipeline_error = |e: GpuError| match e {
        GpuError::Lost(..) | GpuError::Memory(..) => PipelineError::Device(e.to_string()),
        _ => PipelineError::Usage(e.to_string()),
    };
    let gpu = Gpu::open(device.parse().map_err(PipelineError::Usage)?).map_err(to_pipeline_error)?;
    let mut rows = check::run(&gpu).map_err(to_pipeline_error)?;
    rows.extend(diorama_engine::on_gpu::check::run(&gpu).map_err(to_pipeline_error)?);
    let line = |r: check::Row| Line {
        op: r.op,
        result: r.result,
        shape: r.shape,
        error: r.error.is_finite().then_some(r.error),
        fault: r.fault,
        seconds: r.seconds,
    };
    let mut lines: Vec<Line> = rows.into_iter().map(line).collect();
    let mut cases = vec![("loss per step", "f32", &[][..])];
    if tensor_element(&gpu).is_some() {
        cases.push(("loss, tensor cores", "auto", &[]));
    }
    // Finding distances takes longer than the steps: that is left to the first cases.
    cases.push(("d cameras", "f32", &["camera.refine=true"]));
    cases.push(("d cameras, focal", "f32", &["loss.depth=0", "camera.refine=true", "camera.refine_focal=true"]));
    cases.push(("loss, drawn by error", "f32", &["loss.depth=0", "sampling.error_map=true"]));
    cases.push(("loss, distortion", "f32", &["loss.depth=0", "loss.distortion=1", "background=learned"]));
    // Software takes a second for a step.
    let training = Training::new(device, if gpu.software { FEW_STEPS } else { STEPS }, data)?;
    for (result, precision, changes) in cases {
        lines.extend(training.compare(Method::Ngp, result, precision, changes)?);
    }
    for (method, result) in [(Method::Nerf, "loss, nerf"), (Method::Mlp, "loss, mlp"), (Method::Baseline, "loss, baseline")] {
        let small = ["loss.depth=0", "sampling.rays=16", "sampling.samples=12", "sampling.importance=12"];
        lines.extend(training.compare(method, result, "f32", &small)?);
    }
    Ok(Report {
        device: gpu.api.name(),
        native_atomics: gpu.has_native_atomics(),
        name: gpu.name,
        software: gpu.software,
        tolerance: check::TOLERANCE,
        seconds: begin.elapsed().as_secs_f64(),
        lines,
    })
}

/// Steps over which losses are compared.
#[cfg(feature = "gpu")]
const STEPS: u64 = 50;
/// The same on software that stands for a device: more than `sampling.occupancy_every`, so that the device updates its grid.
#[cfg(feature = "gpu")]
const FEW_STEPS: u64 = 20;
/// The same of wide networks, which the CPU takes long for.
#[cfg(feature = "gpu")]
const WIDE_STEPS: u64 = 10;
/// How far the first gradient of cameras' corrections may be apart, and the step that they take by its signs, as root mean
/// square of that of all. Later ones diverge fast, because a sign decides where a camera goes: on fox, two instruction
/// sets of one CPU are 42 % apart after 50 steps.
#[cfg(feature = "gpu")]
const CAMERAS_APART: [f64; 2] = [0.02, 0.4];
/// Largest relative difference of losses in f32, and on tensor cores.
#[cfg(feature = "gpu")]
const APART: [f64; 2] = [0.02, 0.05];

/// Small steps of the standard recipe on a device and on the CPU.
#[cfg(feature = "gpu")]
struct Training<'a> {
    device: &'a str,
    steps: u64,
    name: String,
    data: crate::object::config::DataConfig,
    loaded: crate::object::recipe::Loaded,
}

#[cfg(feature = "gpu")]
impl<'a> Training<'a> {
    /// Loads a capture at a quarter of its size, or the still life.
    fn new(device: &'a str, steps: u64, data: Option<&Path>) -> Result<Training<'a>> {
        use crate::object::{config::Config, quickstart, recipe};
        let scratch = std::env::temp_dir().join(format!("diorama-check-{}", std::process::id()));
        let mut c = Config::new(Method::Ngp, data.unwrap_or(&scratch).into());
        (c.device, c.data.split) = (device.into(), "every:8".into());
        c.data.downscale = if data.is_some() { 4 } else { 1 };
        let loaded = match data {
            Some(_) => recipe::Loaded::new(&c),
            None => quickstart::write_capture(&scratch, 24, 64).and_then(|_| recipe::Loaded::new(&c)),
        };
        if data.is_none() {
            // What cannot be removed from a scratch folder stays there.
            let _ = std::fs::remove_dir_all(&scratch);
        }
        let name = data.map_or_else(|| "still life".into(), |d| d.display().to_string());
        Ok(Training { device, steps, name, data: c.data, loaded: loaded? })
    }

    /// Both losses with the same rays, in the given precision on the device and in f32 on the CPU.
    fn compare(&self, method: Method, result: &'static str, precision: &str, changes: &[&str]) -> Result<Vec<Line>> {
        use crate::object::config::Config;
        use crate::object::recipe;
        let begin = std::time::Instant::now();
        let refines = changes.contains(&"camera.refine=true");
        let steps = match method {
            Method::Ngp if refines => 1,
            Method::Ngp => self.steps,
            _ => WIDE_STEPS,
        };
        let most = APART[(precision != "f32") as usize];
        let mut c = Config::new(method, self.data.path.clone());
        (c.data, c.run.log_every) = (self.data.clone(), 1);
        (c.sampling.rays, c.sampling.batch_samples, c.sampling.occupancy_points) = (64, 4096, 8192);
        for (key, value) in changes.iter().filter_map(|c| c.split_once('=')) {
            c.set(key, value)?;
        }
        let mut of = |device: &str| {
            c.device = device.into();
            c.field.precision = if device == "cpu" { "f32" } else { precision }.into();
            recipe::begin(&c, steps, &self.loaded)
        };
        let (cpu, gpu) = (of("cpu")?, of(self.device)?);
        let seconds = begin.elapsed().as_secs_f64();
        let shape = format!("{steps} step{}, {}", if steps == 1 { "" } else { "s" }, self.name);
        let line = |result, error: f64, most: f64| {
            let right = error <= most;
            let fault = (!right).then(|| format!("{:.2} % off, {:.0} % is allowed", 100.0 * error, 100.0 * most));
            let error = (right && error.is_finite()).then_some(error);
            Line { op: "training", result, shape: shape.clone(), error, fault, seconds }
        };
        if let (Some(a), Some(b)) = (&cpu.cameras, &gpu.cameras) {
            let energy = |v: &mut dyn Iterator<Item = f32>| v.map(|x| (x * x) as f64).sum::<f64>().sqrt();
            let apart = |i: usize| energy(&mut a[i].iter().zip(&b[i]).map(|(a, b)| a - b)) / energy(&mut a[i].iter().copied());
            let first = Line { seconds: 0.0, ..line("cameras' first step", apart(0), CAMERAS_APART[1]) };
            return Ok(vec![line(result, apart(1), CAMERAS_APART[0]), first]);
        }
        let apart = cpu.losses.iter().zip(&gpu.losses).map(|(a, b)| (b / a - 1.0).abs());
        Ok(vec![line(result, apart.fold(0.0, |a: f64, e| if e.is_nan() { e } else { a.max(e) }), most)])
    }
}

/// This build has no GPU kernels.
///
/// # Errors
/// Always.
#[cfg(not(feature = "gpu"))]
pub fn run(device: &str, _: Option<&Path>) -> Result<Report> {
    Err(not_built(device))
}

/// Error of a build without GPU kernels.
#[cfg(not(feature = "gpu"))]
pub fn not_built(device: &str) -> PipelineError {
    PipelineError::Usage(match device.parse::<diorama_kernels::device::Api>() {
        Ok(api) => api.not_built(),
        Err(e) => e,
    })
}
