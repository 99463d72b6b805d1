//! Point by point in f64.

use super::{Filter, Kind, Level, Texture};

/// A texel that a point reads: its index among those of all levels, its weight, and the weight's slopes along the coordinates and the level.
struct Tap {
    texel: usize,
    weight: f64,
    along: [f64; 3],
    along_level: f64,
}

/// Axis of a face, its sign, and the axes and signs of s and t (OpenGL 4.6, table 8.19).
const AXES: [(usize, f64, (usize, f64), (usize, f64)); 6] = [
    (0, 1.0, (2, -1.0), (1, -1.0)),
    (0, -1.0, (2, 1.0), (1, -1.0)),
    (1, 1.0, (0, 1.0), (2, 1.0)),
    (1, -1.0, (0, 1.0), (2, -1.0)),
    (2, 1.0, (0, 1.0), (1, -1.0)),
    (2, -1.0, (0, -1.0), (1, -1.0)),
];

/// Face, (s, t) on it, and their slopes along the direction.
fn project(d: &[f64]) -> (usize, [f64; 2], [[f64; 3]; 2]) {
    let (mut axis, mut most) = (0, d[0].abs());
    for k in 1..3 {
        if d[k].abs() > most {
            (axis, most) = (k, d[k].abs());
        }
    }
    let face = 2 * axis + (d[axis] < 0.0) as usize;
    let (_, sign, s, t) = AXES[face];
    let mut slopes = [[0.0; 3]; 2];
    let place = [s, t].map(|(k, turned)| (turned * d[k] / most + 1.0) / 2.0);
    for (i, (k, turned)) in [s, t].into_iter().enumerate() {
        slopes[i][k] = turned / (2.0 * most);
        slopes[i][axis] = -sign * turned * d[k] / (2.0 * most * most);
    }
    (face, place, slopes)
}

/// The texel of a cube at (x, y) of a face or just outside of it, unless it is beyond a corner.
fn around(n: i64, face: usize, x: i64, y: i64) -> Option<(usize, i64, i64)> {
    let outside = |v: i64| v < 0 || v >= n;
    if outside(x) && outside(y) {
        return None;
    }
    let (axis, sign, (s, s_sign), (t, t_sign)) = AXES[face];
    let mut d = [0.0; 3];
    d[axis] = sign;
    d[s] = s_sign * ((2 * x + 1) as f64 / n as f64 - 1.0);
    d[t] = t_sign * ((2 * y + 1) as f64 / n as f64 - 1.0);
    let (face, place, _) = project(&d);
    let [x, y] = place.map(|v| ((v * n as f64).floor() as i64).clamp(0, n - 1));
    Some((face, x, y))
}

/// Weighted texels `(face, x, y)` of one level, as (texel within the image, weight, slopes along s and t).
fn within_level(t: &Texture, level: &Level, face: usize, place: [f64; 2]) -> Vec<(usize, f64, [f64; 2])> {
    let [h, w] = level.size.map(|n| n as i64);
    let index = |face: usize, x: i64, y: i64| ((face as i64 * h + y) * w + x) as usize;
    if t.filter == Filter::Nearest {
        let at = |v: f64, n: i64| (if t.kind == Kind::Repeat { v - v.floor() } else { v } * n as f64).floor().clamp(0.0, n as f64 - 1.0);
        return vec![(index(face, at(place[0], w) as i64, at(place[1], h) as i64), 1.0, [0.0; 2])];
    }
    let (x, y) = (place[0] * w as f64 - 0.5, place[1] * h as f64 - 0.5);
    let (x0, y0) = (x.floor(), y.floor());
    let mut taps = Vec::new();
    let mut missing = None;
    for (j, i) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
        let (wx, sx) = if i == 0 { (1.0 - (x - x0), -1.0) } else { (x - x0, 1.0) };
        let (wy, sy) = if j == 0 { (1.0 - (y - y0), -1.0) } else { (y - y0, 1.0) };
        let (px, py) = (x0 as i64 + i, y0 as i64 + j);
        let (weight, slopes) = (wx * wy, [sx * wy * w as f64, sy * wx * h as f64]);
        match t.kind {
            Kind::Repeat => taps.push((index(0, px.rem_euclid(w), py.rem_euclid(h)), weight, slopes)),
            Kind::Clamp => taps.push((index(0, px.clamp(0, w - 1), py.clamp(0, h - 1)), weight, slopes)),
            Kind::Cube => match around(w, face, px, py) {
                Some((face, x, y)) => taps.push((index(face, x, y), weight, slopes)),
                None => missing = Some((weight, slopes)),
            },
        }
    }
    if let Some((weight, slopes)) = missing {
        for tap in &mut taps {
            tap.1 += weight / 3.0;
            (0..2).for_each(|k| tap.2[k] += slopes[k] / 3.0);
        }
    }
    taps
}

fn taps(t: &Texture, coordinates: &[f64], level: f64, image: usize) -> Vec<Tap> {
    let levels = t.levels();
    let most = levels.len() - 1;
    let (face, place, slopes) = match t.kind {
        Kind::Cube => project(coordinates),
        _ => (0, [coordinates[0], coordinates[1]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    };
    let first = level.clamp(0.0, most as f64).floor();
    let share = level.clamp(0.0, most as f64) - first;
    let free = if level > 0.0 && level < most as f64 { 1.0 } else { 0.0 };
    let mut all = Vec::new();
    let read = [(first as usize, 1.0 - share, -free), ((first as usize + 1).min(most), share, free)];
    for (l, share, along_level) in read.into_iter().take(if t.filter == Filter::Trilinear { 2 } else { 1 }) {
        let start = levels[l].first + image * t.faces() * levels[l].size[0] * levels[l].size[1];
        for (texel, weight, [s, d]) in within_level(t, &levels[l], face, place) {
            let along = std::array::from_fn(|k| share * (s * slopes[0][k] + d * slopes[1][k]));
            all.push(Tap { texel: start + texel, weight: share * weight, along, along_level: along_level * weight });
        }
    }
    all
}

/// All levels of a texture from its finest, `[levels]`.
pub fn mips(t: &Texture, finest: &[f64]) -> Vec<f64> {
    let mut texels = finest.to_vec();
    let levels = t.levels();
    for pair in levels.windows(2) {
        let ([h, w], [finer_h, finer_w]) = (pair[1].size, pair[0].size);
        for i in 0..t.images * t.faces() * h * w * t.channels {
            let (c, x, y, image) = (i % t.channels, i / t.channels % w, i / t.channels / w % h, i / t.channels / w / h);
            let (across, down) = (finer_w / w, finer_h / h);
            let mut sum = 0.0;
            for fine_y in y * down..(y + 1) * down {
                for fine_x in x * across..(x + 1) * across {
                    sum += texels[(pair[0].first + (image * finer_h + fine_y) * finer_w + fine_x) * t.channels + c];
                }
            }
            texels.push(sum / (across * down) as f64);
        }
    }
    texels
}

/// `[P, C]`
pub fn forward(t: &Texture, texels: &[f64], coordinates: &[f64], level: &[f64]) -> Vec<f64> {
    let (n, c) = (t.coordinates(), t.channels);
    let points = coordinates.len() / n;
    let mut out = vec![0.0; points * c];
    for p in 0..points {
        for tap in taps(t, &coordinates[n * p..n * p + n], level.get(p).copied().unwrap_or(0.0), p / (points / t.images)) {
            (0..c).for_each(|k| out[p * c + k] += tap.weight * texels[tap.texel * c + k]);
        }
    }
    out
}

/// Gradients of the texels of all levels, of coordinates and of levels.
pub fn backward(t: &Texture, texels: &[f64], coordinates: &[f64], level: &[f64], d: &[f64]) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let (n, c) = (t.coordinates(), t.channels);
    let points = coordinates.len() / n;
    let (mut d_texels, mut d_coordinates, mut d_level) = (vec![0.0; texels.len()], vec![0.0; coordinates.len()], vec![0.0; level.len()]);
    for p in 0..points {
        for tap in taps(t, &coordinates[n * p..n * p + n], level.get(p).copied().unwrap_or(0.0), p / (points / t.images)) {
            for k in 0..c {
                d_texels[tap.texel * c + k] += tap.weight * d[p * c + k];
                let through = texels[tap.texel * c + k] * d[p * c + k];
                (0..n).for_each(|i| d_coordinates[n * p + i] += tap.along[i] * through);
                if let Some(d_level) = d_level.get_mut(p) {
                    *d_level += tap.along_level * through;
                }
            }
        }
    }
    (d_texels, d_coordinates, d_level)
}

/// Level of each point's footprint, `[P]`.
pub fn footprint(t: &Texture, coordinates: &[f64], derivatives: &[f64]) -> Vec<f64> {
    let n = t.coordinates();
    (0..coordinates.len() / n)
        .map(|p| {
            let d = &derivatives[2 * n * p..2 * n * (p + 1)];
            let slopes = match t.kind {
                Kind::Cube => project(&coordinates[n * p..n * p + n]).2,
                _ => [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            };
            let mut j = [[0.0; 2]; 2];
            for (i, size) in [t.size[1], t.size[0]].into_iter().enumerate() {
                for axis in 0..2 {
                    j[i][axis] = (0..n).map(|k| slopes[i][k] * d[2 * k + axis]).sum::<f64>() * size as f64;
                }
            }
            // Larger singular value of J, from its norm and its determinant.
            let norm: f64 = j.iter().flatten().map(|v| v * v).sum();
            let determinant = j[0][0] * j[1][1] - j[0][1] * j[1][0];
            let value = 0.5 * (norm + (norm * norm - 4.0 * determinant * determinant).max(0.0).sqrt());
            0.5 * value.max(0.5f64.powi(40)).log2()
        })
        .collect()
}
