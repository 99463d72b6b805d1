//! Every op in burn's graph on a device against the same graph on the CPU: `graph-check DEVICE`, by `cargo xtask gpu-check`.

use diorama_kernels::device::Api;
use diorama_kernels::gpu::Gpu;
use std::process::ExitCode;

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
    let gpu = Gpu::open(name.parse::<Api>()?).map_err(|e| e.to_string())?;
    if !gpu.shares_memory() {
        return Err(format!("device {name}: burn's own kernels share memory among units, which this device cannot"));
    }
    let mut rows = diorama_nets::bridge::check::run(&gpu);
    rows.extend(diorama_nets::ops::check::run(&gpu));
    for row in &rows {
        if let Some(fault) = &row.fault {
            println!("WRONG {} {} ({}): {fault}", row.op, row.result, row.shape);
        }
    }
    let right = rows.iter().filter(|r| r.fault.is_none()).count();
    println!("{right} of {} right in burn's graph on {name} ({})", rows.len(), gpu.name);
    Ok(right == rows.len() && !rows.is_empty())
}
