use super::*;
use diorama_testkit::{assert_close, assert_gradient, wide};

#[test]
fn matches_the_reference_both_ways() {
    let all = cases::cameras();
    for c in cases::cases() {
        let (n, pixels) = (c.index.len(), wide(&c.pixels));
        let (mut o, mut d) = (vec![9.0; n * 3], vec![9.0; n * 3]);
        cpu::forward(&all, &c.index, &c.pixels, &mut o, &mut d);
        let (ro, rd) = reference::forward(&all, &c.index, &pixels);
        assert_close("origins", &o, &ro, 1e-5);
        assert_close("dirs", &d, &rd, 1e-5);
        let mut g = vec![0.0; all.len() * CORRECTION];
        cpu::backward(&all, &c.index, &c.pixels, &d, &c.d_origins, &c.d_dirs, &mut g);
        let g: Vec<f32> = g.iter().map(|v| *v as f32).collect();
        let want = reference::backward(&all, &c.index, &pixels, &wide(&c.d_origins), &wide(&c.d_dirs));
        assert_close("corrections", &g, &want, 1e-4);
    }
}

#[test]
fn reference_gradient_matches_central_differences_of_corrected_cameras() {
    let (c, cases::Case { index, pixels, d_origins, d_dirs }) = (cases::cameras(), cases::case(15));
    let pixels = wide(&pixels);
    let (go, gd) = (wide(&d_origins), wide(&d_dirs));
    let g = reference::backward(&c, &index, &pixels, &go, &gd);
    assert_gradient("corrections", &g, &[0.0; 35], 1e-5, |x| {
        let moved: Vec<PosedCamera> = c.iter().zip(x.chunks_exact(7)).map(|(c, d)| c.corrected(d.try_into().unwrap())).collect();
        let (o, d) = reference::forward(&moved, &index, &pixels);
        o.iter().zip(&go).chain(d.iter().zip(&gd)).map(|(a, b)| a * b).sum()
    });
}
