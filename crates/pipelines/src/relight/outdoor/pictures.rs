//! Pictures of a run: views in their own light or a new one, and their layers.

use super::model::SceneModel;
use super::render::{FineViews, SceneView, ViewLight};
use crate::error::Result;
use crate::relight::light::LightOptions;
use diorama_data::{DataError, photo};
use diorama_geom::Image;
use diorama_geom::capture::Split;
use diorama_geom::color::srgb_from_linear;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

/// Opacity from which a pixel shows a surface.
const SURFACE: f32 = 0.5;

/// A layer of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    Rgb,
    Albedo,
    Normal,
    Shadow,
    Irradiance,
    Depth,
}

impl Layer {
    fn name(self) -> &'static str {
        match self {
            Layer::Rgb => "rgb",
            Layer::Albedo => "albedo",
            Layer::Normal => "normal",
            Layer::Shadow => "shadow",
            Layer::Irradiance => "irradiance",
            Layer::Depth => "depth",
        }
    }
}

impl std::str::FromStr for Layer {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Layer, String> {
        let all = [Layer::Rgb, Layer::Albedo, Layer::Normal, Layer::Shadow, Layer::Irradiance, Layer::Depth];
        let found = all.into_iter().find(|l| l.name() == s);
        found.ok_or_else(|| format!("{s:?}: expected {}", all.map(Layer::name).join(", ")))
    }
}

/// What to render and where to put it.
#[derive(Clone, Debug)]
pub struct PicturesOptions {
    /// None: the light that was learned for each view.
    pub light: Option<LightOptions>,
    /// Numbers or names of frames; none: all that were held out.
    pub frames: Vec<String>,
    pub layers: Vec<Layer>,
    /// Rays per pixel and axis.
    pub samples: u32,
    /// Whether pictures are EXR in linear light, or PNG.
    pub is_linear: bool,
    pub out: PathBuf,
}

/// What was rendered.
#[derive(Clone, Debug, Default)]
pub struct Pictures {
    pub pictures: Vec<PathBuf>,
    pub interrupted: bool,
    pub notes: Vec<String>,
}

/// Renders pictures; `progress` gets the share that is done.
///
/// # Errors
/// When a frame does not exist, the light cannot be read, a view has no light of its own, or a file cannot be written.
pub fn render(model: &SceneModel, options: &PicturesOptions, stop: &AtomicBool, progress: &mut dyn FnMut(f64)) -> Result<Pictures> {
    let mut made = Pictures::default();
    let given = match &options.light {
        None => None,
        Some(light) => {
            let (daylight, notes) = light.read()?;
            made.notes = notes;
            Some(ViewLight::of_daylight(model, &daylight.sun_apart(), [1.0; 3]))
        }
    };
    let frames = if options.frames.is_empty() { model.capture.indices(Split::Test) } else { named(model, &options.frames)? };
    if frames.is_empty() {
        return Err(DataError::input(&model.config.data.path, "no photographs were held out; name some with --frame").into());
    }
    let own = match &given {
        Some(_) => Vec::new(),
        None => frames.iter().map(|f| own_light(model, *f)).collect::<Result<Vec<_>>>()?,
    };
    let mut fine = FineViews::new(model, options.samples)?;
    std::fs::create_dir_all(&options.out).map_err(DataError::io(&options.out, "create"))?;
    for (i, frame) in frames.iter().enumerate() {
        let light = given.as_ref().unwrap_or_else(|| &own[i]);
        let view = fine.view(&model.posed(*frame), light);
        let title = model.capture.frames[*frame].name.replace(['/', '\\'], "_");
        for layer in &options.layers {
            let extension = if options.is_linear { "exr" } else { "png" };
            let file = options.out.join(format!("{title}_{}.{extension}", layer.name()));
            let image = &matter(&view, *layer);
            match options.is_linear {
                true => photo::save_exr(&file, &three_channels(image))?,
                false => photo::save_png(&file, &shown(image, *layer).to_u8())?,
            }
            made.pictures.push(file);
        }
        progress((i + 1) as f64 / frames.len() as f64);
        if stop.load(Ordering::Relaxed) && i + 1 < frames.len() {
            made.interrupted = true;
            break;
        }
    }
    Ok(made)
}

fn named(model: &SceneModel, names: &[String]) -> Result<Vec<usize>> {
    let frames = &model.capture.frames;
    let find = |name: &String| {
        let found = match name.parse::<usize>() {
            Ok(i) => (i < frames.len()).then_some(i),
            Err(_) => frames.iter().position(|f| f.name == *name || f.name.rsplit('/').next() == Some(name)),
        };
        let what = || DataError::input(&model.config.data.path, format!("--frame {name}: there are {} frames, from 0 on", frames.len()));
        Ok(found.ok_or_else(what)?)
    };
    names.iter().map(find).collect()
}

fn own_light(model: &SceneModel, frame: usize) -> Result<ViewLight> {
    let own = model.light_of_frame(frame).ok_or_else(|| {
        let name = &model.capture.frames[frame].name;
        DataError::input(&model.config.data.path, format!("{name}: its light was not trained on; give --light"))
    })?;
    Ok(ViewLight::learned(model, own))
}

pub(super) fn layer_of(view: &SceneView, layer: Layer) -> &Image {
    match layer {
        Layer::Rgb => &view.color,
        Layer::Albedo => &view.albedo,
        Layer::Normal => &view.normal,
        Layer::Shadow => &view.shadow,
        Layer::Irradiance => &view.irradiance,
        Layer::Depth => &view.depth,
    }
}

fn three_channels(image: &Image) -> Image {
    match image.channels {
        3 => image.clone(),
        _ => Image { width: image.width, height: image.height, channels: 3, data: image.data.iter().flat_map(|v| [*v; 3]).collect() },
    }
}

/// A layer that is 0 where a view shows no surface; the picture shows the sky there.
fn matter(view: &SceneView, layer: Layer) -> Image {
    let mut image = layer_of(view, layer).clone();
    if layer != Layer::Rgb {
        let pixels = image.data.chunks_exact_mut(image.channels).zip(&view.opacity.data);
        pixels.filter(|(_, o)| **o < SURFACE).for_each(|(p, _)| p.fill(0.0));
    }
    image
}

/// Values between 0 and 1 as people look at them, `[H, W, 3]`: light along the sRGB curve, normals from −1 on, depth by its largest value.
pub(super) fn shown(image: &Image, layer: Layer) -> Image {
    let mut image = three_channels(image);
    let largest = image.data.iter().copied().fold(1e-6, f32::max);
    image.data.iter_mut().for_each(|v| {
        *v = match layer {
            Layer::Normal => 0.5 * *v + 0.5,
            Layer::Shadow => *v,
            Layer::Depth => *v / largest,
            _ => srgb_from_linear(v.clamp(0.0, 1.0)),
        }
    });
    image
}
