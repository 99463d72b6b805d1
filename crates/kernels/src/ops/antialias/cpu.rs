//! Crossings are found by tasks of some rows each, and blended in their order: they are few.

use super::{Antialias, Crossing, Topology, Visible};
use crate::ops::rasterize::check_triangles;
use crate::tasks::{self, Parts};

/// Rows per task.
const ROWS: usize = 16;
/// Triangles, or numbers that are copied, per task.
const BLOCK: usize = 1 << 12;

/// Positions in clip space, with sizes in pixels.
struct Scene<'a> {
    antialias: &'a Antialias,
    positions: &'a [f32],
    triangles: &'a [[u32; 3]],
    topology: &'a Topology,
}

/// The end of an edge relative to a pixel's center: along the segment between centers, across it, and w.
type End = [f64; 3];

/// Where an edge crosses the axis: `numerator / denominator`.
#[derive(Clone, Copy)]
struct Cut {
    numerator: f64,
    denominator: f64,
}

impl Cut {
    fn new(p: End, q: End) -> Cut {
        Cut { numerator: q[0] * p[1] - p[0] * q[1], denominator: p[1] * q[2] - q[1] * p[2] }
    }

    /// Gradients of both ends from that of the quotient.
    fn backward(&self, p: End, q: End, d: f64) -> [End; 2] {
        let d_numerator = d / self.denominator;
        let d_denominator = -d_numerator * self.numerator / self.denominator;
        let d_p = [-d_numerator * q[1], d_numerator * q[0] + d_denominator * q[2], -d_denominator * q[1]];
        let d_q = [d_numerator * p[1], -d_numerator * p[0] - d_denominator * p[2], d_denominator * p[1]];
        [d_p, d_q]
    }
}

/// Two pixels side by side.
#[derive(Clone, Copy)]
struct Pair {
    image: usize,
    /// Center of the nearer one, (x, y).
    center: [f64; 2],
    /// 0 if they are in one row, 1 if in one column.
    axis: usize,
    /// Whether the other one is to the right or below.
    step: f64,
}

impl Scene<'_> {
    fn vertex(&self, image: usize, v: u32) -> [f64; 4] {
        let at = (image * self.antialias.vertices + v as usize) * 4;
        std::array::from_fn(|k| self.positions[at + k] as f64)
    }

    /// Half the picture along an axis, in pixels.
    fn half(&self, axis: usize) -> f64 {
        0.5 * self.antialias.size[1 - axis] as f64
    }

    fn end(&self, pair: &Pair, v: u32) -> End {
        let p = self.vertex(pair.image, v);
        let at = |axis: usize| p[axis] * self.half(axis) + (self.half(axis) - pair.center[axis]) * p[3];
        [at(pair.axis), at(1 - pair.axis), p[3]]
    }

    /// Twice the volume that three vertices span with the camera; its sign is their turn in the picture.
    fn turn(&self, image: usize, [a, b, c]: [u32; 3]) -> f64 {
        let [a, b, c] = [a, b, c].map(|v| self.vertex(image, v));
        a[0] * (b[1] * c[3] - c[1] * b[3]) + a[1] * (b[3] * c[0] - c[3] * b[0]) + a[3] * (b[0] * c[1] - c[0] * b[1])
    }

    /// Bit `i`: whether edge `i` of a triangle is a silhouette.
    fn silhouettes(&self, image: usize, triangle: usize) -> u8 {
        let t = self.triangles[triangle];
        let own = self.turn(image, t);
        (0..3).fold(0, |bits, i| {
            let is = self.topology.across(triangle, i).is_none_or(|(other, edge)| {
                let side = self.turn(image, [t[(i + 1) % 3], t[(i + 2) % 3], self.triangles[other][edge]]);
                side == 0.0 || (side > 0.0) == (own >= 0.0)
            });
            bits | (is as u8) << i
        })
    }

    /// The edge, other than `entered`, through which the segment between a pair's centers leaves a triangle: its number, its distance, and
    /// whether it is steep enough to blend the pair.
    fn exit(&self, pair: &Pair, triangle: usize, entered: Option<usize>) -> Option<(usize, f64, bool)> {
        let ends = self.triangles[triangle].map(|v| self.end(pair, v));
        let mut last: Option<(usize, f64, bool)> = None;
        for i in (0..3).filter(|i| Some(*i) != entered) {
            let (p, q) = (ends[(i + 1) % 3], ends[(i + 2) % 3]);
            if (p[1] >= 0.0) == (q[1] >= 0.0) {
                continue;
            }
            let cut = Cut::new(p, q);
            let distance = pair.step * cut.numerator / cut.denominator;
            let is_before_camera = cut.denominator / (p[1] - q[1]) > 0.0;
            if is_before_camera && last.is_none_or(|l| distance > l.1) {
                // Both coefficients of the line are the same for all pixels.
                let (along, across) = (cut.denominator.abs(), (p[2] * q[0] - p[0] * q[2]).abs());
                last = Some((i, distance, if pair.axis == 0 { along >= across } else { along > across }));
            }
        }
        last
    }

    /// Follows the surface from a triangle at the nearer center to its silhouette: distance and edge.
    fn follow(&self, pair: &Pair, silhouettes: &[u8], mut triangle: usize, far: Option<usize>) -> Option<(f32, [u32; 2])> {
        let mut entered = None;
        for _ in 0..=self.antialias.follow {
            let (i, distance, is_steep) = self.exit(pair, triangle, entered)?;
            if !(0.0..=1.0).contains(&distance) {
                return None;
            }
            if silhouettes[triangle] >> i & 1 == 1 {
                let t = self.triangles[triangle];
                return is_steep.then_some((distance as f32, [t[(i + 1) % 3], t[(i + 2) % 3]]));
            }
            let (next, edge) = self.topology.across(triangle, i)?;
            if Some(next) == far {
                return None;
            }
            (triangle, entered) = (next, Some(edge));
        }
        None
    }
}

/// Bits of the silhouettes of all triangles, `[N, F]`.
fn silhouettes(scene: &Scene) -> Vec<u8> {
    let f = scene.triangles.len();
    let mut bits = vec![0; scene.antialias.images * f];
    let (n, parts) = (bits.len(), Parts::new(&mut bits));
    tasks::run(n.div_ceil(BLOCK), 16 * n, |task| {
        // SAFETY: each task has a chunk of its own.
        let bits = unsafe { parts.chunk(task, BLOCK) };
        for (i, bits) in (task * BLOCK..).zip(bits) {
            *bits = scene.silhouettes(i / f, i % f);
        }
    });
    bits
}

impl Antialias {
    fn pixels(&self) -> usize {
        self.images * self.size[0] * self.size[1]
    }
}

/// Crossings of silhouettes with segments between centers of neighbors, in the pixels' order.
///
/// # Shapes
/// positions `[N, V, 4]`, triangles `[F, 3]`, ids and depths `[N, H, W]`.
///
/// # Panics
/// When shapes disagree, or a triangle names a vertex that is not there.
pub fn find(a: &Antialias, positions: &[f32], triangles: &[[u32; 3]], topology: &Topology, visible: Visible) -> Vec<Crossing> {
    assert_eq!(positions.len(), a.images * a.vertices * 4, "antialias: positions");
    assert!(visible.ids.len() == a.pixels() && visible.depth.len() == a.pixels(), "antialias: pixels");
    assert!(a.pixels() <= u32::MAX as usize, "antialias: too many pixels");
    assert_eq!(topology.len(), triangles.len(), "antialias: topology");
    check_triangles("antialias", triangles, a.vertices);
    let scene = Scene { antialias: a, positions, triangles, topology };
    let silhouettes = silhouettes(&scene);
    let ([h, w], rows) = (a.size, a.images * a.size[0]);
    let mut found: Vec<Vec<Crossing>> = vec![Vec::new(); rows.div_ceil(ROWS)];
    let (n, parts) = (found.len(), Parts::new(&mut found));
    tasks::run(n, a.pixels(), |task| {
        // SAFETY: each task has an element of its own.
        let found = &mut unsafe { parts.range(task..task + 1) }[0];
        for row in task * ROWS..((task + 1) * ROWS).min(rows) {
            let (image, y) = (row / h, row % h);
            let silhouettes = &silhouettes[image * triangles.len()..(image + 1) * triangles.len()];
            let mut visit = |x: usize, p: usize, q: usize, axis: usize| {
                let near_first = is_nearer(&visible, p, q);
                let (near, far) = if near_first { (p, q) } else { (q, p) };
                let triangle = visible.ids[near] as usize - 1;
                if a.follow == 0 && silhouettes[triangle] == 0 {
                    return;
                }
                let mut center = [x as f64 + 0.5, y as f64 + 0.5];
                center[axis] += if near_first { 0.0 } else { 1.0 };
                let pair = Pair { image, center, axis, step: if near_first { 1.0 } else { -1.0 } };
                let beside = visible.ids[far].checked_sub(1).map(|t| t as usize);
                let crossing = scene.follow(&pair, silhouettes, triangle, beside);
                found.extend(crossing.map(|(distance, edge)| Crossing { near: near as u32, far: far as u32, distance, edge }));
            };
            let ids = &visible.ids[row * w..];
            for x in 0..w {
                let p = row * w + x;
                if x + 1 < w && ids[x] != ids[x + 1] {
                    visit(x, p, p + 1, 0);
                }
                if y + 1 < h && ids[x] != ids[x + w] {
                    visit(x, p, p + w, 1);
                }
            }
        }
    });
    found.concat()
}

/// Whether pixel `p` shows the nearer triangle: not the background, less deep, of equals the first.
#[inline(always)]
fn is_nearer(visible: &Visible, p: usize, q: usize) -> bool {
    match (visible.ids[p], visible.ids[q]) {
        (0, _) => false,
        (_, 0) => true,
        (i, j) => (visible.depth[p], i) < (visible.depth[q], j),
    }
}

fn copy(from: &[f32], to: &mut [f32]) {
    let parts = Parts::new(to);
    tasks::run(from.len().div_ceil(BLOCK), from.len(), |task| {
        // SAFETY: each task has a chunk of its own.
        let to = unsafe { parts.chunk(task, BLOCK) };
        to.copy_from_slice(&from[task * BLOCK..][..to.len()]);
    });
}

/// The pixel that gets a share of its neighbor's color, the neighbor, and the share.
fn blend(c: &Crossing) -> (usize, usize, f32) {
    let share = 0.5 - c.distance;
    if share > 0.0 { (c.near as usize, c.far as usize, share) } else { (c.far as usize, c.near as usize, -share) }
}

/// Colors with the silhouettes blended.
///
/// # Shapes
/// crossings of [`find`]; colors and out `[N, H, W, C]`.
///
/// # Panics
/// When shapes disagree.
pub fn forward(a: &Antialias, crossings: &[Crossing], colors: &[f32], out: &mut [f32]) {
    let n = a.channels;
    assert!(colors.len() == a.pixels() * n && out.len() == colors.len(), "antialias: colors");
    copy(colors, out);
    for c in crossings {
        let (to, from, share) = blend(c);
        let (to, from) = (to * n, from * n);
        (0..n).for_each(|k| out[to + k] += share * (colors[from + k] - colors[to + k]));
    }
}

/// Gradients of colors and of positions, both overwritten.
///
/// # Shapes
/// As [`find`] and [`forward`]; d and d_colors `[N, H, W, C]`, d_positions `[N, V, 4]`, whose z stay 0.
///
/// # Panics
/// When shapes disagree.
pub fn backward(
    a: &Antialias,
    positions: &[f32],
    crossings: &[Crossing],
    colors: &[f32],
    d: &[f32],
    d_colors: &mut [f32],
    d_positions: &mut [f32],
) {
    let ([h, w], n) = (a.size, a.channels);
    assert!(colors.len() == a.pixels() * n && d.len() == colors.len() && d_colors.len() == d.len(), "antialias: colors");
    assert!(positions.len() == a.images * a.vertices * 4 && d_positions.len() == positions.len(), "antialias: positions");
    copy(d, d_colors);
    d_positions.fill(0.0);
    let topology = Topology::new(&[]);
    let scene = Scene { antialias: a, positions, triangles: &[], topology: &topology };
    for c in crossings {
        let (to, from, share) = blend(c);
        let (to, from) = (to * n, from * n);
        let mut d_share = 0.0;
        for k in 0..n {
            d_share += d[to + k] * (colors[from + k] - colors[to + k]);
            d_colors[from + k] += share * d[to + k];
            d_colors[to + k] -= share * d[to + k];
        }
        let (near, far) = (c.near as usize, c.far as usize);
        let (axis, step) = (near.abs_diff(far) == w && near % w == far % w, if far > near { 1.0 } else { -1.0 });
        let (x, y, image) = (near % w, near / w % h, near / (w * h));
        let pair = Pair { image, center: [x as f64 + 0.5, y as f64 + 0.5], axis: axis as usize, step };
        let d_distance = if to == near * n { -d_share } else { d_share } as f64;
        let [p, q] = c.edge.map(|v| scene.end(&pair, v));
        let ends = Cut::new(p, q).backward(p, q, pair.step * d_distance);
        for (v, end) in c.edge.into_iter().zip(ends) {
            let to = &mut d_positions[(image * a.vertices + v as usize) * 4..][..4];
            let mut d_w = end[2];
            for (k, axis) in [pair.axis, 1 - pair.axis].into_iter().enumerate() {
                to[axis] += (end[k] * scene.half(axis)) as f32;
                d_w += end[k] * (scene.half(axis) - pair.center[axis]);
            }
            to[3] += d_w as f32;
        }
    }
}
