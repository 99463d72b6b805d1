//! First stage: the surface of a signed distance on a tetrahedral grid, whose topology is found, with a material by position (Shen et al.
//! 2021, DMTet; Munkberg et al. 2022, nvdiffrec).

use super::capture::{BOX_HALF, ObjectPhoto, ObjectView};
use super::carving::Carving;
use super::config::Config;
use super::hull;
use super::loss::{self, PictureLoss};
use super::material::{self, Material};
use super::placement::Placement;
use super::probe::Probe;
use super::raster::{Shape, Surface, SurfaceGradient};
use crate::error::Result;
use diorama_data::tetrahedra_npz;
use diorama_engine::params::ParamGroup;
use diorama_geom::Mesh;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::mesh_smoothness::{self, MeshTopology};
use diorama_kernels::ops::split_sum::Points;
use diorama_kernels::ops::tetrahedral_surface::{self, Surface as Extracted};
use diorama_kernels::ops::{antialias, sign_change_loss, vertex_normals};
use diorama_mesh::surface_limits::{SurfaceFault, SurfaceLimits};
use diorama_mesh::tetrahedral_grid::{BOX_EDGE, TetrahedralGrid};
use rayon::prelude::*;

/// Largest distance at the start, in cells.
const NEAR: f64 = 1.0;
/// Of so many surface points, one is compared with a point nearby.
const SPARSITY: usize = 4;
/// Standard deviation of the way to that point.
const JITTER: f32 = 0.03;
/// Share of the stage over which smoothness of the color sets in.
const RAMP: f32 = 0.1;
/// Share of the stage after which the sign-change loss has its last weight.
const SETTLED: f32 = 0.25;
/// Crease beyond which angles between faces count little, as 1 − cos 18°.
const CREASE: f32 = 0.05;
/// Weight of occlusion against none.
const OCCLUSION: f32 = 0.001;

/// What a step of either stage gets.
pub struct StepInput<'a> {
    pub photos: Vec<&'a ObjectPhoto>,
    /// Random numbers of the step.
    pub rng: Rng,
    /// Share of the stage that is done.
    pub progress: f32,
    /// Step of the stage, from 1.
    pub t: u32,
    pub rate_scale: f32,
}

/// A photograph in a step.
#[derive(Clone, Copy)]
pub struct ViewPass<'a> {
    pub config: &'a Config,
    pub photo: &'a ObjectPhoto,
    /// Share of the step's loss.
    pub share: f32,
    pub rng: Rng,
    /// Share of the stage that is done.
    pub progress: f32,
}

/// Losses of a step.
#[derive(Clone, Copy, Debug, Default)]
pub struct StepLoss {
    pub color: f64,
    pub mask: f64,
    pub regularizers: f64,
    pub mse: f64,
    pub faces: usize,
}

impl StepLoss {
    pub fn total(&self) -> f64 {
        self.color + self.mask + self.regularizers
    }

    pub fn add(&mut self, p: PictureLoss, share: f64) {
        self.color += share * p.color;
        self.mask += share * p.mask;
        self.mse += share * p.mse;
    }
}

/// The model of the first stage.
pub struct Topology {
    grid: TetrahedralGrid,
    limits: SurfaceLimits,
    pub distances: ParamGroup,
    pub offsets: ParamGroup,
    pub material: Material,
}

impl Topology {
    /// The model without a surface yet.
    ///
    /// # Errors
    /// When the grid comes from a file that cannot be read.
    pub fn new(config: &Config) -> Result<Topology> {
        let grid = match config.grid.file.as_os_str().is_empty() {
            true => TetrahedralGrid::lattice(config.grid.cells, BOX_EDGE),
            false => TetrahedralGrid::new(tetrahedra_npz::read(&config.grid.file)?, BOX_EDGE),
        };
        let adam = Adam { rate: config.optim.shape_rate, beta2: 0.999, epsilon: 1e-8, ..Adam::default() };
        let zeros = |name, n: usize| ParamGroup::dense(name, vec![0.0; n], adam);
        let (distances, offsets) = (zeros("distances", grid.vertices()), zeros("offsets", 3 * grid.vertices()));
        Ok(Topology { limits: SurfaceLimits::of(&grid), distances, offsets, grid, material: Material::new(config) })
    }

    /// Gives it a random surface; `bias` is added to all distances, in cells.
    pub fn begin_random(&mut self, seed: u64, bias: f32) {
        self.distances.values = self.grid.random_distances(seed).iter().map(|d| d + bias).collect();
    }

    /// Gives it the hull of the masks, without what is carved off; `bias` is added to all distances, in cells.
    pub fn begin(&mut self, silhouettes: &[hull::Silhouette], placement: &Placement, carving: Option<&Carving>, bias: f32) {
        let cell = self.grid.cell as f64;
        let at = |p: &[f32; 3]| {
            let p = DVec3::from(p.map(f64::from));
            let hull = hull::distance(silhouettes, p * placement.scale + placement.center) / placement.scale / cell;
            // Far from what was taken off, nothing but the hull limits it: a cell of carving may be a small part of one here.
            let left = carving.map(|c| (c.distance(p), c.cell() / cell)).map_or(NEAR, |(d, size)| if d < 1.0 { d * size } else { NEAR });
            // The surface must be closed within the box.
            let to_wall = (BOX_HALF - p.abs().max_element()) / cell - 0.5;
            hull.min(left).min(to_wall).clamp(-NEAR, NEAR) as f32 + bias
        };
        self.distances.values = self.grid.rest.par_iter().map(at).collect();
    }

    fn positions(&self) -> Vec<[f32; 3]> {
        let mut positions = vec![[0.0; 3]; self.grid.vertices()];
        self.grid.deform(self.offsets.values.as_chunks::<3>().0, &mut positions);
        positions
    }

    fn extract(&self, positions: &[[f32; 3]]) -> Extracted {
        let mut surface = Extracted::default();
        tetrahedral_surface::cpu::extract(&self.grid.topology, &self.distances.values, positions, &mut surface);
        surface
    }

    /// The surface as a mesh.
    pub fn mesh(&self) -> Mesh {
        let surface = self.extract(&self.positions());
        Mesh { positions: surface.positions, faces: surface.faces, ..Mesh::default() }
    }

    /// The picture `[H, W, 4]` of a view, linear light times opacity.
    pub fn picture(&self, view: &ObjectView, probe: &Probe) -> Vec<f32> {
        let mesh = self.mesh();
        let normals = vertex_normals::cpu::forward(&mesh.faces, &mesh.positions);
        let topology = antialias::Topology::new(&mesh.faces);
        let shape = Shape { positions: &mesh.positions, normals: &normals, faces: &mesh.faces, topology: &topology };
        let surface = Surface::draw(view, &shape, false);
        let (values, normal) = (self.material.evaluate(&surface.position), surface.bent(&surface.normal));
        let shaded = probe.shade(&Points { normal: &normal, view: &surface.view, kd: &values.kd, ks: &values.ks }, None);
        surface.picture(&shape, &shaded.color).rgba
    }

    /// Edge of a cube of the grid.
    pub fn cell(&self) -> f32 {
        self.grid.cell
    }

    /// One optimizer step.
    ///
    /// # Errors
    /// When the surface has vanished or exploded; nothing is changed then.
    pub fn step(&mut self, config: &Config, input: &StepInput, probe: &mut Probe) -> std::result::Result<StepLoss, SurfaceFault> {
        let positions = self.positions();
        let surface = self.extract(&positions);
        self.limits.check(&surface)?;
        let normals = vertex_normals::cpu::forward(&surface.faces, &surface.positions);
        let topology = antialias::Topology::new(&surface.faces);
        let shape = Shape { positions: &surface.positions, normals: &normals, faces: &surface.faces, topology: &topology };
        let mut loss = StepLoss { faces: surface.faces.len(), ..StepLoss::default() };
        let mut d_vertices = vec![[0.0f32; 3]; surface.positions.len()];
        let share = 1.0 / input.photos.len() as f32;
        probe.update();
        for (i, photo) in input.photos.iter().enumerate() {
            let pass = ViewPass { config, photo, share, rng: Rng::new(input.rng.bits(i as u64), 0), progress: input.progress };
            self.view(&pass, &shape, probe, &mut loss, &mut d_vertices);
        }
        loss.regularizers += probe.finish_backward(config.loss.white_light);
        if config.loss.normal_consistency > 0.0 {
            let (topology, weight) = (MeshTopology::new(surface.positions.len(), &surface.faces), config.loss.normal_consistency);
            let value = mesh_smoothness::cpu::normal_consistency(&topology, &surface.positions, CREASE, weight, &mut d_vertices);
            loss.regularizers += weight as f64 * value;
        }
        let (mut d_positions, d_s) = (vec![[0.0; 3]; positions.len()], &mut self.distances.grads);
        let at = (&self.distances.values[..], &positions[..]);
        tetrahedral_surface::cpu::backward(&self.grid.topology, &surface, at, &d_vertices, (d_s, &mut d_positions));
        self.grid.deform_backward(self.offsets.values.as_chunks::<3>().0, &mut d_positions);
        self.offsets.grads.copy_from_slice(d_positions.as_flattened());
        let [first, last] = config.loss.sign_change;
        let weight = first + (last - first) * (input.progress / SETTLED).min(1.0);
        loss.regularizers += weight as f64 * sign_change_loss::cpu::value(&self.grid.topology, &surface, &self.distances.values);
        sign_change_loss::cpu::backward(&self.grid.topology, &surface, &self.distances.values, weight, &mut self.distances.grads);
        let rate = input.rate_scale * config.optim.final_scale.powf(input.progress);
        self.distances.step(input.t, rate);
        self.offsets.step(input.t, rate);
        // What light can explain, it shall: the material follows later.
        if input.progress >= config.optim.material_from {
            self.material.step(input.t, rate);
        } else {
            self.material.forget();
        }
        probe.step(input.t, rate);
        Ok(loss)
    }

    /// One photograph: its losses, and gradients of everything.
    fn view(&mut self, pass: &ViewPass, shape: &Shape, probe: &mut Probe, loss: &mut StepLoss, d_vertices: &mut [[f32; 3]]) {
        let ViewPass { config, photo, share, rng, progress } = *pass;
        let surface = Surface::draw(&photo.view, shape, false);
        let n = surface.covered.len();
        // Points nearby follow the points themselves.
        let mut points = surface.position.clone();
        let near: Vec<usize> = (0..n).skip(rng.below(0, SPARSITY as u64) as usize).step_by(SPARSITY).collect();
        let jitter = Rng::new(rng.bits(1), 1);
        for (j, i) in near.iter().enumerate() {
            points.extend((0..3).map(|k| surface.position[3 * i + k] + JITTER * jitter.normal((3 * j + k) as u64)));
        }
        let values = self.material.evaluate(&points);
        let normal = surface.bent(&surface.normal);
        let at = Points { normal: &normal, view: &surface.view, kd: &values.kd[..3 * n], ks: &values.ks[..3 * n] };
        let shaded = probe.shade(&at, None);
        let picture = surface.picture(shape, &shaded.color);
        let mut d = vec![0.0; picture.rgba.len()];
        let of = loss::picture(&picture.rgba, &photo.rgba.data, config.loss.mask, Rng::new(rng.bits(2), 2), &mut d);
        d.par_iter_mut().with_min_len(4096).for_each(|d| *d *= share);
        loss.add(of, share as f64);
        let (d_color, d_clip) = surface.picture_backward(&picture, &d);
        let [mut d_normal, mut d_kd, mut d_ks, _] = probe.shade_backward(&at, (&shaded, None), &d_color);
        surface.bent_backward(&surface.normal, &mut d_normal);
        d_kd.resize(points.len(), 0.0);
        d_ks.resize(points.len(), 0.0);
        let covered = n as f32 / (photo.rgba.width * photo.rgba.height) as f32;
        let ramp = share * covered * (progress / RAMP).min(1.0);
        let own: Vec<f32> = near.iter().flat_map(|i| values.kd[3 * i..3 * i + 3].iter().copied()).collect();
        loss.regularizers += material::smoothness(&own, &values.kd[3 * n..], ramp * config.loss.color_smoothness, |i, d| {
            d_kd[3 * near[i / 3] + i % 3] += d;
            d_kd[3 * n + i] -= d;
        });
        let occlusion = ramp * OCCLUSION / n.max(1) as f32;
        for i in 0..n {
            d_ks[3 * i] += occlusion;
            loss.regularizers += (occlusion * values.ks[3 * i]) as f64;
        }
        let d_points = self.material.backward(&values, &d_kd, &d_ks);
        let gradient = SurfaceGradient { normal: &d_normal, position: Some(&d_points[..3 * n]), barycentric: None };
        surface.backward(&photo.view, shape, &gradient, d_clip, d_vertices);
    }
}
