//! Writes the still life as a large capture: `cargo run --release -p diorama-pipelines --example photographs -- FOLDER 1000 4000x3000`.
//! Every 250th photograph is held out. Photographs that are there already are kept, so an interrupted call goes on.

use diorama_data::{photo_import, transforms_json};
use diorama_geom::capture::{Frame, Split};
use diorama_geom::{Camera, Capture, ImageU8};
use diorama_scenes::still_life;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, views, size] = &arguments[..] else { return Err("expected FOLDER VIEWS WIDTHxHEIGHT".into()) };
    let (width, height) = size.split_once('x').ok_or("expected WIDTHxHEIGHT")?;
    let (views, width, height): (usize, u32, u32) = (views.parse()?, width.parse()?, height.parse()?);
    let (root, images) = (Path::new(folder), Path::new(folder).join("images"));
    std::fs::create_dir_all(&images)?;
    let (scene, camera) = (still_life::scene(), Camera::pinhole(width, height, still_life::FOV * width as f64 / height as f64));
    let mut frames = Vec::new();
    for i in 0..views {
        let (name, pose) = (format!("view_{i:04}"), still_life::pose(i, views));
        let image = images.join(format!("{name}.jpg"));
        if !image.exists() {
            photo_import::write(&on_gray(&scene.render(&camera, &pose, 1)), &images, &name)?;
            eprint!("\r{} of {views}", i + 1);
        }
        let split = if i % 250 == 125.min(views / 2) { Split::Test } else { Split::Train };
        frames.push(Frame { split, ..Frame::new(name, image, camera, pose) });
    }
    let capture = Capture::new(frames, still_life::scene_box());
    transforms_json::write(&root.join("transforms.json"), root, &capture, None)?;
    Ok(())
}

/// RGBA over gray, as a JPEG shows it.
fn on_gray(im: &ImageU8) -> ImageU8 {
    let over = |p: &[u8]| -> [u8; 3] { std::array::from_fn(|k| ((p[k] as u32 * p[3] as u32 + 128 * (255 - p[3] as u32)) / 255) as u8) };
    ImageU8 { width: im.width, height: im.height, channels: 3, data: im.data.chunks_exact(4).flat_map(over).collect() }
}
