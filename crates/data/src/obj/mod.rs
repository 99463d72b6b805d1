//! Reads Wavefront OBJ with MTL materials into a [`Model`]: one part per material.

mod material;
mod polygon;

use crate::error::{self, DataError, Result};
use crate::loaded_model::{LoadedModel, Notes};
use diorama_geom::Mesh;
use diorama_geom::glam::{DAffine3, DVec3};
use diorama_geom::model::{Instance, Material, Model, Part};
use material::Library;
use std::collections::HashMap;
use std::path::Path;

/// Largest file that is read, in bytes.
const LIMIT: u64 = 8 << 30;

/// The axis of a file that points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Up {
    /// Usual for OBJ: (x, y, z) there is (x, −z, y) here.
    Y,
    Z,
}

/// Reads an OBJ: positions, texture coordinates, normals, colors of vertices, and polygons. Without `up`, y points up, unless the first line
/// says `z up`, as in the files that [`crate::mesh_text`] writes.
///
/// # Errors
/// If a line cannot be read or there are no faces; the line is named.
pub fn read(path: &Path, up: Option<Up>) -> Result<LoadedModel> {
    let bytes = error::read(path, LIMIT)?;
    let text = String::from_utf8_lossy(&bytes);
    let is_marked = text.lines().next().is_some_and(|l| l.starts_with('#') && l.contains("z up"));
    let up = up.unwrap_or(if is_marked { Up::Z } else { Up::Y });
    let mut reader = Reader::new(path, up);
    let mut joined = String::new();
    for (number, line) in text.lines().enumerate() {
        if let Some(start) = line.strip_suffix('\\') {
            joined += start;
            joined.push(' ');
            continue;
        }
        if joined.is_empty() {
            reader.line(line, number + 1)?;
        } else {
            reader.line(&(std::mem::take(&mut joined) + line), number + 1)?;
        }
    }
    reader.finish()
}

/// A part, with the vertices of its corners: indices of position, texture coordinates and normal.
struct OpenPart {
    material: Option<usize>,
    mesh: Mesh,
    vertices: HashMap<[u32; 3], u32>,
}

/// Absent texture coordinates or normals of a corner.
const NONE: u32 = u32::MAX;

struct Reader<'a> {
    path: &'a Path,
    up: Up,
    positions: Vec<[f32; 3]>,
    colors: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    normals: Vec<[f32; 3]>,
    library: Library,
    /// The material of the next faces.
    material: Option<usize>,
    parts: Vec<OpenPart>,
    /// Index of a part by material, and by whether it has texture coordinates and normals.
    by_kind: HashMap<(Option<usize>, [bool; 2]), usize>,
    notes: Notes,
}

impl<'a> Reader<'a> {
    fn new(path: &'a Path, up: Up) -> Reader<'a> {
        Reader {
            path,
            up,
            positions: Vec::new(),
            colors: Vec::new(),
            uvs: Vec::new(),
            normals: Vec::new(),
            library: Library::default(),
            material: None,
            parts: Vec::new(),
            by_kind: HashMap::new(),
            notes: Notes::default(),
        }
    }

    fn wrong(&self, line: usize, message: &str) -> DataError {
        DataError::input(self.path, format!("line {line}: {message}"))
    }

    fn line(&mut self, line: &str, number: usize) -> Result<()> {
        let line = line.split('#').next().unwrap_or_default().trim();
        let (key, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        match key {
            "v" => {
                let n = self.numbers(rest, 3, number)?;
                self.positions.push(self.turned([n[0], n[1], n[2]]));
                if let [_, _, _, r, g, b] = n[..] {
                    self.colors.push([r, g, b].map(|v| v.clamp(0.0, 1.0)));
                }
            }
            "vt" => {
                let n = self.numbers(rest, 1, number)?;
                self.uvs.push([n[0], 1.0 - n.get(1).copied().unwrap_or(0.0)]);
            }
            "vn" => {
                let n = self.numbers(rest, 3, number)?;
                let v = DVec3::new(n[0] as f64, n[1] as f64, n[2] as f64).try_normalize().unwrap_or(DVec3::Z);
                self.normals.push(self.turned(v.as_vec3().to_array()));
            }
            "f" => self.face(rest, number)?,
            "mtllib" => self.library.read(rest.trim(), self.path, &mut self.notes)?,
            "usemtl" => {
                let name = rest.trim();
                self.material = self.library.find(name);
                if self.material.is_none() {
                    self.notes.add(format!("material \"{name}\" is in no .mtl file: the default material, matte white, is used"));
                    self.material = Some(self.library.add(Material { name: name.into(), ..Material::default() }));
                }
            }
            _ => {}
        }
        Ok(())
    }

    fn turned(&self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        if self.up == Up::Y { [x, -z, y] } else { [x, y, z] }
    }

    fn numbers(&self, text: &str, least: usize, line: usize) -> Result<Vec<f32>> {
        let parse = |w: &str| w.parse::<f32>().ok().filter(|v| v.is_finite());
        let found: Option<Vec<f32>> = text.split_whitespace().map(parse).collect();
        found
            .filter(|n| n.len() >= least)
            .ok_or_else(|| self.wrong(line, &format!("\"{text:.40}\" is not {least} finite numbers; export the mesh again")))
    }

    /// Index from 0 of a reference, which counts from 1 or, if negative, backward from the last one so far.
    fn reference(&self, word: &str, count: usize, what: &str, line: usize) -> Result<u32> {
        let n: i64 = word.parse().map_err(|_| self.wrong(line, &format!("\"{word:.40}\" is not an index of a {what}")))?;
        let index = if n < 0 { n.checked_add(count as i64) } else { n.checked_sub(1) };
        let index = index.filter(|i| (0..count as i64).contains(i)).and_then(|i| u32::try_from(i).ok());
        index.ok_or_else(|| self.wrong(line, &format!("{what} {n} does not exist; there are {count} so far; export the mesh again")))
    }

    fn face(&mut self, text: &str, line: usize) -> Result<()> {
        let mut corners = Vec::new();
        for word in text.split_whitespace() {
            let mut words = word.split('/');
            let position = self.reference(words.next().unwrap_or_default(), self.positions.len(), "vertex", line)?;
            let mut optional = |count, what| match words.next().filter(|w| !w.is_empty()) {
                Some(w) => self.reference(w, count, what, line),
                None => Ok(NONE),
            };
            let uv = optional(self.uvs.len(), "texture coordinate")?;
            corners.push([position, uv, optional(self.normals.len(), "normal")?]);
        }
        if corners.len() < 3 {
            return Err(self.wrong(line, "a face has fewer than 3 corners; export the mesh again"));
        }
        let has = [1, 2].map(|k| corners.iter().all(|c| c[k] != NONE));
        let material = self.material;
        let index = *self.by_kind.entry((material, has)).or_insert_with(|| {
            self.parts.push(OpenPart { material, mesh: Mesh::default(), vertices: HashMap::new() });
            self.parts.len() - 1
        });
        let OpenPart { mesh, vertices, .. } = &mut self.parts[index];
        let colored = self.colors.len() == self.positions.len();
        let ids: Vec<u32> = corners
            .iter()
            .map(|c| {
                let corner = [c[0], if has[0] { c[1] } else { NONE }, if has[1] { c[2] } else { NONE }];
                *vertices.entry(corner).or_insert_with(|| {
                    mesh.positions.push(self.positions[corner[0] as usize]);
                    mesh.uvs.extend(self.uvs.get(corner[1] as usize));
                    mesh.normals.extend(self.normals.get(corner[2] as usize));
                    mesh.colors_srgb.extend(self.colors.get(corner[0] as usize).filter(|_| colored));
                    mesh.positions.len() as u32 - 1
                })
            })
            .collect();
        let places: Vec<DVec3> = ids.iter().map(|i| DVec3::from(mesh.positions[*i as usize].map(f64::from))).collect();
        mesh.faces.extend(polygon::triangulate(&places).into_iter().map(|t| t.map(|i| ids[i])));
        Ok(())
    }

    fn finish(mut self) -> Result<LoadedModel> {
        if self.parts.is_empty() {
            return Err(DataError::input(self.path, "the file has no faces; export the object as a mesh of polygons"));
        }
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut model = Model::default();
        let mut untextured = HashMap::new();
        for OpenPart { material, mut mesh, .. } in self.parts {
            if mesh.colors_srgb.len() != mesh.positions.len() {
                mesh.colors_srgb.clear();
            }
            let mut material = material.unwrap_or_else(|| {
                self.notes.add(format!("mesh \"{stem}\": faces without a material get the default material, matte white"));
                self.library.add(Material { name: "default".into(), ..Material::default() })
            });
            let name = self.library.materials[material].name.clone();
            if mesh.uvs.is_empty() && without_textures(&self.library.materials[material]) != self.library.materials[material] {
                let message =
                    format!("mesh \"{stem}\": faces of material \"{name}\" have no texture coordinates: its textures are left out");
                self.notes.add(message);
                material = *untextured.entry(material).or_insert_with(|| {
                    self.library.materials.push(without_textures(&self.library.materials[material]));
                    self.library.materials.len() - 1
                });
            }
            model.instances.push(Instance { part: model.parts.len(), world_from_part: DAffine3::IDENTITY });
            model.parts.push(Part { name, mesh, material });
        }
        (model.materials, model.textures) = (self.library.materials, self.library.textures);
        Ok(LoadedModel { model, notes: self.notes.0 })
    }
}

fn without_textures(material: &Material) -> Material {
    Material { base_color_texture: None, normal_texture: None, emission_texture: None, ..material.clone() }
}

#[cfg(test)]
mod tests;
