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
    let [seconds] = alternating_seconds(repeats, |_| f());
    seconds
}

/// Median seconds of each of `N` things over `repeats` rounds, after one round that does not count: in each round they take turns, so that
/// other work on the machine slows all of them.
pub fn alternating_seconds<const N: usize>(repeats: usize, mut f: impl FnMut(usize)) -> [f64; N] {
    (0..N).for_each(&mut f);
    let mut times = [(); N].map(|_| Vec::with_capacity(repeats));
    for _ in 0..repeats.max(1) {
        for (k, times) in times.iter_mut().enumerate() {
            let begin = Instant::now();
            f(k);
            times.push(begin.elapsed().as_secs_f64());
        }
    }
    times.map(|mut t| {
        t.sort_by(f64::total_cmp);
        t[t.len() / 2]
    })
}
