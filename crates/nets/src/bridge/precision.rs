//! Arithmetic of layers on the CPU.

pub use diorama_kernels::gemm::Precision;
use std::cell::Cell;

thread_local! {
    static PRECISION: Cell<Precision> = const { Cell::new(Precision::F32) };
}

/// Runs `work` with convolutions and fully connected layers in `precision`, forward and backward, wherever the backward pass runs.
///
/// [`Precision::Bf16`] rounds inputs, weights and gradients of outputs to bf16 on CPUs that multiply such tiles (AMX) and changes nothing
/// elsewhere; sums, weights' gradients of convolutions, and optimizers stay in f32.
pub fn with_precision<R>(precision: Precision, work: impl FnOnce() -> R) -> R {
    struct Restore(Precision);
    impl Drop for Restore {
        fn drop(&mut self) {
            PRECISION.set(self.0);
        }
    }
    let _restore = Restore(PRECISION.replace(precision));
    work()
}

/// What layers that are called now compute in.
pub(crate) fn precision() -> Precision {
    PRECISION.get()
}
