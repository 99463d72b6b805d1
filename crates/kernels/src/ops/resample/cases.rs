//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
use super::{Filter, Resample};
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Gpu, GpuError, table::Table},
    ops::pool::Pool,
};
#[cfg(feature = "gpu")]
use diorama_testkit::wide;
use diorama_testkit::random;

pub const FILTERS: [Filter; 6] = [
    Filter::Nearest,
    Filter::Bilinear { align_corners: false },
    Filter::Bilinear { align_corners: true },
    Filter::BilinearAntialiased,
    Filter::BicubicAntialiased,
    Filter::Area,
];

/// Sizes of images before and after.
pub const SIZES: [([usize; 2], [usize; 2]); 7] = [
    ([1, 1], [1, 1]),
    ([5, 7], [10, 14]),
    ([13, 40], [5, 17]),
    ([3, 1], [1, 6]),
    ([40, 33], [3, 2]),
    ([4, 5], [4, 5]),
    ([3, 3], [0, 4]),
];

/// Planes, and gradients of the resampled ones.
pub struct Case {
    pub name: String,
    pub resample: Resample,
    pub planes: usize,
    pub x: Vec<f32>,
    pub d: Vec<f32>,
}

impl Case {
    pub fn new(name: String, resample: Resample, planes: usize) -> Case {
        let ([h, w], [oh, ow]) = (resample.from(), resample.to());
        Case { name, planes, x: random(planes * h * w, 1), d: random(planes * oh * ow, 2), resample }
    }
}

pub fn cases() -> Vec<Case> {
    let of = |(filter, (from, to), planes): (Filter, ([usize; 2], [usize; 2]), usize)| {
        Case::new(format!("P={planes} {from:?} to {to:?} {filter:?}"), Resample::new(filter, from, to), planes)
    };
    let sized = |filter| SIZES.into_iter().flat_map(move |sizes| [0, 1, 3].map(|planes| (filter, sizes, planes)));
    // The last has more than one band on the CPU.
    FILTERS.into_iter().flat_map(sized).chain([(Filter::BilinearAntialiased, ([20, 30], [70, 900]), 1)]).map(of).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    let means = [false, true].map(|count_padding| {
        let pool = Pool { kernel: [3, 2], stride: [2, 3], padding: [1, 0], ceil_mode: true };
        Case::new(format!("means of {pool:?} count padding {count_padding}"), pool.average([7, 9], count_padding), 3)
    });
    for c in cases().into_iter().chain(means) {
        let out = on_gpu::forward(gpu, &c.resample, c.planes, &gpu.upload(&c.x));
        table.close("resample", "forward", &c.name, &out, &reference::forward(&c.resample, c.planes, &wide(&c.x)))?;
        let dx = on_gpu::backward(gpu, &c.resample, c.planes, &gpu.upload(&c.d));
        table.close("resample", "d x", &c.name, &dx, &reference::backward(&c.resample, c.planes, &wide(&c.d)))?;
    }
    Ok(())
}
