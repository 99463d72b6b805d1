use super::*;
use diorama_testkit::{assert_close, random, wide};

#[test]
fn matches_the_reference() {
    for n in [0, 1, 500] {
        let (o, mut d) = (random(n * 3, 1).iter().map(|v| v * 3.0).collect::<Vec<f32>>(), random(n * 3, 2));
        if n > 2 {
            d[..3].copy_from_slice(&[0.0, 0.0, 1.0]);
            d[3..6].copy_from_slice(&[0.0, -1.0, 0.0]);
        }
        let mut out = vec![9.0; n * 2];
        cpu::intersect(&o, &d, [-1.0; 3], [1.0, 1.5, 0.5], 0.05, &mut out);
        let want = reference::intersect(&wide(&o), &wide(&d), [-1.0; 3], [1.0, 1.5, 0.5], 0.05f32 as f64);
        assert_close("near far", &out, &want, 1e-4);
    }
}

#[test]
fn a_ray_from_inside_starts_at_the_near_plane() {
    let mut out = [0.0; 2];
    cpu::intersect(&[0.0; 3], &[1.0, 0.0, 0.0], [-1.0; 3], [1.0; 3], 0.1, &mut out);
    assert_eq!(out, [0.1, 1.0]);
}
