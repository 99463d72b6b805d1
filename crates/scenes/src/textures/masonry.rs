//! Bricks, blocks, paving and roofing: courses of units with joints.

use super::{Noise, Texel, Tile, mix, scale, smooth_step};

/// A unit of a running bond at a point of the unit square.
struct Unit {
    column: i64,
    row: i64,
    /// Position within the unit, 0 to 1.
    at: [f32; 2],
    /// Distance to the closest edge of the unit, in tile edges.
    edge: f32,
}

/// Running bond of `columns × rows`: every other course is shifted by half a unit.
fn bond(u: f32, v: f32, columns: i64, rows: i64) -> Unit {
    let y = v * rows as f32;
    let row = (y.floor() as i64).rem_euclid(rows);
    let x = u * columns as f32 + if row % 2 == 1 { 0.5 } else { 0.0 };
    let at = [x - x.floor(), y - y.floor()];
    let edge = (at[0].min(1.0 - at[0]) / columns as f32).min(at[1].min(1.0 - at[1]) / rows as f32);
    Unit { column: (x.floor() as i64).rem_euclid(columns), row, at, edge }
}

/// Fired bricks in lime mortar, 2 m.
pub fn bricks(seed: u64) -> Tile {
    let noise = Noise::new(seed, 101);
    Tile::paint(512, |u, v| {
        let wobble = 0.0012 * (noise.smooth(u, v, 32, 32, 3) - 0.5);
        let unit = bond((u + wobble).rem_euclid(1.0), (v - wobble).rem_euclid(1.0), 8, 26);
        let hue = noise.value(unit.column, unit.row, 0);
        let tone = 0.75 + 0.5 * noise.value(unit.column, unit.row, 1);
        let grain = noise.fractal(u, v, 64, 64, 3);
        let body = scale(mix([0.36, 0.12, 0.07], [0.26, 0.10, 0.075], hue), tone * (0.75 + 0.5 * grain));
        let face = smooth_step(0.0022, 0.0042, unit.edge);
        let mortar = scale([0.42, 0.38, 0.32], 0.8 + 0.4 * grain);
        let height = face * (0.008 + 0.002 * noise.value(unit.column, unit.row, 2)) + 0.002 * grain;
        Texel::matte(mix(mortar, body, face), height, 0.85 + 0.1 * grain)
    })
}

/// Ashlar of sandstone, 2.4 m.
pub fn blocks(seed: u64) -> Tile {
    let noise = Noise::new(seed, 102);
    Tile::paint(512, |u, v| {
        let unit = bond(u, v, 3, 6);
        let tone = 0.82 + 0.3 * noise.value(unit.column, unit.row, 0);
        let warm = noise.value(unit.column, unit.row, 1);
        let grain = noise.fractal(u, v, 12, 12, 5);
        let strata = noise.smooth(u, v, 4, 48, 2);
        let body = scale(mix([0.50, 0.39, 0.25], [0.47, 0.40, 0.31], warm), tone * (0.78 + 0.35 * grain + 0.1 * strata));
        let face = smooth_step(0.0015, 0.0055, unit.edge);
        let height = 0.014 * face + 0.006 * grain + 0.003 * strata;
        Texel::matte(mix([0.25, 0.2, 0.15], body, face), height, 0.88)
    })
}

/// Rounded paving stones, 1.5 m.
pub fn cobbles(seed: u64) -> Tile {
    let noise = Noise::new(seed, 103);
    Tile::paint(512, |u, v| {
        let cell = noise.cell(u, v, 14, 0.28);
        let gap = cell.second - cell.nearest;
        let face = smooth_step(0.04, 0.2, gap);
        let tone = 0.65 + 0.7 * noise.value(cell.column, cell.row, 3);
        let grain = noise.fractal(u, v, 48, 48, 3);
        let stone = scale(mix([0.23, 0.22, 0.21], [0.27, 0.23, 0.19], noise.value(cell.column, cell.row, 4)), tone * (0.75 + 0.5 * grain));
        let height = 0.02 * smooth_step(0.0, 0.5, gap) + 0.002 * grain + 0.004 * noise.value(cell.column, cell.row, 5);
        Texel::matte(mix([0.075, 0.065, 0.055], stone, face), height, 0.9 - 0.25 * face)
    })
}

/// Stone flags of a pavement, 2.4 m.
pub fn slabs(seed: u64) -> Tile {
    let noise = Noise::new(seed, 104);
    Tile::paint(512, |u, v| {
        let unit = bond(u, v, 4, 6);
        let tone = 0.85 + 0.3 * noise.value(unit.column, unit.row, 0);
        let grain = noise.fractal(u, v, 24, 24, 4);
        let stain = noise.fractal(u, v, 4, 4, 3);
        let face = smooth_step(0.0012, 0.003, unit.edge);
        let body = scale([0.36, 0.345, 0.32], tone * (0.7 + 0.35 * grain + 0.3 * (stain - 0.3)));
        Texel::matte(mix([0.1, 0.095, 0.085], body, face), 0.006 * face + 0.001 * grain, 0.8)
    })
}

/// Clay pantiles, 1.5 m: each course overlaps the one below.
pub fn roof_tiles(seed: u64) -> Tile {
    let noise = Noise::new(seed, 105);
    Tile::paint(512, |u, v| {
        let (columns, rows) = (7i64, 5i64);
        let (x, y) = (u * columns as f32, v * rows as f32);
        let (column, row) = ((x.floor() as i64).rem_euclid(columns), (y.floor() as i64).rem_euclid(rows));
        let (s, t) = (x - x.floor(), y - y.floor());
        let tone = 0.7 + 0.55 * noise.value(column, row, 0);
        let grain = noise.fractal(u, v, 32, 32, 4);
        let moss = smooth_step(0.62, 0.75, noise.fractal(u, v, 5, 5, 4));
        let body = scale(mix([0.44, 0.16, 0.075], [0.36, 0.17, 0.11], noise.value(column, row, 1)), tone * (0.7 + 0.55 * grain));
        let wave = 0.5 - 0.5 * (std::f32::consts::TAU * s).cos();
        // The lower edge of a tile stands out and shades the top of the next course.
        let lip = smooth_step(0.0, 0.1, t);
        let shade = (0.35 + 0.65 * lip) * (0.6 + 0.4 * smooth_step(0.0, 0.25, wave));
        let color = scale(mix(body, [0.17, 0.16, 0.08], 0.6 * moss), shade);
        Texel::matte(color, 0.03 * wave.sqrt() + 0.02 * t + 0.002 * grain, 0.85)
    })
}

/// Slates, 1.5 m.
pub fn slates(seed: u64) -> Tile {
    let noise = Noise::new(seed, 106);
    Tile::paint(512, |u, v| {
        let unit = bond(u, v, 6, 10);
        let tone = 0.65 + 0.7 * noise.value(unit.column, unit.row, 0);
        let grain = noise.fractal(u, v, 24, 24, 4);
        let joint = smooth_step(0.0, 0.0035, unit.edge.min(unit.at[1] / 10.0 * 0.6));
        let body = scale(mix([0.13, 0.14, 0.16], [0.15, 0.14, 0.14], noise.value(unit.column, unit.row, 1)), tone * (0.75 + 0.4 * grain));
        Texel::matte(scale(body, 0.5 + 0.5 * joint), 0.008 * unit.at[1] + 0.004 * joint + 0.001 * grain, 0.6)
    })
}
