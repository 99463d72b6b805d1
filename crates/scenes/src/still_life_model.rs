//! The objects of [`crate::still_life`] as a model: closed meshes whose textures hold the procedural colors, with a plausible roughness.

use crate::ray_caster::{Object, Shape, Texture as Pattern};
use crate::still_life;
use diorama_geom::color::{srgb_from_linear, u8_from_unit};
use diorama_geom::glam::{DMat3, DVec2, DVec3, dvec2, dvec3};
use diorama_geom::model::{Instance, Material, Model, Part, Texture, Wrap};
use diorama_geom::{ImageU8, Mesh};
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};

/// Names of the parts, in the order of the scene's objects.
pub const NAMES: [&str; 6] = ["table", "ball.red", "box.dots", "can", "ball.violet", "box.rings"];

/// Segments around balls and cylinders.
const SEGMENTS: usize = 128;

/// A piece of a surface: columns and rows of its quads, and points with normals over the unit square.
struct Chart {
    cells: [usize; 2],
    at: Box<dyn Fn(f64, f64) -> (DVec3, DVec3) + Sync>,
}

/// Charts that cover a shape once; u runs to the right and v down seen from outside.
fn charts(shape: &Shape) -> Vec<Chart> {
    match *shape {
        Shape::Sphere { center, radius } => vec![Chart {
            cells: [SEGMENTS, SEGMENTS / 2],
            at: Box::new(move |u, v| {
                let (longitude, polar) = (TAU * (u % 1.0), PI * v);
                let r = if v == 0.0 || v == 1.0 { 0.0 } else { polar.sin() };
                let n = dvec3(r * longitude.cos(), r * longitude.sin(), polar.cos());
                (center + n * radius, n)
            }),
        }],
        Shape::Cylinder { center, radius, half_height } => {
            let rim = move |u: f64, r: f64| dvec2((TAU * (u % 1.0)).cos(), (TAU * (u % 1.0)).sin()) * r;
            let side = Chart {
                cells: [SEGMENTS, 1],
                at: Box::new(move |u, v| (center + rim(u, radius).extend(half_height * (1.0 - 2.0 * v)), rim(u, 1.0).extend(0.0))),
            };
            let cap = |sign: f64| Chart {
                cells: [SEGMENTS, 1],
                // v is the share of the radius.
                at: Box::new(move |u, v| {
                    (center + rim(if sign > 0.0 { u } else { 1.0 - u }, radius * v).extend(sign * half_height), DVec3::Z * sign)
                }),
            };
            vec![side, cap(1.0), cap(-1.0)]
        }
        Shape::Box { center, half, angle } => {
            let turn = DMat3::from_rotation_z(angle);
            let face = |right: DVec3, down: DVec3| Chart {
                cells: [1, 1],
                at: Box::new(move |u, v| {
                    let n = down.cross(right);
                    let p = (n + right * (2.0 * u - 1.0) + down * (2.0 * v - 1.0)) * half;
                    (center + turn * p, turn * n)
                }),
            };
            let (x, y, z) = (DVec3::X, DVec3::Y, DVec3::Z);
            vec![face(x, -z), face(y, -z), face(-x, -z), face(-y, -z), face(x, -y), face(x, y)]
        }
    }
}

/// Place of a chart in the texture: charts stand side by side with a border of `GUTTER` pixels.
#[derive(Clone, Copy)]
struct Slot {
    corner: [usize; 2],
    size: [usize; 2],
}

/// Pixels of the textures per unit of length.
const PIXELS: f64 = 600.0;

/// Pixels between a chart and its neighbors.
const GUTTER: usize = 4;

/// Whether a chart is a disk in polar coordinates; those are stored as squares so that the middle gets no more pixels than the rim.
fn is_disk(shape: &Shape, chart: usize) -> bool {
    matches!(shape, Shape::Cylinder { .. }) && chart > 0
}

/// Texture coordinates in the chart's square for chart coordinates.
fn in_square(shape: &Shape, chart: usize, u: f64, v: f64) -> DVec2 {
    if is_disk(shape, chart) { dvec2((TAU * u).cos(), -(TAU * u).sin()) * (0.5 * v) + 0.5 } else { dvec2(u, v) }
}

/// Point of the surface for texture coordinates in the chart's square.
fn point(shape: &Shape, index: usize, chart: &Chart, q: DVec2) -> DVec3 {
    if is_disk(shape, index) {
        let d = (q - 0.5) * 2.0;
        (chart.at)((-d.y).atan2(d.x).rem_euclid(TAU) / TAU, d.length().min(1.0)).0
    } else {
        (chart.at)(q.x, q.y).0
    }
}

/// Side-by-side places for the charts of a shape, and the texture's size.
fn slots(shape: &Shape) -> (Vec<Slot>, [usize; 2]) {
    let of = |w: f64, h: f64| [w, h].map(|v| (v * PIXELS).round() as usize);
    let sizes: Vec<[usize; 2]> = match *shape {
        Shape::Sphere { radius, .. } => vec![of(TAU * radius, PI * radius)],
        Shape::Cylinder { radius, half_height, .. } => {
            vec![of(TAU * radius, 2.0 * half_height), of(2.0 * radius, 2.0 * radius), of(2.0 * radius, 2.0 * radius)]
        }
        Shape::Box { half, .. } => {
            let side = |a: f64, b: f64| of(2.0 * a, 2.0 * b);
            let (x, y, z) = (half.x, half.y, half.z);
            vec![side(x, z), side(y, z), side(x, z), side(y, z), side(x, y), side(x, y)]
        }
    };
    // Two rows for cylinders: the side above, both disks below.
    let rows: Vec<Vec<[usize; 2]>> =
        if matches!(shape, Shape::Cylinder { .. }) { vec![sizes[..1].to_vec(), sizes[1..].to_vec()] } else { vec![sizes] };
    let (mut out, mut extent, mut y) = (Vec::new(), [0, 0], GUTTER);
    for row in rows {
        let mut x = GUTTER;
        for &size in &row {
            out.push(Slot { corner: [x, y], size });
            x += size[0] + 2 * GUTTER;
        }
        extent[0] = extent[0].max(x);
        y += row.iter().map(|s| s[1]).max().unwrap_or(0) + 2 * GUTTER;
    }
    (out, [extent[0], y])
}

/// Colors of the pattern at the surface, averaged over 3 × 3 points of each pixel after the sRGB encoding.
fn texture(shape: &Shape, pattern: &Pattern, charts: &[Chart], slots: &[Slot], size: [usize; 2]) -> ImageU8 {
    let mut data = vec![128u8; size[0] * size[1] * 3];
    for (index, (chart, slot)) in charts.iter().zip(slots).enumerate() {
        let [left, top] = slot.corner.map(|c| c - GUTTER);
        let [width, height] = slot.size.map(|s| s + 2 * GUTTER);
        // Pixels of the gutter repeat the nearest color of the chart.
        let at = |pixel: usize, k: usize, sub: usize| {
            let inside = (pixel as f64 + (sub as f64 + 0.5) / 3.0 - GUTTER as f64) / slot.size[k] as f64;
            inside.clamp(0.0, 1.0 - 1e-9)
        };
        let rows = data.par_chunks_exact_mut(size[0] * 3).skip(top).take(height).enumerate();
        rows.for_each(|(y, row)| {
            for x in 0..width {
                let color = |s: usize| {
                    let p = point(shape, index, chart, dvec2(at(x, 0, s % 3), at(y, 1, s / 3)));
                    DVec3::from_array(pattern.color(p).to_array().map(|c| srgb_from_linear(c as f32) as f64))
                };
                let mean = (0..9).map(color).sum::<DVec3>() / 9.0;
                row[3 * (left + x)..][..3].copy_from_slice(&mean.to_array().map(|c| u8_from_unit(c as f32)));
            }
        });
    }
    ImageU8 { width: size[0], height: size[1], channels: 3, data }
}

/// The closed mesh of a shape.
fn mesh(shape: &Shape, charts: &[Chart], slots: &[Slot], size: [usize; 2]) -> Mesh {
    let mut mesh = Mesh::default();
    for (index, (chart, slot)) in charts.iter().zip(slots).enumerate() {
        let [columns, rows] = chart.cells;
        let first = mesh.positions.len() as u32;
        for j in 0..=rows {
            for i in 0..=columns {
                let (u, v) = (i as f64 / columns as f64, j as f64 / rows as f64);
                let (p, n) = (chart.at)(u, v);
                mesh.positions.push(p.as_vec3().to_array().map(|v| v + 0.0));
                mesh.normals.push(n.as_vec3().to_array());
                let q = in_square(shape, index, u, v);
                mesh.uvs.push(std::array::from_fn(|k| ((slot.corner[k] as f64 + q[k] * slot.size[k] as f64) / size[k] as f64) as f32));
            }
        }
        let at = |i: usize, j: usize| first + (j * (columns + 1) + i) as u32;
        for j in 0..rows {
            for i in 0..columns {
                let quad = [at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)];
                for f in [[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]] {
                    let p = f.map(|k| mesh.positions[k as usize]);
                    if p[0] != p[1] && p[1] != p[2] && p[2] != p[0] {
                        mesh.faces.push(f);
                    }
                }
            }
        }
    }
    mesh
}

/// The still life: six parts named by [`NAMES`], each with a texture of its own without overlaps.
pub fn model() -> Model {
    let mut model = Model::default();
    for (index, (name, Object { shape, texture: pattern, gloss })) in NAMES.iter().zip(still_life::scene().objects).enumerate() {
        let charts = charts(&shape);
        let (slots, size) = slots(&shape);
        model.textures.push(Texture { image: texture(&shape, &pattern, &charts, &slots, size), wrap: [Wrap::Clamp; 2] });
        // A stronger highlight is a smoother surface.
        let roughness = if gloss > 0.0 { 0.5 - 1.0 * gloss as f32 } else { 0.85 };
        model.materials.push(Material { name: (*name).into(), base_color_texture: Some(index), roughness, ..Material::default() });
        model.parts.push(Part { name: (*name).into(), mesh: mesh(&shape, &charts, &slots, size), material: index });
        model.instances.push(Instance { part: index, world_from_part: diorama_geom::glam::DAffine3::IDENTITY });
    }
    model
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::rng::Rng;

    #[test]
    fn textures_hold_the_color_of_the_surface_where_they_are_shown() {
        let (model, rng) = (model(), Rng::new(3, 3));
        for (part, object) in model.parts.iter().zip(still_life::scene().objects) {
            let image = &model.textures[part.material].image;
            let mut same = 0;
            for k in 0..2000u64 {
                let face = part.mesh.faces[rng.below(3 * k, part.mesh.faces.len() as u64) as usize];
                let (mut a, mut b) = (rng.uniform(3 * k + 1), rng.uniform(3 * k + 2));
                if a + b > 1.0 {
                    (a, b) = (1.0 - a, 1.0 - b);
                }
                let weights = [1.0 - a - b, a, b];
                let sum = |of: &dyn Fn(usize) -> f32| (0..3).map(|i| weights[i] * of(face[i] as usize)).sum::<f32>();
                let p: [f32; 3] = std::array::from_fn(|c| sum(&|i| part.mesh.positions[i][c]));
                let uv: [f32; 2] = std::array::from_fn(|c| sum(&|i| part.mesh.uvs[i][c]));
                let pixel = image.pixel((uv[0] * image.width as f32) as usize, (uv[1] * image.height as f32) as usize);
                let expected = object.texture.color(DVec3::from(p.map(f64::from))).to_array().map(|c| srgb_from_linear(c as f32) * 255.0);
                same += (0..3).all(|c| (pixel[c] as f32 - expected[c]).abs() < 2.0) as usize;
            }
            // The others lie on the borders of the pattern.
            assert!(same > 1840, "{}: {same} of 2000", part.name);
        }
    }

    #[test]
    fn meshes_fill_the_shapes() {
        for (part, Object { shape, .. }) in model().parts.iter().zip(still_life::scene().objects) {
            let exact = match shape {
                Shape::Sphere { radius, .. } => 4.0 / 3.0 * PI * radius.powi(3),
                Shape::Cylinder { radius, half_height, .. } => PI * radius * radius * 2.0 * half_height,
                Shape::Box { half, .. } => 8.0 * half.x * half.y * half.z,
            };
            let volume = part.mesh.volume();
            assert!((volume / exact - 1.0).abs() < 3e-3, "{}: {volume} and {exact}", part.name);
        }
    }
}
