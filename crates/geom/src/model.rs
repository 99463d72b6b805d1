//! Triangle meshes with metallic-roughness materials, placed in a scene, as glTF 2.0 describes them (z up here).

use crate::{ImageU8, Mesh};
use glam::DAffine3;

/// Parts and where they stand.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    pub parts: Vec<Part>,
    /// Copies of parts; a part without an instance is not in the scene.
    pub instances: Vec<Instance>,
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
}

/// Triangles of one material. The mesh's own texture and normal map are not used; its colors multiply the base color.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Part {
    pub name: String,
    pub mesh: Mesh,
    /// Index of the material.
    pub material: usize,
}

/// A part that stands somewhere. Under a mirroring transform (negative determinant) the outside stays outside: there, faces wind clockwise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Instance {
    /// Index of the part.
    pub part: usize,
    pub world_from_part: DAffine3,
}

/// How a surface scatters light. Values of textures multiply the factors.
#[derive(Clone, Debug, PartialEq)]
pub struct Material {
    pub name: String,
    /// Linear RGB and opacity.
    pub base_color: [f32; 4],
    /// Index of a texture of sRGB colors and opacity.
    pub base_color_texture: Option<usize>,
    pub roughness: f32,
    pub metallic: f32,
    /// Factor of the reflection at the surface of what is not metal; 0 makes it perfectly diffuse.
    pub specular: f32,
    /// Index of a texture whose green is roughness and whose blue is metalness; its red, if `is_occluding`, is ambient occlusion.
    pub metallic_roughness_texture: Option<usize>,
    pub is_occluding: bool,
    /// Index of a texture of normals in tangent space, `(n + 1) / 2`: x along u, y against v, z outward.
    pub normal_texture: Option<usize>,
    /// Factor of the normals' x and y.
    pub normal_scale: f32,
    /// Linear radiance that the surface emits.
    pub emission: [f32; 3],
    /// Index of a texture of sRGB colors.
    pub emission_texture: Option<usize>,
    /// Share of the light entering the surface that passes straight through, as through a thin pane, tinted by the base color.
    pub transmission: f32,
    pub opacity: Opacity,
    /// Whether the back is visible too.
    pub is_two_sided: bool,
}

impl Default for Material {
    /// Matte, white, opaque and visible from both sides.
    fn default() -> Material {
        Material {
            name: String::new(),
            base_color: [1.0; 4],
            base_color_texture: None,
            roughness: 1.0,
            metallic: 0.0,
            specular: 1.0,
            metallic_roughness_texture: None,
            is_occluding: false,
            normal_texture: None,
            normal_scale: 1.0,
            emission: [0.0; 3],
            emission_texture: None,
            transmission: 0.0,
            opacity: Opacity::Opaque,
            is_two_sided: true,
        }
    }
}

/// What the fourth channel of the base color means.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Opacity {
    /// Nothing.
    Opaque,
    /// Points below the value are holes.
    Cutoff(f32),
    /// The share of light that meets the surface.
    Blend,
}

/// An image on a surface; its coordinates are those of [`Mesh::uvs`].
#[derive(Clone, Debug, PartialEq)]
pub struct Texture {
    /// RGB or RGBA.
    pub image: ImageU8,
    /// What lies beyond 0 to 1, along u and v.
    pub wrap: [Wrap; 2],
}

/// Values of a texture outside of its image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Wrap {
    #[default]
    Repeat,
    Mirror,
    Clamp,
}

impl Model {
    /// One part, standing where its coordinates say.
    pub fn of(name: &str, mut mesh: Mesh) -> Model {
        let (texture, normal_map) = (mesh.texture.take(), mesh.normal_map.take());
        let mut model = Model::default();
        let mut add = |image: Option<ImageU8>| {
            image.map(|image| {
                model.textures.push(Texture { image, wrap: [Wrap::Clamp; 2] });
                model.textures.len() - 1
            })
        };
        let material =
            Material { name: name.into(), base_color_texture: add(texture), normal_texture: add(normal_map), ..Material::default() };
        model.materials.push(material);
        model.parts.push(Part { name: name.into(), mesh, material: 0 });
        model.instances.push(Instance { part: 0, world_from_part: DAffine3::IDENTITY });
        model
    }

    /// Adds another model, moved by `world_from_model`.
    pub fn add(&mut self, other: Model, world_from_model: DAffine3) {
        let (parts, materials, textures) = (self.parts.len(), self.materials.len(), self.textures.len());
        self.textures.extend(other.textures);
        self.materials.extend(other.materials.into_iter().map(|m| Material {
            base_color_texture: m.base_color_texture.map(|i| i + textures),
            metallic_roughness_texture: m.metallic_roughness_texture.map(|i| i + textures),
            normal_texture: m.normal_texture.map(|i| i + textures),
            emission_texture: m.emission_texture.map(|i| i + textures),
            ..m
        }));
        self.parts.extend(other.parts.into_iter().map(|p| Part { material: p.material + materials, ..p }));
        let moved = other.instances.into_iter();
        self.instances.extend(moved.map(|i| Instance { part: i.part + parts, world_from_part: world_from_model * i.world_from_part }));
    }

    /// Lowest and highest corner of all instances; `None` without vertices.
    pub fn bounds(&self) -> Option<([f64; 3], [f64; 3])> {
        let mut bounds: Option<(glam::DVec3, glam::DVec3)> = None;
        for instance in &self.instances {
            for p in &self.parts[instance.part].mesh.positions {
                let p = instance.world_from_part.transform_point3(glam::DVec3::from(p.map(f64::from)));
                bounds = Some(bounds.map_or((p, p), |(lo, hi)| (lo.min(p), hi.max(p))));
            }
        }
        bounds.map(|(lo, hi)| (lo.into(), hi.into()))
    }

    /// Triangles of all instances.
    pub fn face_count(&self) -> usize {
        self.instances.iter().map(|i| self.parts[i.part].mesh.faces.len()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn triangle(texture: bool) -> Model {
        let image = ImageU8 { width: 1, height: 1, channels: 3, data: vec![9; 3] };
        Model::of(
            "t",
            Mesh {
                positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
                uvs: vec![[0.0; 2]; 3],
                texture: texture.then_some(image),
                faces: vec![[0, 1, 2]],
                ..Mesh::default()
            },
        )
    }

    #[test]
    fn added_models_keep_their_materials_and_textures() {
        let mut model = triangle(true);
        model.add(triangle(false), DAffine3::IDENTITY);
        model.add(triangle(true), DAffine3::from_translation(DVec3::new(0.0, 0.0, 5.0)));
        let texture = |part: usize| model.materials[model.parts[part].material].base_color_texture;
        assert_eq!([0, 1, 2].map(texture), [Some(0), None, Some(1)]);
        assert_eq!(model.textures.len(), 2);
        assert_eq!(model.bounds(), Some(([0.0; 3], [1.0, 1.0, 5.0])));
        assert_eq!(model.face_count(), 3);
    }

    #[test]
    fn a_part_that_stands_nowhere_is_not_in_the_scene() {
        let mut model = triangle(false);
        model.instances.clear();
        assert_eq!((model.bounds(), model.face_count()), (None, 0));
    }
}
