//! Training steps on the device: parameters, samples and gradients stay in its memory.

use super::place::{self, FieldRef, GpuSamples, PlaceOn};
use super::shape::Shape;
use crate::fields::Field;
use crate::params::{ParamGroup, Schedule};
use crate::step::{Figures, GivenRays, Loss, Probes, RaySource, Scene, Step, Trainees};
use diorama_kernels::gpu::{Buffer, Gpu, GpuError, Rows};
use diorama_kernels::ops::adam::{self, Adam};
use diorama_kernels::ops::composite::gpu::{GpuComposited, GpuPacked};
use diorama_kernels::ops::error_map::gpu::{self as error_map, GpuErrorMap};
use diorama_kernels::ops::field_step::gpu::{self as field, FieldInput};
use diorama_kernels::ops::field_step::{BatchLoss, RayGradients, RayOutputs};
use diorama_kernels::ops::linear::{self, Activation, Dense};
use diorama_kernels::ops::march::gpu::{self as march, GpuRays};
use diorama_kernels::ops::occupancy_update::gpu::GpuOccupancyGrid;
use diorama_kernels::ops::photometric_loss::gpu::{self as loss, SUMS, Target};
use diorama_kernels::ops::pixel_draw::gpu::{Drawn, GpuPhotographs};
use diorama_kernels::ops::ray_generation::gpu::GpuCameras;
use diorama_kernels::ops::{ray_aabb, spherical_harmonics};
use std::ops::Range;

/// Terms of the learned background per channel.
const BACKDROP_TERMS: usize = 16;

/// A group of parameters on the device.
struct GpuGroup {
    values: Buffer,
    moment1: Buffer,
    moment2: Buffer,
    adam: Adam,
    schedule: Schedule,
    sparse: bool,
    frozen: bool,
    /// Ranges that are trained; none: all.
    trained: Option<Vec<Range<usize>>>,
}

impl GpuGroup {
    fn upload(gpu: &Gpu, g: &ParamGroup) -> Self {
        GpuGroup {
            values: gpu.upload(&g.values),
            moment1: gpu.upload_or_zeros(&g.moment1),
            moment2: gpu.upload_or_zeros(&g.moment2),
            adam: g.adam,
            schedule: g.schedule,
            sparse: !g.touched.is_empty(),
            frozen: g.frozen,
            trained: g.trained.clone(),
        }
    }

    fn download(&self, gpu: &Gpu, g: &mut ParamGroup) -> Result<(), GpuError> {
        g.values = gpu.read(&self.values)?;
        g.moment1 = gpu.read(&self.moment1)?;
        g.moment2 = gpu.read(&self.moment2)?;
        Ok(())
    }

    /// One optimizer step along `grads`, which are cleared.
    fn step(&self, gpu: &Gpu, s: &Step, grads: &Buffer) {
        if self.frozen {
            return;
        }
        let (t, scale) = (s.number as u32 + 1, self.schedule.scale(s.progress) * s.rate_scale);
        let a = Adam { rate: self.adam.rate * scale, ..self.adam };
        let all = std::iter::once(0..self.values.len()).collect();
        for range in self.trained.as_ref().unwrap_or(&all) {
            adam::gpu::step(gpu, &a, (t, self.sparse), range.clone(), &self.values, [&self.moment1, &self.moment2], grads);
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

/// What is computed for one field's samples.
struct Pass<'a> {
    left_out: &'a Buffer<u32>,
    /// Whether the step's loss and errors are those of these samples.
    is_main: bool,
    wants_weights: bool,
    /// Whether gradients of positions are wanted.
    moves: bool,
}

/// Rays of a step with their targets, backgrounds and codes.
struct Rays {
    rays: GpuRays,
    drawn: Drawn,
    /// `[R, C]`
    background: Buffer,
    /// Given codes, `[R, width]` each.
    codes: Vec<Buffer>,
}

/// Results of a training pass besides updated parameters.
struct Learned {
    /// Squared error of each ray; none: not compared with photographs.
    errors: Option<Buffer>,
    background: Buffer,
    weights: Option<Buffer>,
    points: Option<Buffer>,
    /// Gradients of the given codes.
    codes: Vec<Buffer>,
    /// Value of a [`BatchLoss`].
    loss: Option<f64>,
}

/// Device, step and the sums that steps add to.
#[derive(Clone, Copy)]
struct Executor<'a> {
    gpu: &'a Gpu,
    step: &'a Step<'a>,
    /// Sums of losses, errors and counts, kept on the device.
    sums: &'a Buffer,
}

impl GpuField {
    fn upload(gpu: &Gpu, field: &Field, moves: bool) -> Self {
        field.check_freezing();
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

    fn read(&self) -> FieldRef<'_> {
        FieldRef { shape: &self.shape, table: self.table(), weights: &self.weights.values }
    }

    /// Evaluates samples, compares them, and steps along the gradients.
    ///
    /// # Errors
    /// When the device was lost while a [`BatchLoss`] waited for it.
    fn train(&self, at: &Executor, r: &Rays, on: &GpuSamples, pass: &Pass) -> Result<Learned, GpuError> {
        let &Executor { gpu, step: s, sums } = at;
        let (net, weights, packed) = (&self.shape.net, &self.weights.values, &on.packed);
        let direction = self.shape.direction(gpu, &r.rays.dirs);
        let appearance = self.appearance.as_ref().map(|(g, dims)| field::look_up(gpu, &g.values, &r.drawn.images, *dims));
        let codes: Vec<&Buffer> = direction.iter().chain(&appearance).chain(&r.codes).collect();
        let background = &r.background;
        let waves = self.shape.waves(gpu, &on.points);
        let input = FieldInput { packed, features: &on.features, codes: &codes, beside: waves.as_ref() };
        let (g, errors, composited, loss) = match s.loss {
            Loss::Batch(loss) => {
                let step = net.forward(gpu, weights, &input, background, true);
                let (d, value) = evaluate_batch_loss(gpu, loss, &step.out, net.net.channels(), packed)?;
                let g = net.backward(gpu, weights, &step, &d, s.near_scaling);
                (g, None, Some(step.out.weights), Some(value))
            }
            Loss::Photometric(terms) => {
                assert_eq!(net.net.channels(), 3, "a photometric loss compares colors alone");
                let terms = (terms, self.shape.measure);
                let (rgba, distance) = (&r.drawn.target, &r.drawn.distance);
                let target = Target { rgba, background, left_out: pass.left_out, distance };
                let cut = on.march.as_ref().map_or_else(|| gpu.zeros(packed.rays()), |m| m.cut.clone());
                let figures = loss::Figures { sums, marched: &on.marched, cut: &cut, is_main: pass.is_main };
                if !pass.wants_weights {
                    let out = net.evaluate(gpu, weights, &input, true);
                    let (d, errors) =
                        loss::composite_and_loss(gpu, terms, packed, (&out.sigma, &out.outputs), target, s.near_scaling, figures);
                    (net.gradients(gpu, weights, &out, &d), Some(errors), None, None)
                } else {
                    let step = net.forward(gpu, weights, &input, background, true);
                    let (d, errors) = loss::loss(gpu, terms, packed, &step.out, target, figures);
                    let g = net.backward(gpu, weights, &step, &d, s.near_scaling);
                    (g, Some(errors), Some(step.out.weights), None)
                }
            }
        };
        let points = match (&g.features, pass.moves) {
            (Some(d), true) => Some(self.shape.points_backward(gpu, &packed.rows(), &on.points, self.table(), d)),
            _ => None,
        };
        if let (Some(points), Some(d)) = (&points, &g.beside) {
            self.shape.waves_backward(gpu, &packed.rows(), &on.points, d, points);
        }
        self.weights.step(gpu, s, &g.params);
        if let (Some((table, d_table)), Some(d)) = (&self.table, &g.features)
            && !table.frozen
        {
            self.shape.table_backward(gpu, &packed.rows(), &on.points, d, d_table);
            table.step(gpu, s, d_table);
        }
        let own = codes.len() - r.codes.len();
        let mut d_codes = g.codes;
        let d_given = d_codes.split_off(own.min(d_codes.len())).into_iter().flatten().collect();
        if let (Some((group, dims)), Some(Some(d_codes))) = (self.appearance.as_ref().filter(|a| !a.0.frozen), d_codes.last()) {
            let d = gpu.zeros(group.values.len());
            field::look_up_backward(gpu, d_codes, &r.drawn.images, *dims, &d);
            group.step(gpu, s, &d);
        }
        Ok(Learned { errors, background: g.background, weights: composited, points, codes: d_given, loss })
    }
}

/// Gradients of a batch loss for the composited outputs, and its value.
fn evaluate_batch_loss(
    gpu: &Gpu,
    loss: &dyn BatchLoss,
    out: &GpuComposited,
    channels: usize,
    packed: &GpuPacked,
) -> Result<(GpuComposited, f64), GpuError> {
    assert_eq!(loss.distortion(), 0.0, "the distortion of a batch loss is computed on the CPU alone");
    let (values, opacity, depth) = (gpu.read(&out.color)?, gpu.read(&out.opacity)?, gpu.read(&out.depth)?);
    let mut g = RayGradients::default();
    g.clear(packed.rays(), channels);
    let value = loss.batch(&RayOutputs { values: &values, opacity: &opacity, depth: &depth }, &mut g);
    let d = GpuComposited {
        color: gpu.upload(&g.values),
        depth: gpu.upload(&g.depth),
        opacity: gpu.upload(&g.opacity),
        weights: gpu.zeros(packed.t.len()),
    };
    Ok((d, value))
}

/// Carries out [`Step`]s on a GPU; keeps parameters, photographs and buffers there.
pub struct GpuTrainer {
    gpu: Gpu,
    field: GpuField,
    coarse: Option<GpuField>,
    scene: Scene,
    learned: Option<(GpuGroup, Activation)>,
    occupancy: Option<GpuOccupancyGrid>,
    photographs: Option<GpuPhotographs>,
    cameras: GpuCameras,
    corrections: Option<(GpuGroup, bool)>,
    error_map: Option<GpuErrorMap>,
    /// Sums of steps that are compared on the device.
    sums: Buffer,
    /// Rays, and sums of steps whose loss is computed on the CPU.
    on_host: Figures,
    d_given: Vec<Buffer>,
}

impl GpuTrainer {
    /// Uploads parameters, grid, photographs and cameras.
    ///
    /// # Panics
    /// When a field composites normals.
    pub fn new(gpu: Gpu, scene: Scene, of: &Trainees, photographs: Option<GpuPhotographs>) -> Self {
        assert!(!of.composites_normals(), "a device composites no normals of a field; train on the CPU");
        let cameras = GpuCameras::upload(&gpu, &scene.cameras);
        let error_map = of.error_map.as_ref().zip(photographs.as_ref()).map(|(m, p)| GpuErrorMap::upload(&gpu, m, p.sizes()));
        let corrections = of.corrections.as_ref().map(|(g, focal)| (GpuGroup::upload(&gpu, g), *focal));
        corrections.iter().for_each(|(g, focal)| cameras.correct(&gpu, &g.values, *focal));
        GpuTrainer {
            field: GpuField::upload(&gpu, of.field, corrections.is_some()),
            coarse: of.coarse.as_ref().map(|f| GpuField::upload(&gpu, f, false)),
            scene,
            learned: of.learned.as_ref().map(|l| (GpuGroup::upload(&gpu, &l.group), l.activation)),
            occupancy: of.occupancy.as_deref().map(|o| GpuOccupancyGrid::upload(&gpu, &o.grid)),
            photographs,
            cameras,
            corrections,
            error_map,
            sums: gpu.zeros(SUMS),
            on_host: Figures::default(),
            d_given: Vec::new(),
            gpu,
        }
    }

    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// One optimiser step: draw, place samples, encode, evaluate, compare, and back. Nothing waits for the device but a [`BatchLoss`].
    ///
    /// # Errors
    /// When the device was lost while a [`BatchLoss`] waited for it.
    ///
    /// # Panics
    /// When samples go to occupied cells and there is no grid, to a coarse field that is not there, or rays to photographs that are not
    /// there.
    pub fn step(&mut self, s: &Step) -> Result<(), GpuError> {
        if let Some(probes) = &s.probes {
            self.update_occupancy(probes, s.number);
        }
        let mut rays = self.rays(s);
        let gpu = &self.gpu;
        let backdrop = self.learned.as_ref().map(|(g, activation)| {
            let all_rays = Rows::all(gpu, s.rays.count());
            let codes = spherical_harmonics::gpu::forward(gpu, 4, &rays.rays.dirs);
            let rgb = linear::gpu::forward(gpu, &all_rays, &Dense::without_bias(BACKDROP_TERMS, 3, *activation), &codes, &g.values, None);
            (all_rays, codes, rgb)
        });
        if let Some((_, _, rgb)) = &backdrop {
            rays.background = rgb.clone();
        }
        let (samples, marched, learned) = self.place(s, &rays)?;
        if let Some(loss) = learned.loss {
            let last = |offsets: &Buffer<u32>| gpu.read(offsets).map(|o| o.last().copied().unwrap_or(0) as f64);
            let (trained, marched) = (last(&samples.offsets)?, last(&marched)?);
            let f = &mut self.on_host;
            (f.steps, f.loss, f.trained, f.marched) = (f.steps + 1, f.loss + loss, f.trained + trained, f.marched + marched);
            // A batch loss counts rays that were cut.
            f.whole += s.rays.count() as u64;
        }
        self.on_host.rays += s.rays.count() as u64;
        if let (Some((group, activation)), Some((all_rays, codes, rgb))) = (self.learned.as_ref().filter(|l| !l.0.frozen), &backdrop) {
            let layer = Dense::without_bias(BACKDROP_TERMS, 3, *activation);
            let d = linear::gpu::backward(gpu, all_rays, &layer, codes, &group.values, rgb, &learned.background);
            group.step(gpu, s, &d.w);
        }
        if let (Some((group, focal)), Some(d_points)) = (&self.corrections, &learned.points) {
            let (d_origins, d_dirs) = march::positions_backward(gpu, &rays.rays, &samples, d_points, self.field.shape.space);
            let d = self.cameras.backward(gpu, &rays.drawn.images, &rays.drawn.pixels, &rays.rays.dirs, &d_origins, &d_dirs);
            group.step(gpu, s, &d);
            self.cameras.correct(gpu, &group.values, *focal);
        }
        let drawn_from = self.photographs.as_ref().filter(|_| s.rays.is_of_cameras());
        if let (Some(map), Some(errors), Some(_)) = (&self.error_map, &learned.errors, drawn_from) {
            let Drawn { images, pixels, left_out, .. } = &rays.drawn;
            map.record(gpu, error_map::Rays { images, pixels, left_out }, errors);
            if s.refresh_errors {
                map.refresh(gpu);
            }
        }
        self.d_given = learned.codes;
        Ok(())
    }

    /// Gradients of the last step's given codes, `[R, width]` each.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn given_gradients(&self) -> Result<Vec<Vec<f32>>, GpuError> {
        self.d_given.iter().map(|d| self.gpu.read(d)).collect()
    }

    /// Draws the step's rays, or uploads the caller's.
    fn rays(&self, s: &Step) -> Rays {
        let gpu = &self.gpu;
        let (drawn, origins, dirs, background, codes) = match &s.rays {
            RaySource::Photographs { count, rng } => {
                let from = self.photographs.as_ref().expect("photographs to draw from");
                let drawn = from.draw(gpu, *count, s.first, rng, self.error_map.as_ref(), s.backdrop);
                let (origins, dirs) = self.cameras.forward(gpu, &drawn.images, &drawn.pixels);
                let background = drawn.background.clone();
                (drawn, origins, dirs, background, Vec::new())
            }
            RaySource::Given(g) => {
                let codes = g.codes.iter().map(|c| gpu.upload(c)).collect();
                (given(gpu, g), gpu.upload(g.origins), gpu.upload(g.dirs), gpu.upload(g.background), codes)
            }
        };
        let (low, size) = self.scene.cube;
        let near_far = match &s.rays {
            RaySource::Given(g) if !g.far.is_empty() => {
                let mut near_far = vec![0.0; 2 * g.images.len()];
                g.extents(self.scene.cube, self.scene.near, &mut near_far);
                gpu.upload(&near_far)
            }
            _ => ray_aabb::gpu::intersect(gpu, &origins, &dirs, [low; 3], [low + size; 3], self.scene.near),
        };
        let rays = GpuRays { origins, dirs, near_far, jitter: drawn.jitter.clone(), resumed: false };
        Rays { rays, drawn, background, codes }
    }

    /// Places samples and trains on them; the samples, the offsets of all that were marched, and what was learned.
    fn place(&self, s: &Step, r: &Rays) -> Result<(GpuPacked, Buffer<u32>, Learned), GpuError> {
        let at = Executor { gpu: &self.gpu, step: s, sums: &self.sums };
        let grid = self.occupancy.as_ref();
        let on = PlaceOn { field: self.field.read(), grid: grid.map(|g| &g.bits), rays: &r.rays, first: s.first, room: s.room };
        let mut coarse_loss = None;
        let mut train_coarse = |packed: &GpuPacked| {
            let field = self.coarse.as_ref().expect("a coarse field");
            let (points, features) = field.read().encode(at.gpu, &r.rays, packed);
            let on = GpuSamples { packed: packed.clone(), points, features, marched: packed.offsets.clone(), march: None };
            let pass = Pass { left_out: &r.drawn.left_out, is_main: false, wants_weights: true, moves: false };
            let learned = field.train(&at, r, &on, &pass)?;
            coarse_loss = learned.loss;
            Ok(learned.weights.expect("weights were asked for"))
        };
        let samples = place::place(at.gpu, &s.placement, &on, &mut train_coarse)?;
        let left_out = match (&samples.march, grid) {
            (Some(m), Some(grid)) => {
                m.waves.iter().for_each(|w| grid.record(at.gpu, &w.rows, &w.cells, &w.sigma));
                at.gpu.either(&r.drawn.left_out, &m.cut)
            }
            _ => r.drawn.left_out.clone(),
        };
        let moves = self.corrections.as_ref().is_some_and(|(group, _)| !group.frozen) && s.rays.is_of_cameras();
        let mut learned = self.field.train(&at, r, &samples, &Pass { left_out: &left_out, is_main: true, wants_weights: false, moves })?;
        learned.loss = learned.loss.map(|l| l + coarse_loss.unwrap_or(0.0));
        Ok((samples.packed, samples.marched, learned))
    }

    /// Samples the field at random points of the cells that a camera sees, and decides anew which are occupied.
    fn update_occupancy(&self, p: &Probes, counter: u64) {
        let (gpu, f) = (&self.gpu, &self.field);
        let Some(grid) = &self.occupancy else { return };
        let (points, cells) = grid.probe(gpu, &p.rng, counter, p.points, p.block, f.shape.space);
        let rows = Rows::all(gpu, p.points);
        let features = f.shape.features(gpu, &rows, &points, f.table());
        let sigma = f.shape.net.density(gpu, &f.weights.values, &features, &rows);
        grid.update(gpu, &cells, &sigma, p.block);
    }

    /// Waits for the device; means since the last call.
    ///
    /// # Errors
    /// When the device was lost or is full.
    pub fn figures(&mut self) -> Result<Figures, GpuError> {
        let sums = std::mem::replace(&mut self.sums, self.gpu.zeros(SUMS));
        let sums: Vec<f64> = self.gpu.read(&sums)?.iter().map(|v| *v as f64).collect();
        let other = std::mem::take(&mut self.on_host);
        let steps = sums[5] as u64 + other.steps;
        Ok(Figures {
            steps,
            rays: other.rays,
            whole: sums[4] as u64 + other.whole,
            loss: (sums[0] + other.loss) / steps.max(1) as f64,
            mse: if sums[5] > 0.0 { sums[1] / sums[5] } else { f64::NAN },
            trained: sums[2] + other.trained,
            marched: sums[3] + other.marched,
        })
    }

    /// Brings parameters, moments, occupancy and errors back.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn download(&self, to: &mut Trainees) -> Result<(), GpuError> {
        let gpu = &self.gpu;
        self.field.download(gpu, to.field)?;
        if let (Some(own), Some(f)) = (&self.coarse, &mut to.coarse) {
            own.download(gpu, f)?;
        }
        if let (Some((own, _)), Some(l)) = (&self.learned, &mut to.learned) {
            own.download(gpu, &mut l.group)?;
        }
        if let (Some((own, _)), Some((g, _))) = (&self.corrections, &mut to.corrections) {
            own.download(gpu, g)?;
        }
        if let (Some(own), Some(m)) = (&self.error_map, &mut to.error_map) {
            (m.errors, m.drawn) = own.read(gpu)?;
            m.rebuild();
        }
        if let (Some(own), Some(o)) = (&self.occupancy, &mut to.occupancy) {
            (o.grid.density, o.grid.fresh) = own.read(gpu)?;
            o.grid.refresh();
        }
        Ok(())
    }
}

/// Rays of the caller, in the form of drawn ones.
fn given(gpu: &Gpu, g: &GivenRays) -> Drawn {
    let n = g.images.len();
    Drawn {
        images: gpu.upload(g.images),
        pixels: gpu.zeros(n * 2),
        target: if g.target.is_empty() { gpu.zeros(n * 4) } else { gpu.upload(g.target) },
        jitter: gpu.upload(g.jitter),
        left_out: gpu.zeros(n),
        distance: gpu.zeros(n),
        background: gpu.zeros(0),
    }
}
