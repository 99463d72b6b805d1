//! A furnished room of 6 × 5.2 m with posters, lit through a roof light and a window behind the camera.

use super::views::CameraPath;
use super::{Board, Draw, Finishes, slab};
use crate::assembly::{Assembly, ModelBuilder, place};
use diorama_geom::glam::{DAffine3, DVec2, DVec3, dvec3};
use std::f64::consts::FRAC_PI_2;

/// Half the width, half the depth, and the height in meters.
const HALF: [f64; 2] = [3.0, 2.6];
const HEIGHT: f64 = 2.9;

pub const PATH: CameraPath = CameraPath {
    from: [-1.9, -1.0, 1.3],
    to: [1.9, -1.2, 1.7],
    bulge: [0.0, -0.8, 0.1],
    looks_from: [1.5, 2.2, 1.55],
    looks_to: [-1.5, 2.2, 1.55],
    sway: 0.08,
    glance: 0.2,
};

/// Posters on three walls, and one that stands on the table.
pub fn boards(draw: &Draw) -> Vec<Board> {
    let [x, y] = [HALF[0] - 0.012, HALF[1] - 0.012];
    let poster = |at, yaw, size| Board::flat(at, yaw, size).thick(0.01);
    let shift = |what| draw.between(what, -0.12, 0.12);
    vec![
        poster([-2.1 + shift(0), y, 1.75 + shift(1)], 0.0, [1.15, 0.55]),
        poster([-0.6 + shift(2), y, 2.15 + 0.4 * shift(3)], 0.0, [1.2, 0.36]),
        poster([0.75 + shift(4), y, 1.65 + shift(5)], 0.0, [0.95, 0.7]).rolled(draw.between(6, -0.06, 0.06)),
        poster([2.15 + shift(7), y, 2.0 + shift(8)], 0.0, [0.9, 0.4]),
        poster([-x, 1.3 + shift(9), 1.75 + shift(10)], FRAC_PI_2, [1.2, 0.5]),
        poster([x, 1.2 + shift(11), 1.7 + shift(12)], -FRAC_PI_2, [1.1, 0.6]),
        poster([1.25 + shift(15), y, 2.5], 0.0, [1.0, 0.3]),
        Board::flat([0.15 + shift(13), 0.75, 0.955], draw.between(14, -0.5, 0.5), [0.6, 0.24]).leaning(0.25),
    ]
}

/// Walls, furniture, and a lamp and a plant that stand before posters.
pub fn stand(b: &mut ModelBuilder, m: &Finishes, draw: &Draw) {
    let [x, y] = HALF;
    let wall = m.plaster[draw.below(20, 4)];
    slab(b, "room.floor", m.wood[draw.below(21, 2)], [-x, -y, -0.1], [x, y, 0.0]);
    slab(b, "room.back", wall, [-x - 0.2, y, -0.1], [x + 0.2, y + 0.2, HEIGHT]);
    slab(b, "room.left", m.plaster[0], [-x - 0.2, -y, -0.1], [-x, y, HEIGHT]);
    slab(b, "room.right", m.plaster[0], [x, -y, -0.1], [x + 0.2, y, HEIGHT]);
    // A window in the wall behind the camera.
    slab(b, "room.front.below", wall, [-x - 0.2, -y - 0.2, -0.1], [x + 0.2, -y, 0.9]);
    slab(b, "room.front.above", wall, [-x - 0.2, -y - 0.2, 2.4], [x + 0.2, -y, HEIGHT]);
    slab(b, "room.front.left", wall, [-x - 0.2, -y - 0.2, 0.9], [-1.8, -y, 2.4]);
    slab(b, "room.front.right", wall, [1.8, -y - 0.2, 0.9], [x + 0.2, -y, 2.4]);
    // A roof light of 4 × 3 m.
    slab(b, "room.ceiling.left", m.plaster[0], [-x - 0.2, -y - 0.2, HEIGHT], [-2.0, y + 0.2, HEIGHT + 0.2]);
    slab(b, "room.ceiling.right", m.plaster[0], [2.0, -y - 0.2, HEIGHT], [x + 0.2, y + 0.2, HEIGHT + 0.2]);
    slab(b, "room.ceiling.back", m.plaster[0], [-2.0, 1.5, HEIGHT], [2.0, y + 0.2, HEIGHT + 0.2]);
    slab(b, "room.ceiling.front", m.plaster[0], [-2.0, -y - 0.2, HEIGHT], [2.0, -1.5, HEIGHT + 0.2]);
    slab(b, "room.skirting", m.wood[1], [-x, y - 0.02, 0.0], [x, y, 0.1]);
    b.stand("table", &table(m), &[DAffine3::from_translation(dvec3(0.1, 0.8, 0.0))]);
    b.stand("lamp", &lamp(m), &[DAffine3::from_translation(dvec3(draw.between(22, -1.75, -1.25), 1.2, 0.0))]);
    b.stand("plant", &plant(m, draw), &[DAffine3::from_translation(dvec3(draw.between(23, 1.3, 2.0), 1.6, 0.0))]);
    let mut boxes = Assembly::default();
    for k in 0..4 {
        let (w, h) = (draw.between(30 + k, 0.12, 0.28), draw.between(40 + k, 0.1, 0.35));
        let at = dvec3(-0.75 + 0.5 * k as f64, 0.95, 0.79);
        boxes.piece("side", m.lacquer[draw.below(50 + k, 5)]).cuboid(at, at + dvec3(w, 0.16, h));
    }
    b.stand("box", &boxes, &[DAffine3::IDENTITY]);
    b.stand("chest", &chest(m), &[place(dvec3(-2.55, -0.2, 0.0), FRAC_PI_2)]);
}

fn table(m: &Finishes) -> Assembly {
    let mut out = Assembly::default();
    let wood = out.piece("wood", m.wood[0]);
    wood.cuboid(dvec3(-1.0, -0.4, 0.75), dvec3(1.0, 0.4, 0.79));
    for (x, y) in [(-0.94, -0.34), (0.88, -0.34), (-0.94, 0.28), (0.88, 0.28)] {
        wood.cuboid(dvec3(x, y, 0.0), dvec3(x + 0.06, y + 0.06, 0.75));
    }
    out
}

/// A floor lamp with a shade.
fn lamp(m: &Finishes) -> Assembly {
    let mut out = Assembly::default();
    let pole = [[0.0, 0.0], [0.16, 0.0], [0.16, 0.03], [0.018, 0.05], [0.018, 1.5], [0.0, 1.5]];
    out.piece("pole", m.iron).lathe(DVec3::ZERO, &pole.map(DVec2::from), 20);
    let shade = [[0.2, 1.42], [0.14, 1.72]];
    out.piece("shade", m.plaster[1]).lathe(DVec3::ZERO, &shade.map(DVec2::from), 28);
    out
}

/// A pot with leaves of bent blades.
fn plant(m: &Finishes, draw: &Draw) -> Assembly {
    let mut out = Assembly::default();
    let pot = [[0.0, 0.0], [0.14, 0.0], [0.2, 0.34], [0.17, 0.34], [0.16, 0.3], [0.0, 0.3]];
    out.piece("pot", m.stone).lathe(DVec3::ZERO, &pot.map(DVec2::from), 24);
    let leaf = out.piece("leaf", m.leaf);
    for k in 0..14 {
        let (angle, lean) = (k as f64 * 2.4, draw.between(60 + k, 0.15, 0.5));
        let out_of = |s: f64| lean * s * s;
        let path: Vec<DVec3> = (0..6)
            .map(|i| {
                let s = i as f64 / 5.0;
                dvec3(out_of(s) * angle.cos(), out_of(s) * angle.sin(), 0.3 + (1.1 - lean) * s)
            })
            .collect();
        leaf.tube(&path, &[0.012, 0.03, 0.035, 0.03, 0.02, 0.004], 5);
    }
    out
}

fn chest(m: &Finishes) -> Assembly {
    let mut out = Assembly::default();
    out.piece("wood", m.wood[1]).cuboid(dvec3(-0.6, -0.22, 0.0), dvec3(0.6, 0.22, 0.8));
    let fronts = out.piece("fronts", m.wood[0]);
    for k in 0..3 {
        let z = 0.06 + 0.25 * k as f64;
        fronts.cuboid(dvec3(-0.56, -0.245, z), dvec3(0.56, -0.22, z + 0.22));
    }
    out
}
