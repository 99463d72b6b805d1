//! Light of a photograph that training never saw: spherical harmonics, and a sun where the model tells suns apart, from what the model knows of
//! the place.
//!
//! The model's albedo, normals and shadow at the photograph's camera explain its pixels under an unknown light, which [`solve`] finds. The
//! shadow depends on the light, so both are found in turn; with suns apart, the sun is searched whose shadows fit. Only surfaces count that
//! other photographs show as well: what nobody saw has no albedo.

mod known;
pub mod solve;

use super::outdoor::model::SceneModel;
use super::outdoor::render::{SceneView, ViewLight};
use super::outdoor::shading::{LIGHT, SKY};
use super::outdoor::sun::{self, Shown};
use crate::error::{PipelineError, Result};
use diorama_data::{DataError, masks, photo, transforms_json};
use diorama_geom::capture::Frame;
use diorama_geom::color::{self, linear_from_srgb, srgb_from_linear};
use diorama_geom::glam::{DVec3, Vec3};
use diorama_geom::sh_light::ShLight;
use diorama_geom::{Camera, Image, ImageU8, Similarity};
use diorama_kernels::ops::ray_generation::PosedCamera;
use solve::LitPixel;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Times that shadow and light are found in turn, and pixels along the longer side meanwhile.
const ROUNDS: usize = 4;
const FIT_PX: u32 = 256;
/// Opacity from which a pixel shows a surface.
const SURFACE: f32 = 0.5;
/// Values from here on are overexposed, and values up to here underexposed: they say little about the light.
const EXPOSED: (u8, u8) = (3, 252);
/// Fewest pixels that tell a light, or a sky.
const FEWEST: usize = 50;
/// Value of the first spherical harmonic.
const FIRST: f32 = 0.282_094_8;

/// Part of a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Region {
    All,
    Left,
    Right,
    /// Lowest and highest column and row, in pixels of the photograph: x0, y0, x1, y1.
    Box([f64; 4]),
}

impl std::str::FromStr for Region {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Region, String> {
        let fault = || format!("region {s:?}: expected all, left, right, or x0,y0,x1,y1 in pixels with x0 < x1 and y0 < y1");
        match s {
            "all" => Ok(Region::All),
            "left" => Ok(Region::Left),
            "right" => Ok(Region::Right),
            _ => {
                let numbers = s.split(',').map(|v| v.trim().parse::<f64>().ok()).collect::<Option<Vec<f64>>>();
                let corners: [f64; 4] = numbers.and_then(|n| n.try_into().ok()).ok_or_else(fault)?;
                let [x0, y0, x1, y1] = corners;
                if x0 < x1 && y0 < y1 { Ok(Region::Box(corners)) } else { Err(fault()) }
            }
        }
    }
}

impl Region {
    /// Whether the center of a pixel lies in it, for an image of `size` that shows a photograph of `full` pixels.
    fn holds(&self, (x, y): (usize, usize), size: (usize, usize), full: (usize, usize)) -> bool {
        let at = |v: usize, n: usize, full: usize| (v as f64 + 0.5) / n as f64 * full as f64;
        let (x, y) = (at(x, size.0, full.0), at(y, size.1, full.1));
        match *self {
            Region::All => true,
            Region::Left => 2.0 * x < full.0 as f64,
            Region::Right => 2.0 * x >= full.0 as f64,
            Region::Box([x0, y0, x1, y1]) => x0 <= x && x < x1 && y0 <= y && y < y1,
        }
    }
}

/// What is fitted.
#[derive(Clone, Debug)]
pub struct FitOptions {
    pub photo: PathBuf,
    /// Name or number of a frame whose camera took the photograph, or a `transforms.json` that lists it; none: the frame of its name.
    pub camera: Option<String>,
    pub region: Region,
    /// Surfaces that no other photograph shows count as well.
    pub all_surfaces: bool,
}

/// A light, and how well it explains the photograph: PSNR in sRGB over pixels that show surfaces, inside and outside of the fitted region.
#[derive(Clone, Debug)]
pub struct FittedLight {
    pub light: ShLight,
    /// A sun, whose light the harmonics then lack: direction, and the irradiance of a surface that faces it.
    pub sun: Option<(DVec3, [f64; 3])>,
    /// Luminance of the light over that of the mean light of training.
    pub gain: f64,
    pub fitted_psnr: f64,
    /// None where the region is all of the picture.
    pub rest_psnr: Option<f64>,
    /// The same under the mean light of training.
    pub mean_light_fitted_psnr: f64,
    pub mean_light_rest_psnr: Option<f64>,
    /// The rest again, only where the photograph looks like the model's albedo: without who stands before it.
    pub alike_rest_psnr: Option<f64>,
    pub mean_light_alike_rest_psnr: Option<f64>,
    /// Pixels that were fitted, at the size at which lights are compared.
    pub pixels: usize,
    /// sRGB: the photograph at the run's size, and the model's picture in the new and in the mean light.
    pub photograph: ImageU8,
    pub picture: ImageU8,
    pub mean_picture: ImageU8,
    /// 255 where a pixel is scored, 128 where the photograph looks like something else there.
    pub scored: ImageU8,
}

/// A photograph with its camera, at one size.
struct Shot {
    camera: PosedCamera,
    /// `[H, W, 3]`, 8 bits.
    photo: ImageU8,
    /// 255 is static, 192 glass, 160 sky, 0 left out.
    mask: Option<ImageU8>,
    full: (usize, usize),
}

impl Shot {
    /// A photograph whose longer side has at most `longest` pixels.
    fn resized(&self, longest: u32) -> Shot {
        let c = &self.camera.camera;
        let by = (longest as f64 / c.width.max(c.height) as f64).min(1.0);
        let camera = c.resized(((c.width as f64 * by) as u32).max(1), ((c.height as f64 * by) as u32).max(1));
        let (w, h) = (camera.width as usize, camera.height as usize);
        Shot {
            camera: PosedCamera { camera, pose: self.camera.pose },
            photo: self.photo.downsampled(w, h),
            mask: self.mask.as_ref().map(|m| m.downsampled(w, h)),
            full: self.full,
        }
    }

    fn is_kept(&self, i: usize) -> bool {
        let is_surface = |v: u8| v >= masks::COUNTS && !masks::GLASS.contains(&v) && !masks::SKY.contains(&v);
        self.mask.as_ref().is_none_or(|m| is_surface(m.data[i]))
    }

    fn rgb(&self, i: usize) -> [u8; 3] {
        std::array::from_fn(|k| self.photo.data[self.photo.channels * i + k])
    }
}

/// The even sky that the region's pixels show as far as the model is transparent there; none where it is opaque.
fn even_sky(shot: &Shot, view: &SceneView, region: &Region) -> Option<Vec<f32>> {
    let size = (shot.photo.width, shot.photo.height);
    let (mut sum, mut total) = ([0.0f32; 3], 0.0);
    for i in (0..size.0 * size.1).filter(|i| shot.is_kept(*i) && region.holds((i % size.0, i / size.0), size, shot.full)) {
        // Squared, because what shines through hardly shows the sky.
        let weight = (1.0 - view.opacity.data[i]).powi(2);
        let rgb = shot.rgb(i);
        (0..3).for_each(|k| sum[k] += weight * linear_from_srgb(rgb[k] as f32 / 255.0));
        total += weight;
    }
    let constant = |i: usize| if i < 3 { sum[i] / total / FIRST } else { 0.0 };
    (total > FEWEST as f32).then(|| (0..SKY).map(constant).collect())
}

/// Finds the light of a photograph; none when stopped. `progress` receives the share that is done.
///
/// # Errors
/// When the photograph or its camera cannot be read, or the region shows hardly any surface that the model knows.
pub fn fit(model: &SceneModel, o: &FitOptions, stop: &AtomicBool, progress: &mut dyn FnMut(f64)) -> Result<Option<FittedLight>> {
    let mut shot = shot(model, o)?;
    let mean = mean_light(model);
    let mut small = shot.resized(FIT_PX);
    let (mut light, mut sun, mut sky, mut pixels) = (None, None, None, 0);
    let lit_by = |light: ShLight, sun: Option<(DVec3, [f64; 3])>, sky: &Option<Vec<f32>>| {
        let mut shown = ViewLight::new(model, light, sun);
        sky.iter().for_each(|sky| shown.sky.clone_from(sky));
        shown
    };
    let known = (!o.all_surfaces).then(|| known::Known::of(model));
    let rounds = if model.has_suns() { 1 } else { ROUNDS };
    for round in 0..rounds {
        let own = lit_by(light.unwrap_or(mean), None, &sky);
        let view = model.view(&small.camera, &own, &mut |_| {});
        if let Some(known) = known.as_ref().filter(|_| round == 0) {
            known.keep(&mut small, &view);
        }
        sky = sky.or_else(|| even_sky(&small, &view, &o.region));
        let alike = known::alike(&small, &view);
        let used: Vec<usize> = used_pixels(&small, &view, &o.region, model.has_suns()).into_iter().filter(|i| alike[*i]).collect();
        pixels = used.len();
        if pixels < FEWEST {
            let why = "the region shows hardly any well-exposed surface that the model and other photographs know; give another --region or \
                       --camera, or mend its mask";
            return Err(DataError::input(&o.photo, why).into());
        }
        if let Some(around) = model.surroundings.as_deref().filter(|_| model.has_suns()) {
            let shown: Vec<Shown> = used.iter().map(|i| shown(&small, &view, *i)).collect();
            let Some(found) = sun::of_photograph(&shown, &around.surfaces, &around.visibility, stop) else { return Ok(None) };
            light = Some(ShLight(std::array::from_fn(|i| std::array::from_fn(|k| found.sky[3 * i + k] as f64))));
            let power: [f64; 3] = std::array::from_fn(|k| found.sun[3 + k] as f64 * std::f64::consts::PI);
            sun = (power != [0.0; 3]).then(|| (DVec3::new(found.sun[0] as f64, found.sun[1] as f64, found.sun[2] as f64), power));
        } else {
            let before = lit_by(own.light, None, &sky);
            let lit: Vec<LitPixel> = used.iter().map(|i| lit_pixel(&small, &view, &before, *i)).collect();
            light = Some(solve::light(&lit, &mean, light.as_ref()));
        }
        progress((round + 1) as f64 / (rounds + 2) as f64);
        if stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
    }
    let light = light.unwrap_or(mean);
    let view = model.view(&shot.camera, &lit_by(light, sun, &sky), &mut |_| {});
    known.iter().for_each(|known| known.keep(&mut shot, &view));
    progress((rounds + 1) as f64 / (rounds + 2) as f64);
    let plain = model.view(&shot.camera, &lit_by(mean, None, &sky), &mut |_| {});
    let alike = known::alike(&shot, &view);
    let inside = |i: usize| {
        let (w, h) = (shot.photo.width, shot.photo.height);
        o.region.holds((i % w, i / w), (w, h), shot.full)
    };
    let of = |view: &SceneView, which: &dyn Fn(usize) -> bool| psnr(&shot, view, which);
    let (fitted, rest) = (of(&view, &inside), of(&view, &|i| !inside(i)));
    let (mean_fitted, mean_rest) = (of(&plain, &inside), of(&plain, &|i| !inside(i)));
    let is_alike = |i: usize| !inside(i) && alike[i];
    let mut whole = light;
    sun.iter().for_each(|(direction, irradiance)| whole.add_sun(*direction, *irradiance));
    Ok(Some(FittedLight {
        gain: luminance(&whole) / luminance(&mean).max(1e-9),
        light,
        sun,
        fitted_psnr: fitted.unwrap_or(f64::NAN),
        rest_psnr: rest,
        mean_light_fitted_psnr: mean_fitted.unwrap_or(f64::NAN),
        mean_light_rest_psnr: mean_rest,
        alike_rest_psnr: of(&view, &is_alike),
        mean_light_alike_rest_psnr: of(&plain, &is_alike),
        pixels,
        photograph: shot.photo.clone(),
        picture: encoded(&view.color),
        mean_picture: encoded(&plain.color),
        scored: scored(&shot, &view, &alike),
    }))
}

/// Mean of the lights of training, with their suns.
pub fn mean_light(model: &SceneModel) -> ShLight {
    let n = model.lights.values.len() / LIGHT;
    let mut sum = ShLight::DARK;
    for l in 0..n {
        let mut light = model.light(l);
        if let Some(sun) = model.sun(l) {
            let [x, y, z, r, g, b] = std::array::from_fn(|i| sun[i] as f64);
            light.add_sun(DVec3::new(x, y, z), [r, g, b].map(|power| power * std::f64::consts::PI));
        }
        (0..9).for_each(|i| (0..3).for_each(|k| sum.0[i][k] += light.0[i][k] / n as f64));
    }
    sum
}

fn luminance(light: &ShLight) -> f64 {
    color::luminance(light.0[0])
}

fn encoded(linear: &Image) -> ImageU8 {
    let data = linear.data.iter().map(|v| srgb_from_linear(v.clamp(0.0, 1.0))).collect();
    Image { data, ..linear.clone() }.to_u8()
}

/// Pixels of a region that show surfaces and are well exposed, or overexposed where that is `bright`.
fn used_pixels(shot: &Shot, view: &SceneView, region: &Region, bright: bool) -> Vec<usize> {
    let size = (shot.photo.width, shot.photo.height);
    let is_used = |i: &usize| {
        let rgb = shot.rgb(*i);
        view.opacity.data[*i] > SURFACE
            && shot.is_kept(*i)
            && rgb.iter().any(|v| *v > EXPOSED.0)
            && (bright || rgb.iter().all(|v| *v < EXPOSED.1))
            && region.holds((i % size.0, i / size.0), size, shot.full)
    };
    (0..size.0 * size.1).filter(is_used).collect()
}

fn lit_pixel(shot: &Shot, view: &SceneView, light: &ViewLight, i: usize) -> LitPixel {
    let through = view.opacity.data[i] * view.shadow.data[i];
    LitPixel {
        reflected: std::array::from_fn(|k| view.albedo.data[3 * i + k] * through),
        behind: std::array::from_fn(|k| (1.0 - view.opacity.data[i]) * (light.sky[k] * FIRST).max(0.0)),
        normal: std::array::from_fn(|k| view.normal.data[3 * i + k]),
        target_srgb: shot.rgb(i).map(|v| v as f32 / 255.0),
    }
}

/// A pixel as the search for suns reads it.
fn shown(shot: &Shot, view: &SceneView, i: usize) -> Shown {
    let at = |image: &Image| Vec3::from_slice(&image.data[3 * i..]);
    Shown {
        point: known::point(&shot.camera, view, i).as_vec3(),
        normal: at(&view.normal),
        albedo: at(&view.albedo),
        share: view.share.data[i],
        color: Vec3::from(shot.rgb(i).map(|v| linear_from_srgb(v as f32 / 255.0))),
    }
}

/// PSNR in sRGB over the surfaces among some pixels; none without pixels.
fn psnr(shot: &Shot, view: &SceneView, which: &dyn Fn(usize) -> bool) -> Option<f64> {
    let (mut sum, mut n) = (0.0, 0);
    for i in 0..shot.photo.width * shot.photo.height {
        if counts(shot, view, i) && which(i) {
            let rgb = shot.rgb(i);
            for k in 0..3 {
                let e = srgb_from_linear(view.color.data[3 * i + k].clamp(0.0, 1.0)) - rgb[k] as f32 / 255.0;
                sum += (e * e) as f64;
            }
            n += 3;
        }
    }
    (n > 0).then(|| -10.0 * (sum / n as f64).log10())
}

fn scored(shot: &Shot, view: &SceneView, alike: &[bool]) -> ImageU8 {
    let (w, h) = (shot.photo.width, shot.photo.height);
    let of = |i: usize| match (counts(shot, view, i), alike[i]) {
        (false, _) => 0,
        (true, false) => 128,
        (true, true) => 255,
    };
    let data = (0..w * h).map(of).collect();
    ImageU8 { width: w, height: h, channels: 1, data }
}

/// Whether a pixel shows a surface that is known.
fn counts(shot: &Shot, view: &SceneView, i: usize) -> bool {
    view.opacity.data[i] > SURFACE && shot.is_kept(i)
}

/// The photograph at the run's size, with its camera in model space.
fn shot(model: &SceneModel, o: &FitOptions) -> Result<Shot> {
    let frame = frame(model, o)?;
    let full = photo::load(&o.photo)?;
    let camera: Camera = frame.camera.downscaled(model.config.data.downscale);
    let (w, h) = (camera.width as usize, camera.height as usize);
    if !photo::is_same_aspect((full.width as u32, full.height as u32), (camera.width, camera.height)) {
        return Err(DataError::input(
            &o.photo,
            format!("is {}×{}, but its camera takes pictures of {w}×{h}: give the --camera that took it", full.width, full.height),
        )
        .into());
    }
    let mask = masks::of_frame(&frame, &model.capture.masks, (w, h))?;
    let photo = full.downsampled(w.min(full.width), h.min(full.height));
    let camera = camera.resized(photo.width as u32, photo.height as u32);
    let mask = mask.map(|m| m.downsampled(photo.width, photo.height));
    let pose = model.model_from_world.pose(&frame.world_from_camera);
    Ok(Shot { camera: PosedCamera { camera, pose }, photo, mask, full: (full.width, full.height) })
}

/// The frame whose camera took the photograph.
fn frame(model: &SceneModel, o: &FitOptions) -> Result<Frame> {
    let frames = &model.capture.frames;
    let file_name = |p: &Path| p.file_name().map(|n| n.to_string_lossy().into_owned());
    let stem = |name: &str| Path::new(name).file_stem().map(|s| s.to_string_lossy().into_owned());
    let found = match o.camera.as_deref() {
        Some(file) if file.ends_with(".json") => return frame_of_file(model, Path::new(file), &o.photo),
        Some(which) => match which.parse::<usize>() {
            Ok(i) => frames.get(i),
            Err(_) => frames.iter().find(|f| f.name == which || stem(&f.name) == stem(which)),
        },
        None => frames.iter().find(|f| file_name(&f.image) == file_name(&o.photo)),
    };
    found.cloned().ok_or_else(|| match &o.camera {
        Some(which) => PipelineError::Usage(format!("--camera {which}: the run has {} frames, from 0 on; name one of them", frames.len())),
        None => DataError::input(&o.photo, "no frame of the run has this name; give its camera with --camera FRAME or --camera pose.json")
            .into(),
    })
}

/// The photograph's frame in a `transforms.json` in the coordinates of the run's capture.
fn frame_of_file(model: &SceneModel, file: &Path, photo: &Path) -> Result<Frame> {
    let root = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let read = transforms_json::read(file, root)?;
    let found = read.frames.into_iter().find(|f| f.image.file_name() == photo.file_name());
    let mut frame = found.ok_or_else(|| {
        let name = photo.file_name().unwrap_or_default().to_string_lossy();
        DataError::input(
            file,
            format!("frames: none has the file_path {name}, beside this file; add it with its transform_matrix and fl_x"),
        )
    })?;
    let capture_from_frames = read.frames_from_capture.map_or(Similarity::IDENTITY, |f| f.inverse());
    frame.world_from_camera = model.capture.world_from_capture.pose(&capture_from_frames.pose(&frame.world_from_camera));
    Ok(frame)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_are_halves_or_boxes_of_the_photograph() {
        let holds = |text: &str, x: usize, y: usize| text.parse::<Region>().unwrap().holds((x, y), (10, 6), (1000, 600));
        assert!(holds("left", 4, 0) && !holds("left", 5, 0) && holds("right", 5, 3) && !holds("right", 4, 3) && holds("all", 9, 5));
        assert!(holds("100,100,300,200", 1, 1) && !holds("100,100,300,200", 3, 1) && !holds("100,100,300,200", 1, 2));
        for wrong in ["top", "1,2,3", "5,5,5,9", "a,b,c,d"] {
            assert!(wrong.parse::<Region>().unwrap_err().contains("x0,y0,x1,y1"), "{wrong}");
        }
    }
}
