use super::*;
use diorama_testkit::{assert_close, wide};

#[test]
fn matches_the_reference() {
    for cases::Case { origins, dirs } in cases::cases() {
        let mut out = vec![9.0; origins.len() / 3 * 2];
        cpu::intersect(&origins, &dirs, cases::MIN, cases::MAX, cases::NEAR, &mut out);
        let (min, max) = (cases::MIN.map(f64::from), cases::MAX.map(f64::from));
        let want = reference::intersect(&wide(&origins), &wide(&dirs), min, max, cases::NEAR as f64);
        assert_close("near far", &out, &want, 1e-4);
    }
}

#[test]
fn a_ray_from_inside_starts_at_the_near_plane() {
    let mut out = [0.0; 2];
    cpu::intersect(&[0.0; 3], &[1.0, 0.0, 0.0], [-1.0; 3], [1.0; 3], 0.1, &mut out);
    assert_eq!(out, [0.1, 1.0]);
}
