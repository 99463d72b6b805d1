//! Interface of devices that render instead of the CPU.

use super::traced::Traced;
use crate::samplers::RayBatch;
use crate::samplers::placement::Placement;

/// Why an accelerator did not serve a call.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unserved {
    /// The device failed; the CPU does the work instead.
    #[error("{0}")]
    Failed(String),
    /// The user named a device and it failed: the caller reports that, so nobody has to work for this call.
    #[error("the device failed before")]
    Abandoned,
}

/// Evaluates a field elsewhere than on the CPU.
pub trait Accelerator: Send + Sync {
    /// Composites rays in front of black; where an occupancy grid places the samples also the transmittance `[R]` behind the last.
    ///
    /// # Errors
    /// When the device failed.
    fn trace(&self, batch: &RayBatch, placement: &Placement, appearance: Option<u32>) -> Result<(Traced, Option<Vec<f32>>), Unserved>;

    /// Densities `[N]` at model points `[N, 3]`.
    ///
    /// # Errors
    /// When the device failed.
    fn density(&self, model: &[f32]) -> Result<Vec<f32>, Unserved>;

    /// The field's colors `[N, 3]` at model points `[N, 3]`, seen along unit directions `[N, 3]`, with the mean appearance code.
    ///
    /// # Errors
    /// When the device failed.
    fn color(&self, model: &[f32], dirs: &[f32]) -> Result<Vec<f32>, Unserved>;

    /// Number of rays per call that keeps the device busy.
    fn rays(&self) -> usize;
}
