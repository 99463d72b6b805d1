//! Memory that training and export will take, compared with what the machine has before they begin. Only certain needs are counted, so
//! that nothing is refused that would fit.

use super::config::{Auto, Config, Method};
use super::device;
use super::field_shape;
use super::model::ObjectModel;
use crate::error::{PipelineError, Result};
pub use crate::run::memory::{available, size};
use diorama_data::pixel_store;
use diorama_engine::samplers::stereo;
use diorama_geom::capture::Split;
use diorama_geom::{Capture, PixelFormat};
use diorama_kernels::ops::hash_grid::HashGrid;
use diorama_mesh::extract::Grid;

/// Bytes per pixel of a photograph while it is decoded: as the file has it, as RGBA, reduced; beyond 8 bits in floats.
const DECODED: u64 = 8;
const DECODED_IN_FLOATS: u64 = 32;
/// Bytes per sample of a step of `ngp`: encoded, through the network and back.
const SAMPLE: u64 = 1024;
/// Bytes per square cell of the grid's side, of a surface that crosses the grid a few times while it is simplified.
const SURFACE: u64 = 1200;
/// Bytes per point of a slice of densities.
const SLICE: u64 = 48;
/// Bytes per texel while a texture is baked, and of a normal map beside it.
const TEXEL: u64 = 64;
const NORMAL_TEXEL: u64 = 24;
/// Share of what is available from which on users are warned.
const TIGHT: f64 = 0.8;

/// Bytes by what takes them, in words.
#[derive(Clone, Debug, PartialEq)]
pub struct Needs(Vec<(&'static str, u64)>);

impl Needs {
    /// All bytes together.
    pub fn total(&self) -> u64 {
        self.0.iter().fold(0, |sum, n| sum.saturating_add(n.1))
    }

    fn of(&self, what: &str) -> u64 {
        self.0.iter().find(|n| n.0 == what).map_or(0, |n| n.1)
    }

    fn largest(&self) -> &'static str {
        self.0.iter().max_by_key(|n| n.1).map_or("", |n| n.0)
    }
}

impl std::fmt::Display for Needs {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let parts: Vec<String> = self.0.iter().filter(|n| n.1 > 0).map(|n| format!("{} {}", n.0, size(n.1))).collect();
        write!(f, "{}", parts.join(", "))
    }
}

/// What training a configuration on a capture takes, whose pixels are kept in `format`, with so many samples in a step.
pub fn of_training(config: &Config, capture: &Capture, format: PixelFormat, samples: usize) -> Needs {
    let train = capture.indices(Split::Train);
    let (mut pixels, mut masks, mut largest) = (0u64, 0u64, 0u64);
    let mut sizes = Vec::new();
    for f in train.iter().map(|&i| &capture.frames[i]) {
        let (w, h) = config.reduction().size((f.camera.width, f.camera.height));
        pixels += w as u64 * h as u64;
        sizes.push((w, h));
        masks += if f.mask.is_some() { w as u64 * h as u64 } else { 0 };
        largest = largest.max(f.camera.width as u64 * f.camera.height as u64);
    }
    let bytes = pixels * format.bytes() as u64;
    let kept = bytes.min(config.data.memory_budget);
    let masks = (masks as f64 * kept as f64 / bytes.max(1) as f64) as u64;
    let decoded = if format == PixelFormat::Unorm8 { DECODED } else { DECODED_IN_FLOATS };
    let at_once = (2 * rayon::current_num_threads()).min(train.len()) as u64;
    // Whether photographs are opaque is not known yet; what they need most for is.
    let space = field_shape::space(config, capture, false);
    // Values, gradients and two moments; a checkpoint copies all but the gradients while it is written.
    let parameters = match config.method {
        Method::Ngp => HashGrid::new(field_shape::hash_grid(config, capture, space)).params_len() as u64 * (4 * 4 + 3 * 4),
        _ => 0,
    };
    let cells = (config.sampling.occupancy_resolution as u64).saturating_pow(3).saturating_mul(field_shape::cascades(space) as u64);
    let occupancy = if config.method == Method::Ngp { cells.saturating_mul(9) } else { 0 };
    let batch = if config.method == Method::Ngp { (samples as u64).saturating_mul(SAMPLE) } else { 0 };
    // Whether sparse points tell enough is not known yet.
    let compares = config.method == Method::Ngp && config.loss.depth != Auto::Is(0.0) && config.loss.depth_from != "points";
    Needs(vec![
        ("photographs", kept + masks + at_once * largest * decoded),
        ("parameters", parameters),
        ("occupancy grid", occupancy),
        ("batch", batch),
        ("comparison of photographs", if compares { stereo::bytes(sizes.into_iter()) } else { 0 }),
    ])
}

/// Memory of an export besides the model: a mesh sampled on `grid`, a texture `texels` wide (0: none), and its normal map.
pub fn of_export(model: &ObjectModel, grid: &Grid, texels: usize, normal_map: bool) -> Needs {
    let [nx, ny, nz] = grid.points().map(|n| n as u64);
    let widest = nx.max(ny).max(nz);
    let texels = texels as u64 * texels as u64;
    let cameras = if texels > 0 { model.train.len().min(240) as u64 * (640 * 640 * 4) } else { 0 };
    Needs(vec![
        ("densities", nx * ny * SLICE),
        ("surface", widest * widest * SURFACE),
        ("texture", texels * (TEXEL + if normal_map { NORMAL_TEXEL } else { 0 })),
        ("depth maps", cameras),
    ])
}

/// Compares what training takes with what there is: a note where it is tight.
///
/// # Errors
/// When it does not fit, or a photograph's head cannot be read.
pub fn check_training(config: &Config, capture: &Capture) -> Result<Option<String>> {
    // A GPU that was named keeps its batches itself.
    let on_host = config.device == "cpu" || config.sampling.batch_samples == 0;
    let train: Vec<_> = capture.indices(Split::Train).into_iter().map(|i| &capture.frames[i]).collect();
    let format = pixel_store::format_of(&train)?;
    let needs = of_training(config, capture, format, if on_host { device::batch_samples(config, false) } else { 0 });
    let cure = match needs.largest() {
        "photographs" => format!("--downscale 2, or --set data.memory_budget={}", (needs.of("photographs") / 4).max(1 << 20)),
        "occupancy grid" => "--set sampling.occupancy_resolution=128".into(),
        "batch" => "--set sampling.batch_samples=0".into(),
        _ => format!("--set field.log2_size={}, or fewer field.levels", config.field.log2_size.saturating_sub(2).clamp(4, 19)),
    };
    judge("training", &needs, available()?, &cure)
}

/// Compares what an export takes with what there is: a note where it is tight.
///
/// # Errors
/// When it does not fit.
pub fn check_export(model: &ObjectModel, grid: &Grid, texels: usize, normal_map: bool) -> Result<Option<String>> {
    let needs = of_export(model, grid, texels, normal_map);
    let cure = match needs.largest() {
        "texture" => format!("--texture {}", (texels / 2).max(64)),
        // Only a texture asks the cameras.
        "depth maps" => "--texture 0".into(),
        _ => format!("--resolution {}", (grid.resolution / 2).max(16)),
    };
    judge("the export", &needs, available()?, &cure)
}

/// One line of needs, has and cure: an error where it does not fit, a note where it is tight.
fn judge(what: &str, needs: &Needs, available: Option<u64>, cure: &str) -> Result<Option<String>> {
    let Some(has) = available else { return Ok(None) };
    let total = needs.total();
    let line = format!("{what} needs about {} ({needs}), {} are available", size(total), size(has));
    if total > has {
        return Err(PipelineError::Memory(format!("{line}; try {cure}")));
    }
    Ok((total as f64 > TIGHT * has as f64).then(|| format!("{line}; if it does not fit: {cure}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::object::{quickstart, recipe};

    fn still_life(dir: &std::path::Path, sets: &[(&str, &str)]) -> (Config, Capture) {
        quickstart::write_capture(dir, 8, 24).unwrap();
        let mut c = Config::new(Method::Ngp, dir.into());
        sets.iter().for_each(|(k, v)| c.set(k, v).unwrap());
        let capture = recipe::load_capture(&c).unwrap();
        (c, capture)
    }

    #[test]
    fn what_is_counted_is_what_a_model_has() {
        let dir = tempfile::tempdir().unwrap();
        let (c, capture) = still_life(dir.path(), &[("field.log2_size", "14")]);
        let needs = of_training(&c, &capture, PixelFormat::Unorm8, 9 << 10);
        assert_eq!(needs.of("batch"), 9 << 20);
        let m = ObjectModel::new(c, capture, false).unwrap();
        let table = m.field.encoder.table().unwrap().values.len() as f64 * 28.0;
        let counted = needs.of("parameters") as f64;
        assert!((0.9..1.1).contains(&(counted / table)), "{counted} for {table}");
        let cells = m.occupancy.as_ref().unwrap().grid.density.len() as u64;
        assert!((8 * cells..=12 * cells).contains(&needs.of("occupancy grid")));
    }

    #[test]
    fn photographs_go_by_their_reduced_size_and_the_budget() {
        let dir = tempfile::tempdir().unwrap();
        let (c, mut capture) = still_life(dir.path(), &[]);
        capture.frames.iter_mut().for_each(|f| f.camera = f.camera.resized(4000, 3000));
        let of = |sets: &[(&str, &str)]| {
            let mut c = c.clone();
            sets.iter().for_each(|(k, v)| c.set(k, v).unwrap());
            of_training(&c, &capture, PixelFormat::Unorm8, 0).of("photographs")
        };
        let decoded = of(&[("data.memory_budget", "0")]);
        let n = capture.indices(Split::Train).len() as u64;
        assert_eq!(of(&[]) - decoded, n * 48_000_000);
        assert_eq!(of(&[("data.downscale", "4")]) - decoded, n * 3_000_000);
        assert_eq!(of(&[("data.memory_budget", "1000")]) - decoded, 1000);
        let deep = |budget: &str| {
            let mut c = c.clone();
            c.set("data.memory_budget", budget).unwrap();
            of_training(&c, &capture, PixelFormat::Unorm16, 0).of("photographs")
        };
        assert_eq!(deep("4294967296") - deep("0"), n * 96_000_000, "16 bits take twice as much");
    }

    #[test]
    fn needs_has_and_cure_are_one_line() {
        let needs = Needs(vec![("photographs", 3 << 30), ("batch", 1 << 20)]);
        let Err(PipelineError::Memory(line)) = judge("training", &needs, Some(2 << 30), "--downscale 2") else { panic!("it fits") };
        assert_eq!(line, "training needs about 3.0 GiB (photographs 3.0 GiB, batch 1 MiB), 2.0 GiB are available; try --downscale 2");
        assert!(judge("training", &needs, Some(10 << 30), "").unwrap().is_none());
        assert!(judge("training", &needs, Some(7 << 29), "--downscale 2").unwrap().unwrap().contains("--downscale 2"));
        assert!(judge("training", &needs, None, "").unwrap().is_none());
    }

    #[test]
    fn an_export_grows_with_its_grid_and_its_texture() {
        let dir = tempfile::tempdir().unwrap();
        let (c, capture) = still_life(dir.path(), &[("field.log2_size", "8")]);
        let m = ObjectModel::new(c, capture, false).unwrap();
        let of = |resolution: usize, texels: usize, normal_map: bool| {
            of_export(&m, &Grid { min: [0.0; 3], max: [1.0; 3], resolution }, texels, normal_map)
        };
        let ordinary = of(320, 2048, false);
        assert!((200 << 20..1 << 30).contains(&ordinary.total()), "{ordinary}");
        assert!(of(2048, 0, false).of("surface") > 30 * ordinary.of("surface"));
        assert_eq!(of(320, 16_384, false).largest(), "texture");
        assert!(of(320, 2048, true).total() > ordinary.total());
    }
}
