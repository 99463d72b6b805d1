//! How bright and of which color light is, from gloss: dielectrics mirror 4 % of it whatever their color, so what changes on a point of the
//! surface as the camera moves tells the light's absolute scale.
//!
//! With the mirrored light `S` of a view (split sum, base color 0), a point sends `c = d + s S`: the factor `s` of each channel minimizes the
//! squares of `c − mean c − s (S − mean S)`, reweighted against outliers.

use super::albedo_entropy::{CLIPPED, Sighting};
use super::probe::Probe;
use super::transport::{Transport, dot, unit};
use diorama_geom::mesh::sub;
use diorama_kernels::ops::ray_triangles::Ray;
use diorama_kernels::ops::split_sum::Points;

/// Roughnesses that are tried.
const ROUGHNESS: [f32; 5] = [0.2, 0.3, 0.45, 0.65, 0.9];
/// Sightings of a vertex that are needed, and vertices that are used.
const LEAST: usize = 6;
const VERTICES: usize = 8000;
/// Rounds of reweighting.
const ROUNDS: usize = 6;
/// Least share of the changes that gloss must explain.
const EXPLAINED: f64 = 0.08;
/// Bounds of the factor. The light before it is one under which the brightest colors are nearly white: much less light is impossible, and a
/// smaller factor tells of an object whose gloss differs from place to place.
const BOUNDS: [f64; 2] = [0.6, 8.0];
/// Distance from the surface at which rays begin, in object space.
const OFFSET: f32 = 1e-3;

/// What gloss tells.
#[derive(Clone, Debug, PartialEq)]
pub struct Gloss {
    /// Factor of the light by channel.
    pub scale: [f32; 3],
    pub roughness: f32,
    /// Mean mirrored light of the vertices' sightings, after the factor `[V]`.
    pub mirrored: Vec<[f32; 3]>,
}

/// Sightings, those of one vertex in a row.
pub struct Rows {
    pub vertex: Vec<u32>,
    /// Sightings of each vertex.
    pub ranges: Vec<std::ops::Range<usize>>,
    pub normal: Vec<f32>,
    pub view: Vec<f32>,
    pub color: Vec<[f32; 3]>,
}

/// Fits the factor; none where nothing glossy is seen.
pub fn fit(
    probe: &Probe,
    transport: &Transport,
    sightings: &[Vec<Sighting>],
    (positions, normals): (&[[f32; 3]], &[[f32; 3]]),
) -> Option<Gloss> {
    let rows = rows(transport, sightings, (positions, normals));
    if rows.ranges.len() < 50 {
        return None;
    }
    let n = rows.color.len();
    let fits = ROUGHNESS.map(|r| {
        let ks: Vec<f32> = [0.0, r, 0.0].repeat(n);
        let points = Points { normal: &rows.normal, view: &rows.view, kd: &vec![0.0; 3 * n], ks: &ks };
        let mirrored = probe.shade(&points, None).color;
        let channels = [0, 1, 2].map(|k| factor(&rows, &mirrored, k));
        let explained = channels.iter().map(|c| c.1).sum::<f64>() / 3.0;
        (explained, channels.map(|c| c.0), r, mirrored)
    });
    let (explained, factors, roughness, mirrored) = fits.into_iter().max_by(|a, b| a.0.total_cmp(&b.0))?;
    if explained < EXPLAINED || factors.iter().any(|f| *f < BOUNDS[0]) {
        return None;
    }
    let scale = factors.map(|f| f.min(BOUNDS[1]) as f32);
    let mut mean = vec![[0.0f32; 3]; positions.len()];
    for (v, range) in rows.vertex.iter().zip(&rows.ranges) {
        for i in range.clone() {
            (0..3).for_each(|k| mean[*v as usize][k] += scale[k] * mirrored[3 * i + k] / range.len() as f32);
        }
    }
    Some(Gloss { scale, roughness, mirrored: mean })
}

/// Sightings in which no other surface is mirrored, of some of the vertices.
pub fn rows(transport: &Transport, sightings: &[Vec<Sighting>], (positions, normals): (&[[f32; 3]], &[[f32; 3]])) -> Rows {
    let mut rows = Rows { vertex: Vec::new(), ranges: Vec::new(), normal: Vec::new(), view: Vec::new(), color: Vec::new() };
    let seen: Vec<usize> = (0..sightings.len()).filter(|v| sightings[*v].len() >= LEAST).collect();
    for v in seen.iter().step_by(seen.len().div_ceil(VERTICES).max(1)).copied() {
        let (p, n) = (positions[v], unit(normals[v]));
        let views: Vec<[f32; 3]> = sightings[v].iter().map(|s| unit(sub(s.eye, p))).collect();
        let rays: Vec<Ray> = views
            .iter()
            .map(|w| {
                let along = 2.0 * dot(n, *w);
                let direction = std::array::from_fn(|k| along * n[k] - w[k]);
                Ray { origin: std::array::from_fn(|k| p[k] + OFFSET * n[k]), direction, range: [0.0, f32::INFINITY] }
            })
            .collect();
        let blocked = transport.reflected(&rays);
        let open: Vec<usize> = (0..views.len()).filter(|i| blocked[*i].is_none()).collect();
        if open.len() < LEAST {
            continue;
        }
        let first = rows.color.len();
        for i in open {
            rows.normal.extend(n);
            rows.view.extend(views[i]);
            rows.color.push(sightings[v][i].color);
        }
        rows.vertex.push(v as u32);
        rows.ranges.push(first..rows.color.len());
    }
    rows
}

/// The factor of a channel and the share of the changes that it explains.
fn factor(rows: &Rows, mirrored: &[f32], k: usize) -> (f64, f64) {
    let kept: Vec<_> = rows.ranges.iter().filter(|r| rows.color[(*r).clone()].iter().all(|c| c[k] < CLIPPED)).collect();
    let (mut weights, mut s) = (vec![1.0f64; rows.color.len()], 0.0);
    let mut explained = 0.0;
    for _ in 0..ROUNDS {
        let (mut both, mut square, mut total) = (0.0, 0.0, 0.0);
        let mut centered = Vec::with_capacity(rows.color.len());
        for range in &kept {
            let sum = |f: &dyn Fn(usize) -> f64| (*range).clone().map(|i| weights[i] * f(i)).sum::<f64>();
            let all = sum(&|_| 1.0).max(1e-12);
            let (c, m) = (sum(&|i| rows.color[i][k] as f64) / all, sum(&|i| mirrored[3 * i + k] as f64) / all);
            for i in (*range).clone() {
                let [c, m] = [rows.color[i][k] as f64 - c, mirrored[3 * i + k] as f64 - m];
                both += weights[i] * c * m;
                square += weights[i] * m.powi(2);
                total += weights[i] * c.powi(2);
                centered.push((i, c, m));
            }
        }
        s = both / square.max(1e-12);
        explained = both * s / total.max(1e-12);
        let mut off: Vec<f64> = centered.iter().map(|(_, c, m)| (c - s * m).abs()).collect();
        for ((i, ..), off) in centered.iter().zip(&off) {
            weights[*i] = *off;
        }
        off.sort_by(f64::total_cmp);
        let width = 2.0 * off.get(off.len() / 2).copied().unwrap_or(0.0) + 1e-6;
        centered.iter().for_each(|(i, ..)| weights[*i] = 1.0 / (1.0 + (weights[*i] / width).powi(2)));
    }
    (s, explained)
}
