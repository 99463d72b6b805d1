//! The space and the grids of a field, as a configuration and a capture decide them.

use super::config::Config;
use diorama_geom::Capture;
use diorama_geom::capture::Split;
use diorama_geom::contraction::Space;
use diorama_kernels::ops::hash_grid::HashGridConfig;

/// Cascades of the occupancy grid of unbounded space: they reach 64 inner cubes far, beyond which a ray has a few samples left.
const CASCADES: usize = 8;

/// Least and most cells of the finest level, per inner cube.
const FINEST: (f64, f64) = (512.0, 2048.0);

/// `log2` of training pixels per row of the hash grid's largest levels, and of the fewest and most rows.
const PIXELS_PER_ROW: f64 = 5.0;
const ROWS: (f64, f64) = (14.0, 19.0);

/// The space that a configuration gives a capture: opaque photographs show the world to its end.
pub fn space(config: &Config, capture: &Capture, has_alpha: bool) -> Space {
    let unbounded = match &config.field.space[..] {
        "auto" => !has_alpha,
        s => s == "unbounded",
    };
    match unbounded {
        // What lies around the cameras keeps its shape.
        true => Space::Contracted((2.0 * capture.viewing_distance()).clamp(1.0, 8.0) as f32),
        false => Space::Cube(capture.scene.aabb_scale.max(1) as f32),
    }
}

/// Shape of the hash grid of `ngp`.
pub fn hash_grid(config: &Config, capture: &Capture, space: Space) -> HashGridConfig {
    let f = &config.field;
    let train: Vec<_> =
        capture.frames.iter().filter(|f| f.split == Split::Train).map(|f| f.camera.downscaled(config.data.downscale)).collect();
    let finest = match f.finest {
        0 => {
            let mut focal: Vec<f64> = train.iter().map(|c| c.fx.max(c.fy)).collect();
            focal.sort_by(f64::total_cmp);
            let per_cube = (2.0 * focal[focal.len() / 2] / capture.viewing_distance()).clamp(FINEST.0, FINEST.1);
            let cubes = match space {
                Space::Contracted(edge) => 2.0 * edge,
                Space::Cube(edge) => edge,
            };
            (per_cube * cubes as f64) as u32
        }
        n => n,
    };
    let log2_size = match f.log2_size {
        0 => {
            let pixels: f64 = train.iter().map(|c| c.width as f64 * c.height as f64).sum();
            (pixels.log2() - PIXELS_PER_ROW).round().clamp(ROWS.0, ROWS.1) as u32
        }
        n => n,
    };
    HashGridConfig { levels: f.levels, features: f.features, log2_size, base: f.base, finest: finest.max(f.base) }
}

/// Cascades of the occupancy grid, each twice as wide as the one inside it.
pub fn cascades(space: Space) -> usize {
    match space {
        Space::Contracted(_) => CASCADES,
        Space::Cube(edge) => (edge as u32).ilog2() as usize + 1,
    }
}
