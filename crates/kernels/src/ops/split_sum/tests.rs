use super::reference::{self, Point};
use super::{Gradients, Light, Points, Table, cpu, level_of, roughness_of, table};
use diorama_testkit::{assert_close, assert_gradient, random, random_unit};

fn unit(v: [f32; 3]) -> [f32; 3] {
    let l = v.iter().map(|v| v * v).sum::<f32>().sqrt();
    v.map(|v| v / l)
}

/// Points with normals on both sides of the view.
struct Case {
    normal: Vec<f32>,
    view: Vec<f32>,
    kd: Vec<f32>,
    ks: Vec<f32>,
    light: [Vec<f32>; 2],
    d: Vec<f32>,
}

impl Case {
    fn new(n: usize) -> Case {
        let units = |seed: u64| random(3 * n, seed).as_chunks::<3>().0.iter().flat_map(|v| unit(*v)).collect();
        let ks = random_unit(3 * n, 4).as_chunks::<3>().0.iter().flat_map(|k| [0.5 * k[0], 0.1 + 0.85 * k[1], k[2]]).collect();
        Case {
            normal: units(1),
            view: units(2),
            kd: random_unit(3 * n, 3),
            ks,
            light: [random_unit(3 * n, 5), random_unit(3 * n, 6)],
            d: random(3 * n, 7),
        }
    }

    fn points(&self) -> Points<'_> {
        Points { normal: &self.normal, view: &self.view, kd: &self.kd, ks: &self.ks }
    }

    fn light(&self) -> Light<'_> {
        Light { diffuse: &self.light[0], specular: &self.light[1] }
    }

    fn point(&self, i: usize) -> Point {
        let at = |v: &[f32]| std::array::from_fn(|k| v[3 * i + k] as f64);
        let [diffuse, specular] = [&self.light[0], &self.light[1]].map(|l| at(l));
        Point { normal: at(&self.normal), view: at(&self.view), kd: at(&self.kd), ks: at(&self.ks), diffuse, specular }
    }
}

fn wide(v: &[f32], i: usize) -> [f64; 3] {
    std::array::from_fn(|k| v[3 * i + k] as f64)
}

#[test]
fn both_directions_match_the_reference() {
    for n in [1, 700] {
        let c = Case::new(n);
        let mut out = vec![0.0; 3 * n];
        cpu::forward(&c.points(), &c.light(), &mut out);
        let want: Vec<f64> = (0..n).flat_map(|i| reference::shade(&c.point(i))).collect();
        assert_close("color", &out, &want, 1e-4);
        let mut g: [Vec<f32>; 5] = std::array::from_fn(|_| vec![9.0; 3 * n]);
        let [normal, kd, ks, diffuse, specular] = &mut g;
        cpu::backward(&c.points(), &c.light(), &c.d, Gradients { normal, kd, ks, diffuse, specular });
        let want: Vec<[[f64; 3]; 5]> = (0..n).map(|i| reference::shade_backward(&c.point(i), wide(&c.d, i))).collect();
        for (j, name) in ["normal", "kd", "ks", "diffuse", "specular"].into_iter().enumerate() {
            let want: Vec<f64> = want.iter().flat_map(|w| w[j]).collect();
            assert_close(name, &g[j], &want, 2e-3);
        }
    }
}

#[test]
fn lookups_and_bends_match_the_reference() {
    let n = 600;
    let c = Case::new(n);
    let face: Vec<f32> = c.view.iter().zip(&c.normal).map(|(v, n)| v + 0.2 * n).collect();
    let face: Vec<f32> = face.as_chunks::<3>().0.iter().flat_map(|f| unit(*f)).collect();
    let (mut directions, mut levels) = (vec![0.0; 3 * n], vec![0.0; n]);
    cpu::lookups(&c.points(), 4, &mut directions, &mut levels);
    let want: Vec<f64> = (0..n).flat_map(|i| reference::mirror(wide(&c.normal, i), wide(&c.view, i))).collect();
    assert_close("mirror", &directions, &want, 1e-5);
    let (mut d_normal, mut d_ks) = (vec![1.0; 3 * n], vec![0.0; 3 * n]);
    cpu::lookups_backward(&c.points(), 4, &c.d, &vec![2.0; n], &mut d_normal, &mut d_ks);
    let of = |i: usize| reference::mirror_backward(wide(&c.normal, i), wide(&c.view, i), wide(&c.d, i)).map(|v| v + 1.0);
    assert_close("mirror's gradient", &d_normal, &(0..n).flat_map(of).collect::<Vec<_>>(), 1e-5);
    assert!((0..n).all(|i| d_ks[3 * i + 1] == 2.0 * level_of(c.ks[3 * i + 1], 4).1));
    let mut bent = c.normal.clone();
    cpu::bend(&mut bent, &face, &c.view);
    let want: Vec<f64> = (0..n).flat_map(|i| reference::bend(wide(&c.normal, i), wide(&face, i), wide(&c.view, i))).collect();
    assert_close("bend", &bent, &want, 1e-4);
    let mut d = c.d.clone();
    cpu::bend_backward(&c.normal, &face, &c.view, &mut d);
    let of = |i: usize| reference::bend_backward(wide(&c.normal, i), wide(&face, i), wide(&c.view, i), wide(&c.d, i));
    assert_close("bend's gradient", &d, &(0..n).flat_map(of).collect::<Vec<_>>(), 2e-3);
}

#[test]
fn the_reference_s_gradients_match_central_differences() {
    let c = Case::new(12);
    for i in 0..12 {
        let (p, d) = (c.point(i), wide(&c.d, i));
        let got = reference::shade_backward(&p, d);
        let x: Vec<f64> = [p.normal, p.kd, p.ks, p.diffuse, p.specular].concat();
        let v = |x: &[f64], at: usize| [x[at], x[at + 1], x[at + 2]];
        assert_gradient("shade", got.as_flattened(), &x, 1e-4, |x| {
            let p = Point { normal: v(x, 0), kd: v(x, 3), ks: v(x, 6), diffuse: v(x, 9), specular: v(x, 12), ..p };
            (0..3).map(|k| reference::shade(&p)[k] * d[k]).sum()
        });
        let product = |a: [f64; 3]| (0..3).map(|k| a[k] * d[k]).sum::<f64>();
        let got = reference::mirror_backward(p.normal, p.view, d);
        assert_gradient("mirror", &got, &p.normal, 1e-6, |n| product(reference::mirror(v(n, 0), p.view)));
        let face: [f64; 3] = std::array::from_fn(|k| p.view[k] + 0.2);
        let got = reference::bend_backward(p.normal, face, p.view, d);
        assert_gradient("bend", &got, &p.normal, 1e-4, |n| product(reference::bend(v(n, 0), face, p.view)));
    }
}

#[test]
fn levels_and_roughness_are_inverse() {
    for levels in [3, 4, 6] {
        for level in 0..levels {
            assert!((level_of(roughness_of(level, levels), levels).0 - level as f32).abs() < 1e-4);
        }
    }
}

#[test]
fn a_white_metal_in_a_white_furnace_is_invisible() {
    let ones = [1.0f64; 3];
    for (r, cosine) in [(0.1, 0.9f64), (0.5, 0.3), (1.0, 0.6)] {
        let view = [(1.0 - cosine * cosine).sqrt(), 0.0, cosine];
        for m in [0.0, 1.0] {
            let p = Point { normal: [0.0, 0.0, 1.0], view, kd: ones, ks: [0.0, r, m], diffuse: ones, specular: ones };
            let out = reference::shade(&p)[0];
            assert!((out - 1.0).abs() < 0.01, "roughness {r}, metal {m}: {out}");
        }
    }
}

#[test]
fn the_table_holds_the_integral_over_directions() {
    // Directions in place of normals: the lobe itself over the hemisphere.
    for (cosine, roughness) in [(0.3f64, 0.6f64), (0.8, 0.9), (0.5, 0.4)] {
        let (alpha, o) = (roughness * roughness, [(1.0 - cosine * cosine).sqrt(), 0.0, cosine]);
        let lambda = |v: [f64; 3]| 0.5 * ((1.0 + alpha * alpha * (v[0] * v[0] + v[1] * v[1]) / (v[2] * v[2])).sqrt() - 1.0);
        let (rows, columns) = (800, 400);
        let mut sums = [0.0; 2];
        for i in 0..rows * columns {
            let z = (i / columns) as f64 / rows as f64 + 0.5 / rows as f64;
            let (s, angle) = ((1.0 - z * z).sqrt(), std::f64::consts::TAU * ((i % columns) as f64 + 0.5) / columns as f64);
            let l = [s * angle.cos(), s * angle.sin(), z];
            let sum: [f64; 3] = std::array::from_fn(|k| o[k] + l[k]);
            let length = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
            let h = sum.map(|v| v / length);
            let q = h[2] * h[2] * (alpha * alpha - 1.0) + 1.0;
            let d = alpha * alpha / (std::f64::consts::PI * q * q);
            let lobe = d / (4.0 * o[2]) / (1.0 + lambda(o) + lambda(l)) * std::f64::consts::TAU / (rows * columns) as f64;
            let fresnel = (1.0 - (0..3).map(|k| o[k] * h[k]).sum::<f64>()).powi(5);
            sums = [sums[0] + lobe * (1.0 - fresnel), sums[1] + lobe * fresnel];
        }
        let (got, near) = (Table::get().at(cosine as f32, roughness as f32).value, table::integrate(cosine, roughness));
        for k in 0..2 {
            assert!((got[k] as f64 - sums[k]).abs() < 5e-3 && (near[k] - sums[k]).abs() < 5e-3, "{got:?} {near:?} {sums:?}");
        }
    }
}
