//! Gradients of a batch loss on their way to the rays, with the distortion loss that it asks for.

use super::Loss;
use diorama_kernels::ops::composite::Packed;
use diorama_kernels::ops::distortion;
use diorama_kernels::ops::field_step::{InjectedGradients, RayGradient, RayGradients, RayLoss, RayOutput};

/// Gradients per ray; the loss of a ray is that of its distortion.
pub(super) struct Injected<'a> {
    gradients: InjectedGradients<'a>,
    /// Weight divided by the number of rays.
    distortion: f32,
    samples: Packed<'a>,
    /// Starts and lengths of samples in the distance in which unbounded rays are measured; else empty.
    normalized: (Vec<f32>, Vec<f32>),
}

impl<'a> Injected<'a> {
    pub fn new(gradients: &'a RayGradients, loss: &Loss, samples: Packed<'a>, unbounded: bool) -> Injected<'a> {
        let weight = if let Loss::Batch(loss) = loss { loss.distortion() } else { 0.0 };
        let mut normalized = (Vec::new(), Vec::new());
        if weight > 0.0 && unbounded {
            distortion::cpu::normalize(&samples, &mut normalized.0, &mut normalized.1);
        }
        Injected { gradients: InjectedGradients(gradients), distortion: weight / samples.rays().max(1) as f32, samples, normalized }
    }
}

impl RayLoss for Injected<'_> {
    fn ray(&self, r: usize, out: &RayOutput, gradient: &mut RayGradient) -> f64 {
        let value = self.gradients.ray(r, out, gradient);
        if self.distortion == 0.0 {
            return value;
        }
        let (t, dt) = (&self.normalized.0[..], &self.normalized.1[..]);
        let measured = if t.is_empty() { self.samples } else { Packed { offsets: self.samples.offsets, t, dt } };
        value + (self.distortion * distortion::cpu::ray(&measured, r, out.weights, self.distortion, gradient.weights)) as f64
    }
}
