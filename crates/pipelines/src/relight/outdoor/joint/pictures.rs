//! Pictures of the model as printed.

use super::Joint;
use super::loss::lit;
use crate::relight::outdoor::config::Config;
use crate::relight::outdoor::shading::{NORMAL, RayColor};
use diorama_engine::fields::OuterSamples;
use diorama_geom::color::linear_from_srgb;
use diorama_kernels::ops::strata::cpu as strata;

/// Rays at a time.
const CHUNK: usize = 1 << 12;

impl Joint {
    /// What lies behind rays `[R, 3]` that begin inside the sphere, sRGB `[R, 3]`; none without a background.
    pub fn behind(&self, config: &Config, origins: &[f32], dirs: &[f32]) -> Option<Vec<f32>> {
        let [coarse, fine] = &self.backgrounds[..] else { return None };
        let (n, more) = (config.sampling.coarse, config.sampling.fine);
        let (mut first, mut all) = (OuterSamples::default(), OuterSamples::default());
        let mut out = Vec::with_capacity(origins.len());
        for (origins, dirs) in origins.chunks(3 * CHUNK).zip(dirs.chunks(3 * CHUNK)) {
            strata::stratified(&[0.0, 1.0].repeat(origins.len() / 3), n, None, &mut first.samples);
            coarse.locate(origins, dirs, &mut first);
            coarse.render(&mut first);
            strata::refine(&first.samples, &first.out.weights, n, more, None, &mut all.samples);
            fine.locate(origins, dirs, &mut all);
            fine.render(&mut all);
            out.extend_from_slice(&all.out.values);
        }
        Some(out)
    }
}

/// Linear color of composited values, the shadow before 1, under a light `[9, 3]`, and what makes it; without what lies behind.
pub fn color(values: &[f32], light: &[f32]) -> RayColor {
    let lit = lit(&values[NORMAL..], light);
    let linear = |v: f32| linear_from_srgb(v.max(0.0));
    RayColor {
        rgb: [0, 1, 2].map(|k| linear(values[3] * values[k] * lit.factor[k])),
        irradiance: [0, 1, 2].map(|k| linear(values[3] * lit.factor[k])),
        shadow: linear(values[3]),
    }
}
