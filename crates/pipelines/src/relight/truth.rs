//! Exact layers and lights of a generated benchmark, in `truth/` beside its photographs.

use crate::error::Result;
use diorama_data::photo::{self, Photo};
use diorama_data::{DataError, atomic, environment, error, sh_text};
use diorama_geom::Image;
use diorama_geom::daylight::Daylight;
use diorama_geom::sh_light::ShLight;
use diorama_kernels::ops::path_trace::Film;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

const NAME: &str = "truth.json";
const LIMIT: u64 = 1 << 26;

/// What belongs to which photograph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    pub lights: Vec<LightTruth>,
    pub views: Vec<ViewTruth>,
    /// The light that no photograph of training has.
    pub unseen: usize,
    /// Another one, without shadows that have edges.
    #[serde(default)]
    pub veiled: Option<usize>,
}

/// A light.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LightTruth {
    pub name: String,
    /// Map and sun as spherical harmonics, without shadows.
    pub harmonics: [[f64; 3]; 9],
    /// Direction toward the sun, and the irradiance of a surface that faces it.
    pub sun: Option<([f64; 3], [f64; 3])>,
}

/// A photograph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewTruth {
    pub photograph: String,
    /// Name of the layers that do not depend on light.
    pub view: String,
    pub light: usize,
    pub held_out: bool,
}

impl LightTruth {
    pub fn of(name: &str, light: &Daylight) -> LightTruth {
        let mut harmonics = ShLight::of(&light.environment);
        if let Some(sun) = light.sun {
            harmonics.add_sun(sun.direction, sun.irradiance);
        }
        let sun = light.sun.map(|s| (s.direction.into(), s.irradiance));
        LightTruth { name: name.into(), harmonics: harmonics.0, sun }
    }

    pub fn light(&self) -> ShLight {
        ShLight(self.harmonics)
    }
}

impl Truth {
    /// Whether training has photographs in a light.
    pub fn is_seen(&self, light: usize) -> bool {
        light != self.unseen && Some(light) != self.veiled
    }

    /// Whether a data set has a truth.
    pub fn exists(data: &Path) -> bool {
        file(data, NAME).exists()
    }

    /// # Errors
    /// When the file is missing or damaged.
    pub fn read(data: &Path) -> Result<Truth> {
        let path = file(data, NAME);
        let bytes = error::read(&path, LIMIT)?;
        Ok(serde_json::from_slice(&bytes).map_err(|e| DataError::input(&path, format!("{e}; generate the benchmark again")))?)
    }

    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, data: &Path) -> Result<()> {
        Ok(atomic::write(&file(data, NAME), &serde_json::to_vec_pretty(self).expect("plain values"))?)
    }
}

/// Layers of a view that do not depend on light.
pub struct ViewLayers {
    /// Linear, `[H, W, 3]`.
    pub albedo: Image,
    /// `[H, W, 3]`
    pub normal: Image,
    /// Distance along the ray, `[H, W, 1]`.
    pub depth: Image,
    /// 1 where an opaque surface is visible, `[H, W, 1]`.
    pub valid: Image,
}

fn file(data: &Path, name: &str) -> PathBuf {
    data.join("truth").join(name)
}

/// The map of a light.
pub fn light_file(data: &Path, name: &str) -> PathBuf {
    file(data, &format!("{name}.hdr"))
}

/// Writes albedo and normals, and depth with validity.
pub fn save_view(data: &Path, view: &str, film: &Film, valid: &Image) -> Result<()> {
    photo::save_exr(&file(data, &format!("{view}_albedo.exr")), &film.image(|p| p.albedo))?;
    photo::save_exr(&file(data, &format!("{view}_normal.exr")), &film.image(|p| p.normal))?;
    let mut depth = film.image(|p| [p.depth, p.sun, 0.0]);
    depth.data.chunks_exact_mut(3).zip(&valid.data).for_each(|(p, v)| p[2] = *v);
    Ok(photo::save_exr(&file(data, &format!("{view}_depth.exr")), &depth)?)
}

/// Writes the share of the direct light that arrives, and of the sun.
pub fn save_shadow(data: &Path, photograph: &str, film: &Film) -> Result<()> {
    let shadow = film.image(|p| [if p.unshadowed > 0.0 { p.direct / p.unshadowed } else { 0.0 }, p.sun, p.unshadowed]);
    Ok(photo::save_exr(&file(data, &format!("{photograph}_shadow.exr")), &shadow)?)
}

/// Writes map and harmonics of a light.
pub fn save_light(data: &Path, name: &str, light: &Daylight) -> Result<()> {
    let mut map = light.environment.clone();
    if let Some(sun) = light.sun {
        map.add_disc(sun.direction, sun.diameter, sun.irradiance);
    }
    environment::save_hdr(&file(data, &format!("{name}.hdr")), &map)?;
    Ok(sh_text::save(&file(data, &format!("{name}.txt")), &LightTruth::of(name, light).light(), None)?)
}

fn read_exr(data: &Path, name: &str) -> Result<Image> {
    let path = file(data, name);
    match photo::load_full(&path)? {
        Photo::Linear(image) => Ok(image),
        _ => Err(DataError::input(&path, "holds no floating-point values; generate the benchmark again").into()),
    }
}

/// # Errors
/// When a file is missing or damaged.
pub fn read_view(data: &Path, view: &str) -> Result<ViewLayers> {
    let depth = read_exr(data, &format!("{view}_depth.exr"))?;
    let channel = |k: usize| Image {
        width: depth.width,
        height: depth.height,
        channels: 1,
        data: depth.data.chunks_exact(3).map(|p| p[k]).collect(),
    };
    Ok(ViewLayers {
        albedo: read_exr(data, &format!("{view}_albedo.exr"))?,
        normal: read_exr(data, &format!("{view}_normal.exr"))?,
        depth: channel(0),
        valid: channel(2),
    })
}

/// Share of the direct light, of the sun, and the direct light without shadows, `[H, W, 3]`.
///
/// # Errors
/// When the file is missing or damaged.
pub fn read_shadow(data: &Path, photograph: &str) -> Result<Image> {
    read_exr(data, &format!("{photograph}_shadow.exr"))
}
