//! A viewer for your own pictures: a painted ball with its own layers, slider, toggle and list.
//!
//! `cargo run --release -p diorama-viewer --example own_picture` prints the address to open.

use diorama_geom::glam::DVec3;
use diorama_geom::view_controls::{ControlInput, ViewControl, ViewLayer};
use diorama_geom::view_source::{MeasuredLength, MeshRequest, ViewFrame, ViewRequest, ViewScene, ViewSource, ViewStatus};
use diorama_geom::{Camera, ImageU8, Pose, Similarity};
use diorama_viewer::{Server, ViewerOptions};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const WARM: [u8; 3] = [224, 122, 63];
const COOL: [u8; 3] = [38, 84, 124];
const DUSK: [u8; 3] = [24, 28, 38];

/// A ball of radius 1 about the origin.
pub struct Ball;

impl Ball {
    /// Distance along a ray to the ball, if the ray meets it.
    fn meet(eye: DVec3, dir: DVec3) -> Option<f64> {
        let b = eye.dot(dir);
        let inside = b * b - eye.length_squared() + 1.0;
        (inside > 0.0).then(|| -b - inside.sqrt()).filter(|t| *t > 0.0)
    }

    fn paint(p: DVec3, pattern: &str) -> [u8; 3] {
        let stripe = |v: f64| (v * 6.0).floor() as i64;
        let warm = match pattern {
            "stripes" => stripe(p.z) % 2 == 0,
            "checker" => (stripe(p.x) + stripe(p.y) + stripe(p.z)) % 2 == 0,
            _ => true,
        };
        if warm { WARM } else { COOL }
    }

    fn color(eye: DVec3, dir: DVec3, r: &ViewRequest) -> [u8; 3] {
        let sky = if r.values.switch("sky") { [120, 150, 180] } else { DUSK };
        let Some(t) = Ball::meet(eye, dir) else { return sky };
        let p = eye + dir * t;
        let albedo = Ball::paint(p, r.values.choice("pattern"));
        match &r.layer[..] {
            "albedo" => albedo,
            "height" => [((p.z + 1.0) * 127.5) as u8; 3],
            _ => {
                let (sin, cos) = r.values.number("sun").to_radians().sin_cos();
                let light = 0.15 + 0.85 * p.dot(DVec3::new(cos, 0.0, sin)).max(0.0);
                albedo.map(|v| (v as f64 * light) as u8)
            }
        }
    }
}

impl ViewSource for Ball {
    fn scene(&self) -> ViewScene {
        let control = |id: &str, label: &str, help: &str, layers: &[&str], input| ViewControl {
            id: id.into(),
            label: label.into(),
            help: help.into(),
            layers: layers.iter().map(|l| l.to_string()).collect(),
            input,
        };
        let patterns = [("plain", "Plain"), ("stripes", "Stripes"), ("checker", "Checker")];
        let options = patterns.map(|(id, label)| (id.to_string(), label.to_string())).to_vec();
        let sun = ControlInput::Slider { min: 0.0, max: 90.0, step: 1.0, unit: "°".into(), default: 40.0 };
        let frame = |i: usize| {
            let a = i as f64 * std::f64::consts::TAU / 6.0;
            let eye = DVec3::new(a.cos(), a.sin(), 0.4) * 3.5;
            let camera = Camera::pinhole(160, 120, 50f64.to_radians());
            ViewFrame { name: format!("view {i}"), camera, world_from_camera: Pose::look_at(eye, DVec3::ZERO, DVec3::Z), held_out: i == 5 }
        };
        ViewScene {
            name: "painted ball".into(),
            frames: (0..6).map(frame).collect(),
            layers: vec![
                ViewLayer::new("shaded", "Shaded"),
                ViewLayer::new("albedo", "Albedo").with_classes(&[("warm paint", WARM), ("cool paint", COOL)]),
                ViewLayer::new("height", "Height").with_scale(&[[0; 3], [255; 3]], "-1", "1", "m"),
            ],
            controls: vec![
                control("sun", "Sun", "Height of the sun above the horizon", &["shaded"], sun),
                control(
                    "pattern",
                    "Pattern",
                    "How the ball is painted",
                    &["shaded", "albedo"],
                    ControlInput::Pick { options, default: "stripes".into() },
                ),
                control("sky", "Bright sky", "", &[], ControlInput::Toggle { default: false }),
            ],
            note: String::new(),
            is_run: false,
            focus: [0.0; 3],
            distance: 3.5,
            world_from_capture: Similarity::IDENTITY,
            bounds: ([-1.5; 3], [1.5; 3]),
            crop: None,
            measured: None,
            path: None,
        }
    }

    fn status(&self) -> ViewStatus {
        ViewStatus::default()
    }

    fn view(&self, r: &ViewRequest) -> Result<ImageU8, String> {
        let (w, h) = (r.camera.width as usize, r.camera.height as usize);
        let ray = |i: usize| r.world_from_camera.rotation * r.camera.direction((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
        let color = |i| Ball::color(r.world_from_camera.translation, ray(i), r);
        Ok(ImageU8 { width: w, height: h, channels: 3, data: (0..w * h).flat_map(color).collect() })
    }

    fn point(&self, r: &ViewRequest, x_px: f64, y_px: f64) -> Option<[f64; 3]> {
        let (eye, dir) = (r.world_from_camera.translation, r.world_from_camera.rotation * r.camera.direction(x_px, y_px));
        Ball::meet(eye, dir).map(|t| (eye + dir * t).to_array())
    }

    fn thumbnail(&self, frame: usize) -> Result<ImageU8, String> {
        let s = self.scene();
        let f = s.frames.get(frame).ok_or("there is no such view")?;
        let values = diorama_geom::view_controls::ControlValues::defaults(&s.controls);
        self.view(&ViewRequest { camera: f.camera, world_from_camera: f.world_from_camera, layer: "shaded".into(), values, clip: None })
    }

    fn save_crop(&self, _: Option<([f32; 3], [f32; 3])>) -> Result<(), String> {
        Err("this example saves nothing".into())
    }

    fn save_measured(&self, _: Option<MeasuredLength>) -> Result<(), String> {
        Err("this example saves nothing".into())
    }

    fn save_path(&self, _: &str) -> Result<PathBuf, String> {
        Err("this example saves nothing".into())
    }

    fn open_path(&self, json: &str) -> Result<String, String> {
        Ok(json.into())
    }

    fn export(&self, _: &MeshRequest, _: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64), String> {
        Err("this example has no mesh".into())
    }
}

fn main() {
    let server = Server::bind(&ViewerOptions { port: 0, ..ViewerOptions::default() }, Arc::new(Ball)).expect("a free port");
    println!("{}", server.address());
    server.run(&AtomicBool::new(false));
}
