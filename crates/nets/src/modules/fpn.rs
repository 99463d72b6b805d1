//! Feature pyramid (Lin et al. 2017): features of all strides with the same channels, each with what coarser ones know.

use super::Features;
use crate::bridge::OpError;
use crate::layers::{Conv2d, Init};
use crate::ops::{self, Conv, Filter};
use crate::param::{Mode, Module, Visitor};
use burn::tensor::Tensor;

/// A feature pyramid over four strides.
#[derive(Debug)]
pub struct Fpn {
    pub(super) inner: Vec<Conv2d>,
    pub(super) layer: Vec<Conv2d>,
}

impl Fpn {
    pub fn new(init: &mut Init, channels: [usize; 4], out: usize) -> Fpn {
        Fpn::narrowing(init, channels, out, out)
    }

    /// A pyramid whose levels are summed at `inner` channels and given at `out`.
    pub fn narrowing(init: &mut Init, channels: [usize; 4], inner: usize, out: usize) -> Fpn {
        let summed = channels.iter().map(|c| Conv2d::new(init, [*c, inner], 1, Conv::default())).collect();
        let layer = channels.iter().map(|_| Conv2d::new(init, [inner, out], 3, Conv::same(3))).collect();
        Fpn { inner: summed, layer }
    }

    /// The pyramid, finest first.
    pub fn forward(&self, features: Features, mode: Mode) -> Result<Features, OpError> {
        let mut out = Vec::new();
        let mut above: Option<Tensor<4>> = None;
        for (level, x) in features.into_iter().enumerate().rev() {
            let mut x = self.inner[level].forward(x, mode)?;
            if let Some(above) = above.take() {
                let [_, _, h, w] = x.dims();
                x = ops::add(x, ops::resize(above, Filter::Nearest, [h, w])?)?;
            }
            if level > 0 {
                let [here, below] = ops::fork(x)?;
                above = Some(below);
                x = here;
            }
            out.push(self.layer[level].forward(x, mode)?);
        }
        out.reverse();
        Ok(out.try_into().unwrap_or_else(|_| unreachable!("four levels")))
    }
}

impl Module for Fpn {
    fn visit(&self, v: &mut Visitor) {
        for (i, (inner, layer)) in self.inner.iter().zip(&self.layer).enumerate() {
            v.part(&format!("inner_blocks.{i}.0"), inner);
            v.part(&format!("layer_blocks.{i}.0"), layer);
        }
    }
}
