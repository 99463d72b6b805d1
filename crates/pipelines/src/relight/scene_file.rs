//! `scene.toml`: which models stand where, under which light, seen by which camera. Its world is y up, as glTF's.

use crate::error::Result;
use crate::run::config::nearest;
use diorama_data::{DataError, error};
use serde::Deserialize;
use std::path::{Path, PathBuf};

const LIMIT: u64 = 1 << 20;

/// A composition.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneFile {
    #[serde(default)]
    pub scene: Option<Place>,
    /// `[[object]]`
    #[serde(default, rename = "object")]
    pub objects: Vec<Object>,
    #[serde(default)]
    pub light: Light,
    pub camera: CameraPart,
    #[serde(default)]
    pub render: Render,
}

/// What objects stand in.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Place {
    pub mesh: PathBuf,
}

/// A model, and where it stands.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Object {
    pub mesh: PathBuf,
    #[serde(default)]
    pub translate: [f64; 3],
    /// About the fixed axes x, y and z, in this order.
    #[serde(default)]
    pub rotate_deg: [f64; 3],
    #[serde(default = "one")]
    pub scale: f64,
    #[serde(default)]
    pub snap: Snap,
    /// Whether the object may stand in the scene's surfaces.
    #[serde(default)]
    pub overlap: bool,
}

/// How an object's height is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Snap {
    /// As `translate` says.
    #[default]
    None,
    /// Its lowest point is moved onto the scene below its center.
    Ground,
}

/// Distant light: one of `hdri` and `sky`, else uniform light.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Light {
    #[serde(default)]
    pub hdri: Option<PathBuf>,
    #[serde(default)]
    pub sky: Option<SkyPart>,
    #[serde(default)]
    pub rotate_deg: f64,
    #[serde(default = "one")]
    pub strength: f64,
}

impl Default for Light {
    fn default() -> Light {
        Light { hdri: None, sky: None, rotate_deg: 0.0, strength: 1.0 }
    }
}

/// A clear sky; angles in degrees.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SkyPart {
    pub elevation: f64,
    #[serde(default)]
    pub rotation: f64,
    #[serde(default = "one")]
    pub intensity: f64,
}

/// A camera: a frame of a run's capture, or eye and target.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraPart {
    /// `RUN:NUMBER` or `RUN:NAME`.
    #[serde(default)]
    pub frame: Option<String>,
    #[serde(default)]
    pub eye: Option<[f64; 3]>,
    #[serde(default)]
    pub target: Option<[f64; 3]>,
    /// What this camera photographed, with eye and target.
    #[serde(default)]
    pub photograph: Option<PathBuf>,
    /// Horizontal.
    #[serde(default = "field_of_view")]
    pub fov_deg: f64,
    /// None: everything is sharp.
    #[serde(default)]
    pub f_stop: Option<f64>,
    #[serde(default)]
    pub focus: Option<Focus>,
}

/// What is sharp: a distance, or an object as `object:NUMBER`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged)]
pub enum Focus {
    Distance(f64),
    Object(String),
}

/// How the picture is rendered.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Render {
    /// None: of the camera's frame, else 960 × 540.
    #[serde(default)]
    pub size: Option<[u32; 2]>,
    #[serde(default = "samples")]
    pub spp: u32,
    #[serde(default)]
    pub denoise: Denoise,
    #[serde(default)]
    pub backplate: Backplate,
    #[serde(default = "bounces")]
    pub bounces: u32,
    /// Stops by which pictures other than EXR are brightened; none: such that the brightest twentieth is nearly white.
    #[serde(default)]
    pub exposure: Option<f64>,
    #[serde(default)]
    pub seed: u64,
}

impl Default for Render {
    fn default() -> Render {
        Render {
            size: None,
            spp: samples(),
            denoise: Denoise::Off,
            backplate: Backplate::Light,
            bounces: bounces(),
            exposure: None,
            seed: 0,
        }
    }
}

/// Noise removal after rendering.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Denoise {
    #[default]
    Off,
    /// Edge-avoiding wavelets guided by albedo and normals.
    Atrous,
}

/// What is behind the objects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backplate {
    /// The rendered scene and the light.
    #[default]
    Light,
    /// The photograph of the camera, changed by the objects' shadows and reflections.
    Photo,
    /// Nothing: transparent.
    None,
}

fn one() -> f64 {
    1.0
}

fn field_of_view() -> f64 {
    50.0
}

fn samples() -> u32 {
    256
}

fn bounces() -> u32 {
    8
}

/// Reads a composition; paths in it become relative to the folder that the program runs in.
///
/// # Errors
/// When the file is no TOML or a key or value is wrong: the message names the line, and the nearest key to an unknown one.
pub fn read(path: &Path) -> Result<SceneFile> {
    let bytes = error::read(path, LIMIT)?;
    let text = String::from_utf8(bytes).map_err(|_| DataError::input(path, "is not UTF-8 text"))?;
    let mut file: SceneFile = toml::from_str(&text).map_err(|e| DataError::input(path, explain(&text, &e)))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let meshes = file.scene.iter_mut().map(|s| &mut s.mesh).chain(file.objects.iter_mut().map(|o| &mut o.mesh));
    meshes.chain(&mut file.light.hdri).chain(&mut file.camera.photograph).for_each(|p| *p = folder.join(&*p));
    if let Some((run, frame)) = file.camera.frame.as_deref().and_then(|f| f.rsplit_once(':')) {
        file.camera.frame = Some(format!("{}:{frame}", folder.join(run).display()));
    }
    let faulty = |(table, nth, key, message): Fault| {
        let (line, dot) = (line_of(&text, table, nth, key), if key.is_empty() { "" } else { "." });
        let line = line.map_or(String::new(), |i| format!("line {i}: "));
        DataError::input(path, format!("{line}{table}{dot}{key}: {message}"))
    };
    check(&file).map_err(faulty)?;
    missing(&file).map_or(Ok(file), |f| Err(faulty(f).into()))
}

/// Table, which of its name, key in it, and what is wrong.
type Fault = (&'static str, usize, &'static str, String);

/// The line of a key of the `nth` table of a name, or else of the table, from 1 on.
fn line_of(text: &str, table: &str, nth: usize, key: &str) -> Option<usize> {
    let name = |l: &str| l.trim().trim_start_matches('[').split(']').next().unwrap_or_default().trim().to_string();
    let lines: Vec<&str> = text.lines().collect();
    let is_head = |l: &&str| l.trim_start().starts_with('[');
    let heads = lines.iter().enumerate().filter(|(_, l)| is_head(l) && name(l) == table);
    let head = heads.map(|(i, _)| i).nth(nth)?;
    let within = lines[head + 1..].iter().take_while(|l| !is_head(l));
    let is_key = |l: &&str| l.split('=').next().is_some_and(|k| k.trim() == key) && l.contains('=');
    Some(within.into_iter().position(is_key).map_or(head, |i| head + 1 + i) + 1)
}

/// The first file that a description names and that is not there.
fn missing(file: &SceneFile) -> Option<Fault> {
    let scene = file.scene.iter().map(|s| ("scene", 0, "mesh", &s.mesh));
    let objects = file.objects.iter().enumerate().map(|(i, o)| ("object", i, "mesh", &o.mesh));
    let light = file.light.hdri.iter().map(|p| ("light", 0, "hdri", p));
    let photograph = file.camera.photograph.iter().map(|p| ("camera", 0, "photograph", p));
    let mut all = scene.chain(objects).chain(light).chain(photograph);
    let (table, nth, key, path) = all.find(|f| !f.3.is_file())?;
    let of = if table == "object" { format!("object {nth}: ") } else { String::new() };
    Some((table, nth, key, format!("{of}there is no such file as {}", path.display())))
}

/// The error in one line: where, what, and the nearest key to an unknown one.
fn explain(text: &str, error: &toml::de::Error) -> String {
    let line = error.span().map(|s| text[..s.start.min(text.len())].matches('\n').count() + 1);
    let message = error.message().lines().next().unwrap_or_default();
    let quoted: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
    let message = match (message.starts_with("unknown field"), &quoted[..]) {
        (true, [key, known @ ..]) if !known.is_empty() => {
            let known: Vec<String> = known.iter().map(|k| k.to_string()).collect();
            format!("unknown key {key}; did you mean {}?", nearest(key, &known))
        }
        _ => message.to_string(),
    };
    line.map_or(message.clone(), |l| format!("line {l}: {message}"))
}

/// What no type says.
fn check(file: &SceneFile) -> std::result::Result<(), Fault> {
    let fault = |key: &'static str, message: &str| {
        let (table, key) = key.split_once('.').unwrap_or((key, ""));
        Err((table, 0, key, message.to_string()))
    };
    let positive = |v: f64| v.is_finite() && v > 0.0;
    if file.scene.is_none() && file.objects.is_empty() {
        return fault("object", "nothing to render; add [scene] or [[object]] with a mesh");
    }
    for (i, o) in file.objects.iter().enumerate() {
        if !positive(o.scale) {
            return Err(("object", i, "scale", "must be a number above 0".into()));
        }
        if o.snap == Snap::Ground && file.scene.is_none() {
            return Err(("object", i, "snap", "there is no [scene] to stand on".into()));
        }
    }
    if file.light.hdri.is_some() && file.light.sky.is_some() {
        return fault("light.hdri", "give hdri or sky, not both");
    }
    let c = &file.camera;
    match (&c.frame, c.eye, c.target) {
        (Some(_), None, None) | (None, Some(_), Some(_)) => {}
        (Some(_), ..) => return fault("camera.frame", "give frame, or eye and target"),
        _ => return fault("camera", "give eye and target, or frame = \"RUN:NUMBER\""),
    }
    if c.photograph.is_some() && c.frame.is_some() {
        return fault("camera.photograph", "the frame has a photograph of its own; give one of them");
    }
    if c.eye.is_some() && c.eye == c.target {
        return fault("camera.target", "is where the eye is");
    }
    if !(c.fov_deg > 0.0 && c.fov_deg < 179.0) {
        return fault("camera.fov_deg", "must lie between 0 and 179");
    }
    if c.f_stop.is_some_and(|f| !positive(f)) {
        return fault("camera.f_stop", "must be a number above 0");
    }
    match &c.focus {
        Some(Focus::Distance(d)) if !positive(*d) => return fault("camera.focus", "must be a distance above 0 or \"object:NUMBER\""),
        Some(Focus::Object(name)) if object_of(name).is_none_or(|i| i >= file.objects.len()) => {
            return Err(("camera", 0, "focus", format!("{name:?}: expected object:NUMBER below {}", file.objects.len())));
        }
        _ => {}
    }
    if file.render.size.is_some_and(|[w, h]| w == 0 || h == 0 || w > 16384 || h > 16384) {
        return fault("render.size", "width and height must lie between 1 and 16384");
    }
    if file.render.spp == 0 || file.render.bounces == 0 {
        return fault("render.spp", "spp and bounces must be at least 1");
    }
    if file.render.backplate == Backplate::Photo && (c.frame.is_none() && c.photograph.is_none() || file.scene.is_none()) {
        return fault("render.backplate", "a photograph needs camera.frame or camera.photograph, and [scene] to catch shadows");
    }
    Ok(())
}

/// The number in `object:NUMBER`.
pub fn object_of(name: &str) -> Option<usize> {
    name.strip_prefix("object:")?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHOLE: &str = r#"
[scene]
mesh = "site.glb"
[[object]]
mesh = "chair.glb"
translate = [1.2, 0, -3]
rotate_deg = [0, 35, 0]
scale = 0.8
snap = "ground"
[light]
hdri = "dusk.hdr"
rotate_deg = 40
strength = 1.5
[camera]
eye = [0, 1.6, 4]
target = [0, 1, 0]
f_stop = 2.8
focus = "object:0"
[render]
size = [1920, 1080]
spp = 4096
denoise = "atrous"
"#;

    fn fault(text: &str) -> String {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("scene.toml");
        std::fs::write(&file, text).unwrap();
        let e = read(&file).unwrap_err();
        assert!(e.is_input());
        let text = e.to_string();
        assert!(!text.contains('\n') && text.contains("scene.toml"), "{text}");
        text
    }

    #[test]
    fn a_whole_file_is_read_and_its_paths_are_relative_to_it() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("scene.toml");
        std::fs::write(&file, WHOLE).unwrap();
        let e = read(&file).unwrap_err().to_string();
        assert!(e.contains("line 3: scene.mesh") && e.contains("site.glb"), "{e}");
        ["site.glb", "chair.glb", "dusk.hdr"].iter().for_each(|f| std::fs::write(dir.path().join(f), b"").unwrap());
        let s = read(&file).unwrap();
        assert_eq!(s.objects[0].mesh, dir.path().join("chair.glb"));
        assert_eq!((s.objects[0].snap, s.render.denoise, s.render.size), (Snap::Ground, Denoise::Atrous, Some([1920, 1080])));
        assert_eq!((s.light.strength, s.camera.focus), (1.5, Some(Focus::Object("object:0".into()))));
    }

    #[test]
    fn wrong_keys_and_values_name_the_line_and_the_cure() {
        let e = fault(&WHOLE.replace("f_stop", "fstop"));
        assert!(e.contains("line 17") && e.contains("did you mean f_stop?"), "{e}");
        let e = fault(&WHOLE.replace("[render]", "[rendr]"));
        assert!(e.contains("line 19") && e.contains("did you mean render?"), "{e}");
        let e = fault(&WHOLE.replace("snap = \"ground\"", "snap = \"floor\""));
        assert!(e.contains("line 9") && e.contains("ground"), "{e}");
        let e = fault(&WHOLE.replace("spp = 4096", "spp = \"many\""));
        assert!(e.contains("line 21"), "{e}");
        let e = fault(&WHOLE.replace("object:0", "object:3"));
        assert!(e.contains("line 18") && e.contains("below 1"), "{e}");
        let e = fault(&WHOLE.replace("scale = 0.8", "scale = -1"));
        assert!(e.contains("line 8") && e.contains("above 0"), "{e}");
        let e = fault(&format!("{WHOLE}[[object]]\nmesh = \"chair.glb\"\nscale = 0\n"));
        assert!(e.contains("line 25") && e.contains("object.scale"), "{e}");
        let e = fault(&WHOLE.replace("eye = [0, 1.6, 4]", ""));
        assert!(e.contains("eye and target"), "{e}");
        let e = fault(&WHOLE.replace("spp = 4096", "backplate = \"photo\""));
        assert!(e.contains("camera.frame"), "{e}");
        let e = fault("[camera]\neye = [1, 0, 0]\ntarget = [0, 0, 0]\n");
        assert!(e.contains("nothing to render"), "{e}");
    }
}
