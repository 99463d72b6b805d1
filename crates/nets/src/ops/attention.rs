//! Scaled dot product attention.

use super::by_burn;
use crate::bridge::work;
use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
use diorama_kernels::ops::attention::{Attention, cpu};
use std::cell::RefCell;

thread_local! {
    /// Tiles of a backward pass; grows once.
    static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

#[derive(Clone, Debug)]
pub(super) struct AttentionOp {
    pub(super) causal: bool,
}

impl AttentionOp {
    fn attention(&self, q: &[usize], k: &[usize]) -> Attention {
        Attention { causal: self.causal, ..Attention::new(q[0], q[1], k[1], q[2]) }
    }
}

impl SliceOp for AttentionOp {
    fn name(&self) -> &'static str {
        "attention"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 3)?;
        expect_shape(self.name(), "q", shapes[0], &[None, None, None])?;
        let (batch, width) = (Some(shapes[0][0]), Some(shapes[0][2]));
        expect_shape(self.name(), "k", shapes[1], &[batch, None, width])?;
        if shapes[1][1] == 0 {
            return Err(OpError::shape(self.name(), "k", shapes[1], "1 or more keys"));
        }
        expect_shape(self.name(), "v", shapes[2], &[batch, Some(shapes[1][1]), width])
    }

    fn forward(&self, x: &[Values], wanted: &[bool]) -> Forward {
        let a = self.attention(x[0].shape(), x[1].shape());
        work::book(2 * a.batch * a.queries * a.keys * a.width);
        let (mut out, mut logs) = (ValuesMut::any(x[0].shape()), ValuesMut::any(&[a.batch, a.queries]));
        cpu::forward(&a, &x[0], &x[1], &x[2], &mut out, &mut logs);
        let out = out.freeze();
        let kept = [x[0].clone(), x[1].clone(), x[2].clone(), out.clone(), logs.freeze()];
        Forward::one(out, if wanted.contains(&true) { Kept::of(&kept) } else { Kept::default() })
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; 3] };
        let [q, k, v, out, logs] = std::array::from_fn(|i| &kept.values[i]);
        let a = self.attention(q.shape(), k.shape());
        let saved = cpu::Saved { q, k, v, out, log_sums: logs, d_out: d };
        let [mut dq, mut dk, mut dv] = [q, k, v].map(|t| ValuesMut::any(t.shape()));
        // Taken, not borrowed: while this waits for the pool, its thread may run another backward pass.
        let mut scratch = SCRATCH.take();
        cpu::backward(&a, &saved, &mut dq, &mut dk, &mut dv, &mut scratch);
        SCRATCH.set(scratch);
        vec![Some(dq.freeze()), Some(dk.freeze()), Some(dv.freeze())]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::attention(x, self.causal))
    }
}

/// `softmax(q kᵀ / √K) v`; `causal` lets query `i` see the keys `0..=i` alone.
///
/// # Shapes
/// q `[B, T, K]`; k, v `[B, S, K]`, where B is the batch times the heads (see [`super::heads`]); result as q.
pub fn attention(q: Tensor<3>, k: Tensor<3>, v: Tensor<3>, causal: bool) -> Result<Tensor<3>, OpError> {
    apply_one(AttentionOp { causal }, vec![q.into_dispatch(), k.into_dispatch(), v.into_dispatch()])
}
