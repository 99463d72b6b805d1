//! What a triangle's pixels share: edge functions and the depth's plane, in f64.

use super::TILE;

/// Distance in pixels by which bounds and tiles are widened, more than what evaluation in f32 rounds.
const MARGIN: f64 = 1e-3;

/// Affine functions `x X + y Y + one` of pixel coordinates: those of the edges, which face the corners and are positive inside, and z/w.
///
/// Edge functions are scaled by a power of two, so that two triangles' functions of one edge are the exact negatives of each other up to
/// such a factor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Setup {
    pub x: [f64; 4],
    pub y: [f64; 4],
    pub one: [f64; 4],
    /// First and last pixel along x and y; the last is below the first where nothing is covered.
    pub first: [i32; 2],
    pub last: [i32; 2],
}

/// Clip space in pixels, still homogeneous: `(x, y, z, w)`.
fn in_pixels(p: [f32; 4], [h, w]: [usize; 2]) -> [f64; 4] {
    let p = p.map(f64::from);
    [(p[0] + p[3]) * (0.5 * w as f64), (p[1] + p[3]) * (0.5 * h as f64), p[2], p[3]]
}

/// Lowest and highest x and y of what is before the near plane, or `None` if nothing is.
fn bounds(corners: &[[f64; 4]; 3]) -> Option<([f64; 2], [f64; 2])> {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let mut add = |p: [f64; 4]| {
        for k in 0..2 {
            // Nothing is known about what is at the camera or behind it.
            let (l, h) = if p[3] > 0.0 { (p[k] / p[3], p[k] / p[3]) } else { (f64::NEG_INFINITY, f64::INFINITY) };
            (low[k], high[k]) = (low[k].min(l), high[k].max(h));
        }
    };
    if corners.iter().all(|p| p[3] > 0.0) {
        corners.iter().for_each(|p| add(*p));
        return Some((low, high));
    }
    let before = |p: &[f64; 4]| p[2] + p[3];
    for (i, p) in corners.iter().enumerate() {
        let q = &corners[(i + 1) % 3];
        let (a, b) = (before(p), before(q));
        if a >= 0.0 {
            add(*p);
        }
        if (a >= 0.0) != (b >= 0.0) {
            add(std::array::from_fn(|k| p[k] + (q[k] - p[k]) * (a / (a - b))));
        }
    }
    (low[0] <= high[0]).then_some((low, high))
}

impl Setup {
    const EMPTY: Setup = Setup { x: [0.0; 4], y: [0.0; 4], one: [0.0; 4], first: [0; 2], last: [-1; 2] };

    /// Functions of a triangle of corners in clip space; empty where it is seen from its edge or not at all.
    pub fn new(corners: [[f32; 4]; 3], size: [usize; 2]) -> Setup {
        let p = corners.map(|c| in_pixels(c, size));
        let (mut x, mut y, mut one) = ([0.0; 4], [0.0; 4], [0.0; 4]);
        for i in 0..3 {
            let (j, k) = (&p[(i + 1) % 3], &p[(i + 2) % 3]);
            x[i] = j[1] * k[3] - k[1] * j[3];
            y[i] = j[3] * k[0] - k[3] * j[0];
            one[i] = j[0] * k[1] - k[0] * j[1];
        }
        let volume = p[0][0] * x[0] + p[0][1] * y[0] + p[0][3] * one[0];
        let size_of = x.iter().chain(&y).fold(0.0f64, |m, v| m.max(v.abs()));
        let usable = volume != 0.0 && volume.is_finite() && size_of.is_normal() && one.iter().all(|v| v.is_finite());
        let Some((low, high)) = usable.then(|| bounds(&p)).flatten() else { return Setup::EMPTY };
        for f in [&mut x, &mut y, &mut one] {
            f[3] = (0..3).map(|i| f[i] * p[i][2]).sum::<f64>() / volume;
        }
        // The inverse of the largest slope's power of two.
        let scale = f64::from_bits((2046 - (size_of.to_bits() >> 52).clamp(1, 2045)) << 52).copysign(volume);
        for f in [&mut x, &mut y, &mut one] {
            (0..3).for_each(|i| f[i] *= scale);
        }
        let pixels = [size[1], size[0]];
        let first = std::array::from_fn(|k| (low[k] - 0.5 - MARGIN).ceil().clamp(0.0, pixels[k] as f64) as i32);
        let last = std::array::from_fn(|k| (high[k] - 0.5 + MARGIN).floor().clamp(-1.0, pixels[k] as f64 - 1.0) as i32);
        Setup { x, y, one, first, last }
    }

    pub fn is_empty(&self) -> bool {
        (0..2).any(|k| self.last[k] < self.first[k])
    }

    /// Calls `visit(tile along x, tile along y)` for the tiles that the triangle may cover, row by row.
    #[inline(always)]
    pub fn each_tile(&self, mut visit: impl FnMut(usize, usize)) {
        if self.is_empty() {
            return;
        }
        let tile = TILE as i32;
        let (first, last) = (self.first.map(|v| v / tile), self.last.map(|v| v / tile));
        if first == last {
            return visit(first[0] as usize, first[1] as usize);
        }
        for ty in first[1]..=last[1] {
            for tx in first[0]..=last[0] {
                if self.may_cover((tx * tile) as f64, (ty * tile) as f64) {
                    visit(tx as usize, ty as usize);
                }
            }
        }
    }

    /// Whether no edge has all of a tile outside.
    #[inline(always)]
    fn may_cover(&self, left: f64, top: f64) -> bool {
        let (half, reach) = (0.5 * TILE as f64, 0.5 * TILE as f64 + MARGIN);
        (0..3).all(|i| {
            let center = self.x[i] * (left + half) + self.y[i] * (top + half) + self.one[i];
            center + (self.x[i].abs() + self.y[i].abs()) * reach >= 0.0
        })
    }
}
