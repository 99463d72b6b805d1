//! Every pixel against every triangle in f64, by solving `M β = q`.

use super::{GRID, Rasterize, WIDEST};

/// As [`Raster`](super::Raster), with screen derivatives.
#[derive(Clone, Debug, Default)]
pub struct Raster {
    pub ids: Vec<u32>,
    pub uv: Vec<f64>,
    pub depth: Vec<f64>,
    pub derivatives: Vec<f64>,
}

/// Gradients of what pixels show, shaped as [`Raster`]'s members.
pub struct Upstream<'a> {
    pub uv: &'a [f64],
    pub depth: &'a [f64],
    pub derivatives: &'a [f64],
}

type Vec3 = [f64; 3];

fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Positions with x and y moved to the grid, where they can be.
///
/// # Shapes
/// positions `[N, V, 4]`.
pub fn snapped(r: &Rasterize, positions: &[f64]) -> Vec<f64> {
    let mut moved = positions.to_vec();
    for p in moved.as_chunks_mut::<4>().0 {
        if let Some(grid) = on_grid(r, p) {
            (0..2).for_each(|k| p[k] = grid[k] as f64 / GRID / half(r, k) * p[3] - p[3]);
        }
    }
    moved
}

/// Half of the picture's width or height.
fn half(r: &Rasterize, axis: usize) -> f64 {
    0.5 * r.size[1 - axis] as f64
}

/// Steps of the grid to a vertex before the camera that is not too far outside.
fn on_grid(r: &Rasterize, p: &[f64]) -> Option<[i128; 2]> {
    let steps = [0, 1].map(|k| ((p[k] + p[3]) * half(r, k) / p[3] * GRID).round_ties_even());
    (p[3] > 0.0 && steps.iter().all(|s| s.abs() <= WIDEST)).then(|| steps.map(|s| s as i128))
}

/// A triangle of an image: `M⁻¹` by rows, z of the corners, and the corners on the grid.
struct Triangle {
    inverse: [Vec3; 3],
    z: Vec3,
    grid: Option<[[i128; 2]; 3]>,
}

impl Triangle {
    /// `None` where it is seen from its edge.
    fn new(r: &Rasterize, positions: &[f64], image: usize, triangle: [u32; 3]) -> Option<Triangle> {
        let corner = triangle.map(|v| &positions[(image * r.vertices + v as usize) * 4..][..4]);
        let p = corner.map(|c| [(c[0] + c[3]) * half(r, 0), (c[1] + c[3]) * half(r, 1), c[3]]);
        let rows = [cross(p[1], p[2]), cross(p[2], p[0]), cross(p[0], p[1])];
        let volume = dot(p[0], rows[0]);
        let [a, b, c] = corner.map(|c| on_grid(r, c));
        let grid = a.zip(b).zip(c).map(|((a, b), c)| [a, b, c]);
        (volume != 0.0).then(|| Triangle { inverse: rows.map(|r| r.map(|v| v / volume)), z: corner.map(|c| c[2]), grid })
    }

    /// Weights at a pixel's center.
    fn beta(&self, x: usize, y: usize) -> Vec3 {
        self.inverse.map(|row| dot(row, [x as f64 + 0.5, y as f64 + 0.5, 1.0]))
    }

    fn covers(&self, x: usize, y: usize) -> bool {
        let Some(p) = self.grid else {
            let beta = self.beta(x, y);
            return (0..3).all(|i| {
                let [x, y, _] = self.inverse[i];
                beta[i] > 0.0 || beta[i] == 0.0 && (x > 0.0 || x == 0.0 && y > 0.0)
            });
        };
        let at = |v: usize| (2 * v as i128 + 1) * GRID as i128 / 2;
        let side =
            |from: [i128; 2], to: [i128; 2], q: [i128; 2]| (to[0] - from[0]) * (q[1] - from[1]) - (to[1] - from[1]) * (q[0] - from[0]);
        let area = side(p[0], p[1], p[2]);
        area != 0
            && (0..3).all(|i| {
                let (from, to) = (p[i], p[(i + 1) % 3]);
                let inside = side(from, to, [at(x), at(y)]) * area.signum();
                // How the function grows along x and y.
                let (right, down) = ((from[1] - to[1]) * area.signum(), (to[0] - from[0]) * area.signum());
                inside > 0 || inside == 0 && (right > 0 || right == 0 && down > 0)
            })
    }
}

/// Pixels as (image, x, y).
fn pixels(r: &Rasterize) -> impl Iterator<Item = (usize, usize, usize)> {
    let [h, w] = r.size;
    (0..r.pixels()).map(move |p| (p / (h * w), p % w, p / w % h))
}

/// Nearest triangles of [`snapped`] positions; with the depths and ids of a layer in front, the next ones behind it.
///
/// # Shapes
/// positions `[N, V, 4]`, triangles `[F, 3]`.
pub fn forward(r: &Rasterize, positions: &[f64], triangles: &[[u32; 3]], front: Option<&Raster>) -> Raster {
    let positions = &snapped(r, positions);
    let solve = |image| triangles.iter().map(move |t| Triangle::new(r, positions, image, *t)).collect();
    let solved: Vec<Vec<Option<Triangle>>> = (0..r.images).map(solve).collect();
    let mut ids = Vec::new();
    for (p, (image, x, y)) in pixels(r).enumerate() {
        let mut best = (f64::INFINITY, 0);
        for (i, t) in solved[image].iter().enumerate().filter_map(|(i, t)| Some((i, t.as_ref()?))) {
            let beta = t.beta(x, y);
            let (z, id) = (dot(beta, t.z), i as u32 + 1);
            let behind = front.is_none_or(|f| f.ids[p] != 0 && (z > f.depth[p] || z == f.depth[p] && id > f.ids[p]));
            if t.covers(x, y) && z.abs() <= 1.0 && z < best.0 && behind {
                best = (z, id);
            }
        }
        ids.push(best.1);
    }
    shade(r, positions, triangles, ids)
}

/// What pixels show of given triangles of vertices where they are.
pub fn shade(r: &Rasterize, positions: &[f64], triangles: &[[u32; 3]], ids: Vec<u32>) -> Raster {
    let mut out = Raster { ids, ..Default::default() };
    for (p, (image, x, y)) in pixels(r).enumerate() {
        let found = out.ids[p].checked_sub(1).and_then(|t| Triangle::new(r, positions, image, triangles[t as usize]));
        let Some(t) = found else {
            out.uv.extend([0.0; 2]);
            out.depth.push(0.0);
            out.derivatives.extend([0.0; 4]);
            continue;
        };
        let beta = t.beta(x, y);
        let sum: f64 = beta.iter().sum();
        let (u, v) = (beta[0] / sum, beta[1] / sum);
        out.uv.extend([u, v]);
        out.depth.push(dot(beta, t.z));
        let slope = |k: usize, i: usize, at: f64| (t.inverse[i][k] - at * t.inverse.iter().map(|row| row[k]).sum::<f64>()) / sum;
        out.derivatives.extend([slope(0, 0, u), slope(1, 0, u), slope(0, 1, v), slope(1, 1, v)]);
    }
    out
}

/// Gradient of positions, of vertices where they are.
///
/// # Shapes
/// positions `[N, V, 4]`, triangles `[F, 3]`, ids `[N, H, W]`.
pub fn backward(r: &Rasterize, positions: &[f64], triangles: &[[u32; 3]], ids: &[u32], up: &Upstream) -> Vec<f64> {
    let mut d_positions = vec![0.0; positions.len()];
    for (p, (image, x, y)) in pixels(r).enumerate() {
        let Some(triangle) = ids[p].checked_sub(1).map(|t| triangles[t as usize]) else { continue };
        let Some(t) = Triangle::new(r, positions, image, triangle) else { continue };
        let beta = t.beta(x, y);
        let sum: f64 = beta.iter().sum();
        // Gradients of the numerators and of the sum in u = β₀ / Σβ, v = β₁ / Σβ, and of their slopes along each axis.
        let (mut d_beta, mut d_slope) = ([0.0; 3], [[0.0; 3]; 2]);
        for i in 0..2 {
            let at = beta[i] / sum;
            let mut d_at = up.uv[2 * p + i];
            for k in 0..2 {
                let total: f64 = t.inverse.iter().map(|row| row[k]).sum();
                let d = up.derivatives[4 * p + 2 * i + k] / sum;
                d_slope[k][i] += d;
                d_slope[k].iter_mut().for_each(|s| *s -= d * at);
                d_at -= d * total;
                d_beta.iter_mut().for_each(|b| *b -= d * (t.inverse[i][k] - at * total) / sum);
            }
            d_beta[i] += d_at / sum;
            d_beta.iter_mut().for_each(|b| *b -= d_at * at / sum);
        }
        (0..3).for_each(|i| d_beta[i] += up.depth[p] * t.z[i]);
        let (half_w, half_h) = (0.5 * r.size[1] as f64, 0.5 * r.size[0] as f64);
        for i in 0..3 {
            let slopes = [t.inverse[i][0], t.inverse[i][1]];
            let d: Vec3 = std::array::from_fn(|k| {
                -(0..3)
                    .map(|j| t.inverse[j][k] * (d_beta[j] * beta[i] + d_slope[0][j] * slopes[0] + d_slope[1][j] * slopes[1]))
                    .sum::<f64>()
            });
            let to = &mut d_positions[(image * r.vertices + triangle[i] as usize) * 4..][..4];
            to[0] += d[0] * half_w;
            to[1] += d[1] * half_h;
            to[2] += up.depth[p] * beta[i];
            to[3] += d[2] + d[0] * half_w + d[1] * half_h;
        }
    }
    d_positions
}
