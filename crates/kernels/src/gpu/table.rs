//! A table of comparisons: what a device gives against what is wanted.

use super::{Buffer, Gpu, GpuError};
use crate::api::Api;
use cubecl::prelude::CubeElement;
use diorama_testkit::compare;

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
    /// What is wrong; none: it passed.
    pub fault: Option<String>,
}

/// The table so far.
pub struct Table<'a> {
    gpu: &'a Gpu,
    pub rows: Vec<Row>,
}

impl<'a> Table<'a> {
    pub fn new(gpu: &'a Gpu) -> Self {
        Table { gpu, rows: Vec::new() }
    }

    /// Adds a line of a known outcome: the largest relative error, or what is wrong.
    pub fn row(&mut self, op: &'static str, result: &'static str, shape: String, outcome: Result<f64, String>) {
        let (error, fault) = match outcome {
            Ok(e) => (e, None),
            Err(e) => (f64::INFINITY, Some(e)),
        };
        self.rows.push(Row { op, result, shape, error, fault });
    }

    /// Compares numbers within [`TOLERANCE`].
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
        self.row(op, result, shape.to_string(), compare(&got, want, TOLERANCE));
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
        let differs = got.iter().zip(want).position(|(a, b)| a != b);
        let outcome = match differs {
            _ if got.len() != want.len() => Err(format!("lengths differ: {} and {}", got.len(), want.len())),
            Some(i) => Err(format!("element {i}: {} is not {}", got[i], want[i])),
            None => Ok(0.0),
        };
        self.row(op, result, shape.to_string(), outcome);
        Ok(())
    }
}

/// The ways in which the device may have to add: its own, or exchanges where it has none; WebGPU needs both,
/// because browsers have none.
pub(crate) fn adders(gpu: &Gpu) -> Vec<(&'static str, Gpu)> {
    let mut all = Vec::new();
    if gpu.has_native_atomics() {
        all.push(("d table, native", gpu.clone()));
    }
    if !gpu.has_native_atomics() || gpu.api == Api::WebGpu {
        all.push(("d table, exchanged", gpu.without_native_atomics()));
    }
    all
}
