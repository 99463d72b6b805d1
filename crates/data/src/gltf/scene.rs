//! Nodes of the scene, flattened to instances of parts.

use super::document::Document;
use super::texture::Textures;
use super::{extensions, material, placement, primitive};
use crate::error::Result;
use crate::loaded_model::{LoadedModel, Notes};
use diorama_geom::glam::DAffine3;
use diorama_geom::model::{Instance, Material, Model, Part};
use std::collections::HashMap;
use std::path::Path;

/// Reads the scene of a `.glb` or `.gltf` file: triangles with metallic-roughness materials, without animation.
///
/// # Errors
/// If the file is damaged, refers to a file that is missing, or requires an extension that is not read.
pub fn read(path: &Path) -> Result<LoadedModel> {
    let document = Document::open(path)?;
    let mut reader = Reader {
        document: &document,
        model: Model::default(),
        notes: Notes::default(),
        textures: Textures::default(),
        materials: HashMap::new(),
        parts: HashMap::new(),
    };
    extensions::note(&document.root, &mut reader.notes);
    reader.place_nodes()?;
    if reader.model.instances.is_empty() {
        return Err(document.wrong("no node of its scene has triangles; export the objects as meshes"));
    }
    let Reader { mut model, notes, textures, .. } = reader;
    model.textures = textures.read;
    Ok(LoadedModel { model, notes: notes.0 })
}

struct Reader<'a> {
    document: &'a Document<'a>,
    model: Model,
    notes: Notes,
    textures: Textures,
    /// Index of a material by its index in glTF, if it has one, and by whether its textures can be used.
    materials: HashMap<(Option<usize>, bool), usize>,
    /// Indices of the parts of a mesh.
    parts: HashMap<usize, Vec<usize>>,
}

impl Reader<'_> {
    fn place_nodes(&mut self) -> Result<()> {
        let document = self.document;
        let root = &document.root;
        let roots = match root.scenes.get(root.scene.unwrap_or(0)) {
            Some(scene) => scene.nodes.clone(),
            None => {
                let mut is_child = vec![false; root.nodes.len()];
                root.nodes.iter().flat_map(|n| &n.children).for_each(|c| is_child.get_mut(*c).into_iter().for_each(|is| *is = true));
                (0..root.nodes.len()).filter(|i| !is_child[*i]).collect()
            }
        };
        let mut seen = vec![false; root.nodes.len()];
        let mut open: Vec<(usize, DAffine3)> = roots.into_iter().rev().map(|i| (i, DAffine3::IDENTITY)).collect();
        while let Some((index, world_from_parent)) = open.pop() {
            let node = document.item(&root.nodes, index, "node", "the scene")?;
            let what = Document::title("node", index, node.name.as_deref());
            if std::mem::replace(&mut seen[index], true) {
                return Err(document.wrong(format!("{what} is part of the scene twice; export the scene again")));
            }
            let world_from_node = world_from_parent * placement::of(document, node, &what)?;
            if !world_from_node.is_finite() {
                return Err(document.wrong(format!("{what}: its place is not finite; correct the transforms above it")));
            }
            if let Some(mesh) = node.mesh {
                if node.skin.is_some() {
                    self.notes.add(format!("{what}: its skin is left out, and its mesh stands as it was modeled"));
                }
                let world_from_part = placement::z_up(world_from_node);
                let parts = self.parts_of(mesh, &what)?;
                self.model.instances.extend(parts.into_iter().map(|part| Instance { part, world_from_part }));
            }
            open.extend(node.children.iter().rev().map(|c| (*c, world_from_node)));
        }
        Ok(())
    }

    /// The parts of a mesh, read at its first use.
    fn parts_of(&mut self, index: usize, node: &str) -> Result<Vec<usize>> {
        if let Some(parts) = self.parts.get(&index) {
            return Ok(parts.clone());
        }
        let document = self.document;
        let mesh = document.item(&document.root.meshes, index, "mesh", node)?;
        let what = Document::title("mesh", index, mesh.name.as_deref());
        let mut parts = Vec::new();
        for primitive in &mesh.primitives {
            let coordinates = primitive.material.map(|m| material::coordinates(document, m)).transpose()?.flatten();
            let Some(triangles) = primitive::read(document, primitive, coordinates, &what, &mut self.notes)? else { continue };
            let has_uvs = !triangles.uvs.is_empty();
            if coordinates.is_some() && !has_uvs {
                self.notes.add(format!("{what} has no texture coordinates: the textures of its material are left out"));
            }
            let material = self.material(primitive.material, has_uvs || coordinates.is_none(), &what)?;
            parts.push(self.model.parts.len());
            let name = mesh.name.clone().unwrap_or_default();
            self.model.parts.push(Part { name, mesh: triangles, material });
        }
        self.parts.insert(index, parts.clone());
        Ok(parts)
    }

    fn material(&mut self, index: Option<usize>, has_uvs: bool, mesh: &str) -> Result<usize> {
        if index.is_none() {
            self.notes.add(format!("{mesh} has no material: the default material, matte white, is used"));
        }
        if let Some(known) = self.materials.get(&(index, has_uvs)) {
            return Ok(*known);
        }
        let material = match index {
            Some(index) => material::read(self.document, index, has_uvs, &mut self.textures, &mut self.notes)?,
            None => Material { name: "default".into(), ..Material::default() },
        };
        self.model.materials.push(material);
        self.materials.insert((index, has_uvs), self.model.materials.len() - 1);
        Ok(self.model.materials.len() - 1)
    }
}
