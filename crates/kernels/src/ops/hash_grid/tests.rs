use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, random_unit, wide};

fn grids() -> Vec<HashGrid> {
    [1, 2, 4, 8]
        .into_iter()
        .map(|features| HashGrid::new(HashGridConfig { levels: 4, features, log2_size: 9, base: 3, finest: 40 }))
        .collect()
}

/// Points inside, on the border and outside of the cube.
fn points(s: usize) -> Vec<f32> {
    let mut p = random_unit(s * 3, 11);
    if s > 3 {
        p[..9].copy_from_slice(&[0.0, 1.0, 0.5, -0.3, 0.4, 1.7, 1.0, 1.0, 1.0]);
    }
    p
}

#[test]
fn levels_grow_from_base_to_finest() {
    let g = HashGrid::new(HashGridConfig { levels: 16, features: 2, log2_size: 19, base: 16, finest: 2048 });
    assert_eq!((g.levels[0].cells, g.levels[15].cells), (16, 2048));
    assert!(g.levels[0].dense && !g.levels[15].dense);
}

#[test]
fn matches_the_reference_both_ways() {
    for grid in grids() {
        for s in [0, 1, 5, 16, 67] {
            let (p, t) = (points(s), random(grid.params_len(), 2));
            let d = random(s * grid.output_dims(), 3);
            let mut out = vec![7.0; s * grid.output_dims()];
            cpu::forward(&grid, &p, &t, &mut out);
            assert_close("forward", &out, &reference::forward(&grid, &wide(&p), &wide(&t)), 1e-4);
            let (dp, dt) = reference::backward(&grid, &wide(&p), &wide(&t), &wide(&d));
            let mut d_table = vec![0.0; grid.params_len()];
            let mut touched = vec![0u8; grid.params_len() / cpu::LINE];
            cpu::backward(&grid, &p, &d, &mut d_table, Some(&mut touched));
            assert_close("table", &d_table, &dt, 1e-4);
            for (i, line) in d_table.chunks(cpu::LINE).enumerate() {
                assert!(touched[i] == 1 || line.iter().all(|&g| g == 0.0), "line {i} has a gradient but no mark");
            }
            let mut d_points = vec![7.0; s * 3];
            cpu::backward_positions(&grid, &p, &t, &d, &mut d_points);
            assert_close("points", &d_points, &dp, 1e-4);
        }
    }
}

#[test]
fn jacobian_matches_the_reference_both_ways() {
    for grid in grids() {
        let (p, t) = (points(33), random(grid.params_len(), 2));
        let n = 33 * grid.output_dims() * 3;
        let mut jac = vec![0.0; n];
        cpu::jacobian(&grid, &p, &t, &mut jac);
        assert_close("jacobian", &jac, &reference::jacobian(&grid, &wide(&p), &wide(&t)), 1e-4);
        let d = random(n, 5);
        let mut dt = vec![0.0; grid.params_len()];
        cpu::jacobian_backward(&grid, &p, &d, &mut dt);
        assert_close("jacobian backward", &dt, &reference::jacobian_backward(&grid, &wide(&p), &wide(&d)), 1e-4);
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let grid = HashGrid::new(HashGridConfig { levels: 2, features: 2, log2_size: 6, base: 2, finest: 7 });
    let p = vec![0.31, 0.62, 0.77, 0.12, 0.55, 0.41];
    let (t, d) = (wide(&random(grid.params_len(), 1)), wide(&random(2 * grid.output_dims(), 2)));
    let (dp, dt) = reference::backward(&grid, &p, &t, &d);
    let loss = |p: &[f64], t: &[f64]| reference::forward(&grid, p, t).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
    assert_gradient("points", &dp, &p, 1e-6, |x| loss(x, &t));
    assert_gradient("table", &dt, &t, 1e-6, |x| loss(&p, x));
    let dj = wide(&random(6 * grid.output_dims(), 4));
    let g = reference::jacobian_backward(&grid, &p, &dj);
    assert_gradient("jacobian", &g, &t, 1e-6, |x| reference::jacobian(&grid, &p, x).iter().zip(&dj).map(|(a, b)| a * b).sum());
}
