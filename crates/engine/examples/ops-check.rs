//! Every op on a device against its f64 reference, and views against the CPU's: `ops-check DEVICE`, by `cargo xtask gpu-check`.

use diorama_kernels::check;
use std::process::ExitCode;

fn main() -> ExitCode {
    check::main("ops and views", |gpu| {
        let mut rows = check::run(gpu).map_err(|e| e.to_string())?;
        rows.extend(diorama_engine::on_gpu::check::run(gpu).map_err(|e| e.to_string())?);
        Ok(rows)
    })
}
