use super::cases::{Rays, rays, sparse_grid};
use super::*;
use diorama_geom::contraction::Space;
use diorama_testkit::random;

fn run(g: &OccupancyBits, r: &Rays, c: &MarchConfig) -> Marched {
    let mut out = Marched::default();
    cpu::march(g, &r.view(), c, &mut Default::default(), &mut out);
    out
}

#[test]
fn matches_the_reference_up_to_ties() {
    for cases::Case { grid, config, rays } in cases::cases() {
        cases::compare_rays(&run(&grid, &rays, &config), &reference::march(&grid, &rays.view(), &config)).unwrap();
    }
}

#[test]
fn other_samples_are_told() {
    let c = &cases::cases()[2];
    let want = reference::march(&c.grid, &c.rays.view(), &c.config);
    let mut off = Marched { t: want.t.iter().map(|t| t + 1e-3).collect(), ..want.clone() };
    assert!(cases::compare_rays(&off, &want).is_err());
    off.t.clone_from(&want.t);
    assert_eq!(cases::compare_rays(&off, &want), Ok(0.0));
    off.dt.iter_mut().for_each(|dt| *dt *= 1.001);
    assert!(cases::compare_rays(&off, &want).is_err());
    off.dt.clone_from(&want.dt);
    off.cells.iter_mut().for_each(|c| *c += 1);
    assert!(cases::compare_rays(&off, &want).is_err());
}

#[cfg(feature = "gpu")]
#[test]
fn other_places_are_told() {
    let c = &cases::cases()[2];
    let (samples, mut places) = (reference::march(&c.grid, &c.rays.view(), &c.config), Vec::new());
    cpu::positions(&c.rays.view(), &samples, &mut places);
    assert_eq!(cases::compare_places(&samples, &c.rays, &places), Ok(0.0));
    places[7] += 1e-2;
    assert!(cases::compare_places(&samples, &c.rays, &places).is_err());
}

#[test]
fn a_full_grid_covers_the_ray_without_gaps_and_an_empty_one_not_at_all() {
    let r = rays(50, 0.5);
    let c = MarchConfig { cone: 0.0, dt_min: 0.01, dt_max: 0.01, max_samples: 10_000, ..MarchConfig::default() };
    let mut g = OccupancyBits::full(16, 3);
    let out = run(&g, &r, &c);
    for i in 0..50 {
        let span = out.offsets[i] as usize..out.offsets[i + 1] as usize;
        for k in span.start + 1..span.end {
            assert!((out.t[k] - out.t[k - 1] - out.dt[k - 1]).abs() < 1e-5);
        }
    }
    g.fill_with(|_| false);
    assert_eq!(run(&g, &r, &c).t.len(), 0);
}

#[test]
fn samples_lie_in_occupied_cells_and_respect_the_limit() {
    let (g, r) = (sparse_grid(1), rays(100, 0.9));
    let c = MarchConfig { cone: 0.0, dt_min: 0.004, dt_max: 0.004, max_samples: 7, ..MarchConfig::default() };
    let out = run(&g, &r, &c);
    let mut x = Vec::new();
    cpu::positions(&r.view(), &out, &mut x);
    for p in x.chunks_exact(3) {
        let cell: Vec<usize> = p.iter().map(|v| ((v * 16.0) as usize).min(15)).collect();
        assert!(g.get((cell[2] * 16 + cell[1]) * 16 + cell[0]), "{p:?}");
    }
    assert!(out.offsets.windows(2).all(|w| w[1] - w[0] <= 7));
}

#[test]
fn unbounded_rays_are_sampled_to_their_end_evenly_in_disparity() {
    let mut r = rays(40, 0.5);
    r.near_far.iter_mut().skip(1).step_by(2).for_each(|far| *far = 1000.0);
    let c = MarchConfig { cone: 1.0 / 128.0, dt_min: 0.001, dt_max: 1e6, disparity_from: 1.0, unbounded: true, max_samples: 10_000 };
    let mut g = OccupancyBits::full(16, 3);
    g.fill_with(|_| false);
    let out = run(&g, &r, &c);
    for w in out.offsets.windows(2) {
        let last = w[1] as usize - 1;
        let (first, end) = (out.t[w[0] as usize], out.t[last] + out.dt[last]);
        assert!(first > 1.0 && first < 8.0, "the cascades are empty, what lies beyond is not: {first}");
        assert!(end >= 1000.0, "{end}");
        for i in w[0] as usize..last {
            // 1/t − 1/(t + δ) = cone / (1 + cone t), next to constant.
            let step = 1.0 / out.t[i] - 1.0 / out.t[i + 1];
            let want = c.cone / (1.0 + c.cone * out.t[i]);
            assert!((step - want).abs() < 1e-3 * want, "{step} {want}");
        }
        assert!(w[1] - w[0] < 128, "{} samples", w[1] - w[0]);
    }
}

#[test]
fn missing_rays_get_no_samples() {
    let mut r = rays(3, 0.5);
    r.near_far = vec![1.0, 0.5, 0.0, 1.0, 2.0, 2.0];
    let c = MarchConfig { cone: 0.0, dt_min: 0.01, dt_max: 0.01, max_samples: 100, ..MarchConfig::default() };
    let out = run(&OccupancyBits::full(16, 1), &r, &c);
    assert!(out.offsets[1] == 0 && out.offsets[2] > 0 && out.offsets[3] == out.offsets[2]);
}

#[test]
fn empty_blocks_are_crossed_at_once_and_nothing_behind_them_is_missed() {
    // A shell of single cells around much emptiness.
    let mut g = OccupancyBits::full(32, 2);
    g.fill_with(|i| i % 32 == 29 || i / 32 % 32 == 2);
    assert!((0..4).any(|x| g.is_block_empty(0, [x * 8, 16, 16])) && !g.is_block_empty(0, [29, 16, 16]));
    let r = rays(400, 1.0);
    let c = MarchConfig { cone: 0.0, dt_min: 0.003, dt_max: 0.003, max_samples: 1000, ..MarchConfig::default() };
    let (got, want) = (run(&g, &r, &c), reference::march(&g, &r.view(), &c));
    let length = |m: &Marched, i: usize| m.dt[m.offsets[i] as usize..m.offsets[i + 1] as usize].iter().sum::<f32>();
    let mut met = 0;
    for i in 0..400 {
        // Where a ray enters a cell may differ by a step's jitter, how much of it is covered may not.
        let (a, b) = (length(&got, i), length(&want, i));
        assert!((a - b).abs() <= 0.01, "ray {i}: {a} {b}");
        met += (b > 0.1) as usize;
    }
    assert!(met > 100);
}

#[test]
fn a_coarser_cascade_holds_what_the_finer_one_holds() {
    let mut g = OccupancyBits::full(16, 2);
    let at = |c: usize, x: usize, y: usize, z: usize| ((c * 16 + z) * 16 + y) * 16 + x;
    g.fill_with(|i| i == at(0, 5, 8, 15));
    let occupied: Vec<usize> = (0..g.cells()).filter(|i| g.get(*i)).collect();
    assert_eq!(occupied, [at(0, 5, 8, 15), at(1, 4 + 2, 4 + 4, 4 + 7)]);
}

#[test]
fn rays_that_go_on_take_the_samples_of_one_march() {
    let c = MarchConfig { cone: 1.0 / 256.0, dt_min: 0.005, dt_max: 0.08, max_samples: 200, ..MarchConfig::default() };
    let (g, r) = (sparse_grid(2), rays(60, 1.0));
    let whole = run(&g, &r, &c);
    let mut near_far = r.near_far.clone();
    let mut most = 0;
    for i in 0..60 {
        let mut parts = Marched::default();
        loop {
            let before = parts.t.len();
            let own = MarchRays { near_far: &near_far, resumed: before > 0, ..r.view() };
            cpu::march_ray(&g, &own, i, &MarchConfig { max_samples: 7, ..c }, &mut parts);
            if parts.t.len() < before + 7 || parts.t.len() >= c.max_samples {
                break;
            }
            near_far[i * 2] = parts.t[parts.t.len() - 1] + parts.dt[parts.dt.len() - 1];
        }
        most = most.max(parts.t.len());
        let own = whole.offsets[i] as usize..whole.offsets[i + 1] as usize;
        assert_eq!((&parts.t[..own.len()], parts.t.len() - own.len() < 7), (&whole.t[own.clone()], true), "ray {i}");
    }
    assert!(most > 30, "{most}");
}

#[test]
fn points_are_normalized_as_space_says() {
    let far: Vec<f32> = random(3 * 50, 4).iter().map(|v| 0.5 + 3.0 * v * v * v).collect();
    for space in [Space::Cube(2.0), Space::Contracted(1.0), Space::Contracted(2.0)] {
        let mut points = [0, 1, 2].map(|k| far.iter().skip(k).step_by(3).copied().collect::<Vec<f32>>());
        cpu::normalize(space, &mut points);
        for (i, p) in far.chunks_exact(3).enumerate() {
            let want = space.normalize([p[0] - 0.5, p[1] - 0.5, p[2] - 0.5]);
            for k in 0..3 {
                assert!((points[k][i] - 0.5 - want[k]).abs() < 1e-6, "{space:?} {p:?}");
            }
        }
    }
}

#[test]
fn positions_pass_their_gradients_to_origins_and_directions() {
    let (g, r) = (sparse_grid(1), rays(9, 0.9));
    let c = MarchConfig { cone: 0.0, dt_min: 0.01, dt_max: 0.01, max_samples: 30, ..MarchConfig::default() };
    let samples = run(&g, &r, &c);
    assert!(!samples.t.is_empty());
    let d = diorama_testkit::random(samples.t.len() * 3, 5);
    let (mut d_origins, mut d_dirs) = (vec![9.0; 27], vec![9.0; 27]);
    cpu::positions_backward(&samples, &d, &mut d_origins, &mut d_dirs);
    // Positions are linear in both, so that any step shows the slope.
    let value = |r: &MarchRays| {
        let mut x = Vec::new();
        cpu::positions(r, &samples, &mut x);
        x.iter().zip(&d).map(|(x, d)| (x * d) as f64).sum::<f64>()
    };
    let view = r.view();
    for i in 0..27 {
        let moved = |v: &[f32], by: f32| v.iter().enumerate().map(|(k, x)| if k == i { x + by } else { *x }).collect::<Vec<f32>>();
        let of_origin = |by: f32| value(&MarchRays { origins: &moved(view.origins, by), ..r.view() });
        let of_dir = |by: f32| value(&MarchRays { dirs: &moved(view.dirs, by), ..r.view() });
        for (got, want) in [(d_origins[i], of_origin(0.5) - of_origin(-0.5)), (d_dirs[i], of_dir(0.5) - of_dir(-0.5))] {
            assert!((got as f64 - want).abs() < 1e-3 * (1.0 + want.abs()), "{i}: {got} {want}");
        }
    }
}
