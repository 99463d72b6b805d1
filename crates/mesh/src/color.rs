//! Vertex colors from the field.

use diorama_geom::Mesh;
use diorama_geom::field_query::FieldQuery;

/// Colors each vertex as seen along its inward normal. The mesh must have normals.
pub fn color_from_field(mesh: &mut Mesh, field: &dyn FieldQuery) {
    let inward: Vec<[f32; 3]> = mesh.normals.iter().map(|n| n.map(|v| -v)).collect();
    mesh.colors_srgb = vec![[0.0; 3]; mesh.positions.len()];
    field.color(&mesh.positions, &inward, &mut mesh.colors_srgb);
}
