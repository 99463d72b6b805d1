//! Reads a capture (COLMAP, `transforms.json`, LLFF or a zip of one) and prints what it holds.
//!
//! `cargo run --release -p diorama-pipelines --example read_capture -- [CAPTURE]`; where there is no capture yet, a small one is
//! generated and written as a COLMAP model.

use diorama_data::import::{self, ImportOptions};
use diorama_data::{colmap, photo};
use diorama_geom::Capture;
use diorama_geom::capture::{Frame, Split, focus_point};
use diorama_scenes::still_life;
use std::path::{Path, PathBuf};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::args().nth(1).map_or_else(|| std::env::temp_dir().join("diorama-read-capture"), PathBuf::from);
    if !folder.is_file() && import::root(&folder).and_then(|root| import::detect(&root)).is_err() {
        write_colmap(&folder)?;
    }

    let capture = import::import(&folder, &ImportOptions::default())?;
    println!("{}: {}", folder.display(), import::detect(&import::root(&folder)?)?.name());
    let count = |split| capture.indices(split).len();
    println!("{} photographs, {} to train on, {} held out", capture.frames.len(), count(Split::Train), count(Split::Test));
    println!("{} sparse points", capture.points.len());
    println!("inner cube: center {:.2?}, half {:.2}", capture.scene.center.to_array(), capture.scene.half);

    // Poses say where a camera stands in the world (z up) and how it is turned: x right, y down, z forward.
    let poses: Vec<_> = capture.frames.iter().map(|f| f.world_from_camera).collect();
    let (center, distance) = focus_point(&poses);
    println!("the cameras look at {:.2?} from {distance:.2} away", center.to_array());
    for f in capture.frames.iter().take(4) {
        let (c, at) = (&f.camera, f.world_from_camera.translation);
        println!("  {}: {}x{}, focal length {:.1} px, at {:.2?}", f.name, c.width, c.height, c.fx, at.to_array());
    }
    capture.notes.iter().for_each(|n| println!("note: {n}"));
    Ok(())
}

/// Renders a few photographs of the still life and describes them as COLMAP does.
fn write_colmap(folder: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let images = folder.join("images");
    std::fs::create_dir_all(&images)?;
    let mut frames = Vec::new();
    for p in still_life::photographs(12, 64) {
        let image = images.join(format!("{}.png", p.name));
        photo::save_png(&image, &p.image)?;
        frames.push(Frame::new(p.name, image, p.camera, p.world_from_camera));
    }
    colmap::write_text(&folder.join("sparse/0"), &Capture::new(frames, still_life::scene_box()))?;
    Ok(())
}
