//! Trees: bent limbs that split, and leaves on cards.

use super::materials::Materials;
use crate::assembly::{Assembly, Finish};
use crate::surface::Surface;
use diorama_geom::glam::{DAffine3, DMat3, DVec2, DVec3, dvec2, dvec3};
use diorama_geom::rng::Rng;
use std::f64::consts::TAU;

/// A card in the plane y = 0 with a texture of leaves, standing on the origin. The texture covers 1 m of texture coordinates.
pub fn card(surface: &mut Surface, size: f64) {
    let corners = [dvec2(-0.5, 0.0), dvec2(0.5, 0.0), dvec2(0.5, 1.0), dvec2(-0.5, 1.0)];
    let at = |p: DVec2| (dvec3(p.x * size, 0.0, p.y * size), dvec2(0.002 + 0.996 * (p.x + 0.5), 0.998 - 0.996 * p.y));
    let [a, b, c, d] = corners.map(at);
    surface.triangle([a, b, c]);
    surface.triangle([a, c, d]);
}

/// Growth of one tree.
struct Growth<'a> {
    rng: Rng,
    next: u64,
    bark: &'a mut Surface,
    leaves: Surface,
}

/// A limb to grow.
#[derive(Clone, Copy)]
struct Limb {
    from: DVec3,
    direction: DVec3,
    length: f64,
    radius: f64,
    order: usize,
}

impl Growth<'_> {
    fn uniform(&mut self, lo: f64, hi: f64) -> f64 {
        self.next += 1;
        lo + (hi - lo) * self.rng.uniform(self.next) as f64
    }

    fn limb(&mut self, limb: Limb) {
        let steps = [7, 4, 2, 1][limb.order.min(3)];
        let (mut p, mut d) = (limb.from, limb.direction);
        let mut path = vec![p];
        for _ in 0..steps {
            let sway = if limb.order == 0 { 0.06 } else { 0.16 };
            let bend = dvec3(self.uniform(-sway, sway), self.uniform(-sway, sway), if limb.order == 0 { 0.05 } else { 0.09 });
            d = (d + bend).normalize();
            p += d * (limb.length / steps as f64);
            path.push(p);
        }
        let taper = |k: usize| 1.0 - 0.55 * k as f64 / steps as f64;
        let flare = |k: usize| if limb.order == 0 && k == 0 { 1.45 } else { 1.0 };
        let radii: Vec<f64> = (0..=steps).map(|k| limb.radius * taper(k) * flare(k)).collect();
        self.bark.tube(&path, &radii, [14, 8, 4, 3][limb.order.min(3)]);
        if limb.order >= 2 {
            self.foliage(&path, if limb.order == 2 { 7 } else { 6 });
        }
        if limb.order < 3 {
            let children = [8, 5, 3][limb.order];
            let first = [0.5, 0.35, 0.3][limb.order];
            let start = self.uniform(0.0, TAU);
            for k in 0..children {
                let t = first + (1.0 - first) * (k as f64 + 0.9) / children as f64;
                let s = (t * steps as f64).min(steps as f64 - 1e-6);
                let (j, f) = (s as usize, s.fract());
                let along = (path[j + 1] - path[j]).normalize();
                let side = along.any_orthonormal_vector();
                let angle = start + k as f64 * 2.4 + self.uniform(-0.3, 0.3);
                let around = side * angle.cos() + along.cross(side) * angle.sin();
                let lean = self.uniform(0.65, 1.0) * if k + 1 == children { 0.35 } else { 1.0 };
                let length = limb.length * [0.5, 0.55, 0.5][limb.order] * self.uniform(0.8, 1.15) * (1.15 - 0.3 * t);
                let radius = limb.radius * taper(j) * 0.55;
                let direction = (along * lean.cos() + around * lean.sin()).normalize();
                self.limb(Limb { from: path[j].lerp(path[j + 1], f), direction, length, radius, order: limb.order + 1 });
            }
        }
    }

    fn foliage(&mut self, path: &[DVec3], cards: usize) {
        for k in 0..cards {
            let s = (path.len() - 1) as f64 * (0.25 + 0.75 * (k as f64 + 0.5) / cards as f64);
            let at = path[s as usize].lerp(path[(s as usize + 1).min(path.len() - 1)], s.fract());
            let turn = DMat3::from_rotation_z(self.uniform(0.0, TAU)) * DMat3::from_rotation_x(self.uniform(-1.9, -0.2));
            let turn = turn * DMat3::from_rotation_z(self.uniform(0.0, TAU));
            let size = self.uniform(0.42, 0.62);
            let mut leaf = Surface::default();
            card(&mut leaf, size);
            self.leaves.add(&leaf, DAffine3 { matrix3: turn, translation: at });
        }
    }
}

/// A tree on the origin, about `height` meters high.
pub fn tree(m: &Materials, leaves: Finish, height: f64, seed: u64) -> Assembly {
    let mut out = Assembly::default();
    let bark = out.piece("trunk", m.bark);
    let mut growth = Growth { rng: Rng::new(seed, 72), next: 0, bark, leaves: Surface::default() };
    growth.limb(Limb { from: dvec3(0.0, 0.0, -0.1), direction: DVec3::Z, length: 0.72 * height, radius: 0.028 * height, order: 0 });
    let crown = growth.leaves;
    out.piece("leaves", leaves).add(&crown, DAffine3::IDENTITY);
    out
}
