use super::*;
use diorama_testkit::{assert_close, assert_gradient, random, random_unit, wide};

/// Two voxels that share a face: twelve corners.
const ROWS: [u32; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 1, 8, 3, 9, 5, 10, 7, 11];

fn voxels(s: usize) -> Vec<u32> {
    (0..s as u32).map(|i| i % 2).collect()
}

#[test]
fn matches_the_reference_both_ways() {
    for case in cases::cases() {
        let (k, c) = (case.corners(), case.c);
        let mut out = vec![9.0; case.d.len()];
        cpu::forward(&k, &case.local, &case.table, c, &mut out);
        let (u, t) = (wide(&case.local), wide(&case.table));
        assert_close("forward", &out, &reference::forward(&k, &u, &t, c), 1e-5);
        let (mut du, mut dt) = (vec![9.0; case.local.len()], vec![0.0; case.table.len()]);
        cpu::backward(&k, &case.local, &case.table, c, &case.d, &mut du, &mut dt);
        let (ru, rt) = reference::backward(&k, &u, &t, c, &wide(&case.d));
        assert_close("positions", &du, &ru, 1e-4);
        assert_close("table", &dt, &rt, 1e-4);
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    let voxel = voxels(3);
    let k = Corners { rows: &ROWS, voxel: &voxel };
    let (u, t, d) = (wide(&random_unit(9, 1)), wide(&random(24, 2)), wide(&random(6, 3)));
    let (du, dt) = reference::backward(&k, &u, &t, 2, &d);
    let loss = |u: &[f64], t: &[f64]| reference::forward(&k, u, t, 2).iter().zip(&d).map(|(a, b)| a * b).sum::<f64>();
    assert_gradient("positions", &du, &u, 1e-6, |x| loss(x, &t));
    assert_gradient("table", &dt, &t, 1e-6, |x| loss(&u, x));
}

#[test]
fn features_are_continuous_across_a_shared_face() {
    let t = random(12, 4);
    let at = |voxel: u32, u: [f32; 3]| {
        let mut out = [0.0];
        cpu::forward(&Corners { rows: &ROWS, voxel: &[voxel] }, &u, &t, 1, &mut out);
        out[0]
    };
    assert!((at(0, [1.0, 0.3, 0.6]) - at(1, [0.0, 0.3, 0.6])).abs() < 1e-6);
}
