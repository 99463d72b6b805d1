//! Turns a radiance field into a mesh: extraction in slices, cleaning, repair, simplification, vertex colors, textures, normal maps.
//!
//! The field is any [`FieldQuery`](diorama_geom::field_query::FieldQuery). The usual order is [`extract::extract`],
//! [`clean::remove_floaters`] and [`clean::remove_unseen`], [`simplify::simplify`], [`repair::close`], then either [`color::color_from_field`]
//! for vertex colors, or [`atlas::unwrap`] with [`bake`] and [`normal_map`] for textures. `diorama-data` writes the result to files.
//!
//! Surfaces that are trained lie in a deformable [`tetrahedral_grid`]; [`tetrahedral_fit`] fits one to a mesh.
//!
//! ```
//! use diorama_geom::field_query::FieldQuery;
//! use diorama_mesh::extract::{self, Grid, Method};
//! use diorama_mesh::{color, simplify};
//!
//! /// A red ball of radius 1; its surface is where the density is 1.
//! struct Ball;
//!
//! impl FieldQuery for Ball {
//!     fn density(&self, points_in_world: &[[f32; 3]], sigma: &mut [f32]) {
//!         for (p, s) in points_in_world.iter().zip(sigma) {
//!             *s = 2.0 - p.iter().map(|v| v * v).sum::<f32>().sqrt();
//!         }
//!     }
//!
//!     fn color(&self, _: &[[f32; 3]], _: &[[f32; 3]], rgb_srgb: &mut [[f32; 3]]) {
//!         rgb_srgb.fill([1.0, 0.0, 0.0]);
//!     }
//! }
//!
//! let grid = Grid { min: [-1.5; 3], max: [1.5; 3], resolution: 48 };
//! let mut mesh = extract::extract(&Ball, &grid, 1.0, Method::default(), &mut |_done, _all| {});
//! assert!(mesh.is_watertight());
//!
//! simplify::simplify(&mut mesh, 1000).expect("a ball can have so few faces");
//! assert!(mesh.faces.len() <= 1000);
//! mesh.compute_normals();
//! color::color_from_field(&mut mesh, &Ball);
//! assert_eq!(mesh.colors_srgb[0], [1.0, 0.0, 0.0]);
//! assert!((mesh.volume() / (4.0 / 3.0 * std::f64::consts::PI) - 1.0).abs() < 0.02);
//! ```

pub mod atlas;
pub mod bake;
pub mod clean;
pub mod closest_point;
pub mod color;
pub mod extract;
pub mod normal_map;
pub mod repair;
pub mod simplify;
pub mod sparse_grid;
pub mod surface_limits;
pub mod tetrahedral_fit;
pub mod tetrahedral_grid;
pub mod visibility;
