//! Normal maps: normals of the field on the texture of a simplified mesh, in the tangent space of glTF: x along u, y against v, z outward.

use crate::bake::{self, Texels};
use diorama_geom::field_query::FieldQuery;
use diorama_geom::{ImageU8, Mesh};
use glam::{Mat3, Vec2, Vec3, Vec4};

/// Cells on either side of a face in which the surface is searched, and steps of the search.
const REACH: f32 = 2.0;
const STEPS: usize = 8;
/// Cells over which the density gradient is taken.
const SPAN: f32 = 0.75;
/// Texels per query of the field.
const BATCH: usize = 1 << 16;

/// Computes tangents of a mesh with normals and texture coordinates: unit vectors along u, and the sign of `normal × tangent` along −v.
pub fn set_tangents(mesh: &mut Mesh) {
    let n = mesh.positions.len();
    let (mut along_u, mut against_v) = (vec![Vec3::ZERO; n], vec![Vec3::ZERO; n]);
    for f in &mesh.faces {
        let p = f.map(|i| Vec3::from(mesh.positions[i as usize]));
        let t = f.map(|i| Vec2::from(mesh.uvs[i as usize]));
        let (e, d) = ([p[1] - p[0], p[2] - p[0]], [t[1] - t[0], t[2] - t[0]]);
        let det = d[0].perp_dot(d[1]);
        if det.abs() < 1e-20 {
            continue;
        }
        // Weighted by area, because the tangents of large faces are more reliable.
        let area = e[0].cross(e[1]).length();
        let u = ((e[0] * d[1].y - e[1] * d[0].y) / det).normalize_or_zero() * area;
        let v = ((e[1] * d[0].x - e[0] * d[1].x) / det).normalize_or_zero() * area;
        f.iter().for_each(|i| {
            along_u[*i as usize] += u;
            against_v[*i as usize] -= v;
        });
    }
    let tangent = |i: usize| {
        let n = Vec3::from(mesh.normals[i]);
        let u = along_u[i] - n * n.dot(along_u[i]);
        let t = u.try_normalize().unwrap_or_else(|| n.any_orthonormal_vector());
        t.extend(if n.cross(t).dot(against_v[i]) < 0.0 { -1.0 } else { 1.0 }).to_array()
    };
    mesh.tangents = (0..n).map(tangent).collect();
}

/// Computes the normal map, `size × size`, of a mesh with tangents. `cell` is the edge of the cells that it was extracted with, `level`
/// the density of the surface.
pub fn bake(field: &dyn FieldQuery, mesh: &Mesh, size: usize, cell: f32, level: f32, progress: &mut dyn FnMut(usize, usize)) -> ImageU8 {
    let texels = bake::texels(mesh, size);
    let frames = frames(mesh, &texels, size);
    let mut rgb = Vec::with_capacity(texels.index.len());
    for first in (0..texels.index.len()).step_by(BATCH) {
        let last = (first + BATCH).min(texels.index.len());
        let normals = normals(field, &texels, first..last, cell, level);
        rgb.extend(normals.iter().zip(&frames[first..last]).map(|(n, frame)| {
            // A renderer reconstructs the normal from this frame, whose vectors need not be orthogonal.
            let t = (frame.inverse() * *n).try_normalize().filter(|t| t.is_finite() && t.z > 0.0).unwrap_or(Vec3::Z);
            (t * 0.5 + 0.5).to_array()
        }));
        progress(last, texels.index.len());
    }
    bake::texture(&texels, &rgb, size)
}

/// Interpolated tangent, bitangent and normal of each texel.
fn frames(mesh: &Mesh, texels: &Texels, size: usize) -> Vec<Mat3> {
    let frame = |k: usize| {
        let f = mesh.faces[texels.face[k] as usize];
        let at = Vec2::new((texels.index[k] as usize % size) as f32 + 0.5, (texels.index[k] as usize / size) as f32 + 0.5) / size as f32;
        let [a, b, c] = f.map(|i| Vec2::from(mesh.uvs[i as usize]));
        let det = (b - a).perp_dot(c - a);
        let s = (at - a).perp_dot(c - a) / det;
        let t = (b - a).perp_dot(at - a) / det;
        let weights = if det.abs() > 1e-20 { [1.0 - s - t, s, t] } else { [1.0, 0.0, 0.0] };
        let mut tangent = Vec4::ZERO;
        f.iter().zip(weights).for_each(|(i, w)| tangent += Vec4::from(mesh.tangents[*i as usize]) * w);
        let normal = Vec3::from(texels.normals[k]);
        let along = tangent.truncate().normalize_or(normal.any_orthonormal_vector());
        Mat3::from_cols(along, normal.cross(along) * tangent.w.signum(), normal)
    };
    (0..texels.index.len()).map(frame).collect()
}

/// Outward unit normals of the field at the points where lines through some texels, along the mesh normal, meet its surface.
fn normals(field: &dyn FieldQuery, texels: &Texels, range: std::ops::Range<usize>, cell: f32, level: f32) -> Vec<Vec3> {
    let place = |k: usize| (Vec3::from(texels.positions[k]), Vec3::from(texels.normals[k]));
    let offset = |s: usize| (2.0 * s as f32 / STEPS as f32 - 1.0) * REACH * cell;
    let line = |k: usize| {
        let (p, n) = place(k);
        (0..=STEPS).map(move |s| (p - n * offset(s)).to_array())
    };
    let points: Vec<[f32; 3]> = range.clone().flat_map(line).collect();
    let mut sigma = vec![0.0; points.len()];
    field.density(&points, &mut sigma);
    // From outside inward: the crossing of the level nearest to the face.
    let on_surface = |(k, s): (usize, &[f32])| {
        let crossing = |i: usize| offset(i) + (offset(i + 1) - offset(i)) * (level - s[i]) / (s[i + 1] - s[i]);
        let all = (0..STEPS).filter(|i| s[*i] <= level && s[*i + 1] > level).map(crossing);
        let nearest = all.min_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(0.0);
        let (p, n) = place(k);
        p - n * nearest
    };
    let surface: Vec<Vec3> = range.clone().zip(sigma.chunks_exact(STEPS + 1)).map(on_surface).collect();
    let step = SPAN * cell;
    let around = |p: &Vec3| (0..6).map(|k| (*p + Vec3::AXES[k / 2] * if k % 2 == 0 { step } else { -step }).to_array()).collect::<Vec<_>>();
    let points: Vec<[f32; 3]> = surface.iter().flat_map(around).collect();
    let mut sigma = vec![0.0; points.len()];
    field.density(&points, &mut sigma);
    let slope = |(k, s): (usize, &[f32])| {
        let n = place(k).1;
        let g = Vec3::new(s[1] - s[0], s[3] - s[2], s[5] - s[4]).normalize_or(n);
        // A field normal that points away from the mesh normal is noise.
        if g.dot(n) > 0.2 { g } else { n }
    };
    range.zip(sigma.chunks_exact(6)).map(slope).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::extract::{Grid, Method, extract};
    use crate::{atlas, simplify};

    /// A ball with a wavy surface.
    struct Waves;

    impl Waves {
        fn density_at(p: Vec3) -> f32 {
            let r = 0.7 + 0.012 * (14.0 * p.x).sin() * (14.0 * p.y).sin();
            (10.0 - 60.0 * (p.length() - r)).max(0.0)
        }
    }

    impl FieldQuery for Waves {
        fn density(&self, points: &[[f32; 3]], sigma: &mut [f32]) {
            points.iter().zip(sigma).for_each(|(p, s)| *s = Waves::density_at(Vec3::from(*p)));
        }
        fn color(&self, _: &[[f32; 3]], _: &[[f32; 3]], rgb: &mut [[f32; 3]]) {
            rgb.fill([0.5; 3]);
        }
    }

    #[test]
    fn a_simplified_ball_shows_its_waves() {
        let grid = Grid { min: [-1.0; 3], max: [1.0; 3], resolution: 96 };
        let mut m = extract(&Waves, &grid, 10.0, Method::Cubes, &mut |_, _| {});
        simplify::simplify(&mut m, 800).unwrap();
        m.compute_normals();
        atlas::unwrap(&mut m, 256);
        set_tangents(&mut m);
        let map = bake(&Waves, &m, 256, grid.cell(), 10.0, &mut |_, _| {});
        let texels = bake::texels(&m, 256);
        let frames = frames(&m, &texels, 256);
        let (mut mapped, mut plain) = (0.0, 0.0);
        for k in 0..texels.index.len() {
            let p = Vec3::from(texels.positions[k]);
            let e = 1e-3;
            // The gradient is the same slightly deeper, where the density is not clamped.
            let inner = p * (0.69 / p.length());
            let slope_in = |d: Vec3| Waves::density_at(inner + d * e) - Waves::density_at(inner - d * e);
            let truth = -Vec3::new(slope_in(Vec3::X), slope_in(Vec3::Y), slope_in(Vec3::Z)).normalize();
            let i = texels.index[k] as usize;
            let c = map.pixel(i % 256, i / 256);
            let t = Vec3::new(c[0] as f32, c[1] as f32, c[2] as f32) / 127.5 - 1.0;
            mapped += (frames[k] * t).normalize().dot(truth).clamp(-1.0, 1.0).acos();
            plain += Vec3::from(texels.normals[k]).dot(truth).clamp(-1.0, 1.0).acos();
        }
        let n = texels.index.len() as f32;
        assert!(mapped / n < 0.06 && mapped < 0.4 * plain, "{} against {} radians", mapped / n, plain / n);
    }
}
