//! `diorama bench`: each op against the machine's measured limits, the stages of a training step, networks, the speed of rendering,
//! path tracing and rasterization, and tables of the thesis.

pub mod check;
#[cfg(feature = "gpu")]
pub mod gpu_ops;
pub mod mesh;
pub mod nets;
pub mod ops;
pub mod path_trace;
pub mod raster;
pub mod reduce;
pub mod render;
pub mod tetrahedra;
pub mod thesis;
pub mod train;

use std::time::Instant;

/// Median seconds of `f` over `repeats` calls, after one call that does not count.
pub fn median_seconds(repeats: usize, mut f: impl FnMut()) -> f64 {
    f();
    let mut times: Vec<f64> = (0..repeats.max(1))
        .map(|_| {
            let begin = Instant::now();
            f();
            begin.elapsed().as_secs_f64()
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}
