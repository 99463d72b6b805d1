//! `diorama compare`

use super::Outcome;
use crate::arguments::CompareArgs;
use diorama_pipelines::Result;
use diorama_pipelines::object::compare;
use diorama_pipelines::object::memory::size;

pub fn run(a: &CompareArgs) -> Result<Outcome> {
    let table = compare::compare(&a.runs, a.data.as_deref(), &a.out, &mut |n| eprintln!("{n}"))?;
    if a.json {
        println!("{}", serde_json::to_string(&table).expect("plain values"));
        return Ok(Outcome::Done);
    }
    println!(
        "{:<24} {:<9} {:>8} {:>9} {:>11} {:>11} {:>7} {:>7} {:>8} {:>10}",
        "run", "method", "steps", "seconds", "rays", "parameters", "psnr", "ssim", "mse", "memory"
    );
    for c in &table {
        let run = c.run.display().to_string();
        println!(
            "{run:<24} {:<9} {:>8} {:>9.1} {:>11} {:>11} {:>7.2} {:>7.4} {:>8.5} {:>10}",
            c.method,
            c.steps,
            c.seconds,
            c.rays,
            c.parameters,
            c.psnr,
            c.ssim,
            c.mse,
            c.peak_memory_bytes.map_or("unknown".into(), size)
        );
    }
    println!("{}", a.out.display());
    Ok(Outcome::Done)
}
