//! Triangles under construction: corners with texture coordinates in meters; shading normals follow from a crease angle at the end.

mod solids;

use diorama_geom::Mesh;
use diorama_geom::glam::{DAffine3, DVec2, DVec3};
use std::collections::HashMap;

pub use solids::arc;

/// Faces that meet at a larger angle keep a sharp edge, in degrees.
pub const CREASE_DEGREES: f64 = 38.0;

/// A list of triangles, three corners each, counterclockwise seen from outside.
#[derive(Clone, Debug, Default)]
pub struct Surface {
    corners: Vec<Corner>,
}

/// Position in meters, and texture coordinates in meters.
#[derive(Clone, Copy, Debug)]
struct Corner {
    position: [f32; 3],
    uv: [f32; 2],
}

/// Texture coordinates in meters by projection along the axis closest to the normal: u to the right, v down.
fn box_projection(p: DVec3, normal: DVec3) -> DVec2 {
    let a = normal.abs();
    if a.z >= a.x && a.z >= a.y {
        DVec2::new(p.x, -p.y * normal.z.signum())
    } else if a.y >= a.x {
        DVec2::new(-p.x * normal.y.signum(), -p.z)
    } else {
        DVec2::new(p.y * normal.x.signum(), -p.z)
    }
}

impl Surface {
    /// Adds a triangle with texture coordinates; one without area is left out.
    pub fn triangle(&mut self, corners: [(DVec3, DVec2); 3]) {
        // Sums with 0 turn −0 into 0, so that equal positions have equal bits.
        let rounded = corners.map(|(p, uv)| Corner { position: p.as_vec3().to_array().map(|v| v + 0.0), uv: uv.as_vec2().to_array() });
        let [a, b, c] = rounded.map(|c| DVec3::from(c.position.map(f64::from)));
        if (b - a).cross(c - a).length() > 1e-10 {
            self.corners.extend(rounded);
        }
    }

    /// Adds a convex polygon, mapped by projection along an axis.
    pub fn polygon(&mut self, corners: &[DVec3]) {
        let normal = polygon_normal(corners);
        let at = |p: DVec3| (p, box_projection(p, normal));
        for k in 1..corners.len() - 1 {
            self.triangle([at(corners[0]), at(corners[k]), at(corners[k + 1])]);
        }
    }

    /// Adds a planar convex polygon mapped in its own plane: u along the first edge, v against the direction to the last corner.
    pub fn slope(&mut self, corners: &[DVec3]) {
        let u = (corners[1] - corners[0]).normalize();
        let v = polygon_normal(corners).cross(u);
        let at = |p: DVec3| (p, DVec2::new(p.dot(u), -(p - corners[0]).dot(v)));
        for k in 1..corners.len() - 1 {
            self.triangle([at(corners[0]), at(corners[k]), at(corners[k + 1])]);
        }
    }

    /// Adds `columns × rows` quads between points `at(i, j)`; outside is where i runs to the right and j runs up.
    pub fn grid(&mut self, columns: usize, rows: usize, at: impl Fn(usize, usize) -> (DVec3, DVec2)) {
        for j in 0..rows {
            for i in 0..columns {
                let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                self.triangle([a, b, c]);
                self.triangle([a, c, d]);
            }
        }
    }

    /// Adds a copy of another surface. The transform must not mirror.
    pub fn add(&mut self, other: &Surface, self_from_other: DAffine3) {
        self.corners.extend(other.corners.iter().map(|c| {
            let p = self_from_other.transform_point3(DVec3::from(c.position.map(f64::from)));
            Corner { position: p.as_vec3().to_array().map(|v| v + 0.0), uv: c.uv }
        }));
    }

    /// The indexed mesh with unit normals and tangents; the texture repeats every `tile_m` meters.
    pub fn mesh(&self, tile_m: f64) -> Mesh {
        let normals = self.corner_normals(CREASE_DEGREES.to_radians().cos());
        let mut mesh = Mesh::default();
        let mut index = HashMap::<[u32; 9], u32>::new();
        let mut tangents: Vec<DVec3> = Vec::new();
        for (f, face) in self.corners.chunks_exact(3).enumerate() {
            let (tangent, sign) = face_tangent(face);
            let ids: [u32; 3] = std::array::from_fn(|k| {
                let (c, n) = (face[k], normals[3 * f + k]);
                let values = [c.position[0], c.position[1], c.position[2], n[0], n[1], n[2], c.uv[0], c.uv[1], sign as f32];
                let id = *index.entry(values.map(f32::to_bits)).or_insert_with(|| {
                    mesh.positions.push(c.position);
                    mesh.normals.push(n);
                    mesh.uvs.push(c.uv.map(|v| (v as f64 / tile_m) as f32));
                    mesh.tangents.push([0.0, 0.0, 0.0, sign as f32]);
                    tangents.push(DVec3::ZERO);
                    mesh.positions.len() as u32 - 1
                });
                tangents[id as usize] += tangent;
                id
            });
            mesh.faces.push(ids);
        }
        for ((t, n), out) in tangents.iter().zip(&mesh.normals).zip(&mut mesh.tangents) {
            let n = DVec3::from(n.map(f64::from));
            let t = (*t - n * t.dot(n)).try_normalize().unwrap_or_else(|| n.any_orthonormal_vector());
            out[..3].copy_from_slice(&t.as_vec3().to_array());
        }
        mesh
    }

    /// Angle-weighted average of the face normals around each corner whose cosine with the corner's own face is at least `min_cosine`.
    fn corner_normals(&self, min_cosine: f64) -> Vec<[f32; 3]> {
        let point = |c: &Corner| DVec3::from(c.position.map(f64::from));
        let mut around = HashMap::<[u32; 3], Vec<(DVec3, f64)>>::new();
        let mut face_normals = Vec::with_capacity(self.corners.len() / 3);
        for face in self.corners.chunks_exact(3) {
            let p: [DVec3; 3] = std::array::from_fn(|k| point(&face[k]));
            let n = (p[1] - p[0]).cross(p[2] - p[0]).normalize();
            face_normals.push(n);
            for k in 0..3 {
                let angle = (p[(k + 1) % 3] - p[k]).angle_between(p[(k + 2) % 3] - p[k]);
                around.entry(face[k].position.map(f32::to_bits)).or_default().push((n, angle));
            }
        }
        let smooth = |(i, c): (usize, &Corner)| {
            let own = face_normals[i / 3];
            let near = around[&c.position.map(f32::to_bits)].iter().filter(|(n, _)| n.dot(own) >= min_cosine);
            let sum = near.map(|(n, angle)| *n * *angle).sum::<DVec3>();
            sum.try_normalize().unwrap_or(own).as_vec3().to_array()
        };
        self.corners.iter().enumerate().map(smooth).collect()
    }

    /// Whether, with corners at equal positions joined, every edge is crossed as often in one direction as in the other.
    #[cfg(test)]
    pub fn is_closed(&self) -> bool {
        let mut balance = HashMap::<[[u32; 3]; 2], i64>::new();
        for face in self.corners.chunks_exact(3) {
            for k in 0..3 {
                let (a, b) = (face[k].position.map(f32::to_bits), face[(k + 1) % 3].position.map(f32::to_bits));
                *balance.entry(if a < b { [a, b] } else { [b, a] }).or_default() += if a < b { 1 } else { -1 };
            }
        }
        !self.corners.is_empty() && balance.values().all(|n| *n == 0)
    }
}

/// Unit normal of a planar polygon.
fn polygon_normal(corners: &[DVec3]) -> DVec3 {
    let fan = (1..corners.len() - 1).map(|k| (corners[k] - corners[0]).cross(corners[k + 1] - corners[0]));
    fan.sum::<DVec3>().normalize_or_zero()
}

/// Direction of u on a triangle, and the sign for which `sign · (normal × tangent)` points against v.
fn face_tangent(face: &[Corner]) -> (DVec3, f64) {
    let p = |k: usize| DVec3::from(face[k].position.map(f64::from));
    let t = |k: usize| DVec2::from(face[k].uv.map(f64::from));
    let (e1, e2, d1, d2) = (p(1) - p(0), p(2) - p(0), t(1) - t(0), t(2) - t(0));
    let det = d1.perp_dot(d2);
    if det.abs() < 1e-14 {
        return (DVec3::ZERO, 1.0);
    }
    let along_u = (e1 * d2.y - e2 * d1.y) / det;
    let along_v = (e2 * d1.x - e1 * d2.x) / det;
    let sign = if e1.cross(e2).cross(along_u).dot(along_v) < 0.0 { 1.0 } else { -1.0 };
    (along_u.normalize_or_zero(), sign)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_geom::glam::dvec3;

    #[test]
    fn a_box_keeps_its_edges_and_a_ball_is_smooth() {
        let mut s = Surface::default();
        s.cuboid(DVec3::ZERO, dvec3(1.0, 2.0, 3.0));
        let mesh = s.mesh(1.0);
        assert!(s.is_closed() && (mesh.volume() - 6.0).abs() < 1e-6);
        assert!(mesh.normals.iter().all(|n| n.iter().filter(|v| v.abs() > 1e-6).count() == 1));

        let mut ball = Surface::default();
        ball.ball(dvec3(1.0, 0.0, 0.0), 0.5, 32);
        let mesh = ball.mesh(1.0);
        assert!(ball.is_closed());
        for (p, n) in mesh.positions.iter().zip(&mesh.normals) {
            let outward = (DVec3::from(p.map(f64::from)) - dvec3(1.0, 0.0, 0.0)).normalize();
            assert!(DVec3::from(n.map(f64::from)).dot(outward) > 0.99);
        }
    }

    #[test]
    fn tangents_follow_u_and_their_sign_points_against_v() {
        let mut s = Surface::default();
        s.polygon(&[dvec3(0.0, 0.0, 0.0), dvec3(1.0, 0.0, 0.0), dvec3(1.0, 0.0, 1.0), dvec3(0.0, 0.0, 1.0)]);
        let mesh = s.mesh(2.0);
        assert!(mesh.normals.iter().all(|n| *n == [0.0, -1.0, 0.0]));
        // v falls with height: against v is up; normal × tangent = −y × x = z.
        assert!(mesh.tangents.iter().all(|t| *t == [1.0, 0.0, 0.0, 1.0]), "{:?}", mesh.tangents);
        assert!(mesh.positions.iter().zip(&mesh.uvs).all(|(p, uv)| *uv == [p[0] / 2.0, -p[2] / 2.0]));
    }

    #[test]
    fn an_open_surface_is_not_closed() {
        let mut s = Surface::default();
        s.cuboid(DVec3::ZERO, DVec3::ONE);
        s.corners.truncate(33);
        assert!(!s.is_closed());
    }
}
