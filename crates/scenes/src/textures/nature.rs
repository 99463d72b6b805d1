//! Plaster, stone, asphalt, soil, bark and leaves.

use super::{Noise, Texel, Tile, mix, scale, smooth_step};

/// Lime plaster, nearly white so that a factor colors it, 3 m.
pub fn plaster(seed: u64) -> Tile {
    let noise = Noise::new(seed, 201);
    Tile::paint(512, |u, v| {
        let patches = noise.fractal(u, v, 3, 3, 5);
        let grain = noise.fractal(u, v, 96, 96, 2);
        let streaks = noise.smooth(u, v, 40, 3, 1) * noise.smooth(u, v, 9, 2, 2);
        let tone = 0.72 + 0.14 * (patches - 0.5) * 2.0 + 0.08 * (grain - 0.5) - 0.1 * streaks;
        let dirt = smooth_step(0.55, 0.8, noise.fractal(u, v, 5, 4, 5));
        Texel::matte(mix([tone; 3], [0.5 * tone, 0.48 * tone, 0.44 * tone], 0.5 * dirt), 0.004 * grain + 0.01 * patches, 0.92)
    })
}

/// Smooth stone of trims and columns, nearly white so that a factor colors it, 1.5 m.
pub fn stone(seed: u64) -> Tile {
    let noise = Noise::new(seed, 202);
    Tile::paint(256, |u, v| {
        let clouds = noise.fractal(u, v, 4, 6, 5);
        let grain = noise.fractal(u, v, 64, 64, 2);
        let tone = 0.5 + 0.4 * clouds + 0.16 * (grain - 0.5);
        Texel::matte([tone, 0.99 * tone, 0.96 * tone], 0.002 * grain + 0.004 * clouds, 0.85)
    })
}

/// Worn asphalt, 3 m.
pub fn asphalt(seed: u64) -> Tile {
    let noise = Noise::new(seed, 203);
    Tile::paint(512, |u, v| {
        let grit = noise.smooth(u, v, 200, 200, 1);
        let stones = smooth_step(0.72, 0.9, grit);
        let worn = noise.fractal(u, v, 3, 3, 5);
        let crack = (noise.fractal(u, v, 4, 4, 4) - 0.5).abs();
        let line = 1.0 - smooth_step(0.002, 0.006, crack) * 1.0;
        let color = mix(scale([0.1, 0.1, 0.102], 0.7 + 0.6 * worn), [0.24, 0.23, 0.22], 0.7 * stones);
        Texel::matte(scale(color, 1.0 - 0.45 * line), 0.003 * grit - 0.006 * line, 0.9)
    })
}

/// Bare soil, 2 m.
pub fn soil(seed: u64) -> Tile {
    let noise = Noise::new(seed, 204);
    Tile::paint(256, |u, v| {
        let lumps = noise.fractal(u, v, 12, 12, 5);
        let grass = smooth_step(0.5, 0.62, noise.fractal(u, v, 5, 5, 5));
        Texel::matte(scale(mix([0.17, 0.12, 0.08], [0.11, 0.15, 0.055], grass), 0.5 + lumps), 0.02 * lumps, 0.95)
    })
}

/// Ridged bark, 1 m.
pub fn bark(seed: u64) -> Tile {
    let noise = Noise::new(seed, 205);
    Tile::paint(256, |u, v| {
        let bend = 0.06 * (noise.smooth(u, v, 4, 6, 1) - 0.5);
        let ridges = 1.0 - (2.0 * noise.fractal((u + bend).rem_euclid(1.0), v, 14, 4, 4) - 1.0).abs() * 2.0;
        let grain = noise.fractal(u, v, 32, 32, 3);
        let color = mix([0.075, 0.06, 0.047], [0.23, 0.185, 0.145], (0.6 * ridges + 0.5 * grain).clamp(0.0, 1.0));
        Texel::matte(color, 0.02 * ridges + 0.004 * grain, 0.92)
    })
}

/// A twig with leaves on a transparent ground, 1 tile wide; it does not repeat.
pub fn leaves(seed: u64, young: [f32; 3], old: [f32; 3]) -> Tile {
    let noise = Noise::new(seed, 206);
    // Base, direction, length and tone of each leaf: pairs along a twig that rises through the middle, and one at its tip.
    let leaves: Vec<[f32; 6]> = (0..15)
        .map(|k| {
            let side = if k % 2 == 0 { 1.0 } else { -1.0 };
            let t = (k / 2) as f32 / 7.0;
            let lean = if k == 14 { 0.0 } else { side * (0.95 - 0.5 * t + 0.35 * (noise.value(k, 0, 0) - 0.5)) };
            let length = (0.34 - 0.12 * (2.0 * t - 0.7).abs()) * (0.85 + 0.3 * noise.value(k, 0, 1));
            let (base_u, base_v) = (0.5 + 0.05 * (3.0 * t).sin(), 0.97 - 0.72 * t);
            [base_u, base_v, lean.sin(), -lean.cos(), length, noise.value(k, 0, 2)]
        })
        .collect();
    Tile::paint(256, |u, v| {
        let mut texel = Texel { color: old, alpha: 0.0, height: 0.0, roughness: 0.55, metallic: 0.0 };
        let twig = (u - 0.5 - 0.05 * (3.0 * (0.97 - v) / 0.72).sin()).abs();
        if twig < 0.006 && (0.25..0.99).contains(&v) {
            texel = Texel { color: [0.12, 0.09, 0.05], alpha: 1.0, ..texel };
        }
        for &[bu, bv, du, dv, length, tone] in &leaves {
            let (x, y) = (u - bu, v - bv);
            let (along, across) = ((x * du + y * dv) / length, (x * dv - y * du).abs() / length);
            let half_width = if (0.0..1.0).contains(&along) { 0.27 * (along.sqrt() * (1.0 - along)).sqrt() * 1.5 } else { -1.0 };
            if across < half_width {
                let vein = 1.0 - smooth_step(0.0, 0.035, across) * 1.0;
                let ribs = 0.92 + 0.08 * ((along + across * 0.8) * 40.0).sin();
                let color = scale(mix(old, young, (0.25 + 0.75 * tone - 0.2 * along).clamp(0.0, 1.0)), ribs * (1.0 + 0.5 * vein));
                texel = Texel { color, alpha: 1.0, ..texel };
            }
        }
        texel
    })
}
