//! Level of detail of a pixel: the length in texels of the longer axis of the ellipse that the pixel's footprint is (Heckbert 1989),
//! `½ log₂ λ` with λ the larger eigenvalue of `J Jᵀ`, where J is the derivative of (s W, t H) along the screen.

use super::{FACES, Kind, Texture, dot, face_of};
use crate::tasks::{self, Parts};

/// Points per task.
const BLOCK: usize = 4096;
/// Smallest λ, of level −20; smaller ones have no gradient.
const LEAST: f32 = 1.0 / (1u64 << 40) as f32;

/// `JJᵀ` by its elements, and the larger eigenvalue with its slopes.
struct Ellipse {
    value: f32,
    along: [f32; 3],
}

impl Ellipse {
    fn new([s, t]: [[f32; 2]; 2]) -> Ellipse {
        let (a, b, c) = (s[0] * s[0] + s[1] * s[1], t[0] * t[0] + t[1] * t[1], s[0] * t[0] + s[1] * t[1]);
        let half = 0.5 * (a - b);
        let root = (half * half + c * c).sqrt();
        let (turn, skew) = if root > 0.0 { (0.5 * half / root, c / root) } else { (0.0, 0.0) };
        Ellipse { value: 0.5 * (a + b) + root, along: [0.5 + turn, 0.5 - turn, skew] }
    }
}

/// A direction's derivatives as those of its face's coordinates, and their gradients back again.
struct Projected {
    face: [[f32; 3]; 3],
    depth: f32,
    place: [f32; 2],
    slopes: [[f32; 2]; 2],
}

impl Projected {
    fn new(d: [f32; 3], along: [[f32; 3]; 2]) -> Projected {
        let face = FACES[face_of(d)];
        let depth = dot(d, face[0]);
        let place = [dot(d, face[1]) / depth, dot(d, face[2]) / depth];
        let slope = |i: usize, axis: usize| (dot(along[axis], face[1 + i]) - place[i] * dot(along[axis], face[0])) * (0.5 / depth);
        Projected { face, depth, place, slopes: std::array::from_fn(|i| [slope(i, 0), slope(i, 1)]) }
    }

    /// Gradients of the direction and of its derivatives.
    fn backward(&self, along: [[f32; 3]; 2], d_slopes: [[f32; 2]; 2]) -> ([f32; 3], [[f32; 3]; 2]) {
        let (mut d_direction, mut d_along) = ([0.0; 3], [[0.0; 3]; 2]);
        for i in 0..2 {
            for axis in 0..2 {
                let (d, major) = (d_slopes[i][axis], self.face[0]);
                let forward = dot(along[axis], major) * 0.5 / (self.depth * self.depth);
                for k in 0..3 {
                    let across = self.face[1 + i][k] - self.place[i] * major[k];
                    d_along[axis][k] += d * across * 0.5 / self.depth;
                    d_direction[k] -= d * (across * forward + self.slopes[i][axis] * major[k] / self.depth);
                }
            }
        }
        (d_direction, d_along)
    }
}

/// Screen derivatives of (s, t).
#[derive(Clone, Copy)]
struct Slopes {
    projected: [[f32; 2]; 2],
    /// Texels along s and t.
    scale: [f32; 2],
}

impl Slopes {
    fn scaled(&self) -> [[f32; 2]; 2] {
        std::array::from_fn(|i| self.projected[i].map(|v| v * self.scale[i]))
    }

    fn level(&self) -> f32 {
        let value = Ellipse::new(self.scaled()).value;
        // What is no number reads the finest level.
        0.5 * (if value > LEAST { value } else { LEAST }).log2()
    }

    fn backward(&self, d: f32) -> [[f32; 2]; 2] {
        let ([s, t], ellipse) = (self.scaled(), Ellipse::new(self.scaled()));
        let d = if ellipse.value > LEAST { d * 0.5 * std::f32::consts::LOG2_E / ellipse.value } else { 0.0 };
        let [a, b, c] = ellipse.along.map(|v| v * d);
        [
            std::array::from_fn(|k| (2.0 * a * s[k] + c * t[k]) * self.scale[0]),
            std::array::from_fn(|k| (2.0 * b * t[k] + c * s[k]) * self.scale[1]),
        ]
    }
}

fn check(t: &Texture, coordinates: usize, derivatives: usize, level: usize) {
    let n = t.coordinates();
    assert!(coordinates == n * level && derivatives == 2 * n * level, "texture: footprints");
}

fn scale(t: &Texture) -> [f32; 2] {
    [t.size[1] as f32, t.size[0] as f32]
}

/// Derivatives of a direction along the screen's axes.
fn along(derivatives: &[f32]) -> [[f32; 3]; 2] {
    std::array::from_fn(|axis| std::array::from_fn(|k| derivatives[2 * k + axis]))
}

/// Levels of points, which may be below 0 or beyond the coarsest level; a bias can be added to them.
///
/// # Shapes
/// coordinates `[P, 2]` or `[P, 3]`, derivatives `[P, 2, 2]` or `[P, 3, 2]` of `∂/∂X, ∂/∂Y` for each coordinate, level `[P]`.
///
/// # Panics
/// When shapes disagree.
pub fn forward(t: &Texture, coordinates: &[f32], derivatives: &[f32], level: &mut [f32]) {
    check(t, coordinates.len(), derivatives.len(), level.len());
    let (n, scale, total) = (t.coordinates(), scale(t), level.len());
    let parts = Parts::new(level);
    tasks::run(total.div_ceil(BLOCK), 16 * total, |task| {
        // SAFETY: each task has a chunk of its own.
        let level = unsafe { parts.chunk(task, BLOCK) };
        for (p, level) in (task * BLOCK..).zip(level) {
            let (c, d) = (&coordinates[n * p..][..n], &derivatives[2 * n * p..][..2 * n]);
            let projected = match t.kind {
                Kind::Cube => Projected::new([c[0], c[1], c[2]], along(d)).slopes,
                _ => [[d[0], d[1]], [d[2], d[3]]],
            };
            *level = Slopes { projected, scale }.level();
        }
    });
}

/// Gradients of derivatives, and of coordinates where levels depend on them (cube maps), both overwritten.
///
/// # Shapes
/// As [`forward`]; d_level `[P]`, d_coordinates as coordinates, d_derivatives as derivatives.
///
/// # Panics
/// When shapes disagree.
pub fn backward(
    t: &Texture,
    coordinates: &[f32],
    derivatives: &[f32],
    d_level: &[f32],
    d_coordinates: &mut [f32],
    d_derivatives: &mut [f32],
) {
    check(t, coordinates.len(), derivatives.len(), d_level.len());
    check(t, d_coordinates.len(), d_derivatives.len(), d_level.len());
    let (n, scale, total) = (t.coordinates(), scale(t), d_level.len());
    let (to_coordinates, to_derivatives) = (Parts::new(d_coordinates), Parts::new(d_derivatives));
    tasks::run(total.div_ceil(BLOCK), 32 * total, |task| {
        // SAFETY: each task has chunks of its own.
        let (to_c, to_d) = unsafe { (to_coordinates.chunk(task, n * BLOCK), to_derivatives.chunk(task, 2 * n * BLOCK)) };
        to_c.fill(0.0);
        for (i, (to_c, to_d)) in to_c.chunks_exact_mut(n).zip(to_d.chunks_exact_mut(2 * n)).enumerate() {
            let p = task * BLOCK + i;
            let (c, d) = (&coordinates[n * p..][..n], &derivatives[2 * n * p..][..2 * n]);
            if t.kind != Kind::Cube {
                let projected = [[d[0], d[1]], [d[2], d[3]]];
                to_d.copy_from_slice(Slopes { projected, scale }.backward(d_level[p]).as_flattened());
                continue;
            }
            let projected = Projected::new([c[0], c[1], c[2]], along(d));
            let d_slopes = Slopes { projected: projected.slopes, scale }.backward(d_level[p]);
            let (d_direction, d_along) = projected.backward(along(d), d_slopes);
            to_c.copy_from_slice(&d_direction);
            (0..6).for_each(|k| to_d[k] = d_along[k % 2][k / 2]);
        }
    });
}
