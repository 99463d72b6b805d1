//! Distant light as on the CPU: the environment map, drawn from in proportion to its radiance, and the sun's disc.

use super::angles::{arc_cosine, frame, sin_cos_turns, turns_of};
use super::sampler::Pair;
use crate::gpu::vector::{V3, along, dot, float, read, scale, sub};
use cubecl::prelude::*;
use std::f32::consts::PI;

/// Words of the light before its tables.
pub const HEADER: usize = 18;
pub const WIDTH: usize = 0;
pub const HEIGHT: usize = 1;
pub const TURN: usize = 2;
pub const SUN_SHARE: usize = 3;
/// 1 where there is a sun.
pub const SUN: usize = 4;
pub const SUN_DIRECTION: usize = 5;
pub const SUN_CAP: usize = 8;
pub const SUN_RADIANCE: usize = 9;
pub const SUN_DENSITY: usize = 12;
/// Where tables begin: of the distribution of rows, of those of columns, edges and texels.
pub const ROWS: usize = 13;
pub const ROW_GUIDE: usize = 14;
pub const COLUMNS: usize = 15;
pub const COLUMN_GUIDE: usize = 16;
pub const EDGES: usize = 17;

/// A direction toward light.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub struct Drawn {
    pub direction: V3,
    pub radiance: V3,
    pub density: f32,
}

/// A point of the map in pixels, and the texel that it lies in.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Place {
    x: f32,
    y: f32,
    inside: u32,
}

/// A direction, and where it meets the map.
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Toward {
    direction: V3,
    place: Place,
}

/// An interval of a distribution, and where in it.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Step {
    index: u32,
    place: f32,
}

/// The interval of `n` that a number in `[0, 1)` falls into, in a row of a distribution.
#[cube]
fn find(light: &[u32], sums: u32, guide: u32, n: u32, row: u32, random: f32) -> Step {
    let bucket = min(u32::cast_from(max(random * f32::cast_from(n), 0.0)), n - 1);
    let start = (sums + row * (n + 1)) as usize;
    let mut at = light[(guide + row * n + bucket) as usize];
    while at + 1 < n && float(light, start + at as usize + 1) <= random {
        at += 1;
    }
    let below = float(light, start + at as usize);
    let size = float(light, start + at as usize + 1) - below;
    let mut place = 0.5f32;
    if size > 0.0 {
        place = clamp((random - below) / size, 0.0, 1.0);
    }
    Step { index: at, place }
}

/// Where a direction of length 1 meets the map.
#[cube]
fn place_of(light: &[u32], d: V3) -> Place {
    let width = light[WIDTH];
    let height = light[HEIGHT];
    let u = 0.5 + turns_of(d.x, d.y) + float(light, TURN);
    let x = (u - u.floor()) * f32::cast_from(width);
    let y = arc_cosine(d.z) / PI * f32::cast_from(height);
    let column = min(u32::cast_from(max(x, 0.0)), width - 1);
    let row = min(u32::cast_from(max(y, 0.0)), height - 1);
    Place { x, y, inside: row * width + column }
}

/// Radiance at a place of the map, bilinear, and with the sun's where the direction points into it.
#[cube]
fn at(light: &[u32], place: &Place, direction: V3) -> Drawn {
    let width = light[WIDTH];
    let height = light[HEIGHT];
    let texels = light[EDGES] + height + 1;
    let x = clamp(place.x - 0.5, -1.0, f32::cast_from(width));
    let y = clamp(place.y - 0.5, -1.0, f32::cast_from(height));
    let fx = x - x.floor();
    let fy = y - y.floor();
    // One more than the texel to the left, so that it is no negative number.
    let right = u32::cast_from(x.floor() + 1.0);
    let lower = u32::cast_from(y.floor() + 1.0);
    let left = select(right == 0, width, min(right, width)) - 1;
    let upper = max(min(lower, height), 1) - 1;
    let first = upper * width;
    let second = min(lower, height - 1) * width;
    let next = select(right >= width, 0u32, right);
    let a = read(light, (texels + (first + left) * 4) as usize);
    let b = read(light, (texels + (first + next) * 4) as usize);
    let c = read(light, (texels + (second + left) * 4) as usize);
    let d = read(light, (texels + (second + next) * 4) as usize);
    let above = along(scale(a, 1.0 - fx), fx, b);
    let below = along(scale(c, 1.0 - fx), fx, d);
    let mut radiance = along(scale(above, 1.0 - fy), fy, below);
    let mut density = float(light, (texels + place.inside * 4 + 3) as usize);
    let chord = sub(read(light, SUN_DIRECTION), direction);
    if light[SUN] == 1 && dot(chord, chord) <= 2.0 * float(light, SUN_CAP) {
        radiance = along(radiance, 1.0, read(light, SUN_RADIANCE));
        density += float(light, SUN_DENSITY) * float(light, SUN_SHARE);
    }
    Drawn { direction, radiance, density }
}

/// Light from a direction of length 1, and the density with which [`draw`] draws it.
#[cube]
pub fn evaluate(light: &[u32], direction: V3) -> Drawn {
    at(light, &place_of(light, direction), direction)
}

/// A direction from the sun's disc.
#[cube]
pub fn draw_sun(light: &[u32], random: Pair) -> V3 {
    let cap = random.first * float(light, SUN_CAP);
    let cosine = 1.0 - cap;
    let sine = (cap * (1.0 + cosine)).sqrt();
    let f = frame(read(light, SUN_DIRECTION));
    let around = sin_cos_turns(random.second);
    along(along(scale(f.n, cosine), sine * around.cosine, f.s), sine * around.sine, f.t)
}

/// A direction from two numbers in `[0, 1)`.
#[cube]
pub fn draw(light: &[u32], random: Pair) -> Drawn {
    let share = float(light, SUN_SHARE);
    let toward = if random.first < share {
        let direction = draw_sun(light, Pair { first: random.first / share, second: random.second });
        Toward { direction, place: place_of(light, direction) }
    } else {
        let width = light[WIDTH];
        let height = light[HEIGHT];
        let from_map = clamp((random.first - share) / max(1.0 - share, 1e-7), 0.0, 1.0 - f32::EPSILON);
        let row = find(light, light[ROWS], light[ROW_GUIDE], height, 0u32.runtime(), from_map);
        let column = find(light, light[COLUMNS], light[COLUMN_GUIDE], width, row.index, random.second);
        let edge = (light[EDGES] + row.index) as usize;
        // Even in solid angle, not in the polar angle.
        let z = float(light, edge) + row.place * (float(light, edge + 1) - float(light, edge));
        let sine = max(1.0 - z * z, 0.0).sqrt();
        let x = f32::cast_from(column.index) + column.place;
        let y = arc_cosine(z) / PI * f32::cast_from(height);
        let around = sin_cos_turns(x / f32::cast_from(width) - 0.5 - float(light, TURN));
        Toward {
            direction: V3 { x: sine * around.sine, y: sine * around.cosine, z },
            place: Place { x, y, inside: row.index * width + column.index },
        }
    };
    at(light, &toward.place, toward.direction)
}
