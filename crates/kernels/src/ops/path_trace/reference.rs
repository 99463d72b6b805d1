//! The same light by uniform directions and all triangles one by one, in double precision. Materials without textures, holes and panes.

use super::View;
use super::bsdf::{Bsdf, Material};
use crate::ops::ray_triangles::{Ray, reference};
use diorama_geom::Model;
use diorama_geom::daylight::Daylight;
use diorama_geom::glam::DVec3;
use diorama_geom::rng::Rng;

/// Mean linear radiance of a pixel and its standard error by channel, from `samples` paths that meet at most `bounces` surfaces.
pub fn pixel(model: &Model, light: &Daylight, view: &View, [x, y]: [usize; 2], bounces: u32, samples: u64) -> ([f64; 3], [f64; 3]) {
    let world = World::new(model);
    let (mut sum, mut squares) = ([0.0; 3], [0.0; 3]);
    for sample in 0..samples {
        let rng = Rng::new(sample, (y * view.camera.width as usize + x) as u64);
        let at = [rng.uniform(0), rng.uniform(1)].map(f64::from);
        let d = view.world_from_camera.rotation * view.camera.direction(x as f64 + at[0], y as f64 + at[1]);
        let color = world.radiance(light, view.world_from_camera.translation, d, bounces, &rng);
        (0..3).for_each(|k| {
            sum[k] += color[k];
            squares[k] += color[k] * color[k];
        });
    }
    let n = samples as f64;
    let mean = sum.map(|s| s / n);
    (mean, std::array::from_fn(|k| ((squares[k] / n - mean[k] * mean[k]).max(0.0) / n).sqrt()))
}

struct World {
    vertices: Vec<[f32; 3]>,
    normals: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    materials: Vec<Material>,
}

impl World {
    fn new(model: &Model) -> World {
        let mut world = World { vertices: Vec::new(), normals: Vec::new(), triangles: Vec::new(), materials: Vec::new() };
        for instance in &model.instances {
            let (part, m) = (&model.parts[instance.part], &instance.world_from_part);
            let first = world.vertices.len() as u32;
            let wide = |v: &[f32; 3]| DVec3::from(v.map(f64::from));
            world.vertices.extend(part.mesh.positions.iter().map(|p| m.transform_point3(wide(p)).to_array().map(|v| v as f32)));
            let normal_matrix = m.matrix3.inverse().transpose();
            world.normals.extend(part.mesh.normals.iter().map(|n| normal_matrix * wide(n)));
            world.triangles.extend(part.mesh.faces.iter().map(|f| f.map(|v| v + first)));
            let m = &model.materials[part.material];
            let material = Material {
                base_color: [m.base_color[0], m.base_color[1], m.base_color[2]],
                roughness: m.roughness,
                metallic: m.metallic,
                specular: m.specular,
            };
            world.materials.resize(world.triangles.len(), material);
        }
        world
    }

    fn radiance(&self, light: &Daylight, mut origin: DVec3, mut d: DVec3, bounces: u32, rng: &Rng) -> [f64; 3] {
        let mut throughput = [1.0; 3];
        for bounce in 0..=bounces {
            let narrow = |v: DVec3| [v.x as f32, v.y as f32, v.z as f32];
            let ray = Ray { origin: narrow(origin), direction: narrow(d), range: [0.0, f32::INFINITY] };
            let Some((t, triangle, [u, v])) = reference::nearest(&self.vertices, &self.triangles, &ray) else {
                let radiance = distant(light, d);
                return std::array::from_fn(|k| throughput[k] * radiance[k]);
            };
            if bounce == bounces {
                break;
            }
            let [a, b, c] = self.triangles[triangle as usize].map(|i| i as usize);
            let [p, q, r] = [a, b, c].map(|i| DVec3::from(self.vertices[i].map(f64::from)));
            let flat = (q - p).cross(r - p).normalize();
            let side = if flat.dot(d) > 0.0 { -1.0 } else { 1.0 };
            let normal = side * ((1.0 - u - v) * self.normals[a] + u * self.normals[b] + v * self.normals[c]).normalize();
            let (s, t2) = normal.any_orthonormal_pair();
            let local = |v: DVec3| [v.dot(s) as f32, v.dot(t2) as f32, v.dot(normal) as f32];
            let Some(bsdf) = Bsdf::new(&self.materials[triangle as usize], local(-d)) else { break };
            // Even over the hemisphere: density 1 / 2π.
            let [z, turn] = [4 * bounce as u64 + 2, 4 * bounce as u64 + 3].map(|i| rng.uniform(i) as f64);
            let (sine, azimuth) = ((1.0 - z * z).sqrt(), std::f64::consts::TAU * turn);
            origin += t * d;
            d = sine * azimuth.cos() * s + sine * azimuth.sin() * t2 + z * normal;
            if d.dot(side * flat) <= 0.0 {
                break;
            }
            origin += 1e-5 * side * flat;
            let (value, _) = bsdf.evaluate(local(d));
            (0..3).for_each(|k| throughput[k] *= value[k] as f64 * std::f64::consts::TAU);
        }
        [0.0; 3]
    }
}

/// Radiance of map and sun.
fn distant(light: &Daylight, d: DVec3) -> [f64; 3] {
    let mut radiance = light.environment.radiance(d);
    if let Some(sun) = light.sun.filter(|s| s.direction.angle_between(d) <= 0.5 * s.diameter) {
        (0..3).for_each(|k| radiance[k] += sun.irradiance[k] / sun.solid_angle());
    }
    radiance
}
