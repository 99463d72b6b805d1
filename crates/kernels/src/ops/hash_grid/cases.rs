//! Cases of the op, for its tests and for `bench check`.

use super::{HashGrid, HashGridConfig};
#[cfg(feature = "gpu")]
use super::{gpu::GpuHashGrid, reference};
#[cfg(feature = "gpu")]
use crate::gpu::table::{Table, adders};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, Rows};
#[cfg(feature = "gpu")]
use diorama_testkit::wide;
use diorama_testkit::{random, random_unit};

/// Points, a table, and gradients of the features and of their Jacobian.
pub struct Case {
    pub grid: HashGrid,
    pub points: Vec<f32>,
    pub table: Vec<f32>,
    pub d: Vec<f32>,
    pub d_jacobian: Vec<f32>,
}

/// Points inside, on the border and outside of the cube.
fn points(s: usize) -> Vec<f32> {
    let mut p = random_unit(s * 3, 11);
    if s > 3 {
        p[..9].copy_from_slice(&[0.0, 1.0, 0.5, -0.3, 0.4, 1.7, 1.0, 1.0, 1.0]);
    }
    p
}

pub fn cases() -> Vec<Case> {
    let of = |(features, s): (usize, usize)| {
        let grid = HashGrid::new(HashGridConfig { levels: 4, features, log2_size: 9, base: 3, finest: 40 });
        let n = s * grid.output_dims();
        Case { points: points(s), table: random(grid.params_len(), 2), d: random(n, 3), d_jacobian: random(n * 3, 5), grid }
    };
    [1, 2, 4, 8].into_iter().flat_map(|features| [0, 1, 16, 67, 1000].map(|s| (features, s))).map(of).collect()
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for c in cases() {
        let (on_gpu, s) = (GpuHashGrid::new(gpu, &c.grid), c.points.len() / 3);
        let (t, p) = (gpu.upload(&c.table), gpu.upload(&c.points));
        let (d, dj) = (gpu.upload(&c.d), gpu.upload(&c.d_jacobian));
        let (rows, shape) = (Rows::all(gpu, s), format!("S={s} L=4 F={}", c.grid.config.features));
        let (pw, tw) = (wide(&c.points), wide(&c.table));
        let want = reference::forward(&c.grid, &pw, &tw);
        table.close("hash grid", "forward", &shape, &on_gpu.forward(gpu, &rows, &p, &t), &want)?;
        let (dp, dt) = reference::backward(&c.grid, &pw, &tw, &wide(&c.d));
        table.close("hash grid", "d points", &shape, &on_gpu.backward_positions(gpu, &rows, &p, &t, &d), &dp)?;
        let jacobian = reference::jacobian(&c.grid, &pw, &tw);
        table.close("hash grid", "jacobian", &shape, &on_gpu.jacobian(gpu, &rows, &p, &t), &jacobian)?;
        let djt = reference::jacobian_backward(&c.grid, &pw, &wide(&c.d_jacobian));
        let pairs = (c.grid.config.features == 2 && gpu.has_pair_atomics()).then(|| ("d table, pairs", gpu.clone()));
        for (name, adder) in pairs.into_iter().chain(adders(gpu)) {
            let (sum, sum_j) = (gpu.zeros(c.grid.params_len()), gpu.zeros(c.grid.params_len()));
            on_gpu.backward(&adder, &rows, &p, &d, &sum);
            table.close("hash grid", name, &shape, &sum, &dt)?;
            on_gpu.jacobian_backward(&adder, &rows, &p, &dj, &sum_j);
            table.close("hash grid jacobian", name, &shape, &sum_j, &djt)?;
        }
    }
    Ok(())
}
