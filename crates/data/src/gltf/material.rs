//! Metallic-roughness materials, and the texture coordinates that their textures use.

use super::document::Document;
use super::schema::{self, TextureInfo, TextureTransform};
use super::texture::{self, Textures};
use crate::error::Result;
use crate::loaded_model::Notes;
use diorama_geom::model::{Material, Opacity};

/// The texture coordinates of a material: a set of the mesh, transformed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Coordinates {
    pub set: u32,
    pub transform: Transform,
}

/// KHR_texture_transform: `T R S`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transform {
    pub offset: [f32; 2],
    /// Radians, counter-clockwise where v points down.
    pub rotation: f32,
    pub scale: [f32; 2],
}

impl Default for Transform {
    fn default() -> Transform {
        Transform { offset: [0.0; 2], rotation: 0.0, scale: [1.0; 2] }
    }
}

impl Transform {
    pub fn apply(&self, [u, v]: [f32; 2]) -> [f32; 2] {
        let (sine, cosine) = self.rotation.sin_cos();
        let (u, v) = (self.scale[0] * u, self.scale[1] * v);
        [cosine * u + sine * v + self.offset[0], cosine * v - sine * u + self.offset[1]]
    }

    /// Whether u and v keep their directions, and with them the tangents.
    pub fn keeps_directions(&self) -> bool {
        self.rotation == 0.0 && self.scale.iter().all(|s| *s > 0.0)
    }
}

impl Coordinates {
    fn of(info: &TextureInfo) -> Coordinates {
        let TextureTransform { offset, rotation, scale, tex_coord } = info.extensions.transform.unwrap_or_default();
        Coordinates { set: tex_coord.unwrap_or(info.tex_coord), transform: Transform { offset, rotation, scale } }
    }
}

/// The coordinates of all textures of a material; `None` without textures.
///
/// # Errors
/// If textures of the material use different coordinates: a mesh has one set of them.
pub fn coordinates(document: &Document, index: usize) -> Result<Option<Coordinates>> {
    let (material, what) = find(document, index)?;
    let mut found: Option<Coordinates> = None;
    for info in kept(document, material, &what)? {
        let these = Coordinates::of(info);
        if found.is_some_and(|f| f != these) {
            return Err(document.wrong(format!(
                "{what}: its textures use different coordinates (texCoord or KHR_texture_transform), of which one set is read; bake them into one"
            )));
        }
        found = Some(these);
    }
    Ok(found)
}

fn find<'d>(document: &'d Document, index: usize) -> Result<(&'d schema::Material, String)> {
    let material = document.item(&document.root.materials, index, "material", "a mesh")?;
    Ok((material, Document::title("material", index, material.name.as_deref())))
}

/// The textures that are read; a black surface emits nothing.
fn kept<'d>(document: &Document, material: &'d schema::Material, what: &str) -> Result<Vec<&'d TextureInfo>> {
    let pbr = &material.pbr_metallic_roughness;
    let emissive = material.emissive_texture.as_ref().filter(|_| is_emissive(material));
    let all: Vec<&TextureInfo> = if material.extensions.unlit.is_some() {
        pbr.base_color_texture.iter().collect()
    } else {
        [&pbr.base_color_texture, &pbr.metallic_roughness_texture, &material.normal_texture].into_iter().flatten().chain(emissive).collect()
    };
    all.iter().try_for_each(|info| texture::source(document, info.index, what).map(drop))?;
    Ok(all)
}

fn is_emissive(material: &schema::Material) -> bool {
    material.emissive_factor.iter().any(|v| *v > 0.0)
}

/// Reads a material, without its textures if the mesh has no coordinates for them.
///
/// # Errors
/// If a number is out of its range or a texture cannot be read.
pub fn read(document: &Document, index: usize, has_uvs: bool, textures: &mut Textures, notes: &mut Notes) -> Result<Material> {
    let (material, what) = find(document, index)?;
    let pbr = &material.pbr_metallic_roughness;
    let unit = |name: &str, v: f32| {
        let message = || format!("{what}: {name} is {v}, outside of 0 to 1; correct it and export again");
        if (0.0..=1.0).contains(&v) { Ok(v) } else { Err(document.wrong(message())) }
    };
    pbr.base_color_factor.iter().try_for_each(|v| unit("baseColorFactor", *v).map(drop))?;
    let mut texture = |info: Option<&TextureInfo>| match info.filter(|_| has_uvs) {
        Some(info) => textures.add(document, info.index, &what, notes),
        None => Ok(None),
    };
    let name = material.name.clone().unwrap_or_default();
    let mut out = Material {
        name,
        base_color: pbr.base_color_factor,
        base_color_texture: texture(pbr.base_color_texture.as_ref())?,
        opacity: match material.alpha_mode.as_str() {
            "MASK" => Opacity::Cutoff(material.alpha_cutoff),
            "BLEND" => Opacity::Blend,
            _ => Opacity::Opaque,
        },
        is_two_sided: material.double_sided,
        ..Material::default()
    };
    if material.extensions.unlit.is_some() {
        // Emission would ignore the new light, and shine on other surfaces.
        notes.add(format!("{what} is unlit: its colors, which may hold light already, are read as the base color of a matte surface"));
        return Ok(out);
    }
    out.roughness = unit("roughnessFactor", pbr.roughness_factor)?;
    out.metallic = unit("metallicFactor", pbr.metallic_factor)?;
    out.metallic_roughness_texture = texture(pbr.metallic_roughness_texture.as_ref())?;
    out.normal_texture = texture(material.normal_texture.as_ref())?;
    out.normal_scale = material.normal_texture.as_ref().map_or(1.0, |t| t.scale);
    if is_emissive(material) {
        let strength = material.extensions.emissive_strength.as_ref().map_or(1.0, |e| e.emissive_strength);
        out.emission = material.emissive_factor.map(|v| v.max(0.0) * strength.max(0.0));
        out.emission_texture = texture(material.emissive_texture.as_ref())?;
    }
    if let Some(specular) = &material.extensions.specular {
        out.specular = unit("specularFactor", specular.specular_factor)?;
        if specular.specular_texture.is_some() || specular.specular_color_texture.is_some() || specular.specular_color_factor.is_some() {
            notes.add(format!("{what}: the texture and the color of its reflection are left out"));
        }
    }
    if let Some(transmission) = &material.extensions.transmission {
        out.transmission = unit("transmissionFactor", transmission.transmission_factor)?;
        if transmission.transmission_texture.is_some() {
            notes.add(format!("{what}: its transmission texture is left out"));
        }
    }
    if let Some(occlusion) = material.occlusion_texture.as_ref().filter(|_| has_uvs) {
        out.is_occluding = is_packed(document, pbr.metallic_roughness_texture.as_ref(), occlusion, &what)?;
        if !out.is_occluding {
            notes.add(format!("{what}: its occlusion texture is not in the image of roughness and metalness: it is left out"));
        } else if occlusion.strength != 1.0 {
            notes.add(format!("{what}: the strength {} of its occlusion is read as 1", occlusion.strength));
        }
    }
    Ok(out)
}

/// Whether occlusion lies in the same place of the same image as roughness and metalness.
fn is_packed(document: &Document, metallic_roughness: Option<&TextureInfo>, occlusion: &TextureInfo, what: &str) -> Result<bool> {
    let Some(other) = metallic_roughness else { return Ok(false) };
    let sources = [other, occlusion].map(|info| texture::source(document, info.index, what));
    let [a, b] = sources;
    Ok(a? == b? && Coordinates::of(other) == Coordinates::of(occlusion))
}
