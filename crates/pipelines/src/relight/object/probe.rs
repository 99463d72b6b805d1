//! The light around an object: a cube map that is learned or given, blurred as surfaces see it.

use diorama_engine::params::ParamGroup;
use diorama_geom::environment::Environment;
use diorama_geom::glam::DVec3;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::cube_prefilter::CubePrefilter;
use diorama_kernels::ops::cube_prefilter::cpu::{Blurred, Prefilter};
use diorama_kernels::ops::split_sum::{self, Gradients, Light, Points};
use diorama_kernels::ops::texture::{self, Filter, Kind, Texture, cube_direction};
use rayon::prelude::*;

/// First radiance of a light that is learned.
const FIRST: f32 = 0.5;
/// Points per texel and axis when a light is given.
const POINTS: usize = 4;
/// Rows of the environment map of a probe.
const ROWS: usize = 128;

/// Light, its texels `[6, S, S, 3]` being parameters.
pub struct Probe {
    pub group: ParamGroup,
    prefilter: Prefilter,
    blurred: Blurred,
    d_blurred: Blurred,
    /// Gradient of the texels besides that of blurred light.
    d_texels: Vec<f32>,
}

/// What surroundings do to the light on surface points.
#[derive(Clone, Debug, Default)]
pub struct Seen {
    /// Share of the diffuse light that is not in shadow, and diffuse light from other surfaces `[P, 3]`.
    pub share: Vec<f32>,
    pub added: Vec<f32>,
    /// Share of the mirrored lobe in which the light is seen `[P]`, and light from other surfaces in the rest of it `[P, 3]`.
    pub open: Vec<f32>,
    pub reflected: Vec<f32>,
}

impl Probe {
    /// Even gray light to begin with.
    pub fn new(size: usize, adam: Adam) -> Probe {
        let shape = CubePrefilter::new(size);
        Probe::of(shape, vec![FIRST; shape.base_len()], adam)
    }

    /// Light that is given, each texel the mean over its area.
    pub fn given(size: usize, environment: &Environment) -> Probe {
        let shape = CubePrefilter::new(size);
        let texel = |i: usize| {
            let (face, y, x) = (i / (size * size), i / size % size, i % size);
            let mut sum = [0.0; 3];
            for p in 0..POINTS * POINTS {
                let at = |first: usize, p: usize| (first as f32 + (p as f32 + 0.5) / POINTS as f32) / size as f32;
                let d = cube_direction(face, at(x, p % POINTS), at(y, p / POINTS));
                let radiance = environment.radiance(DVec3::from(d.map(f64::from)).normalize());
                (0..3).for_each(|k| sum[k] += radiance[k]);
            }
            sum.map(|s| (s / (POINTS * POINTS) as f64) as f32)
        };
        let values: Vec<[f32; 3]> = (0..6 * size * size).into_par_iter().map(texel).collect();
        let mut probe = Probe::of(shape, values.into_flattened(), Adam::default());
        probe.group.frozen = true;
        probe.update();
        probe
    }

    fn of(shape: CubePrefilter, values: Vec<f32>, adam: Adam) -> Probe {
        let zeros = || Blurred { diffuse: vec![0.0; shape.diffuse_texture().numbers()], specular: vec![0.0; shape.texture().numbers()] };
        let (blurred, d_blurred) = (zeros(), zeros());
        let d_texels = vec![0.0; values.len()];
        Probe { group: ParamGroup::dense("light", values, adam), prefilter: Prefilter::new(shape), blurred, d_blurred, d_texels }
    }

    fn shape(&self) -> CubePrefilter {
        self.prefilter.shape
    }

    /// Blurs the light as it is now; gradients begin anew.
    pub fn update(&mut self) {
        self.prefilter.forward(&self.group.values, &mut self.blurred);
        self.d_blurred.diffuse.fill(0.0);
        self.d_blurred.specular.fill(0.0);
        self.d_texels.fill(0.0);
    }

    /// Replaces light that is learned by `values` times a coarse factor, `edge`² squares per face, and forgets how it was trained.
    pub fn set_scaled(&mut self, values: &[f32], factor: &[[f32; 3]], rate: f32) {
        let (size, edge) = (self.shape().size, (factor.len() / 6).isqrt());
        let t = Texture { kind: Kind::Cube, filter: Filter::Bilinear, images: 1, size: [edge; 2], channels: 3 };
        let directions: Vec<f32> = (0..6 * size * size)
            .flat_map(|i| {
                let place = |c: usize| (c as f32 + 0.5) / size as f32;
                cube_direction(i / (size * size), place(i % size), place(i / size % size))
            })
            .collect();
        let mut scaled = vec![0.0; values.len()];
        texture::cpu::forward(&t, factor.as_flattened(), &directions, &[], &mut scaled);
        scaled.iter_mut().zip(values).for_each(|(s, v)| *s *= v);
        let adam = Adam { rate, ..self.group.adam };
        self.group = ParamGroup::dense("light", scaled, adam);
        self.update();
    }

    /// Multiplies the light by a factor per channel.
    pub fn scale(&mut self, by: [f32; 3]) {
        self.group.values.as_chunks_mut::<3>().0.iter_mut().for_each(|l| (0..3).for_each(|k| l[k] *= by[k]));
        self.update();
    }

    /// Means of the light over `edge`² squares of each face.
    pub fn coarse(&self, edge: usize) -> Vec<[f32; 3]> {
        coarse(&self.group.values, edge)
    }

    /// Keeps the gradient of [`Probe::coarse`].
    pub fn coarse_backward(&mut self, d: &[[f32; 3]]) {
        let (size, edge) = (self.shape().size, (d.len() / 6).isqrt());
        let wide = size / edge;
        let share = 1.0 / (wide * wide) as f32;
        for (i, to) in self.d_texels.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let d = d[coarse_of(i, size, edge)];
            (0..3).for_each(|k| to[k] += share * d[k]);
        }
    }

    /// Diffuse light along normals `[P, 3]` where nothing casts shadows.
    pub fn diffuse(&self, normals: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; normals.len()];
        texture::cpu::forward(&self.shape().diffuse_texture(), &self.blurred.diffuse, normals, &[], &mut out);
        out
    }

    /// Keeps the gradient of the light for that of [`Probe::diffuse`].
    pub fn diffuse_backward(&mut self, normals: &[f32], d: &[f32]) {
        let t = self.shape().diffuse_texture();
        add(&mut self.d_blurred.diffuse, |to| texture::cpu::backward_texels(&t, normals, &[], d, to));
    }

    /// Colors of surface points; without surroundings if `seen` is none.
    pub fn shade(&self, points: &Points, seen: Option<&Seen>) -> Shaded {
        let n = points.normal.len();
        let mut s = Shaded {
            directions: vec![0.0; n],
            levels: vec![0.0; n / 3],
            diffuse: vec![0.0; n],
            specular: vec![0.0; n],
            unshadowed: Vec::new(),
            color: vec![0.0; n],
        };
        split_sum::cpu::lookups(points, self.shape().levels(), &mut s.directions, &mut s.levels);
        texture::cpu::forward(&self.shape().diffuse_texture(), &self.blurred.diffuse, points.normal, &[], &mut s.diffuse);
        texture::cpu::forward(&self.shape().texture(), &self.blurred.specular, &s.directions, &s.levels, &mut s.specular);
        if let Some(seen) = seen {
            s.unshadowed = s.diffuse.clone();
            s.diffuse.iter_mut().zip(&seen.share).zip(&seen.added).for_each(|((d, share), added)| *d = *d * share + added);
            let rows = s.specular.as_chunks_mut::<3>().0.iter_mut().zip(&seen.open).zip(seen.reflected.as_chunks::<3>().0);
            rows.for_each(|((s, open), more)| (0..3).for_each(|k| s[k] = s[k] * open + more[k]));
        }
        split_sum::cpu::forward(points, &Light { diffuse: &s.diffuse, specular: &s.specular }, &mut s.color);
        s
    }

    /// Gradients of normals, base color, occlusion, roughness and metalness, and of the share in `seen`, for that of [`Probe::shade`]'s color; that
    /// of the light is kept.
    pub fn shade_backward(&mut self, points: &Points, (shaded, seen): (&Shaded, Option<&Seen>), d: &[f32]) -> [Vec<f32>; 4] {
        let n = points.normal.len();
        let [mut d_normal, mut d_kd, mut d_ks, mut d_diffuse, mut d_specular] = std::array::from_fn(|_| vec![0.0; n]);
        let light = Light { diffuse: &shaded.diffuse, specular: &shaded.specular };
        let into = Gradients { normal: &mut d_normal, kd: &mut d_kd, ks: &mut d_ks, diffuse: &mut d_diffuse, specular: &mut d_specular };
        split_sum::cpu::backward(points, &light, d, into);
        let mut d_share = Vec::new();
        if let Some(seen) = seen {
            d_share = d_diffuse.iter().zip(&shaded.unshadowed).map(|(d, u)| d * u).collect();
            d_diffuse.iter_mut().zip(&seen.share).for_each(|(d, share)| *d *= share);
            d_specular.as_chunks_mut::<3>().0.iter_mut().zip(&seen.open).for_each(|(d, open)| d.iter_mut().for_each(|d| *d *= open));
        }
        let (flat, lobes) = (self.shape().diffuse_texture(), self.shape().texture());
        let (mut d_directions, mut d_levels, mut d_along) = (vec![0.0; n], vec![0.0; n / 3], vec![0.0; n]);
        let at = (&shaded.directions[..], &shaded.levels[..]);
        texture::cpu::backward_coordinates(&lobes, &self.blurred.specular, at.0, at.1, &d_specular, &mut d_directions, &mut d_levels);
        texture::cpu::backward_coordinates(&flat, &self.blurred.diffuse, points.normal, &[], &d_diffuse, &mut d_along, &mut []);
        d_normal.par_iter_mut().zip(&d_along).for_each(|(d, a)| *d += a);
        split_sum::cpu::lookups_backward(points, self.shape().levels(), &d_directions, &d_levels, &mut d_normal, &mut d_ks);
        if !self.group.frozen {
            add(&mut self.d_blurred.diffuse, |to| texture::cpu::backward_texels(&flat, points.normal, &[], &d_diffuse, to));
            add(&mut self.d_blurred.specular, |to| texture::cpu::backward_texels(&lobes, at.0, at.1, &d_specular, to));
        }
        [d_normal, d_kd, d_ks, d_share]
    }

    /// Turns the gradients of blurred light into that of its texels, and adds that of `weight · mean |L − gray|`, whose value is returned.
    pub fn finish_backward(&mut self, weight: f32) -> f64 {
        if self.group.frozen {
            return 0.0;
        }
        self.prefilter.backward(&self.d_blurred, &mut self.group.grads);
        self.group.grads.iter_mut().zip(&self.d_texels).for_each(|(g, d)| *g += d);
        let scale = weight / self.group.values.len() as f32;
        let mut sum = 0.0;
        for (texel, d) in self.group.values.as_chunks::<3>().0.iter().zip(self.group.grads.as_chunks_mut::<3>().0) {
            let gray = (texel[0] + texel[1] + texel[2]) / 3.0;
            let signs = texel.map(|v| if v == gray { 0.0 } else { (v - gray).signum() });
            let mean = signs.iter().sum::<f32>() / 3.0;
            for k in 0..3 {
                sum += (texel[k] - gray).abs() as f64;
                d[k] += scale * (signs[k] - mean);
            }
        }
        weight as f64 * sum / self.group.values.len() as f64
    }

    /// One optimizer step; light is never negative.
    pub fn step(&mut self, t: u32, rate_scale: f32) {
        self.group.step(t, rate_scale);
        if !self.group.frozen {
            self.group.values.iter_mut().for_each(|v| *v = v.max(0.0));
        }
    }

    /// The light as an environment map.
    pub fn environment(&self) -> Environment {
        let t = Texture { kind: Kind::Cube, filter: Filter::Bilinear, images: 1, size: [self.shape().size; 2], channels: 3 };
        Environment::from_fn(ROWS, |d| {
            let mut out = [0.0; 3];
            texture::cpu::forward(&t, &self.group.values, &d.as_vec3().to_array(), &[], &mut out);
            out.map(|v| v.max(0.0) as f64)
        })
    }
}

/// Means of a cube map `[6, S, S, 3]` over `edge`² squares of each face.
pub fn coarse(values: &[f32], edge: usize) -> Vec<[f32; 3]> {
    let (size, mut out) = ((values.len() / 18).isqrt(), vec![[0.0f32; 3]; 6 * edge * edge]);
    let wide = size / edge;
    let share = 1.0 / (wide * wide) as f32;
    for (i, v) in values.as_chunks::<3>().0.iter().enumerate() {
        let to = &mut out[coarse_of(i, size, edge)];
        (0..3).for_each(|k| to[k] += share * v[k]);
    }
    out
}

/// The square of a coarse light that holds a texel.
fn coarse_of(i: usize, size: usize, edge: usize) -> usize {
    let (face, y, x, wide) = (i / (size * size), i / size % size, i % size, size / edge);
    (face * edge + y / wide) * edge + x / wide
}

fn add(into: &mut [f32], gradient: impl FnOnce(&mut [f32])) {
    let mut own = vec![0.0; into.len()];
    gradient(&mut own);
    into.par_iter_mut().zip(&own).with_min_len(4096).for_each(|(i, o)| *i += o);
}

/// Colors of points, and what their gradients need.
pub struct Shaded {
    directions: Vec<f32>,
    levels: Vec<f32>,
    diffuse: Vec<f32>,
    specular: Vec<f32>,
    /// Diffuse light before shadows; empty where there are none.
    unshadowed: Vec<f32>,
    /// Linear `[P, 3]`.
    pub color: Vec<f32>,
}
