//! Training steps that stay on the device.

use super::shape::Shape;
use crate::background::LearnedBackground;
use crate::fields::Field;
use crate::params::ParamGroup;
use crate::samplers::occupancy::Occupancy;
use crate::samplers::pixels::ErrorMap;
use diorama_geom::rng::Rng;
use diorama_kernels::gpu::{Buffer, Gpu, GpuError, Rows};
use diorama_kernels::ops::adam::{self, Adam};
use diorama_kernels::ops::composite::gpu::GpuPacked;
use diorama_kernels::ops::field_step::gpu::loss::{self, SUMS, Target, Terms};
use diorama_kernels::ops::field_step::gpu::{self as field, FieldInput};
use diorama_kernels::ops::linear::{self, Activation, BiasKind, Dense};
use diorama_kernels::ops::march::MarchConfig;
use diorama_kernels::ops::march::gpu::occupancy::GpuOccupancyGrid;
use diorama_kernels::ops::march::gpu::prune::{self, Limits};
use diorama_kernels::ops::march::gpu::{self as march, GpuRays};
use diorama_kernels::ops::pixel_gather::gpu::error_map::GpuErrorMap;
use diorama_kernels::ops::pixel_gather::gpu::{Backdrop, Drawn, GpuPhotographs};
use diorama_kernels::ops::ray_generation::PosedCamera;
use diorama_kernels::ops::ray_generation::gpu::GpuCameras;
use diorama_kernels::ops::sample_pdf::gpu::strata;
use diorama_kernels::ops::{ray_aabb, spherical_harmonics};

/// Terms of the learned background per channel.
const SKY: usize = 16;

/// The learned background as a layer on codes of directions.
fn sky_layer(activation: Activation) -> Dense {
    Dense { k: SKY, n: 3, bias: BiasKind::None, activation }
}

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
            moment1: gpu.upload_or_zeros(&g.moment1),
            moment2: gpu.upload_or_zeros(&g.moment2),
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
    fn step(&self, gpu: &Gpu, (t, scale): (u32, f32), grads: &Buffer) {
        if !self.frozen {
            let a = Adam { rate: self.adam.rate * scale, ..self.adam };
            adam::gpu::step(gpu, &a, (t, self.sparse), &self.values, [&self.moment1, &self.moment2], grads);
        }
    }
}

/// A field in training.
struct GpuField {
    shape: Shape,
    /// Values and gradient.
    table: Option<(GpuGroup, Buffer)>,
    weights: GpuGroup,
    /// Codes and their length.
    appearance: Option<(GpuGroup, usize)>,
}

/// Samples that a field is trained on.
struct Samples<'a> {
    rays: &'a GpuRays,
    packed: &'a GpuPacked,
    /// In the field's space, and encoded.
    points: Buffer,
    features: Buffer,
    drawn: &'a Drawn,
    target: Target<'a>,
    figures: loss::Figures<'a>,
    wants_weights: bool,
    moves: bool,
}

/// What training on samples gives besides better parameters.
struct Learned {
    /// Squared error of each ray.
    errors: Buffer,
    background: Buffer,
    weights: Option<Buffer>,
    points: Option<Buffer>,
}

impl GpuField {
    fn upload(gpu: &Gpu, field: &Field, moves: bool) -> Self {
        GpuField {
            shape: Shape::new(gpu, field, moves),
            table: field.encoder.table().map(|t| (GpuGroup::upload(gpu, t), gpu.zeros(t.values.len()))),
            weights: GpuGroup::upload(gpu, &field.weights),
            appearance: field.codes.appearance.as_ref().map(|a| (GpuGroup::upload(gpu, &a.group), a.dims)),
        }
    }

    fn download(&self, gpu: &Gpu, field: &mut Field) -> Result<(), GpuError> {
        if let (Some((own, _)), Some(t)) = (&self.table, field.encoder.table_mut()) {
            own.download(gpu, t)?;
        }
        self.weights.download(gpu, &mut field.weights)?;
        if let (Some((own, _)), Some(a)) = (&self.appearance, &mut field.codes.appearance) {
            own.download(gpu, &mut a.group)?;
        }
        Ok(())
    }

    fn table(&self) -> Option<&Buffer> {
        self.table.as_ref().map(|(t, _)| &t.values)
    }

    /// Points of samples in the field's space, and encoded.
    fn encode(&self, gpu: &Gpu, rays: &GpuRays, packed: &GpuPacked) -> (Buffer, Buffer) {
        let points = march::positions(gpu, rays, packed, self.shape.space);
        let features = self.shape.features(gpu, &packed.rows(), &points, self.table());
        (points, features)
    }

    /// Evaluates samples, compares them, and steps along the gradients.
    fn train(&self, gpu: &Gpu, s: &GpuStep, on: &Samples) -> Learned {
        let (net, weights, packed) = (&self.shape.net, &self.weights.values, on.packed);
        let direction = self.shape.direction(gpu, &on.rays.dirs);
        let appearance = self.appearance.as_ref().map(|(g, dims)| field::look_up(gpu, &g.values, &on.drawn.images, *dims));
        let codes: Vec<&Buffer> = direction.iter().chain(&appearance).collect();
        let input = FieldInput { packed, features: &on.features, codes: &codes };
        let (g, errors, composited) = if !on.wants_weights {
            let at = net.evaluate(gpu, weights, &input, true);
            let (d, errors) =
                loss::composite_and_loss(gpu, s.terms, packed, (&at.sigma, &at.outputs), on.target, s.near_scaling, on.figures);
            (net.gradients(gpu, weights, &at, &d), errors, None)
        } else {
            let step = net.forward(gpu, weights, &input, on.target.background, true);
            let (d, errors) = loss::loss(gpu, s.terms, packed, &step.out, on.target, on.figures);
            let g = net.backward(gpu, weights, &step, &d, s.near_scaling);
            (g, errors, Some(step.out.weights))
        };
        let points = match (&g.features, on.moves) {
            (Some(d), true) => Some(self.shape.points_backward(gpu, &packed.rows(), &on.points, self.table(), d)),
            _ => None,
        };
        let at = (s.t, s.rate_scale);
        self.weights.step(gpu, at, &g.params);
        if let (Some((table, d_table)), Some(d)) = (&self.table, &g.features)
            && !table.frozen
        {
            self.shape.table_backward(gpu, &packed.rows(), &on.points, d, d_table);
            table.step(gpu, at, d_table);
        }
        if let (Some((group, dims)), Some(Some(d_codes))) = (&self.appearance, g.codes.last()) {
            let d = gpu.zeros(group.values.len());
            field::look_up_backward(gpu, d_codes, &on.drawn.images, *dims, &d);
            group.step(gpu, at, &d);
        }
        Learned { errors, background: g.background, weights: composited, points }
    }
}

/// How a step's samples are placed.
#[derive(Clone, Copy, Debug)]
pub enum Placing {
    /// In occupied cells, but for those that cannot matter; `room`: samples that there is memory for, before and
    /// after those are left out.
    Occupancy { march: MarchConfig, limits: Limits, room: (usize, usize) },
    /// One per equal interval.
    Stratified { samples: usize, rng: Rng },
    /// The coarse field's decide where `more` go for the main one.
    Hierarchical { samples: usize, more: usize, coarse: Rng, fine: Rng },
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
    pub placing: Placing,
    pub terms: Terms,
    pub near_scaling: f32,
    /// Number of the optimiser step, from 1.
    pub t: u32,
    pub rate_scale: f32,
    /// Whether draws go by the errors as they are after this step.
    pub refresh_errors: bool,
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

/// What is trained.
pub struct Trainees<'a> {
    pub field: &'a Field,
    pub coarse: Option<&'a Field>,
    pub learned: Option<&'a LearnedBackground>,
    pub occupancy: Option<&'a Occupancy>,
    /// Of the cameras, `[cameras, 7]`, and whether focal lengths are among what is refined.
    pub corrections: Option<(&'a ParamGroup, bool)>,
    pub error_map: Option<&'a ErrorMap>,
}

/// Where what was trained comes back to.
pub struct TraineesMut<'a> {
    pub field: &'a mut Field,
    pub coarse: Option<&'a mut Field>,
    pub learned: Option<&'a mut LearnedBackground>,
    pub occupancy: Option<&'a mut Occupancy>,
    pub corrections: Option<&'a mut ParamGroup>,
    pub error_map: Option<&'a mut ErrorMap>,
}

/// See the module.
pub struct GpuTrainer {
    gpu: Gpu,
    field: GpuField,
    coarse: Option<GpuField>,
    cube: (f32, f32),
    learned: Option<(GpuGroup, Activation)>,
    occupancy: Option<GpuOccupancyGrid>,
    photographs: GpuPhotographs,
    cameras: GpuCameras,
    corrections: Option<(GpuGroup, bool)>,
    error_map: Option<GpuErrorMap>,
    sums: Buffer,
}

impl GpuTrainer {
    /// Uploads all that training needs; `cameras` as they were given, `cube` the scene's outer cube: lowest corner
    /// and edge.
    pub fn new(gpu: Gpu, of: &Trainees, photographs: GpuPhotographs, cameras: &[PosedCamera], cube: (f32, f32)) -> Self {
        let occupancy = |o: &Occupancy| {
            let thresholds: Vec<f32> = (0..o.bits.cascades).map(|c| o.most(c)).collect();
            GpuOccupancyGrid::upload(&gpu, &o.bits, &o.density, &o.fresh, &o.live, o.decay, &thresholds)
        };
        let cameras = GpuCameras::upload(&gpu, cameras);
        let corrections = of.corrections.map(|(g, focal)| (GpuGroup::upload(&gpu, g), focal));
        corrections.iter().for_each(|(g, focal)| cameras.correct(&gpu, &g.values, *focal));
        GpuTrainer {
            field: GpuField::upload(&gpu, of.field, corrections.is_some()),
            coarse: of.coarse.map(|f| GpuField::upload(&gpu, f, false)),
            cube,
            learned: of.learned.map(|l| (GpuGroup::upload(&gpu, &l.group), l.activation)),
            occupancy: of.occupancy.map(occupancy),
            photographs,
            cameras,
            corrections,
            error_map: of.error_map.map(|m| GpuErrorMap::upload(&gpu, &m.errors, &m.drawn)),
            sums: gpu.zeros(SUMS),
            gpu,
        }
    }

    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// One optimiser step: draw, place samples, encode, evaluate, compare, and back.
    ///
    /// # Panics
    /// When samples go to occupied cells and there is no grid, or to a coarse field that is not there.
    pub fn step(&self, s: &GpuStep) {
        let gpu = &self.gpu;
        let drawn = self.photographs.draw(gpu, s.rays, s.first, &s.pixels, self.error_map.as_ref(), s.backdrop);
        let (origins, dirs) = self.cameras.forward(gpu, &drawn.images, &drawn.pixels);
        let (low, size) = self.cube;
        let near_far = ray_aabb::gpu::intersect(gpu, &origins, &dirs, [low; 3], [low + size; 3], s.near);
        let rays = GpuRays { origins, dirs, near_far, jitter: drawn.jitter.clone(), resumed: false };
        let sky = self.learned.as_ref().map(|(g, activation)| {
            let every_ray = Rows::all(gpu, s.rays);
            let codes = spherical_harmonics::gpu::forward(gpu, 4, &rays.dirs);
            let rgb = linear::gpu::forward(gpu, &every_ray, &sky_layer(*activation), &codes, &g.values, None);
            (every_ray, codes, rgb)
        });
        let background = sky.as_ref().map_or(&drawn.background, |(_, _, rgb)| rgb);
        let target = Target { rgba: &drawn.target, background, left_out: &drawn.left_out, distance: &drawn.distance };
        let moves = self.corrections.is_some();
        let train = |of: &GpuField, packed: &GpuPacked, (points, features), marched: &Buffer<u32>, target, is_main: bool, wants_weights| {
            let figures = loss::Figures { sums: &self.sums, marched, is_main };
            let moves = moves && is_main;
            of.train(gpu, s, &Samples { rays: &rays, packed, points, features, drawn: &drawn, target, figures, wants_weights, moves })
        };

        let (samples, learned) = match s.placing {
            Placing::Occupancy { march: config, limits, room } => {
                // All samples in occupied cells: their densities decide which are trained, and keep the grid up to date.
                let grid = self.occupancy.as_ref().expect("an occupancy grid");
                let marched = march::march(gpu, &grid.bits, &rays, &config, room.0);
                let (points, features) = self.field.encode(gpu, &rays, &marched.packed);
                let all = marched.packed.rows();
                let sigma = self.field.shape.net.density(gpu, &self.field.weights.values, &features, &all);
                let pruned = prune::prune(gpu, &marched.packed, &sigma, limits, &marched.cut, room.1);
                grid.record(gpu, &all, &marched.cells, &sigma);
                let encoded = (pruned.take(gpu, &points, 3), self.field.shape.net.take(gpu, &pruned, &features));
                let left_out = gpu.either(&drawn.left_out, &marched.cut);
                let target = Target { left_out: &left_out, ..target };
                let learned = train(&self.field, &pruned.packed, encoded, &marched.packed.offsets, target, true, false);
                (pruned.packed, learned)
            }
            Placing::Stratified { samples, rng } => {
                let packed = strata::stratified(gpu, &rays.near_far, samples, Some((rng, s.first)));
                let encoded = self.field.encode(gpu, &rays, &packed);
                let learned = train(&self.field, &packed, encoded, &packed.offsets, target, true, false);
                (packed, learned)
            }
            Placing::Hierarchical { samples, more, coarse, fine } => {
                let guide = self.coarse.as_ref().expect("a coarse field");
                let first = strata::stratified(gpu, &rays.near_far, samples, Some((coarse, s.first)));
                let encoded = guide.encode(gpu, &rays, &first);
                let seen = train(guide, &first, encoded, &first.offsets, target, false, true);
                let weights = seen.weights.expect("weights were asked for");
                let packed = strata::refine(gpu, &first, &weights, samples, more, Some((fine, s.first)));
                let encoded = self.field.encode(gpu, &rays, &packed);
                let learned = train(&self.field, &packed, encoded, &packed.offsets, target, true, false);
                (packed, learned)
            }
        };

        let at = (s.t, s.rate_scale);
        if let (Some((group, activation)), Some((every_ray, codes, rgb))) = (&self.learned, &sky) {
            let (layer, d) = (sky_layer(*activation), &learned.background);
            let d = linear::gpu::backward(gpu, every_ray, &layer, codes, &group.values, rgb, d);
            group.step(gpu, at, &d.w);
        }
        if let (Some((group, focal)), Some(d_points)) = (&self.corrections, &learned.points) {
            let (d_origins, d_dirs) = march::positions_backward(gpu, &rays, &samples, d_points, self.field.shape.space);
            let d = self.cameras.backward(gpu, &drawn.images, &drawn.pixels, &rays.dirs, &d_origins, &d_dirs);
            group.step(gpu, at, &d);
            self.cameras.correct(gpu, &group.values, *focal);
        }
        if let Some(map) = &self.error_map {
            map.record(gpu, &self.photographs, &drawn, &learned.errors);
            if s.refresh_errors {
                map.refresh(gpu);
            }
        }
    }

    /// Samples the field at random points of the cells that a camera sees, and decides anew which are occupied.
    pub fn update_occupancy(&self, rng: &Rng, counter: u64, count: usize, block: usize) {
        let (gpu, f) = (&self.gpu, &self.field);
        let Some(grid) = &self.occupancy else { return };
        let (points, cells) = grid.probe(gpu, rng, counter, count, block, f.shape.space);
        let rows = Rows::all(gpu, count);
        let features = f.shape.features(gpu, &rows, &points, f.table());
        let sigma = f.shape.net.density(gpu, &f.weights.values, &features, &rows);
        grid.update(gpu, &cells, &sigma, block);
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

    /// Brings parameters, moments, occupancy and errors back.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn download(&self, to: TraineesMut) -> Result<(), GpuError> {
        let gpu = &self.gpu;
        self.field.download(gpu, to.field)?;
        if let (Some(own), Some(f)) = (&self.coarse, to.coarse) {
            own.download(gpu, f)?;
        }
        if let (Some((own, _)), Some(l)) = (&self.learned, to.learned) {
            own.download(gpu, &mut l.group)?;
        }
        if let (Some((own, _)), Some(g)) = (&self.corrections, to.corrections) {
            own.download(gpu, g)?;
        }
        if let (Some(own), Some(m)) = (&self.error_map, to.error_map) {
            (m.errors, m.drawn) = own.read(gpu)?;
            m.rebuild();
        }
        if let (Some(own), Some(o)) = (&self.occupancy, to.occupancy) {
            (o.density, o.fresh) = own.read(gpu)?;
            o.refresh();
        }
        Ok(())
    }
}
