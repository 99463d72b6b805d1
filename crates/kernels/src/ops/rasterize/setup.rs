//! What a triangle's pixels share: exact edge functions in integers, those of barycentrics, and the depth's plane, in f64.

use super::{GRID, TILE, WIDEST};

/// Distance in pixels by which bounds and tiles of triangles off the grid are widened, more than what evaluation in f32 rounds.
const MARGIN: f64 = 1e-3;

/// A vertex in pixels, still homogeneous. On the grid, `x` and `y` are `w` times a whole number of its steps.
#[derive(Clone, Copy, Debug)]
pub(super) struct Vertex {
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub w: f64,
    /// Steps of the grid; [`OFF`] for a vertex at the camera, behind it, or far outside.
    pub grid: [i32; 2],
}

/// Not on the grid.
const OFF: [i32; 2] = [i32::MIN; 2];

impl Vertex {
    /// From clip space, moved to the grid.
    #[inline(always)]
    pub fn new(p: [f32; 4], [h, w]: [usize; 2]) -> Vertex {
        // Adding and taking away 1.5 · 2⁵² rounds to a whole number.
        const ROUND: f64 = 6_755_399_441_055_744.0;
        let p = p.map(f64::from);
        let (x, y) = ((p[0] + p[3]) * (0.5 * w as f64), (p[1] + p[3]) * (0.5 * h as f64));
        let per_w = GRID / p[3];
        let (along, down) = ((x * per_w + ROUND) - ROUND, (y * per_w + ROUND) - ROUND);
        let off = Vertex { x, y, z: p[2], w: p[3], grid: OFF };
        if p[3] > 0.0 && along.abs() <= WIDEST && down.abs() <= WIDEST {
            let step = p[3] / GRID;
            Vertex { x: along * step, y: down * step, grid: [along as i32, down as i32], ..off }
        } else {
            off
        }
    }

    fn array(&self) -> [f64; 4] {
        [self.x, self.y, self.z, self.w]
    }
}

/// First and last pixel along x and y; the last is below the first where nothing is covered.
#[derive(Clone, Copy, Debug)]
pub(super) struct Span {
    pub first: [i32; 2],
    pub last: [i32; 2],
}

/// Affine functions `x X + y Y + one`, of which those of the edges face the corners and are positive inside.
#[derive(Clone, Copy, Debug)]
pub(super) struct Setup {
    /// Of pixel coordinates: weights of the corners up to a factor, and z/w.
    pub x: [f64; 4],
    pub y: [f64; 4],
    pub one: [f64; 4],
    /// Of a pixel's column and row, exact: at least 0 where the pixel's center is inside, or on an edge that is the triangle's.
    pub edge_x: [i32; 3],
    pub edge_y: [i32; 3],
    pub edge_one: [i64; 3],
    /// Whether all corners are on the grid; if not, the weights tell what is inside.
    pub is_exact: bool,
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

/// Whether a center on an edge belongs to the triangle.
#[inline(always)]
pub(super) fn is_top_left(x: f64, y: f64) -> bool {
    x > 0.0 || x == 0.0 && y > 0.0
}

impl Span {
    pub const EMPTY: Span = Span { first: [0; 2], last: [-1; 2] };

    /// Pixels whose centers lie between corners on the grid.
    #[inline(always)]
    fn on_grid(corners: &[&Vertex; 3], pixels: [usize; 2]) -> Span {
        const STEP: i32 = GRID as i32;
        let range = |k: usize| {
            let [a, b, c] = corners.map(|v| v.grid[k]);
            (a.min(b).min(c), a.max(b).max(c))
        };
        let ends = [range(0), range(1)];
        // Centers lie half a pixel beyond whole ones.
        let first = ends.map(|(low, _)| ((low - STEP / 2 + STEP - 1).div_euclid(STEP)).max(0));
        let last = std::array::from_fn(|k| (ends[k].1 - STEP / 2).div_euclid(STEP).min(pixels[k] as i32 - 1));
        Span { first, last }
    }

    fn is_empty(&self) -> bool {
        (0..2).any(|k| self.last[k] < self.first[k])
    }

    /// Calls `visit(tile along x, tile along y)` for the tiles that the triangle of a setup may cover, row by row.
    #[inline(always)]
    pub fn each_tile(&self, setup: &Setup, mut visit: impl FnMut(usize, usize)) {
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
                if setup.may_cover(tx * tile, ty * tile) {
                    visit(tx as usize, ty as usize);
                }
            }
        }
    }
}

impl Setup {
    const EMPTY: Setup =
        Setup { x: [0.0; 4], y: [0.0; 4], one: [0.0; 4], edge_x: [0; 3], edge_y: [0; 3], edge_one: [0; 3], is_exact: false };

    /// Functions of a triangle, and where it is; nowhere if it is seen from its edge or not at all.
    #[inline(always)]
    pub fn new(corners: [&Vertex; 3], size: [usize; 2]) -> (Setup, Span) {
        let p = corners.map(Vertex::array);
        let (mut x, mut y, mut one) = ([0.0; 4], [0.0; 4], [0.0; 4]);
        for i in 0..3 {
            let (j, k) = (&p[(i + 1) % 3], &p[(i + 2) % 3]);
            x[i] = j[1] * k[3] - k[1] * j[3];
            y[i] = j[3] * k[0] - k[3] * j[0];
            one[i] = j[0] * k[1] - k[0] * j[1];
        }
        let volume = p[0][0] * x[0] + p[0][1] * y[0] + p[0][3] * one[0];
        let size_of = x.iter().chain(&y).fold(0.0f64, |m, v| m.max(v.abs()));
        let is_usable = volume != 0.0 && volume.is_finite() && size_of.is_normal() && one.iter().all(|v| v.is_finite());
        if !is_usable {
            return (Setup::EMPTY, Span::EMPTY);
        }
        for f in [&mut x, &mut y, &mut one] {
            f[3] = (0..3).map(|i| f[i] * p[i][2]).sum::<f64>() / volume;
        }
        // The inverse of the largest slope's power of two.
        let scale = f64::from_bits((2046 - (size_of.to_bits() >> 52).clamp(1, 2045)) << 52).copysign(volume);
        for f in [&mut x, &mut y, &mut one] {
            (0..3).for_each(|i| f[i] *= scale);
        }
        let mut setup = Setup { x, y, one, ..Setup::EMPTY };
        let pixels = [size[1], size[0]];
        if corners.iter().all(|c| c.grid != OFF) {
            let covers = setup.set_edges(corners.map(|c| c.grid));
            return (setup, if covers { Span::on_grid(&corners, pixels) } else { Span::EMPTY });
        }
        let Some((low, high)) = bounds(&p) else { return (Setup::EMPTY, Span::EMPTY) };
        let first = std::array::from_fn(|k| (low[k] - 0.5 - MARGIN).ceil().clamp(0.0, pixels[k] as f64) as i32);
        let last = std::array::from_fn(|k| (high[k] - 0.5 + MARGIN).floor().clamp(-1.0, pixels[k] as f64 - 1.0) as i32);
        (setup, Span { first, last })
    }

    /// Exact edge functions of corners on the grid; false if these lie on a line.
    #[inline(always)]
    fn set_edges(&mut self, p: [[i32; 2]; 3]) -> bool {
        let wide = |v: i32| v as i64;
        let area = wide(p[1][0] - p[0][0]) * wide(p[2][1] - p[0][1]) - wide(p[1][1] - p[0][1]) * wide(p[2][0] - p[0][0]);
        let sign = area.signum() as i32;
        for i in 0..3 {
            let (j, k) = (p[(i + 1) % 3], p[(i + 2) % 3]);
            let (x, y) = (sign * (j[1] - k[1]), sign * (k[0] - j[0]));
            let one = -(wide(x) * wide(j[0]) + wide(y) * wide(j[1]));
            // At the centers of pixels the function is GRID (x column + y row) + the rest, whose integer part decides.
            let rest = GRID as i64 / 2 * (wide(x) + wide(y)) + one - !is_top_left(x as f64, y as f64) as i64;
            (self.edge_x[i], self.edge_y[i], self.edge_one[i]) = (x, y, rest.div_euclid(GRID as i64));
        }
        self.is_exact = true;
        area != 0
    }

    /// Whether no edge has all of a tile outside.
    #[inline(always)]
    fn may_cover(&self, left: i32, top: i32) -> bool {
        if self.is_exact {
            let most = TILE as i64 - 1;
            return (0..3).all(|i| {
                let (x, y) = (self.edge_x[i] as i64, self.edge_y[i] as i64);
                x * left as i64 + y * top as i64 + self.edge_one[i] + most * (x.max(0) + y.max(0)) >= 0
            });
        }
        let (half, reach) = (0.5 * TILE as f64, 0.5 * TILE as f64 + MARGIN);
        (0..3).all(|i| {
            let center = self.x[i] * (left as f64 + half) + self.y[i] * (top as f64 + half) + self.one[i];
            center + (self.x[i].abs() + self.y[i].abs()) * reach >= 0.0
        })
    }
}
