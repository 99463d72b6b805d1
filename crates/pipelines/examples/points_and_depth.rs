//! Takes a point cloud and a depth map from a trained field.
//!
//! `cargo run --release -p diorama-pipelines --example points_and_depth -- [FOLDER]`

use diorama_data::{photo, point_cloud};
use diorama_engine::renderers::volume::Quality;
use diorama_geom::Mesh;
use diorama_geom::glam::DVec3;
use diorama_pipelines::object::config::{Config, Method};
use diorama_pipelines::object::render::{self, Layer};
use diorama_pipelines::object::{quickstart, recipe};
use diorama_pipelines::run::RunFolder;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = std::env::args().nth(1).map_or_else(|| std::env::temp_dir().join("diorama-points-and-depth"), PathBuf::from);

    let data = out.join("capture");
    quickstart::write_capture(&data, 24, 96)?;
    let mut config = Config::new(Method::Ngp, data);
    (config.run.steps, config.run.seconds) = (150, 0.0);
    (config.field.log2_size, config.field.finest) = (15, 256);
    let mut run = RunFolder::create(&out.join("run"), true)?;
    let model = recipe::train(&config, &mut run, false, None, &AtomicBool::new(false), &mut |_| {})?.model;

    // The depth layer as a picture: near is bright.
    let posed = model.posed(0);
    let picture = out.join("depth.png");
    photo::save_png(&picture, &render::picture(&model, &posed, Layer::Depth, None, Quality::Full))?;

    // The depth of a view is measured along its rays, in model units, so each opaque pixel is a point:
    // x_in_model = camera center + depth * direction.
    let mut cloud = Mesh::default();
    let world_from_model = model.model_from_world.inverse();
    let tracer = model.tracer(Quality::Full);
    for &frame in &model.train {
        let posed = model.posed(frame);
        let view = tracer.view(&posed, &mut |_| {});
        let w = view.depth.width;
        for (i, depth) in view.depth.data.iter().enumerate().filter(|(i, _)| view.opacity.data[*i] > 0.9) {
            let direction: DVec3 = posed.pose.rotation * posed.camera.direction((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
            let point = world_from_model.point(posed.pose.translation + *depth as f64 * direction);
            cloud.positions.push(point.as_vec3().to_array());
            // Toward the camera that sees it; `diorama export` asks the field for normals instead.
            cloud.normals.push((-direction).as_vec3().to_array());
            cloud.colors_srgb.push(std::array::from_fn(|k| view.rgb.data[3 * i + k]));
        }
    }

    let file = out.join("points.ply");
    point_cloud::save_ply(&file, &cloud)?;
    println!("wrote {} points to {} and {}", cloud.positions.len(), file.display(), picture.display());
    Ok(())
}
