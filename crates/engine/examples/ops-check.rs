//! Every op on a device against its f64 reference, and views against the CPU's: `ops-check DEVICE`, by `cargo xtask gpu-check`.

use diorama_kernels::device::Api;
use diorama_kernels::gpu::Gpu;
use std::process::ExitCode;
use std::time::Instant;

fn main() -> ExitCode {
    let name = std::env::args().nth(1).unwrap_or_default();
    match check(&name) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(e) => {
            eprintln!("{e}");
            ExitCode::from(2)
        }
    }
}

/// Whether all results are right.
fn check(name: &str) -> Result<bool, String> {
    let begin = Instant::now();
    let gpu = Gpu::open(name.parse::<Api>()?).map_err(|e| e.to_string())?;
    let mut rows = diorama_kernels::check::run(&gpu).map_err(|e| e.to_string())?;
    rows.extend(diorama_engine::on_gpu::check::run(&gpu).map_err(|e| e.to_string())?);
    for row in &rows {
        if let Some(fault) = &row.fault {
            println!("WRONG {} {} ({}): {fault}", row.op, row.result, row.shape);
        }
    }
    let right = rows.iter().filter(|r| r.fault.is_none()).count();
    println!("{right} of {} right on {name} ({}) in {:.0} s", rows.len(), gpu.name, begin.elapsed().as_secs_f64());
    Ok(right == rows.len() && !rows.is_empty())
}
