//! Materials, textures and images of glTF.

use super::binary::{CLAMP, Chunk, LINEAR, LINEAR_MIPMAP, MIRROR, REPEAT, name};
use crate::error::{DataError, Result};
use crate::photo;
use diorama_geom::model::{Material, Model, Opacity, Texture, Wrap};
use serde_json::{Value, json};
use std::collections::{BTreeSet, HashMap};
use std::path::Path;

/// The materials written so far, with what they use.
#[derive(Default)]
pub struct Materials {
    pub materials: Vec<Value>,
    pub textures: Vec<Value>,
    pub images: Vec<Value>,
    pub samplers: Vec<Value>,
    pub extensions: BTreeSet<&'static str>,
    /// Index in glTF by index in the model.
    known: HashMap<usize, usize>,
    known_textures: HashMap<usize, usize>,
    known_samplers: HashMap<[Wrap; 2], usize>,
}

impl Materials {
    /// Index in glTF of a material of the model, which is written at its first use.
    ///
    /// # Errors
    /// If a number of the material is outside of its range.
    pub fn add(&mut self, model: &Model, index: usize, chunk: &mut Chunk, path: &Path) -> Result<usize> {
        if let Some(known) = self.known.get(&index) {
            return Ok(*known);
        }
        let material = &model.materials[index];
        check(material, path)?;
        let mut texture = |index: Option<usize>| index.map(|i| json!({ "index": self.texture(&model.textures[i], i, chunk) }));
        let mut pbr = json!({
            "baseColorFactor": material.base_color,
            "metallicFactor": material.metallic,
            "roughnessFactor": material.roughness,
        });
        if let Some(base) = texture(material.base_color_texture) {
            pbr["baseColorTexture"] = base;
        }
        let packed = texture(material.metallic_roughness_texture);
        if let Some(packed) = &packed {
            pbr["metallicRoughnessTexture"] = packed.clone();
        }
        let normal = texture(material.normal_texture);
        let emissive = texture(material.emission_texture);
        let mut out = json!({ "pbrMetallicRoughness": pbr });
        name(&mut out, &material.name);
        if let Some(packed) = packed.filter(|_| material.is_occluding) {
            out["occlusionTexture"] = packed;
        }
        if let Some(mut normal) = normal {
            normal["scale"] = material.normal_scale.into();
            out["normalTexture"] = normal;
        }
        if let Some(emissive) = emissive {
            out["emissiveTexture"] = emissive;
        }
        match material.opacity {
            Opacity::Opaque => {}
            Opacity::Blend => out["alphaMode"] = "BLEND".into(),
            Opacity::Cutoff(cutoff) => {
                out["alphaMode"] = "MASK".into();
                out["alphaCutoff"] = cutoff.into();
            }
        }
        if material.is_two_sided {
            out["doubleSided"] = true.into();
        }
        self.emission_and_transmission(material, &mut out);
        self.materials.push(out);
        self.known.insert(index, self.materials.len() - 1);
        Ok(self.materials.len() - 1)
    }

    fn emission_and_transmission(&mut self, material: &Material, out: &mut Value) {
        let strength = material.emission.into_iter().fold(0.0, f32::max);
        if strength > 0.0 {
            out["emissiveFactor"] = json!(material.emission.map(|v| if strength > 1.0 { v / strength } else { v }));
        }
        let mut extension = |name: &'static str, value: Value| {
            out["extensions"][name] = value;
            self.extensions.insert(name);
        };
        if strength > 1.0 {
            extension("KHR_materials_emissive_strength", json!({ "emissiveStrength": strength }));
        }
        if material.specular < 1.0 {
            extension("KHR_materials_specular", json!({ "specularFactor": material.specular }));
        }
        if material.transmission > 0.0 {
            extension("KHR_materials_transmission", json!({ "transmissionFactor": material.transmission }));
        }
    }

    fn texture(&mut self, texture: &Texture, index: usize, chunk: &mut Chunk) -> usize {
        if let Some(known) = self.known_textures.get(&index) {
            return *known;
        }
        let view = chunk.view(photo::encode_png(&texture.image), None);
        self.images.push(json!({ "mimeType": "image/png", "bufferView": view }));
        let samplers = &mut self.samplers;
        let sampler = *self.known_samplers.entry(texture.wrap).or_insert_with(|| {
            let [s, t] = texture.wrap.map(wrap);
            samplers.push(json!({ "magFilter": LINEAR, "minFilter": LINEAR_MIPMAP, "wrapS": s, "wrapT": t }));
            samplers.len() - 1
        });
        self.textures.push(json!({ "sampler": sampler, "source": self.images.len() - 1 }));
        self.known_textures.insert(index, self.textures.len() - 1);
        self.textures.len() - 1
    }
}

fn wrap(wrap: Wrap) -> u32 {
    match wrap {
        Wrap::Repeat => REPEAT,
        Wrap::Mirror => MIRROR,
        Wrap::Clamp => CLAMP,
    }
}

fn check(material: &Material, path: &Path) -> Result<()> {
    let wrong = |what: &str, v: f32, range: &str| {
        Err(DataError::input(path, format!("material \"{}\": {what} is {v}, not {range}; correct it", material.name)))
    };
    let factors = material.base_color.iter().map(|v| ("base color", *v));
    let others = [
        ("roughness", material.roughness),
        ("metalness", material.metallic),
        ("transmission", material.transmission),
        ("reflection", material.specular),
    ];
    if let Some((what, v)) = factors.chain(others).find(|(_, v)| !(0.0..=1.0).contains(v)) {
        return wrong(what, v, "0 to 1");
    }
    if let Some(v) = material.emission.iter().find(|v| !(v.is_finite() && **v >= 0.0)) {
        return wrong("emission", *v, "0 or more");
    }
    if !material.normal_scale.is_finite() {
        return wrong("the scale of normals", material.normal_scale, "finite");
    }
    match material.opacity {
        Opacity::Cutoff(v) if !(v.is_finite() && v >= 0.0) => wrong("the cutoff of opacity", v, "0 or more"),
        _ => Ok(()),
    }
}
