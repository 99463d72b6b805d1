//! Blocks of points in parallel; every point is on its own, so the result does not depend on threads.

use super::{BEND, DIELECTRIC, GRAZING, Gradients, Light, Points, Table, level_of};
use rayon::prelude::*;

/// Points per task.
const BLOCK: usize = 512;

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn at(values: &[f32], i: usize) -> [f32; 3] {
    [values[3 * i], values[3 * i + 1], values[3 * i + 2]]
}

impl Points<'_> {
    fn check(&self) -> usize {
        let n = self.normal.len();
        assert!([self.view.len(), self.kd.len(), self.ks.len()] == [n; 3] && n.is_multiple_of(3), "split sum: points");
        n / 3
    }
}

/// Mirrored views, and levels of the blurred light for the points' roughness.
///
/// # Shapes
/// directions `[P, 3]`, levels `[P]`.
///
/// # Panics
/// When shapes disagree, or there are fewer than two levels.
pub fn lookups(p: &Points, levels: usize, directions: &mut [f32], out: &mut [f32]) {
    let n = p.check();
    assert!(directions.len() == 3 * n && out.len() == n && levels >= 2, "split sum: lookups");
    directions.par_chunks_mut(3 * BLOCK).zip(out.par_chunks_mut(BLOCK)).enumerate().for_each(|(b, (directions, out))| {
        for (j, (direction, out)) in directions.as_chunks_mut::<3>().0.iter_mut().zip(out).enumerate() {
            let i = b * BLOCK + j;
            let (normal, view) = (at(p.normal, i), at(p.view, i));
            let along = dot(normal, view);
            *direction = std::array::from_fn(|k| 2.0 * along * normal[k] - view[k]);
            *out = level_of(p.ks[3 * i + 1], levels).0;
        }
    });
}

/// Adds the gradients of [`lookups`] to those of normals and of `ks`.
///
/// # Panics
/// When shapes disagree.
pub fn lookups_backward(p: &Points, levels: usize, d_directions: &[f32], d_levels: &[f32], d_normal: &mut [f32], d_ks: &mut [f32]) {
    let n = p.check();
    assert!([d_directions.len(), d_normal.len(), d_ks.len()] == [3 * n; 3] && d_levels.len() == n, "split sum: lookups");
    d_normal.par_chunks_mut(3 * BLOCK).zip(d_ks.par_chunks_mut(3 * BLOCK)).enumerate().for_each(|(b, (d_normal, d_ks))| {
        for (j, (d_normal, d_ks)) in d_normal.as_chunks_mut::<3>().0.iter_mut().zip(d_ks.as_chunks_mut::<3>().0).enumerate() {
            let i = b * BLOCK + j;
            let (normal, view, d) = (at(p.normal, i), at(p.view, i), at(d_directions, i));
            let (along, dn) = (dot(normal, view), dot(d, normal));
            (0..3).for_each(|k| d_normal[k] += 2.0 * (dn * view[k] + along * d[k]));
            d_ks[1] += d_levels[i] * level_of(p.ks[3 * i + 1], levels).1;
        }
    });
}

/// Colors of the points, `[P, 3]`.
///
/// # Panics
/// When shapes disagree.
pub fn forward(p: &Points, light: &Light, out: &mut [f32]) {
    let n = p.check();
    assert!([light.diffuse.len(), light.specular.len(), out.len()] == [3 * n; 3], "split sum: shapes");
    let table = Table::get();
    out.par_chunks_mut(3 * BLOCK).enumerate().for_each(|(b, out)| {
        for (j, out) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let i = b * BLOCK + j;
            let (kd, [o, r, m]) = (at(p.kd, i), at(p.ks, i));
            let [a, b] = table.at(dot(at(p.normal, i), at(p.view, i)).max(GRAZING), r).value;
            let g = 1.0 / (a + b) - 1.0;
            let left = 1.0 - (DIELECTRIC * a + b) * (1.0 + DIELECTRIC * g);
            let (diffuse, specular) = (at(light.diffuse, i), at(light.specular, i));
            *out = std::array::from_fn(|k| {
                let f = DIELECTRIC * (1.0 - m) + kd[k] * m;
                (1.0 - o) * (kd[k] * (1.0 - m) * left * diffuse[k] + (f * a + b) * (1.0 + f * g) * specular[k])
            });
        }
    });
}

/// Gradients of [`forward`] for the gradient `d` of the colors.
///
/// # Panics
/// When shapes disagree.
pub fn backward(p: &Points, light: &Light, d: &[f32], into: Gradients) {
    let n = p.check();
    let shapes = [light.diffuse.len(), light.specular.len(), d.len(), into.normal.len(), into.kd.len(), into.ks.len(), into.diffuse.len()];
    assert!(shapes == [3 * n; 7] && into.specular.len() == 3 * n, "split sum: shapes");
    let table = Table::get();
    let Gradients { normal, kd, ks, diffuse, specular } = into;
    let surface = normal.par_chunks_mut(3 * BLOCK).zip(kd.par_chunks_mut(3 * BLOCK)).zip(ks.par_chunks_mut(3 * BLOCK));
    let both = surface.zip(diffuse.par_chunks_mut(3 * BLOCK)).zip(specular.par_chunks_mut(3 * BLOCK));
    both.enumerate().for_each(|(b, ((((normal, kd), ks), diffuse), specular))| {
        for j in 0..normal.len() / 3 {
            let i = b * BLOCK + j;
            let own = Own { normal: at(p.normal, i), view: at(p.view, i), kd: at(p.kd, i), ks: at(p.ks, i) };
            let of = own.backward(table, [at(light.diffuse, i), at(light.specular, i)], at(d, i));
            for (to, from) in [&mut *normal, &mut *kd, &mut *ks, &mut *diffuse, &mut *specular].into_iter().zip(of) {
                to[3 * j..3 * j + 3].copy_from_slice(&from);
            }
        }
    });
}

/// One point.
struct Own {
    normal: [f32; 3],
    view: [f32; 3],
    kd: [f32; 3],
    ks: [f32; 3],
}

impl Own {
    /// Gradients of normal, kd, ks, diffuse and specular.
    #[inline(always)]
    fn backward(&self, table: &Table, [diffuse, specular]: [[f32; 3]; 2], d: [f32; 3]) -> [[f32; 3]; 5] {
        let [o, r, m] = self.ks;
        let along = dot(self.normal, self.view);
        let share = table.at(along.max(GRAZING), r);
        let [a, b] = share.value;
        let e = a + b;
        let (g, d_g) = (1.0 / e - 1.0, -1.0 / (e * e));
        let coat = (DIELECTRIC * a + b, 1.0 + DIELECTRIC * g);
        let left = 1.0 - coat.0 * coat.1;
        let [mut d_kd, mut d_diffuse, mut d_specular] = [[0.0; 3]; 3];
        let (mut d_o, mut d_m, mut d_a, mut d_b, mut d_left) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for k in 0..3 {
            let f = DIELECTRIC * (1.0 - m) + self.kd[k] * m;
            let (lobe, gain) = (f * a + b, 1.0 + f * g);
            let matte = self.kd[k] * (1.0 - m) * left;
            d_o -= d[k] * (matte * diffuse[k] + lobe * gain * specular[k]);
            let q = d[k] * (1.0 - o);
            (d_diffuse[k], d_specular[k]) = (q * matte, q * lobe * gain);
            let (d_matte, d_lobes) = (q * diffuse[k], q * specular[k]);
            let d_f = d_lobes * (a * gain + lobe * g);
            d_kd[k] = d_matte * (1.0 - m) * left + d_f * m;
            d_m += d_f * (self.kd[k] - DIELECTRIC) - d_matte * self.kd[k] * left;
            d_left += d_matte * self.kd[k] * (1.0 - m);
            d_a += d_lobes * (f * gain + lobe * f * d_g);
            d_b += d_lobes * (gain + lobe * f * d_g);
        }
        d_a -= d_left * DIELECTRIC * (coat.1 + coat.0 * d_g);
        d_b -= d_left * (coat.1 + coat.0 * DIELECTRIC * d_g);
        let d_c = if along > GRAZING { d_a * share.along_cosine[0] + d_b * share.along_cosine[1] } else { 0.0 };
        let d_r = d_a * share.along_roughness[0] + d_b * share.along_roughness[1];
        [self.view.map(|v| d_c * v), d_kd, [d_o, d_r, d_m], d_diffuse, d_specular]
    }
}

/// Shading normals `[P, 3]` bent toward those of the faces where they turn away from the camera; in place.
///
/// # Panics
/// When shapes disagree.
pub fn bend(normal: &mut [f32], face: &[f32], view: &[f32]) {
    assert!(normal.len() == face.len() && view.len() == face.len(), "split sum: bend");
    normal.par_chunks_mut(3 * BLOCK).enumerate().for_each(|(b, normal)| {
        for (j, n) in normal.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let i = b * BLOCK + j;
            let (g, t) = (at(face, i), (dot(*n, at(view, i)) / BEND).clamp(0.0, 1.0));
            let sum: [f32; 3] = std::array::from_fn(|k| g[k] + t * (n[k] - g[k]));
            let l = dot(sum, sum).sqrt().max(1e-12);
            *n = sum.map(|s| s / l);
        }
    });
}

/// Gradient of the normals before [`bend`], in place of the gradient `d` of those after.
///
/// # Panics
/// When shapes disagree.
pub fn bend_backward(normal: &[f32], face: &[f32], view: &[f32], d: &mut [f32]) {
    assert!(normal.len() == face.len() && view.len() == face.len() && d.len() == face.len(), "split sum: bend");
    d.par_chunks_mut(3 * BLOCK).enumerate().for_each(|(b, d)| {
        for (j, d) in d.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let i = b * BLOCK + j;
            let (n, g, v) = (at(normal, i), at(face, i), at(view, i));
            let along = dot(n, v) / BEND;
            let t = along.clamp(0.0, 1.0);
            let sum: [f32; 3] = std::array::from_fn(|k| g[k] + t * (n[k] - g[k]));
            let l = dot(sum, sum).sqrt().max(1e-12);
            let radial = dot(sum, *d) / (l * l);
            let d_sum: [f32; 3] = std::array::from_fn(|k| (d[k] - radial * sum[k]) / l);
            let between = along > 0.0 && along < 1.0;
            let d_t = if between { (0..3).map(|k| d_sum[k] * (n[k] - g[k])).sum::<f32>() / BEND } else { 0.0 };
            *d = std::array::from_fn(|k| t * d_sum[k] + d_t * v[k]);
        }
    });
}
