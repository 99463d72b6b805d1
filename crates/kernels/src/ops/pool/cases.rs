//! Cases of the op, for its tests and for `bench check`.

use super::Pool;
#[cfg(feature = "gpu")]
use super::reference;
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Gpu, GpuError, table::Table},
    ops::resample::gpu as resampling,
};
#[cfg(feature = "gpu")]
use diorama_testkit::{random, wide};

/// Windows, and sizes of the planes that they move over.
pub fn pools() -> Vec<(Pool, [usize; 2])> {
    let mut out = Vec::new();
    for (kernel, stride, padding) in [(1, 1, 0), (2, 2, 0), (3, 2, 1), (3, 1, 1), (2, 3, 1), (5, 4, 2)] {
        for ceil_mode in [false, true] {
            for from in [[5, 5], [6, 37], [7, 8]] {
                out.push((Pool { kernel: [kernel; 2], stride: [stride; 2], padding: [padding; 2], ceil_mode }, from));
            }
        }
    }
    out.push((Pool { kernel: [2, 3], stride: [1, 2], padding: [0, 1], ceil_mode: true }, [4, 9]));
    out
}

/// Means of windows, which are resampled; burn has the other pools.
#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for (pool, from) in pools() {
        for count_padding in [false, true] {
            let (planes, means) = (2, pool.average(from, count_padding));
            let [oh, ow] = means.to();
            let (x, d) = (random(planes * from[0] * from[1], 1), random(planes * oh * ow, 2));
            let shape = format!("{from:?} {pool:?} count padding {count_padding}");
            let want = reference::average(&pool, count_padding, planes, from, &wide(&x));
            table.close("average pool", "forward", &shape, &resampling::forward(gpu, &means, planes, &gpu.upload(&x)), &want)?;
            let want = reference::average_backward(&pool, count_padding, planes, from, &wide(&d));
            table.close("average pool", "d x", &shape, &resampling::backward(gpu, &means, planes, &gpu.upload(&d)), &want)?;
        }
    }
    Ok(())
}
