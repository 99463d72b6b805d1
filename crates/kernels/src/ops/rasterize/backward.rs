//! Gradient of positions, by runs of pixels that show one triangle.
//!
//! With `β = M⁻¹ q`, `dβ = −M⁻¹ dM β`: a pixel's gradient `g` of β adds `−(M⁻ᵀ g) βᵢ` to corner `i`. M belongs to the triangle, so that a
//! run needs only the sums of `gⱼ βᵢ`.

use super::setup::Vertex;
use super::{Raster, Rasterize};
use crate::partials;

/// Gradients of what pixels show; those left out are 0.
#[derive(Clone, Copy, Debug, Default)]
pub struct Upstream<'a> {
    /// `[N, H, W, 2]`
    pub uv: Option<&'a [f32]>,
    /// `[N, H, W]`
    pub depth: Option<&'a [f32]>,
    /// `[N, H, W, 4]`
    pub derivatives: Option<&'a [f32]>,
}

/// The weights `β` along a row of pixels, and what their gradients add up to.
struct Run {
    /// Rows of `M⁻¹`, relative to the center of the run's first pixel.
    inverse: [[f64; 3]; 3],
    x: [f32; 3],
    y: [f32; 3],
    one: [f32; 3],
    z: [f32; 3],
    /// `Σ gⱼ βᵢ`
    products: [[f32; 3]; 3],
    /// Sums of the gradients of `∂β/∂X` and `∂β/∂Y`.
    slopes: [[f32; 3]; 2],
    d_z: [f32; 3],
}

impl Run {
    /// From corners, size and the first pixel's column and row.
    #[inline(always)]
    fn new(corners: [[f32; 4]; 3], size: [usize; 2], pixel: [usize; 2]) -> Run {
        let [center_x, center_y] = pixel.map(|v| v as f64 + 0.5);
        let p = corners.map(|c| {
            let v = Vertex::new(c, size);
            [v.x - center_x * v.w, v.y - center_y * v.w, v.w]
        });
        let mut inverse: [[f64; 3]; 3] = std::array::from_fn(|i| {
            let (j, k) = (&p[(i + 1) % 3], &p[(i + 2) % 3]);
            [j[1] * k[2] - k[1] * j[2], j[2] * k[0] - k[2] * j[0], j[0] * k[1] - k[0] * j[1]]
        });
        let scale = 1.0 / (0..3).map(|k| p[0][k] * inverse[0][k]).sum::<f64>();
        inverse.iter_mut().flatten().for_each(|v| *v *= scale);
        let column = |k: usize| std::array::from_fn(|i| inverse[i][k] as f32);
        let (x, y, one, z) = (column(0), column(1), column(2), corners.map(|c| c[2]));
        Run { inverse, x, y, one, z, products: [[0.0; 3]; 3], slopes: [[0.0; 3]; 2], d_z: [0.0; 3] }
    }

    /// Adds pixel `p` of all pixels, which is number `i` of the run.
    #[inline(always)]
    fn add(&mut self, up: &Upstream, p: usize, i: usize) {
        let beta: [f32; 3] = std::array::from_fn(|k| self.x[k] * i as f32 + self.one[k]);
        let inverse = 1.0 / (beta[0] + beta[1] + beta[2]);
        let (u, v) = (beta[0] * inverse, beta[1] * inverse);
        let (mut d_u, mut d_v) = up.uv.map_or((0.0, 0.0), |d| (d[2 * p], d[2 * p + 1]));
        // Gradient of Σβ beyond that through u and v.
        let mut d_sum = 0.0;
        if let Some(d) = up.derivatives {
            for (k, slope) in [self.x, self.y].into_iter().enumerate() {
                let sum = slope[0] + slope[1] + slope[2];
                let (du, dv) = (d[4 * p + k] * inverse, d[4 * p + 2 + k] * inverse);
                d_u -= du * sum;
                d_v -= dv * sum;
                d_sum -= du * (slope[0] - u * sum) * inverse + dv * (slope[1] - v * sum) * inverse;
                let all = -(du * u + dv * v);
                self.slopes[k][0] += du + all;
                self.slopes[k][1] += dv + all;
                self.slopes[k][2] += all;
            }
        }
        let all = d_sum - (d_u * u + d_v * v) * inverse;
        let mut g = [d_u * inverse + all, d_v * inverse + all, all];
        if let Some(d) = up.depth {
            for k in 0..3 {
                g[k] += d[p] * self.z[k];
                self.d_z[k] += d[p] * beta[k];
            }
        }
        for j in 0..3 {
            for k in 0..3 {
                self.products[j][k] += g[j] * beta[k];
            }
        }
    }

    /// Gradient of each corner in clip space.
    #[inline(always)]
    fn corners(&self, [h, w]: [usize; 2], pixel: [usize; 2]) -> [[f32; 4]; 3] {
        let (half_w, half_h) = (0.5 * w as f64, 0.5 * h as f64);
        std::array::from_fn(|i| {
            let mut d = [0.0f64; 3];
            for (j, row) in self.inverse.iter().enumerate() {
                let g = self.products[j][i] + self.slopes[0][j] * self.x[i] + self.slopes[1][j] * self.y[i];
                (0..3).for_each(|k| d[k] -= row[k] * g as f64);
            }
            let [x, y] = pixel.map(|v| v as f64 + 0.5);
            let d_w = d[2] + d[0] * (half_w - x) + d[1] * (half_h - y);
            [(d[0] * half_w) as f32, (d[1] * half_h) as f32, self.d_z[i], d_w as f32]
        })
    }
}

/// Adds the gradients of the pixels of one row.
#[inline(always)]
fn add_row(r: &Rasterize, positions: &[f32], triangles: &[[u32; 3]], ids: &[u32], up: &Upstream, first: usize, to: &mut [f32]) {
    let mut x = 0;
    while x < ids.len() {
        let (start, id) = (x, ids[x]);
        while x < ids.len() && ids[x] == id {
            x += 1;
        }
        let Some(triangle) = id.checked_sub(1) else { continue };
        let corners = triangles[triangle as usize].map(|v| 4 * v as usize);
        let pixel = [start, first / r.size[1] % r.size[0]];
        let mut run = Run::new(corners.map(|c| std::array::from_fn(|k| positions[c + k])), r.size, pixel);
        (start..x).for_each(|i| run.add(up, first + i, i - start));
        for (c, d) in corners.into_iter().zip(run.corners(r.size, pixel)) {
            (0..4).for_each(|k| to[c + k] += d[k]);
        }
    }
}

/// Gradient of positions through barycentrics, their screen derivatives and depth, overwritten. Which triangle a pixel shows has none: that
/// is what [`antialias`](crate::ops::antialias) is for.
///
/// # Shapes
/// positions and d_positions `[N, V, 4]`, triangles `[F, 3]`, raster as `forward` gave it.
///
/// # Panics
/// When shapes disagree.
pub fn backward(r: &Rasterize, positions: &[f32], triangles: &[[u32; 3]], raster: &Raster, up: &Upstream, d_positions: &mut [f32]) {
    r.check(positions.len(), triangles);
    let fits = |d: Option<&[f32]>, k: usize| d.is_none_or(|d| d.len() == k * r.pixels());
    assert!(fits(up.uv, 2) && fits(up.depth, 1) && fits(up.derivatives, 4), "rasterize: gradients of pixels");
    assert!(raster.ids.len() == r.pixels() && d_positions.len() == positions.len(), "rasterize: shapes");
    let ([h, w], n) = (r.size, r.vertices * 4);
    let tasks = partials::tasks_for(r.images, h * w, r.vertices);
    let rows = h.div_ceil(tasks);
    partials::scatter(r.images, tasks, 4 * r.pixels(), d_positions, |image, task, to| {
        for y in (task * rows).min(h)..((task + 1) * rows).min(h) {
            let first = (image * h + y) * w;
            add_row(r, &positions[image * n..][..n], triangles, &raster.ids[first..first + w], up, first, to);
        }
    });
}
