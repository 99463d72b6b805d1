//! Texture baking: positions of texels on the surface, the cameras that see them, and padding between charts.

use crate::atlas::covered;
use diorama_geom::{Camera, ImageU8, Mesh, Pose};
use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;

/// Texels that lie on the surface.
#[derive(Default)]
pub struct Texels {
    /// Index in the texture, row by row, `[N]`.
    pub index: Vec<u32>,
    pub face: Vec<u32>,
    pub positions: Vec<[f32; 3]>,
    /// Unit normals, interpolated.
    pub normals: Vec<[f32; 3]>,
}

/// Texels of a `size × size` texture whose centers are covered by a face. The mesh must have texture coordinates and normals.
pub fn texels(mesh: &Mesh, size: usize) -> Texels {
    let mut out = Texels::default();
    for (i, f) in mesh.faces.iter().enumerate() {
        let uv = f.map(|v| Vec2::from(mesh.uvs[v as usize]) * size as f32);
        let (p, n) = (f.map(|v| Vec3::from(mesh.positions[v as usize])), f.map(|v| Vec3::from(mesh.normals[v as usize])));
        covered(uv, |x, y, b| {
            if x < 0 || y < 0 || x >= size as i32 || y >= size as i32 {
                return;
            }
            out.index.push(y as u32 * size as u32 + x as u32);
            out.face.push(i as u32);
            out.positions.push((p[0] * b[0] + p[1] * b[1] + p[2] * b[2]).to_array());
            out.normals.push((n[0] * b[0] + n[1] * b[1] + n[2] * b[2]).normalize_or(n[0]).to_array());
        });
    }
    out
}

/// A texture with the texels' colors `[N, 3]`, spread as [`spread`] does.
pub fn texture(texels: &Texels, rgb_srgb: &[[f32; 3]], size: usize) -> ImageU8 {
    let data = spread(texels, rgb_srgb, size).iter().flatten().map(|v| diorama_geom::color::u8_from_unit(*v)).collect();
    ImageU8 { width: size, height: size, channels: 3, data }
}

/// Values `[size, size, 3]` of all texels. Those beside the texels, and those with a negative first value, get the nearest value, so that
/// texture filtering does not blend a background across seams.
pub fn spread(texels: &Texels, values: &[[f32; 3]], size: usize) -> Vec<[f32; 3]> {
    let mut color = vec![[0.0f32; 3]; size * size];
    let mut known = vec![false; size * size];
    for (i, c) in texels.index.iter().zip(values).filter(|(_, c)| c[0] >= 0.0) {
        color[*i as usize] = *c;
        known[*i as usize] = true;
    }
    let mut border: Vec<u32> = (0..(size * size) as u32).filter(|i| !known[*i as usize]).collect();
    while !border.is_empty() && border.len() < size * size {
        let around = |i: u32| {
            let (x, y) = ((i as usize % size) as i32, (i as usize / size) as i32);
            let near = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)].map(|(dx, dy)| (x + dx, y + dy));
            near.into_iter()
                .filter(|(x, y)| (0..size as i32).contains(x) && (0..size as i32).contains(y))
                .map(|(x, y)| y as usize * size + x as usize)
        };
        let found: Vec<(u32, Option<[f32; 3]>)> = border
            .par_iter()
            .map(|&i| {
                let (mut sum, mut n) = ([0.0f32; 3], 0.0);
                for j in around(i).filter(|j| known[*j]) {
                    (0..3).for_each(|k| sum[k] += color[j][k]);
                    n += 1.0;
                }
                (i, (n > 0.0).then(|| sum.map(|v| v / n)))
            })
            .collect();
        border.clear();
        for (i, c) in found {
            match c {
                Some(c) => (color[i as usize], known[i as usize]) = (c, true),
                None => border.push(i),
            }
        }
    }
    color
}

/// Depth map of a camera: distance to the first surface in each pixel.
pub struct DepthMap {
    camera: Camera,
    camera_from_world: Pose,
    /// Infinite where there is no surface.
    depth: Vec<f32>,
}

impl DepthMap {
    /// Renders a mesh; faces that reach behind the camera are left out.
    pub fn new(mesh: &Mesh, camera: Camera, world_from_camera: &Pose) -> DepthMap {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut map = DepthMap { camera, camera_from_world: world_from_camera.inverse(), depth: vec![f32::INFINITY; w * h] };
        let seen: Vec<Option<(Vec2, f32)>> = mesh.positions.iter().map(|p| map.project(*p)).collect();
        for f in &mesh.faces {
            let [Some(a), Some(b), Some(c)] = f.map(|i| seen[i as usize]) else { continue };
            let t = [a.0, b.0, c.0];
            if t.iter().all(|p| p.x < 0.0)
                || t.iter().all(|p| p.y < 0.0)
                || t.iter().all(|p| p.x > w as f32)
                || t.iter().all(|p| p.y > h as f32)
            {
                continue;
            }
            let t = t.map(|p| p.clamp(Vec2::splat(-4.0 * w as f32), Vec2::splat(4.0 * w as f32)));
            covered(t, |x, y, s| {
                if x >= 0 && y >= 0 && x < w as i32 && y < h as i32 {
                    // 1/z is linear in the image.
                    let d = 1.0 / (s[0] / a.1 + s[1] / b.1 + s[2] / c.1);
                    let at = &mut map.depth[y as usize * w + x as usize];
                    *at = at.min(d);
                }
            });
        }
        map
    }

    /// Pixel and distance of a point in front of the camera.
    fn project(&self, p_in_world: [f32; 3]) -> Option<(Vec2, f32)> {
        let q = self.camera_from_world.point(DVec3::from(p_in_world.map(|v| v as f64)));
        let px = self.camera.project(q).filter(|_| q.z > 0.0)?;
        (px.is_finite()).then(|| (px.as_vec2(), q.length() as f32))
    }

    /// Whether the camera sees a point, that is, no surface is nearer by more than `slack`.
    pub fn sees(&self, p_in_world: [f32; 3], slack: f32) -> bool {
        let Some((px, d)) = self.project(p_in_world) else { return false };
        let (w, h) = (self.camera.width as i32, self.camera.height as i32);
        // Checked before the conversion to pixel indices: a lens may project a point arbitrarily far outside the image.
        if !((1.0..w as f32 - 1.0).contains(&px.x) && (1.0..h as f32 - 1.0).contains(&px.y)) {
            return false;
        }
        let (x, y) = (px.x as i32, px.y as i32);
        // The nearest of the neighboring pixels, so that an edge in front of the point occludes it.
        let first = (0..9).map(|k| self.depth[((y + k / 3 - 1) * w + x + k % 3 - 1) as usize]).fold(f32::INFINITY, f32::min);
        // On a surface at 60 degrees to the view, the neighboring pixels are nearer by this much.
        d <= first + slack + 2.5 * d / self.camera.fx.min(self.camera.fy) as f32
    }

    /// Distance to the first surface in each pixel, row by row; infinite where there is none.
    pub fn depth(&self) -> &[f32] {
        &self.depth
    }

    /// Center of the camera in the world.
    pub fn eye(&self) -> DVec3 {
        self.camera_from_world.inverse().translation
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two unit squares perpendicular to z, the second two units behind the first.
    fn squares() -> Mesh {
        let mut m = Mesh::default();
        for z in [0.0, -2.0] {
            let first = m.positions.len() as u32;
            m.positions.extend([[0.0, 0.0, z], [1.0, 0.0, z], [1.0, 1.0, z], [0.0, 1.0, z]]);
            m.faces.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
        }
        m.compute_normals();
        m
    }

    #[test]
    fn the_near_square_hides_the_far_one() {
        let m = squares();
        let eye = Pose::look_at(DVec3::new(0.5, 0.5, 3.0), DVec3::new(0.5, 0.5, 0.0), DVec3::Y);
        let map = DepthMap::new(&m, Camera::pinhole(100, 100, 0.8), &eye);
        assert!(map.sees([0.5, 0.5, 0.0], 1e-3) && !map.sees([0.5, 0.5, -2.0], 1e-3));
        let side = Pose::look_at(DVec3::new(5.0, 0.5, 3.0), DVec3::new(0.5, 0.5, -2.0), DVec3::Y);
        assert!(DepthMap::new(&m, Camera::pinhole(100, 100, 0.8), &side).sees([0.9, 0.5, -2.0], 2e-2));
        assert!(!map.sees([0.5, 0.5, 9.0], 1e-3), "behind the camera");
        // Beside the camera, where projections exceed the range of pixel indices.
        assert!(!map.sees([1e30, 0.5, 2.9], 1e-3) && !map.sees([0.5, -1e30, 2.9], 1e-3));
    }

    #[test]
    fn texels_lie_on_the_surface_and_the_rest_is_filled() {
        let mut m = squares();
        crate::atlas::unwrap(&mut m, 64);
        let t = texels(&m, 64);
        assert!(t.positions.iter().all(|p| p[2].abs() < 1e-5 || (p[2] + 2.0).abs() < 1e-5) && t.index.len() > 64 * 64 / 3);
        let rgb: Vec<[f32; 3]> = t.positions.iter().map(|p| [p[0], p[1], if p[2] < -1.0 { 1.0 } else { 0.0 }]).collect();
        let image = texture(&t, &rgb, 64);
        // A vertex's texture coordinates lead to its own color.
        for (p, uv) in m.positions.iter().zip(&m.uvs) {
            let c = image.pixel((uv[0] * 64.0) as usize, (uv[1] * 64.0) as usize);
            assert!((c[0] as f32 / 255.0 - p[0]).abs() < 0.06 && (c[1] as f32 / 255.0 - p[1]).abs() < 0.06, "{p:?} {c:?}");
        }
    }
}
