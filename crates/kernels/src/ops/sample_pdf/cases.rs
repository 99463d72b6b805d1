//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_testkit::random_unit;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Intervals of rays with weights, some of them 0, and numbers to draw by.
pub struct Case {
    pub rays: usize,
    pub n: usize,
    pub m: usize,
    pub edges: Vec<f32>,
    pub weights: Vec<f32>,
    pub u: Vec<f32>,
}

pub fn cases() -> Vec<Case> {
    let of = |(rays, n, m): (usize, usize, usize)| {
        let edges = (0..rays * (n + 1)).map(|i| (i % (n + 1)) as f32 * 0.3 + 1.0).collect();
        let mut weights = random_unit(rays * n, 1);
        weights.iter_mut().step_by(3).for_each(|w| *w = 0.0);
        Case { rays, n, m, edges, weights, u: random_unit(rays * m, 2) }
    };
    [(0, 8, 4), (1, 1, 1), (50, 16, 33), (37, 64, 33)].map(of).into()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for Case { rays, n, m, edges, weights, u } in cases() {
        let got = on_gpu::sample(gpu, n, &gpu.upload(&edges), &gpu.upload(&weights), m, &gpu.upload(&u));
        let want = reference::sample(n, &wide(&edges), &wide(&weights), m, &wide(&u));
        table.close("sample pdf", "distances", format!("R={rays} N={n} M={m}"), &got, &want)?;
    }
    Ok(())
}
