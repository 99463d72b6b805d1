//! The scene model as printed (Rudnev et al. 2022): `C = S · A ⊙ max(0, Lᵀ b(N))^(1/2.2)` with sRGB albedo `A`, learned at once with the density
//! from whose gradient the normal `N = v / √(|v|² + ε²)`, `v = −Σ w ∇σ`, comes (printed without `ε`: there, empty space has normals of noise), by a coarse and a fine network with a table of light each. What lies around the sphere of the
//! cameras is a color of an inverted sphere (Zhang et al. 2020), which no light changes.

mod loss;
mod pictures;

pub use loss::{JointGradients, JointLoss};
pub use pictures::color;

use super::config::Config;
use super::fields::{self, first_lights};
use diorama_engine::fields::{Encoder, Field, InvertedSphere, Sphere};
use diorama_engine::params::ParamGroup;
use diorama_engine::samplers::placement::Placement;
use diorama_kernels::ops::frequency::Frequency;
use diorama_kernels::ops::ray_generation::PosedCamera;

/// Streams of initial values.
const COARSE: u64 = 20;
const FINE: u64 = 21;
const OUTER: u64 = 22;
/// Bands of the encoding at first, and steps until all are read.
const FIRST_BANDS: f32 = 8.0;
const BANDS_UNTIL: f32 = 30_000.0;
/// Distance of the sphere beyond the farthest camera.
const MARGIN: f64 = 1.1;

/// What the model has besides its fine network and its lights.
pub struct Joint {
    pub coarse: Field,
    /// `[lights, 9, 3]`
    pub coarse_lights: ParamGroup,
    /// Around the sphere, of the coarse and the fine network; empty without a background.
    pub backgrounds: Vec<InvertedSphere>,
    pub sphere: Sphere,
}

/// The least sphere around the middle of the scene that holds all cameras.
pub fn sphere(cameras: &[PosedCamera]) -> Sphere {
    let farthest = cameras.iter().map(|c| (c.pose.translation - 0.5).length()).fold(0.0, f64::max);
    Sphere { center: [0.5; 3], radius: (MARGIN * farthest).max(0.5) as f32 }
}

/// Table of as many lights, `[lights, 9, 3]`.
pub fn joint_lights(config: &Config, lights: usize) -> ParamGroup {
    fields::joint_group(config, "lights", first_lights(lights), config.optim.light_rate)
}

/// The fine network of a sphere.
pub fn fine(config: &Config, sphere: &Sphere) -> Field {
    fields::of_all(config, 2.0 * sphere.radius, FINE)
}

impl Joint {
    /// Untrained networks of `lights` lights.
    pub fn new(config: &Config, sphere: Sphere, lights: usize) -> Joint {
        let (f, adam) = (&config.field, fields::joint_adam(config.optim.net_rate));
        let background = |i: u64| {
            let mut b = InvertedSphere::new(sphere, f.bands, f.width, adam, config.seed, OUTER + i);
            b.weights.schedule = fields::joint_schedule(config);
            b
        };
        Joint {
            coarse: fields::of_all(config, 2.0 * sphere.radius, COARSE),
            coarse_lights: joint_lights(config, lights),
            backgrounds: if config.field.background { (0..2).map(background).collect() } else { Vec::new() },
            sphere,
        }
    }

    /// Lets the networks read as many bands as after `step` steps.
    pub fn anneal(&mut self, fine: &mut Field, step: u64) {
        for field in [&mut self.coarse, fine] {
            if let Encoder::Frequency(f) = &mut field.encoder {
                *f = admitted(*f, step);
            }
        }
        self.backgrounds.iter_mut().for_each(|b| b.encoding = admitted(b.encoding, step));
    }

    /// Placement of samples in pictures.
    pub fn placement(config: &Config) -> Placement {
        Placement::Hierarchical { samples: config.sampling.coarse, more: config.sampling.fine, noise: None }
    }

    /// A copy that renders: without gradients and moments.
    pub fn for_rendering(&self) -> Joint {
        Joint {
            coarse: self.coarse.for_rendering(),
            coarse_lights: self.coarse_lights.values_only(),
            backgrounds: self.backgrounds.iter().map(InvertedSphere::for_rendering).collect(),
            sphere: self.sphere,
        }
    }
}

/// An encoding with the bands that are admitted after `step` steps.
fn admitted(f: Frequency, step: u64) -> Frequency {
    let all = f.bands as f32;
    let first = FIRST_BANDS.min(all);
    Frequency { window: Some(first + (all - first) * (step as f32 / BANDS_UNTIL).min(1.0)), ..f }
}
