//! Every op on a GPU against its reference.

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

/// Runs the table on the named device, then trains there and on the CPU and compares the losses.
///
/// # Errors
/// When the device is unknown, not part of the build, absent or lost; wrong results are lines with a fault.
#[cfg(feature = "gpu")]
pub fn run(device: &str, data: Option<&Path>) -> Result<Report> {
    use diorama_kernels::gpu::{Gpu, GpuError, check};
    use diorama_kernels::ops::fused_mlp::gpu::fused::tensor_element;
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
    let mut lines: Vec<Line> = rows.into_iter().map(line).collect();
    let mut cases = vec![("loss per step", "f32", &[][..])];
    if tensor_element(&gpu).is_some() {
        cases.push(("loss, tensor cores", "auto", &[]));
    }
    cases.push(("camera corrections", "f32", &["camera.refine=true"]));
    cases.push(("corrections, focal", "f32", &["camera.refine=true", "camera.refine_focal=true"]));
    cases.push(("loss, drawn by error", "f32", &["sampling.error_map=true"]));
    cases.push(("loss, distortion", "f32", &["loss.distortion=0.01", "background=learned"]));
    for (result, precision, changes) in cases {
        lines.push(training(device, data, Method::Ngp, result, precision, changes)?);
    }
    for (method, result) in [(Method::Nerf, "loss, nerf"), (Method::Mlp, "loss, mlp"), (Method::Baseline, "loss, baseline")] {
        let small = ["sampling.rays=16", "sampling.samples=12", "sampling.importance=12"];
        lines.push(training(device, data, method, result, "f32", &small)?);
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
/// The same of wide networks, which the CPU takes long for.
#[cfg(feature = "gpu")]
const WIDE_STEPS: u64 = 10;
/// Steps after which cameras' corrections are compared, few because they diverge fast: on fox, two instruction sets of one
/// CPU are 42 % apart after 50.
#[cfg(feature = "gpu")]
const REFINED_STEPS: u64 = 4;
/// How far they may be apart, as root mean square of that of all.
#[cfg(feature = "gpu")]
const CORRECTIONS_APART: f64 = 0.2;
/// How far losses may be apart in f32, and on tensor cores.
#[cfg(feature = "gpu")]
const APART: [f64; 2] = [0.02, 0.05];

/// Small steps of the standard recipe on the device in the given precision, and on the CPU in f32, with the same
/// rays: by default on the still life.
#[cfg(feature = "gpu")]
fn training(device: &str, data: Option<&Path>, method: Method, result: &'static str, precision: &str, changes: &[&str]) -> Result<Line> {
    use crate::object::config::Config;
    use crate::object::{quickstart, recipe};
    let refines = changes.contains(&"camera.refine=true");
    let steps = match method {
        Method::Ngp if refines => REFINED_STEPS,
        Method::Ngp => STEPS,
        _ => WIDE_STEPS,
    };
    let most = APART[(precision != "f32") as usize];
    let scratch = std::env::temp_dir().join(format!("diorama-check-{}", std::process::id()));
    let folder = data.unwrap_or(&scratch);
    let mut c = Config::new(method, folder.into());
    let name = match data {
        Some(d) => d.display().to_string(),
        None => {
            quickstart::write_capture(&scratch, 24, 64)?;
            "still life".into()
        }
    };
    c.data.split = "every:8".into();
    c.data.downscale = if data.is_some() { 4 } else { 1 };
    c.run.log_every = 1;
    (c.sampling.rays, c.sampling.batch_samples, c.sampling.occupancy_points) = (64, 4096, 8192);
    for (key, value) in changes.iter().filter_map(|c| c.split_once('=')) {
        c.set(key, value)?;
    }
    let mut of = |device: &str| {
        c.device = device.into();
        c.field.precision = if device == "cpu" { "f32" } else { precision }.into();
        recipe::begin(&c, steps)
    };
    let curves = of("cpu").and_then(|cpu| Ok((cpu, of(device)?)));
    if data.is_none() {
        // What cannot be removed from a scratch folder stays there.
        let _ = std::fs::remove_dir_all(&scratch);
    }
    let (cpu, gpu) = curves?;
    let (error, most) = match (&cpu.corrections, &gpu.corrections) {
        (Some(a), Some(b)) => {
            let energy = |v: &mut dyn Iterator<Item = f32>| v.map(|x| (x * x) as f64).sum::<f64>().sqrt();
            (energy(&mut a.iter().zip(b).map(|(a, b)| a - b)) / energy(&mut a.iter().copied()), CORRECTIONS_APART)
        }
        _ => {
            let apart = cpu.losses.iter().zip(&gpu.losses).map(|(a, b)| (b / a - 1.0).abs());
            (apart.fold(0.0, |a: f64, e| if e.is_nan() { e } else { a.max(e) }), most)
        }
    };
    let right = error <= most;
    Ok(Line {
        op: "training",
        result,
        shape: format!("{steps} steps, {name}"),
        error: (right && error.is_finite()).then_some(error),
        fault: (!right).then(|| format!("{:.2} % off, {:.0} % is allowed", 100.0 * error, 100.0 * most)),
    })
}

/// This build has no GPU kernels.
///
/// # Errors
/// Always.
#[cfg(not(feature = "gpu"))]
pub fn run(device: &str, _: Option<&Path>) -> Result<Report> {
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
