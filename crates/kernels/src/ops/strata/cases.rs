//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::gpu as on_gpu;
use super::{Jitter, reference};
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Gpu, GpuError, table::Table},
    ops::composite::gpu::GpuPacked,
};
use diorama_geom::rng::Rng;
use diorama_testkit::{random_unit, wide};

/// Intervals per ray, and more of them.
pub const N: usize = 13;
pub const M: usize = 29;

/// Rays with near and far, of which every fifth is empty, and weights of their intervals, most of which are 0.
pub struct Case {
    pub near_far: Vec<f32>,
    pub weights: Vec<f32>,
    pub jitter: Jitter,
}

pub fn cases() -> Vec<Case> {
    let of = |(rays, jitter): (usize, Jitter)| Case {
        near_far: random_unit(rays, 1).iter().enumerate().flat_map(|(i, v)| [*v, v + 0.3 * (i % 5) as f32]).collect(),
        weights: random_unit(rays * N, 2).iter().map(|w| if *w < 0.7 { 0.0 } else { *w }).collect(),
        jitter,
    };
    // A counter beyond 32 bits.
    let jitters = [None, Some((Rng::new(4, 4), (1u64 << 33) + 7))];
    [0, 1, 70].into_iter().flat_map(|rays| jitters.map(|jitter| (rays, jitter))).map(of).collect()
}

/// Edges of coarse and of refined intervals.
pub struct Want {
    pub coarse: Vec<f64>,
    pub fine: Vec<f64>,
}

impl Case {
    pub fn want(&self) -> Want {
        let coarse = reference::stratified(&self.near_far, N, self.jitter);
        Want { fine: reference::refine(&coarse, &wide(&self.weights), N, M, self.jitter), coarse }
    }
}

/// First edges of intervals, or last ones, of edges `[R, n + 1]`.
pub fn side(edges: &[f64], n: usize, last: bool) -> Vec<f64> {
    edges.chunks_exact(n + 1).flat_map(|e| e[last as usize..n + last as usize].to_vec()).collect()
}

/// Last edges of intervals.
pub fn ends(t: &[f32], dt: &[f32]) -> Vec<f32> {
    t.iter().zip(dt).map(|(t, dt)| t + dt).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for c in cases() {
        let want = c.want();
        let coarse = on_gpu::stratified(gpu, &gpu.upload(&c.near_far), N, c.jitter);
        let fine = on_gpu::refine(gpu, &coarse, &gpu.upload(&c.weights), N, M, c.jitter);
        let of = |name: &str| format!("R={} {name}{}", c.near_far.len() / 2, if c.jitter.is_some() { " jittered" } else { "" });
        compare(gpu, table, of("coarse"), &coarse, (&want.coarse, N))?;
        compare(gpu, table, of("refined"), &fine, (&want.fine, N + M))?;
    }
    Ok(())
}

#[cfg(feature = "gpu")]
fn compare(gpu: &Gpu, table: &mut Table, shape: String, got: &GpuPacked, (edges, n): (&[f64], usize)) -> Result<(), GpuError> {
    let offsets: Vec<u32> = (0..=edges.len() / (n + 1)).map(|r| (r * n) as u32).collect();
    table.equal("strata", "offsets", &shape, &got.offsets, &offsets)?;
    table.close("strata", "starts", &shape, &got.t, &side(edges, n, false))?;
    // Lengths are small differences of starts.
    let last = ends(&gpu.read(&got.t)?, &gpu.read(&got.dt)?);
    table.close("strata", "ends", &shape, &gpu.upload(&last), &side(edges, n, true))
}
