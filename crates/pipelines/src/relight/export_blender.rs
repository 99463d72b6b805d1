//! Writes a composition as a folder that Blender opens: `scene.glb`, `light.exr`, `scene.json`, and `scene.py`, which puts them together.

use super::compose::Composition;
use super::scene_file::{Backplate, SceneFile};
use crate::error::{PipelineError, Result};
use diorama_data::gltf::{self, WriteOptions};
use diorama_data::{DataError, atomic, environment, process};
use diorama_geom::Model;
use diorama_geom::camera::Lens;
use diorama_geom::daylight::Daylight;
use diorama_kernels::ops::path_trace::View;
use serde_json::{Value, json};
use std::path::Path;

/// Width of the camera's film in millimeters, as `ThinLens::of_f_stop` takes it.
const FILM_MM: f64 = 36.0;

/// Writes the folder and returns notes about what Blender cannot show.
///
/// # Errors
/// When the folder holds files and `force` is not given, the camera has no Blender counterpart, or a file cannot be written.
pub fn write(folder: &Path, c: &Composition, file: &SceneFile, force: bool) -> Result<Vec<String>> {
    if !force && std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some()) {
        return Err(PipelineError::Usage(format!("{}: holds files; give --force to replace an earlier export", folder.display())));
    }
    let mut notes = Vec::new();
    match c.view.camera.lens {
        Lens::Pinhole => {}
        Lens::Equirectangular => {
            return Err(PipelineError::Usage("camera: a panorama has no counterpart in the export to Blender; give eye and target".into()));
        }
        _ => notes.push("the distortion of the photograph's lens is left out of the export to Blender".to_string()),
    }
    if file.render.backplate == Backplate::Photo {
        notes.push("the photograph and its shadow catcher are left out of the export to Blender".to_string());
    }
    // Blender knows materials by their names.
    let mut named = c.model.clone();
    named.materials.iter_mut().enumerate().for_each(|(i, m)| m.name = format!("{i} {}", m.name).trim().to_string());
    let description = describe(c, &named, file);
    let model = folder.join("scene.glb");
    let glb = gltf::encode(&named, WriteOptions::default(), &model)?;
    std::fs::create_dir_all(folder).map_err(DataError::io(folder, "create"))?;
    atomic::write(&model, &glb)?;
    let mut still = c.light.environment.clone();
    (still.turn, still.strength) = (0.0, 1.0);
    environment::save_exr(&folder.join("light.exr"), &still)?;
    atomic::write(&folder.join("scene.json"), format!("{description:#}\n").as_bytes())?;
    atomic::write(&folder.join("scene.py"), include_bytes!("blender_scene.py"))?;
    Ok(notes)
}

/// Everything that `scene.py` reads; positions have z up, as in Blender.
fn describe(c: &Composition, model: &Model, file: &SceneFile) -> Value {
    let specular: serde_json::Map<String, Value> = model.materials.iter().map(|m| (m.name.clone(), m.specular.into())).collect();
    json!({
        "model": "scene.glb",
        "specular": specular,
        "size": [c.view.camera.width, c.view.camera.height],
        "spp": file.render.spp,
        "seed": file.render.seed,
        "bounces": c.settings.bounces,
        "transparent": !c.settings.shows_light,
        "exposure": file.render.exposure.unwrap_or(0.0),
        "camera": camera(&c.view, file.camera.f_stop),
        "light": light(&c.light),
    })
}

fn camera(view: &View, f_stop: Option<f64>) -> Value {
    let (k, pose) = (&view.camera, view.world_from_camera.flip_y_z());
    let (w, h) = (k.width as f64, k.height as f64);
    let (r, t) = (pose.rotation.transpose(), pose.translation);
    let row = |axis: usize| [r.col(axis).x, r.col(axis).y, r.col(axis).z, t[axis]];
    json!({
        "world_from_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
        "lens_mm": FILM_MM * k.fx / w,
        // In widths of the picture.
        "shift": [(0.5 * w - k.cx) / w, (k.cy - 0.5 * h) / w * (k.fx / k.fy)],
        "pixel_aspect": k.fy / k.fx,
        "f_stop": view.lens.and(f_stop),
        "focus": view.lens.map(|l| l.focus),
    })
}

fn light(light: &Daylight) -> Value {
    json!({
        "file": "light.exr",
        "turn": light.environment.turn,
        "strength": light.environment.strength,
        "sun": light.sun.map(|s| json!({ "direction": s.direction.to_array(), "diameter": s.diameter, "irradiance": s.irradiance })),
    })
}

/// The command that renders an exported folder, and what to install if Blender is not there.
pub fn hint(folder: &Path) -> String {
    let command = |blender: &str| format!("{blender} -b -P {} -- --render picture.exr", folder.join("scene.py").display());
    match process::find("blender", "DIORAMA_BLENDER", "blender.org, or apt-get install blender") {
        Ok(program) => command(&program.display().to_string()),
        Err(e) => format!("{} ({e})", command("blender")),
    }
}
