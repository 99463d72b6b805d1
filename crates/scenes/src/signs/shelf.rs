//! A shelf of 2.4 × 2 m with boxes and cans whose fronts carry writing, before a wall; lit from an open room.

use super::views::CameraPath;
use super::{Board, Draw, Finishes, slab};
use crate::assembly::{Assembly, ModelBuilder};
use diorama_geom::glam::{DAffine3, DVec2, dvec2, dvec3};

/// Heights of the boards' tops, and the depth of the shelf in meters; its front is at y = 0.
const TOPS: [f64; 3] = [0.5, 1.0, 1.5];
const DEPTH: f64 = 0.45;
/// Middle of the goods.
const ROW: f64 = 0.2;

pub const PATH: CameraPath = CameraPath {
    from: [-0.95, -1.5, 1.05],
    to: [0.95, -1.45, 1.5],
    bulge: [0.0, -0.25, 0.0],
    looks_from: [-0.3, 0.2, 1.1],
    looks_to: [0.3, 0.2, 1.15],
    sway: 0.05,
    glance: 0.08,
};

/// Goods with writing: middle, half the width, height, and whether it is a can.
const GOODS: [([f64; 2], f64, f64, bool); 8] = [
    ([-0.82, 1.0], 0.17, 0.34, false),
    ([-0.3, 1.0], 0.15, 0.36, true),
    ([0.22, 1.0], 0.2, 0.3, false),
    ([0.78, 1.0], 0.15, 0.36, true),
    ([-0.6, 1.5], 0.22, 0.32, false),
    ([0.1, 1.5], 0.14, 0.34, true),
    ([0.68, 1.5], 0.2, 0.36, false),
    ([-0.1, 0.5], 0.24, 0.36, false),
];

/// How far back a thing stands, and how it is turned.
fn pose(draw: &Draw, k: usize) -> (f64, f64) {
    (ROW + draw.between(10 + k as u64, -0.05, 0.05), draw.between(20 + k as u64, -0.35, 0.35))
}

/// The labels of all goods.
pub fn boards(draw: &Draw) -> Vec<Board> {
    let label = |(k, ([x, z], half, height, is_can)): (usize, &([f64; 2], f64, f64, bool))| {
        let (y, turn) = pose(draw, k);
        let (sin, cos) = turn.sin_cos();
        let depth = if *is_can { *half } else { 0.1 };
        // The front, moved out by more than the label is thick.
        let at = [x + (depth + 0.005) * sin, y - (depth + 0.005) * cos, z + 0.5 * height];
        let wide = if *is_can { 1.75 * half } else { 1.8 * half };
        let board = Board::flat(at, turn, [wide, 0.42 * height]).thick(0.004);
        if *is_can { board.bent(half + 0.005) } else { board }
    };
    GOODS.iter().enumerate().map(label).collect()
}

/// The shelf, goods, and small things on the edge before them.
pub fn stand(b: &mut ModelBuilder, m: &Finishes, draw: &Draw) {
    slab(b, "shop.floor", m.slabs, [-4.0, -4.0, -0.1], [4.0, 0.6, 0.0]);
    slab(b, "shop.wall", m.plaster[draw.below(1, 4)], [-4.0, 0.6, -0.1], [4.0, 0.8, 3.0]);
    let mut shelf = Assembly::default();
    let wood = shelf.piece("wood", m.wood[draw.below(2, 2)]);
    for top in TOPS.into_iter().chain([0.08, 2.04]) {
        wood.cuboid(dvec3(-1.2, 0.0, top - 0.04), dvec3(1.2, DEPTH, top));
    }
    for x in [-1.24, 1.2] {
        wood.cuboid(dvec3(x, 0.0, 0.0), dvec3(x + 0.04, DEPTH, 2.04));
    }
    wood.cuboid(dvec3(-1.24, DEPTH, 0.0), dvec3(1.24, DEPTH + 0.02, 2.04));
    b.stand("shelf", &shelf, &[DAffine3::IDENTITY]);
    for (k, ([x, z], half, height, is_can)) in GOODS.iter().enumerate() {
        let (y, turn) = pose(draw, k);
        let mut thing = Assembly::default();
        let body = thing.piece("body", m.lacquer[(draw.below(30, 5) + 2 * k) % 5]);
        if *is_can {
            let profile = [dvec2(0.0, 0.0), dvec2(*half, 0.0), dvec2(*half, *height), dvec2(0.0, *height)];
            body.lathe(dvec3(0.0, 0.0, 0.0), &profile, 48);
            let lid = [[0.0, 0.0], [1.02, 0.0], [1.02, 0.012], [0.0, 0.012]].map(|[r, z]| DVec2::new(r * half, height + z));
            thing.piece("lid", m.steel).lathe(dvec3(0.0, 0.0, 0.0), &lid, 48);
        } else {
            body.cuboid(dvec3(-half, -0.1, 0.0), dvec3(*half, 0.1, *height));
        }
        let at = DAffine3::from_translation(dvec3(*x, y, *z)) * DAffine3::from_rotation_z(turn);
        b.stand(&format!("good.{k}"), &thing, &[at]);
    }
    let mut small = Assembly::default();
    for k in 0..7 {
        let x = -1.0 + 0.3 * k as f64 + draw.between(40 + k, -0.08, 0.08);
        let z = TOPS[1 + draw.below(50 + k, 2)];
        let height = draw.between(60 + k, 0.07, 0.15);
        let body = small.piece("body", m.lacquer[draw.below(70 + k, 5)]);
        let r = draw.between(80 + k, 0.025, 0.045);
        let profile = [[0.0, 0.0], [r, 0.0], [r, 0.7 * height], [0.4 * r, 0.8 * height], [0.4 * r, height], [0.0, height]];
        body.lathe(dvec3(x, 0.05, z), &profile.map(DVec2::from), 20);
    }
    b.stand("small", &small, &[DAffine3::IDENTITY]);
}
