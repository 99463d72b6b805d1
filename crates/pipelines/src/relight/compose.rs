//! Renders a composition: models in a scene under one light, or before a photograph that receives their shadows.

use super::light::{LightOptions, Source};
use super::path_tracer::PathTracer;
use super::picture::{self, Job};
use super::scene_file::{Backplate, Denoise, Focus, SceneFile, Snap, object_of};
use crate::error::{PipelineError, Result};
use crate::run::{RunDescription, kept_capture};
use diorama_data::{DataError, model_file, photo};
use diorama_geom::daylight::Daylight;
use diorama_geom::glam::{DAffine3, DMat3, DVec3};
use diorama_geom::model::Instance;
use diorama_geom::{Camera, Image, Mesh, Model, Pose};
use diorama_kernels::ops::denoise;
use diorama_kernels::ops::path_trace::{Film, Scene, Settings, ThinLens, View, cpu};
use diorama_mesh::{clean, repair};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Lowest share of an object that may be in the ground.
const FOOT: f64 = 0.02;
/// Share of an object's edges that may cross the scene's surfaces.
const PIERCED: f64 = 0.02;
/// Edges of the scene, once for each of their triangles, that may cross an object: specks of photographed scenes do.
const PIERCING: usize = 4;
/// Winding number of a closed surface around what is inside of it, with room for holes.
const ENCLOSED: f64 = 0.75;
/// Edges that are tested.
const EDGES: usize = 4000;
/// Largest change of a photograph by light that objects throw onto it.
const MOST: f32 = 4.0;

/// From glTF's world (y up) to ours (z up).
pub const Z_UP: DMat3 = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y);

/// A composition that is ready to be rendered.
pub struct Composition {
    pub model: Model,
    /// Instances of the place that objects stand in; those of the objects follow.
    pub place: usize,
    pub scene: Scene,
    pub view: View,
    pub light: Daylight,
    pub settings: Settings,
    /// Photograph behind the objects, `[H, W, 3]`, linear.
    pub photograph: Option<Image>,
    /// What was mended or skipped, one line each.
    pub notes: Vec<String>,
    key: String,
}

/// A rendered composition.
pub struct Composed {
    /// Linear, premultiplied, `[H, W, 4]`.
    pub rgba: Image,
    pub film: Film,
    pub interrupted: bool,
}

/// Loads everything that a composition names.
///
/// # Errors
/// When a file is missing or wrong, an object stands in a wall or above nothing, or the camera's frame does not exist.
pub fn load(file: &SceneFile) -> Result<Composition> {
    let mut notes = Vec::new();
    let mut read = |path: &Path| -> Result<Model> {
        let read = model_file::read(path)?;
        notes.extend(read.notes);
        Ok(read.model)
    };
    let mut model = file.scene.as_ref().map(|s| read(&s.mesh)).transpose()?.unwrap_or_default();
    let place = model.instances.len();
    let ground = Scene::new(&model, &LightOptions::of(Source::Uniform(1.0)).read()?.0);
    let mut objects = Vec::new();
    for (i, o) in file.objects.iter().enumerate() {
        let object = read(&o.mesh)?;
        let mut stands = placement(o.translate, o.rotate_deg, o.scale);
        let mut placed = Model::default();
        placed.add(object, stands);
        if o.snap == Snap::Ground {
            let drop = height_above_ground(&ground, &placed).ok_or_else(|| {
                let message = format!("object {i}: there is no ground below it; change translate, or leave out snap");
                DataError::input(&o.mesh, message)
            })?;
            stands = DAffine3::from_translation(DVec3::new(0.0, 0.0, -drop));
            let mut lowered = Model::default();
            lowered.add(placed, stands);
            placed = lowered;
        }
        if !o.overlap {
            let cure = "change translate, or set overlap = true";
            let refused = |what: String| Err(DataError::input(&o.mesh, format!("object {i} stands in the scene: {what}; {cure}")).into());
            let share = pierced(&ground, &placed);
            if share > PIERCED {
                return refused(format!("{:.0} % of its edges cross surfaces", 100.0 * share));
            }
            let through = piercing(&model, place, &placed)?;
            if through > PIERCING {
                return refused(format!("{through} edges of the scene cross its surfaces"));
            }
            if let Some(part) = enclosing(&model, place, &placed) {
                return refused(format!("it is inside of the closed surface {part}"));
            }
        }
        objects.push(placed.bounds());
        model.add(placed, DAffine3::IDENTITY);
    }
    let (light, more) = light_options(file)?.read()?;
    notes.extend(more);
    let (mut view, photograph) = camera(file)?;
    view.lens = lens(file, &view, &objects, &model, &light)?;
    let mut scene = Scene::new(&model, &light);
    scene.set_backdrop(place);
    let settings = Settings {
        seed: file.render.seed,
        bounces: file.render.bounces,
        shows_light: file.render.backplate == Backplate::Light,
        ..Settings::default()
    };
    let key = key(file, &view)?;
    Ok(Composition { model, place, scene, view, light, settings, photograph, notes, key })
}

/// Renders a composition with `samples` per pixel. Unfinished pictures are in `kept`. `progress` gets the share that is done.
///
/// # Errors
/// When an unfinished picture cannot be written, or a device that was named failed.
pub fn render(
    c: &mut Composition,
    file: &SceneFile,
    tracer: &mut PathTracer,
    kept: &Path,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(f64),
) -> Result<Composed> {
    let samples = file.render.spp;
    let passes = if c.photograph.is_some() { 2.0 } else { 1.0 };
    let job = |scene, part: &str| Job {
        scene,
        view: c.view,
        settings: c.settings,
        samples,
        kept: Some(kept.join(part)),
        key: format!("{} {part}", c.key),
    };
    tracer.load(&c.scene)?;
    let (mut film, interrupted) = picture::render(&job(&c.scene, "with"), tracer, stop, &mut |s| progress(s / passes))?;
    if file.render.denoise == Denoise::Atrous && !interrupted {
        denoise::cpu::run(&mut film);
    }
    let Some(photograph) = c.photograph.as_ref().filter(|_| !interrupted) else {
        let rgba = film.image(|p| [p.color[0], p.color[1], p.color[2], if c.settings.shows_light { 1.0 } else { p.opacity }]);
        return Ok(Composed { rgba, film, interrupted });
    };
    let mut empty = c.model.clone();
    empty.instances.truncate(c.place);
    let empty = Scene::new(&empty, &c.light);
    tracer.load(&empty)?;
    let (mut without, interrupted) = picture::render(&job(&empty, "without"), tracer, stop, &mut |s| progress(0.5 + s / passes))?;
    if file.render.denoise == Denoise::Atrous && !interrupted {
        denoise::cpu::run(&mut without);
    }
    Ok(Composed { rgba: before_photograph(&film, &without, photograph), film, interrupted })
}

/// Where a model stands: scaled, turned about the fixed axes x, y and z of a world with y up, and moved.
fn placement(translate: [f64; 3], rotate_deg: [f64; 3], scale: f64) -> DAffine3 {
    let [x, y, z] = rotate_deg.map(f64::to_radians);
    let rotation = DMat3::from_rotation_z(z) * DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x);
    let matrix = Z_UP * (scale * rotation) * Z_UP.transpose();
    DAffine3::from_mat3_translation(matrix, Z_UP * DVec3::from(translate))
}

/// How far an object's lowest point is above the ground below its center.
fn height_above_ground(ground: &Scene, object: &Model) -> Option<f64> {
    let (low, high) = object.bounds()?;
    let above = DVec3::new(0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), high[2]);
    let hit = cpu::first_hit(ground, above, DVec3::NEG_Z)?;
    Some(low[2] - hit.position.z)
}

/// Edges of the scene, which is the first `place` instances of a model, that pass through an object above its lowest part: a post through a wall
/// crosses none of the object's own edges.
fn piercing(model: &Model, place: usize, object: &Model) -> Result<usize> {
    let Some((low, high)) = object.bounds().map(|(l, h)| (DVec3::from(l), DVec3::from(h))) else { return Ok(0) };
    let floor = low.z + FOOT * (high.z - low.z);
    let solid = Scene::new(object, &LightOptions::of(Source::Uniform(1.0)).read()?.0);
    let mut crossing = 0;
    for instance in &model.instances[..place] {
        let mesh = &model.parts[instance.part].mesh;
        for face in &mesh.faces {
            let [a, b, c] = face.map(|i| instance.world_from_part.transform_point3(DVec3::from(mesh.positions[i as usize].map(f64::from))));
            let is_apart = a.min(b).min(c).cmpgt(high).any() || a.max(b).max(c).cmplt(low.with_z(floor)).any();
            if !is_apart {
                let edges = [(a, b), (b, c), (c, a)].into_iter().filter_map(|(p, q)| above(floor, p, q));
                crossing += edges.filter(|(low, high)| cpu::is_between(&solid, *low, *high)).count();
            }
        }
    }
    Ok(crossing)
}

/// Name of a part of the scene, which is the first `place` instances of a model, that an object's middle is inside of: a connected surface of it
/// closes around that, seen from behind (winding number, Jacobson et al. 2013).
fn enclosing(model: &Model, place: usize, object: &Model) -> Option<String> {
    let (low, high) = object.bounds()?;
    let middle = 0.5 * (DVec3::from(low) + DVec3::from(high));
    let encloses = |instance: &&Instance| {
        let mesh = &model.parts[instance.part].mesh;
        let mut welded = Mesh { positions: mesh.positions.clone(), faces: mesh.faces.clone(), ..Mesh::default() };
        repair::weld(&mut welded);
        let at = |i: u32| instance.world_from_part.transform_point3(DVec3::from(welded.positions[i as usize].map(f64::from))) - middle;
        // The tangent of half the solid angle of a triangle (van Oosterom and Strackee 1983).
        let half_angle = |[a, b, c]: [DVec3; 3]| {
            let (x, y, z) = (a.length(), b.length(), c.length());
            a.dot(b.cross(c)).atan2(x * y * z + a.dot(b) * z + b.dot(c) * x + c.dot(a) * y)
        };
        // A mirrored part is inside out.
        let way = instance.world_from_part.matrix3.determinant().signum() / std::f64::consts::TAU;
        let winding = |faces: &Vec<u32>| way * faces.iter().map(|f| half_angle(welded.faces[*f as usize].map(at))).sum::<f64>();
        let reach = |faces: &Vec<u32>| faces.iter().map(|f| at(welded.faces[*f as usize][0]).length()).fold(0.0, f64::max);
        // The innermost surface decides: in a room of thick walls, that is seen from the front.
        let parts = clean::components(&welded);
        let around = parts.iter().map(|f| (winding(f), reach(f))).filter(|(w, _)| w.abs() > ENCLOSED);
        around.min_by(|a, b| a.1.total_cmp(&b.1)).is_some_and(|(w, _)| w > 0.0)
    };
    let found = model.instances[..place].iter().find(encloses)?;
    Some(model.parts[found.part].name.clone())
}

/// The part of an edge above a floor, its lower end first.
fn above(floor: f64, p: DVec3, q: DVec3) -> Option<(DVec3, DVec3)> {
    let (low, high) = if p.z < q.z { (p, q) } else { (q, p) };
    let cut = if low.z < floor { low + (high - low) * ((floor - low.z) / (high.z - low.z)) } else { low };
    (high.z > floor).then_some((cut, high))
}

/// Share of an object's edges that cross the scene's surfaces, without what is near its lowest point, which may touch the ground.
fn pierced(ground: &Scene, object: &Model) -> f64 {
    let Some((low, high)) = object.bounds().filter(|_| ground.triangles() > 0) else { return 0.0 };
    let floor = low[2] + FOOT * (high[2] - low[2]);
    let faces: usize = object.face_count().max(1);
    let (step, mut n, mut tested, mut crossing) = (faces.div_ceil(EDGES), 0usize, 0usize, 0usize);
    for instance in &object.instances {
        let mesh = &object.parts[instance.part].mesh;
        for face in &mesh.faces {
            n += 1;
            let at = |i: u32| instance.world_from_part.transform_point3(DVec3::from(mesh.positions[i as usize].map(f64::from)));
            for (i, j) in [(0, 1), (1, 2), (2, 0)].into_iter().filter(|_| n.is_multiple_of(step)) {
                if let Some((low, high)) = above(floor, at(face[i]), at(face[j])) {
                    tested += 1;
                    crossing += cpu::is_between(ground, low, high) as usize;
                }
            }
        }
    }
    crossing as f64 / tested.max(1) as f64
}

/// The light that a file describes.
fn light_options(file: &SceneFile) -> Result<LightOptions> {
    let l = &file.light;
    let (source, intensity) = match (&l.hdri, l.sky) {
        (Some(path), _) => (Source::File(path.clone()), 1.0),
        (None, Some(sky)) => (Source::Sky { elevation: sky.elevation, rotation: sky.rotation }, sky.intensity),
        (None, None) => (Source::Uniform(1.0), 1.0),
    };
    Ok(LightOptions { rotate_deg: l.rotate_deg, strength: l.strength * intensity, ..LightOptions::of(source) })
}

/// The camera, and the photograph behind the objects.
fn camera(file: &SceneFile) -> Result<(View, Option<Image>)> {
    let part = &file.camera;
    let (camera, pose, photograph) = match (&part.frame, part.eye, part.target) {
        (Some(frame), ..) => {
            let (camera, pose, image) = frame_of_run(frame)?;
            (camera, pose, (file.render.backplate == Backplate::Photo).then_some(image))
        }
        (None, Some(eye), Some(target)) => {
            let (eye, target) = (Z_UP * DVec3::from(eye), Z_UP * DVec3::from(target));
            let up = if (target - eye).normalize().z.abs() > 0.9999 { DVec3::Y } else { DVec3::Z };
            let (mut size, mut photograph) = ((960, 540), None);
            if let Some(path) = &part.photograph {
                size = photo::size(path)?;
                photograph = (file.render.backplate == Backplate::Photo).then(|| path.clone());
            }
            (Camera::pinhole(size.0, size.1, part.fov_deg.to_radians()), Pose::look_at(eye, target, up), photograph)
        }
        _ => return Err(PipelineError::Usage("camera: give eye and target, or frame".into())),
    };
    let camera = match file.render.size {
        Some([w, h]) if part.frame.is_some() => camera.resized(w, h),
        Some([w, h]) => Camera::pinhole(w, h, part.fov_deg.to_radians()),
        None => camera,
    };
    let photograph = photograph.map(|path| -> Result<Image> {
        let photo = photo::load(&path)?.to_f32();
        let mut photo = photo.downsampled(camera.width as usize, camera.height as usize);
        photo.data = photo.data.chunks_exact(photo.channels).flat_map(|p| [p[0], p[1], p[2]]).collect();
        photo.data.iter_mut().for_each(|v| *v = diorama_geom::color::linear_from_srgb(*v));
        photo.channels = 3;
        Ok(photo)
    });
    Ok((View { camera, world_from_camera: pose, lens: None }, photograph.transpose()?))
}

/// Camera, pose in the coordinates of the run's input, and photograph of `RUN:NUMBER` or `RUN:NAME`.
pub(super) fn frame_of_run(frame: &str) -> Result<(Camera, Pose, PathBuf)> {
    let (run, which) = frame.rsplit_once(':').unwrap_or((frame, "0"));
    let run = Path::new(run);
    let capture = kept_capture::read(run, None, &RunDescription::read(run)?.data_set())?;
    let found = match which.parse::<usize>() {
        Ok(i) => capture.frames.get(i),
        Err(_) => capture.frames.iter().find(|f| f.name == which),
    };
    let found = found.ok_or_else(|| {
        let message = format!("camera.frame: the run has no frame {which:?}; it has {}, numbered from 0", capture.frames.len());
        DataError::input(run, message)
    })?;
    Ok((found.camera, capture.world_from_capture.inverse().pose(&found.world_from_camera), found.image.clone()))
}

/// The lens with its focus.
fn lens(
    file: &SceneFile,
    view: &View,
    objects: &[Option<([f64; 3], [f64; 3])>],
    model: &Model,
    light: &Daylight,
) -> Result<Option<ThinLens>> {
    let Some(f_stop) = file.camera.f_stop else { return Ok(None) };
    let in_camera = view.world_from_camera.inverse();
    let focus = match &file.camera.focus {
        Some(Focus::Distance(d)) => *d,
        Some(Focus::Object(name)) => {
            let (low, high) = object_of(name).and_then(|i| objects[i]).unwrap_or_default();
            in_camera.point(0.5 * (DVec3::from(low) + DVec3::from(high))).z
        }
        None => {
            let ahead = view.world_from_camera.rotation.z_axis;
            cpu::first_hit(&Scene::new(model, light), view.world_from_camera.translation, ahead).map_or(f64::INFINITY, |h| h.depth)
        }
    };
    if !(focus > 0.0 && focus.is_finite()) {
        return Err(PipelineError::Usage(format!("camera.focus: what is to be sharp is not in front of the camera (distance {focus})")));
    }
    Ok(Some(ThinLens::of_f_stop(&view.camera, f_stop, focus)))
}

/// Objects before a photograph: it is multiplied by what they change of the scene's light (Debevec 1998, "Rendering Synthetic Objects into
/// Real Scenes"); their own light is scaled by the photograph's brightness relative to the scene's.
fn before_photograph(with: &Film, without: &Film, photograph: &Image) -> Image {
    let lum = |c: [f32; 3]| 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2];
    let pixels = || with.pixels.iter().zip(&without.pixels).zip(photograph.data.chunks_exact(3));
    let mut ratios: Vec<f32> = pixels()
        .filter(|((a, b), _)| a.backdrop[3] > 0.99 && b.opacity > 0.99 && lum(b.color) > 1e-4)
        .map(|((_, b), photo)| lum([photo[0], photo[1], photo[2]]) / lum(b.color))
        .collect();
    ratios.sort_by(f32::total_cmp);
    let gain = ratios.get(ratios.len() / 2).copied().unwrap_or(1.0);
    let data = pixels().flat_map(|((a, b), photo)| {
        let [r, g, bl, share] = a.backdrop;
        let backdrop = [r, g, bl];
        let rgb: [f32; 3] = std::array::from_fn(|k| {
            let changed = match (share > 0.0 && b.opacity > 0.0, b.color[k] / b.opacity) {
                (true, before) if before > 1e-6 => (backdrop[k] / share / before).clamp(0.0, MOST),
                _ => 1.0,
            };
            (a.color[k] - backdrop[k]) * gain + photo[k] * (share * changed + 1.0 - a.opacity)
        });
        [rgb[0], rgb[1], rgb[2], 1.0]
    });
    Image { width: with.width, height: with.height, channels: 4, data: data.collect() }
}

/// What a picture depends on besides its number of samples: the description and the files' contents.
fn key(file: &SceneFile, view: &View) -> Result<String> {
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    let mut mix = |bytes: &[u8]| bytes.iter().for_each(|b| hash = (hash ^ *b as u64).wrapping_mul(0x0000_0100_0000_01b3));
    let mut description = file.clone();
    description.render.spp = 0;
    mix(format!("{description:?} {view:?}").as_bytes());
    let meshes = file.scene.iter().map(|s| &s.mesh).chain(file.objects.iter().map(|o| &o.mesh));
    for path in meshes.chain(&file.light.hdri).chain(&file.camera.photograph) {
        mix(&std::fs::read(path).map_err(DataError::io(path, "read"))?);
    }
    Ok(format!("{hash:016x}"))
}
