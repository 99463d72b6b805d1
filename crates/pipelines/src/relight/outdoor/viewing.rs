//! Runs of the scene model in the viewer: layers under the light of a session, of an environment map or of a clear sky.

use super::model::SceneModel;
use super::pictures::{self, Layer};
use super::render::{SceneView, ViewLight};
use crate::error::{PipelineError, Result};
use crate::relight::light::{LightOptions, Source};
use crate::run::viewing::{RunView as AnyRunView, ViewedModel};
use diorama_engine::renderers::volume::Quality;
use diorama_engine::train::Origin;
use diorama_geom::daylight::{Daylight, Sun};
use diorama_geom::glam::{DMat3, DVec3};
use diorama_geom::sky::Sky;
use diorama_geom::view_controls::{ControlInput, ControlValues, ViewControl, ViewLayer};
use diorama_geom::view_source::{MeshRequest, ViewRequest};
use diorama_geom::{Capture, ImageU8};
use diorama_kernels::ops::ray_generation::PosedCamera;
use std::f64::consts::PI;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// A run of the scene model in the viewer.
pub type RunView = AnyRunView<ViewedScene>;

/// Rows of the map of a clear sky.
const SKY_ROWS: usize = 32;
/// Factor from the radiance of a sky to photographs in which a sunlit white surface is about white.
const SKY_STRENGTH: f64 = 0.02;
/// Option of the light that is a clear sky.
const CLEAR: &str = "sky";
/// Layers that do not depend on light.
const UNLIT: [&str; 3] = ["albedo", "normal", "depth"];

/// A model with the lights that the viewer offers besides those that were learned.
pub struct ViewedScene {
    model: SceneModel,
    maps: Arc<Vec<GivenLight>>,
    /// The last light that was shown, and the controls that describe it.
    lit: Mutex<Option<(ControlValues, Arc<ViewLight>)>>,
}

/// A light of a file, its sun apart.
pub struct GivenLight {
    name: String,
    light: Daylight,
}

/// Lights of files for the viewer, each with its file name, and notes about what was mended in them.
///
/// # Errors
/// When a file is no light.
pub fn read_maps(files: &[PathBuf]) -> Result<(Vec<GivenLight>, Vec<String>)> {
    let (mut maps, mut notes) = (Vec::new(), Vec::new());
    for file in files {
        let (light, of_file) = LightOptions::of(Source::File(file.clone())).read()?;
        let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        maps.push(GivenLight { name, light: light.sun_apart() });
        notes.extend(of_file);
    }
    Ok((maps, notes))
}

/// Opens the view of a run; `running` says whether it trains.
///
/// # Errors
/// When what was saved in the viewer before cannot be read.
pub fn open(run: &Path, model: SceneModel, maps: Vec<GivenLight>, running: bool) -> Result<Arc<RunView>> {
    RunView::new(run, ViewedScene::new(model, Arc::new(maps)), running)
}

impl RunView {
    /// Shows a newer state of a model in training.
    pub fn show_model(&self, model: SceneModel) {
        let maps = self.model().maps.clone();
        self.show(ViewedScene::new(model, maps));
    }
}

impl ViewedScene {
    fn new(model: SceneModel, maps: Arc<Vec<GivenLight>>) -> ViewedScene {
        ViewedScene { model, maps, lit: Mutex::default() }
    }

    /// The light that the controls describe, found anew only where they changed.
    fn lit(&self, values: &ControlValues) -> Arc<ViewLight> {
        let mut lit = self.lit.lock().expect("no other thread fails with it");
        match &*lit {
            Some((of, light)) if of == values => light.clone(),
            _ => lit.insert((values.clone(), Arc::new(self.light(values)))).1.clone(),
        }
    }

    /// Options of the light: what was learned, maps, a clear sky.
    fn lights(&self) -> Vec<(String, String)> {
        let m = &self.model;
        let learned = (0..m.light_count()).map(|i| (format!("learned:{i}"), m.light_name(i)));
        let maps = self.maps.iter().enumerate().map(|(i, map)| (format!("map:{i}"), map.name.clone()));
        learned.chain(maps).chain([(CLEAR.to_string(), "Clear sky".to_string())]).collect()
    }

    /// The light that the controls describe.
    fn light(&self, values: &ControlValues) -> ViewLight {
        let m = &self.model;
        let (rotate, strength) = (values.number("rotate").to_radians(), values.number("strength"));
        let turn = DMat3::from_rotation_z(rotate);
        let (elevation, azimuth) = (values.number("sun_elevation").to_radians(), values.number("sun_azimuth").to_radians());
        let added = [values.number("sun_power"); 3];
        let added = (added[0] > 0.0).then(|| (Sky::clear(elevation, azimuth).sun(), added));
        let choice = values.choice("light");
        let number = |prefix: &str| choice.strip_prefix(prefix).and_then(|i| i.parse::<usize>().ok());
        match (number("learned:"), number("map:")) {
            (Some(i), _) => {
                let mut light = ViewLight::learned(m, i);
                light.light = light.light.rotated(turn).scaled(strength);
                light.sky.iter_mut().for_each(|v| *v *= strength as f32);
                match (&mut light.sun, added) {
                    (Some(sun), _) => {
                        let (direction, irradiance) =
                            added.unwrap_or((turn * DVec3::new(sun[0] as f64, sun[1] as f64, sun[2] as f64), [0.0; 3]));
                        sun[..3].copy_from_slice(&direction.as_vec3().to_array());
                        sun[3..].iter_mut().for_each(|v| *v *= strength as f32);
                        if added.is_some() {
                            (0..3).for_each(|k| sun[3 + k] = (irradiance[k] / PI) as f32);
                        }
                    }
                    (None, Some((direction, irradiance))) => light.light.add_sun(direction, irradiance),
                    (None, None) => {}
                }
                light
            }
            (None, Some(i)) => {
                let mut light = self.maps[i].light.clone().turned(rotate, strength);
                if let Some((direction, irradiance)) = added {
                    light.sun = Some(Sun { direction, diameter: Sky::SUN_DIAMETER, irradiance });
                }
                ViewLight::of_daylight(m, &light, [1.0; 3])
            }
            (None, None) => {
                let sky = Daylight::clear(&Sky::clear(elevation, azimuth), SKY_ROWS);
                ViewLight::of_daylight(m, &sky.turned(rotate, SKY_STRENGTH * strength), [1.0; 3])
            }
        }
    }

    fn posed(&self, r: &ViewRequest) -> PosedCamera {
        PosedCamera { camera: r.camera, pose: self.model.model_from_world.pose(&r.world_from_camera) }
    }

    /// All layers of a view.
    fn draw(&self, r: &ViewRequest) -> SceneView {
        let m = &self.model;
        let mut tracer = m.tracer(Quality::Full);
        let corner = |c: [f32; 3]| m.model_from_world.point(DVec3::from(c.map(f64::from))).as_vec3().to_array();
        tracer.clip = r.clip.map(|(low, high)| (corner(low), corner(high)));
        m.view_with(tracer, &self.posed(r), &self.lit(&r.values), &mut |_| {})
    }
}

impl ViewedModel for ViewedScene {
    const FIGURES: &'static [(&'static str, &'static str)] = &[("loss", "Loss"), ("psnr", "PSNR"), ("rays_per_s", "Rays")];
    const CHARTS: &'static [(&'static str, &'static str)] = &[("psnr", "PSNR")];

    fn capture(&self) -> &Capture {
        &self.model.capture
    }

    fn origin(&self) -> Origin {
        self.model.origin
    }

    fn layers(&self) -> Vec<ViewLayer> {
        let dark_to_light = [[0; 3], [255; 3]];
        vec![
            ViewLayer::new("rgb", "Color"),
            ViewLayer::new("albedo", "Albedo"),
            ViewLayer::new("normal", "Normals").with_classes(&[("x", [255, 128, 128]), ("y", [128, 255, 128]), ("z", [128, 128, 255])]),
            ViewLayer::new("shadow", "Shadow").with_scale(&dark_to_light, "shadow", "lit", ""),
            ViewLayer::new("irradiance", "Light"),
            ViewLayer::new("depth", "Depth").with_scale(&dark_to_light, "near", "far", ""),
        ]
    }

    fn controls(&self) -> Vec<ViewControl> {
        let lit: Vec<String> = self.layers().into_iter().map(|l| l.id).filter(|id| !UNLIT.contains(&&id[..])).collect();
        let control = |id: &str, label: &str, help: &str, input| ViewControl {
            id: id.into(),
            label: label.into(),
            help: help.into(),
            layers: lit.clone(),
            input,
        };
        let slider = |min, max, step, unit: &str, default| ControlInput::Slider { min, max, step, unit: unit.into(), default };
        let options = self.lights();
        let default = options[0].0.clone();
        vec![
            control(
                "light",
                "Light",
                "Learned from photographs, an environment map (view --light FILE), or a clear sky",
                ControlInput::Pick { options, default },
            ),
            control("rotate", "Rotation", "Turn of the light about the vertical", slider(-180.0, 180.0, 1.0, "°", 0.0)),
            control("strength", "Strength", "Factor of the light", slider(0.0, 4.0, 0.05, "", 1.0)),
            control("sun_azimuth", "Sun azimuth", "Of the clear sky's sun or the added one", slider(-180.0, 180.0, 1.0, "°", 140.0)),
            control("sun_elevation", "Sun elevation", "Height of the sun above the horizon", slider(0.0, 90.0, 1.0, "°", 35.0)),
            control(
                "sun_power",
                "Added sun",
                "Irradiance of a sun besides a learned light or in place of its sun",
                slider(0.0, 6.0, 0.1, "", 0.0),
            ),
        ]
    }

    fn view(&self, r: &ViewRequest) -> Result<ImageU8> {
        let layer = r.layer.parse::<Layer>().map_err(PipelineError::Usage)?;
        let view = self.draw(r);
        Ok(pictures::shown(pictures::layer_of(&view, layer), layer).to_u8())
    }

    fn point(&self, one_pixel: &ViewRequest) -> Option<[f64; 3]> {
        let (posed, view) = (self.posed(one_pixel), self.draw(one_pixel));
        let is_surface = view.opacity.data[0] > 0.5;
        let along = posed.camera.direction(0.5, 0.5) * view.depth.data[0] as f64;
        is_surface.then(|| self.model.model_from_world.inverse().point(posed.pose.point(along)).to_array())
    }

    fn export(&self, run: &Path, _: &MeshRequest, _: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64)> {
        let what = format!("meshes of this run are made by `diorama relight mesh {}`", run.display());
        Err(PipelineError::Usage(what))
    }
}
