use super::cpu::Pixels;
use super::*;
use crate::simd::{Level, with_level};
use diorama_testkit::{assert_close, assert_gradient, random, random_unit, wide};

struct Case {
    interpolate: Interpolate,
    attributes: Vec<f32>,
    triangles: Vec<[u32; 3]>,
    ids: Vec<u32>,
    uv: Vec<f32>,
    slopes: Vec<f32>,
}

fn case(images: usize, pixels: usize, vertices: usize, attributes: usize, per_image: bool) -> Case {
    let (n, faces) = (images * pixels, if vertices == 0 { 0 } else { 37 });
    let corners = random_unit(3 * faces, 1);
    let pick = random_unit(n, 2);
    Case {
        interpolate: Interpolate { images, pixels, vertices, attributes, per_image },
        attributes: random(vertices * attributes * if per_image { images } else { 1 }, 3),
        triangles: corners.as_chunks::<3>().0.iter().map(|c| c.map(|c| (c * vertices as f32) as u32)).collect(),
        // Runs of equal ids of several lengths, some without a triangle.
        ids: (0..n).map(|p| if p % 11 == 0 { 0 } else { (pick[p - p % 5] * (faces + 1) as f32) as u32 }).collect(),
        uv: random_unit(2 * n, 4),
        slopes: random(4 * n, 5),
    }
}

fn cases() -> Vec<Case> {
    let mut all = vec![case(1, 0, 4, 3, false), case(1, 50, 0, 3, false), case(3, 2011, 40, 3, true), case(2, 9001, 40, 5, false)];
    all.extend([1, 2, 4, 6, 7, 8, 9, 21].map(|attributes| case(2, 77, 13, attributes, attributes % 2 == 0)));
    all
}

#[test]
fn matches_the_reference_both_ways_at_every_level() {
    for level in Level::available() {
        for c in cases() {
            let (s, n) = (&c.interpolate, c.ids.len());
            let d_out = random(n * s.attributes, 6);
            let (mut out, mut d_attributes, mut d_uv) = (vec![9.0; d_out.len()], vec![9.0; c.attributes.len()], vec![9.0; 2 * n]);
            with_level(level, || {
                cpu::forward(s, &c.attributes, &c.triangles, &c.ids, &c.uv, &mut out);
                let at = Pixels { ids: &c.ids, uv: &c.uv };
                cpu::backward(s, &c.attributes, &c.triangles, at, &d_out, &mut d_attributes, &mut d_uv);
            });
            let (attributes, uv) = (wide(&c.attributes), wide(&c.uv));
            assert_close("forward", &out, &reference::forward(s, &attributes, &c.triangles, &c.ids, &uv), 1e-5);
            let (want_attributes, want_uv) = reference::backward(s, &attributes, &c.triangles, &c.ids, &uv, &wide(&d_out));
            assert_close("d attributes", &d_attributes, &want_attributes, 1e-4);
            assert_close("d uv", &d_uv, &want_uv, 1e-4);
        }
    }
}

#[test]
fn derivatives_match_the_reference_both_ways() {
    for c in cases() {
        let (s, n) = (&c.interpolate, c.ids.len());
        for chosen in [vec![], vec![s.attributes - 1], vec![0, s.attributes / 2]] {
            let (width, (attributes, slopes)) = (2 * chosen.len(), (wide(&c.attributes), wide(&c.slopes)));
            let (d_out, mut out) = (random(n * width, 6), vec![9.0; n * width]);
            // Gradients of attributes are added to what is there.
            let (mut d_attributes, mut d_slopes) = (random(c.attributes.len(), 8), vec![9.0; 4 * n]);
            let before = wide(&d_attributes);
            cpu::derivatives(s, &chosen, &c.attributes, &c.triangles, &c.ids, &c.slopes, &mut out);
            let at = Pixels { ids: &c.ids, uv: &c.slopes };
            cpu::derivatives_backward(s, &chosen, &c.attributes, &c.triangles, at, &d_out, (&mut d_attributes, &mut d_slopes));
            assert_close("forward", &out, &reference::derivatives(s, &chosen, &attributes, &c.triangles, &c.ids, &slopes), 1e-5);
            let (mut want, want_slopes) =
                reference::derivatives_backward(s, &chosen, &attributes, &c.triangles, &c.ids, &slopes, &wide(&d_out));
            want.iter_mut().zip(before).for_each(|(w, b)| *w += b);
            assert_close("d attributes", &d_attributes, &want, 1e-4);
            assert_close("d slopes", &d_slopes, &want_slopes, 1e-4);
        }
    }
}

#[test]
fn reference_gradients_match_central_differences() {
    for per_image in [false, true] {
        let c = case(2, 20, 7, 3, per_image);
        let s = &c.interpolate;
        let (attributes, uv, slopes) = (wide(&c.attributes), wide(&c.uv), wide(&c.slopes));
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let d = wide(&random(40 * 3, 6));
        let loss = |attributes: &[f64], uv: &[f64]| dot(&reference::forward(s, attributes, &c.triangles, &c.ids, uv), &d);
        let (d_attributes, d_uv) = reference::backward(s, &attributes, &c.triangles, &c.ids, &uv, &d);
        assert_gradient("attributes", &d_attributes, &attributes, 1e-6, |a| loss(a, &uv));
        assert_gradient("uv", &d_uv, &uv, 1e-6, |uv| loss(&attributes, uv));
        let (chosen, d) = ([2, 0], wide(&random(40 * 4, 7)));
        let loss =
            |attributes: &[f64], slopes: &[f64]| dot(&reference::derivatives(s, &chosen, attributes, &c.triangles, &c.ids, slopes), &d);
        let (d_attributes, d_slopes) = reference::derivatives_backward(s, &chosen, &attributes, &c.triangles, &c.ids, &slopes, &d);
        assert_gradient("attributes of derivatives", &d_attributes, &attributes, 1e-6, |a| loss(a, &slopes));
        assert_gradient("slopes", &d_slopes, &slopes, 1e-6, |slopes| loss(&attributes, slopes));
    }
}

#[test]
fn gradients_do_not_depend_on_threads() {
    let c = case(1, 50_000, 300, 5, false);
    let d_out = random(c.ids.len() * 5, 6);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (mut d_attributes, mut d_uv) = (vec![0.0; c.attributes.len()], vec![0.0; c.uv.len()]);
        pool.install(|| {
            let at = Pixels { ids: &c.ids, uv: &c.uv };
            cpu::backward(&c.interpolate, &c.attributes, &c.triangles, at, &d_out, &mut d_attributes, &mut d_uv);
        });
        (d_attributes, d_uv)
    };
    assert_eq!(with(1), with(3));
}
