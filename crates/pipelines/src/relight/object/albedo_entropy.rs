//! The light of photographs from how few colors an object has: of all lights, that under which the base colors of its surface have the least
//! entropy (Alldrin, Mallick and Kriegman 2008; Barron and Malik 2015), light between surfaces and shadows being known (`Transport`).
//!
//! A vertex that sends the radiance `c` in the irradiance `π E(L)` has the base color `a = c / E`. With `x = ln(a + ε)`, and a Parzen window
//! of width σ, the entropy is `−mean_i ln mean_j exp(−|x_i − x_j|² / 2σ²)`. The light is the exponential of a sum of lobes of three widths.

use super::capture::ObjectPhoto;
use super::transport::{Transport, dot, unit};
use diorama_engine::params::ParamGroup;
use diorama_geom::mesh::sub;
use diorama_geom::rng::Rng;
use diorama_kernels::ops::adam::Adam;
use diorama_kernels::ops::texture::cube_direction;
use rayon::prelude::*;

/// Added to base colors before the logarithm: differences of dark ones do not count.
const DARK: f32 = 0.04;
/// Luminance of the base color that all but a twentieth of the surface stay below. The photographs do not tell it.
const BRIGHT: f32 = 0.8;
/// Vertices that are compared, and with how many others each, at random and nearby.
const VERTICES: usize = 6000;
const PARTNERS: usize = 64;
const NEIGHBORS: usize = 8;
/// Width of the window at the start and at the end.
const WIDTH: [f32; 2] = [0.6, 0.12];
/// Steps, and their rate at the start.
const STEPS: u32 = 300;
const RATE: f32 = 0.03;
/// Edges of the cube maps at whose texels wide and middle lobes are, and their concentration.
const LOBES: [(usize, f32); 2] = [(2, 3.0), (4, 14.0)];
/// Weights of the squares of wide, middle and narrow lobes, and of what has a color.
const PRIOR: [f32; 3] = [0.0005, 0.005, 0.02];
const TINT: f32 = 0.02;
/// Weight of nearby vertices against the entropy.
const LOCAL: f32 = 0.5;
/// Least cosine between normal and view at which a photograph counts, and value from which on it is clipped.
const SEEN: f32 = 0.3;
pub const CLIPPED: f32 = 0.97;

/// A vertex in a photograph.
#[derive(Clone, Copy, Debug)]
pub struct Sighting {
    pub color: [f32; 3],
    pub eye: [f32; 3],
}

/// Where photographs show each vertex `[V]`.
pub fn sightings(photos: &[&ObjectPhoto], (positions, normals): (&[[f32; 3]], &[[f32; 3]]), transport: &Transport) -> Vec<Vec<Sighting>> {
    let mut all = vec![Vec::new(); positions.len()];
    for photo in photos {
        let eye = photo.view.eye;
        let hidden = transport.are_hidden(positions, normals, eye);
        let at = |v: usize| {
            let view = unit(sub(eye, positions[v]));
            (!hidden[v] && dot(unit(normals[v]), view) > SEEN).then(|| sample(photo, positions[v])).flatten()
        };
        let seen: Vec<Option<[f32; 3]>> = (0..positions.len()).into_par_iter().with_min_len(256).map(at).collect();
        all.iter_mut().zip(seen).for_each(|(all, s)| all.extend(s.map(|color| Sighting { color, eye })));
    }
    all
}

/// Radiance of each vertex without highlights: the mean of the darker half of what photographs show; none where too few do.
pub fn observed(sightings: &[Vec<Sighting>]) -> Vec<Option<[f32; 3]>> {
    let of = |seen: &Vec<Sighting>| {
        let mut colors: Vec<[f32; 3]> = seen.iter().map(|s| s.color).collect();
        colors.sort_by(|a, b| luminance(*a).total_cmp(&luminance(*b)));
        let kept = &colors[colors.len() / 4..(colors.len() / 2 + 1).min(colors.len())];
        let n = kept.len() as f32;
        (colors.len() >= 3).then(|| std::array::from_fn(|k| kept.iter().map(|c| c[k]).sum::<f32>() / n))
    };
    sightings.par_iter().with_min_len(256).map(of).collect()
}

/// The color of a photograph where a point is, if the object fills that place.
fn sample(photo: &ObjectPhoto, p: [f32; 3]) -> Option<[f32; 3]> {
    let c = photo.view.clip.map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3]);
    let (w, h) = (photo.rgba.width, photo.rgba.height);
    let (x, y) = (0.5 * (c[0] / c[3] + 1.0) * w as f32 - 0.5, 0.5 * (c[1] / c[3] + 1.0) * h as f32 - 0.5);
    if !(x >= 0.0 && y >= 0.0 && x < (w - 1) as f32 && y < (h - 1) as f32) {
        return None;
    }
    let (left, top) = (x as usize, y as usize);
    let (fx, fy) = (x - left as f32, y - top as f32);
    let pixel = |dx: usize, dy: usize| &photo.rgba.data[4 * ((top + dy) * w + left + dx)..][..4];
    let corners = [pixel(0, 0), pixel(1, 0), pixel(0, 1), pixel(1, 1)];
    let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
    corners.iter().all(|c| c[3] > 0.99).then(|| std::array::from_fn(|k| (0..4).map(|i| weights[i] * corners[i][k]).sum()))
}

/// Luminance of a linear color.
pub fn luminance(c: [f32; 3]) -> f32 {
    0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]
}

/// Light as lobes that brighten or darken a first one.
struct Lobes {
    /// Light to begin with `[texels]`.
    first: Vec<[f32; 3]>,
    /// Weights of wide and middle lobes by texel.
    tables: [Vec<f32>; 2],
    counts: [usize; 2],
    texels: usize,
}

impl Lobes {
    fn new(edge: usize, first: &[[f32; 3]]) -> Lobes {
        let directions = |edge: usize| -> Vec<[f32; 3]> {
            let of = |i: usize| {
                let place = |c: usize| (c as f32 + 0.5) / edge as f32;
                unit(cube_direction(i / (edge * edge), place(i % edge), place(i / edge % edge)))
            };
            (0..6 * edge * edge).map(of).collect()
        };
        let texels = directions(edge);
        let tables = LOBES.map(|(edge, sharpness)| {
            let centers = directions(edge);
            texels.iter().flat_map(|d| centers.iter().map(|c| (sharpness * (dot(*c, *d) - 1.0)).exp()).collect::<Vec<_>>()).collect()
        });
        Lobes { first: first.to_vec(), tables, counts: LOBES.map(|(edge, _)| 6 * edge * edge), texels: texels.len() }
    }

    fn len(&self) -> usize {
        self.counts[0] + self.counts[1] + self.texels
    }

    fn parts<'a>(&self, all: &'a [f32]) -> [&'a [f32]; 3] {
        let (wide, rest) = all.split_at(3 * self.counts[0]);
        let (middle, narrow) = rest.split_at(3 * self.counts[1]);
        [wide, middle, narrow]
    }

    /// Light `[texels]`.
    fn light(&self, values: &[f32]) -> Vec<[f32; 3]> {
        let [wide, middle, narrow] = self.parts(values);
        let of = |i: usize| {
            let mut sum: [f32; 3] = std::array::from_fn(|k| narrow[3 * i + k]);
            for (table, lobes, n) in [(&self.tables[0], wide, self.counts[0]), (&self.tables[1], middle, self.counts[1])] {
                for (w, lobe) in table[i * n..(i + 1) * n].iter().zip(lobes.as_chunks::<3>().0) {
                    (0..3).for_each(|k| sum[k] += w * lobe[k]);
                }
            }
            std::array::from_fn(|k| self.first[i][k] * sum[k].clamp(-12.0, 8.0).exp())
        };
        (0..self.texels).into_par_iter().with_min_len(64).map(of).collect()
    }

    /// Gradient of the lobes, overwritten, for that of the light.
    fn backward(&self, light: &[[f32; 3]], d: &[[f32; 3]], out: &mut [f32]) {
        let d_log: Vec<[f32; 3]> = light.iter().zip(d).map(|(l, d)| std::array::from_fn(|k| l[k] * d[k])).collect();
        out.fill(0.0);
        let (wide, rest) = out.split_at_mut(3 * self.counts[0]);
        let (middle, narrow) = rest.split_at_mut(3 * self.counts[1]);
        narrow.copy_from_slice(d_log.as_flattened());
        for (table, lobes, n) in [(&self.tables[0], wide, self.counts[0]), (&self.tables[1], middle, self.counts[1])] {
            for (i, d) in d_log.iter().enumerate() {
                for (w, lobe) in table[i * n..(i + 1) * n].iter().zip(lobes.as_chunks_mut::<3>().0) {
                    (0..3).for_each(|k| lobe[k] += w * d[k]);
                }
            }
        }
    }

    /// Adds the gradient of the prior.
    fn prior(&self, values: &[f32], grads: &mut [f32]) {
        let ends = [self.counts[0], self.counts[0] + self.counts[1], self.len()];
        for (i, (v, g)) in values.as_chunks::<3>().0.iter().zip(grads.as_chunks_mut::<3>().0).enumerate() {
            let level = ends.iter().position(|e| i < *e).unwrap_or(2);
            let n = self.counts.get(level).copied().unwrap_or(self.texels) as f32;
            let mean = (v[0] + v[1] + v[2]) / 3.0;
            for k in 0..3 {
                g[k] += 2.0 / n * (PRIOR[level] * v[k] + TINT * (v[k] - mean));
            }
        }
    }
}

/// Coarse light `[texels]` for what the vertices send, near the light `first`.
pub fn estimate(
    transport: &Transport,
    first: &[[f32; 3]],
    observed: &[Option<[f32; 3]>],
    positions: &[[f32; 3]],
    seed: u64,
) -> Vec<[f32; 3]> {
    let sent: Vec<[f32; 3]> = observed.iter().map(|o| o.unwrap_or_default()).collect();
    let indirect = transport.bounced(&sent);
    let tells = |v: &usize| observed[*v].is_some_and(|c| c.iter().all(|c| *c < CLIPPED) && luminance(c) > 1e-3);
    let known: Vec<usize> = (0..observed.len()).filter(tells).collect();
    let chosen: Vec<usize> = known.iter().step_by(known.len().div_ceil(VERTICES).max(1)).copied().collect();
    let lobes = Lobes::new(transport.edge, first);
    if chosen.len() < PARTNERS {
        return first.to_vec();
    }
    let near = neighbors(&chosen, positions);
    let adam = Adam { rate: RATE, beta2: 0.99, epsilon: 1e-10, ..Adam::default() };
    let mut group = ParamGroup::dense("lobes", vec![0.0; 3 * lobes.len()], adam);
    let mut gauge = 1.0;
    for step in 1..=STEPS {
        let progress = step as f32 / STEPS as f32;
        let light = lobes.light(&group.values);
        let direct = transport.direct(&light);
        let colors: Vec<[f32; 3]> =
            chosen.iter().map(|v| std::array::from_fn(|k| sent[*v][k] / (gauge * direct[*v][k] + indirect[*v][k]).max(1e-4))).collect();
        let width = WIDTH[0] * (WIDTH[1] / WIDTH[0]).powf((1.5 * progress).min(1.0));
        let (_, d_colors) = entropy(&colors, &near, width, &Rng::new(seed.wrapping_add(step as u64), 35));
        let mut d_direct = vec![[0.0; 3]; direct.len()];
        for ((v, a), d) in chosen.iter().zip(&colors).zip(&d_colors) {
            for k in 0..3 {
                let e = (gauge * direct[*v][k] + indirect[*v][k]).max(1e-4);
                d_direct[*v][k] = -d[k] * a[k] / e * gauge;
            }
        }
        keep_scale(&direct, &mut d_direct);
        lobes.backward(&light, &transport.direct_backward(&d_direct), &mut group.grads);
        lobes.prior(&group.values, &mut group.grads);
        group.step(step, 0.1f32.powf(progress));
        // Brighter light and darker colors look the same.
        let mut bright: Vec<f32> = colors.iter().map(|c| luminance(*c)).collect();
        bright.sort_by(f32::total_cmp);
        gauge *= (bright[bright.len() * 19 / 20] / BRIGHT).clamp(0.5, 2.0);
    }
    lobes.light(&group.values).iter().map(|l| l.map(|v| gauge * v)).collect()
}

/// Takes the part out of a gradient that makes all light brighter: that is what the gauge is for.
fn keep_scale(direct: &[[f32; 3]], d: &mut [[f32; 3]]) {
    for k in 0..3 {
        let along: f64 = direct.iter().zip(&*d).map(|(e, d)| (e[k] * d[k]) as f64).sum();
        let square: f64 = direct.iter().zip(&*d).filter(|(_, d)| **d != [0.0; 3]).map(|(e, _)| (e[k] * e[k]) as f64).sum();
        let share = (along / square.max(1e-12)) as f32;
        d.iter_mut().zip(direct).filter(|(d, _)| **d != [0.0; 3]).for_each(|(d, e)| d[k] -= share * e[k]);
    }
}

/// Some of the nearest chosen vertices of each, as places in `chosen`.
fn neighbors(chosen: &[usize], positions: &[[f32; 3]]) -> Vec<[u32; NEIGHBORS]> {
    let of = |i: usize| {
        let p = positions[chosen[i]];
        let mut nearest = [(f32::MAX, i as u32); NEIGHBORS];
        for (j, v) in chosen.iter().enumerate().filter(|(j, _)| *j != i) {
            let d = sub(positions[*v], p);
            let d = dot(d, d);
            if d < nearest[NEIGHBORS - 1].0 {
                nearest[NEIGHBORS - 1] = (d, j as u32);
                nearest.sort_by(|a, b| a.0.total_cmp(&b.0));
            }
        }
        nearest.map(|n| n.1)
    };
    (0..chosen.len()).into_par_iter().map(of).collect()
}

/// Entropy of colors and the mean robust difference of nearby ones, with the gradient; partners are drawn at random.
pub fn entropy(colors: &[[f32; 3]], near: &[[u32; NEIGHBORS]], width: f32, rng: &Rng) -> (f64, Vec<[f32; 3]>) {
    let n = colors.len();
    let x: Vec<[f32; 3]> = colors.iter().map(|c| c.map(|c| (c + DARK).ln())).collect();
    let (share, local) = (1.0 / n as f32, LOCAL / (n * NEIGHBORS) as f32);
    let precision = 1.0 / (width * width);
    let of = |i: usize| {
        let partner = |p: usize| rng.below((i * PARTNERS + p) as u64, n as u64) as usize;
        let mut sum = 1e-4f32;
        let kernels: [f32; PARTNERS] = std::array::from_fn(|p| {
            let d = sub(x[i], x[partner(p)]);
            let k = (-0.5 * precision * dot(d, d)).exp();
            sum += k / PARTNERS as f32;
            k
        });
        let mut moved = Vec::with_capacity(PARTNERS + NEIGHBORS);
        for (p, k) in kernels.iter().enumerate() {
            let j = partner(p);
            let d = sub(x[i], x[j]);
            moved.push((j, d.map(|d| share * precision * k / (PARTNERS as f32 * sum) * d)));
        }
        let mut value = -share as f64 * sum.ln() as f64;
        // Geman and McClure's ρ = d² / (d² + σ²)
        for j in near.get(i).into_iter().flatten().copied() {
            let d = sub(x[i], x[j as usize]);
            let (square, q) = (dot(d, d), 1.0 / (dot(d, d) + width * width));
            value += (local * square * q) as f64;
            moved.push((j as usize, d.map(|d| local * 2.0 * width * width * q * q * d)));
        }
        (value, moved)
    };
    let parts: Vec<(f64, Vec<(usize, [f32; 3])>)> = (0..n).into_par_iter().with_min_len(32).map(of).collect();
    let mut d = vec![[0.0f32; 3]; n];
    let mut value = 0.0;
    for (i, (v, moved)) in parts.iter().enumerate() {
        value += v;
        for (j, by) in moved {
            (0..3).for_each(|k| {
                d[i][k] += by[k];
                d[*j][k] -= by[k];
            });
        }
    }
    d.iter_mut().zip(colors).for_each(|(d, c)| (0..3).for_each(|k| d[k] /= c[k] + DARK));
    (value, d)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_kernels::ops::vertex_normals;

    /// A bumpy ball with two colors.
    fn ball() -> (Vec<[f32; 3]>, Vec<[u32; 3]>, Vec<[f32; 3]>) {
        let (columns, rows) = (40u32, 20u32);
        let (mut positions, mut faces) = (Vec::new(), Vec::new());
        for j in 0..=rows {
            for i in 0..columns {
                let (polar, angle) =
                    (std::f32::consts::PI * (j as f32 + 0.02) / (rows as f32 + 0.04), std::f32::consts::TAU * i as f32 / columns as f32);
                let r = 0.8 + 0.1 * (5.0 * polar).sin() * (3.0 * angle).cos();
                positions.push([r * polar.sin() * angle.cos(), r * polar.sin() * angle.sin(), r * polar.cos()]);
            }
        }
        for j in 0..rows {
            for i in 0..columns {
                let at = |x: u32, y: u32| y * columns + x % columns;
                faces.extend([[at(i, j), at(i, j + 1), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i + 1, j)]]);
            }
        }
        let color = |p: &[f32; 3]| if (6.0 * p[0]).sin() * (6.0 * p[2]).cos() > 0.0 { [0.8, 0.75, 0.7] } else { [0.3, 0.15, 0.1] };
        let colors = positions.iter().map(color).collect();
        (positions, faces, colors)
    }

    #[test]
    fn two_colors_tell_the_light() {
        let (positions, faces, colors) = ball();
        let normals = vertex_normals::cpu::forward(&faces, &positions);
        let t = Transport::new(&positions, &normals, &faces, 0);
        let texel = |i: usize| {
            let place = |c: usize| (c as f32 + 0.5) / t.edge as f32;
            let d = unit(cube_direction(i / (t.edge * t.edge), place(i % t.edge), place(i / t.edge % t.edge)));
            let sun = (8.0 * (dot(d, [0.6, 0.0, 0.8]) - 1.0)).exp();
            [0.2 + 3.0 * sun, 0.25 + 2.4 * sun, 0.4 + 0.3 * d[2] + 1.6 * sun]
        };
        let light: Vec<[f32; 3]> = (0..t.texels()).map(texel).collect();
        let dimmed: Vec<[f32; 3]> = light.iter().map(|l| l.map(|l| 0.6 * l)).collect();
        let truth = t.light(&dimmed, &colors);
        let sent: Vec<Option<[f32; 3]>> = truth.sent.iter().map(|s| Some(*s)).collect();
        let found = estimate(&t, &vec![[1.0; 3]; t.texels()], &sent, &positions, 0);
        // Base colors under a light, compared after one factor per channel.
        let error = |light: &[[f32; 3]]| {
            let e = t.light(light, &colors);
            let got: Vec<[f32; 3]> =
                (0..colors.len()).map(|v| std::array::from_fn(|k| truth.sent[v][k] / (e.direct[v][k] + e.indirect[v][k]))).collect();
            let mut sum = 0.0;
            for k in 0..3 {
                let both: f32 = got.iter().zip(&colors).map(|(g, c)| g[k] * c[k]).sum();
                let by = both / got.iter().map(|g| g[k] * g[k]).sum::<f32>();
                sum += got.iter().zip(&colors).map(|(g, c)| (by * g[k] - c[k]).powi(2)).sum::<f32>();
            }
            (sum / (3 * colors.len()) as f32).sqrt()
        };
        let (ours, even) = (error(&found), error(&vec![[0.5; 3]; t.texels()]));
        assert!(ours < 0.05 && ours < 0.4 * even, "{ours} against {even} in even light");
    }

    #[test]
    fn the_gradient_of_the_entropy_matches_central_differences() {
        let colors: Vec<[f32; 3]> = diorama_testkit::random_unit(90, 5).as_chunks::<3>().0.to_vec();
        let near = vec![[1, 2, 3, 4, 5, 6, 7, 8]; 30];
        let at = |c: &[[f32; 3]]| entropy(c, &near, 0.3, &Rng::new(7, 0)).0;
        let (_, d) = entropy(&colors, &near, 0.3, &Rng::new(7, 0));
        for i in 0..90 {
            let moved = |by: f32| {
                let mut c = colors.clone();
                c.as_flattened_mut()[i] += by;
                at(&c)
            };
            let want = (moved(1e-3) - moved(-1e-3)) / 2e-3;
            let got = d.as_flattened()[i] as f64;
            assert!((got - want).abs() < 2e-3 + 2e-2 * want.abs(), "{i}: {got} {want}");
        }
    }
}
