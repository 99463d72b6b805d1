//! A mesh drawn in a view: the surface points behind its pixels, and an antialiased picture of their colors; with gradients.

use super::capture::ObjectView;
use diorama_geom::mesh::{cross, sub};
use diorama_geom::rng::Rng;
use diorama_kernels::ops::antialias::{self, Antialias, Crossing, Visible};
use diorama_kernels::ops::interpolate::cpu::Pixels;
use diorama_kernels::ops::interpolate::{self, Interpolate};
use diorama_kernels::ops::rasterize::{self, Raster, Rasterize, Upstream};
use diorama_kernels::ops::{split_sum, vertex_normals};
use rayon::prelude::*;

/// Triangles beyond the visible one that are searched for a silhouette.
const FOLLOW: usize = 3;
/// Numbers of a vertex: position and normal.
const ATTRIBUTES: usize = 6;

/// A mesh whose vertices move.
#[derive(Clone, Copy)]
pub struct Shape<'a> {
    pub positions: &'a [[f32; 3]],
    pub normals: &'a [[f32; 3]],
    pub faces: &'a [[u32; 3]],
    pub topology: &'a antialias::Topology,
}

/// Surface points behind the pixels of a view.
pub struct Surface {
    raster: Raster,
    clip: Vec<f32>,
    attributes: Vec<f32>,
    size: [usize; 2],
    /// Pixels that show the mesh `[P]`.
    pub covered: Vec<u32>,
    /// Their points, normals of unit length and those of their faces, and unit directions to the camera, `[P, 3]`.
    pub position: Vec<f32>,
    pub normal: Vec<f32>,
    pub face_normal: Vec<f32>,
    pub view: Vec<f32>,
    /// Lengths of the normals before they were made unit `[P]`.
    length: Vec<f32>,
}

/// Gradients of the points of a [`Surface`], `[P, 3]`.
pub struct SurfaceGradient<'a> {
    /// Of unit normals.
    pub normal: &'a [f32],
    pub position: Option<&'a [f32]>,
    /// Of barycentrics, of all pixels `[H, W, 2]`, through what else was interpolated.
    pub barycentric: Option<&'a [f32]>,
}

impl Surface {
    /// Draws a mesh; screen derivatives are kept if asked for.
    pub fn draw(view: &ObjectView, shape: &Shape, derivatives: bool) -> Surface {
        let size = view.size();
        let clip: Vec<f32> = shape
            .positions
            .par_iter()
            .with_min_len(1024)
            .flat_map_iter(|p| view.clip.map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3]))
            .collect();
        let r = Rasterize { images: 1, vertices: shape.positions.len(), size };
        let mut raster = Raster::default();
        rasterize::cpu::forward(&r, &clip, shape.faces, derivatives, &mut raster);
        let attributes: Vec<f32> =
            shape.positions.iter().zip(shape.normals).flat_map(|(p, n)| [p[0], p[1], p[2], n[0], n[1], n[2]]).collect();
        let mut values = vec![0.0; size[0] * size[1] * ATTRIBUTES];
        interpolate::cpu::forward(&interpolation(&r, ATTRIBUTES), &attributes, shape.faces, &raster.ids, &raster.uv, &mut values);
        let covered: Vec<u32> = (0..raster.ids.len() as u32).filter(|i| raster.ids[*i as usize] > 0).collect();
        let n = covered.len();
        let mut s = Surface {
            position: vec![0.0; 3 * n],
            normal: vec![0.0; 3 * n],
            face_normal: vec![0.0; 3 * n],
            view: vec![0.0; 3 * n],
            length: vec![0.0; n],
            raster,
            clip,
            attributes,
            size,
            covered,
        };
        for (i, pixel) in s.covered.iter().enumerate() {
            let v = &values[*pixel as usize * ATTRIBUTES..][..ATTRIBUTES];
            let [p, m] = [[v[0], v[1], v[2]], [v[3], v[4], v[5]]];
            let face = shape.faces[s.raster.ids[*pixel as usize] as usize - 1];
            let [a, b, c] = face.map(|i| shape.positions[i as usize]);
            let at = 3 * i..3 * i + 3;
            s.length[i] = length(m);
            s.position[at.clone()].copy_from_slice(&p);
            s.normal[at.clone()].copy_from_slice(&unit(m));
            s.face_normal[at.clone()].copy_from_slice(&unit(cross(sub(b, a), sub(c, a))));
            s.view[at].copy_from_slice(&unit(sub(view.eye, p)));
        }
        s
    }

    fn rasterize(&self) -> Rasterize {
        Rasterize { images: 1, vertices: self.clip.len() / 4, size: self.size }
    }

    /// Interpolates other attributes `[V′, A]` over the triangles `faces` at the covered pixels, `[P, A]`.
    pub fn interpolate(&self, attributes: &[f32], width: usize, faces: &[[u32; 3]]) -> Vec<f32> {
        let s = Interpolate {
            images: 1,
            pixels: self.raster.ids.len(),
            vertices: attributes.len() / width,
            attributes: width,
            per_image: false,
        };
        let mut all = vec![0.0; self.raster.ids.len() * width];
        interpolate::cpu::forward(&s, attributes, faces, &self.raster.ids, &self.raster.uv, &mut all);
        self.covered.iter().flat_map(|p| all[*p as usize * width..(*p as usize + 1) * width].iter().copied()).collect()
    }

    /// Gradients of attributes `[V′, A]` and of barycentrics `[H, W, 2]` for that of [`Surface::interpolate`].
    pub fn interpolate_backward(&self, attributes: &[f32], width: usize, faces: &[[u32; 3]], d: &[f32]) -> [Vec<f32>; 2] {
        let pixels = self.raster.ids.len();
        let s = Interpolate { images: 1, pixels, vertices: attributes.len() / width, attributes: width, per_image: false };
        let mut d_values = vec![0.0; pixels * width];
        for (pixel, d) in self.covered.iter().zip(d.chunks_exact(width)) {
            d_values[*pixel as usize * width..][..width].copy_from_slice(d);
        }
        let (mut out, mut d_uv) = (vec![0.0; attributes.len()], vec![0.0; self.raster.uv.len()]);
        let at = Pixels { ids: &self.raster.ids, uv: &self.raster.uv };
        interpolate::cpu::backward(&s, attributes, faces, at, &d_values, &mut out, &mut d_uv);
        [out, d_uv]
    }

    /// Screen derivatives of the first `chosen` of such attributes at the covered pixels, `[P, chosen, 2]`.
    pub fn derivatives(&self, attributes: &[f32], width: usize, chosen: &[usize], faces: &[[u32; 3]]) -> Vec<f32> {
        let s = Interpolate {
            images: 1,
            pixels: self.raster.ids.len(),
            vertices: attributes.len() / width,
            attributes: width,
            per_image: false,
        };
        let each = 2 * chosen.len();
        let mut all = vec![0.0; self.raster.ids.len() * each];
        interpolate::cpu::derivatives(&s, chosen, attributes, faces, &self.raster.ids, &self.raster.derivatives, &mut all);
        self.covered.iter().flat_map(|p| all[*p as usize * each..(*p as usize + 1) * each].iter().copied()).collect()
    }

    /// Pairs of covered pixels that show points near each other: of one in `sparsity` pixels with another one at a normally distributed way,
    /// `pixels` wide, unless the latter's plane passes the former at more than `most`.
    pub fn neighbors(&self, (pixels, most): (f32, f32), sparsity: usize, rng: Rng) -> Vec<[usize; 2]> {
        let [h, w] = self.size;
        let mut place = vec![u32::MAX; w * h];
        self.covered.iter().enumerate().for_each(|(i, p)| place[*p as usize] = i as u32);
        let pair = |i: usize| {
            let pixel = self.covered[i] as usize;
            let moved = |at: usize, k: u64| at as i64 + (pixels * rng.normal(2 * i as u64 + k)).round() as i64;
            let (x, y) = (moved(pixel % w, 0), moved(pixel / w, 1));
            if !(0..w as i64).contains(&x) || !(0..h as i64).contains(&y) {
                return None;
            }
            let j = place[y as usize * w + x as usize] as usize;
            if j == u32::MAX as usize || j == i {
                return None;
            }
            let away = |n: &[f32]| (0..3).map(|k| n[3 * j + k] * (self.position[3 * j + k] - self.position[3 * i + k])).sum::<f32>().abs();
            (away(&self.face_normal) < most).then_some([i, j])
        };
        (rng.below(u64::MAX >> 1, sparsity as u64) as usize..self.covered.len()).step_by(sparsity).filter_map(pair).collect()
    }

    /// The picture `[H, W, 4]` of colors `[P, 3]`, multiplied by the opacity in the fourth channel.
    pub fn picture(&self, shape: &Shape, color: &[f32]) -> Picture {
        let mut plain = vec![0.0; self.raster.ids.len() * 4];
        for (pixel, c) in self.covered.iter().zip(color.as_chunks::<3>().0) {
            plain[*pixel as usize * 4..][..4].copy_from_slice(&[c[0], c[1], c[2], 1.0]);
        }
        let a = self.antialias();
        let visible = Visible { ids: &self.raster.ids, depth: &self.raster.depth };
        let crossings = antialias::cpu::find(&a, &self.clip, shape.faces, shape.topology, visible);
        let mut rgba = vec![0.0; plain.len()];
        antialias::cpu::forward(&a, &crossings, &plain, &mut rgba);
        Picture { plain, crossings, rgba }
    }

    fn antialias(&self) -> Antialias {
        Antialias { images: 1, vertices: self.clip.len() / 4, size: self.size, channels: 4, follow: FOLLOW }
    }

    /// Gradients of colors `[P, 3]` and of clip coordinates for that of a picture.
    pub fn picture_backward(&self, picture: &Picture, d: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (mut d_plain, mut d_clip) = (vec![0.0; d.len()], vec![0.0; self.clip.len()]);
        antialias::cpu::backward(&self.antialias(), &self.clip, &picture.crossings, &picture.plain, d, &mut d_plain, &mut d_clip);
        let color = self.covered.iter().flat_map(|p| d_plain[4 * *p as usize..][..3].iter().copied()).collect();
        (color, d_clip)
    }

    /// Adds the gradient of positions `[V, 3]` for gradients of points and the clip coordinates'.
    pub fn backward(&self, view: &ObjectView, shape: &Shape, d: &SurfaceGradient, mut d_clip: Vec<f32>, d_positions: &mut [[f32; 3]]) {
        let mut d_values = vec![0.0; self.raster.ids.len() * ATTRIBUTES];
        for (i, pixel) in self.covered.iter().enumerate() {
            let to = &mut d_values[*pixel as usize * ATTRIBUTES..][..ATTRIBUTES];
            if let Some(p) = d.position {
                to[..3].copy_from_slice(&p[3 * i..3 * i + 3]);
            }
            let (n, d) = (&self.normal[3 * i..3 * i + 3], &d.normal[3 * i..3 * i + 3]);
            let along: f32 = (0..3).map(|k| n[k] * d[k]).sum();
            (0..3).for_each(|k| to[3 + k] = (d[k] - along * n[k]) / self.length[i].max(1e-6));
        }
        let r = self.rasterize();
        let (mut d_attributes, mut d_uv) = (vec![0.0; self.attributes.len()], vec![0.0; self.raster.uv.len()]);
        let at = Pixels { ids: &self.raster.ids, uv: &self.raster.uv };
        let s = interpolation(&r, ATTRIBUTES);
        interpolate::cpu::backward(&s, &self.attributes, shape.faces, at, &d_values, &mut d_attributes, &mut d_uv);
        if let Some(d) = d.barycentric {
            d_uv.par_iter_mut().zip(d).with_min_len(4096).for_each(|(to, d)| *to += d);
        }
        let mut through = vec![0.0; self.clip.len()];
        let up = Upstream { uv: Some(&d_uv), ..Upstream::default() };
        rasterize::backward(&r, &self.clip, shape.faces, &self.raster, &up, &mut through);
        d_clip.par_iter_mut().zip(&through).with_min_len(4096).for_each(|(d, t)| *d += t);
        let mut d_normals = vec![[0.0; 3]; shape.positions.len()];
        for (i, d) in d_attributes.as_chunks::<ATTRIBUTES>().0.iter().enumerate() {
            let c = &d_clip[4 * i..4 * i + 4];
            for k in 0..3 {
                d_positions[i][k] += d[k] + (0..4).map(|j| view.clip[j][k] * c[j]).sum::<f32>();
            }
            d_normals[i].copy_from_slice(&d[3..6]);
        }
        vertex_normals::cpu::backward(shape.faces, shape.positions, &d_normals, d_positions);
    }

    /// Shading normals bent toward the faces where they turn away from the camera.
    pub fn bent(&self, normal: &[f32]) -> Vec<f32> {
        let mut bent = normal.to_vec();
        split_sum::cpu::bend(&mut bent, &self.face_normal, &self.view);
        bent
    }

    /// Gradient of the normals before [`Surface::bent`], in place.
    pub fn bent_backward(&self, normal: &[f32], d: &mut [f32]) {
        split_sum::cpu::bend_backward(normal, &self.face_normal, &self.view, d);
    }
}

fn interpolation(r: &Rasterize, attributes: usize) -> Interpolate {
    Interpolate { images: 1, pixels: r.pixels(), vertices: r.vertices, attributes, per_image: false }
}

/// A drawn picture, and what its gradient needs.
pub struct Picture {
    plain: Vec<f32>,
    crossings: Vec<Crossing>,
    /// Linear light times opacity, `[H, W, 4]`.
    pub rgba: Vec<f32>,
}

fn length(v: [f32; 3]) -> f32 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    let l = length(v).max(1e-20);
    v.map(|v| v / l)
}
