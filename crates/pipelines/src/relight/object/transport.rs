//! Light transport on a mesh that no longer moves: which parts of the light each vertex sees, which other vertices it sees instead, and how
//! bright it is in a light (radiosity, Goral et al. 1984; precomputed transfer, Sloan, Kautz and Snyder 2002).
//!
//! Values are irradiance divided by π: what a white surface sends. A ray is traced from every vertex through every texel of a coarse light,
//! at a random place in it.

use diorama_geom::mesh::sub;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::ray_triangles::{Bvh, Hit, Ray, cpu as rays};
use diorama_kernels::ops::texture::cube_direction;
use rayon::prelude::*;

/// Edge of the faces of the coarse light, and of one for meshes of many vertices.
const EDGES: [usize; 2] = [16, 8];
/// Vertices beyond which the coarser one is used.
const MANY: usize = 40_000;
/// Vertices whose rays are traced at once.
const BLOCK: usize = 256;
/// Distance from the surface at which rays begin, in object space.
const OFFSET: f32 = 2e-4;
/// Bounces of light between surfaces.
const BOUNCES: usize = 3;
/// Stream of random numbers.
const PLACES: u64 = 34;

/// Weights of each vertex on what it sees.
#[derive(Clone, Debug, Default)]
struct Rows {
    offsets: Vec<u32>,
    entries: Vec<(u32, f32)>,
}

impl Rows {
    fn row(&self, i: usize) -> &[(u32, f32)] {
        &self.entries[self.offsets[i] as usize..self.offsets[i + 1] as usize]
    }

    fn push(&mut self, row: &[(u32, f32)]) {
        if self.offsets.is_empty() {
            self.offsets.push(0);
        }
        self.entries.extend_from_slice(row);
        self.offsets.push(self.entries.len() as u32);
    }

    /// `out[i] = Σ w x[j]`
    fn multiply(&self, x: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let of = |i: usize| {
            let mut sum = [0.0f32; 3];
            for (j, w) in self.row(i) {
                let x = &x[*j as usize];
                (0..3).for_each(|k| sum[k] += w * x[k]);
            }
            sum
        };
        (0..self.offsets.len().saturating_sub(1)).into_par_iter().with_min_len(64).map(of).collect()
    }

    /// `out[j] = Σ w d[i]` over `columns`.
    fn transposed_multiply(&self, d: &[[f32; 3]], columns: usize) -> Vec<[f32; 3]> {
        // A fixed number of parts, added in order: the result does not depend on threads.
        const PARTS: usize = 16;
        let each = d.len().div_ceil(PARTS).max(1);
        let parts: Vec<Vec<[f32; 3]>> = d
            .par_chunks(each)
            .enumerate()
            .map(|(c, d)| {
                let mut out = vec![[0.0f32; 3]; columns];
                for (i, d) in d.iter().enumerate().filter(|(_, d)| **d != [0.0; 3]) {
                    for (j, w) in self.row(c * each + i) {
                        (0..3).for_each(|k| out[*j as usize][k] += w * d[k]);
                    }
                }
                out
            })
            .collect();
        let mut sum = vec![[0.0f32; 3]; columns];
        parts.iter().for_each(|p| sum.iter_mut().zip(p).for_each(|(s, p)| (0..3).for_each(|k| s[k] += p[k])));
        sum
    }
}

/// What the vertices of a mesh see.
#[derive(Clone, Debug)]
pub struct Transport {
    /// Edge of the faces of the coarse light.
    pub edge: usize,
    bvh: Bvh,
    faces: Vec<[u32; 3]>,
    /// Texels of the coarse light that are seen, and vertices in the way of others.
    open: Rows,
    blocked: Rows,
}

/// Light at the vertices, `[V]`.
#[derive(Clone, Debug, Default)]
pub struct VertexLight {
    /// From the light itself.
    pub direct: Vec<[f32; 3]>,
    /// From other surfaces.
    pub indirect: Vec<[f32; 3]>,
    /// Radiance that diffuse reflection sends.
    pub sent: Vec<[f32; 3]>,
}

impl Transport {
    /// Traces the rays of all vertices.
    pub fn new(positions: &[[f32; 3]], normals: &[[f32; 3]], faces: &[[u32; 3]], seed: u64) -> Transport {
        let edge = EDGES[(positions.len() > MANY) as usize];
        let bvh = Bvh::build(positions, faces);
        let mut t = Transport { edge, bvh, faces: faces.to_vec(), open: Rows::default(), blocked: Rows::default() };
        let solid_angles: Vec<f32> = (0..6 * edge * edge).map(|i| solid_angle(i, edge)).collect();
        for first in (0..positions.len()).step_by(BLOCK) {
            let block = first..(first + BLOCK).min(positions.len());
            let from: Vec<(u32, u32, f32, Ray)> =
                block.clone().into_par_iter().flat_map_iter(|v| t.rays_of(v, positions[v], normals[v], seed, &solid_angles)).collect();
            let cast: Vec<Ray> = from.iter().map(|f| f.3).collect();
            let mut hits = vec![Hit::NONE; cast.len()];
            rays::nearest(&t.bvh, &cast, &mut hits);
            let (mut open, mut blocked): (Vec<Vec<_>>, Vec<Vec<_>>) = (vec![Vec::new(); block.len()], vec![Vec::new(); block.len()]);
            for ((v, texel, w, _), hit) in from.iter().zip(&hits) {
                let at = *v as usize - first;
                match t.corner(hit).filter(|_| !t.faces[hit.triangle as usize].contains(v)) {
                    Some(other) => blocked[at].push((other, *w)),
                    None => open[at].push((*texel, *w)),
                }
            }
            for (open, blocked) in open.iter_mut().zip(&mut blocked) {
                let sum: f32 = open.iter().chain(blocked.iter()).map(|e| e.1).sum();
                open.iter_mut().chain(blocked.iter_mut()).for_each(|e| e.1 /= sum.max(1e-12));
                t.open.push(open);
                t.blocked.push(blocked);
            }
        }
        t
    }

    /// A ray of a vertex through each texel above its tangent plane: vertex, texel, weight, ray.
    fn rays_of(&self, v: usize, p: [f32; 3], n: [f32; 3], seed: u64, solid_angles: &[f32]) -> Vec<(u32, u32, f32, Ray)> {
        let n = unit(n);
        let (origin, rng) = (std::array::from_fn(|k| p[k] + OFFSET * n[k]), Rng::new(seed, PLACES));
        let (edge, texels) = (self.edge, solid_angles.len());
        let of = |i: usize| {
            let (face, y, x) = (i / (edge * edge), i / edge % edge, i % edge);
            let place = |first: usize, c: usize| (first as f32 + rng.uniform((2 * (v * texels + i) + c) as u64)) / edge as f32;
            let d = unit(cube_direction(face, place(x, 0), place(y, 1)));
            let cosine = dot(n, d);
            let ray = Ray { origin, direction: d, range: [0.0, f32::INFINITY] };
            (cosine > 0.0).then_some((v as u32, i as u32, cosine * solid_angles[i], ray))
        };
        (0..texels).filter_map(of).collect()
    }

    /// The nearest corner of the triangle that a ray hit.
    fn corner(&self, hit: &Hit) -> Option<u32> {
        let face = hit.is_some().then(|| self.faces[hit.triangle as usize])?;
        let [u, v] = hit.weights;
        let largest = if u >= v && u >= 1.0 - u - v {
            1
        } else if v >= 1.0 - u - v {
            2
        } else {
            0
        };
        Some(face[largest])
    }

    /// Texels of the coarse light.
    pub fn texels(&self) -> usize {
        6 * self.edge * self.edge
    }

    /// Light at the vertices for coarse light `[texels]` and base colors `[V]`.
    pub fn light(&self, coarse: &[[f32; 3]], colors: &[[f32; 3]]) -> VertexLight {
        let direct = self.open.multiply(coarse);
        let mut indirect = vec![[0.0; 3]; direct.len()];
        let mut sent = Vec::new();
        for bounce in 0..=BOUNCES {
            sent = direct.iter().zip(&indirect).zip(colors).map(|((d, i), c)| std::array::from_fn(|k| (d[k] + i[k]) * c[k])).collect();
            if bounce < BOUNCES {
                indirect = self.blocked.multiply(&sent);
            }
        }
        VertexLight { direct, indirect, sent }
    }

    /// Light from other surfaces at the vertices, where each sends the radiance `sent` `[V]`.
    pub fn bounced(&self, sent: &[[f32; 3]]) -> Vec<[f32; 3]> {
        self.blocked.multiply(sent)
    }

    /// Light that comes straight from the coarse light.
    pub fn direct(&self, coarse: &[[f32; 3]]) -> Vec<[f32; 3]> {
        self.open.multiply(coarse)
    }

    /// Gradient of the coarse light for that of [`Transport::direct`].
    pub fn direct_backward(&self, d: &[[f32; 3]]) -> Vec<[f32; 3]> {
        self.open.transposed_multiply(d, self.texels())
    }

    /// Share of the cosine-weighted sky that each vertex sees.
    pub fn openness(&self, v: usize) -> f32 {
        self.open.row(v).iter().map(|e| e.1).sum()
    }

    /// What mirrored rays from surface points meet: the vertex nearest to the hit, or none where they leave.
    pub fn reflected(&self, rays_of_points: &[Ray]) -> Vec<Option<u32>> {
        let mut hits = vec![Hit::NONE; rays_of_points.len()];
        rays::nearest(&self.bvh, rays_of_points, &mut hits);
        hits.iter().map(|h| self.corner(h)).collect()
    }

    /// Whether something is between points beside vertices and an eye.
    pub fn are_hidden(&self, positions: &[[f32; 3]], normals: &[[f32; 3]], eye: [f32; 3]) -> Vec<bool> {
        let ray = |(p, n): (&[f32; 3], &[f32; 3])| {
            let n = unit(*n);
            let origin: [f32; 3] = std::array::from_fn(|k| p[k] + 5.0 * OFFSET * n[k]);
            Ray { origin, direction: sub(eye, origin), range: [0.0, 1.0] }
        };
        let cast: Vec<Ray> = positions.iter().zip(normals).map(ray).collect();
        let mut hits = vec![Hit::NONE; cast.len()];
        rays::any(&self.bvh, &cast, &mut hits);
        hits.iter().map(Hit::is_some).collect()
    }
}

/// Solid angle of a texel.
fn solid_angle(i: usize, edge: usize) -> f32 {
    // Of the rectangle from the face's center to (x, y) at distance 1.
    let corner = |x: f64, y: f64| (x * y).atan2((x * x + y * y + 1.0).sqrt());
    let at = |c: usize| 2.0 * c as f64 / edge as f64 - 1.0;
    let (y, x) = (i / edge % edge, i % edge);
    let [x0, x1, y0, y1] = [at(x), at(x + 1), at(y), at(y + 1)];
    (corner(x1, y1) - corner(x0, y1) - corner(x1, y0) + corner(x0, y0)) as f32
}

pub(super) fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn unit(v: [f32; 3]) -> [f32; 3] {
    let l = dot(v, v).sqrt().max(1e-20);
    v.map(|v| v / l)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_kernels::ops::vertex_normals;

    /// Floor of 2n × 2n squares about the origin, and a wall of the same size on its edge x = −1.
    fn corner(n: u32) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
        let (mut positions, mut faces) = (Vec::new(), Vec::new());
        let mut sheet = |of: &dyn Fn(f32, f32) -> [f32; 3]| {
            let first = positions.len() as u32;
            for j in 0..=n {
                for i in 0..=n {
                    positions.push(of(2.0 * i as f32 / n as f32 - 1.0, 2.0 * j as f32 / n as f32 - 1.0));
                }
            }
            for j in 0..n {
                for i in 0..n {
                    let a = first + j * (n + 1) + i;
                    faces.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
                }
            }
        };
        sheet(&|x, y| [x, y, 0.0]);
        sheet(&|x, y| [-1.0 - 1e-3, x, 1.0 + y]);
        (positions, faces)
    }

    #[test]
    fn solid_angles_cover_the_sphere() {
        let sum: f32 = (0..6 * 64).map(|i| solid_angle(i, 8)).sum();
        assert!((sum - 4.0 * std::f32::consts::PI).abs() < 1e-3);
    }

    #[test]
    fn a_wall_takes_the_light_that_its_form_factor_says() {
        let (positions, faces) = corner(8);
        let normals = vertex_normals::cpu::forward(&faces, &positions);
        let t = Transport::new(&positions, &normals, &faces, 0);
        let center = positions.iter().position(|p| *p == [0.0; 3]).unwrap();
        // A point at distance c of a rectangle a × b beside its foot, perpendicular to it: twice the half.
        let (a, b, c) = (2.0f32, 1.0f32, 1.0f32);
        let factor = 2.0 / std::f32::consts::TAU * ((b / c).atan() - c / (a * a + c * c).sqrt() * (b / (a * a + c * c).sqrt()).atan());
        let seen = t.openness(center);
        assert!((1.0 - seen - factor).abs() < 0.01, "{seen} {factor}");
        // In even light, the direct part is the openness; white walls that close the rest would make it 1.
        let light = t.light(&vec![[1.0, 2.0, 0.5]; t.texels()], &vec![[0.5; 3]; positions.len()]);
        assert!((light.direct[center][1] - 2.0 * seen).abs() < 1e-4);
        assert!(light.indirect[center][0] > 0.3 * factor && light.indirect[center][0] < 0.5 * factor, "{:?}", light.indirect[center]);
    }

    #[test]
    fn gradients_are_the_transpose() {
        let (positions, faces) = corner(4);
        let normals = vertex_normals::cpu::forward(&faces, &positions);
        let t = Transport::new(&positions, &normals, &faces, 1);
        let random = |n: usize, seed| diorama_testkit::random(3 * n, seed).as_chunks::<3>().0.to_vec();
        let (x, d) = (random(t.texels(), 1), random(positions.len(), 2));
        let product = |a: &[[f32; 3]], b: &[[f32; 3]]| a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a * b) as f64).sum::<f64>();
        let (there, back) = (product(&t.direct(&x), &d), product(&x, &t.direct_backward(&d)));
        assert!((there - back).abs() < 1e-3 * there.abs().max(1.0), "{there} {back}");
    }
}
