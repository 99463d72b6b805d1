//! A hash grid field on a GPU. In training, parameters, photographs and occupancy stay there, and nothing is read
//! back but [`GpuTrainer::figures`] and, for a checkpoint, [`GpuTrainer::download`].

pub mod check;

use crate::background::LearnedBackground;
use crate::fields::{Appearance, DirectionCode, Encoding, Field, Pruning};
use crate::params::ParamGroup;
use crate::renderers::volume::{Accelerator, Traced};
use crate::samplers::RayBatch;
use crate::samplers::occupancy::{OCCUPIED, Occupancy};
use diorama_geom::rng::Rng;
use diorama_kernels::gemm::Precision;
use diorama_kernels::gpu::{Buffer, Gpu, GpuError, Rows};
use diorama_kernels::ops::adam::{self, Adam};
use diorama_kernels::ops::hash_grid::gpu::GpuHashGrid;
use diorama_kernels::ops::linear::{self, Activation, BiasKind};
use diorama_kernels::ops::march::MarchConfig;
use diorama_kernels::ops::march::gpu::occupancy::GpuOccupancyGrid;
use diorama_kernels::ops::march::gpu::prune::{self, Limits};
use diorama_kernels::ops::march::gpu::{self as march, GpuOccupancy, GpuRays, Space};
use diorama_kernels::ops::ngp_field::gpu::loss::{self, SUMS, Target, Terms};
use diorama_kernels::ops::ngp_field::gpu::{self as field, Arithmetic, GpuNet};
use diorama_kernels::ops::pixel_gather::gpu::{Backdrop, GpuPhotographs};
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_kernels::ops::ray_generation::gpu::GpuCameras;
use diorama_kernels::ops::{ray_aabb, spherical_harmonics};

/// Terms of the learned background per channel.
const SKY: usize = 16;

/// A group of parameters on the device.
struct GpuGroup {
    values: Buffer,
    moment1: Buffer,
    moment2: Buffer,
    adam: Adam,
    sparse: bool,
    frozen: bool,
}

impl GpuGroup {
    fn upload(gpu: &Gpu, g: &ParamGroup) -> Self {
        GpuGroup {
            values: gpu.upload(&g.values),
            moment1: gpu.upload(&g.moment1),
            moment2: gpu.upload(&g.moment2),
            adam: g.adam,
            sparse: !g.touched.is_empty(),
            frozen: g.frozen,
        }
    }

    fn download(&self, gpu: &Gpu, g: &mut ParamGroup) -> Result<(), GpuError> {
        g.values = gpu.read(&self.values)?;
        g.moment1 = gpu.read(&self.moment1)?;
        g.moment2 = gpu.read(&self.moment2)?;
        Ok(())
    }

    /// One step `t ≥ 1` along `grads`, which are cleared.
    fn step(&self, gpu: &Gpu, t: u32, scale: f32, grads: &Buffer) {
        if !self.frozen {
            let a = Adam { rate: self.adam.rate * scale, ..self.adam };
            adam::gpu::step(gpu, &a, t, self.sparse, &self.values, &self.moment1, &self.moment2, grads);
        }
    }
}

/// A field's shape on the device.
struct Shape {
    grid: GpuHashGrid,
    net: GpuNet,
    /// Of the spherical harmonics.
    degree: usize,
    space: Space,
}

impl Shape {
    /// # Panics
    /// When the field is not a hash grid with directions in spherical harmonics.
    fn new(gpu: &Gpu, field: &Field) -> Self {
        let (Encoding::Hash(grid), DirectionCode::SphericalHarmonics(degree)) = (&field.encoding, field.directions) else {
            unreachable!("only hash grid fields go to a GPU")
        };
        let arithmetic = if field.net.mlp.precision == Precision::F32 { Arithmetic::Exact } else { Arithmetic::Best };
        // The features', and the appearance codes'; directions have none.
        let wanted = [true, false, true];
        let (density, per_level) = (field.density_net(Precision::F32), grid.config.features);
        Shape {
            grid: GpuHashGrid::new(gpu, grid),
            net: GpuNet::new(gpu, &field.net, &density, per_level, &wanted[..field.net.mlp.input_widths.len()], arithmetic),
            degree,
            space: if field.contraction { Space::Contracted } else { Space::Cube(field.outer) },
        }
    }

    fn features(&self, gpu: &Gpu, rows: &Rows, points: &Buffer, table: &Buffer) -> Buffer {
        self.net.features(gpu, rows, self.grid.forward(gpu, rows, points, table))
    }
}

/// What a step depends on.
#[derive(Clone, Copy, Debug)]
pub struct GpuStep {
    pub rays: usize,
    /// Rays drawn before.
    pub first: u64,
    pub pixels: Rng,
    /// Ignored where the background is learned.
    pub backdrop: Backdrop,
    pub near: f32,
    pub march: MarchConfig,
    pub limits: Limits,
    pub terms: Terms,
    pub near_scaling: f32,
    /// Samples that there is room for, before and after those that cannot matter are left out.
    pub room: (usize, usize),
    /// Number of the optimiser step, from 1.
    pub t: u32,
    pub rate_scale: f32,
}

/// Means over some steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Figures {
    pub steps: u64,
    pub loss: f64,
    pub mse: f64,
    /// Samples trained and marched, all steps together.
    pub trained: f64,
    pub marched: f64,
}

/// See the module.
pub struct GpuTrainer {
    gpu: Gpu,
    shape: Shape,
    cube: (f32, f32),
    table: GpuGroup,
    d_table: Buffer,
    weights: GpuGroup,
    appearance: Option<(GpuGroup, usize)>,
    learned: Option<GpuGroup>,
    occupancy: GpuOccupancyGrid,
    photographs: GpuPhotographs,
    cameras: GpuCameras,
    sums: Buffer,
}

impl GpuTrainer {
    /// Uploads all that training needs; `cube` is the scene's outer cube: lowest corner and edge.
    ///
    /// # Panics
    /// When the field is not a hash grid with directions in spherical harmonics.
    pub fn new(
        gpu: Gpu,
        field: &Field,
        learned: Option<&LearnedBackground>,
        occupancy: &Occupancy,
        photographs: GpuPhotographs,
        cameras: &[PosedCamera],
        cube: (f32, f32),
    ) -> Self {
        let (shape, o) = (Shape::new(&gpu, field), occupancy);
        let table = field.table.as_ref().expect("a hash field has a table");
        GpuTrainer {
            shape,
            cube,
            d_table: gpu.zeros(table.values.len()),
            table: GpuGroup::upload(&gpu, table),
            weights: GpuGroup::upload(&gpu, &field.weights),
            appearance: field.appearance.as_ref().map(|a| (GpuGroup::upload(&gpu, &a.group), a.dims)),
            learned: learned.map(|l| GpuGroup::upload(&gpu, &l.group)),
            occupancy: GpuOccupancyGrid::upload(&gpu, &o.bits, &o.density, &o.fresh, &o.live, o.decay, OCCUPIED),
            photographs,
            cameras: GpuCameras::upload(&gpu, cameras),
            sums: gpu.zeros(SUMS),
            gpu,
        }
    }

    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// One optimiser step: draw, march, leave out, encode, evaluate, compare, and back.
    pub fn step(&self, s: &GpuStep) {
        let gpu = &self.gpu;
        let drawn = self.photographs.draw(gpu, s.rays, s.first, &s.pixels, s.backdrop);
        let (origins, dirs) = self.cameras.forward(gpu, &drawn.images, &drawn.pixels);
        let (low, size) = self.cube;
        let near_far = ray_aabb::gpu::intersect(gpu, &origins, &dirs, [low; 3], [low + size; 3], s.near);
        let rays = GpuRays { origins, dirs, near_far, jitter: drawn.jitter, resumed: false };
        let direction = spherical_harmonics::gpu::forward(gpu, self.shape.degree, &rays.dirs);
        let sky = self.learned.as_ref().map(|g| {
            let every_ray = Rows::all(gpu, s.rays);
            let codes = spherical_harmonics::gpu::forward(gpu, 4, &rays.dirs);
            let rgb = linear::gpu::forward(gpu, &every_ray, (SKY, 3), &codes, &g.values, None, BiasKind::None, Activation::Sigmoid);
            (every_ray, codes, rgb)
        });
        let background = sky.as_ref().map_or(&drawn.background, |(_, _, rgb)| rgb);

        // All samples in occupied cells: their densities decide which are trained, and keep the grid up to date.
        let marched = march::march(gpu, &self.occupancy.bits, &rays, &s.march, s.room.0);
        let all = marched.packed.rows();
        let points = march::positions(gpu, &rays, &marched.packed, self.shape.space);
        let features = self.shape.features(gpu, &all, &points, &self.table.values);
        let sigma = self.shape.net.density(gpu, &self.weights.values, &features, &all);
        let pruned = prune::prune(gpu, &marched.packed, &sigma, s.limits, &marched.cut, s.room.1);
        self.occupancy.record(gpu, &all, &marched.cells, &sigma);
        let samples = &pruned.packed;
        let points = pruned.take(gpu, &points, 3);
        let features = self.shape.net.take(gpu, &pruned, &features);

        let appearance = self.appearance.as_ref().map(|(g, dims)| field::look_up(gpu, &g.values, &drawn.images, *dims));
        let codes: Vec<&Buffer> = [&direction].into_iter().chain(&appearance).collect();
        let left_out = gpu.either(&drawn.left_out, &marched.cut);
        let target = Target { rgba: &drawn.target, background, left_out: &left_out };
        let (net, weights, all) = (&self.shape.net, &self.weights.values, &marched.packed.offsets);
        let g = if s.terms.distortion == 0.0 {
            let at = net.evaluate(gpu, weights, samples, &features, &codes, true);
            let d = loss::composite_and_loss(gpu, s.terms, samples, &at.sigma, &at.rgb, target, s.near_scaling, all, &self.sums);
            net.gradients(gpu, weights, samples, &at, &d)
        } else {
            let step = net.forward(gpu, weights, samples, &features, &codes, background, true);
            let d = loss::loss(gpu, s.terms, samples, &step.out, target, all, &self.sums);
            net.backward(gpu, weights, samples, background, &step, &d, s.near_scaling)
        };

        self.weights.step(gpu, s.t, s.rate_scale, &g.params);
        if let (false, Some(d_features)) = (self.table.frozen, &g.features) {
            self.shape.grid.backward(gpu, &samples.rows(), &points, d_features, &self.d_table);
            self.table.step(gpu, s.t, s.rate_scale, &self.d_table);
        }
        if let (Some((group, dims)), Some(Some(d_codes))) = (&self.appearance, g.codes.get(1)) {
            let d = gpu.zeros(group.values.len());
            field::look_up_backward(gpu, d_codes, &drawn.images, *dims, &d);
            group.step(gpu, s.t, s.rate_scale, &d);
        }
        if let (Some(group), Some((every_ray, codes, rgb))) = (&self.learned, &sky) {
            let none = BiasKind::None;
            let d = linear::gpu::backward(gpu, every_ray, (SKY, 3), codes, &group.values, none, Activation::Sigmoid, rgb, &g.background);
            group.step(gpu, s.t, s.rate_scale, &d.w);
        }
    }

    /// Samples the field at random points of the cells that a camera sees, and decides anew which are occupied.
    pub fn update_occupancy(&self, rng: &Rng, counter: u64, count: usize, block: usize) {
        let (points, cells) = self.occupancy.probe(&self.gpu, rng, counter, count, block, self.shape.space);
        let rows = Rows::all(&self.gpu, count);
        let features = self.shape.features(&self.gpu, &rows, &points, &self.table.values);
        let sigma = self.shape.net.density(&self.gpu, &self.weights.values, &features, &rows);
        self.occupancy.update(&self.gpu, &cells, &sigma, block);
    }

    /// Waits for the device; means since the last call.
    ///
    /// # Errors
    /// When the device was lost or is full.
    pub fn figures(&mut self) -> Result<Figures, GpuError> {
        let sums = std::mem::replace(&mut self.sums, self.gpu.zeros(SUMS));
        let sums: Vec<f64> = self.gpu.read(&sums)?.iter().map(|v| *v as f64).collect();
        let n = sums[4].max(1.0);
        Ok(Figures { steps: sums[4] as u64, loss: sums[0] / n, mse: sums[1] / n, trained: sums[2], marched: sums[3] })
    }

    /// Brings parameters, moments and occupancy back.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn download(&self, field: &mut Field, learned: Option<&mut LearnedBackground>, occupancy: &mut Occupancy) -> Result<(), GpuError> {
        let gpu = &self.gpu;
        if let Some(t) = &mut field.table {
            self.table.download(gpu, t)?;
        }
        self.weights.download(gpu, &mut field.weights)?;
        if let (Some((own, _)), Some(a)) = (&self.appearance, &mut field.appearance) {
            own.download(gpu, &mut a.group)?;
        }
        if let (Some(own), Some(l)) = (&self.learned, learned) {
            own.download(gpu, &mut l.group)?;
        }
        (occupancy.density, occupancy.fresh) = self.occupancy.read(gpu)?;
        occupancy.refresh();
        Ok(())
    }
}

/// A trained field on the device, ready to be looked at.
pub struct GpuTracer {
    gpu: Gpu,
    shape: Shape,
    table: Buffer,
    weights: Buffer,
    /// Codes of all images and their mean, `[images + 1, dims]`.
    appearance: Option<(Buffer, usize)>,
    occupancy: GpuOccupancy,
    /// Samples that there is room for.
    room: usize,
}

impl GpuTracer {
    /// # Panics
    /// When the field is not a hash grid with directions in spherical harmonics.
    pub fn new(gpu: Gpu, field: &Field, occupancy: &Occupancy) -> Self {
        let table = field.table.as_ref().expect("a hash field has a table");
        let codes = |a: &Appearance| (gpu.upload(&[&a.group.values[..], &a.mean()].concat()), a.dims);
        GpuTracer {
            shape: Shape::new(&gpu, field),
            table: gpu.upload(&table.values),
            weights: gpu.upload(&field.weights.values),
            appearance: field.appearance.as_ref().map(codes),
            occupancy: GpuOccupancy::upload(&gpu, &occupancy.bits),
            room: if gpu.software { 1 << 17 } else { 1 << 20 },
            gpu,
        }
    }

    /// The same with room for other than the usual number of samples.
    #[must_use]
    pub fn with_room(self, samples: usize) -> Self {
        GpuTracer { room: samples, ..self }
    }

    /// Rays `first..first + n` of a batch; halves are traced apart where their samples find no room together.
    fn part(
        &self,
        batch: &RayBatch,
        (first, n): (usize, usize),
        march: &MarchConfig,
        limits: Limits,
        appearance: Option<u32>,
        out: &mut (Traced, Vec<f32>),
    ) -> Result<(), GpuError> {
        let gpu = &self.gpu;
        let of = |v: &[f32], width: usize| gpu.upload(&v[first * width..(first + n) * width]);
        let rays = GpuRays {
            origins: of(&batch.origins, 3),
            dirs: of(&batch.dirs, 3),
            near_far: of(&batch.near_far, 2),
            jitter: of(&batch.jitter, 1),
            resumed: false,
        };
        let marched = march::march(gpu, &self.occupancy, &rays, march, self.room);
        if n > 1 && gpu.read_u32(&marched.cut)?.contains(&1) {
            self.part(batch, (first, n / 2), march, limits, appearance, out)?;
            return self.part(batch, (first + n / 2, n - n / 2), march, limits, appearance, out);
        }
        let all = marched.packed.rows();
        let points = march::positions(gpu, &rays, &marched.packed, self.shape.space);
        let features = self.shape.features(gpu, &all, &points, &self.table);
        let sigma = self.shape.net.density(gpu, &self.weights, &features, &all);
        let pruned = prune::prune(gpu, &marched.packed, &sigma, limits, &marched.cut, self.room);
        let features = self.shape.net.take(gpu, &pruned, &features);
        let direction = spherical_harmonics::gpu::forward(gpu, self.shape.degree, &rays.dirs);
        let code = self.appearance.as_ref().map(|(codes, dims)| {
            let mean = (codes.len() / dims - 1) as u32;
            field::look_up(gpu, codes, &gpu.upload_u32(&vec![appearance.unwrap_or(mean); n]), *dims)
        });
        let codes: Vec<&Buffer> = [&direction].into_iter().chain(&code).collect();
        let black = gpu.zeros(n * 3);
        let view = self.shape.net.forward(gpu, &self.weights, &pruned.packed, &features, &codes, &black, false).out;
        out.0.rgb.extend(gpu.read(&view.color)?);
        out.0.opacity.extend(gpu.read(&view.opacity)?);
        out.0.depth.extend(gpu.read(&view.depth)?);
        out.1.extend(gpu.read(&pruned.light)?);
        Ok(())
    }
}

impl Accelerator for GpuTracer {
    fn trace(&self, batch: &RayBatch, march: &MarchConfig, pruning: Pruning, appearance: Option<u32>) -> Option<(Traced, Vec<f32>)> {
        let Pruning { stop, min_alpha, thin, min_weight } = pruning;
        let mut out = (Traced::default(), Vec::new());
        let limits = Limits { stop, min_alpha, thin, min_weight };
        self.part(batch, (0, batch.len()), march, limits, appearance, &mut out).ok()?;
        Some(out)
    }

    fn rays(&self) -> usize {
        if self.gpu.software { 1 << 12 } else { 1 << 17 }
    }
}
