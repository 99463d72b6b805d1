//! Cases of the op, for its tests and for `bench check`.

use super::Adam;
#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Three steps of parameters; of each gradient every third number is 0.
pub struct Case {
    pub adam: Adam,
    /// Whether parameters without gradient are left alone.
    pub sparse: bool,
    pub params: Vec<f32>,
    pub gradients: [Vec<f32>; 3],
}

pub fn cases() -> Vec<Case> {
    let of = |(n, sparse): (usize, bool)| Case {
        adam: Adam { weight_decay: 0.1, ..Adam::default() },
        sparse,
        params: random(n, 1),
        gradients: [1, 2, 3].map(|t| {
            let mut g = random(n, 10 + t);
            g.iter_mut().skip(t as usize % 3).step_by(3).for_each(|g| *g = 0.0);
            g
        }),
    };
    [(0, false), (1, false), (999, false), (999, true), (70_001, false)].map(of).into()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for c in cases() {
        let n = c.params.len();
        let (pg, mg, vg) = (gpu.upload(&c.params), gpu.zeros(n), gpu.zeros(n));
        let (mut pw, mut mw, mut vw) = (wide(&c.params), vec![0.0; n], vec![0.0; n]);
        let shape = format!("N={n} sparse={}", c.sparse);
        for (t, g) in (1..).zip(&c.gradients) {
            let gg = gpu.upload(g);
            on_gpu::step(gpu, &c.adam, (t, c.sparse), &pg, [&mg, &vg], &gg);
            reference::step(&c.adam, t, c.sparse, &mut pw, &mut mw, &mut vw, &wide(g));
            table.close("adam", "gradient cleared", &shape, &gg, &vec![0.0; n])?;
        }
        table.close("adam", "parameters", &shape, &pg, &pw)?;
        table.close("adam", "moments", &shape, &vg, &vw)?;
    }
    Ok(())
}
