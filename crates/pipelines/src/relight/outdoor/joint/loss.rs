//! Loss of the model as printed, and its gradient.

use crate::relight::outdoor::shading::{CHANNELS, LIGHT, NORMAL};
use diorama_geom::glam::DVec3;
use diorama_geom::sh_light;
use diorama_kernels::ops::field_step::{BatchLoss, RayGradients, RayOutputs};
use std::sync::Mutex;

/// Least irradiance, below which it has no slope.
const DARKEST: f32 = 1e-5;
/// Exponent by which linear light becomes values of a photograph.
pub(super) const GAMMA: f32 = 1.0 / 2.2;
/// Length at which a normal is shortened by `√2`: what is shorter, in empty space, has no direction to speak of.
const SHORT: f32 = 0.05;

/// Squared error of the colors, mean over rays and channels, and of the shadows from 1, mean over rays.
pub struct JointLoss<'a> {
    /// sRGB, `[R, 3]`.
    pub target: &'a [f32],
    /// Whether a ray's color counts, `[R]`.
    pub counts: &'a [bool],
    /// Light of each ray, `[R]`.
    pub light: &'a [u32],
    /// `[lights, 9, 3]`
    pub lights: &'a [f32],
    /// What lies behind, sRGB, `[R, 3]`.
    pub behind: &'a [f32],
    /// Weight of the shadows.
    pub shadow: f32,
    pub out: Mutex<JointGradients>,
}

/// Gradients of what the field does not hold.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JointGradients {
    /// `[lights, 9, 3]`
    pub lights: Vec<f32>,
    /// `[R, 3]`
    pub behind: Vec<f32>,
    /// Mean squared error of the colors.
    pub mse: f64,
}

/// A surface under a light.
pub(super) struct Lit {
    /// `v / √(v² + SHORT²)`, and that root.
    normal: [f32; 3],
    length: f32,
    basis: [f64; 9],
    irradiance: [f32; 3],
    /// Factor of the sRGB albedo.
    pub factor: [f32; 3],
}

/// A normal `−Σ w ∇σ` under a light `[9, 3]`.
pub(super) fn lit(normal: &[f32], light: &[f32]) -> Lit {
    let length = normal.iter().fold(SHORT * SHORT, |sum, n| sum + n * n).sqrt();
    let normal = [0, 1, 2].map(|k| normal[k] / length);
    let basis = sh_light::basis(DVec3::from(normal.map(f64::from)));
    let irradiance = [0, 1, 2].map(|k| (0..9).map(|i| light[3 * i + k] * basis[i] as f32).sum::<f32>());
    Lit { normal, length, basis, irradiance, factor: irradiance.map(|e| e.max(DARKEST).powf(GAMMA)) }
}

impl Lit {
    /// Adds the gradients of normal and light for that of the factors.
    fn backward(&self, light: &[f32], d_factor: [f32; 3], d_normal: &mut [f32], d_light: &mut [f32]) {
        let mut toward = [0.0f32; 3];
        for k in (0..3).filter(|k| self.irradiance[*k] > DARKEST) {
            let d = d_factor[k] * GAMMA * self.factor[k] / self.irradiance[k];
            (0..9).for_each(|i| d_light[3 * i + k] += d * self.basis[i] as f32);
            let slope = sh_light::basis_gradient(DVec3::from(self.normal.map(f64::from)));
            for (i, s) in slope.iter().enumerate() {
                let along = [s.x, s.y, s.z];
                (0..3).for_each(|a| toward[a] += d * light[3 * i + k] * along[a] as f32);
            }
        }
        let radial: f32 = (0..3).map(|a| self.normal[a] * toward[a]).sum();
        (0..3).for_each(|a| d_normal[a] += (toward[a] - radial * self.normal[a]) / self.length);
    }
}

impl BatchLoss for JointLoss<'_> {
    fn batch(&self, out: &RayOutputs, gradients: &mut RayGradients) -> f64 {
        let rays = out.opacity.len();
        let mut tables = JointGradients { lights: vec![0.0; self.lights.len()], behind: vec![0.0; 3 * rays], mse: 0.0 };
        let share = 1.0 / (3 * self.counts.iter().filter(|c| **c).count().max(1)) as f32;
        let mut dark = 0.0;
        for r in 0..rays {
            let (values, d) = (&out.values[r * CHANNELS..][..CHANNELS], &mut gradients.values[r * CHANNELS..][..CHANNELS]);
            let shadow = values[3];
            dark += ((1.0 - shadow) * (1.0 - shadow)) as f64;
            d[3] -= 2.0 * self.shadow / rays as f32 * (1.0 - shadow);
            if !self.counts[r] {
                continue;
            }
            let of = LIGHT * self.light[r] as usize..LIGHT * (self.light[r] as usize + 1);
            let light = &self.lights[of.clone()];
            let (lit, through) = (lit(&values[NORMAL..], light), 1.0 - out.opacity[r]);
            let mut d_factor = [0.0; 3];
            for k in 0..3 {
                let behind = self.behind[3 * r + k];
                let error = shadow * values[k] * lit.factor[k] + through * behind - self.target[3 * r + k];
                tables.mse += (share * error * error) as f64;
                let dc = 2.0 * share * error;
                d[k] += dc * shadow * lit.factor[k];
                d[3] += dc * values[k] * lit.factor[k];
                d_factor[k] = dc * shadow * values[k];
                gradients.opacity[r] -= dc * behind;
                tables.behind[3 * r + k] = dc * through;
            }
            lit.backward(light, d_factor, &mut d[NORMAL..], &mut tables.lights[of]);
        }
        let loss = tables.mse + self.shadow as f64 * dark / rays.max(1) as f64;
        *self.out.lock().expect("no other thread holds it") = tables;
        loss
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_testkit::random;

    #[test]
    fn gradients_equal_differences() {
        let rays = 5;
        let mut values: Vec<f32> = random(rays * CHANNELS, 1).iter().map(|v| 0.5 + 0.4 * v).collect();
        let mut opacity: Vec<f32> = random(rays, 2).iter().map(|v| 0.6 + 0.3 * v).collect();
        // Light from all around and a little more from some sides, so that nothing is black.
        let mut lights: Vec<f32> =
            random(2 * LIGHT, 3).iter().enumerate().map(|(i, v)| 0.2 * v + if i % LIGHT < 3 { 3.0 } else { 0.0 }).collect();
        let mut behind: Vec<f32> = random(3 * rays, 4).iter().map(|v| 0.5 + 0.4 * v).collect();
        let target: Vec<f32> = random(3 * rays, 5).iter().map(|v| 0.5 + 0.4 * v).collect();
        let (counts, light, depth) = ([true, true, false, true, true], [0, 1, 0, 1, 0], vec![0.0; rays]);
        let evaluate = |values: &[f32], opacity: &[f32], lights: &[f32], behind: &[f32]| {
            let out = Mutex::default();
            let loss = JointLoss { target: &target, counts: &counts, light: &light, lights, behind, shadow: 0.05, out };
            let mut gradients = RayGradients::default();
            gradients.clear(rays, CHANNELS);
            let value = loss.batch(&RayOutputs { values, opacity, depth: &depth }, &mut gradients);
            (value, gradients, loss.out.into_inner().unwrap())
        };
        let (_, gradients, tables) = evaluate(&values, &opacity, &lights, &behind);
        let step = 1e-2f32;
        let mut check = |which: usize, grads: &[f32]| {
            for (i, g) in grads.iter().enumerate() {
                let mut at = |by: f32| {
                    let all = [&mut values, &mut opacity, &mut lights, &mut behind];
                    let before = all[which][i];
                    all[which][i] = before + by;
                    let value = evaluate(&values, &opacity, &lights, &behind).0;
                    [&mut values, &mut opacity, &mut lights, &mut behind][which][i] = before;
                    value
                };
                let want = (at(step) - at(-step)) / (2.0 * step as f64);
                assert!((*g as f64 - want).abs() < 2e-4 + 0.01 * want.abs(), "{which} {i}: {g} for {want}");
            }
        };
        check(0, &gradients.values);
        check(1, &gradients.opacity);
        check(2, &tables.lights);
        check(3, &tables.behind);
    }
}
