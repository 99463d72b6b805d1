//! Results of tracing rays.

/// Color `[R, 3]` (or all `[R, C]` that a field composites), opacity `[R]` and `Σ w t` `[R]` of R rays, in front of black.
#[derive(Clone, Debug, Default)]
pub struct Traced {
    pub rgb: Vec<f32>,
    pub opacity: Vec<f32>,
    pub depth: Vec<f32>,
}

impl Traced {
    /// Rays that meet nothing.
    pub fn nothing(rays: usize) -> Traced {
        Traced { rgb: vec![0.0; rays * 3], opacity: vec![0.0; rays], depth: vec![0.0; rays] }
    }

    /// Scales each ray to the opacity `1 − light` that it has with the samples that were left out; `light` is the transmittance `[R]`,
    /// of which less than `stop` counts as none.
    pub fn restore_opacity(&mut self, light: &[f32], stop: f32) {
        let channels = self.rgb.len() / self.opacity.len().max(1);
        for (r, light) in light.iter().enumerate() {
            let full = if *light < stop { 1.0 } else { 1.0 - light };
            let kept = self.opacity[r];
            if kept > 1e-3 && full > kept {
                let by = full / kept;
                self.rgb[r * channels..(r + 1) * channels].iter_mut().for_each(|v| *v *= by);
                (self.opacity[r], self.depth[r]) = (full, self.depth[r] * by);
            }
        }
    }
}
