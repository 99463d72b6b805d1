//! Materials of the street.

use crate::assembly::{Finish, ModelBuilder};
use crate::textures as tx;
use diorama_geom::model::Material;

/// All finishes that houses, ground and furniture use.
pub struct Materials {
    /// Ocher, rose, cream, sage, slate blue, pale yellow.
    pub plaster: [Finish; 6],
    pub brick: Finish,
    pub blocks: Finish,
    /// Sandstone, limestone, granite.
    pub stone: [Finish; 3],
    pub roof: Finish,
    pub slate: Finish,
    pub asphalt: Finish,
    pub cobbles: Finish,
    pub slabs: Finish,
    pub soil: Finish,
    /// Off-white, bottle green, oxblood, brown, blue.
    pub wood: [Finish; 5],
    pub iron: Finish,
    pub zinc: Finish,
    pub glass: Finish,
    pub interior: Finish,
    pub curtain: Finish,
    pub awning: [Finish; 2],
    pub bark: Finish,
    pub leaves: [Finish; 2],
    pub marking: Finish,
    pub water: Finish,
    pub gold: Finish,
    pub clay: Finish,
    pub flower: Finish,
    /// Lacquers of cars.
    pub lacquer: [Finish; 5],
    pub rubber: Finish,
    pub chrome: Finish,
    pub trim: Finish,
    pub tail_light: Finish,
    pub lens: Finish,
}

/// A thin pane that lets most light through.
fn pane(builder: &mut ModelBuilder, name: &str, tint: [f32; 3], transmission: f32) -> Finish {
    let [r, g, b] = tint;
    let material = Material { name: name.into(), base_color: [r, g, b, 1.0], roughness: 0.03, transmission, ..Material::default() };
    builder.material(material, 1.0)
}

impl Materials {
    /// Adds all materials and their textures.
    pub fn new(builder: &mut ModelBuilder, seed: u64) -> Materials {
        let b = builder;
        let plaster = b.tiled("plaster", &tx::plaster(seed), 3.0);
        let stone = b.tiled("stone", &tx::stone(seed), 1.5);
        let wood = b.tiled("painted_wood", &tx::painted(seed), 1.0);
        Materials {
            plaster: [
                b.tinted(plaster, "plaster.ocher", [0.93, 0.62, 0.28]),
                b.tinted(plaster, "plaster.rose", [0.86, 0.46, 0.36]),
                b.tinted(plaster, "plaster.cream", [1.0, 0.92, 0.76]),
                b.tinted(plaster, "plaster.sage", [0.56, 0.64, 0.50]),
                b.tinted(plaster, "plaster.blue", [0.44, 0.55, 0.66]),
                b.tinted(plaster, "plaster.yellow", [1.0, 0.80, 0.44]),
            ],
            brick: b.tiled("brick", &tx::bricks(seed), 2.0),
            blocks: b.tiled("sandstone_blocks", &tx::blocks(seed), 2.4),
            stone: [
                b.tinted(stone, "stone.sandstone", [0.72, 0.57, 0.38]),
                b.tinted(stone, "stone.limestone", [0.82, 0.77, 0.67]),
                b.tinted(stone, "stone.granite", [0.42, 0.41, 0.41]),
            ],
            roof: b.tiled("roof_tiles", &tx::roof_tiles(seed), 1.5),
            slate: b.tiled("slates", &tx::slates(seed), 1.5),
            asphalt: b.tiled("asphalt", &tx::asphalt(seed), 3.0),
            cobbles: b.tiled("cobbles", &tx::cobbles(seed), 1.5),
            slabs: b.tiled("slabs", &tx::slabs(seed), 2.4),
            soil: b.tiled("soil", &tx::soil(seed), 2.0),
            wood: [
                b.tinted(wood, "wood.white", [1.0, 0.98, 0.93]),
                b.tinted(wood, "wood.green", [0.15, 0.33, 0.23]),
                b.tinted(wood, "wood.red", [0.5, 0.14, 0.12]),
                b.tinted(wood, "wood.brown", [0.42, 0.25, 0.15]),
                b.tinted(wood, "wood.blue", [0.2, 0.33, 0.52]),
            ],
            iron: b.plain("iron", [0.05, 0.052, 0.055], 0.45, 0.0),
            zinc: b.plain("zinc", [0.36, 0.37, 0.38], 0.5, 1.0),
            glass: pane(b, "glass", [0.82, 0.85, 0.84], 0.9),
            interior: b.plain("interior", [0.2, 0.17, 0.14], 0.95, 0.0),
            curtain: b.plain("curtain", [0.74, 0.71, 0.64], 0.95, 0.0),
            awning: [
                b.tiled("awning.red", &tx::stripes([0.5, 0.06, 0.055], [0.74, 0.71, 0.62]), 0.8),
                b.tiled("awning.green", &tx::stripes([0.06, 0.25, 0.13], [0.74, 0.71, 0.62]), 0.8),
            ],
            bark: b.tiled("bark", &tx::bark(seed), 1.0),
            leaves: [
                b.tiled("leaves.1", &tx::leaves(seed, [0.17, 0.28, 0.05], [0.06, 0.13, 0.045]), 1.0),
                b.tiled("leaves.2", &tx::leaves(seed + 1, [0.26, 0.30, 0.06], [0.10, 0.16, 0.045]), 1.0),
            ],
            marking: b.plain("marking", [0.62, 0.61, 0.58], 0.8, 0.0),
            water: b.plain("water", [0.045, 0.06, 0.055], 0.05, 0.0),
            gold: b.plain("gold", [0.8, 0.58, 0.24], 0.25, 1.0),
            clay: b.plain("clay", [0.4, 0.17, 0.09], 0.85, 0.0),
            flower: b.plain("flower", [0.6, 0.06, 0.07], 0.8, 0.0),
            lacquer: [
                b.plain("lacquer.red", [0.45, 0.045, 0.045], 0.2, 0.0),
                b.plain("lacquer.white", [0.78, 0.77, 0.74], 0.22, 0.0),
                b.plain("lacquer.blue", [0.05, 0.11, 0.28], 0.2, 0.0),
                b.plain("lacquer.silver", [0.55, 0.56, 0.57], 0.35, 1.0),
                b.plain("lacquer.green", [0.07, 0.17, 0.12], 0.2, 0.0),
            ],
            rubber: b.plain("rubber", [0.045, 0.045, 0.046], 0.8, 0.0),
            chrome: b.plain("chrome", [0.62, 0.63, 0.64], 0.18, 1.0),
            trim: b.plain("trim", [0.05, 0.05, 0.052], 0.55, 0.0),
            tail_light: b.plain("tail_light", [0.5, 0.045, 0.045], 0.15, 0.0),
            lens: pane(b, "lens", [0.83, 0.84, 0.85], 0.5),
        }
    }
}
