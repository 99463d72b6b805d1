use super::cpu::{Blurred, Prefilter};
use super::{CubePrefilter, DIFFUSE, reference};
use diorama_testkit::{assert_close, random, random_unit};

/// The blurred levels of a layout, one after the other: diffuse, then the lobes that are looked up.
fn outputs(p: &CubePrefilter, b: &Blurred) -> Vec<Vec<f32>> {
    let (mut out, mut first) = (vec![b.diffuse.clone()], 0);
    for level in 0..p.levels() {
        let n = 18 * (p.size >> level) * (p.size >> level);
        out.push(b.specular[first..first + n].to_vec());
        first += n;
    }
    out
}

#[test]
fn both_directions_match_the_reference() {
    let p = CubePrefilter::new(32);
    let (base, fast) = (random_unit(p.base_len(), 1), Prefilter::new(p));
    let mut got = Blurred::default();
    fast.forward(&base, &mut got);
    let want = reference::forward(&p, &diorama_testkit::wide(&base));
    assert_eq!(want.len(), p.levels() + 1);
    for (got, want) in outputs(&p, &got).iter().zip(&want) {
        assert_close("blurred", got, want, 1e-5);
    }
    let mut d = Blurred { diffuse: random(got.diffuse.len(), 2), specular: random(got.specular.len(), 3) };
    let used: usize = outputs(&p, &d)[1..].iter().map(Vec::len).sum();
    d.specular[used..].fill(0.0);
    let mut d_base = vec![7.0; p.base_len()];
    fast.backward(&d, &mut d_base);
    let wide: Vec<Vec<f64>> = outputs(&p, &d).iter().map(|v| diorama_testkit::wide(v)).collect();
    assert_close("light", &d_base, &reference::backward(&p, &wide), 1e-4);
    // The reference's two directions are transposes: <d, W x> = <Wᵀ d, x>.
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let ahead: f64 = want.iter().zip(&wide).map(|(a, b)| product(a, b)).sum();
    let back = product(&reference::backward(&p, &wide), &diorama_testkit::wide(&base));
    assert!((ahead - back).abs() < 1e-9 * ahead.abs().max(1.0), "{ahead} {back}");
}

#[test]
fn even_light_stays_even_and_diffuse_light_follows_its_harmonics() {
    let p = CubePrefilter::new(64);
    let fast = Prefilter::new(p);
    let mut out = Blurred::default();
    fast.forward(&vec![0.7; p.base_len()], &mut out);
    assert!(outputs(&p, &out).iter().flatten().all(|v| (v - 0.7).abs() < 1e-5));
    // Light 1 + z: a cosine lobe keeps the first and leaves two thirds of the second (Ramamoorthi and Hanrahan 2001).
    let size = p.size;
    let base: Vec<f32> = (0..6 * size * size).flat_map(|i| [1.0 + super::center(i, size)[2] as f32; 3]).collect();
    fast.forward(&base, &mut out);
    for i in 0..6 * DIFFUSE * DIFFUSE {
        let want = 1.0 + 2.0 / 3.0 * super::center(i, DIFFUSE)[2];
        assert!((out.diffuse[3 * i] as f64 - want).abs() < 5e-3, "{} {want}", out.diffuse[3 * i]);
    }
    // Wider lobes keep less.
    let peak = |v: &Vec<f32>| v.iter().copied().fold(0.0, f32::max);
    let peaks: Vec<f32> = outputs(&p, &out)[1..].iter().map(peak).collect();
    assert!(peaks.windows(2).all(|p| p[1] < p[0]) && peaks[0] > 1.95, "{peaks:?}");
}
