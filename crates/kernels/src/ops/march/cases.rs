//! Cases of the op, for its tests and for `bench check`.

use super::{MarchConfig, MarchRays, Marched, OccupancyBits, Space};
#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
use crate::ops::composite::cases::{Scene, scene};
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Gpu, GpuError, table::Table},
    ops::composite::gpu::GpuPacked,
};
#[cfg(feature = "gpu")]
use diorama_testkit::wide;
use diorama_testkit::{random, random_unit};

/// Rays in and around the model cube with unit directions.
pub struct Rays {
    pub origins: Vec<f32>,
    pub dirs: Vec<f32>,
    pub near_far: Vec<f32>,
    pub jitter: Vec<f32>,
}

/// `n` rays that begin in the cube of edge `half` around the center.
pub fn rays(n: usize, half: f32) -> Rays {
    let mut dirs = random(n * 3, 2);
    for d in dirs.chunks_exact_mut(3) {
        let l = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        d.iter_mut().for_each(|v| *v /= l);
    }
    let origins = random_unit(n * 3, 1).iter().map(|v| 0.5 + (v - 0.5) * half).collect();
    Rays { origins, dirs, near_far: (0..n).flat_map(|_| [0.05, 3.0]).collect(), jitter: random_unit(n, 3) }
}

impl Rays {
    pub fn view(&self) -> MarchRays<'_> {
        MarchRays { origins: &self.origins, dirs: &self.dirs, near_far: &self.near_far, jitter: &self.jitter, resumed: false }
    }
}

/// Three of ten cells are occupied, and some blocks hold none.
pub fn sparse_grid(cascades: usize) -> OccupancyBits {
    let mut g = OccupancyBits::full(16, cascades);
    let u = random_unit(g.cells(), 9);
    g.fill_with(|i| u[i] < 0.3 && i / 64 % 3 != 0);
    g
}

/// Rays through a grid.
pub struct Case {
    pub grid: OccupancyBits,
    pub config: MarchConfig,
    pub rays: Rays,
}

pub fn cases() -> Vec<Case> {
    let bounded = MarchConfig { dt_min: 0.005, dt_max: 0.08, max_samples: 200, ..MarchConfig::default() };
    let growing = MarchConfig { cone: 1.0 / 256.0, ..bounded };
    let unbounded = MarchConfig { dt_max: 1e6, disparity_from: 0.7, unbounded: true, max_samples: 600, ..growing };
    let of = |(cascades, config, n): (usize, MarchConfig, usize)| {
        let mut rays = rays(n, 1.0);
        if config.unbounded {
            rays.near_far.iter_mut().skip(1).step_by(2).for_each(|far| *far = 1000.0);
        }
        Case { grid: sparse_grid(cascades), config, rays }
    };
    let all = [(1, bounded), (3, growing), (3, unbounded)];
    all.into_iter().flat_map(|(cascades, config)| [0, 1, 300].map(|n| (cascades, config, n))).map(of).collect()
}

/// Fails if the samples of too many rays differ. A sample whose midpoint lies on a cell wall may fall to either side: no more than one
/// ray in fifty may differ.
pub fn compare_rays(got: &Marched, want: &Marched) -> Result<f64, String> {
    let n = want.offsets.len() - 1;
    if got.offsets.len() != n + 1 {
        return Err(format!("{} offsets of {n} rays", got.offsets.len()));
    }
    let mut ties = 0;
    for i in 0..n {
        let a = got.offsets[i] as usize..got.offsets[i + 1] as usize;
        let b = want.offsets[i] as usize..want.offsets[i + 1] as usize;
        let same = a.end <= got.t.len()
            && a.len() == b.len()
            && a.zip(b).all(|(a, b)| {
                let [starts, lengths] =
                    [(got.t[a], want.t[b], 1.0), (got.dt[a], want.dt[b], 0.0)].map(|(a, b, least)| (a - b).abs() <= 1e-4 * b.max(least));
                starts && lengths && got.cells[a] == want.cells[b]
            });
        ties += !same as usize;
    }
    if ties * 50 <= n { Ok(0.0) } else { Err(format!("{ties} of {n} rays differ")) }
}

/// Coordinates in which positions are compared.
pub const SPACES: [Space; 5] =
    [Space::Model, Space::Cube(4.0), Space::Centered(4.0), Space::Contracted(1.5), Space::ContractedCentered(1.5)];

/// Samples of rays that begin in and around the model cube, and gradients of their positions.
pub struct Places {
    pub rays: Rays,
    pub scene: Scene,
    pub d: Vec<f32>,
}

pub fn places() -> [Places; 3] {
    [0, 1, 80].map(|n| {
        let scene = scene(n, 3);
        Places { rays: rays(n, 1.0), d: random(scene.t.len() * 3, 6), scene }
    })
}

#[cfg(feature = "gpu")]
fn check_positions(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for Places { rays, scene, d } in places() {
        let (r, p) = (rays.view(), scene.packed());
        let (on, packed, d_gpu) = (on_gpu::GpuRays::upload(gpu, &r), GpuPacked::upload(gpu, &p), gpu.upload(&d));
        let model = on_gpu::positions(gpu, &on, &packed, Space::Model);
        for space in SPACES {
            let (shape, want) = (format!("R={} {space:?}", p.rays()), reference::positions(&r, &p, space));
            table.close("positions", "forward", &shape, &on_gpu::positions(gpu, &on, &packed, space), &want)?;
            table.close("positions", "points", &shape, &on_gpu::to_space(gpu, &model, space), &want)?;
            let (d_origins, d_dirs) = on_gpu::positions_backward(gpu, &on, &packed, &d_gpu, space);
            let (want_origins, want_dirs) = reference::positions_backward(&r, &p, space, &wide(&d));
            table.close("positions", "d origins", &shape, &d_origins, &want_origins)?;
            table.close("positions", "d directions", &shape, &d_dirs, &want_dirs)?;
        }
    }
    Ok(())
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    check_positions(gpu, table)?;
    for Case { grid, config, rays } in cases() {
        let (r, n) = (rays.view(), rays.jitter.len());
        let shape = format!("R={n} cascades={} unbounded={}", grid.cascades, config.unbounded);
        let want = reference::march(&grid, &r, &config);
        let (on, occupancy) = (on_gpu::GpuRays::upload(gpu, &r), on_gpu::GpuOccupancy::upload(gpu, &grid));
        let capacity = want.t.len() + 500;
        let marched = on_gpu::march(gpu, &occupancy, &on, &config, capacity);
        let packed = &marched.packed;
        let got = Marched {
            offsets: gpu.read(&packed.offsets)?,
            t: gpu.read(&packed.t)?,
            dt: gpu.read(&packed.dt)?,
            cells: gpu.read(&marched.cells)?,
        };
        table.row("march", "samples", shape.clone(), compare_rays(&got, &want));
        let places = gpu.read(&on_gpu::positions(gpu, &on, packed, Space::Model))?;
        table.row("march", "positions", shape.clone(), compare_places(&got, &rays, &places));
        // With room for half of them, offsets must stop there and what fits must be the same.
        let half = capacity / 2;
        let marched = on_gpu::march(gpu, &occupancy, &on, &config, half);
        let packed = &marched.packed;
        let cut: Vec<u32> = got.offsets.iter().skip(1).map(|o| (*o > half as u32) as u32).collect();
        table.equal("march", "rays cut", &shape, &marched.cut, &cut)?;
        let bounded: Vec<u32> = got.offsets.iter().map(|o| (*o).min(half as u32)).collect();
        table.equal("march", "bounded offsets", &shape, &packed.offsets, &bounded)?;
        // Rays without light, or that took fewer samples than the first one, as do those that were cut, end.
        let light: Vec<f32> = (0..n).map(|r| if r % 2 == 0 { 0.9 } else { 0.5 }).collect();
        let (size, t, dt) = (bounded.get(1).map_or(1, |end| *end as usize), gpu.read(&packed.t)?, gpu.read(&packed.dt)?);
        let near_far = (0..n).flat_map(|r| {
            let (first, last) = (bounded[r] as usize, bounded[r + 1] as usize);
            let far = rays.near_far[2 * r + 1];
            let near = if last - first == size && light[r] >= 0.9 { t[last - 1] + dt[last - 1] } else { far };
            [near as f64, far as f64]
        });
        let left = on_gpu::go_on(gpu, &on, &marched, &gpu.upload(&light), 0.9, size);
        table.close("march", "rays that go on", &shape, &left.near_far, &near_far.collect::<Vec<_>>())?;
        let kept = *bounded.last().expect("R + 1 offsets") as usize;
        let same = gpu.read(&packed.t)?[..kept] == got.t[..kept];
        let outcome = if same { Ok(0.0) } else { Err("other samples than with room for all".into()) };
        table.row("march", "bounded samples", shape, outcome);
    }
    Ok(())
}

/// Fails unless samples are placed at the middles of their intervals.
#[cfg(feature = "gpu")]
pub fn compare_places(got: &Marched, rays: &Rays, places: &[f32]) -> Result<f64, String> {
    for r in 0..rays.jitter.len() {
        for i in got.offsets[r] as usize..got.offsets[r + 1] as usize {
            let mid = got.t[i] + 0.5 * got.dt[i];
            let off = |k: usize| (places[i * 3 + k] - (rays.origins[r * 3 + k] + mid * rays.dirs[r * 3 + k])).abs();
            if (0..3).any(|k| off(k) >= 1e-4 * mid.max(1.0)) {
                return Err(format!("sample {i} of ray {r} lies elsewhere"));
            }
        }
    }
    Ok(0.0)
}
