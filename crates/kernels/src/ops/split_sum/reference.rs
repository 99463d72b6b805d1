//! One point at a time in f64, on the same table.

use super::{BEND, DIELECTRIC, GRAZING, Table};

type V = [f64; 3];

fn dot(a: V, b: V) -> f64 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

/// A surface point and the blurred light there.
#[derive(Clone, Copy, Debug)]
pub struct Point {
    pub normal: V,
    pub view: V,
    pub kd: V,
    /// Occlusion, roughness, metalness.
    pub ks: V,
    pub diffuse: V,
    pub specular: V,
}

/// Color.
pub fn shade(p: &Point) -> V {
    let [o, r, m] = p.ks;
    let cosine = dot(p.normal, p.view).max(GRAZING as f64);
    let [a, b] = at(cosine, r).0;
    let (f0, g) = (DIELECTRIC as f64, 1.0 / (a + b) - 1.0);
    let left = 1.0 - (f0 * a + b) * (1.0 + f0 * g);
    std::array::from_fn(|k| {
        let f = f0 * (1.0 - m) + p.kd[k] * m;
        (1.0 - o) * (p.kd[k] * (1.0 - m) * left * p.diffuse[k] + (f * a + b) * (1.0 + f * g) * p.specular[k])
    })
}

/// Shares by cosine and roughness with slopes, bilinear in the table that the CPU uses.
fn at(cosine: f64, roughness: f64) -> ([f64; 2], [f64; 2], [f64; 2]) {
    let n = (super::table::SIZE - 1) as f64;
    let low = |v: f64| (v * n).floor().clamp(0.0, n - 1.0);
    let (c, r) = (low(cosine), low(roughness));
    let (x, y) = (cosine * n - c, roughness * n - r);
    // At nodes, single precision holds the entries exactly enough.
    let e = |dr: f64, dc: f64| Table::get().at(((c + dc) / n) as f32, ((r + dr) / n) as f32).value.map(f64::from);
    let (e00, e01, e10, e11) = (e(0.0, 0.0), e(0.0, 1.0), e(1.0, 0.0), e(1.0, 1.0));
    let pick = |f: &dyn Fn(usize) -> f64| [f(0), f(1)];
    (
        pick(&|k| (1.0 - y) * (e00[k] + x * (e01[k] - e00[k])) + y * (e10[k] + x * (e11[k] - e10[k]))),
        pick(&|k| n * ((1.0 - y) * (e01[k] - e00[k]) + y * (e11[k] - e10[k]))),
        pick(&|k| n * (e10[k] + x * (e11[k] - e10[k]) - e00[k] - x * (e01[k] - e00[k]))),
    )
}

/// Gradients of normal, kd, ks, diffuse and specular for the gradient `d` of the color.
pub fn shade_backward(p: &Point, d: V) -> [V; 5] {
    let [o, r, m] = p.ks;
    let along = dot(p.normal, p.view);
    let ([a, b], slope_c, slope_r) = at(along.max(GRAZING as f64), r);
    let (f0, e) = (DIELECTRIC as f64, a + b);
    let (g, d_g) = (1.0 / e - 1.0, -1.0 / (e * e));
    let left = 1.0 - (f0 * a + b) * (1.0 + f0 * g);
    let [mut d_kd, mut d_diffuse, mut d_specular] = [[0.0; 3]; 3];
    let (mut d_o, mut d_m, mut d_a, mut d_b, mut d_left) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for k in 0..3 {
        let f = f0 * (1.0 - m) + p.kd[k] * m;
        let (lobe, gain) = (f * a + b, 1.0 + f * g);
        let matte = p.kd[k] * (1.0 - m) * left;
        d_o -= d[k] * (matte * p.diffuse[k] + lobe * gain * p.specular[k]);
        let q = d[k] * (1.0 - o);
        (d_diffuse[k], d_specular[k]) = (q * matte, q * lobe * gain);
        let (d_matte, d_lobes) = (q * p.diffuse[k], q * p.specular[k]);
        let d_f = d_lobes * (a * gain + lobe * g);
        d_kd[k] = d_matte * (1.0 - m) * left + d_f * m;
        d_m += d_f * (p.kd[k] - f0) - d_matte * p.kd[k] * left;
        d_left += d_matte * p.kd[k] * (1.0 - m);
        d_a += d_lobes * (f * gain + lobe * f * d_g);
        d_b += d_lobes * (gain + lobe * f * d_g);
    }
    d_a -= d_left * (f0 * (1.0 + f0 * g) + (f0 * a + b) * f0 * d_g);
    d_b -= d_left * ((1.0 + f0 * g) + (f0 * a + b) * f0 * d_g);
    let d_c = if along > GRAZING as f64 { d_a * slope_c[0] + d_b * slope_c[1] } else { 0.0 };
    let d_r = d_a * slope_r[0] + d_b * slope_r[1];
    [p.view.map(|v| d_c * v), d_kd, [d_o, d_r, d_m], d_diffuse, d_specular]
}

/// `2 (n·v) n − v`
pub fn mirror(n: V, v: V) -> V {
    let along = dot(n, v);
    std::array::from_fn(|k| 2.0 * along * n[k] - v[k])
}

/// Gradient of the normal.
pub fn mirror_backward(n: V, v: V, d: V) -> V {
    let (along, dn) = (dot(n, v), dot(d, n));
    std::array::from_fn(|k| 2.0 * (dn * v[k] + along * d[k]))
}

/// The unit vector along `g + t (n − g)`, `t = clamp(n·v / BEND, 0, 1)`: a shading normal bent toward the face's `g`.
pub fn bend(n: V, g: V, v: V) -> V {
    let t = (dot(n, v) / BEND as f64).clamp(0.0, 1.0);
    let sum: V = std::array::from_fn(|k| g[k] + t * (n[k] - g[k]));
    let l = dot(sum, sum).sqrt();
    sum.map(|s| s / l)
}

/// Gradient of the shading normal; that of the face counts as given.
pub fn bend_backward(n: V, g: V, v: V, d: V) -> V {
    let along = dot(n, v) / BEND as f64;
    let t = along.clamp(0.0, 1.0);
    let sum: V = std::array::from_fn(|k| g[k] + t * (n[k] - g[k]));
    let l = dot(sum, sum).sqrt();
    let radial = dot(sum, d) / (l * l);
    let d_sum: V = std::array::from_fn(|k| (d[k] - radial * sum[k]) / l);
    let d_t = if along > 0.0 && along < 1.0 { (0..3).map(|k| d_sum[k] * (n[k] - g[k])).sum::<f64>() / BEND as f64 } else { 0.0 };
    std::array::from_fn(|k| t * d_sum[k] + d_t * v[k])
}
