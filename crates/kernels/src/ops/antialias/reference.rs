//! Pair by pair in f64; neighbors of edges are looked for among all triangles.

use super::Antialias;

/// What pixels show.
pub struct Visible<'a> {
    pub ids: &'a [u32],
    pub depth: &'a [f64],
}

/// An edge's end in pixels, relative to a center: x, y and w.
type End = [f64; 3];

struct Found {
    near: usize,
    far: usize,
    distance: f64,
    /// The distance's slopes along the ends' (x, y, z, w) in clip space, by offset in the positions.
    slopes: [(usize, [f64; 4]); 2],
}

fn determinant(p: [&[f64]; 3]) -> f64 {
    let m = |i: usize, k: usize| p[i][[0, 1, 3][k]];
    (0..3).map(|i| m(i, 0) * (m((i + 1) % 3, 1) * m((i + 2) % 3, 2) - m((i + 2) % 3, 1) * m((i + 1) % 3, 2))).sum()
}

/// Other triangles that have the edge opposite to corner `i` of a triangle, and their corners opposite to it.
fn sharing(triangles: &[[u32; 3]], triangle: usize, i: usize) -> Vec<(usize, usize)> {
    let ends = |t: usize, i: usize| [triangles[t][(i + 1) % 3], triangles[t][(i + 2) % 3]];
    let edge = ends(triangle, i);
    let corners = (0..triangles.len()).flat_map(|t| (0..3).map(move |k| (t, k)));
    corners.filter(|(t, k)| (*t, *k) != (triangle, i) && (ends(*t, *k) == edge || ends(*t, *k) == [edge[1], edge[0]])).collect()
}

/// Where the edge from `p` to `q` crosses the axis, from 0: distance, its slopes along both ends, and whether it is steep.
fn crossing(p: End, q: End, axis: usize) -> Option<(f64, [End; 2], bool)> {
    let across = 1 - axis;
    if (p[across] >= 0.0) == (q[across] >= 0.0) {
        return None;
    }
    // The point at `t` of the way from p to q.
    let span = p[across] - q[across];
    let t = p[across] / span;
    let w = p[2] + (q[2] - p[2]) * t;
    let along = p[axis] + (q[axis] - p[axis]) * t;
    if w <= 0.0 {
        return None;
    }
    let normal = [p[1] * q[2] - q[1] * p[2], p[2] * q[0] - q[2] * p[0]].map(f64::abs);
    let is_steep = if axis == 0 { normal[0] >= normal[1] } else { normal[1] > normal[0] };
    let distance = along / w;
    let d_t = ((q[axis] - p[axis]) - distance * (q[2] - p[2])) / w;
    let mut slopes = [[0.0; 3]; 2];
    for (end, share) in [(0, 1.0 - t), (1, t)] {
        slopes[end][axis] = share / w;
        slopes[end][2] = -distance * share / w;
    }
    slopes[0][across] = d_t * -q[across] / (span * span);
    slopes[1][across] = d_t * p[across] / (span * span);
    Some((distance, slopes, is_steep))
}

/// A mesh before a pixel's center.
struct View<'a> {
    antialias: &'a Antialias,
    positions: &'a [f64],
    triangles: &'a [[u32; 3]],
    image: usize,
    center: [f64; 2],
    axis: usize,
    step: f64,
}

impl View<'_> {
    fn offset(&self, v: u32) -> usize {
        (self.image * self.antialias.vertices + v as usize) * 4
    }

    fn half(&self) -> [f64; 2] {
        [0.5 * self.antialias.size[1] as f64, 0.5 * self.antialias.size[0] as f64]
    }

    fn end(&self, v: u32) -> End {
        let p = &self.positions[self.offset(v)..];
        let at = |k: usize| (p[k] + p[3]) * self.half()[k] - self.center[k] * p[3];
        [at(0), at(1), p[3]]
    }

    fn is_silhouette(&self, triangle: usize, i: usize) -> bool {
        let t = self.triangles[triangle];
        let side = |v: u32| determinant([t[(i + 1) % 3], t[(i + 2) % 3], v].map(|v| &self.positions[self.offset(v)..][..4]));
        let [(other, k)] = sharing(self.triangles, triangle, i)[..] else { return true };
        side(self.triangles[other][k]) * side(t[i]) >= 0.0
    }

    /// From the triangle at the center along the surface to the first silhouette: distance, and its slopes by offset.
    fn search(&self, mut triangle: usize) -> Option<(f64, [(usize, [f64; 4]); 2])> {
        let mut entered = None;
        for _ in 0..=self.antialias.follow {
            let t = self.triangles[triangle];
            let ends = |i: usize| [t[(i + 1) % 3], t[(i + 2) % 3]];
            let found = (0..3).filter(|i| Some(*i) != entered).filter_map(|i| {
                let [p, q] = ends(i).map(|v| self.end(v));
                Some((i, crossing(p, q, self.axis)?))
            });
            let (i, (distance, slopes, is_steep)) = found.max_by(|a, b| (self.step * a.1.0).total_cmp(&(self.step * b.1.0)))?;
            if !(0.0..=1.0).contains(&(self.step * distance)) {
                return None;
            }
            if self.is_silhouette(triangle, i) {
                let chain = |s: End| {
                    let (half, center) = (self.half(), self.center);
                    let d_w = s[2] + s[0] * (half[0] - center[0]) + s[1] * (half[1] - center[1]);
                    [s[0] * half[0], s[1] * half[1], 0.0, d_w].map(|v| self.step * v)
                };
                let [p, q] = ends(i).map(|v| self.offset(v));
                return is_steep.then(|| (self.step * distance, [(p, chain(slopes[0])), (q, chain(slopes[1]))]));
            }
            let (next, edge) = sharing(self.triangles, triangle, i)[0];
            (triangle, entered) = (next, Some(edge));
        }
        None
    }
}

fn find(a: &Antialias, positions: &[f64], triangles: &[[u32; 3]], visible: &Visible) -> Vec<Found> {
    let [h, w] = a.size;
    let mut all = Vec::new();
    for p in 0..a.images * h * w {
        for axis in 0..2 {
            let q = if axis == 0 { p + 1 } else { p + w };
            let outside = if axis == 0 { p % w + 1 == w } else { p / w % h + 1 == h };
            if outside || visible.ids[p] == visible.ids[q] {
                continue;
            }
            let key = |p: usize| if visible.ids[p] == 0 { (f64::INFINITY, 0) } else { (visible.depth[p], visible.ids[p]) };
            let (near, far) = if key(p) < key(q) { (p, q) } else { (q, p) };
            let center = [(near % w) as f64 + 0.5, (near / w % h) as f64 + 0.5];
            let step = if near == p { 1.0 } else { -1.0 };
            let view = View { antialias: a, positions, triangles, image: p / (h * w), center, axis, step };
            let found = view.search(visible.ids[near] as usize - 1);
            all.extend(found.map(|(distance, slopes)| Found { near, far, distance, slopes }));
        }
    }
    all
}

/// `[N, H, W, C]`
pub fn forward(a: &Antialias, positions: &[f64], triangles: &[[u32; 3]], visible: &Visible, colors: &[f64]) -> Vec<f64> {
    let (mut out, n) = (colors.to_vec(), a.channels);
    for f in find(a, positions, triangles, visible) {
        for k in 0..n {
            let difference = colors[f.far * n + k] - colors[f.near * n + k];
            if f.distance < 0.5 {
                out[f.near * n + k] += (0.5 - f.distance) * difference;
            } else {
                out[f.far * n + k] += (0.5 - f.distance) * difference;
            }
        }
    }
    out
}

/// Gradients of colors and of positions.
pub fn backward(
    a: &Antialias,
    positions: &[f64],
    triangles: &[[u32; 3]],
    visible: &Visible,
    colors: &[f64],
    d: &[f64],
) -> (Vec<f64>, Vec<f64>) {
    let (mut d_colors, mut d_positions, n) = (d.to_vec(), vec![0.0; positions.len()], a.channels);
    for f in find(a, positions, triangles, visible) {
        let to = if f.distance < 0.5 { f.near } else { f.far };
        let mut d_distance = 0.0;
        for k in 0..n {
            let (near, far) = (f.near * n + k, f.far * n + k);
            d_distance -= d[to * n + k] * (colors[far] - colors[near]);
            d_colors[far] += (0.5 - f.distance) * d[to * n + k];
            d_colors[near] -= (0.5 - f.distance) * d[to * n + k];
        }
        for (at, slopes) in f.slopes {
            (0..4).for_each(|k| d_positions[at + k] += d_distance * slopes[k]);
        }
    }
    (d_colors, d_positions)
}
