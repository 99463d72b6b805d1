//! `diorama bench`

use super::{Outcome, use_threads};
use crate::arguments::{BenchCheckArgs, BenchMeshArgs, BenchOpsArgs, BenchRenderArgs, BenchTrainArgs};
use diorama_pipelines::bench;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::{device, run_folder};
use diorama_pipelines::{PipelineError, Result};

pub fn ops(a: &BenchOpsArgs) -> Result<Outcome> {
    if a.threads == Some(0) || a.repeats == 0 {
        return Err(PipelineError::Usage("--threads and --repeats: at least 1".into()));
    }
    let optional = |v: Option<f64>, unit: &str| v.map_or(String::new(), |v| format!("{v:8.1} {unit}"));
    let print = |f: &bench::ops::OpFigure| {
        let share = f.share_of_peak.map_or(String::new(), |s| format!("{:5.0} % of the multiply-add peak", 100.0 * s));
        let rate = format!("{}{}", optional(f.gflops, "GFLOP/s"), optional(f.gb_per_s, "GB/s"));
        println!("{:<30} {:<30} {:>10.1} ns/{:<10} {rate} {share}", f.op, f.shape, f.ns, f.unit);
    };
    if a.device != "cpu" {
        if a.threads.is_some() {
            return Err(PipelineError::Usage(format!("--threads is the CPU's; leave it out with --device {}", a.device)));
        }
        return gpu_ops(a, &print);
    }
    let report = bench::ops::run(a.threads.unwrap_or(1), a.repeats, &mut |f| {
        if !a.json {
            print(f);
        }
    });
    if a.json {
        println!("{}", serde_json::json!(report));
    } else {
        let l = report.limits;
        println!(
            "{} thread(s), {}; one thread's limits: {:.0} GFLOP/s multiply-add, {:.1} GB/s read",
            report.threads, report.simd, l.fma_gflops, l.read_gb_per_s
        );
    }
    Ok(Outcome::Done)
}

#[cfg(feature = "gpu")]
fn gpu_ops(a: &BenchOpsArgs, print: &dyn Fn(&bench::ops::OpFigure)) -> Result<Outcome> {
    let report = bench::gpu_ops::run(&a.device, a.repeats, &mut |f| {
        if !a.json {
            print(f);
        }
    })?;
    if a.json {
        println!("{}", serde_json::json!(report));
    } else {
        println!("{} ({}): copies {:.0} GB/s", report.device, report.name, report.copy_gb_per_s);
    }
    Ok(Outcome::Done)
}

#[cfg(not(feature = "gpu"))]
fn gpu_ops(a: &BenchOpsArgs, _: &dyn Fn(&bench::ops::OpFigure)) -> Result<Outcome> {
    Err(bench::check::not_built(&a.device))
}

pub fn train(a: &BenchTrainArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let method: Method = a.method.parse().map_err(|e| PipelineError::Usage(format!("--method {e}")))?;
    let mut c = Config::new(method, a.data.clone());
    c.data.downscale = a.downscale;
    c.data.split = a.split.clone();
    c.set("device", &a.device)?;
    for o in &a.overrides {
        let (key, value) = o.split_once('=').ok_or_else(|| PipelineError::Usage(format!("--set {o}: expected KEY=VALUE")))?;
        c.set(key.trim(), value.trim())?;
    }
    c.check()?;
    let r = bench::train::run(&c, a.warmup, a.steps.max(1))?;
    if a.json {
        println!("{}", serde_json::json!(r));
        return Ok(Outcome::Done);
    }
    for s in &r.stages {
        println!("{:<12} {:>8.2} ms/step {:>6.1} %", s.stage, s.ms, 100.0 * s.share);
    }
    let with = if r.device == "cpu" { format!("{} thread(s), {}", r.threads, r.simd) } else { r.device };
    println!("{} steps in {:.1} s on {with}", r.steps, r.seconds);
    println!(
        "{:.0} rays/s; per ray {:.1} samples marched, {:.1} trained; {:.0} samples/s trained",
        r.rays_per_s, r.marched_per_ray, r.trained_per_ray, r.trained_per_s
    );
    if let Some(o) = r.occupied {
        println!("{:.1} % of the occupancy grid's cells are occupied", 100.0 * o);
    }
    Ok(Outcome::Done)
}

pub fn render(a: &BenchRenderArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    let (mut model, notes) = run_folder::load_model(&a.run)?;
    let device = device::accelerate(&mut model, &a.device, Box::new(super::note))?;
    notes.iter().for_each(|n| eprintln!("note: {n}"));
    let report = bench::render::run(&model, a.repeats, device)?;
    if a.json {
        println!("{}", serde_json::json!(report));
        return Ok(Outcome::Done);
    }
    println!("{} views of {} x {} on {}", report.views, report.width, report.height, report.device);
    for (name, q) in [("exhaustive", report.exhaustive), ("full", report.full), ("fast", report.fast)] {
        let times = q.frames_per_s / report.exhaustive.frames_per_s;
        println!(
            "{name:<10} {:6.2} frames/s ({times:.2} x), {:.3} dB, {:.1} dB against exhaustive",
            q.frames_per_s, q.psnr, q.psnr_against_exhaustive
        );
    }
    Ok(Outcome::Done)
}

pub fn check(a: &BenchCheckArgs) -> Result<Outcome> {
    let r = bench::check::run(&a.device, a.data.as_deref())?;
    let wrong = r.lines.iter().filter(|l| l.fault.is_some()).count();
    if a.json {
        println!("{}", serde_json::json!(r));
    } else {
        for l in &r.lines {
            let error = l.error.map_or("FAILED ".into(), |e| format!("{e:.1e}"));
            println!("{error}  {:<20} {:<18} {:<28} {}", l.op, l.result, l.shape, l.fault.as_deref().unwrap_or(""));
        }
        let atomics = if r.native_atomics { "native f32 atomics" } else { "exchanged f32 atomics" };
        let kind = if r.software { "software" } else { "hardware" };
        println!(
            "{} ({}, {kind}, {atomics}): {} of {} right in {:.1} s",
            r.device,
            r.name,
            r.lines.len() - wrong,
            r.lines.len(),
            r.seconds
        );
    }
    if wrong > 0 {
        return Err(PipelineError::Device(format!("{wrong} of {} results on {} are wrong", r.lines.len(), r.device)));
    }
    Ok(Outcome::Done)
}

pub fn mesh(a: &BenchMeshArgs) -> Result<Outcome> {
    use_threads(a.threads)?;
    if !(16..=2048).contains(&a.resolution) || a.repeats == 0 {
        return Err(PipelineError::Usage("--resolution: must be 16 to 2048; --repeats: at least 1".into()));
    }
    let (model, notes) = run_folder::load_model(&a.run)?;
    notes.iter().for_each(|n| eprintln!("note: {n}"));
    let r = bench::mesh::run(&model, a.resolution, a.save_grid.as_deref(), a.repeats)?;
    if a.json {
        println!("{}", serde_json::json!(r));
    } else {
        let [x, y, z] = r.points;
        let memory = r.peak_bytes.map_or(String::new(), |b| format!(", {:.0} MB above the densities", b as f64 / 1e6));
        println!(
            "{x} x {y} x {z} at {:.2}: {} vertices, {} faces in {:.2} s on {} thread(s){memory}",
            r.level, r.vertices, r.faces, r.seconds, r.threads
        );
    }
    Ok(Outcome::Done)
}
