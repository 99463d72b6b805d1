use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, wide};

#[test]
fn levels_grow_from_base_to_finest() {
    let g = HashGrid::new(HashGridConfig { levels: 16, features: 2, log2_size: 19, base: 16, finest: 2048 });
    assert_eq!((g.levels[0].cells, g.levels[15].cells), (16, 2048));
    assert!(g.levels[0].dense && !g.levels[15].dense);
}

#[test]
fn matches_the_reference_both_ways() {
    for c in cases::cases() {
        let (p, t, d) = (wide(&c.points), wide(&c.table), wide(&c.d));
        let mut out = vec![7.0; c.d.len()];
        cpu::forward(&c.grid, &c.points, &c.table, &mut out);
        assert_close("forward", &out, &reference::forward(&c.grid, &p, &t), 1e-4);
        let (dp, dt) = reference::backward(&c.grid, &p, &t, &d);
        let mut d_table = vec![0.0; c.table.len()];
        let mut touched = vec![0u8; c.table.len() / cpu::LINE];
        cpu::backward(&c.grid, &c.points, &c.d, &mut d_table, Some(&mut touched));
        assert_close("table", &d_table, &dt, 1e-4);
        for (i, line) in d_table.chunks(cpu::LINE).enumerate() {
            assert!(touched[i] == 1 || line.iter().all(|&g| g == 0.0), "line {i} has a gradient but no mark");
        }
        let mut d_points = vec![7.0; c.points.len()];
        cpu::backward_positions(&c.grid, &c.points, &c.table, &c.d, &mut d_points);
        assert_close("points", &d_points, &dp, 1e-4);
    }
}

#[test]
fn jacobian_matches_the_reference_both_ways() {
    for c in cases::cases() {
        let (p, t) = (wide(&c.points), wide(&c.table));
        let mut jac = vec![0.0; c.d_jacobian.len()];
        cpu::jacobian(&c.grid, &c.points, &c.table, &mut jac);
        assert_close("jacobian", &jac, &reference::jacobian(&c.grid, &p, &t), 1e-4);
        let mut dt = vec![0.0; c.table.len()];
        cpu::jacobian_backward(&c.grid, &c.points, &c.d_jacobian, &mut dt);
        assert_close("jacobian backward", &dt, &reference::jacobian_backward(&c.grid, &p, &wide(&c.d_jacobian)), 1e-4);
    }
}

#[test]
fn gradient_matches_the_reference_both_ways() {
    for c in cases::cases() {
        let (p, t, g, s) = (wide(&c.points), wide(&c.table), wide(&c.d), c.points.len() / 3);
        let (value, direction) = (random(s, 8), random(s * 3, 9));
        let mut out = vec![7.0; s * 3];
        cpu::gradient(&c.grid, &c.points, &c.table, &c.d, &mut out);
        assert_close("gradient", &out, &reference::backward(&c.grid, &p, &t, &g).0, 1e-4);
        let (want, mut want_table) = reference::gradient_backward(&c.grid, &p, &t, &g, &wide(&direction));
        let weighted: Vec<f64> = g.iter().enumerate().map(|(e, g)| g * value[e / c.grid.config.features % s] as f64).collect();
        want_table.iter_mut().zip(reference::backward(&c.grid, &p, &t, &weighted).1).for_each(|(a, b)| *a += b);
        let along = cpu::Along { value: &value, direction: &direction };
        for marks in [c.table.len() / cpu::LINE, 0] {
            let (mut grads, mut touched) = (vec![0.0; c.table.len()], vec![0u8; marks]);
            let to = cpu::TableGradient { grads: &mut grads, touched: &mut touched };
            cpu::gradient_backward(&c.grid, &c.points, &c.d, along, to);
            assert_close("table", &grads, &want_table, 1e-4);
            let lines = grads.chunks(cpu::LINE).zip(&touched);
            assert!(lines.into_iter().all(|(line, t)| *t == 1 || line.iter().all(|g| *g == 0.0)), "a line without a mark");
        }
        let mut got = vec![7.0; c.d.len()];
        cpu::derivatives(&c.grid, &c.points, &c.table, &direction, &mut got);
        assert_close("derivatives", &got, &want, 1e-4);
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
    let (g, d) = (wide(&random(2 * grid.output_dims(), 5)), wide(&random(6, 6)));
    let (d_g, d_table) = reference::gradient_backward(&grid, &p, &t, &g, &d);
    let loss = |t: &[f64], g: &[f64]| reference::backward(&grid, &p, t, g).0.iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
    assert_gradient("gradient to g", &d_g, &g, 1e-6, |x| loss(&t, x));
    assert_gradient("gradient to table", &d_table, &t, 1e-6, |x| loss(x, &g));
}
