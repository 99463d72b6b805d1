//! Wood, paint, cloth and gilding.

use super::{Noise, Texel, Tile, mix, scale, smooth_step};
use std::f32::consts::TAU;

/// Wood with its grain along v, 0.5 m, between a light and a dark color.
pub fn wood(seed: u64, light: [f32; 3], dark: [f32; 3]) -> Tile {
    let noise = Noise::new(seed, 301);
    Tile::paint(512, |u, v| {
        let bend = noise.fractal(u, v, 3, 2, 3);
        let rings = 0.5 + 0.5 * (TAU * (6.0 * u + 2.2 * bend)).sin();
        let fibers = noise.fractal(u, v, 96, 4, 3);
        let pores = smooth_step(0.66, 0.74, noise.smooth(u, v, 200, 10, 5));
        let t = (0.55 * rings.powf(1.6) + 0.5 * (fibers - 0.25)).clamp(0.0, 1.0);
        let color = scale(mix(light, dark, t), 1.0 - 0.3 * pores);
        Texel::matte(color, 0.0006 * (1.0 - pores) + 0.0003 * fibers, 0.38 + 0.2 * fibers + 0.15 * pores)
    })
}

/// Old paint on boards, nearly white so that a factor colors it, 1 m.
pub fn painted(seed: u64) -> Tile {
    let noise = Noise::new(seed, 302);
    Tile::paint(256, |u, v| {
        let fibers = noise.fractal(u, v, 48, 3, 3);
        let patches = noise.fractal(u, v, 4, 4, 4);
        let x = u * 8.0;
        let gap = smooth_step(0.0, 0.06, (x - x.round()).abs());
        let tone = (0.62 + 0.16 * fibers + 0.16 * (patches - 0.5)) * (0.55 + 0.45 * gap);
        Texel::matte([tone; 3], 0.004 * gap + 0.001 * fibers, 0.45 + 0.25 * patches)
    })
}

/// Striped awning cloth, 0.8 m.
pub fn stripes(a: [f32; 3], b: [f32; 3]) -> Tile {
    Tile::paint(256, |u, v| {
        let weave = 0.94 + 0.06 * (TAU * 64.0 * u).sin() * (TAU * 64.0 * v).sin();
        let first = (0.0..0.25).contains(&u) || (0.5..0.75).contains(&u);
        Texel::matte(scale(if first { a } else { b }, weave), 0.0, 0.95)
    })
}

/// Woven cloth with a gold-colored pattern of rosettes on red, 0.24 m.
pub fn brocade(seed: u64) -> Tile {
    let noise = Noise::new(seed, 304);
    Tile::paint(512, |u, v| {
        // Two rosettes per tile, the second one in the middle of four first ones.
        let rosette = |cu: f32, cv: f32| {
            let wrap = |d: f32| d - d.round();
            let (x, y) = (wrap(u - cu), wrap(v - cv));
            let (r, a) = (x.hypot(y), y.atan2(x));
            let petals = 0.17 + 0.05 * (8.0 * a).cos();
            let ring = (r - petals).abs() - 0.014;
            let heart = r - 0.045 - 0.012 * (8.0 * a).cos();
            ring.min(heart).min((r - 0.105).abs() - 0.008)
        };
        let diamond = ((2.0 * u).fract() - 0.5).abs() + ((2.0 * v).fract() - 0.5).abs();
        let lattice = (diamond - 0.5).abs() * 0.5 - 0.006;
        let pattern = 1.0 - smooth_step(-0.003, 0.003, rosette(0.25, 0.25).min(rosette(0.75, 0.75)).min(lattice));
        let (warp, weft) = ((TAU * 96.0 * u).sin(), (TAU * 96.0 * v).sin());
        let thread = 0.5 + 0.25 * warp + 0.25 * weft;
        let slub = noise.fractal(u, v, 64, 8, 2);
        let ground = scale([0.33, 0.055, 0.05], 0.6 + 0.35 * thread + 0.3 * slub);
        let gold = scale([0.55, 0.36, 0.12], 0.65 + 0.35 * thread + 0.2 * slub);
        Texel::matte(mix(ground, gold, pattern), 0.0003 * thread + 0.0006 * pattern, 0.9 - 0.25 * pattern)
    })
}

/// Hammered gold leaf, a metal, 0.2 m.
pub fn gilding(seed: u64) -> Tile {
    let noise = Noise::new(seed, 305);
    Tile::paint(256, |u, v| {
        let cell = noise.cell(u, v, 14, 0.8);
        let worn = noise.fractal(u, v, 4, 4, 4);
        let color = scale([0.8, 0.56, 0.22], 0.85 + 0.2 * (1.0 - worn));
        let height = 0.0011 * (0.5 - cell.nearest).max(0.0);
        Texel { color, alpha: 1.0, height, roughness: 0.2 + 0.2 * worn, metallic: 1.0 }
    })
}
