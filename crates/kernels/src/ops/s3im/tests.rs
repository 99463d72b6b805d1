use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

/// Colors between 0 and 1.
fn colors(n: usize, seed: u64) -> Vec<f32> {
    random(n, seed).iter().map(|v| 0.5 + 0.4 * v.clamp(-1.0, 1.0)).collect()
}

fn tile(height: usize, width: usize) -> Tile {
    Tile { height, width }
}

#[test]
fn matches_the_reference_both_ways() {
    for (tile, tiles, m) in [(tile(4, 4), 1, 1), (tile(8, 8), 2, 3), (tile(9, 6), 1, 10), (tile(32, 32), 1, 2)] {
        let rays = tile.pixels() * tiles;
        let (x, y) = (colors(3 * rays, 1), colors(3 * rays, 2));
        let arranged = arrangements(rays, m, &Rng::new(3, 4), 5);
        let (want, want_d) = reference::loss(&wide(&x), &wide(&y), tile, &arranged);
        let mut d = vec![1.0; x.len()];
        let got = cpu::loss(&x, &y, tile, &arranged, 2.0, &mut d);
        assert_close("loss", &[got as f32], &[want], 1e-5);
        let want_d: Vec<f64> = want_d.iter().map(|d| 1.0 + 2.0 * d).collect();
        assert_close("d_colors", &d, &want_d, 1e-5);
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    let (x, y) = (wide(&colors(3 * 72, 6)), wide(&colors(3 * 72, 7)));
    let arranged = arrangements(72, 3, &Rng::new(8, 9), 0);
    let value = |x: &[f64]| reference::loss(x, &y, tile(6, 6), &arranged).0;
    assert_gradient("d_colors", &reference::loss(&x, &y, tile(6, 6), &arranged).1, &x, 1e-5, value);
}

#[test]
fn equal_colors_cost_nothing_and_flat_ones_what_the_formula_says() {
    let x = colors(3 * 64, 10);
    let arranged = arrangements(64, 4, &Rng::new(1, 2), 0);
    let mut d = vec![0.0; x.len()];
    assert!(cpu::loss(&x, &x, tile(8, 8), &arranged, 1.0, &mut d).abs() < 1e-9);
    assert!(d.iter().all(|d| d.abs() < 1e-6), "the gradient vanishes where nothing differs");
    // Two flat pictures in a tile of one window, of which the border takes weight: what is left is `w`.
    let (a, b) = (0.3, 0.8);
    let own: Vec<u32> = (0..16).collect();
    let (loss, _) = reference::loss(&[a; 48], &[b; 48], tile(4, 4), &own);
    let w: f64 = tile(4, 4).pixels_of(0, 0).map(|(_, g)| g).sum();
    let [sx, sy, sxy] = [a * a, b * b, a * b].map(|v| w * v - w * w * v);
    let expected = (2.0 * w * w * a * b + C1) * (2.0 * sxy + C2) / ((w * w * (a * a + b * b) + C1) * (sx + sy + C2));
    assert!((loss - (1.0 - expected)).abs() < 1e-12 && w < 0.9);
    // A window inside has all of its weights.
    assert!((tile(8, 8).pixels_of(1, 1).map(|(_, g)| g).sum::<f64>() - 1.0).abs() < 1e-12);
}

#[test]
fn arrangements_are_permutations_and_the_first_is_the_rays_own_order() {
    let rng = Rng::new(11, 12);
    let all = arrangements(50, ARRANGEMENTS, &rng, 7);
    let mut rows = all.chunks(50);
    assert_eq!(rows.next().unwrap(), (0..50).collect::<Vec<u32>>());
    for row in rows {
        let mut sorted = row.to_vec();
        sorted.sort_unstable();
        assert!(sorted == (0..50).collect::<Vec<u32>>() && sorted != row);
    }
    assert!(all[50..100] != all[100..150] && all == arrangements(50, ARRANGEMENTS, &rng, 7));
    // The next draw's numbers are others.
    assert!(all != arrangements(50, ARRANGEMENTS, &rng, 7 + draws(50, ARRANGEMENTS)));
}

#[test]
fn the_value_does_not_depend_on_threads_and_whole_tiles_are_needed() {
    let (x, y) = (colors(3 * 4096, 13), colors(3 * 4096, 14));
    let arranged = arrangements(4096, ARRANGEMENTS, &Rng::new(1, 1), 0);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut d = vec![0.0; x.len()];
        (pool.install(|| cpu::loss(&x, &y, tile(64, 64), &arranged, 1.0, &mut d)), d)
    };
    assert_eq!(run(1), run(4));
    let ragged = std::panic::catch_unwind(|| cpu::loss(&x[..60], &y[..60], tile(4, 4), &arranged[..20], 1.0, &mut vec![0.0; 60]));
    let narrow = std::panic::catch_unwind(|| cpu::loss(&x[..30], &y[..30], tile(2, 5), &arranged[..10], 1.0, &mut [0.0; 30]));
    assert!(ragged.is_err() && narrow.is_err());
}
