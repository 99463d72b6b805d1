//! Views of the scene model under any light, and its layers.

use super::config::Stage;
use super::joint;
use super::model::SceneModel;
use super::shading::{self, NORMAL, RayColor, SUNLIT_CHANNELS};
use super::sun::{SUN, gray};
use super::sunlit::{LEFT, passing, sun_code, sunlit};
use super::visibility::Ambient;
use crate::error::Result;
use crate::run::memory;
use diorama_engine::renderers::layers::Layers;
use diorama_engine::renderers::volume::{Quality, Tracer};
use diorama_geom::Image;
use diorama_geom::color::{linear_from_srgb, srgb_from_linear};
use diorama_geom::daylight::Daylight;
use diorama_geom::environment::Environment;
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::sh_light::ShLight;
use diorama_kernels::ops::ray_generation::{self, PosedCamera};
use rayon::prelude::*;
use std::sync::OnceLock;

/// Radiance over the mean of a map from which on it casts shadows, and lamps at most by which it does.
const GLARING: f64 = 4.0;
const LAMPS: usize = 64;

/// Directions in which a ray's surface looks for sky and other surfaces.
const LOOKS: usize = 32;
/// Bytes of a ray of a view, while it is lit.
const RAY: u64 = 200;

/// Light in which views are shown: spherical harmonics, and the sky behind.
pub struct ViewLight {
    pub light: ShLight,
    /// `[16, 3]`
    pub sky: Vec<f32>,
    /// A sun apart, whose light the harmonics then lack: direction, power.
    pub sun: Option<[f32; SUN]>,
    /// Whether it is one of those of training, of which the field says itself where the sun arrives.
    is_learned: bool,
    /// More of them, from what is bright in a map: their shadows together are soft.
    lamps: Vec<f32>,
    /// The sky behind as a map, to which `sky` is added.
    behind: Option<Environment>,
    /// What of sky and surfaces reaches places in this light; found with the first view.
    ambient: OnceLock<Ambient>,
}

impl ViewLight {
    /// A light with an even sky of the radiance that comes from above.
    pub fn of(light: ShLight) -> ViewLight {
        let above = light.shade(DVec3::Z);
        let sky = (0..shading::SKY).map(|i| if i < 3 { above[i].max(0.0) as f32 / 0.282_094_8 } else { 0.0 }).collect();
        ViewLight { light, sky, sun: None, is_learned: false, lamps: Vec::new(), behind: None, ambient: OnceLock::new() }
    }

    /// Harmonics, and a sun (direction and irradiance) besides, as a model takes them: apart, if it tells suns apart.
    pub fn new(model: &SceneModel, mut light: ShLight, sun: Option<(DVec3, [f64; 3])>) -> ViewLight {
        if !model.has_suns() {
            sun.iter().for_each(|(direction, irradiance)| light.add_sun(*direction, *irradiance));
            return ViewLight::of(light);
        }
        let mut out = ViewLight::of(light);
        let (direction, irradiance) = sun.unwrap_or((DVec3::Z, [0.0; 3]));
        let mut numbers = [0.0; SUN];
        numbers[..3].copy_from_slice(&direction.as_vec3().to_array());
        (0..3).for_each(|k| numbers[3 + k] = (irradiance[k] / std::f64::consts::PI) as f32);
        out.sun = Some(numbers);
        out
    }

    /// A map and its sun, times a factor per channel, as a model takes them: if it tells suns apart, what is bright in the map casts shadows.
    pub fn of_daylight(model: &SceneModel, light: &Daylight, by: [f64; 3]) -> ViewLight {
        let (map, lamps) =
            if model.has_suns() { light.environment.with_lamps(GLARING, LAMPS) } else { (light.environment.clone(), Vec::new()) };
        let scaled = |c: [f64; 3]| std::array::from_fn(|k| c[k] * by[k]);
        let sun = light.sun.map(|s| (s.direction, scaled(s.irradiance)));
        let mut out = ViewLight::new(model, ShLight(ShLight::of(&map).0.map(scaled)), sun);
        out.sky.fill(0.0);
        out.behind = Some(light.environment.clone());
        for (direction, irradiance) in lamps {
            out.lamps.extend(direction.as_vec3().to_array());
            out.lamps.extend(scaled(irradiance).map(|v: f64| (v / std::f64::consts::PI) as f32));
        }
        out
    }

    /// Sun and lamps, `[N, 6]`; none where suns are not apart.
    fn suns(&self) -> Option<Vec<f32>> {
        self.sun.map(|sun| sun.into_iter().chain(self.lamps.iter().copied()).collect())
    }

    /// The same for each of the `side`² rays of a pixel: of the lamps, a part that is as much brighter.
    fn shares(&self, side: usize) -> Vec<Vec<f32>> {
        let Some(sun) = self.sun else { return Vec::new() };
        let parts = side * side;
        let brighter = |(i, v): (usize, &f32)| if i < 3 { *v } else { *v * parts as f32 };
        let of_ray = |own: usize| {
            let lamps = self.lamps.chunks_exact(SUN).skip(own).step_by(parts);
            sun.into_iter().chain(lamps.flat_map(|l| l.iter().enumerate().map(brighter))).collect()
        };
        (0..parts).map(of_ray).collect()
    }

    /// The light that a model learned.
    pub fn learned(model: &SceneModel, index: usize) -> ViewLight {
        ViewLight {
            light: model.light(index),
            sky: model.sky(index).to_vec(),
            sun: model.sun(index),
            is_learned: true,
            lamps: Vec::new(),
            behind: None,
            ambient: OnceLock::new(),
        }
    }

    /// Radiance of the map behind in a direction; black without one.
    fn map_toward(&self, dir: &[f32]) -> [f32; 3] {
        let radiance = |map: &Environment| map.radiance(Vec3::from_slice(dir).as_dvec3()).map(|v| v as f32);
        self.behind.as_ref().map_or([0.0; 3], radiance)
    }

    /// What shadows read of it: the second only where suns are apart.
    fn codes(&self) -> [[f32; 9]; 2] {
        match self.sun {
            Some(sun) => [sun_code(&sun), if self.is_learned { sun_code(&sun) } else { [0.0; 9] }],
            None => [std::array::from_fn(|i| gray(&self.light.0[i].map(|v| v as f32))), [0.0; 9]],
        }
    }

    fn numbers(&self) -> Vec<f32> {
        self.light.0.iter().flatten().map(|v| *v as f32).collect()
    }
}

/// Layers of a view; images are `[H, W, 3]` or `[H, W, 1]`.
pub struct SceneView {
    /// Linear light.
    pub color: Image,
    /// Linear, not multiplied by the opacity.
    pub albedo: Image,
    /// Of unit length.
    pub normal: Image,
    pub shadow: Image,
    /// Share that arrives of an unknown sun whose traced ray passes, where suns are apart.
    pub share: Image,
    /// Light that a white surface would send, shadow included.
    pub irradiance: Image,
    pub depth: Image,
    pub opacity: Image,
}

impl SceneModel {
    /// Linear albedo of what the field says: as printed, that is sRGB.
    pub(super) fn linear_albedo(&self, v: f32) -> f32 {
        if self.joint.is_some() { linear_from_srgb(v) } else { v }
    }

    /// Renders a camera that stands in model space under a light; `progress` receives rows.
    pub fn view(&self, camera: &PosedCamera, light: &ViewLight, progress: &mut dyn FnMut(usize)) -> SceneView {
        self.view_with(self.tracer(Quality::Full), camera, light, progress)
    }

    /// The same by a tracer of this model, such as one that shows only what lies in a box.
    pub fn view_with(&self, tracer: Tracer, camera: &PosedCamera, light: &ViewLight, progress: &mut dyn FnMut(usize)) -> SceneView {
        if self.stage == Stage::Surfaces {
            return unlit_view(&tracer.layers(camera, &[], progress), camera);
        }
        self.lit(&self.layers(&tracer, camera, light, progress), camera, light, 1)
    }

    /// What the field says of each pixel.
    fn layers(&self, tracer: &Tracer, camera: &PosedCamera, light: &ViewLight, progress: &mut dyn FnMut(usize)) -> Layers {
        let codes = light.codes();
        let codes: Vec<&[f32]> = codes.iter().map(|c| &c[..]).take(self.field.codes.given.len()).collect();
        tracer.layers(camera, &codes, progress)
    }

    /// A view under a light, of what the field says of it. Lamps are shared among the `samples`² rays of a pixel.
    fn lit(&self, Layers { values, opacity, depth }: &Layers, camera: &PosedCamera, light: &ViewLight, samples: u32) -> SceneView {
        let numbers = light.numbers();
        let (depth, opacity) = (depth.clone(), opacity.clone());
        let (w, h) = (values.width, values.height);
        let pixels: Vec<f32> = (0..w * h).flat_map(|i| [(i % w) as f32 + 0.5, (i / w) as f32 + 0.5]).collect();
        let (mut origins, mut dirs) = (vec![0.0; 3 * w * h], vec![0.0; 3 * w * h]);
        ray_generation::cpu::forward(std::slice::from_ref(camera), &vec![0; w * h], &pixels, &mut origins, &mut dirs);
        let image = |channels| Image::zeros(w, h, channels);
        let mut out = SceneView {
            color: image(3),
            albedo: image(3),
            normal: image(3),
            shadow: image(1),
            share: image(1),
            irradiance: image(3),
            depth,
            opacity,
        };
        let behind = self.joint.as_ref().and_then(|j| j.behind(&self.config, &origins, &dirs));
        let suns = light.suns();
        let (side, shares) = (samples as usize, light.shares(samples as usize));
        let sunlight = suns.as_ref().map(|suns| {
            let around = self.surroundings.as_deref().expect("a model with suns apart knows what stands around");
            let ambient = light.ambient.get_or_init(|| around.surfaces.light(&around.visibility, suns, &numbers));
            (&*around.visibility, ambient)
        });
        let shaded = |i: usize| {
            let mut v = [0.0; SUNLIT_CHANNELS];
            v[..values.channels].copy_from_slice(&values.data[values.channels * i..][..values.channels]);
            let o = out.opacity.data[i];
            // Shadows are composited before 1.
            [3, LEFT].into_iter().for_each(|k| v[k] += 1.0 - o);
            let at = 3 * i..3 * i + 3;
            let hit = (o, out.depth.data[i] * o);
            let ray = (&origins[at.clone()], &dirs[at.clone()]);
            if self.joint.is_some() {
                let mut color = joint::color(&v, &numbers);
                if let Some(behind) = &behind {
                    // The background is of photographs, in whose values it is added.
                    let sum = |k: usize| srgb_from_linear(color.rgb[k]) + (1.0 - o) * behind[at.start + k];
                    color.rgb = [0, 1, 2].map(|k| linear_from_srgb(sum(k)));
                    return (v, color);
                }
                let sky = shading::sky_toward(&light.sky, ray.1);
                (0..3).for_each(|k| color.rgb[k] += (1.0 - o) * (sky[k].max(0.0) + light.map_toward(ray.1)[k]));
                return (v, color);
            }
            let own = (i / w % side) * side + i % w % side;
            let sunlit = sunlight.map(|around| sunlit(around, (&shares[own], light.is_learned), (LOOKS, i as u32), &v[NORMAL..], hit, ray));
            let mut color = shading::color(&v, o, ray.1, &numbers, &light.sky, sunlit);
            if o < 1.0 {
                let radiance = light.map_toward(ray.1);
                (0..3).for_each(|k| color.rgb[k] += (1.0 - o) * radiance[k]);
            }
            (v, color)
        };
        let all: Vec<([f32; SUNLIT_CHANNELS], RayColor)> = (0..w * h).into_par_iter().map(shaded).collect();
        for (i, (v, color)) in all.into_iter().enumerate() {
            let o = out.opacity.data[i];
            let length = v[NORMAL..NORMAL + 3].iter().map(|n| n * n).sum::<f32>().sqrt().max(1e-20);
            for k in 0..3 {
                out.color.data[3 * i + k] = color.rgb[k];
                out.albedo.data[3 * i + k] = if o > 1e-3 { self.linear_albedo(v[k] / o) } else { 0.0 };
                out.normal.data[3 * i + k] = v[NORMAL + k] / length;
                out.irradiance.data[3 * i + k] = color.irradiance[k];
            }
            out.shadow.data[i] = color.shadow;
            out.share.data[i] = passing(&v);
        }
        out
    }
}

/// Views with several rays per pixel, whose layers are averaged. Views of one camera in several lights are traced once where they can be.
pub struct FineViews<'a> {
    model: &'a SceneModel,
    /// Rays per pixel and axis.
    samples: u32,
    last: Option<(PosedCamera, [[f32; 9]; 2], Layers)>,
}

impl FineViews<'_> {
    /// # Errors
    /// When the largest view does not fit into memory.
    pub fn new(model: &SceneModel, samples: u32) -> Result<FineViews<'_>> {
        let pixels = |i: usize| {
            let c = model.posed(i).camera;
            c.width as u64 * c.height as u64
        };
        let most = (0..model.capture.frames.len()).map(pixels).max().unwrap_or(0);
        memory::require("a view", most * (samples * samples) as u64 * RAY, "use fewer --samples")?;
        Ok(FineViews { model, samples, last: None })
    }

    /// A camera's view under a light.
    pub fn view(&mut self, camera: &PosedCamera, light: &ViewLight) -> SceneView {
        let (model, (w, h)) = (self.model, (camera.camera.width, camera.camera.height));
        let fine = PosedCamera { camera: camera.camera.resized(self.samples * w, self.samples * h), pose: camera.pose };
        let codes = light.codes();
        let is_traced = self.last.as_ref().is_some_and(|l| l.0.camera == fine.camera && l.0.pose == fine.pose && l.1 == codes);
        if !is_traced {
            self.last = Some((fine, codes, model.layers(&model.tracer(Quality::Full), &fine, light, &mut |_| {})));
        }
        let view = model.lit(&self.last.as_ref().expect("traced").2, &fine, light, self.samples);
        let mean = |image: Image| image.downsampled(w as usize, h as usize);
        let opacity = mean(view.opacity.clone());
        // What is not multiplied by the opacity is the mean of what is opaque.
        let of_matter = |image: Image| of_matter(image, &view.opacity, &opacity);
        let mut normal = of_matter(view.normal);
        for n in normal.data.as_chunks_mut::<3>().0 {
            *n = Vec3::from_array(*n).normalize_or_zero().to_array();
        }
        SceneView {
            color: mean(view.color),
            albedo: of_matter(view.albedo),
            normal,
            shadow: mean(view.shadow),
            share: mean(view.share),
            irradiance: mean(view.irradiance),
            depth: of_matter(view.depth),
            opacity,
        }
    }
}

/// A smaller image whose pixels are means weighted by the opacity of theirs.
fn of_matter(mut image: Image, opacity: &Image, mean: &Image) -> Image {
    let channels = image.channels;
    image.data.chunks_exact_mut(channels).zip(&opacity.data).for_each(|(p, o)| p.iter_mut().for_each(|v| *v *= o));
    let mut small = image.downsampled(mean.width, mean.height);
    small.data.chunks_exact_mut(channels).zip(&mean.data).for_each(|(p, o)| p.iter_mut().for_each(|v| *v /= o.max(1e-6)));
    small
}

/// Surfaces as they look in the mean of all lights, from which nothing is told apart yet: in place of color and albedo alike. Normals face the
/// camera.
fn unlit_view(layers: &Layers, camera: &PosedCamera) -> SceneView {
    let (w, h) = (layers.values.width, layers.values.height);
    let linear = Image { data: layers.values.data.iter().map(|v| linear_from_srgb(v.clamp(0.0, 1.0))).collect(), ..layers.values.clone() };
    let back = -camera.pose.rotation.z_axis.as_vec3();
    SceneView {
        albedo: linear.clone(),
        normal: Image { data: back.to_array().repeat(w * h), ..Image::zeros(w, h, 3) },
        shadow: Image { data: vec![1.0; w * h], ..Image::zeros(w, h, 1) },
        share: Image { data: vec![1.0; w * h], ..Image::zeros(w, h, 1) },
        irradiance: Image { data: vec![1.0; 3 * w * h], ..Image::zeros(w, h, 3) },
        color: linear,
        depth: layers.depth.clone(),
        opacity: layers.opacity.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_of_a_pixel_share_all_lamps() {
        let lamp = |i: usize| [0.0, 0.6, 0.8, i as f32, 2.0, 1.0];
        let mut light = ViewLight::of(ShLight::DARK);
        (light.sun, light.lamps) = (Some([1.0; SUN]), (0..10).flat_map(lamp).collect());
        assert_eq!(light.shares(1), [light.suns().unwrap()]);
        let shares = light.shares(2);
        let power = |k: usize| shares.iter().flat_map(|s| s[SUN..].chunks_exact(SUN)).map(|l| l[k]).sum::<f32>() / 4.0;
        assert!(shares.iter().all(|s| s[..SUN] == [1.0; SUN] && s.len() < 5 * SUN) && shares[1][SUN..SUN + 3] == [0.0, 0.6, 0.8]);
        assert_eq!([power(3), power(4)], [45.0, 20.0]);
    }

    #[test]
    fn half_covered_pixels_have_the_albedo_of_what_covers_them() {
        let image = |data: Vec<f32>, channels| Image { width: 2, height: 2, channels, data };
        let (opacity, albedo) = (image(vec![1.0, 0.0, 1.0, 0.0], 1), image([[0.6; 3], [0.0; 3]].repeat(2).concat(), 3));
        let mean = opacity.downsampled(1, 1);
        let small = of_matter(albedo, &opacity, &mean);
        assert!(mean.data[0] == 0.5 && small.data.iter().all(|v| (v - 0.6).abs() < 1e-6), "{:?}", small.data);
        let nothing = image(vec![0.0; 4], 1);
        assert_eq!(of_matter(image(vec![7.0; 4], 1), &nothing, &nothing.downsampled(1, 1)).data, [0.0]);
    }
}
