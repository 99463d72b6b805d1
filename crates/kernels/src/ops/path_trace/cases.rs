//! Scenes of the op, for its tests and for `bench check`.

use super::View;
#[cfg(feature = "gpu")]
use super::{Film, Pixel, Scene, Settings, Strategy, ThinLens, cpu, geometry::Geometry, gpu as on_gpu};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_geom::daylight::{Daylight, Sun};
use diorama_geom::environment::Environment;
#[cfg(feature = "gpu")]
use diorama_geom::glam::DQuat;
use diorama_geom::glam::{DAffine3, DVec3};
use diorama_geom::model::{Instance, Material, Model, Part};
use diorama_geom::{Camera, Mesh, Pose};
#[cfg(feature = "gpu")]
use diorama_geom::{
    ImageU8, Lens,
    model::{Opacity, Texture, Wrap},
};

/// A unit sphere with smooth normals.
pub fn sphere(n: usize) -> Mesh {
    let mut mesh = Mesh::default();
    for r in 0..=n {
        for c in 0..=2 * n {
            let (polar, azimuth) = (std::f64::consts::PI * r as f64 / n as f64, std::f64::consts::PI * c as f64 / n as f64);
            mesh.positions.push([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()].map(|v| v as f32));
            mesh.uvs.push([c as f32 / (2 * n) as f32, r as f32 / n as f32]);
        }
    }
    mesh.normals = mesh.positions.clone();
    for r in 0..n as u32 {
        for c in 0..2 * n as u32 {
            let at = |r: u32, c: u32| r * (2 * n as u32 + 1) + c;
            mesh.faces.extend([[at(r, c), at(r + 1, c), at(r + 1, c + 1)], [at(r, c), at(r + 1, c + 1), at(r, c + 1)]]);
        }
    }
    mesh
}

/// A square of edge 2 `half` at height `z`, facing up; texture coordinates grow with x and fall with y.
pub fn square(half: f32, z: f32) -> Mesh {
    Mesh {
        positions: vec![[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]],
        normals: vec![[0.0, 0.0, 1.0]; 4],
        uvs: vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]],
        faces: vec![[0, 1, 2], [0, 2, 3]],
        ..Mesh::default()
    }
}

pub fn model(parts: Vec<(Mesh, Material)>) -> Model {
    let mut model = Model::default();
    for (i, (mesh, material)) in parts.into_iter().enumerate() {
        model.materials.push(material);
        model.parts.push(Part { name: String::new(), mesh, material: i });
        model.instances.push(Instance { part: i, world_from_part: DAffine3::IDENTITY });
    }
    model
}

pub fn matte(color: [f32; 3]) -> Material {
    Material { base_color: [color[0], color[1], color[2], 1.0], ..Material::default() }
}

pub fn glossy(color: [f32; 3], roughness: f32, metallic: f32) -> Material {
    Material { roughness, metallic, ..matte(color) }
}

pub fn view(size: u32, eye: DVec3, target: DVec3, up: DVec3) -> View {
    View { camera: Camera::pinhole(size, size, 0.6), world_from_camera: Pose::look_at(eye, target, up), lens: None }
}

/// Dim sky, a bright patch and a sun.
pub fn day() -> Daylight {
    let lamp = DVec3::new(0.5, -0.5, 0.7).normalize();
    let map =
        Environment::from_fn(32, |d| if d.dot(lamp) > 0.95 { [9.0, 8.0, 6.0] } else { [0.3, 0.4, 0.6].map(|v| v * (0.6 + 0.4 * d.z)) });
    let sun = Sun { direction: DVec3::new(-0.48, -0.36, 0.8), diameter: 0.08, irradiance: [3.0, 2.5, 2.0] };
    Daylight { environment: map, sun: Some(sun) }
}

/// A glossy ball beside a matte one on a floor, seen from above.
pub fn balls() -> Model {
    let mut scene = model(vec![(square(4.0, 0.0), glossy([0.7, 0.6, 0.5], 0.6, 0.0)), (sphere(12), glossy([0.9, 0.6, 0.3], 0.3, 1.0))]);
    scene.materials.push(matte([0.2, 0.5, 0.8]));
    scene.parts.push(Part { name: String::new(), mesh: sphere(12), material: 2 });
    scene.instances[1].world_from_part = DAffine3::from_translation(DVec3::new(-1.1, 0.0, 1.0));
    scene.instances.push(Instance { part: 2, world_from_part: DAffine3::from_translation(DVec3::new(1.1, 0.2, 1.0)) });
    scene
}

pub fn balls_view(size: u32) -> View {
    view(size, DVec3::new(0.5, -8.0, 5.0), DVec3::new(0.0, 0.0, 0.6), DVec3::Z)
}

/// Everything at once before a camera with a fisheye lens: copies of a textured ball with a normal map, a fence with holes, a veil, a pane
/// and a lamp.
#[cfg(feature = "gpu")]
fn garden() -> (Scene, View) {
    let image = |channels: usize, seed: u64| {
        let data = diorama_testkit::random_unit(8 * 6 * channels, seed).iter().map(|v| (255.0 * v) as u8).collect();
        ImageU8 { width: 8, height: 6, channels, data }
    };
    let textures = [(image(4, 1), Wrap::Repeat), (image(3, 2), Wrap::Mirror), (image(3, 3), Wrap::Clamp)];
    let full = Material {
        base_color_texture: Some(0),
        metallic_roughness_texture: Some(1),
        normal_texture: Some(2),
        normal_scale: 0.3,
        ..glossy([0.9, 0.8, 0.7], 0.8, 0.7)
    };
    let holed = |opacity| Material { base_color_texture: Some(0), opacity, ..matte([0.6, 0.7, 0.5]) };
    let pane = Material { roughness: 0.1, transmission: 0.9, ..matte([0.8, 0.9, 0.8]) };
    let lamp = Material { emission: [2.0, 1.0, 0.5], emission_texture: Some(1), ..matte([0.1; 3]) };
    let mut wide = sphere(8);
    wide.uvs.iter_mut().for_each(|uv| *uv = [2.5 * uv[0] - 0.7, 1.5 * uv[1]]);
    let parts = vec![
        (square(4.0, 0.0), glossy([0.6, 0.5, 0.4], 0.5, 0.0)),
        (wide, full),
        (square(0.7, 0.0), holed(Opacity::Cutoff(0.5))),
        (square(0.7, 0.0), holed(Opacity::Blend)),
        (square(0.7, 0.0), pane),
        (square(0.4, 0.0), lamp),
    ];
    let mut model = model(parts);
    model.textures.extend(textures.map(|(image, wrap)| Texture { image, wrap: [wrap, Wrap::Repeat] }));
    let upright = |x: f64, y: f64, z: f64| DAffine3::from_rotation_translation(DQuat::from_rotation_x(1.4), DVec3::new(x, y, z));
    let stands = [(-1.6, -1.2, 0.9), (0.0, -1.6, 0.9), (1.6, -1.2, 0.9), (0.0, 1.5, 2.2)];
    stands.iter().enumerate().for_each(|(i, (x, y, z))| model.instances[2 + i].world_from_part = upright(*x, *y, *z));
    let ball = |x: f64, scale: DVec3| {
        let turn = DQuat::from_rotation_y(x);
        Instance { part: 1, world_from_part: DAffine3::from_scale_rotation_translation(scale, turn, DVec3::new(x, 0.3, 0.8)) }
    };
    model.instances[1] = ball(-1.2, DVec3::new(0.8, 0.6, 0.9));
    model.instances.push(ball(1.2, DVec3::new(0.7, -0.7, 0.7)));
    // No copy is stored one by one.
    let mut scene = Scene { geometry: Geometry::with_copies(&model, 0), ..Scene::new(&model, &day()) };
    scene.set_backdrop(1);
    let mut view = balls_view(16);
    view.camera.lens = Lens::Fisheye { k: [0.05, -0.01, 0.0, 0.0], p: [0.0; 2], s: [0.0; 2] };
    view.lens = Some(ThinLens { radius: 0.1, focus: 8.0 });
    (scene, view)
}

/// Largest root mean square of the differences between two pictures, relative to that of the second: 40 dB.
#[cfg(feature = "gpu")]
const NOISE: f64 = 1e-2;

/// Numbers of a pixel that are compared together.
#[cfg(feature = "gpu")]
const LAYERS: [(&str, std::ops::Range<usize>); 7] = [
    ("color", 0..3),
    ("albedo", 3..6),
    ("normal", 6..9),
    ("depth and opacity", 9..11),
    ("light layers", 11..14),
    ("backdrop", 14..18),
    ("square", 18..19),
];

/// Relative difference of one layer of two pictures, and of their means; infinite where the second alone is 0.
#[cfg(feature = "gpu")]
fn difference(got: &Film, want: &Film, layer: std::ops::Range<usize>) -> [f64; 2] {
    let values = |f: &Film| -> Vec<f64> {
        f.to_image().data.chunks_exact(Pixel::LEN).flat_map(|p| p[layer.clone()].to_vec()).map(f64::from).collect()
    };
    let (got, want) = (values(got), values(want));
    let energy = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
    let (error, whole) = (energy(&mut got.iter().zip(&want).map(|(g, w)| g - w)), energy(&mut want.iter().copied()));
    let mean = got.iter().zip(&want).map(|(g, w)| g - w).sum::<f64>().abs() / want.iter().map(|w| w.abs()).sum::<f64>();
    if error == 0.0 { [0.0; 2] } else { [error / whole, mean] }
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    const OP: &str = "path tracer";
    let plain = (Scene::new(&balls(), &day()), balls_view(16), Settings { bounces: 5, ..Settings::default() });
    let (scene, view) = garden();
    let full = (scene, view, Settings { seed: 7 << 33 | 5, light_layers: true, bounces: 4, ..Settings::default() });
    // By one strategy alone, with the light hidden or shown, and in a light that takes the place of another.
    let alone = |strategy: Strategy, shows_light: bool| {
        let settings = Settings { bounces: 3, strategy, shows_light, ..Settings::default() };
        (Scene::new(&balls(), &day()), balls_view(16), settings)
    };
    let evening = Daylight { environment: Environment::from_fn(16, |d| [0.8 - 0.3 * d.z, 0.5, 0.3 + 0.2 * d.x]), sun: None };
    let mut relit = alone(Strategy::Both, true);
    relit.0.set_light(&evening);
    let cases = [plain, full, alone(Strategy::Light, false), alone(Strategy::Surface, true), relit];
    let names = ["balls", "garden", "balls, light's rays", "balls, surface's rays", "balls, evening"];
    for ((scene, view, settings), name) in cases.iter().zip(names) {
        let mut on_device = on_gpu::GpuScene::upload(gpu, if name == names[4] { &cases[0].0 } else { scene })?;
        if name == names[4] {
            on_device.set_light(gpu, scene)?;
        }
        let draw = |settings: &Settings, passes: &[u32], paths: usize| {
            let mut film = Film::new(&view.camera);
            let mut run = passes.iter().map(|n| on_gpu::render_batches(gpu, &on_device, view, settings, *n, &mut film, paths));
            run.try_for_each(|r| r).map(|()| film)
        };
        let (mut want, got) = (Film::new(&view.camera), draw(settings, &[24, 40], 1000)?);
        for n in [24, 40] {
            cpu::render(scene, view, settings, n, &mut want);
        }
        for (result, layer) in LAYERS {
            let [error, mean] = difference(&got, &want, layer);
            let is_close = error <= NOISE && mean <= NOISE;
            let outcome = if is_close { Ok(error) } else { Err(format!("differs by {error:.2e}, its mean by {mean:.2e}")) };
            table.row(OP, result, name.into(), outcome);
        }
        let other = draw(&Settings { seed: 1, ..*settings }, &[64], 1000)?;
        let [error, _] = difference(&other, &want, 0..3);
        let outcome = if error > NOISE { Ok(0.0) } else { Err(format!("another seed differs by {error:.2e} only")) };
        table.row(OP, "other seeds", name.into(), outcome);
        let same = draw(settings, &[24, 40], 150)? == got;
        table.row(OP, "fewer at once", name.into(), if same { Ok(0.0) } else { Err("the picture has other bits".into()) });
    }
    Ok(())
}
