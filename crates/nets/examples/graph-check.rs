//! Every op in burn's graph on a device against the same graph on the CPU: `graph-check DEVICE`, by `cargo xtask gpu-check`.

use std::process::ExitCode;

fn main() -> ExitCode {
    diorama_kernels::check::main("burn's graph", |gpu| {
        if !gpu.shares_memory() {
            return Err("burn's own kernels share memory among units, which this device cannot".into());
        }
        let mut rows = diorama_nets::bridge::check::run(gpu);
        rows.extend(diorama_nets::ops::check::run(gpu));
        Ok(rows)
    })
}
