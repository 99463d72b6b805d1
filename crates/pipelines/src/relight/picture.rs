//! Pictures that are refined in passes, kept when they are interrupted, and written as EXR or PNG.

use super::path_tracer::PathTracer;
use crate::error::{PipelineError, Result};
use crate::run::memory;
use diorama_data::checkpoint::{self, Entry};
use diorama_data::{DataError, photo};
use diorama_geom::color::{srgb_from_linear, u8_from_unit};
use diorama_geom::{Camera, Image, ImageU8};
use diorama_kernels::ops::path_trace::{Film, Pixel, Scene, Settings, View};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Samples per pixel of a pass. A picture of `n` samples is the same whether it was interrupted or not.
const PASS: u32 = 16;
/// Time between writes of an unfinished picture.
const KEEP: Duration = Duration::from_secs(30);
/// Share of the pixels that automatic exposure lets be brighter than [`BRIGHT`].
const ABOVE: f64 = 0.05;
/// Bytes of a pixel: the film, and the same numbers once more where it is kept or filtered.
const PIXEL: u64 = 2 * 4 * Pixel::LEN as u64;
/// Linear value of nearly white.
const BRIGHT: f64 = 0.85;

/// A picture to render.
pub struct Job<'a> {
    pub scene: &'a Scene,
    pub view: View,
    pub settings: Settings,
    /// Samples per pixel.
    pub samples: u32,
    /// Folder that holds the unfinished picture; none: it is not kept.
    pub kept: Option<PathBuf>,
    /// Everything that the picture depends on; an unfinished picture of another key is not continued.
    pub key: String,
}

/// Refuses pictures that do not fit into memory.
///
/// # Errors
/// When a camera's does not.
pub fn require_memory(camera: &Camera) -> Result<()> {
    memory::require("the picture", camera.width as u64 * camera.height as u64 * PIXEL, "render a smaller size")
}

/// Renders a picture of the scene that `tracer` has loaded, continuing an unfinished one, and whether it was interrupted. `progress` gets the
/// share that is done.
///
/// # Errors
/// When the unfinished picture cannot be written, or a device that was named failed.
pub fn render(job: &Job, tracer: &mut PathTracer, stop: &AtomicBool, progress: &mut dyn FnMut(f64)) -> Result<(Film, bool)> {
    require_memory(&job.view.camera)?;
    let mut film = job.continued().unwrap_or_else(|| Film::new(&job.view.camera));
    let mut last = Instant::now();
    while film.samples < job.samples {
        progress(film.samples as f64 / job.samples as f64);
        let pass = PASS.min(job.samples - film.samples);
        if let Err(e) = tracer.add(job.scene, &job.view, &job.settings, pass, &mut film) {
            // The passes before it are not lost.
            if film.samples > 0 {
                job.keep(&film)?;
            }
            return Err(e);
        }
        let interrupted = stop.load(Ordering::Relaxed) && film.samples < job.samples;
        if interrupted || last.elapsed() > KEEP {
            job.keep(&film)?;
            last = Instant::now();
        }
        if interrupted {
            return Ok((film, true));
        }
    }
    progress(1.0);
    Ok((film, false))
}

impl Job<'_> {
    /// The unfinished picture, if it is of the same key and has whole passes.
    fn continued(&self) -> Option<Film> {
        let folder = self.kept.as_deref().filter(|f| checkpoint::exists(f))?;
        let (mut kept, _) = checkpoint::load(folder).ok()?;
        let samples: u32 = kept.metadata.get("samples")?.parse().ok()?;
        let (width, height) = (self.view.camera.width as usize, self.view.camera.height as usize);
        let is_same = kept.metadata.get("key") == Some(&self.key) && samples <= self.samples && samples.is_multiple_of(PASS);
        let data = kept.take("film").filter(|d| is_same && d.len() == width * height * Pixel::LEN)?;
        Some(Film::of_image(&Image { width, height, channels: Pixel::LEN, data }, samples))
    }

    fn keep(&self, film: &Film) -> Result<()> {
        let Some(folder) = &self.kept else { return Ok(()) };
        let image = film.to_image();
        let entry = Entry { name: "film".into(), shape: vec![image.height, image.width, image.channels], data: &image.data };
        let metadata = [("samples", film.samples.to_string()), ("key", self.key.clone())].map(|(k, v)| (k.to_string(), v));
        Ok(checkpoint::save(folder, &[entry], HashMap::from(metadata))?)
    }
}

/// Folder beside a picture that holds it while it is unfinished.
pub fn kept_beside(out: &Path) -> PathBuf {
    let mut name = out.file_name().unwrap_or_default().to_os_string();
    name.push(".unfinished");
    out.with_file_name(name)
}

/// Removes the unfinished picture.
///
/// # Errors
/// When the folder cannot be removed.
pub fn discard(kept: &Path) -> Result<()> {
    match std::fs::remove_dir_all(kept) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(DataError::io(kept, "remove")(e).into()),
        _ => Ok(()),
    }
}

/// Formats of pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureFormat {
    /// Linear light.
    Exr,
    /// sRGB of 8 bits.
    Png,
}

impl PictureFormat {
    /// # Errors
    /// When the extension is neither `.exr` nor `.png`.
    pub fn of(path: &Path) -> Result<PictureFormat> {
        match path.extension().and_then(|e| e.to_str()).map(str::to_lowercase).as_deref() {
            Some("exr") => Ok(PictureFormat::Exr),
            Some("png") => Ok(PictureFormat::Png),
            _ => Err(PipelineError::Usage(format!("{}: pictures are .exr (linear light) or .png", path.display()))),
        }
    }
}

/// Stops that make the brightest twentieth of the pixels that are not transparent nearly white; 0 for black pictures.
///
/// `rgba` is `[H, W, 4]`, linear and premultiplied.
pub fn automatic_exposure(rgba: &Image) -> f64 {
    let lum = |p: &[f32]| (0.2126 * p[0] + 0.7152 * p[1] + 0.0722 * p[2]) as f64;
    let mut values: Vec<f64> = rgba.data.chunks_exact(4).filter(|p| p[3] > 0.5).map(lum).collect();
    if values.is_empty() {
        return 0.0;
    }
    let at = ((1.0 - ABOVE) * (values.len() - 1) as f64) as usize;
    let (_, bright, _) = values.select_nth_unstable_by(at, f64::total_cmp);
    if *bright > 0.0 { (BRIGHT / *bright).log2() } else { 0.0 }
}

/// sRGB of 8 bits with straight alpha of a linear, premultiplied picture `[H, W, 4]`; opaque pictures have three channels.
pub fn develop(rgba: &Image, stops: f64) -> ImageU8 {
    let gain = stops.exp2() as f32;
    let is_opaque = rgba.data.chunks_exact(4).all(|p| p[3] >= 0.999);
    let mut data = Vec::with_capacity(rgba.data.len());
    for p in rgba.data.chunks_exact(4) {
        let scale = gain / if p[3] > 0.0 { p[3] } else { 1.0 };
        data.extend(p[..3].iter().map(|v| u8_from_unit(srgb_from_linear((v * scale).clamp(0.0, 1.0)))));
        if !is_opaque {
            data.push(u8_from_unit(p[3]));
        }
    }
    ImageU8 { width: rgba.width, height: rgba.height, channels: if is_opaque { 3 } else { 4 }, data }
}

/// Writes a linear, premultiplied picture `[H, W, 4]` and returns the stops by which a PNG was brightened.
///
/// # Errors
/// When the file cannot be written.
pub fn save(path: &Path, rgba: &Image, exposure: Option<f64>) -> Result<Option<f64>> {
    match PictureFormat::of(path)? {
        PictureFormat::Exr => {
            let mut straight = rgba.clone();
            straight.data.chunks_exact_mut(4).filter(|p| p[3] > 0.0).for_each(|p| {
                let a = p[3];
                p[..3].iter_mut().for_each(|v| *v /= a);
            });
            photo::save_exr(path, &straight)?;
            Ok(None)
        }
        PictureFormat::Png => {
            let stops = exposure.unwrap_or_else(|| automatic_exposure(rgba));
            photo::save_png(path, &develop(rgba, stops))?;
            Ok(Some(stops))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exposure_makes_the_bright_nearly_white() {
        let mut image = Image::zeros(100, 1, 4);
        for (i, p) in image.data.chunks_exact_mut(4).enumerate() {
            p.copy_from_slice(&[0.1 * i as f32, 0.1 * i as f32, 0.1 * i as f32, 1.0]);
        }
        let stops = automatic_exposure(&image);
        let picture = develop(&image, stops);
        assert_eq!(picture.channels, 3);
        // 0.85 in linear light is 238 of 255.
        let white = picture.data.chunks_exact(3).filter(|p| p[0] >= 237).count();
        assert!((4..=6).contains(&white), "{white}");
        assert_eq!(automatic_exposure(&Image::zeros(4, 4, 4)), 0.0);
    }

    #[test]
    fn pictures_keep_their_light_and_their_transparency() {
        let dir = tempfile::tempdir().unwrap();
        let mut image = Image::zeros(2, 1, 4);
        image.data.copy_from_slice(&[3.0, 2.0, 1.0, 1.0, 0.1, 0.2, 0.05, 0.5]);
        let file = dir.path().join("a.exr");
        assert_eq!(save(&file, &image, None).unwrap(), None);
        let read = photo::load_full(&file).unwrap();
        assert_eq!(read.channels(), 4);
        save(&dir.path().join("a.png"), &image, Some(0.0)).unwrap();
        let png = photo::load(&dir.path().join("a.png")).unwrap();
        // Straight: 0.2 and 0.4 in linear light.
        assert_eq!(png.pixel(1, 0), &[124, 170, 89, 128]);
        assert!(save(&dir.path().join("a.bmp"), &image, None).unwrap_err().to_string().contains(".png"));
    }
}
