//! Light that reaches a camera from triangles with materials under distant light: an unbiased path tracer.
//!
//! Kajiya 1986, "The Rendering Equation"; light and surface are both drawn from and weighted by the power heuristic (Veach 1997), paths
//! end by Russian roulette. A pixel's value after `n` samples depends on seed, pixel and `n` alone, so a picture can be
//! refined in passes and continued after an interruption.

pub mod bsdf;
#[cfg(any(test, feature = "gpu"))]
pub(crate) mod cases;
pub mod cpu;
mod geometry;
#[cfg(feature = "gpu")]
pub mod gpu;
mod light;
pub mod reference;
mod sampler;
mod surface;
#[cfg(test)]
mod tests;
mod tracer;
mod vector;
mod wave;

use diorama_geom::daylight::Daylight;
use diorama_geom::glam::DVec3;
use diorama_geom::{Camera, Image, Model, Pose};
use geometry::{Found, Geometry, Point};
use light::DistantLight;
use surface::{Surface, Surfaces};

/// What is rendered: surfaces and the light on them.
#[derive(Clone, Debug)]
pub struct Scene {
    geometry: Geometry,
    surfaces: Surfaces,
    light: DistantLight,
    /// Whether an instance is a part of a photograph's scene: [`Pixel::backdrop`].
    is_backdrop: Vec<bool>,
}

impl Scene {
    /// # Panics
    /// When the model refers to parts, materials, textures or vertices that do not exist.
    pub fn new(model: &Model, light: &Daylight) -> Scene {
        Scene {
            geometry: Geometry::new(model),
            surfaces: Surfaces::new(model),
            light: DistantLight::new(light),
            is_backdrop: vec![false; model.instances.len()],
        }
    }

    /// Replaces the light.
    pub fn set_light(&mut self, light: &Daylight) {
        self.light = DistantLight::new(light);
    }

    /// Makes the first `instances` of the model the backdrop, whose light is also kept apart.
    pub fn set_backdrop(&mut self, instances: usize) {
        self.is_backdrop.iter_mut().enumerate().for_each(|(i, b)| *b = i < instances);
    }

    /// What a ray found.
    #[inline(always)]
    fn at(&self, found: &Found) -> (Point, Surface) {
        let point = self.geometry.point(found, |material| self.surfaces.needs_tangent(material));
        (point, self.surfaces.at(&point))
    }

    /// Triangles of all instances.
    pub fn triangles(&self) -> usize {
        self.geometry.triangles
    }
}

/// A camera where it stands.
#[derive(Clone, Copy, Debug)]
pub struct View {
    pub camera: Camera,
    pub world_from_camera: Pose,
    /// None: everything is sharp.
    pub lens: Option<ThinLens>,
}

/// A lens that images one plane sharply.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ThinLens {
    /// Radius of the aperture in units of the scene.
    pub radius: f64,
    /// Distance of the sharp plane along the camera's axis.
    pub focus: f64,
}

impl ThinLens {
    /// The aperture of a full-frame camera (36 mm wide) with the field of view of `camera` at an f-number, in a scene of metres.
    pub fn of_f_stop(camera: &Camera, f_stop: f64, focus: f64) -> ThinLens {
        let focal_length = 0.036 * camera.fx / camera.width as f64;
        ThinLens { radius: 0.5 * focal_length / f_stop, focus }
    }
}

/// How paths are traced.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    pub seed: u64,
    /// Surfaces that a path meets at most; 1: direct light alone.
    pub bounces: u32,
    /// Whether the camera sees the light itself where nothing is in front of it; else pixels are black and transparent there.
    pub shows_light: bool,
    /// Whether [`Pixel::direct`], [`Pixel::unshadowed`] and [`Pixel::sun`] are computed; else they are 0.
    pub light_layers: bool,
    pub strategy: Strategy,
}

impl Default for Settings {
    fn default() -> Settings {
        Settings { seed: 0, bounces: 12, shows_light: true, light_layers: false, strategy: Strategy::Both }
    }
}

/// Where directions are drawn from. All have the same mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Strategy {
    /// Light and surface, weighted by the power heuristic.
    Both,
    Light,
    Surface,
}

/// Means over the samples of a pixel. Those of surfaces are of the first that a sample meets, and 0 where it meets none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pixel {
    /// Linear radiance.
    pub color: [f32; 3],
    /// Base color.
    pub albedo: [f32; 3],
    /// Shading normals in the world; their mean is shorter than 1 at edges.
    pub normal: [f32; 3],
    /// Distance along the ray.
    pub depth: f32,
    /// Share of the samples that meet a surface.
    pub opacity: f32,
    /// Luminance of the direct irradiance, divided by π.
    pub direct: f32,
    /// The same as if nothing cast shadows.
    pub unshadowed: f32,
    /// Share of the sun's disc that is visible from the surface.
    pub sun: f32,
    /// The part of the color that comes from samples whose first surface is of the backdrop, and the share of these samples.
    pub backdrop: [f32; 4],
    /// Square of the samples' luminance, for their variance.
    pub square: f32,
}

impl Pixel {
    /// Numbers of a pixel.
    pub const LEN: usize = 19;

    #[inline(always)]
    fn values(&self) -> [f32; Pixel::LEN] {
        let mut v = [0.0; Pixel::LEN];
        v[..3].copy_from_slice(&self.color);
        v[3..6].copy_from_slice(&self.albedo);
        v[6..9].copy_from_slice(&self.normal);
        v[9..14].copy_from_slice(&[self.depth, self.opacity, self.direct, self.unshadowed, self.sun]);
        v[14..18].copy_from_slice(&self.backdrop);
        v[18] = self.square;
        v
    }

    /// Means with the sums of `added` samples, after which there are `samples`.
    #[inline(always)]
    fn add(&mut self, sums: &[f32; Pixel::LEN], added: f32, samples: f32) {
        let (mut mean, share) = (self.values(), added / samples);
        for (mean, sum) in mean.iter_mut().zip(sums) {
            *mean += share * (sum / added - *mean);
        }
        *self = Pixel::of(mean);
    }

    #[inline(always)]
    fn of(v: [f32; Pixel::LEN]) -> Pixel {
        Pixel {
            color: [v[0], v[1], v[2]],
            albedo: [v[3], v[4], v[5]],
            normal: [v[6], v[7], v[8]],
            depth: v[9],
            opacity: v[10],
            direct: v[11],
            unshadowed: v[12],
            sun: v[13],
            backdrop: [v[14], v[15], v[16], v[17]],
            square: v[18],
        }
    }
}

/// A picture so far.
#[derive(Clone, Debug, PartialEq)]
pub struct Film {
    pub width: usize,
    pub height: usize,
    /// Samples of each pixel.
    pub samples: u32,
    /// `[H, W]`
    pub pixels: Vec<Pixel>,
}

impl Film {
    /// No samples yet.
    pub fn new(camera: &Camera) -> Film {
        let (width, height) = (camera.width as usize, camera.height as usize);
        Film { width, height, samples: 0, pixels: vec![Pixel::default(); width * height] }
    }

    /// An image `[H, W, C]` of what `channels` gives for each pixel.
    pub fn image<const C: usize>(&self, channels: impl Fn(&Pixel) -> [f32; C]) -> Image {
        let data = self.pixels.iter().flat_map(&channels).collect();
        Image { width: self.width, height: self.height, channels: C, data }
    }

    /// All means `[H, W, 19]`, for storage.
    pub fn to_image(&self) -> Image {
        self.image(Pixel::values)
    }

    /// The film of stored means.
    ///
    /// # Panics
    /// When the image is not `[H, W, 19]`.
    pub fn of_image(image: &Image, samples: u32) -> Film {
        assert_eq!(image.channels, Pixel::LEN, "a film has {} channels", Pixel::LEN);
        let pixels = image.data.chunks_exact(Pixel::LEN).map(|v| Pixel::of(std::array::from_fn(|i| v[i]))).collect();
        Film { width: image.width, height: image.height, samples, pixels }
    }
}

/// First hit of the ray through a pixel's center.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FirstHit {
    /// Index of the instance in the model.
    pub instance: u32,
    pub position: DVec3,
    /// Distance along the ray.
    pub depth: f64,
}
