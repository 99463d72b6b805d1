//! Table of comparisons between a device's results and references.

use super::{Buffer, Gpu, GpuError};
use crate::api::Api;
use cubecl::prelude::CubeElement;
use diorama_testkit::compare_proven;
use std::time::Instant;

/// Largest error allowed, relative to the value plus the root mean square of all.
pub const TOLERANCE: f64 = 1e-3;

/// One line of the table.
#[derive(Clone, Debug)]
pub struct Row {
    pub op: &'static str,
    /// What was compared, for example `forward` or `d table`.
    pub result: &'static str,
    pub shape: String,
    /// Largest relative error.
    pub error: f64,
    /// Reason of a failure; `None` if the comparison passed.
    pub fault: Option<String>,
    /// Time since the line before, or since the table was begun.
    pub seconds: f64,
}

/// The table so far.
pub struct Table<'a> {
    gpu: &'a Gpu,
    /// When the last line was added.
    last: Instant,
    pub rows: Vec<Row>,
}

impl<'a> Table<'a> {
    pub fn new(gpu: &'a Gpu) -> Self {
        Table { gpu, last: Instant::now(), rows: Vec::new() }
    }

    /// Adds a line with its outcome: the largest relative error, or the reason of a failure.
    pub fn row(&mut self, op: &'static str, result: &'static str, shape: String, outcome: Result<f64, String>) {
        let (error, fault) = match outcome {
            Ok(e) => (e, None),
            Err(e) => (f64::INFINITY, Some(e)),
        };
        let seconds = std::mem::replace(&mut self.last, Instant::now()).elapsed().as_secs_f64();
        self.rows.push(Row { op, result, shape, error, fault, seconds });
    }

    /// Compares numbers within [`TOLERANCE`], and shows that a wrong one would be noticed.
    ///
    /// # Errors
    /// When the device is lost.
    pub fn close(
        &mut self,
        op: &'static str,
        result: &'static str,
        shape: impl ToString,
        got: &Buffer,
        want: &[f64],
    ) -> Result<(), GpuError> {
        let got = self.gpu.read(got)?;
        self.row(op, result, shape.to_string(), compare_proven(&got, want, TOLERANCE));
        Ok(())
    }

    /// Compares bits exactly.
    ///
    /// # Errors
    /// When the device is lost.
    pub fn equal(
        &mut self,
        op: &'static str,
        result: &'static str,
        shape: impl ToString,
        got: &Buffer<impl CubeElement>,
        want: &[u32],
    ) -> Result<(), GpuError> {
        let got = self.gpu.read(&got.cast::<u32>())?;
        self.row(op, result, shape.to_string(), compare_bits(&got, want));
        Ok(())
    }
}

/// No error, or the first difference.
fn compare_bits(got: &[u32], want: &[u32]) -> Result<f64, String> {
    match got.iter().zip(want).position(|(a, b)| a != b) {
        _ if got.len() != want.len() => Err(format!("lengths differ: {} and {}", got.len(), want.len())),
        Some(i) => Err(format!("element {i}: {} is not {}", got[i], want[i])),
        None => Ok(0.0),
    }
}

/// The ways of adding f32 to be checked on a device: native atomics where it has them, exchanges where it has none. WebGPU is checked
/// with both, because browsers have no f32 atomics.
pub(crate) fn adders(gpu: &Gpu) -> Vec<(&'static str, Gpu)> {
    let mut all = Vec::new();
    if gpu.has_native_atomics() {
        all.push(("d table, native", gpu.without_pair_atomics()));
    }
    if !gpu.has_native_atomics() || gpu.api == Api::WebGpu {
        all.push(("d table, exchanged", gpu.without_native_atomics()));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_bits_are_refused() {
        assert_eq!(compare_bits(&[1, 2], &[1, 2]), Ok(0.0));
        assert!(compare_bits(&[1, 2], &[1, 3]).unwrap_err().contains("element 1"));
        assert!(compare_bits(&[1, 2], &[1]).is_err() && compare_bits(&[], &[1]).is_err());
    }
}
