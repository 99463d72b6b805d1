//! The engine: radiance fields and everything that trains and renders them, on the CPU and on GPUs. It knows no application and opens no
//! file.
//!
//! - [`fields`]: a [`fields::Field`] is an encoder of positions, codes of rays, and a network with any outputs.
//! - [`step`]: a [`step::Step`] describes a training step: source of rays, placement of samples, loss and rates. [`step::CpuTrainer`] carries
//!   it out, `on_gpu::GpuTrainer` on a device.
//! - [`samplers`]: pixels, the occupancy grid, and [`samplers::placement::Placement`] of samples, for training and rendering alike.
//! - [`metrics`]: MSE, PSNR, SSIM and LPIPS. Losses are ops of `diorama-kernels`: `photometric_loss`, or a `BatchLoss` of one's own.
//! - [`params`]: groups of parameters, each with a rate, decay and schedule of its own, and sets of them.
//! - [`renderers`]: [`renderers::volume::Tracer`] renders views of a field.
//! - [`mod@train`]: the loop of a run, its events, and figures by name.
//!
//! A field learns the color of two rays:
//!
//! ```
//! use diorama_engine::fields;
//! use diorama_engine::samplers::placement::Placement;
//! use diorama_engine::step::{CpuTrainer, GivenRays, Loss, RaySource, Scene, Step, Trainees};
//! use diorama_geom::contraction::Space;
//! use diorama_kernels::ops::photometric_loss::{ColorLoss, Terms};
//!
//! // In the cube [0, 1]³.
//! let mut field = fields::baseline(Space::Cube(1.0), 1e-2, 1);
//! let mut of = Trainees::of(&mut field);
//! let mut trainer = CpuTrainer::new(Scene { cameras: Vec::new(), near: 0.0, cube: (0.0, 1.0) }, &of);
//! let red = [1.0, 0.0, 0.0, 1.0].repeat(2);
//! let rays = GivenRays {
//!     images: &[0; 2],
//!     origins: &[-1.0, 0.4, 0.5, -1.0, 0.6, 0.5],
//!     dirs: &[1.0, 0.0, 0.0, 1.0, 0.0, 0.0],
//!     far: &[],
//!     jitter: &[0.5; 2],
//!     target: &red,
//!     background: &[0.0; 6],
//!     codes: &[],
//! };
//! let placement = Placement::Stratified { samples: 16, noise: None };
//! let loss = Loss::Photometric(Terms { color: ColorLoss::Mse, distortion: 0.0, depth: 0.0, alpha: 0.0 });
//! let mut train = |number| trainer.step(&mut of, None, &Step::new(number, 2 * number, RaySource::Given(rays), placement, loss)).loss;
//! let first = train(0);
//! let last = (1..40).map(train).last().unwrap();
//! assert!(last < 0.5 * first, "{first} {last}");
//! ```

pub mod background;
pub mod fields;
pub mod metrics;
#[cfg(feature = "gpu")]
pub mod on_gpu;
pub mod params;
pub mod renderers;
pub mod samplers;
pub mod stages;
pub mod step;
pub mod train;
