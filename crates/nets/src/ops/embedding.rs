//! Rows of a table by index.

use super::by_burn;
use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
use diorama_kernels::ops::embedding::cpu;
use std::sync::Arc;

#[derive(Clone, Debug)]
pub(super) struct EmbeddingOp {
    pub(super) indices: Arc<[i64]>,
}

impl SliceOp for EmbeddingOp {
    fn name(&self) -> &'static str {
        "embedding"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)?;
        expect_shape(self.name(), "table", shapes[0], &[None, None])?;
        match self.indices.iter().find(|i| !(0..shapes[0][0] as i64).contains(*i)) {
            Some(i) => Err(OpError::settings(self.name(), format!("row {i} of a table of {}", shapes[0][0]))),
            None => Ok(()),
        }
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let (rows, width) = (x[0].shape()[0], x[0].shape()[1]);
        let mut out = ValuesMut::any(&[self.indices.len(), width]);
        cpu::forward(rows, width, &x[0], &self.indices, &mut out);
        // The table's shape alone is needed, which its values carry.
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let shape = kept.values[0].shape();
        vec![d[0].as_ref().map(|d| {
            let mut table = ValuesMut::any(shape);
            cpu::backward(shape[0], shape[1], &self.indices, d, &mut table);
            table.freeze()
        })]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::embedding(x, &self.indices))
    }
}

/// The rows of a table that `indices` name.
///
/// # Shapes
/// table `[rows, K]`; indices `[M]`; result `[M, K]`.
pub fn embedding(table: Tensor<2>, indices: &[i64]) -> Result<Tensor<2>, OpError> {
    apply_one(EmbeddingOp { indices: indices.into() }, vec![table.into_dispatch()])
}
