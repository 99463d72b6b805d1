//! Materials of `.mtl` files: matte colors, textures, normal maps, opacity and emission.

use crate::error::{self, Result};
use crate::loaded_model::{Notes, decode_texture};
use crate::photo::Origin;
use diorama_geom::model::{Material, Opacity, Texture, Wrap};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Largest `.mtl` and texture that are read, in bytes.
const LIMIT: u64 = 1 << 30;

/// Materials by name, and their textures.
#[derive(Default)]
pub struct Library {
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    by_name: HashMap<String, usize>,
    /// Index of a texture by file and wrap.
    files: HashMap<(PathBuf, Wrap), usize>,
}

impl Library {
    /// Index of a material.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.by_name.get(name).copied()
    }

    /// Adds a material.
    pub fn add(&mut self, material: Material) -> usize {
        self.by_name.insert(material.name.clone(), self.materials.len());
        self.materials.push(material);
        self.materials.len() - 1
    }

    /// Reads the files that `mtllib` names beside `obj`: one with blanks in its name, or several.
    pub fn read(&mut self, names: &str, obj: &Path, notes: &mut Notes) -> Result<()> {
        let whole = obj.with_file_name(names);
        let files = if whole.is_file() { vec![whole] } else { names.split_whitespace().map(|n| obj.with_file_name(n)).collect() };
        for file in files {
            if file.is_file() {
                self.read_file(&file, notes)?;
            } else {
                notes.add(format!("{} is missing: its materials become the default material", file.display()));
            }
        }
        Ok(())
    }

    fn read_file(&mut self, path: &Path, notes: &mut Notes) -> Result<()> {
        let text = String::from_utf8_lossy(&error::read(path, LIMIT)?).into_owned();
        let mut current = None;
        for line in text.lines() {
            let (key, rest) = line.trim().split_once(char::is_whitespace).unwrap_or((line.trim(), ""));
            if key == "newmtl" {
                current = Some(self.add(Material { name: rest.trim().into(), ..Material::default() }));
            } else if let Some(index) = current {
                self.set(index, key, rest.trim(), path, notes)?;
            }
        }
        for material in self.materials.iter_mut().filter(|m| m.base_color_texture.is_some() && m.base_color[..3] == [0.0; 3]) {
            notes.add(format!("material \"{}\": Kd is black, which would hide its texture: it is read as white", material.name));
            material.base_color[..3].fill(1.0);
        }
        Ok(())
    }

    /// Sets one property; unknown ones are ignored.
    fn set(&mut self, index: usize, key: &str, value: &str, path: &Path, notes: &mut Notes) -> Result<()> {
        let numbers: Vec<f32> = value.split_whitespace().map_while(|w| w.parse().ok()).filter(|v: &f32| v.is_finite()).collect();
        let gray = |n: &[f32]| if n.len() < 3 { [n[0]; 3] } else { [n[0], n[1], n[2]] };
        let is_map = matches!(key.to_lowercase().as_str(), "map_kd" | "map_ke" | "norm");
        let texture = if is_map { self.texture(value, path, notes)? } else { None };
        let material = &mut self.materials[index];
        match (key.to_lowercase().as_str(), numbers.first()) {
            ("kd", Some(_)) => material.base_color[..3].copy_from_slice(&gray(&numbers).map(|v| v.clamp(0.0, 1.0))),
            ("ke", Some(_)) => material.emission = gray(&numbers).map(|v| v.max(0.0)),
            ("pr", Some(v)) => material.roughness = v.clamp(0.0, 1.0),
            ("pm", Some(v)) => material.metallic = v.clamp(0.0, 1.0),
            ("d", Some(v)) => set_opacity(material, *v),
            ("tr", Some(v)) => set_opacity(material, 1.0 - v),
            ("map_kd", _) => material.base_color_texture = texture,
            ("map_ke", _) => material.emission_texture = texture,
            ("norm", _) => material.normal_texture = texture,
            _ => {}
        }
        Ok(())
    }

    /// The texture of a `map_…` line, after its options.
    fn texture(&mut self, value: &str, mtl: &Path, notes: &mut Notes) -> Result<Option<usize>> {
        let (name, wrap) = file_name(value);
        let name = name.replace('\\', "/");
        let short = Path::new(&name).file_name().unwrap_or_default();
        let Some(file) = [mtl.with_file_name(&name), mtl.with_file_name(short)].into_iter().find(|f| f.is_file()) else {
            notes.add(format!("{}: the texture {name} is missing: it is left out", mtl.display()));
            return Ok(None);
        };
        if let Some(known) = self.files.get(&(file.clone(), wrap)) {
            return Ok(Some(*known));
        }
        let origin = Origin { path: &file, cure: "copy it again" };
        let image = decode_texture(origin, &error::read(&file, LIMIT)?)?;
        self.textures.push(Texture { image, wrap: [wrap; 2] });
        self.files.insert((file, wrap), self.textures.len() - 1);
        Ok(Some(self.textures.len() - 1))
    }
}

fn set_opacity(material: &mut Material, opacity: f32) {
    material.base_color[3] = opacity.clamp(0.0, 1.0);
    material.opacity = if opacity < 1.0 { Opacity::Blend } else { Opacity::Opaque };
}

/// File name of a `map_…` line, which may contain blanks, and `-clamp`.
fn file_name(value: &str) -> (&str, Wrap) {
    let (mut rest, mut wrap) = (value.trim(), Wrap::Repeat);
    while rest.starts_with('-') {
        let (option, mut after) = next_word(rest);
        let most = match option {
            "-o" | "-s" | "-t" => 3,
            "-mm" => 2,
            _ => 1,
        };
        for i in 0..most {
            let (word, following) = next_word(after);
            // Offsets and scales have one to three numbers.
            if i > 0 && word.parse::<f32>().is_err() {
                break;
            }
            if option == "-clamp" && word == "on" {
                wrap = Wrap::Clamp;
            }
            after = following;
        }
        rest = after;
    }
    (rest, wrap)
}

fn next_word(text: &str) -> (&str, &str) {
    let (word, rest) = text.split_once(char::is_whitespace).unwrap_or((text, ""));
    (word, rest.trim_start())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_before_a_file_name_are_skipped() {
        for (line, want) in [
            ("wood.png", ("wood.png", Wrap::Repeat)),
            ("-s 2 2 1 -o 0.5 old wood.png", ("old wood.png", Wrap::Repeat)),
            ("-clamp on -bm 0.3 -mm 0 1 a.png", ("a.png", Wrap::Clamp)),
            ("-", ("", Wrap::Repeat)),
        ] {
            assert_eq!(file_name(line), want, "{line}");
        }
    }
}
