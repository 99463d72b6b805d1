//! Cases of the op, for its tests and for `bench check`.

use super::Corners;
#[cfg(feature = "gpu")]
use super::{gpu::GpuCorners, reference};
#[cfg(feature = "gpu")]
use crate::gpu::table::{Table, adders};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError};
#[cfg(feature = "gpu")]
use diorama_testkit::wide;
use diorama_testkit::{random, random_unit};

/// Rows of the table, and voxels that share them.
const ROWS: usize = 50;
const VOXELS: usize = 20;

/// Places in voxels, a table of `c` channels, and gradients of the features.
pub struct Case {
    pub c: usize,
    rows: Vec<u32>,
    voxel: Vec<u32>,
    pub local: Vec<f32>,
    pub table: Vec<f32>,
    pub d: Vec<f32>,
}

impl Case {
    pub fn corners(&self) -> Corners<'_> {
        Corners { rows: &self.rows, voxel: &self.voxel }
    }
}

pub fn cases() -> Vec<Case> {
    let below = |n: usize, limit: usize, seed| random_unit(n, seed).iter().map(|v| (v * limit as f32) as u32).collect();
    let of = |(s, c): (usize, usize)| Case {
        c,
        rows: below(VOXELS * 8, ROWS, 2),
        voxel: below(s, VOXELS, 1),
        local: random_unit(s * 3, 3),
        table: random(ROWS * c, 4),
        d: random(s * c, 5),
    };
    [(0, 4), (1, 1), (301, 7), (300, 24)].map(of).into()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for case in cases() {
        let (k, c) = (case.corners(), case.c);
        let (on_gpu, lg, vg, dg) = (GpuCorners::upload(gpu, &k), gpu.upload(&case.local), gpu.upload(&case.table), gpu.upload(&case.d));
        let shape = format!("S={} C={c}", k.voxel.len());
        let want = reference::forward(&k, &wide(&case.local), &wide(&case.table), c);
        table.close("corner grid", "forward", &shape, &on_gpu.forward(gpu, &lg, &vg, c), &want)?;
        let (dl, dt) = reference::backward(&k, &wide(&case.local), &wide(&case.table), c, &wide(&case.d));
        for (name, adder) in adders(gpu) {
            let sum = gpu.zeros(ROWS * c);
            table.close("corner grid", "d places", &shape, &on_gpu.backward(&adder, &lg, &vg, c, &dg, &sum), &dl)?;
            table.close("corner grid", name, &shape, &sum, &dt)?;
        }
    }
    Ok(())
}
