//! The trained object as a model of glTF's materials.

use super::config::CHANNELS;
use super::placement::Placement;
use super::textured::Textured;
use diorama_geom::color::{srgb_from_linear, u8_from_unit};
use diorama_geom::glam::DAffine3;
use diorama_geom::model::{Instance, Material, Model, Part, Texture, Wrap};
use diorama_geom::{ImageU8, Mesh};

/// The object in the world, with base color (sRGB), occlusion, roughness and metalness, and normals in tangent space as textures.
pub fn model(textured: &Textured, placement: &Placement, name: &str) -> Model {
    let mesh = textured.mesh();
    let mesh = Mesh { positions: mesh.positions.iter().map(|p| placement.to_world(*p)).collect(), ..mesh };
    let texels = textured.texels.values.as_chunks::<CHANNELS>().0;
    let size = texels.len().isqrt();
    let image = |of: &dyn Fn(&[f32; CHANNELS]) -> [f32; 3]| {
        let data = texels.iter().flat_map(|t| of(t).map(u8_from_unit)).collect();
        Texture { image: ImageU8 { width: size, height: size, channels: 3, data }, wrap: [Wrap::Clamp; 2] }
    };
    let normal = |t: &[f32; CHANNELS]| {
        let l = (t[6] * t[6] + t[7] * t[7] + t[8] * t[8]).sqrt().max(1e-6);
        [t[6], t[7], t[8]].map(|v| 0.5 + 0.5 * v / l)
    };
    let textures = vec![image(&|t| [t[0], t[1], t[2]].map(srgb_from_linear)), image(&|t| [1.0 - t[3], t[4], t[5]]), image(&normal)];
    let material = Material {
        name: name.into(),
        base_color_texture: Some(0),
        metallic_roughness_texture: Some(1),
        is_occluding: true,
        normal_texture: Some(2),
        roughness: 1.0,
        metallic: 1.0,
        is_two_sided: false,
        ..Material::default()
    };
    Model {
        parts: vec![Part { name: name.into(), mesh, material: 0 }],
        instances: vec![Instance { part: 0, world_from_part: DAffine3::IDENTITY }],
        materials: vec![material],
        textures,
    }
}
