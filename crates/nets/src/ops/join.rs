//! Copies between layouts: channels of several images together, rows of tokens, heads of attention.

use super::by_burn;
use crate::bridge::{Forward, Kept, OpError, SliceOp, Values, ValuesMut, apply, apply_one, expect_inputs, expect_shape};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
use rayon::prelude::*;

/// Images of one size, one after the other along the channels.
#[derive(Clone, Debug)]
pub(super) struct ConcatOp {
    pub(super) channels: Vec<usize>,
}

impl SliceOp for ConcatOp {
    fn name(&self) -> &'static str {
        "concat"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, self.channels.len())?;
        expect_shape(self.name(), "an input", shapes[0], &[None, None, None, None])?;
        let (n, h, w) = (shapes[0][0], shapes[0][2], shapes[0][3]);
        shapes.iter().try_for_each(|s| expect_shape(self.name(), "an input", s, &[Some(n), None, Some(h), Some(w)]))
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let shape = x[0].shape();
        let (all, places) = (self.channels.iter().sum::<usize>(), shape[2] * shape[3]);
        let mut out = ValuesMut::any(&[shape[0], all, shape[2], shape[3]]);
        out.par_chunks_mut((all * places).max(1)).enumerate().for_each(|(n, out)| {
            let mut first = 0;
            for (x, c) in x.iter().zip(&self.channels) {
                let size = c * places;
                out[first..first + size].copy_from_slice(&x[n * size..(n + 1) * size]);
                first += size;
            }
        });
        Forward::one(out.freeze(), Kept::default())
    }

    fn backward(&self, _: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; wanted.len()] };
        let shape = d.shape();
        let (all, places) = (shape[1] * shape[2] * shape[3], shape[2] * shape[3]);
        let mut first = 0;
        let mut part = |c: usize, wanted: bool| {
            let (from, size) = (first, c * places);
            first += size;
            wanted.then(|| {
                let mut out = ValuesMut::any(&[shape[0], c, shape[2], shape[3]]);
                out.par_chunks_mut(size.max(1)).enumerate().for_each(|(n, out)| out.copy_from_slice(&d[n * all + from..][..size]));
                out.freeze()
            })
        };
        self.channels.iter().zip(wanted).map(|(c, w)| part(*c, *w)).collect()
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::concat(x))
    }
}

/// Joins images along their channels.
///
/// # Shapes
/// inputs `[N, Cᵢ, H, W]`; result `[N, Σ Cᵢ, H, W]`.
pub fn concat_channels(images: Vec<Tensor<4>>) -> Result<Tensor<4>, OpError> {
    let channels = images.iter().map(|t| t.dims()[1]).collect();
    apply_one(ConcatOp { channels }, images.into_iter().map(|t| t.into_dispatch()).collect())
}

/// `[A, B, C, D]` to `[A, C, B, D]`: the inner swap that all of the layouts below are.
#[derive(Clone, Debug)]
pub(super) struct SwapOp {
    pub(super) from: [usize; 4],
    /// Shape of the result.
    pub(super) to: Vec<usize>,
    pub(super) back: Vec<usize>,
}

fn swap(from: [usize; 4], x: &[f32], out: &mut [f32]) {
    let [_, b, c, d] = from;
    out.par_chunks_mut((b * c * d).max(1)).zip(x.par_chunks((b * c * d).max(1))).for_each(|(out, x)| {
        if d > 1 {
            for (i, row) in out.chunks_exact_mut(d).enumerate() {
                let (k, j) = (i / b, i % b);
                row.copy_from_slice(&x[(j * c + k) * d..][..d]);
            }
            return;
        }
        // A transpose: squares that stay in cache.
        const SIDE: usize = 32;
        for k0 in (0..c).step_by(SIDE) {
            for j0 in (0..b).step_by(SIDE) {
                for k in k0..(k0 + SIDE).min(c) {
                    for j in j0..(j0 + SIDE).min(b) {
                        out[k * b + j] = x[j * c + k];
                    }
                }
            }
        }
    });
}

impl SliceOp for SwapOp {
    fn name(&self) -> &'static str {
        "swap"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let mut out = ValuesMut::any(&self.to);
        swap(self.from, &x[0], &mut out);
        Forward::one(out.freeze(), Kept::default())
    }

    fn backward(&self, _: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let [a, b, c, n] = self.from;
        vec![d[0].as_ref().map(|d| {
            let mut dx = ValuesMut::any(&self.back);
            swap([a, c, b, n], d, &mut dx);
            dx.freeze()
        })]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::swap(x, self.from, &self.to))
    }
}

/// A row of channels per pixel.
///
/// # Shapes
/// x `[N, C, H, W]`; result `[N, H · W, C]`.
pub fn to_tokens(x: Tensor<4>) -> Result<Tensor<3>, OpError> {
    let [n, c, h, w] = x.dims();
    apply_one(SwapOp { from: [n, c, h * w, 1], to: vec![n, h * w, c], back: vec![n, c, h, w] }, vec![x.into_dispatch()])
}

/// Tokens by head.
///
/// # Shapes
/// x `[N, T, heads · K]`; result `[N · heads, T, K]`.
///
/// # Errors
/// When the width does not divide by the heads.
pub fn heads(x: Tensor<3>, heads: usize) -> Result<Tensor<3>, OpError> {
    let [n, t, width] = x.dims();
    if heads == 0 || !width.is_multiple_of(heads) {
        return Err(OpError::settings("heads", format!("a width of {width} does not divide into {heads} heads")));
    }
    let k = width / heads;
    apply_one(SwapOp { from: [n, t, heads, k], to: vec![n * heads, t, k], back: vec![n, t, width] }, vec![x.into_dispatch()])
}

/// The inverse of [`heads`].
///
/// # Shapes
/// x `[N · heads, T, K]`; result `[N, T, heads · K]`.
///
/// # Errors
/// When the batch does not divide by the heads.
pub fn merge_heads(x: Tensor<3>, heads: usize) -> Result<Tensor<3>, OpError> {
    let [batch, t, k] = x.dims();
    if heads == 0 || !batch.is_multiple_of(heads) {
        return Err(OpError::settings("merge heads", format!("a batch of {batch} does not divide into {heads} heads")));
    }
    let n = batch / heads;
    apply_one(SwapOp { from: [n, heads, t, k], to: vec![n, t, heads * k], back: vec![batch, t, k] }, vec![x.into_dispatch()])
}

/// Joint queries, keys and values to one tensor each, by head.
#[derive(Clone, Debug)]
pub(super) struct SplitOp {
    pub(super) heads: usize,
}

impl SplitOp {
    /// Calls `visit` with each output's number, and the places of a run of `k` numbers in the joint tensor and in that output.
    fn runs(&self, shape: &[usize], mut visit: impl FnMut(usize, usize, usize)) {
        let (n, t, k) = (shape[0], shape[1], shape[2] / (3 * self.heads));
        for (n, t) in (0..n).flat_map(|n| (0..t).map(move |t| (n, t))) {
            for (which, h) in (0..3).flat_map(|w| (0..self.heads).map(move |h| (w, h))) {
                let joint = ((n * shape[1] + t) * 3 + which) * self.heads + h;
                visit(which, joint * k, ((n * self.heads + h) * shape[1] + t) * k);
            }
        }
    }
}

impl SliceOp for SplitOp {
    fn name(&self) -> &'static str {
        "split heads"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 1)?;
        expect_shape(self.name(), "x", shapes[0], &[None, None, None])?;
        if self.heads == 0 || !shapes[0][2].is_multiple_of(3 * self.heads) {
            let message = format!("a width of {} does not divide into queries, keys and values of {} heads", shapes[0][2], self.heads);
            return Err(OpError::settings(self.name(), message));
        }
        Ok(())
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let s = x[0].shape();
        let k = s[2] / (3 * self.heads);
        let mut out: [ValuesMut; 3] = std::array::from_fn(|_| ValuesMut::any(&[s[0] * self.heads, s[1], k]));
        let mut slices = out.each_mut().map(|o| &mut o[..]);
        self.runs(s, |which, joint, own| slices[which][own..own + k].copy_from_slice(&x[0][joint..joint + k]));
        Forward { outputs: out.map(ValuesMut::freeze).to_vec(), kept: Kept::default() }
    }

    fn backward(&self, _: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let Some(any) = d.iter().flatten().next() else { return vec![None] };
        let (s, k) = (any.shape(), any.shape()[2]);
        let joint_shape = [s[0] / self.heads, s[1], 3 * self.heads * k];
        let mut out = ValuesMut::zeros(&joint_shape);
        let slice: &mut [f32] = &mut out;
        self.runs(&joint_shape, |which, joint, own| {
            if let Some(d) = &d[which] {
                slice[joint..joint + k].copy_from_slice(&d[own..own + k]);
            }
        });
        vec![Some(out.freeze())]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::split_heads(x, self.heads))
    }
}

/// Queries, keys and values by head of their joint projection.
///
/// # Shapes
/// x `[N, T, 3 · heads · K]`; results `[N · heads, T, K]`.
pub fn split_heads(x: Tensor<3>, heads: usize) -> Result<[Tensor<3>; 3], OpError> {
    let mut out = apply(SplitOp { heads }, vec![x.into_dispatch()])?.into_iter();
    Ok(std::array::from_fn(|_| Tensor::from_dispatch(out.next().expect("three outputs"))))
}

/// A class token before the others, and an embedding of places added to all.
#[derive(Clone, Debug)]
pub(super) struct ClassTokenOp;

impl SliceOp for ClassTokenOp {
    fn name(&self) -> &'static str {
        "class token"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 3)?;
        expect_shape(self.name(), "tokens", shapes[0], &[None, None, None])?;
        let (t, width) = (shapes[0][1], Some(shapes[0][2]));
        expect_shape(self.name(), "class token", shapes[1], &[Some(1), Some(1), width])?;
        expect_shape(self.name(), "places", shapes[2], &[Some(1), Some(t + 1), width])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let s = x[0].shape();
        let (size, width) = (s[1] * s[2], s[2]);
        let mut out = ValuesMut::any(&[s[0], s[1] + 1, width]);
        for (n, out) in out.chunks_exact_mut((size + width).max(1)).enumerate() {
            out[..width].copy_from_slice(&x[1]);
            out[width..].copy_from_slice(&x[0][n * size..(n + 1) * size]);
            out.iter_mut().zip(&x[2][..]).for_each(|(o, p)| *o += p);
        }
        Forward::one(out.freeze(), Kept::default())
    }

    fn backward(&self, _: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None; 3] };
        let s = d.shape();
        let (size, width) = (s[1] * s[2], s[2]);
        let mut tokens = ValuesMut::any(&[s[0], s[1] - 1, width]);
        let (mut class, mut places) = (ValuesMut::zeros(&[1, 1, width]), ValuesMut::zeros(&[1, s[1], width]));
        for (n, d) in d.chunks_exact(size.max(1)).enumerate() {
            tokens[n * (size - width)..(n + 1) * (size - width)].copy_from_slice(&d[width..]);
            class.iter_mut().zip(d).for_each(|(c, d)| *c += d);
            places.iter_mut().zip(d).for_each(|(p, d)| *p += d);
        }
        vec![Some(tokens.freeze()), Some(class.freeze()), Some(places.freeze())]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::class_token(x))
    }
}

/// Puts a class token before the others, and adds an embedding of places.
///
/// # Shapes
/// tokens `[N, T, K]`; class `[1, 1, K]`; places `[1, T + 1, K]`; result `[N, T + 1, K]`.
pub fn with_class_token(tokens: Tensor<3>, class: Tensor<3>, places: Tensor<3>) -> Result<Tensor<3>, OpError> {
    apply_one(ClassTokenOp, vec![tokens.into_dispatch(), class.into_dispatch(), places.into_dispatch()])
}
