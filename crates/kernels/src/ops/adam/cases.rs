//! Cases of the op, for its tests and for `bench check`.

use super::Adam;
#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;
use std::ops::Range;

/// Gradients of three steps, every third number of which is 0.
pub struct Case {
    pub adam: Adam,
    /// Whether parameters without gradient are left alone.
    pub sparse: bool,
    /// Parameters that are trained.
    pub range: Range<usize>,
    pub params: Vec<f32>,
    pub gradients: [Vec<f32>; 3],
}

pub fn cases() -> Vec<Case> {
    let of = |(n, sparse, range): (usize, bool, Range<usize>)| Case {
        adam: Adam { weight_decay: 0.1, ..Adam::default() },
        sparse,
        range,
        params: random(n, 1),
        gradients: [1, 2, 3].map(|t| {
            let mut g = random(n, 10 + t);
            g.iter_mut().skip(t as usize % 3).step_by(3).for_each(|g| *g = 0.0);
            g
        }),
    };
    let all = [(0, false, 0..0), (1, false, 0..1), (999, false, 0..999), (999, true, 0..999), (999, false, 300..640)];
    all.into_iter().chain([(70_001, false, 0..70_001)]).map(of).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for c in cases() {
        let n = c.params.len();
        let (pg, mg, vg) = (gpu.upload(&c.params), gpu.zeros(n), gpu.zeros(n));
        let (mut pw, mut mw, mut vw) = (wide(&c.params), vec![0.0; n], vec![0.0; n]);
        let (own, shape) = (&c.range, format!("N={n} sparse={} {:?}", c.sparse, c.range));
        for (t, g) in (1..).zip(&c.gradients) {
            let gg = gpu.upload(g);
            on_gpu::step(gpu, &c.adam, (t, c.sparse), own.clone(), &pg, [&mg, &vg], &gg);
            let of = wide(&g[own.clone()]);
            reference::step(&c.adam, t, c.sparse, &mut pw[own.clone()], &mut mw[own.clone()], &mut vw[own.clone()], &of);
            let left: Vec<f64> = (0..n).map(|i| if own.contains(&i) { 0.0 } else { g[i] as f64 }).collect();
            table.close("adam", "gradient cleared", &shape, &gg, &left)?;
        }
        table.close("adam", "parameters", &shape, &pg, &pw)?;
        table.close("adam", "moments", &shape, &vg, &vw)?;
    }
    Ok(())
}
