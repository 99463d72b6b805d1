//! Texture coordinates: the surface is cut into charts that a parallel projection flattens without overlap, and the charts are packed into
//! a square.

use diorama_geom::Mesh;
use diorama_geom::mesh::{cross, sub};
use glam::{Vec2, Vec3};
use std::collections::{BinaryHeap, HashMap};

/// Empty texels around each chart, so that texture filtering reaches no other chart.
const MARGIN: f32 = 2.0;
/// Cosine of the largest angle between a face and its chart's axis while charts grow; and when tiny charts are merged into neighbors.
const GROW: f32 = 0.64;
const MERGE_ANGLE: f32 = 0.25;
/// Charts with fewer faces are tiny and are merged.
const TINY_CHART: usize = 12;

/// A part of the surface and the plane onto which it is projected.
struct Chart {
    faces: Vec<u32>,
    u: Vec3,
    v: Vec3,
}

/// Computes texture coordinates for a texture of `size × size` texels. Vertices on seams are duplicated. Degenerate faces share one texel.
pub fn unwrap(mesh: &mut Mesh, size: usize) {
    let surface = Surface::new(mesh);
    let total: f32 = surface.areas.iter().sum();
    if mesh.faces.is_empty() || total <= 0.0 {
        mesh.uvs = vec![[0.5; 2]; mesh.positions.len()];
        return;
    }
    // Texels per unit of length at which three quarters of the texture would be used.
    let scale = size as f32 * (0.75 / total).sqrt();
    let charts = surface.charts(scale);
    let flat: Vec<Flat> = charts.iter().map(|c| surface.flatten(c)).collect();
    let (scale, places) = pack(&flat, size as f32, scale);
    rebuild(mesh, &charts, &flat, &places, scale, size as f32);
}

/// The surface from which charts are cut.
struct Surface<'a> {
    mesh: &'a Mesh,
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    /// Normals averaged with those of neighbors that are not across a sharp edge; charts grow by these.
    smooth: Vec<Vec3>,
    areas: Vec<f32>,
    /// Neighbor faces across the three edges.
    neighbors: Vec<[u32; 3]>,
}

const NONE: u32 = u32::MAX;

/// A candidate face for a chart; the face with the smallest angle to the axis comes first.
#[derive(PartialEq)]
struct Candidate {
    flatness: f32,
    face: u32,
}

impl Eq for Candidate {}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.flatness.total_cmp(&other.flatness).then(other.face.cmp(&self.face))
    }
}

impl<'a> Surface<'a> {
    fn new(mesh: &'a Mesh) -> Self {
        let mut normals = Vec::with_capacity(mesh.faces.len());
        let mut areas = Vec::with_capacity(mesh.faces.len());
        let mut edges: HashMap<(u32, u32), u32> = HashMap::with_capacity(mesh.faces.len() * 3);
        for (i, f) in mesh.faces.iter().enumerate() {
            let [a, b, c] = f.map(|i| mesh.positions[i as usize]);
            let n = Vec3::from(cross(sub(b, a), sub(c, a)));
            areas.push(0.5 * n.length());
            normals.push(n.normalize_or_zero());
            for k in 0..3 {
                edges.insert((f[k], f[(k + 1) % 3]), i as u32);
            }
        }
        let neighbors: Vec<[u32; 3]> =
            mesh.faces.iter().map(|f| std::array::from_fn(|k| edges.get(&(f[(k + 1) % 3], f[k])).copied().unwrap_or(NONE))).collect();
        let mut smooth = normals.clone();
        for _ in 0..3 {
            smooth = (0..smooth.len())
                .map(|i| {
                    let around = neighbors[i].iter().filter(|n| **n != NONE && smooth[**n as usize].dot(smooth[i]) > 0.5);
                    let sum: Vec3 = around.map(|n| smooth[*n as usize] * areas[*n as usize]).sum();
                    (sum + smooth[i] * areas[i]).normalize_or(normals[i])
                })
                .collect();
        }
        let positions = mesh.positions.iter().map(|p| Vec3::from(*p)).collect();
        Surface { mesh, positions, normals, smooth, areas, neighbors }
    }

    fn charts(&self, scale: f32) -> Vec<Chart> {
        let mut owner = vec![NONE; self.areas.len()];
        let mut charts = self.grow(&mut owner, scale);
        self.merge_tiny_charts(&mut charts, &mut owner, scale);
        charts
    }

    /// Charts that cover all faces, each grown from the largest remaining face.
    fn grow(&self, owner: &mut [u32], scale: f32) -> Vec<Chart> {
        let mut order: Vec<u32> = (0..self.areas.len() as u32).collect();
        order.sort_by(|a, b| self.areas[*b as usize].total_cmp(&self.areas[*a as usize]).then(a.cmp(b)));
        let mut charts = Vec::new();
        let mut texels = Texels::default();
        for seed in order {
            // Faces that a chart could not take without overlap become available again.
            while owner[seed as usize] == NONE {
                let id = charts.len() as u32;
                let grown = self.grow_from(seed, owner, id);
                let (u, v) = self.plane(&grown);
                texels.clear();
                let (keep, free): (Vec<u32>, Vec<u32>) =
                    grown.into_iter().partition(|f| texels.take(self.triangle(*f, u, v), scale, *f == seed));
                free.iter().for_each(|f| owner[*f as usize] = NONE);
                charts.push(Chart { faces: keep, u, v });
            }
        }
        charts
    }

    /// Connected faces in the order in which they were added.
    fn grow_from(&self, seed: u32, owner: &mut [u32], id: u32) -> Vec<u32> {
        let mut faces = Vec::new();
        let mut sum = Vec3::ZERO;
        let mut heap = BinaryHeap::from([Candidate { flatness: 1.0, face: seed }]);
        while let Some(Candidate { face, .. }) = heap.pop() {
            let i = face as usize;
            let axis = sum.normalize_or_zero();
            let fits = faces.is_empty() || (self.smooth[i].dot(axis) > GROW && self.normals[i].dot(axis) > MERGE_ANGLE);
            if owner[i] != NONE || !fits {
                continue;
            }
            owner[i] = id;
            faces.push(face);
            sum += self.smooth[i] * self.areas[i].max(1e-20);
            let axis = sum.normalize_or_zero();
            for n in self.neighbors[i].into_iter().filter(|n| *n != NONE && owner[*n as usize] == NONE) {
                heap.push(Candidate { flatness: self.smooth[n as usize].dot(axis), face: n });
            }
        }
        faces
    }

    /// Axes of the plane perpendicular to the faces' mean normal, rotated so that the bounding box is small.
    fn plane(&self, faces: &[u32]) -> (Vec3, Vec3) {
        let sum: Vec3 = faces.iter().map(|f| self.normals[*f as usize] * self.areas[*f as usize].max(1e-20)).sum();
        let axis = sum.normalize_or(Vec3::Z);
        let (u, v) = axis.any_orthonormal_pair();
        // (u, v, axis) is right-handed, so faces that look along the axis keep their orientation.
        let (u, v) = if u.cross(v).dot(axis) < 0.0 { (v, u) } else { (u, v) };
        let turned = |k: u32| {
            let (s, c) = (k as f32 * std::f32::consts::FRAC_PI_2 / 9.0).sin_cos();
            (u * c + v * s, v * c - u * s)
        };
        let area = |(u, v): (Vec3, Vec3)| {
            let points = faces.iter().flat_map(|f| self.mesh.faces[*f as usize]).map(|i| self.positions[i as usize]);
            let (lo, hi) = points.fold((Vec2::MAX, Vec2::MIN), |(lo, hi), p| {
                let q = Vec2::new(p.dot(u), p.dot(v));
                (lo.min(q), hi.max(q))
            });
            (hi - lo).element_product()
        };
        let best = if faces.len() > 1 { (0..9).min_by(|a, b| area(turned(*a)).total_cmp(&area(turned(*b)))) } else { None };
        turned(best.unwrap_or(0))
    }

    fn triangle(&self, face: u32, u: Vec3, v: Vec3) -> [Vec2; 3] {
        self.mesh.faces[face as usize].map(|i| {
            let p = self.positions[i as usize];
            Vec2::new(p.dot(u), p.dot(v))
        })
    }

    /// Moves the faces of tiny charts to adjacent charts, if they fit without overlap.
    fn merge_tiny_charts(&self, charts: &mut Vec<Chart>, owner: &mut [u32], scale: f32) {
        let mut by_size: Vec<usize> = (0..charts.len()).collect();
        by_size.sort_by_key(|c| (std::cmp::Reverse(charts[*c].faces.len()), *c));
        let is_tiny: Vec<bool> = charts.iter().map(|c| c.faces.len() < TINY_CHART).collect();
        let mut texels = Texels::default();
        for c in by_size {
            if is_tiny[c] {
                continue;
            }
            texels.clear();
            let (u, v) = (charts[c].u, charts[c].v);
            for f in &charts[c].faces {
                texels.take(self.triangle(*f, u, v), scale, true);
            }
            let mut next = 0;
            while next < charts[c].faces.len() {
                for n in self.neighbors[charts[c].faces[next] as usize] {
                    let free = n != NONE && is_tiny[owner[n as usize] as usize];
                    if free && self.normals[n as usize].dot(u.cross(v)) > MERGE_ANGLE && texels.take(self.triangle(n, u, v), scale, false) {
                        owner[n as usize] = c as u32;
                        charts[c].faces.push(n);
                    }
                }
                next += 1;
            }
        }
        for (c, chart) in charts.iter_mut().enumerate() {
            chart.faces.retain(|f| owner[*f as usize] == c as u32);
        }
        charts.retain(|c| !c.faces.is_empty());
    }

    fn flatten(&self, chart: &Chart) -> Flat {
        let mut index = HashMap::new();
        let mut points = Vec::new();
        for f in &chart.faces {
            for i in self.mesh.faces[*f as usize] {
                index.entry(i).or_insert_with(|| {
                    let p = self.positions[i as usize];
                    points.push((i, Vec2::new(p.dot(chart.u), p.dot(chart.v))));
                    points.len() as u32 - 1
                });
            }
        }
        let (lo, hi) = points.iter().fold((Vec2::MAX, Vec2::MIN), |(lo, hi), (_, p)| (lo.min(*p), hi.max(*p)));
        Flat { index, points, low: lo, extent: hi - lo }
    }
}

/// A chart in its plane.
struct Flat {
    /// Index in `points` of each vertex of the mesh.
    index: HashMap<u32, u32>,
    points: Vec<(u32, Vec2)>,
    low: Vec2,
    extent: Vec2,
}

/// Texels of a chart that are covered by faces.
#[derive(Default)]
struct Texels {
    taken: std::collections::HashSet<(i32, i32)>,
    wanted: Vec<(i32, i32)>,
}

impl Texels {
    fn clear(&mut self) {
        self.taken.clear();
    }

    /// Marks the texels whose centers a triangle covers. Fails without marking if one is taken or the triangle is flipped, unless `always`
    /// is set.
    fn take(&mut self, t: [Vec2; 3], scale: f32, always: bool) -> bool {
        self.wanted.clear();
        let t = t.map(|p| p * scale);
        let area = (t[1] - t[0]).perp_dot(t[2] - t[0]);
        if !always && area <= 0.0 {
            return false;
        }
        let wanted = &mut self.wanted;
        covered(t, |x, y, _| wanted.push((x, y)));
        if !always && wanted.iter().any(|w| self.taken.contains(w)) {
            return false;
        }
        self.taken.extend(wanted.iter());
        true
    }
}

/// Calls `f` with each texel whose center lies in a triangle, and with the center's barycentric coordinates. Of two triangles that share
/// an edge, at most one contains a center on it.
pub(crate) fn covered(t: [Vec2; 3], mut f: impl FnMut(i32, i32, [f32; 3])) {
    let area = (t[1] - t[0]).perp_dot(t[2] - t[0]);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    let t = if area > 0.0 { t } else { [t[0], t[2], t[1]] };
    let flipped = area < 0.0;
    let area = area.abs();
    let lo = t[0].min(t[1]).min(t[2]);
    let hi = t[0].max(t[1]).max(t[2]);
    // An edge owns its points if it runs upward, or to the left.
    let owns = |a: Vec2, b: Vec2| b.y > a.y || (b.y == a.y && b.x < a.x);
    let edges = [(t[1], t[2]), (t[2], t[0]), (t[0], t[1])];
    for y in (lo.y - 0.5).ceil() as i32..=(hi.y - 0.5).floor() as i32 {
        for x in (lo.x - 0.5).ceil() as i32..=(hi.x - 0.5).floor() as i32 {
            let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let w = edges.map(|(a, b)| (b - a).perp_dot(p - a));
            let inside = (0..3).all(|k| w[k] > 0.0 || (w[k] == 0.0 && owns(edges[k].0, edges[k].1)));
            if inside {
                let b = w.map(|v| v / area);
                f(x, y, if flipped { [b[0], b[2], b[1]] } else { b });
            }
        }
    }
}

/// Positions of the charts in the texture, in texels, and texels per unit of length: the largest scale that fits.
fn pack(charts: &[Flat], size: f32, mut scale: f32) -> (f32, Vec<Vec2>) {
    let mut order: Vec<usize> = (0..charts.len()).collect();
    order.sort_by(|a, b| charts[*b].extent.y.total_cmp(&charts[*a].extent.y).then(a.cmp(b)));
    loop {
        if let Some(places) = pack_at(charts, &order, size, scale) {
            return (scale, places);
        }
        scale *= 0.97;
    }
}

/// Skyline packing: each chart goes to the lowest free position.
fn pack_at(charts: &[Flat], order: &[usize], size: f32, scale: f32) -> Option<Vec<Vec2>> {
    let width = size as usize;
    let mut places = vec![Vec2::ZERO; charts.len()];
    // Segments (first column, height) from left to right.
    let mut line: Vec<(usize, usize)> = vec![(0, 0)];
    for &c in order {
        let box_size = (charts[c].extent * scale + 2.0 * MARGIN).ceil();
        // Tiny charts may shrink to nothing, but their margins may not.
        let (w, h) = (box_size.x as usize, box_size.y as usize);
        let mut best: Option<(usize, usize, usize)> = None;
        for s in 0..line.len() {
            let x = line[s].0;
            if x + w > width {
                break;
            }
            let top = line[s..].iter().take_while(|l| l.0 < x + w).map(|l| l.1).max().unwrap_or(0);
            if best.is_none_or(|b| top < b.0) {
                best = Some((top, x, s));
            }
        }
        let (y, x, s) = best?;
        if y + h > width {
            return None;
        }
        places[c] = Vec2::new(x as f32, y as f32) + MARGIN;
        let end = line[s..].iter().take_while(|l| l.0 < x + w).count() + s;
        let after = (x + w < width && line.get(end).is_none_or(|l| l.0 > x + w)).then(|| (x + w, line[end - 1].1));
        line.splice(s..end, [(x, y + h)].into_iter().chain(after));
    }
    Some(places)
}

fn rebuild(mesh: &mut Mesh, charts: &[Chart], flat: &[Flat], places: &[Vec2], scale: f32, size: f32) {
    let old = std::mem::take(mesh);
    let pick = |v: &Vec<[f32; 3]>, i: u32| v.get(i as usize).copied();
    for ((chart, flat), place) in charts.iter().zip(flat).zip(places) {
        let first = mesh.positions.len() as u32;
        for (i, p) in &flat.points {
            mesh.positions.push(old.positions[*i as usize]);
            mesh.normals.extend(pick(&old.normals, *i));
            mesh.colors_srgb.extend(pick(&old.colors_srgb, *i));
            mesh.uvs.push((((*p - flat.low) * scale + *place) / size).to_array());
        }
        let corners = |f: &u32| old.faces[*f as usize].map(|i| first + flat.index[&i]);
        mesh.faces.extend(chart.faces.iter().map(corners));
    }
    mesh.texture = old.texture;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sphere with `n` rings.
    fn sphere(n: u32) -> Mesh {
        let mut m = Mesh::default();
        for i in 0..=n {
            for j in 0..2 * n {
                let (a, b) = (i as f32 / n as f32 * std::f32::consts::PI, j as f32 / n as f32 * std::f32::consts::PI);
                m.positions.push([a.sin() * b.cos(), a.sin() * b.sin(), a.cos()]);
            }
        }
        let at = |i: u32, j: u32| i * 2 * n + j % (2 * n);
        for i in 0..n {
            for j in 0..2 * n {
                m.faces.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                m.faces.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        m.faces.retain(|f| {
            let p = f.map(|i| Vec3::from(m.positions[i as usize]));
            (p[1] - p[0]).cross(p[2] - p[0]).length() > 1e-6
        });
        m.compute_normals();
        m
    }

    #[test]
    fn every_texel_belongs_to_one_face_at_most_and_no_face_is_lost() {
        let mut m = sphere(24);
        let before = m.clone();
        unwrap(&mut m, 256);
        assert_eq!(m.faces.len(), before.faces.len());
        assert_eq!((m.uvs.len(), m.normals.len()), (m.positions.len(), m.positions.len()));
        let mut owner = vec![0u8; 256 * 256];
        let mut used = 0;
        for f in &m.faces {
            let t = f.map(|i| Vec2::from(m.uvs[i as usize]) * 256.0);
            covered(t, |x, y, _| {
                owner[(y * 256 + x) as usize] += 1;
                used += 1;
            });
        }
        assert!(owner.iter().all(|n| *n <= 1), "overlap");
        assert!(used > 256 * 256 / 3, "only {used} texels are in use");
        let area = |m: &Mesh| -> f32 {
            let of = |f: &[u32; 3]| {
                let p = f.map(|i| Vec3::from(m.positions[i as usize]));
                (p[1] - p[0]).cross(p[2] - p[0]).length()
            };
            m.faces.iter().map(of).sum()
        };
        assert!((area(&m) / area(&before) - 1.0).abs() < 1e-5);
    }

    #[test]
    fn a_cube_gets_six_charts_without_stretch() {
        let mut m = Mesh::default();
        for c in 0..8u32 {
            m.positions.push(std::array::from_fn(|k| (c >> k & 1) as f32));
        }
        for (axis, side) in (0..3).flat_map(|a| [(a, 0u32), (a, 1)]) {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let at = |a: u32, b: u32| (side << axis) | (a << u) | (b << v);
            let ring = if side == 1 { [at(0, 0), at(1, 0), at(1, 1), at(0, 1)] } else { [at(0, 0), at(0, 1), at(1, 1), at(1, 0)] };
            m.faces.extend([[ring[0], ring[1], ring[2]], [ring[0], ring[2], ring[3]]]);
        }
        unwrap(&mut m, 128);
        assert_eq!((m.faces.len(), m.positions.len()), (12, 24));
        let lengths: Vec<f32> = m
            .faces
            .iter()
            .map(|f| {
                let (p, q) = (f.map(|i| Vec3::from(m.positions[i as usize])), f.map(|i| Vec2::from(m.uvs[i as usize])));
                (q[1] - q[0]).length() / (p[1] - p[0]).length()
            })
            .collect();
        assert!(lengths.iter().all(|l| (l / lengths[0] - 1.0).abs() < 1e-3), "{lengths:?}");
    }

    #[test]
    fn no_area_no_charts() {
        let mut m = Mesh { positions: vec![[0.0; 3]; 3], faces: vec![[0, 1, 2]], ..Mesh::default() };
        unwrap(&mut m, 64);
        assert_eq!(m.uvs.len(), 3);
    }
}
