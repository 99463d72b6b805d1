//! Writes a [`Model`] as one `.glb` file that Khronos' validator accepts without warnings.

use super::binary::{Chunk, join, name};
use super::placement;
use super::write_materials::Materials;
use super::write_parts::{self, Grid};
use crate::atomic;
use crate::error::{DataError, Result};
use diorama_geom::glam::{DAffine3, DMat3, DQuat, DVec3, Vec3};
use diorama_geom::model::{Model, Part};
use serde_json::{Value, json};
use std::collections::HashMap;
use std::path::Path;

/// How a model is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WriteOptions {
    /// Stores positions with 16 bits per number, normals and tangents with 8, texture coordinates with 16 (KHR_mesh_quantization).
    /// A position is wrong by at most 1/131070 of the part's longest side.
    pub quantize: bool,
}

/// Writes a `.glb` atomically.
///
/// # Errors
/// As [`encode`], or if the file cannot be written.
pub fn save(path: &Path, model: &Model, options: WriteOptions) -> Result<()> {
    atomic::write(path, &encode(model, options, path)?)
}

/// Encodes a model as GLB: parts as meshes, instances as nodes, textures as PNG. Parts without an instance are left out.
///
/// # Errors
/// If the model has no triangles, or numbers that glTF does not allow; `path` is named.
pub fn encode(model: &Model, options: WriteOptions, path: &Path) -> Result<Vec<u8>> {
    let mut writer = Writer { model, options, path, chunk: Chunk::default(), materials: Materials::default(), meshes: Vec::new() };
    let mut known: HashMap<usize, (usize, Grid)> = HashMap::new();
    let mut nodes = Vec::new();
    for instance in &model.instances {
        let part = &model.parts[instance.part];
        if part.mesh.faces.is_empty() {
            continue;
        }
        let world_from_part = placement::y_up(instance.world_from_part);
        if !world_from_part.is_finite() {
            return Err(DataError::input(path, format!("part \"{}\" stands at a place that is not finite", part.name)));
        }
        let ((mesh, grid), placement) = match Placement::of(world_from_part) {
            Some(placement) => {
                let written = match known.get(&instance.part) {
                    Some(written) => *written,
                    None => writer.mesh(part)?,
                };
                known.insert(instance.part, written);
                (written, placement)
            }
            None => (writer.mesh(&moved(part, instance.world_from_part))?, Placement::default()),
        };
        nodes.push(placement.of_grid(grid).node(mesh, &part.name));
    }
    if nodes.is_empty() {
        return Err(DataError::input(path, "the model has no triangles: there is nothing to write"));
    }
    writer.finish(nodes)
}

struct Writer<'a> {
    model: &'a Model,
    options: WriteOptions,
    path: &'a Path,
    chunk: Chunk,
    materials: Materials,
    meshes: Vec<Value>,
}

impl Writer<'_> {
    fn mesh(&mut self, part: &Part) -> Result<(usize, Grid)> {
        let material = &self.model.materials[part.material];
        write_parts::check(part, material, self.path)?;
        let grid = if self.options.quantize { Grid::of(&part.mesh) } else { Grid::default() };
        let mut primitive = write_parts::primitive(&part.mesh, material, self.options.quantize.then_some(grid), &mut self.chunk);
        primitive["material"] = self.materials.add(self.model, part.material, &mut self.chunk, self.path)?.into();
        let mut mesh = json!({ "primitives": [primitive] });
        name(&mut mesh, &part.name);
        self.meshes.push(mesh);
        Ok((self.meshes.len() - 1, grid))
    }

    fn finish(self, nodes: Vec<Value>) -> Result<Vec<u8>> {
        let Materials { materials, textures, images, samplers, mut extensions, .. } = self.materials;
        let mut root = json!({
            "asset": { "version": "2.0", "generator": concat!("diorama ", env!("CARGO_PKG_VERSION")) },
            "scene": 0,
            "scenes": [{ "nodes": (0..nodes.len()).collect::<Vec<_>>() }],
            "nodes": nodes,
            "meshes": self.meshes,
            "materials": materials,
            "buffers": [{ "byteLength": self.chunk.bytes.len() }],
            "bufferViews": self.chunk.views,
            "accessors": self.chunk.accessors,
        });
        for (key, list) in [("textures", textures), ("images", images), ("samplers", samplers)] {
            if !list.is_empty() {
                root[key] = list.into();
            }
        }
        if self.options.quantize {
            root["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
            extensions.insert("KHR_mesh_quantization");
        }
        if !extensions.is_empty() {
            root["extensionsUsed"] = extensions.into_iter().collect();
        }
        join(&root, &self.chunk.bytes, self.path)
    }
}

/// `translation · rotation · scale`, y up.
#[derive(Clone, Copy)]
struct Placement {
    translation: DVec3,
    rotation: DQuat,
    scale: DVec3,
}

impl Default for Placement {
    fn default() -> Placement {
        Placement { translation: DVec3::ZERO, rotation: DQuat::IDENTITY, scale: DVec3::ONE }
    }
}

impl Placement {
    /// The factors of a transform; `None` if it shears or flattens, which glTF's nodes cannot.
    fn of(transform: DAffine3) -> Option<Placement> {
        let size = transform.matrix3.to_cols_array().iter().fold(0.0f64, |a, v| a.max(v.abs()));
        if transform.matrix3.determinant().abs() <= 1e-12 * size.powi(3) {
            return None;
        }
        let (scale, rotation, translation) = transform.to_scale_rotation_translation();
        let again = DMat3::from_quat(rotation) * DMat3::from_diagonal(scale);
        again.abs_diff_eq(transform.matrix3, 1e-6 * size).then_some(Placement { translation, rotation: rotation.normalize(), scale })
    }

    /// The placement of a part whose positions are steps of a grid.
    fn of_grid(self, grid: Grid) -> Placement {
        let corner = self.rotation * (self.scale * grid.corner);
        Placement { translation: self.translation + corner, scale: self.scale * grid.step, ..self }
    }

    fn node(self, mesh: usize, title: &str) -> Value {
        let mut node = json!({ "mesh": mesh });
        name(&mut node, title);
        if self.translation != DVec3::ZERO {
            node["translation"] = json!(self.translation.to_array());
        }
        if self.rotation != DQuat::IDENTITY {
            node["rotation"] = json!(self.rotation.to_array());
        }
        if self.scale != DVec3::ONE {
            node["scale"] = json!(self.scale.to_array());
        }
        node
    }
}

/// A part whose coordinates are those of the world.
fn moved(part: &Part, world_from_part: DAffine3) -> Part {
    let mut part = part.clone();
    let matrix = world_from_part.matrix3;
    let is_mirrored = matrix.determinant() < 0.0;
    // The matrix of cofactors turns normals also where the transform has no inverse.
    let [x, y, z] = [matrix.x_axis, matrix.y_axis, matrix.z_axis];
    let cofactors = DMat3::from_cols(y.cross(z), z.cross(x), x.cross(y)) * if is_mirrored { -1.0 } else { 1.0 };
    let turned = |m: DMat3, v: [f32; 3]| (m * Vec3::from(v).as_dvec3()).normalize_or_zero().as_vec3().to_array();
    let mesh = &mut part.mesh;
    mesh.positions.iter_mut().for_each(|p| *p = world_from_part.transform_point3(Vec3::from(*p).as_dvec3()).as_vec3().to_array());
    mesh.normals.iter_mut().for_each(|n| *n = turned(cofactors, *n));
    for tangent in &mut mesh.tangents {
        let [x, y, z] = turned(matrix, [tangent[0], tangent[1], tangent[2]]);
        *tangent = [x, y, z, if is_mirrored { -tangent[3] } else { tangent[3] }];
    }
    if is_mirrored {
        mesh.faces.iter_mut().for_each(|f| f.swap(1, 2));
    }
    part
}
