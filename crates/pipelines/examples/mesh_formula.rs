//! Meshes a formula: anything that answers density and color can be extracted, simplified, textured and written as a GLB.
//!
//! `cargo run --release -p diorama-pipelines --example mesh_formula -- [FOLDER]`

use diorama_data::glb;
use diorama_geom::field_query::FieldQuery;
use diorama_mesh::extract::{self, Grid, Method};
use diorama_mesh::{color, repair, simplify};
use std::path::PathBuf;

/// A gyroid cut by a ball: `sin x cos y + sin y cos z + sin z cos x = 0`, thickened, within radius 1.
struct Gyroid;

impl Gyroid {
    fn value([x, y, z]: [f32; 3]) -> f32 {
        let [x, y, z] = [x, y, z].map(|v| 6.0 * v);
        x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos()
    }
}

impl FieldQuery for Gyroid {
    /// Above 1 within the walls: the surface is where density equals the level that is asked for.
    fn density(&self, points_in_world: &[[f32; 3]], sigma: &mut [f32]) {
        for (p, s) in points_in_world.iter().zip(sigma) {
            let radius = p.iter().map(|v| v * v).sum::<f32>().sqrt();
            let wall = 0.35 - Gyroid::value(*p).abs();
            *s = 1.0 + wall.min(6.0 * (1.0 - radius));
        }
    }

    /// Warm on one side of the sheet, cool on the other; the direction of view makes no difference.
    fn color(&self, points_in_world: &[[f32; 3]], _: &[[f32; 3]], rgb_srgb: &mut [[f32; 3]]) {
        for (p, rgb) in points_in_world.iter().zip(rgb_srgb) {
            *rgb = if Gyroid::value(*p) > 0.0 { [0.88, 0.48, 0.25] } else { [0.15, 0.33, 0.49] };
        }
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = std::env::args().nth(1).map_or_else(|| std::env::temp_dir().join("diorama-mesh-formula"), PathBuf::from);
    std::fs::create_dir_all(&out)?;

    let grid = Grid { min: [-1.1; 3], max: [1.1; 3], resolution: 96 };
    let mut mesh = extract::extract(&Gyroid, &grid, 1.0, Method::default(), &mut |_, _| {});
    repair::weld(&mut mesh);
    println!("{} faces as extracted, {}", mesh.faces.len(), if mesh.is_watertight() { "closed" } else { "open" });

    simplify::simplify(&mut mesh, 20_000).map_err(|fewest| format!("the surface has at least {fewest} faces"))?;
    color::color_from_field(&mut mesh, &Gyroid);
    println!("{} faces after simplification", mesh.faces.len());

    let file = out.join("gyroid.glb");
    glb::save(&file, &mesh)?;
    println!("wrote {}", file.display());
    Ok(())
}
