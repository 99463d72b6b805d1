//! Cases of the op, for its tests and for `bench check`.

use super::Corners;
#[cfg(feature = "gpu")]
use super::gpu::{GpuCorners, GpuVoxels, keep_empty};
#[cfg(feature = "gpu")]
use super::reference;
#[cfg(feature = "gpu")]
use crate::gpu::table::{Table, adders};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, Rows};
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
            on_gpu.table_backward(&adder, &lg, c, &dg, &sum);
            table.close("corner grid", name, &shape, &sum, &dt)?;
        }
        table.close(
            "corner grid",
            "d places",
            &shape,
            &on_gpu.places_backward(gpu, &lg, &vg, c, &dg, 0.25),
            &dl.iter().map(|d| 4.0 * d).collect::<Vec<_>>(),
        )?;
        if !case.d.is_empty() {
            keep_empty(gpu, c, &dg);
            let kept: Vec<f64> = case.d.iter().enumerate().map(|(i, d)| if i < c { 0.0 } else { *d as f64 }).collect();
            table.close("corner grid", "what is empty", &shape, &dg, &kept)?;
        }
    }
    locating(gpu, table)
}

/// Points in the middle of their voxels' thirds, of which the last ones are not live.
#[cfg(feature = "gpu")]
fn locating(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    const LIVE: usize = 200;
    for n in [2usize, 5] {
        let cells: Vec<u32> = (0..n.pow(3) as u32).map(|i| i % 7).collect();
        let voxels = GpuVoxels::upload(gpu, n, &cells, &[0; 56]);
        let thirds = |u: &f32| ((u * 3.0 * n as f32).floor() + 0.5) / (3.0 * n as f32);
        let points: Vec<f32> = random_unit(300 * 3, 6).iter().map(thirds).collect();
        let rows = Rows::counted(300, &gpu.upload(&[LIVE as u32]), 0);
        let (corners, local) = voxels.locate(gpu, &rows, &gpu.upload(&points));
        let (mut voxel, mut places) = (vec![0; 300], vec![0.0; 900]);
        for s in 0..LIVE {
            let scaled = [0, 1, 2].map(|k| points[s * 3 + k] as f64 * n as f64);
            let [x, y, z] = scaled.map(|v| v as usize);
            voxel[s] = cells[(z * n + y) * n + x];
            (0..3).for_each(|k| places[s * 3 + k] = scaled[k].fract());
        }
        let shape = format!("{n}³ voxels, {LIVE} of 300");
        table.equal("corner grid", "voxels", &shape, &corners.voxel, &voxel)?;
        table.close("corner grid", "places", &shape, &local, &places)?;
    }
    Ok(())
}
