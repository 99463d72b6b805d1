//! Second stage: a mesh that keeps its triangles, with textures of base color, occlusion, roughness, metalness and normals.

use super::albedo_entropy;
use super::capture::ObjectView;
use super::config::{CHANNELS, Config, SHOWN};
use super::loss;
use super::material::{self, Material};
use super::pixel_means::{means, means_backward};
use super::probe::{Probe, Seen};
use super::raster::{Shape, Surface, SurfaceGradient};
use super::surroundings::{LitVertices, Surroundings};
use super::topology::{StepInput, StepLoss, ViewPass};
use diorama_engine::params::ParamGroup;
use diorama_geom::Mesh;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::mesh_smoothness::{self, MeshTopology};
use diorama_kernels::ops::split_sum::{Points, SMOOTHEST};
use diorama_kernels::ops::texture::{self, Filter, Kind, Texture, footprint, mips};
use diorama_kernels::ops::{antialias, vertex_normals};
use diorama_mesh::{atlas, bake, normal_map};
use rayon::prelude::*;
use std::collections::HashMap;

/// Numbers of a vertex of the texture: coordinates and tangent.
const ATTRIBUTES: usize = 6;
/// Of so many surface points, one is compared with a point nearby.
const SPARSITY: usize = 2;
/// Standard deviation of the way to that point in pixels, and largest distance of its plane in object space.
const NEAR: (f32, f32) = (2.0, 0.02);
/// Steps over which rates rise.
const WARMUP: f32 = 100.0;
const OCCLUSION: f32 = 0.001;
/// How much brighter than white base colors may become before the third stage finds the light: only their ratios are known until then.
const HEADROOM: f32 = 4.0;
/// Level at which vertices read their color.
const VERTEX_LEVEL: f32 = 1.0;
/// Points of a view whose colors are compared, and the width within which colors attract each other.
const COMPARED: usize = 2048;
const ENTROPY_WIDTH: f32 = 0.15;
/// Stream of random numbers of pictures that are not trained on.
const PICTURE: u64 = 36;

/// Triangles, fixed: of positions, and of the texture, where vertices of seams are doubled.
#[derive(Clone, Debug, PartialEq)]
pub struct Layout {
    pub faces: Vec<[u32; 3]>,
    pub uv_faces: Vec<[u32; 3]>,
    pub uvs: Vec<[f32; 2]>,
    /// Position of each vertex of the texture.
    pub source: Vec<u32>,
    /// Positions at the start.
    pub initial: Vec<[f32; 3]>,
}

impl Layout {
    /// Cuts and flattens a mesh for textures of `size`² texels.
    pub fn new(mesh: &Mesh, size: usize) -> Layout {
        let mut flat = Mesh { positions: mesh.positions.clone(), faces: mesh.faces.clone(), ..Mesh::default() };
        atlas::unwrap(&mut flat, size);
        let mut known: HashMap<[u32; 3], u32> = HashMap::new();
        let mut initial = Vec::new();
        let source: Vec<u32> = flat
            .positions
            .iter()
            .map(|p| {
                *known.entry(p.map(f32::to_bits)).or_insert_with(|| {
                    initial.push(*p);
                    initial.len() as u32 - 1
                })
            })
            .collect();
        let faces = flat.faces.iter().map(|f| f.map(|i| source[i as usize])).collect();
        Layout { faces, uv_faces: flat.faces, uvs: flat.uvs, source, initial }
    }
}

/// The model of the second stage.
pub struct Textured {
    pub layout: Layout,
    silhouettes: antialias::Topology,
    neighbors: MeshTopology,
    first_laplacian: Vec<[f32; 3]>,
    texture: Texture,
    pub positions: ParamGroup,
    pub texels: ParamGroup,
    color: [f32; 2],
    /// Factor of the largest base color until the third stage.
    headroom: f32,
    /// Samples per pixel and axis.
    samples: usize,
    /// Third stage: what the surface casts onto itself. The mesh no longer moves then.
    pub surroundings: Option<Box<Surroundings>>,
}

impl Textured {
    /// The mesh with textures that hold a field's values, or gray where there is none.
    pub fn new(config: &Config, mesh: &Mesh, field: Option<&Material>) -> Textured {
        let size = config.material.texture;
        let mut model = Textured::of(config, Layout::new(mesh, size));
        let mut flat = model.mesh();
        flat.normals = model.smooth_normals();
        let texels = bake::texels(&flat, size);
        let n = texels.index.len();
        let (kd, ks) = match field {
            Some(field) => {
                let e = field.evaluate(texels.positions.as_flattened());
                (e.kd, e.ks)
            }
            None => (vec![0.5; 3 * n], [0.0, 0.5, 0.0].repeat(n)),
        };
        let parts = [kd, ks].map(|v| bake::spread(&texels, v.as_chunks::<3>().0, size));
        for (i, texel) in model.texels.values.as_chunks_mut::<CHANNELS>().0.iter_mut().enumerate() {
            texel[..3].copy_from_slice(&parts[0][i]);
            texel[3..6].copy_from_slice(&parts[1][i]);
        }
        model
    }

    /// The model on a layout, gray.
    pub fn of(config: &Config, layout: Layout) -> Textured {
        let size = config.material.texture;
        let adam = |rate| Adam { rate, beta2: 0.999, epsilon: 1e-8, ..Adam::default() };
        let texels = [0.5, 0.5, 0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0].repeat(size * size);
        let neighbors = MeshTopology::new(layout.initial.len(), &layout.faces);
        Textured {
            silhouettes: antialias::Topology::new(&layout.faces),
            first_laplacian: mesh_smoothness::cpu::laplacian(&neighbors, &layout.initial),
            neighbors,
            texture: Texture { kind: Kind::Clamp, filter: Filter::Trilinear, images: 1, size: [size; 2], channels: CHANNELS },
            positions: ParamGroup::dense("positions", layout.initial.as_flattened().to_vec(), adam(config.optim.vertex_rate)),
            texels: ParamGroup::dense("texels", texels, adam(config.optim.texture_rate)),
            layout,
            color: config.material.color,
            headroom: if config.run.traced_steps > 0 && config.light.fixed.as_os_str().is_empty() { HEADROOM } else { 1.0 },
            samples: config.run.samples,
            surroundings: None,
        }
    }

    /// Positions `[V, 3]`.
    pub fn places(&self) -> &[[f32; 3]] {
        self.positions.values.as_chunks::<3>().0
    }

    /// Normals of the texture's vertices.
    pub fn smooth_normals(&self) -> Vec<[f32; 3]> {
        let normals = vertex_normals::cpu::forward(&self.layout.faces, self.places());
        self.layout.source.iter().map(|i| normals[*i as usize]).collect()
    }

    /// The mesh with texture coordinates, smooth normals and tangents.
    pub fn mesh(&self) -> Mesh {
        let positions = self.layout.source.iter().map(|i| self.places()[*i as usize]).collect();
        let mut mesh = Mesh { positions, faces: self.layout.uv_faces.clone(), uvs: self.layout.uvs.clone(), ..Mesh::default() };
        mesh.normals = self.smooth_normals();
        normal_map::set_tangents(&mut mesh);
        mesh
    }

    /// Draws a view and looks its textures up.
    pub fn look(&self, view: &ObjectView, drawn: &Drawn) -> Looked {
        let shape = drawn.shape(self);
        let surface = Surface::draw(view, &shape, true);
        let values = surface.interpolate(&drawn.attributes, ATTRIBUTES, &self.layout.uv_faces);
        let slopes = surface.derivatives(&drawn.attributes, ATTRIBUTES, &[0, 1], &self.layout.uv_faces);
        let uv: Vec<f32> = values.as_chunks::<ATTRIBUTES>().0.iter().flat_map(|v| [v[0], v[1]]).collect();
        let mut level = vec![0.0; uv.len() / 2];
        footprint::forward(&self.texture, &uv, &slopes, &mut level);
        let tangent = values.as_chunks::<ATTRIBUTES>().0.iter().map(|v| [v[2], v[3], v[4], v[5]]).collect();
        Looked { surface, uv, level, tangent }
    }

    /// What all views of a step share.
    pub fn drawn(&self) -> Drawn {
        let normals = vertex_normals::cpu::forward(&self.layout.faces, self.places());
        let mesh = self.mesh();
        let attributes = mesh.uvs.iter().zip(&mesh.tangents).flat_map(|(uv, t)| [uv[0], uv[1], t[0], t[1], t[2], t[3]]).collect();
        let mut mipped = vec![0.0; self.texture.numbers()];
        mipped[..self.texels.values.len()].copy_from_slice(&self.texels.values);
        mips::forward(&self.texture, &mut mipped);
        Drawn { normals, attributes, mipped }
    }

    /// Values of texels `[P, 9]`.
    pub fn lookup(&self, drawn: &Drawn, uv: &[f32], level: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; level.len() * CHANNELS];
        texture::cpu::forward(&self.texture, &drawn.mipped, uv, level, &mut out);
        out
    }

    /// Gradient of barycentrics `[H, W, 2]` for that of [`Textured::lookup`]: as the surface moves, its texture moves in the picture.
    fn texture_backward(&self, drawn: &Drawn, looked: &Looked, d_values: &[f32]) -> Vec<f32> {
        let (mut d_uv, mut d_level) = (vec![0.0; looked.uv.len()], vec![0.0; looked.level.len()]);
        texture::cpu::backward_coordinates(&self.texture, &drawn.mipped, &looked.uv, &looked.level, d_values, &mut d_uv, &mut d_level);
        let [_, d_barycentric] = looked.surface.interpolate_backward(self.layout.uvs.as_flattened(), 2, &self.layout.uv_faces, &d_uv);
        d_barycentric
    }

    /// The picture `[H, W, 4]` of a view, linear light times opacity, and that of the base color.
    pub fn picture(&self, view: &ObjectView, probe: &Probe) -> [Vec<f32>; 2] {
        let (drawn, samples) = (self.drawn(), self.samples.max(SHOWN));
        let fine = view.finer(samples);
        let looked = self.look(&fine, &drawn);
        let values = self.lookup(&drawn, &looked.uv, &looked.level);
        let around = self.light(&drawn, probe);
        let lit = looked.shade(&values, probe, self.around(around.as_ref(), Rng::new(0, PICTURE)));
        [&lit.shaded.color, &lit.kd].map(|c| means(&looked.surface.picture(&drawn.shape(self), c).rgba, view.size(), samples))
    }

    /// Lets the textures' optimizer begin anew.
    pub fn forget_steps(&mut self) {
        self.texels.moment1.fill(0.0);
        self.texels.moment2.fill(0.0);
    }

    /// Values of texels at the vertices, `[V, 9]`.
    pub fn at_vertices(&self, drawn: &Drawn) -> Vec<f32> {
        let mut uv = vec![[0.5f32; 2]; self.layout.initial.len()];
        self.layout.source.iter().zip(&self.layout.uvs).for_each(|(v, at)| uv[*v as usize] = *at);
        self.lookup(drawn, uv.as_flattened(), &vec![VERTEX_LEVEL; uv.len()])
    }

    /// Diffuse base color of the vertices.
    pub fn vertex_colors(&self, drawn: &Drawn) -> Vec<[f32; 3]> {
        self.at_vertices(drawn).as_chunks::<CHANNELS>().0.iter().map(|t| [t[0], t[1], t[2]].map(|c| c * (1.0 - t[5]))).collect()
    }

    /// Light at the vertices, in the third stage.
    pub fn light(&self, drawn: &Drawn, probe: &Probe) -> Option<LitVertices> {
        self.surroundings.as_ref().map(|s| s.light(probe, &self.vertex_colors(drawn)))
    }

    fn around<'a>(&'a self, lit: Option<&'a LitVertices>, rng: Rng) -> Option<Around<'a>> {
        self.surroundings.as_deref().zip(lit).map(|(surroundings, lit)| Around { surroundings, lit, rng })
    }

    /// One optimizer step.
    pub fn step(&mut self, config: &Config, input: &StepInput, probe: &mut Probe) -> StepLoss {
        let drawn = self.drawn();
        let mut loss = StepLoss { faces: self.layout.faces.len(), ..StepLoss::default() };
        let share = 1.0 / input.photos.len() as f32;
        probe.update();
        let lit = self.light(&drawn, probe);
        let mut gradient = Gradient {
            positions: vec![[0.0; 3]; self.places().len()],
            texels: vec![0.0; self.texture.numbers()],
            shares: vec![0.0; self.surroundings.as_ref().map_or(0, |s| s.attributes())],
        };
        for (i, photo) in input.photos.iter().enumerate() {
            let looked = self.look(&photo.view.finer(self.samples), &drawn);
            let pass = ViewPass { config, photo, share, rng: Rng::new(input.rng.bits(i as u64), 0), progress: input.progress };
            self.view(&pass, (&drawn, &looked, lit.as_ref()), probe, &mut loss, &mut gradient);
        }
        if let Some(around) = self.around(lit.as_ref(), input.rng) {
            around.surroundings.light_backward(around.lit, &gradient.shares, probe);
        }
        loss.regularizers += probe.finish_backward(config.loss.white_light);
        let rate = input.rate_scale * config.optim.final_scale.powf(input.progress) * (input.t as f32 / WARMUP).min(1.0);
        if self.surroundings.is_none() {
            let weight = config.loss.laplacian * (1.0 - input.progress);
            let (first, to) = (&self.first_laplacian, &mut gradient.positions);
            let bent = mesh_smoothness::cpu::relative_laplacian(&self.neighbors, first, self.places(), weight, to);
            loss.regularizers += weight as f64 * bent;
            self.positions.grads.copy_from_slice(gradient.positions.as_flattened());
            self.positions.step(input.t, rate);
        }
        mips::backward(&self.texture, &mut gradient.texels);
        let n = self.texels.values.len();
        self.texels.grads.copy_from_slice(&gradient.texels[..n]);
        self.texels.step(input.t, rate);
        probe.step(input.t, rate);
        self.clamp();
        loss
    }

    /// Keeps texels where materials are.
    fn clamp(&mut self) {
        let [low, high] = self.color;
        let (high, most_occluded) = if self.surroundings.is_some() { (high, 0.0) } else { (high * self.headroom, 1.0) };
        self.texels.values.as_chunks_mut::<CHANNELS>().0.par_iter_mut().with_min_len(4096).for_each(|t| {
            t[..3].iter_mut().for_each(|v| *v = v.clamp(low, high));
            t[3] = t[3].clamp(0.0, most_occluded);
            t[4] = t[4].clamp(SMOOTHEST, 1.0);
            t[5] = t[5].clamp(0.0, 1.0);
            t[6..8].iter_mut().for_each(|v| *v = v.clamp(-1.0, 1.0));
            t[8] = t[8].clamp(0.1, 1.0);
        });
    }

    /// One photograph: its losses, and gradients of everything.
    fn view(
        &self,
        pass: &ViewPass,
        of: (&Drawn, &Looked, Option<&LitVertices>),
        probe: &mut Probe,
        loss: &mut StepLoss,
        gradient: &mut Gradient,
    ) {
        let (ViewPass { config, photo, share, rng, progress }, (drawn, looked, lit_vertices)) = (*pass, of);
        let (shape, surface) = (drawn.shape(self), &looked.surface);
        let n = surface.covered.len();
        let values = self.lookup(drawn, &looked.uv, &looked.level);
        let around = self.around(lit_vertices, Rng::new(rng.bits(3), 3));
        let lit = looked.shade(&values, probe, around);
        let picture = surface.picture(&shape, &lit.shaded.color);
        let shown = means(&picture.rgba, photo.view.size(), self.samples);
        let mut d = vec![0.0; shown.len()];
        let of = loss::picture(&shown, &photo.rgba.data, config.loss.mask, Rng::new(rng.bits(2), 2), &mut d);
        loss.add(of, share as f64);
        let d = means_backward(&d, photo.view.size(), self.samples, share);
        let (d_color, d_clip) = surface.picture_backward(&picture, &d);
        let covered = n as f32 / (picture.rgba.len() / 4) as f32;
        let at = Points { normal: &lit.bent, view: &surface.view, kd: &lit.kd, ks: &lit.ks };
        let [mut d_normal, mut d_kd, d_ks, d_share] = probe.shade_backward(&at, (&lit.shaded, lit.seen.as_ref()), &d_color);
        if let Some(around) = around {
            around.surroundings.seen_backward(around.lit, surface, &d_share, &mut gradient.shares);
            let weight = share * covered * config.loss.color_entropy * (1.0 - progress);
            loss.regularizers += few_colors(&lit.kd, weight, Rng::new(rng.bits(4), 4), &mut d_kd);
        }
        surface.bent_backward(&lit.normal, &mut d_normal);
        let mut d_values = vec![0.0; values.len()];
        let d_smooth = looked.tangent_backward(&lit, &values, &d_normal, &mut d_values);
        let occlusion = share * covered * OCCLUSION / n.max(1) as f32;
        for i in 0..n {
            let d = &mut d_values[i * CHANNELS..][..6];
            d[..3].copy_from_slice(&d_kd[3 * i..3 * i + 3]);
            d[3..].copy_from_slice(&d_ks[3 * i..3 * i + 3]);
            d[3] += occlusion;
            loss.regularizers += (occlusion * lit.ks[3 * i]) as f64;
        }
        let moves = self.surroundings.is_none().then(|| self.texture_backward(drawn, looked, &d_values));
        // Charts end anywhere on the surface: neighbors in the picture are near each other, neighbors in the texture need not be.
        let near = surface.neighbors((NEAR.0 * self.samples as f32, NEAR.1), SPARSITY * self.samples, Rng::new(rng.bits(1), 1));
        let color = |i: usize| values[i * CHANNELS..][..3].iter().copied();
        let [own, other]: [Vec<f32>; 2] = [0, 1].map(|k| near.iter().flat_map(|pair| color(pair[k])).collect());
        loss.regularizers += material::smoothness(&own, &other, share * covered * config.loss.color_smoothness, |i, d| {
            d_values[near[i / 3][0] * CHANNELS + i % 3] += d;
            d_values[near[i / 3][1] * CHANNELS + i % 3] -= d;
        });
        let mut d_texels = vec![0.0; gradient.texels.len()];
        texture::cpu::backward_texels(&self.texture, &looked.uv, &looked.level, &d_values, &mut d_texels);
        gradient.texels.par_iter_mut().zip(&d_texels).with_min_len(4096).for_each(|(g, d)| *g += d);
        let Some(moves) = moves else { return };
        let d = SurfaceGradient { normal: &d_smooth, position: None, barycentric: Some(&moves) };
        surface.backward(&photo.view.finer(self.samples), &shape, &d, d_clip, &mut gradient.positions);
    }
}

struct Gradient {
    /// Until the third stage.
    positions: Vec<[f32; 3]>,
    texels: Vec<f32>,
    /// Of the vertices' shares of light, in the third stage.
    shares: Vec<f32>,
}

/// What the views of one state of the model share.
#[derive(Clone, Copy)]
pub struct Around<'a> {
    surroundings: &'a Surroundings,
    lit: &'a LitVertices,
    rng: Rng,
}

/// Adds the gradient of the entropy of some of the colors `[P, 3]`, and returns it.
fn few_colors(kd: &[f32], weight: f32, rng: Rng, d_kd: &mut [f32]) -> f64 {
    let n = kd.len() / 3;
    if weight == 0.0 || n == 0 {
        return 0.0;
    }
    let chosen: Vec<usize> = (0..COMPARED.min(n)).map(|i| rng.below(i as u64, n as u64) as usize).collect();
    let colors: Vec<[f32; 3]> = chosen.iter().map(|i| std::array::from_fn(|k| kd[3 * i + k])).collect();
    let (value, d) = albedo_entropy::entropy(&colors, &[], ENTROPY_WIDTH, &Rng::new(rng.bits(0), 1));
    for (i, d) in chosen.iter().zip(&d) {
        (0..3).for_each(|k| d_kd[3 * i + k] += weight * d[k]);
    }
    weight as f64 * value
}

/// What views of a step share.
pub struct Drawn {
    normals: Vec<[f32; 3]>,
    attributes: Vec<f32>,
    mipped: Vec<f32>,
}

impl Drawn {
    pub fn shape<'a>(&'a self, model: &'a Textured) -> Shape<'a> {
        Shape { positions: model.places(), normals: &self.normals, faces: &model.layout.faces, topology: &model.silhouettes }
    }
}

/// The surface in a view, with texture coordinates, levels and tangents.
pub struct Looked {
    pub surface: Surface,
    pub uv: Vec<f32>,
    pub level: Vec<f32>,
    tangent: Vec<[f32; 4]>,
}

/// Points with their material and light.
pub struct Lit {
    pub kd: Vec<f32>,
    pub ks: Vec<f32>,
    /// Normals of the texture in object space, before and after they are bent.
    normal: Vec<f32>,
    bent: Vec<f32>,
    seen: Option<Seen>,
    pub shaded: super::probe::Shaded,
}

impl Looked {
    /// Tangent, bitangent and normal of a point, as glTF has them.
    fn frame(&self, i: usize) -> [[f32; 3]; 3] {
        let t = self.tangent[i];
        let n: [f32; 3] = std::array::from_fn(|k| self.surface.normal[3 * i + k]);
        let l = (t[0] * t[0] + t[1] * t[1] + t[2] * t[2]).sqrt().max(1e-20);
        let along = [t[0] / l, t[1] / l, t[2] / l];
        let across = diorama_geom::mesh::cross(n, along).map(|v| v * t[3].signum());
        [along, across, n]
    }

    /// Lights the points with values of texels `[P, 9]`.
    pub fn shade(&self, values: &[f32], probe: &Probe, around: Option<Around>) -> Lit {
        let n = self.surface.covered.len();
        let (mut kd, mut ks, mut normal) = (vec![0.0; 3 * n], vec![0.0; 3 * n], vec![0.0; 3 * n]);
        for (i, v) in values.as_chunks::<CHANNELS>().0.iter().enumerate() {
            let at = 3 * i..3 * i + 3;
            kd[at.clone()].copy_from_slice(&v[..3]);
            ks[at.clone()].copy_from_slice(&v[3..6]);
            normal[at].copy_from_slice(&unit(turned(self.frame(i), [v[6], v[7], v[8]])));
        }
        let bent = self.surface.bent(&normal);
        let seen = around.map(|a| a.surroundings.seen(a.lit, &self.surface, (&bent, &ks), a.rng));
        let shaded = probe.shade(&Points { normal: &bent, view: &self.surface.view, kd: &kd, ks: &ks }, seen.as_ref());
        Lit { kd, ks, normal, bent, seen, shaded }
    }

    /// Gradients of the texels' normals, into `d_values`, and of the smooth normals; the tangent counts as given.
    fn tangent_backward(&self, lit: &Lit, values: &[f32], d_normal: &[f32], d_values: &mut [f32]) -> Vec<f32> {
        let n = self.surface.covered.len();
        let mut d_smooth = vec![0.0; 3 * n];
        for i in 0..n {
            let v: [f32; 3] = std::array::from_fn(|k| values[i * CHANNELS + 6 + k]);
            let frame = self.frame(i);
            let sum = turned(frame, v);
            let l = sum.iter().map(|s| s * s).sum::<f32>().sqrt().max(1e-20);
            let along: f32 = (0..3).map(|k| lit.normal[3 * i + k] * d_normal[3 * i + k]).sum();
            let d: [f32; 3] = std::array::from_fn(|k| (d_normal[3 * i + k] - along * lit.normal[3 * i + k]) / l);
            for (j, axis) in frame.iter().enumerate() {
                d_values[i * CHANNELS + 6 + j] = (0..3).map(|k| axis[k] * d[k]).sum();
            }
            // n' = x t + y s (n × t) + z n
            let s = self.tangent[i][3].signum();
            let through = diorama_geom::mesh::cross(frame[0], d);
            (0..3).for_each(|k| d_smooth[3 * i + k] = v[2] * d[k] + v[1] * s * through[k]);
        }
        d_smooth
    }
}

fn turned(frame: [[f32; 3]; 3], v: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|k| v[0] * frame[0][k] + v[1] * frame[1][k] + v[2] * frame[2][k])
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    let l = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt().max(1e-20);
    v.map(|v| v / l)
}

#[cfg(test)]
#[path = "textured_tests.rs"]
mod tests;
