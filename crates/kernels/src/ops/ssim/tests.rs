use super::*;
use diorama_testkit::{assert_close, assert_gradient, random_unit, wide};

#[test]
fn matches_the_reference_both_ways() {
    for cases::Case { size: (w, h, c), x, y } in cases::cases() {
        let want = reference::ssim(w, h, c, &wide(&x), &wide(&y));
        if want.is_nan() {
            assert!(cpu::ssim(w, h, c, &x, &y).is_nan());
            continue;
        }
        assert_close("ssim", &[cpu::ssim(w, h, c, &x, &y) as f32], &[want], 1e-5);
        assert_close("gradient", &cpu::gradient(w, h, c, &x, &y), &reference::gradient(w, h, c, &wide(&x), &wide(&y)), 1e-4);
    }
}

#[test]
fn reference_gradient_matches_central_differences() {
    let (x, y) = (wide(&random_unit(12 * 12, 1)), wide(&random_unit(12 * 12, 2)));
    let g = reference::gradient(12, 12, 1, &x, &y);
    assert_gradient("x", &g, &x, 1e-5, |x| reference::ssim(12, 12, 1, x, &y));
}

#[test]
fn an_image_is_like_itself_and_less_like_another() {
    let (x, y) = (random_unit(400, 1), random_unit(400, 2));
    assert!((cpu::ssim(20, 20, 1, &x, &x) - 1.0).abs() < 1e-9);
    assert!(cpu::ssim(20, 20, 1, &x, &y) < 0.5);
    assert!(cpu::ssim(10, 20, 2, &x, &y).is_nan());
}
