//! Models put together from named pieces of one material each.

use crate::surface::Surface;
use crate::textures::Tile;
use diorama_geom::ImageU8;
use diorama_geom::glam::{DAffine3, DVec3};
use diorama_geom::model::{Instance, Material, Model, Opacity, Part, Texture, Wrap};

/// A material's place in the model, and the size of its texture on the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Finish {
    pub material: usize,
    /// Edge of the repeating texture in meters.
    pub tile_m: f64,
}

/// Surfaces of one object by the name of their piece.
#[derive(Clone, Debug, Default)]
pub struct Assembly {
    pieces: Vec<(String, Finish, Surface)>,
}

impl Assembly {
    /// The surface of a piece and a finish; empty at first.
    pub fn piece(&mut self, name: &str, finish: Finish) -> &mut Surface {
        let known = self.pieces.iter().position(|(n, f, _)| n == name && *f == finish);
        let k = known.unwrap_or_else(|| {
            self.pieces.push((name.into(), finish, Surface::default()));
            self.pieces.len() - 1
        });
        &mut self.pieces[k].2
    }

    /// Adds the pieces of another assembly, moved.
    pub fn add(&mut self, other: &Assembly, self_from_other: DAffine3) {
        for (name, finish, surface) in &other.pieces {
            self.piece(name, *finish).add(surface, self_from_other);
        }
    }
}

/// A model under construction.
#[derive(Debug, Default)]
pub struct ModelBuilder {
    model: Model,
}

impl ModelBuilder {
    /// Adds a material; its texture repeats every `tile_m` meters.
    pub fn material(&mut self, material: Material, tile_m: f64) -> Finish {
        self.model.materials.push(material);
        Finish { material: self.model.materials.len() - 1, tile_m }
    }

    /// Adds a plain material of one linear color.
    pub fn plain(&mut self, name: &str, color: [f32; 3], roughness: f32, metallic: f32) -> Finish {
        let [r, g, b] = color;
        self.material(Material { name: name.into(), base_color: [r, g, b, 1.0], roughness, metallic, ..Material::default() }, 1.0)
    }

    /// Adds the images of a tile as textures and a material that uses them.
    pub fn tiled(&mut self, name: &str, tile: &Tile, tile_m: f64) -> Finish {
        let mut texture = |image| {
            self.model.textures.push(Texture { image, wrap: [Wrap::Repeat; 2] });
            Some(self.model.textures.len() - 1)
        };
        let color = tile.color_image();
        let opacity = if color.channels == 4 { Opacity::Cutoff(0.5) } else { Opacity::Opaque };
        let material = Material {
            name: name.into(),
            base_color_texture: texture(color),
            metallic_roughness_texture: texture(tile.metallic_roughness_image()),
            metallic: 1.0,
            normal_texture: tile.normal_image(tile_m).and_then(&mut texture),
            opacity,
            ..Material::default()
        };
        self.material(material, tile_m)
    }

    /// Adds a material that shows an RGB image once, with texture coordinates from 0 to 1.
    pub fn pictured(&mut self, name: &str, image: &ImageU8, roughness: f32) -> Finish {
        self.model.textures.push(Texture { image: image.clone(), wrap: [Wrap::Clamp; 2] });
        let texture = Some(self.model.textures.len() - 1);
        self.material(Material { name: name.into(), base_color_texture: texture, roughness, ..Material::default() }, 1.0)
    }

    /// Adds the same material in another color, which multiplies the texture's.
    pub fn tinted(&mut self, of: Finish, name: &str, color: [f32; 3]) -> Finish {
        let [r, g, b] = color;
        let material = Material { name: name.into(), base_color: [r, g, b, 1.0], ..self.model.materials[of.material].clone() };
        self.material(material, of.tile_m)
    }

    /// Adds the pieces of an object as parts named `name.piece`, each standing at all `places`.
    pub fn stand(&mut self, name: &str, object: &Assembly, places: &[DAffine3]) {
        for (piece, finish, surface) in &object.pieces {
            let part = self.model.parts.len();
            let mesh = surface.mesh(finish.tile_m);
            self.model.parts.push(Part { name: format!("{name}.{piece}"), mesh, material: finish.material });
            self.model.instances.extend(places.iter().map(|&world_from_part| Instance { part, world_from_part }));
        }
    }

    /// The model.
    pub fn finish(self) -> Model {
        self.model
    }
}

/// A move that first turns by `angle` about the vertical axis.
pub fn place(at: DVec3, angle: f64) -> DAffine3 {
    DAffine3::from_translation(at) * DAffine3::from_rotation_z(angle)
}
