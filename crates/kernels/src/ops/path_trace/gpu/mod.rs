//! The CPU's path tracer on a device: the same random numbers, materials and light, in single precision throughout.
//!
//! Paths take each step together, as on the CPU, in four kernels per bounce: rays are followed to surfaces, surfaces emit, ask for light
//! and draw the next direction, and the light that they asked for arrives unless something is in its way. How many paths are on the way
//! at once does not change a picture.

mod angles;
mod bsdf;
mod eye;
mod light;
mod pack;
mod sampler;
mod state;
mod steps;
mod surface;

use super::{Film, Pixel, Scene, Settings, Strategy, View};
use crate::gpu::{Buffer, Gpu, GpuError, launch};
use crate::ops::ray_generation::PosedCamera;
use crate::ops::ray_generation::gpu::{CAMERA, GpuCameras};
use crate::ops::ray_triangles::gpu::Tree;
use diorama_geom::Lens;
use eye::start;
use state::{BatchLaunch, PATH, accumulate};
use steps::{arrive, ask_layers, follow, scatter};

/// Paths in flight: on a hardware GPU, and on a software device.
const PATHS: [usize; 2] = [1 << 21, 1 << 15];

/// A scene on a device.
pub struct GpuScene {
    tree: Buffer<u32>,
    surfaces: Buffer<u32>,
    texels: Buffer<u32>,
    lights: Buffer<u32>,
    /// Trees of all that rays meet, of what light cannot pass, and of what it can pass in places.
    all: Tree,
    solid: Tree,
    porous: Tree,
    is_porous: bool,
    is_textured: bool,
    /// Instances of the backdrop, which are the first.
    backdrop: u32,
}

impl GpuScene {
    /// Copies a scene to a device.
    ///
    /// # Errors
    /// When a part of it does not fit into one piece of the device's memory.
    pub fn upload(gpu: &Gpu, scene: &Scene) -> Result<GpuScene, GpuError> {
        let world = pack::trees(&scene.geometry);
        let (surfaces, texels) = pack::surfaces(&scene.geometry, &scene.surfaces);
        Ok(GpuScene {
            tree: put(gpu, &world.words, "the triangles")?,
            surfaces: put(gpu, &surfaces, "the triangles")?,
            texels: put(gpu, &texels, "the textures")?,
            lights: put(gpu, &pack::light(&scene.light), "the light")?,
            all: world.all,
            solid: world.solid,
            porous: world.porous,
            is_porous: world.porous.root != crate::ops::ray_triangles::binary::NOTHING,
            is_textured: !scene.surfaces.textures.is_empty(),
            backdrop: scene.is_backdrop.iter().filter(|b| **b).count() as u32,
        })
    }

    /// Replaces the light by that of another scene.
    ///
    /// # Errors
    /// When it does not fit into one piece of the device's memory.
    pub fn set_light(&mut self, gpu: &Gpu, scene: &Scene) -> Result<(), GpuError> {
        self.lights = put(gpu, &pack::light(&scene.light), "the light")?;
        Ok(())
    }
}

/// Uploads words, unless they are more than the device takes in one piece.
fn put(gpu: &Gpu, words: &[u32], what: &str) -> Result<Buffer<u32>, GpuError> {
    let (bytes, most) = (4 * words.len() as u64, gpu.largest_buffer());
    if bytes > most {
        return Err(GpuError::Memory(gpu.name.clone(), format!("{what}: {} MB, of {} MB in one piece", bytes >> 20, most >> 20)));
    }
    Ok(gpu.upload(words))
}

/// Adds `samples` samples to each pixel of a film.
///
/// # Errors
/// When the device is lost or full; then the film stays as it was.
///
/// # Panics
/// When film and camera differ in size.
pub fn render(gpu: &Gpu, scene: &GpuScene, view: &View, settings: &Settings, samples: u32, film: &mut Film) -> Result<(), GpuError> {
    let most = gpu.largest_buffer() as usize / (size_of::<u32>() * PATH);
    let paths = PATHS[gpu.software as usize].min(most.max(1));
    render_batches(gpu, scene, view, settings, samples, film, paths)
}

/// [`render`] with so many paths at once.
pub(super) fn render_batches(
    gpu: &Gpu,
    scene: &GpuScene,
    view: &View,
    settings: &Settings,
    samples: u32,
    film: &mut Film,
    paths: usize,
) -> Result<(), GpuError> {
    let (w, h) = (view.camera.width as usize, view.camera.height as usize);
    assert_eq!((w, h), (film.width, film.height), "path_trace: film and camera differ in size");
    if samples == 0 || w * h == 0 {
        return Ok(());
    }
    let chunk = paths.min(w * h);
    let at_once = (paths / chunk).clamp(1, samples as usize);
    let wave = Wave::new(gpu, scene, view, settings, chunk * at_once);
    let mut sums = vec![[0.0f32; Pixel::LEN]; w * h];
    for first in (0..w * h).step_by(chunk) {
        let pixels = chunk.min(w * h - first);
        let sum = gpu.zeros(pixels * Pixel::LEN);
        for sample in (0..samples).step_by(at_once) {
            let n = at_once.min((samples - sample) as usize);
            wave.trace([pixels, n], first, film.samples + sample, &sum);
        }
        let values = gpu.read(&sum)?;
        for (i, sums) in sums[first..first + pixels].iter_mut().enumerate() {
            *sums = std::array::from_fn(|k| values[k * pixels + i]);
        }
    }
    film.samples += samples;
    for (pixel, sums) in film.pixels.iter_mut().zip(&sums) {
        pixel.add(sums, samples as f32, film.samples as f32);
    }
    Ok(())
}

/// Memory of the paths that are on their way.
struct Wave<'a> {
    gpu: &'a Gpu,
    scene: &'a GpuScene,
    settings: &'a Settings,
    view: &'a View,
    camera: GpuCameras,
    paths: Buffer<u32>,
    samples: Buffer,
    queues: [Buffer<u32>; 2],
    /// Paths of each bounce.
    counts: Buffer<u32>,
}

impl<'a> Wave<'a> {
    fn new(gpu: &'a Gpu, scene: &'a GpuScene, view: &'a View, settings: &'a Settings, paths: usize) -> Wave<'a> {
        Wave {
            gpu,
            scene,
            settings,
            view,
            camera: GpuCameras::upload(gpu, &[PosedCamera { camera: view.camera, pose: view.world_from_camera }]),
            paths: gpu.empty(paths * PATH),
            samples: gpu.empty(paths * Pixel::LEN),
            queues: [gpu.empty(paths), gpu.empty(paths)],
            counts: gpu.empty(settings.bounces as usize + 2),
        }
    }

    /// Traces samples from `sample` on of pixels from `first` on, `[pixels, samples]`, and adds them up.
    fn trace(&self, [pixels, samples]: [usize; 2], first: usize, sample: u32, sums: &Buffer) {
        let (gpu, n, bounces) = (self.gpu, pixels * samples, self.settings.bounces);
        let seed = super::sampler::seed_of(self.settings.seed);
        let [radius, focus] = self.view.lens.map_or([0.0, 1.0], |l| [l.radius as f32, l.focus as f32]);
        let batch = || BatchLaunch::new(n as u32, pixels as u32, first as u32, sample, seed);
        launch!(
            gpu,
            start,
            n,
            [
                self.camera.numbers => CAMERA,
                self.paths => n * PATH,
                self.samples => n * Pixel::LEN,
                self.queues[0] => n,
                self.counts => bounces as usize + 2,
            ],
            batch(),
            self.view.camera.width,
            bounces,
            radius,
            focus,
            !matches!(self.view.camera.lens, Lens::Pinhole),
        );
        for bounce in 0..=bounces {
            self.follow(n, batch(), bounce);
            if bounce == 0 && self.settings.light_layers {
                self.ask_layers::<false>(n, batch());
                self.arrive(n, batch(), 0, state::DIRECT);
                self.ask_layers::<true>(n, batch());
                self.arrive(n, batch(), 0, state::SUN);
            }
            self.scatter(n, batch(), bounce);
            if self.settings.strategy != Strategy::Surface {
                self.arrive(n, batch(), bounce, 0);
            }
        }
        launch!(gpu, accumulate, pixels, [self.samples => n * Pixel::LEN, sums => pixels * Pixel::LEN], batch());
    }

    fn queue(&self, bounce: u32) -> &Buffer<u32> {
        &self.queues[bounce as usize % 2]
    }

    fn follow(&self, n: usize, batch: BatchLaunch, bounce: u32) {
        let s = self.scene;
        launch!(
            self.gpu,
            follow,
            n,
            [
                self.queue(bounce) => n,
                self.counts => bounce as usize + 1,
                s.tree => s.tree.len(),
                s.surfaces => s.surfaces.len(),
                s.texels => s.texels.len(),
                self.paths => n * PATH,
            ],
            batch,
            bounce,
            s.all.root,
            s.all.stack,
            s.is_porous,
            s.is_textured,
        );
    }

    fn ask_layers<const SUN: bool>(&self, n: usize, batch: BatchLaunch) {
        let s = self.scene;
        launch!(
            self.gpu,
            ask_layers,
            n,
            [
                s.tree => s.tree.len(),
                s.surfaces => s.surfaces.len(),
                s.texels => s.texels.len(),
                s.lights => s.lights.len(),
                self.paths => n * PATH,
                self.samples => n * Pixel::LEN,
            ],
            batch,
            SUN,
            s.is_textured,
        );
    }

    fn scatter(&self, n: usize, batch: BatchLaunch, bounce: u32) {
        let (s, settings) = (self.scene, self.settings);
        let strategy = match settings.strategy {
            Strategy::Both => steps::BOTH,
            Strategy::Light => steps::LIGHT,
            Strategy::Surface => steps::SURFACE,
        };
        launch!(
            self.gpu,
            scatter,
            n,
            [
                self.queue(bounce) => n,
                self.counts => bounce as usize + 2,
                self.queue(bounce + 1) => n,
                s.tree => s.tree.len(),
                s.surfaces => s.surfaces.len(),
                s.texels => s.texels.len(),
                s.lights => s.lights.len(),
                self.paths => n * PATH,
                self.samples => n * Pixel::LEN,
            ],
            batch,
            bounce,
            settings.bounces,
            strategy,
            settings.shows_light as u32,
            s.backdrop,
            s.is_textured,
        );
    }

    fn arrive(&self, n: usize, batch: BatchLaunch, bounce: u32, field: u32) {
        let s = self.scene;
        launch!(
            self.gpu,
            arrive,
            n,
            [
                self.queue(bounce) => n,
                self.counts => bounce as usize + 1,
                s.tree => s.tree.len(),
                s.surfaces => s.surfaces.len(),
                s.texels => s.texels.len(),
                self.paths => n * PATH,
                self.samples => n * Pixel::LEN,
            ],
            batch,
            bounce,
            field,
            s.solid.root,
            s.porous.root,
            s.all.stack,
            s.is_porous,
            s.is_textured,
        );
    }
}
