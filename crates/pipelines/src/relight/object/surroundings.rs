//! Shadows and light between surfaces in the third stage, where the mesh no longer moves: at vertices for diffuse reflection, by rays of the
//! mirrored lobe from every pixel for gloss.

use super::probe::{Probe, Seen};
use super::raster::Surface;
use super::transport::{Transport, VertexLight, dot, unit};
use diorama_geom::rng::Rng;
use diorama_kernels::ops::ray_triangles::Ray;
use rayon::prelude::*;

/// Rays of a pixel in training, whatever samples it has.
const RAYS: usize = 8;
/// Distance from the surface at which they begin, in object space.
const OFFSET: f32 = 1e-3;
/// Numbers of a vertex that pixels interpolate.
const ATTRIBUTES: usize = 6;
/// Diffuse light below which a vertex is dark.
const DARK: f32 = 1e-4;

/// The surroundings of a mesh's own surface.
#[derive(Clone, Debug)]
pub struct Surroundings {
    pub transport: Transport,
    /// Unit normals of the vertices.
    normals: Vec<[f32; 3]>,
    faces: Vec<[u32; 3]>,
    /// Rays of a sample.
    rays: usize,
}

/// Light of a probe at the vertices.
#[derive(Clone, Debug)]
pub struct LitVertices {
    pub light: VertexLight,
    unshadowed: Vec<[f32; 3]>,
    /// Share of the diffuse light, and light from other surfaces, `[V, 6]`.
    attributes: Vec<f32>,
}

impl LitVertices {
    /// Diffuse light at a vertex.
    pub fn diffuse(&self, v: usize) -> [f32; 3] {
        std::array::from_fn(|k| self.light.direct[v][k] + self.light.indirect[v][k])
    }
}

impl Surroundings {
    pub fn new(positions: &[[f32; 3]], normals: &[[f32; 3]], faces: &[[u32; 3]], seed: u64, samples: usize) -> Surroundings {
        let normals: Vec<[f32; 3]> = normals.iter().map(|n| unit(*n)).collect();
        Surroundings {
            transport: Transport::new(positions, &normals, faces, seed),
            normals,
            faces: faces.to_vec(),
            rays: (RAYS / (samples * samples)).max(1),
        }
    }

    /// Light at the vertices, which have the base colors `colors` `[V]`.
    pub fn light(&self, probe: &Probe, colors: &[[f32; 3]]) -> LitVertices {
        let light = self.transport.light(&probe.coarse(self.transport.edge), colors);
        let unshadowed: Vec<[f32; 3]> = probe.diffuse(self.normals.as_flattened()).as_chunks::<3>().0.to_vec();
        let attributes = light
            .direct
            .iter()
            .zip(&unshadowed)
            .zip(&light.indirect)
            .flat_map(|((d, u), i)| [d[0] / u[0].max(DARK), d[1] / u[1].max(DARK), d[2] / u[2].max(DARK), i[0], i[1], i[2]])
            .collect();
        LitVertices { light, unshadowed, attributes }
    }

    /// What surface points see, with `normal` and `roughness`; `rng` draws the mirrored rays.
    pub fn seen(&self, lit: &LitVertices, surface: &Surface, (normal, ks): (&[f32], &[f32]), rng: Rng) -> Seen {
        let values = surface.interpolate(&lit.attributes, ATTRIBUTES, &self.faces);
        let (n, each) = (surface.covered.len(), self.rays);
        let mut seen =
            Seen { share: Vec::with_capacity(3 * n), added: Vec::with_capacity(3 * n), open: vec![0.0; n], reflected: vec![0.0; 3 * n] };
        for v in values.as_chunks::<ATTRIBUTES>().0 {
            seen.share.extend_from_slice(&v[..3]);
            seen.added.extend_from_slice(&v[3..]);
        }
        let three = |v: &[f32], i: usize| -> [f32; 3] { std::array::from_fn(|k| v[3 * i + k]) };
        let rays: Vec<Ray> = (0..n * each)
            .into_par_iter()
            .with_min_len(1024)
            .map(|r| {
                let i = r / each;
                let (n, flat) = (three(normal, i), three(&surface.face_normal, i));
                let (p, view) = (three(&surface.position, i), three(&surface.view, i));
                let stratum = (r % each) as f32;
                let random = [(stratum + rng.uniform(2 * r as u64)) / each as f32, rng.uniform(2 * r as u64 + 1)];
                let direction = mirrored(n, view, ks[3 * i + 1], random);
                // Not into the surface itself.
                let below = dot(direction, flat).min(0.0);
                let direction = unit(std::array::from_fn(|k| direction[k] - 2.0 * below * flat[k]));
                Ray { origin: std::array::from_fn(|k| p[k] + OFFSET * flat[k]), direction, range: [0.0, f32::INFINITY] }
            })
            .collect();
        let met = self.transport.reflected(&rays);
        for (i, met) in met.chunks_exact(each).enumerate() {
            seen.open[i] = met.iter().filter(|m| m.is_none()).count() as f32 / each as f32;
            for v in met.iter().flatten() {
                (0..3).for_each(|k| seen.reflected[3 * i + k] += lit.light.sent[*v as usize][k] / each as f32);
            }
        }
        seen
    }

    /// Adds the gradient of the vertices' shares `[V, 6]` for that of [`Seen::share`].
    pub fn seen_backward(&self, lit: &LitVertices, surface: &Surface, d_share: &[f32], into: &mut [f32]) {
        let d: Vec<f32> = d_share.as_chunks::<3>().0.iter().flat_map(|d| [d[0], d[1], d[2], 0.0, 0.0, 0.0]).collect();
        let [out, _] = surface.interpolate_backward(&lit.attributes, ATTRIBUTES, &self.faces, &d);
        into.iter_mut().zip(&out).for_each(|(i, o)| *i += o);
    }

    /// Turns the gradient of the shares into that of the light, which the probe keeps.
    pub fn light_backward(&self, lit: &LitVertices, d_attributes: &[f32], probe: &mut Probe) {
        if probe.group.frozen {
            return;
        }
        let (mut d_direct, mut d_unshadowed) = (vec![[0.0f32; 3]; self.normals.len()], vec![[0.0f32; 3]; self.normals.len()]);
        for (v, d) in d_attributes.as_chunks::<ATTRIBUTES>().0.iter().enumerate() {
            for k in (0..3).filter(|k| lit.unshadowed[v][*k] > DARK) {
                d_direct[v][k] = d[k] / lit.unshadowed[v][k];
                d_unshadowed[v][k] = -d[k] * lit.attributes[ATTRIBUTES * v + k] / lit.unshadowed[v][k];
            }
        }
        probe.coarse_backward(&self.transport.direct_backward(&d_direct));
        probe.diffuse_backward(self.normals.as_flattened(), d_unshadowed.as_flattened());
    }

    /// Numbers of the gradient of all vertices.
    pub fn attributes(&self) -> usize {
        ATTRIBUTES * self.normals.len()
    }
}

/// A direction of the mirrored GGX lobe for two numbers from 0 to 1.
fn mirrored(n: [f32; 3], view: [f32; 3], roughness: f32, [a, b]: [f32; 2]) -> [f32; 3] {
    let alpha = roughness * roughness;
    let cosine2 = (1.0 - a) / (1.0 + (alpha * alpha - 1.0) * a);
    let (cosine, sine) = (cosine2.sqrt(), (1.0 - cosine2).max(0.0).sqrt());
    let (y, x) = (std::f32::consts::TAU * b).sin_cos();
    let helper = if n[2].abs() < 0.9 { [0.0, 0.0, 1.0] } else { [1.0, 0.0, 0.0] };
    let s = unit(diorama_geom::mesh::cross(helper, n));
    let t = diorama_geom::mesh::cross(n, s);
    let half: [f32; 3] = std::array::from_fn(|k| sine * (x * s[k] + y * t[k]) + cosine * n[k]);
    let along = 2.0 * dot(half, view);
    unit(std::array::from_fn(|k| along * half[k] - view[k]))
}
