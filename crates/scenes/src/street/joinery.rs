//! What fills and frames the openings of a façade: windows, doors, shop fronts, surrounds, shutters, balconies, awnings.

use super::materials::Materials;
use super::wall::{Opening, frame, pane};
use crate::assembly::{Assembly, Finish};
use crate::surface::Surface;
use diorama_geom::glam::{DAffine3, dvec2, dvec3};

/// How a window looks.
#[derive(Clone, Copy)]
pub struct WindowStyle {
    pub wood: Finish,
    pub trim: Finish,
    pub shutters: Option<Finish>,
    /// Width of the surround in meters; 0 for none.
    pub surround: f64,
    /// Horizontal bars.
    pub bars: usize,
}

/// A window set back by `depth`, with panes, bars, a sill and a surround; curtains hang behind `curtain` of its width on each side.
pub fn window(house: &mut Assembly, m: &Materials, o: &Opening, depth: f64, style: &WindowStyle, curtain: f64) {
    let (front, back) = (depth - 0.06, depth);
    let inset = 0.065;
    let wood = house.piece("frames", style.wood);
    let inner = o.outline(inset);
    frame(wood, &o.outline(0.0), &inner, [front, back]);
    let (left, right) = (o.x - 0.5 * o.width + inset, o.x + 0.5 * o.width - inset);
    // Bars are thinner than the frame and end inside of it.
    let edge = 0.02;
    wood.cuboid(dvec3(o.x - 0.035, front + 0.012, o.bottom + edge), dvec3(o.x + 0.035, back - 0.012, o.top - edge));
    for k in 1..=style.bars {
        let z = o.bottom + (o.spring() - o.bottom) * k as f64 / style.bars as f64 - if o.is_arched { 0.0 } else { 0.02 };
        if z < o.top - 2.0 * inset {
            wood.cuboid(dvec3(left - edge, front + 0.018, z - 0.018), dvec3(right + edge, back - 0.018, z + 0.018));
        }
    }
    pane(house.piece("glass", m.glass), &inner, front + 0.03);
    if curtain > 0.0 && !o.is_round {
        let cloth = house.piece("curtains", m.curtain);
        let width = curtain * o.width;
        for (x, sign) in [(left, 1.0), (right, -1.0)] {
            let (a, b) = if sign > 0.0 { (x, x + width) } else { (x - width, x) };
            cloth.grid(7, 1, |i, j| {
                let s = i as f64 / 7.0;
                let z = if j == 0 { o.bottom } else { o.top };
                let fold = 0.03 * (s * width * 45.0).sin();
                (dvec3(a + (b - a) * s, depth + 0.12 + fold, z), dvec2(s * width, -z))
            });
        }
    }
    surround(house, o, style);
    if let (Some(color), false) = (style.shutters, o.is_arched) {
        for side in [-1.0, 1.0] {
            let center = o.x + side * (o.width * 0.75 + style.surround + 0.04);
            shutter(house.piece("shutters", color), [center - 0.25 * o.width, center + 0.25 * o.width], [o.bottom + 0.03, o.top]);
        }
    }
}

/// A stone frame around an opening, and a sill.
fn surround(house: &mut Assembly, o: &Opening, style: &WindowStyle) {
    let s = style.surround;
    if s <= 0.0 {
        return;
    }
    let trim = house.piece("trim", style.trim);
    frame(trim, &o.outline(-s), &o.outline(0.0), [-0.055, 0.004]);
    if !o.is_round {
        let half = 0.5 * o.width + s + 0.07;
        trim.cuboid(dvec3(o.x - half, -0.16, o.bottom - s - 0.05), dvec3(o.x + half, 0.09, o.bottom + 0.02));
    }
    if !o.is_arched {
        // A cornice over the lintel.
        let profile = [dvec2(-0.02, 0.0), dvec2(0.07, 0.0), dvec2(0.09, 0.05), dvec2(0.17, 0.08), dvec2(0.17, 0.12), dvec2(-0.02, 0.15)];
        let up = dvec2(0.0, o.top + s + 0.04);
        let profile = profile.map(|p| p + up);
        let half = 0.5 * o.width + s + 0.06;
        trim.molding(&profile, o.x - half, o.x + half);
    }
}

/// An open shutter with slats that lies on the wall.
fn shutter(surface: &mut Surface, x: [f64; 2], z: [f64; 2]) {
    let outer = Opening::rectangle(0.5 * (x[0] + x[1]), x[1] - x[0], z[0], z[1]);
    frame(surface, &outer.outline(0.0), &outer.outline(0.06), [-0.075, -0.03]);
    let slats = ((z[1] - z[0] - 0.12) / 0.2) as usize;
    for k in 0..slats {
        let low = z[0] + 0.06 + (z[1] - z[0] - 0.12) * k as f64 / slats as f64;
        let outline = [dvec2(0.064, low + 0.005), dvec2(0.072, low + 0.005), dvec2(0.041, low + 0.19), dvec2(0.033, low + 0.19)];
        surface.molding(&outline, x[0] + 0.045, x[1] - 0.045);
    }
}

/// A double door with panels, a light above and a step.
pub fn door(house: &mut Assembly, m: &Materials, o: &Opening, depth: f64, wood: Finish, trim: Finish) {
    let leaf_top = (o.spring() - o.bottom).min(2.5) + o.bottom;
    let (left, right) = (o.x - 0.5 * o.width, o.x + 0.5 * o.width);
    let boards = house.piece("doors", wood);
    frame(boards, &o.outline(0.0), &o.outline(0.09), [depth - 0.08, depth]);
    boards.cuboid(dvec3(left + 0.07, depth - 0.045, o.bottom + 0.01), dvec3(right - 0.07, depth - 0.01, leaf_top));
    boards.cuboid(dvec3(left + 0.07, depth - 0.09, leaf_top - 0.06), dvec3(right - 0.07, depth - 0.006, leaf_top + 0.06));
    for side in [-1.0, 1.0] {
        let x = o.x + side * 0.25 * (o.width - 0.16);
        let half = 0.25 * (o.width - 0.16) - 0.07;
        for [low, high] in [[0.14, 0.38], [0.44, 0.94]] {
            let panel = Opening::rectangle(x, 2.0 * half, o.bottom + low * (leaf_top - o.bottom), o.bottom + high * (leaf_top - o.bottom));
            frame(boards, &panel.outline(0.0), &panel.outline(0.06), [depth - 0.075, depth - 0.04]);
            let inner = panel.outline(0.11);
            boards.plate(&inner, depth - 0.062, depth - 0.04);
        }
    }
    house.piece("brass", m.gold).ball(dvec3(o.x + 0.06, depth - 0.1, o.bottom + 1.05), 0.035, 10);
    if o.top - leaf_top > 0.3 {
        let mut light = *o;
        light.bottom = leaf_top + 0.06;
        pane(house.piece("glass", m.glass), &light.outline(0.09), depth - 0.04);
        let z = 0.5 * (light.bottom + o.top);
        let bars = house.piece("iron", m.iron);
        for k in -1..=1 {
            let x = o.x + k as f64 * o.width * 0.2;
            bars.cuboid(dvec3(x - 0.012, depth - 0.075, light.bottom), dvec3(x + 0.012, depth - 0.055, z + 0.25 * (o.top - light.bottom)));
        }
    }
    let stone = house.piece("trim", trim);
    frame(stone, &o.outline(-0.2), &o.outline(0.0), [-0.08, 0.004]);
    stone.cuboid(dvec3(left - 0.3, -0.45, o.bottom - 0.6), dvec3(right + 0.3, depth + 0.3, o.bottom + 0.015));
}

/// A shop window with a low wall of boards, a signboard above and an awning.
pub fn shop(house: &mut Assembly, m: &Materials, o: &Opening, depth: f64, wood: Finish, awning: Option<Finish>) {
    let (left, right) = (o.x - 0.5 * o.width, o.x + 0.5 * o.width);
    let base = o.bottom + 0.55;
    let boards = house.piece("shop", wood);
    boards.cuboid(dvec3(left, depth - 0.1, o.bottom - 0.3), dvec3(right, depth, base));
    let glazed = Opening { bottom: base, ..*o };
    frame(boards, &glazed.outline(0.0), &glazed.outline(0.07), [depth - 0.08, depth]);
    let n = (o.width / 1.1).round().max(1.0) as usize;
    for k in 1..n {
        let x = left + o.width * k as f64 / n as f64;
        boards.cuboid(dvec3(x - 0.03, depth - 0.07, base + 0.02), dvec3(x + 0.03, depth - 0.012, o.top - 0.02));
    }
    boards.cuboid(dvec3(left - 0.25, -0.1, o.top + 0.02), dvec3(right + 0.25, 0.02, o.top + 0.5));
    let rail = [dvec2(-0.01, 0.5), dvec2(0.16, 0.5), dvec2(0.2, 0.56), dvec2(-0.01, 0.6)].map(|p| p + dvec2(0.0, o.top));
    boards.molding(&rail, left - 0.28, right + 0.28);
    pane(house.piece("glass", m.glass), &glazed.outline(0.07), depth - 0.04);
    // Boxes on display.
    for k in 0..n {
        let x = left + o.width * (k as f64 + 0.5) / n as f64;
        let color = [m.clay, m.curtain, m.wood[4], m.wood[2]][k % 4];
        house
            .piece("goods", color)
            .cuboid(dvec3(x - 0.3, depth + 0.2, base), dvec3(x + 0.25, depth + 0.6, base + 0.3 + 0.17 * (k % 3) as f64));
    }
    house.piece("goods", m.interior).cuboid(dvec3(left, depth + 0.08, base - 0.2), dvec3(right, depth + 0.9, base - 0.002));
    if let Some(cloth) = awning {
        let (z, out, drop) = (o.top + 0.02, 1.35, 0.55);
        let s = house.piece("awning", cloth);
        s.slope(&[
            dvec3(left - 0.2, -out, z - drop),
            dvec3(right + 0.2, -out, z - drop),
            dvec3(right + 0.2, -0.12, z),
            dvec3(left - 0.2, -0.12, z),
        ]);
        s.slope(&[
            dvec3(left - 0.2, -out, z - drop - 0.22),
            dvec3(right + 0.2, -out, z - drop - 0.22),
            dvec3(right + 0.2, -out, z - drop),
            dvec3(left - 0.2, -out, z - drop),
        ]);
    }
}

/// A balcony on consoles in front of an opening, with an iron railing.
pub fn balcony(house: &mut Assembly, m: &Materials, x: [f64; 2], z: f64, trim: Finish, out: f64) {
    let slab =
        [dvec2(-0.05, -0.2), dvec2(out - 0.14, -0.2), dvec2(out - 0.06, -0.12), dvec2(out, -0.1), dvec2(out, 0.0), dvec2(-0.05, 0.0)];
    let stone = house.piece("trim", trim);
    stone.molding(&slab.map(|p| p + dvec2(0.0, z)), x[0], x[1]);
    let console = [
        dvec2(-0.05, -0.75),
        dvec2(0.08, -0.75),
        dvec2(0.14, -0.55),
        dvec2(0.3, -0.42),
        dvec2(0.6 * out, -0.36),
        dvec2(0.75 * out, -0.19),
        dvec2(-0.05, -0.19),
    ];
    for cx in [x[0] + 0.25, x[1] - 0.25] {
        stone.molding(&console.map(|p| p + dvec2(0.0, z)), cx - 0.09, cx + 0.09);
    }
    let iron = house.piece("iron", m.iron);
    let inset = 0.07;
    let y = -(out - inset);
    let corners = [dvec2(x[0] + inset, -0.02), dvec2(x[0] + inset, y), dvec2(x[1] - inset, y), dvec2(x[1] - inset, -0.02)];
    for pair in corners.windows(2) {
        let (a, b) = (pair[0], pair[1]);
        for (height, r) in [(0.12, 0.012), (0.98, 0.022)] {
            iron.tube(&[a.extend(z + height), b.extend(z + height)], &[r, r], 6);
        }
        let n = (a.distance(b) / 0.17).round().max(1.0) as usize;
        for k in 0..n {
            let p = a.lerp(b, (k as f64 + 0.5) / n as f64);
            iron.tube(&[p.extend(z + 0.115), p.extend(z + 0.97)], &[0.009, 0.009], 4);
            if k % 4 == 0 {
                iron.ball(p.extend(z + 0.55), 0.028, 6);
            }
        }
    }
    for p in corners {
        iron.tube(&[p.extend(z - 0.01), p.extend(z + 1.02)], &[0.018, 0.018], 6);
    }
}

/// A planter with plants from leaf cards, standing at `z` in front of a window.
pub fn planter(house: &mut Assembly, m: &Materials, x: [f64; 2], y: f64, z: f64, seed: u64) {
    house.piece("planter", m.clay).cuboid(dvec3(x[0], y - 0.11, z), dvec3(x[1], y + 0.11, z + 0.17));
    let noise = crate::textures::Noise::new(seed, 71);
    let n = ((x[1] - x[0]) / 0.07) as i64;
    for k in 0..n {
        let at = dvec3(x[0] + (x[1] - x[0]) * (k as f64 + 0.5) / n as f64, y + 0.1 * (noise.value(k, 0, 0) as f64 - 0.5), z + 0.12);
        let turn =
            DAffine3::from_rotation_z(noise.value(k, 0, 1) as f64 * 6.3) * DAffine3::from_rotation_x(-0.5 * noise.value(k, 0, 2) as f64);
        let mut card = Surface::default();
        super::tree::card(&mut card, 0.32);
        house.piece("plants", m.leaves[0]).add(&card, DAffine3::from_translation(at) * turn);
        if k % 3 == 0 {
            let height = 0.14 + 0.16 * noise.value(k, 0, 3) as f64;
            house.piece("flowers", m.flower).ball(at + dvec3(0.02, -0.06, height), 0.03, 6);
        }
    }
}
