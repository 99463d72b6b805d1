//! Changes of images' sizes: pooling, resampling, pixel shuffle, sampling at a grid.

use super::by_burn;
#[cfg(feature = "gpu")]
use crate::bridge::{DeviceKernels, DeviceOutputs, OnDevice};
use crate::bridge::{Forward, IndicesMut, Kept, OpError, SliceOp, Values, ValuesMut, apply_one, expect_inputs, expect_shape};
use burn::backend::DispatchTensor;
use burn::tensor::Tensor;
#[cfg(feature = "gpu")]
use diorama_kernels::gpu::{Buffer, Gpu};
use diorama_kernels::ops::grid_sample::{self, GridSample, Mode, Outside};
use diorama_kernels::ops::pool::{Pool, cpu as pools};
#[cfg(feature = "gpu")]
use diorama_kernels::ops::resample;
use diorama_kernels::ops::resample::{Filter, Resample, cpu as resampling, shuffle};
use std::collections::HashMap;
use std::sync::{Arc, LazyLock, Mutex};

fn expect_images(op: &'static str, shapes: &[&[usize]]) -> Result<(), OpError> {
    expect_inputs(op, shapes, 1)?;
    expect_shape(op, "x", shapes[0], &[None, None, None, None])?;
    if shapes[0][2] * shapes[0][3] == 0 { Err(OpError::shape(op, "x", shapes[0], "images of 1 pixel or more")) } else { Ok(()) }
}

fn check_pool(op: &'static str, pool: &Pool, shape: &[usize]) -> Result<(), OpError> {
    for axis in 0..2 {
        let (k, s, p) = (pool.kernel[axis], pool.stride[axis], pool.padding[axis]);
        if k == 0 || s == 0 || 2 * p > k {
            return Err(OpError::settings(op, format!("kernel {k}, stride {s}, padding {p}: at least 1, 1, and at most half the kernel")));
        }
        if shape[2 + axis] + 2 * p < k && !pool.ceil_mode {
            return Err(OpError::shape(op, "x", shape, format!("room for windows of {k}")));
        }
    }
    Ok(())
}

#[derive(Clone, Debug)]
pub(super) struct MaxPoolOp(pub(super) Pool);

impl SliceOp for MaxPoolOp {
    fn name(&self) -> &'static str {
        "max pool"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_images(self.name(), shapes)?;
        check_pool(self.name(), &self.0, shapes[0])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let s = x[0].shape();
        let to = self.0.output([s[2], s[3]]);
        let shape = [s[0], s[1], to[0], to[1]];
        let (mut out, mut indices) = (ValuesMut::any(&shape), IndicesMut::any(&shape));
        pools::max(&self.0, s[0] * s[1], [s[2], s[3]], &x[0], &mut out, &mut indices);
        // Of the input its shape alone is kept.
        let size = Values::from_vec(vec![s[2] as f32, s[3] as f32], &[2]);
        Forward::one(out.freeze(), Kept { values: vec![size], indices: vec![indices.freeze()] })
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let (h, w) = (kept.values[0][0] as usize, kept.values[0][1] as usize);
        vec![d[0].as_ref().map(|d| {
            let s = d.shape();
            let mut dx = ValuesMut::any(&[s[0], s[1], h, w]);
            pools::max_backward(s[0] * s[1], h * w, &kept.indices[0], d, &mut dx);
            dx.freeze()
        })]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::max_pool(x, &self.0))
    }
}

/// Largest values of windows.
///
/// # Shapes
/// x `[N, C, H, W]`; result `[N, C, H', W']` as [`Pool::output`] says.
pub fn max_pool(x: Tensor<4>, pool: Pool) -> Result<Tensor<4>, OpError> {
    apply_one(MaxPoolOp(pool), vec![x.into_dispatch()])
}

#[derive(Clone, Debug)]
pub(super) struct GlobalAverageOp;

impl SliceOp for GlobalAverageOp {
    fn name(&self) -> &'static str {
        "global average pool"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_images(self.name(), shapes)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let s = x[0].shape();
        let mut out = ValuesMut::any(&[s[0], s[1]]);
        pools::global_average(s[2] * s[3], &x[0], &mut out);
        Forward::one(out.freeze(), Kept::of(&[Values::from_vec(vec![s[2] as f32, s[3] as f32], &[2])]))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let (h, w) = (kept.values[0][0] as usize, kept.values[0][1] as usize);
        vec![d[0].as_ref().map(|d| {
            let mut dx = ValuesMut::any(&[d.shape()[0], d.shape()[1], h, w]);
            pools::global_average_backward(h * w, d, &mut dx);
            dx.freeze()
        })]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::global_average(x))
    }
}

/// The mean of each channel.
///
/// # Shapes
/// x `[N, C, H, W]`; result `[N, C]`.
pub fn global_average_pool(x: Tensor<4>) -> Result<Tensor<2>, OpError> {
    apply_one(GlobalAverageOp, vec![x.into_dispatch()])
}

/// What a table of weights is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Table {
    Filter(u8, bool),
    Windows([usize; 6], bool),
}

/// Tables by what they are made of and the sizes, made once: there are as many as a network has sizes.
static TABLES: LazyLock<Mutex<HashMap<(Table, [usize; 4]), Arc<Resample>>>> = LazyLock::new(Mutex::default);

fn table(key: Table, from: [usize; 2], to: [usize; 2], make: impl FnOnce() -> Resample) -> Arc<Resample> {
    let mut tables = TABLES.lock().unwrap_or_else(|e| e.into_inner());
    tables.entry((key, [from[0], from[1], to[0], to[1]])).or_insert_with(|| Arc::new(make())).clone()
}

#[derive(Debug)]
struct ResampleOp {
    name: &'static str,
    table: Arc<Resample>,
}

impl SliceOp for ResampleOp {
    fn name(&self) -> &'static str {
        self.name
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_images(self.name, shapes)
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let (s, to) = (x[0].shape(), self.table.to());
        let mut out = ValuesMut::any(&[s[0], s[1], to[0], to[1]]);
        resampling::forward(&self.table, s[0] * s[1], &x[0], &mut out);
        Forward::one(out.freeze(), Kept::default())
    }

    fn backward(&self, _: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        vec![d[0].as_ref().map(|d| {
            let (s, from) = (d.shape(), self.table.from());
            let mut dx = ValuesMut::any(&[s[0], s[1], from[0], from[1]]);
            resampling::backward(&self.table, s[0] * s[1], d, &mut dx);
            dx.freeze()
        })]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

#[cfg(feature = "gpu")]
impl DeviceKernels for ResampleOp {
    fn forward_on(&self, gpu: &Gpu, x: &[OnDevice]) -> DeviceOutputs {
        let (s, to) = (&x[0].shape, self.table.to());
        let out = resample::gpu::forward(gpu, &self.table, s[0] * s[1], &x[0].data);
        DeviceOutputs { outputs: vec![(out, vec![s[0], s[1], to[0], to[1]])], kept: Vec::new() }
    }

    fn backward_on(&self, gpu: &Gpu, x: &[OnDevice], _: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let planes = x[0].shape[0] * x[0].shape[1];
        vec![d[0].as_ref().map(|d| resample::gpu::backward(gpu, &self.table, planes, d))]
    }
}

/// Images of another size.
///
/// # Shapes
/// x `[N, C, H, W]`; result `[N, C, to[0], to[1]]`.
pub fn resize(x: Tensor<4>, filter: Filter, to: [usize; 2]) -> Result<Tensor<4>, OpError> {
    let [_, _, h, w] = x.dims();
    if to.contains(&0) || h * w == 0 {
        return Err(OpError::settings("resize", format!("from {h} x {w} to {} x {}", to[0], to[1])));
    }
    let key = match filter {
        Filter::Nearest => Table::Filter(0, false),
        Filter::Bilinear { align_corners } => Table::Filter(1, align_corners),
        Filter::BilinearAntialiased => Table::Filter(2, false),
        Filter::BicubicAntialiased => Table::Filter(3, false),
        Filter::Area => Table::Filter(4, false),
    };
    let table = table(key, [h, w], to, || Resample::new(filter, [h, w], to));
    apply_one(ResampleOp { name: "resize", table }, vec![x.into_dispatch()])
}

/// Means of windows; padding counts as zeros with `count_padding`.
///
/// # Shapes
/// x `[N, C, H, W]`; result `[N, C, H', W']` as [`Pool::output`] says.
pub fn average_pool(x: Tensor<4>, pool: Pool, count_padding: bool) -> Result<Tensor<4>, OpError> {
    let [_, _, h, w] = x.dims();
    check_pool("average pool", &pool, &x.dims())?;
    let Pool { kernel: k, stride: s, padding: p, ceil_mode } = pool;
    let key = Table::Windows([k[0], k[1], s[0], s[1], p[0] << 1 | ceil_mode as usize, p[1]], count_padding);
    let table = table(key, [h, w], pool.output([h, w]), || pool.average([h, w], count_padding));
    apply_one(ResampleOp { name: "average pool", table }, vec![x.into_dispatch()])
}

#[derive(Clone, Debug)]
pub(super) struct ShuffleOp(pub(super) usize);

impl SliceOp for ShuffleOp {
    fn name(&self) -> &'static str {
        "pixel shuffle"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_images(self.name(), shapes)?;
        if self.0 == 0 || !shapes[0][1].is_multiple_of(self.0 * self.0) {
            return Err(OpError::settings(self.name(), format!("{} channels for a factor of {}", shapes[0][1], self.0)));
        }
        Ok(())
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let (s, r) = (x[0].shape(), self.0);
        let c = s[1] / (r * r);
        let mut out = ValuesMut::any(&[s[0], c, s[2] * r, s[3] * r]);
        shuffle::shuffle(s[0] * c, [s[2], s[3]], r, &x[0], &mut out);
        Forward::one(out.freeze(), Kept::default())
    }

    fn backward(&self, _: &Kept, d: &[Option<Values>], _: &[bool]) -> Vec<Option<Values>> {
        let r = self.0;
        vec![d[0].as_ref().map(|d| {
            let s = d.shape();
            let (h, w) = (s[2] / r, s[3] / r);
            let mut dx = ValuesMut::any(&[s[0], s[1] * r * r, h, w]);
            shuffle::unshuffle(s[0] * s[1], [h, w], r, d, &mut dx);
            dx.freeze()
        })]
    }

    fn by_burn(&self, x: &[DispatchTensor]) -> Option<Vec<DispatchTensor>> {
        Some(by_burn::pixel_shuffle(x, self.0))
    }
}

/// Channels become pixels of an image `factor` times as large, in PyTorch's order.
///
/// # Shapes
/// x `[N, C · factor², H, W]`; result `[N, C, H · factor, W · factor]`.
pub fn pixel_shuffle(x: Tensor<4>, factor: usize) -> Result<Tensor<4>, OpError> {
    apply_one(ShuffleOp(factor), vec![x.into_dispatch()])
}

/// How an image is sampled at a grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GridSettings {
    pub mode: Mode,
    pub outside: Outside,
    pub align_corners: bool,
}

#[derive(Debug)]
struct GridOp(GridSettings);

impl GridOp {
    fn description(&self, x: &[usize], grid: &[usize]) -> GridSample {
        let GridSettings { mode, outside, align_corners } = self.0;
        GridSample { mode, outside, align_corners, images: x[0], channels: x[1], from: [x[2], x[3]], points: grid[1] * grid[2] }
    }
}

impl SliceOp for GridOp {
    fn name(&self) -> &'static str {
        "grid sample"
    }

    fn check(&self, shapes: &[&[usize]]) -> Result<(), OpError> {
        expect_inputs(self.name(), shapes, 2)?;
        expect_images(self.name(), &shapes[..1])?;
        expect_shape(self.name(), "grid", shapes[1], &[Some(shapes[0][0]), None, None, Some(2)])
    }

    fn forward(&self, x: &[Values], _: &[bool]) -> Forward {
        let (s, g) = (x[0].shape(), x[1].shape());
        let mut out = ValuesMut::any(&[s[0], s[1], g[1], g[2]]);
        grid_sample::cpu::forward(&self.description(s, g), &x[0], &x[1], &mut out);
        Forward::one(out.freeze(), Kept::of(x))
    }

    fn backward(&self, kept: &Kept, d: &[Option<Values>], wanted: &[bool]) -> Vec<Option<Values>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let [x, grid] = [&kept.values[0], &kept.values[1]];
        let s = self.description(x.shape(), grid.shape());
        let dx = wanted[0].then(|| {
            let mut out = ValuesMut::any(x.shape());
            grid_sample::cpu::backward_input(&s, grid, d, &mut out);
            out.freeze()
        });
        let d_grid = wanted[1].then(|| {
            let mut out = ValuesMut::any(grid.shape());
            grid_sample::cpu::backward_grid(&s, x, grid, d, &mut out);
            out.freeze()
        });
        vec![dx, d_grid]
    }

    #[cfg(feature = "gpu")]
    fn on_device(&self) -> Option<&dyn DeviceKernels> {
        Some(self)
    }
}

#[cfg(feature = "gpu")]
impl DeviceKernels for GridOp {
    fn forward_on(&self, gpu: &Gpu, x: &[OnDevice]) -> DeviceOutputs {
        let (s, g) = (&x[0].shape, &x[1].shape);
        let out = grid_sample::gpu::forward(gpu, &self.description(s, g), &x[0].data, &x[1].data);
        DeviceOutputs { outputs: vec![(out, vec![s[0], s[1], g[1], g[2]])], kept: Vec::new() }
    }

    fn backward_on(&self, gpu: &Gpu, x: &[OnDevice], _: &[Buffer], d: &[Option<Buffer>]) -> Vec<Option<Buffer>> {
        let Some(d) = &d[0] else { return vec![None, None] };
        let (s, grid) = (self.description(&x[0].shape, &x[1].shape), &x[1].data);
        let dx = grid_sample::gpu::backward_input(gpu, &s, grid, d);
        vec![Some(dx), Some(grid_sample::gpu::backward_grid(gpu, &s, &x[0].data, grid, d))]
    }
}

/// Values of images at the points of a grid, whose coordinates −1 and 1 are the images' borders.
///
/// # Shapes
/// x `[N, C, H, W]`; grid `[N, H', W', 2]` of (x, y); result `[N, C, H', W']`.
pub fn grid_sample(x: Tensor<4>, grid: Tensor<4>, settings: GridSettings) -> Result<Tensor<4>, OpError> {
    apply_one(GridOp(settings), vec![x.into_dispatch(), grid.into_dispatch()])
}
