//! A whole network in one launch (Müller et al. 2021, "Real-time neural radiance caching", section 4): a cube takes a
//! tile of rows through all layers in shared memory, forward and backward. Tensor cores multiply where the device has
//! them, with weights and activations in half precision, sums in f32, and gradients scaled so that they stay in
//! its range; elsewhere units multiply in f32.
//!
//! Weights are packed anew from the f32 parameters for every step: each source of a layer is padded to whole
//! blocks of 16 rows, each layer to whole blocks of 16 columns. Gradients of the weights stay in registers while a
//! cube goes from tile to tile, and are added up at the end.

mod backward;
mod forward;
mod plan;

use super::super::{Head, Mlp};
use crate::api::Api;
use crate::gpu::{Buffer, CUBE, Gpu, Rows, has_cuda_headers, launch};
use backward::backward_tiles;
use cubecl::ir::{ElemType, FloatKind};
use cubecl::prelude::*;
use forward::forward_tiles;
use half::{bf16, f16};
use plan::Plan;

/// Edge of a block.
const BLOCK: usize = 16;
/// Planes (warps) of a cube, with 32 units each.
const PLANES: usize = CUBE as usize / 32;
/// Most cubes along one axis.
const MAX_CUBES: usize = 65_535;
/// Marker of a number of the packed weights that is padding.
const EMPTY: u32 = u32::MAX;
/// Most results that a unit keeps until the last tile.
const MOST_SUMS: usize = 96;

/// Assumed number of processors of a device that does not report it: many, since an extra cube costs little and an idle processor a lot.
const PROCESSORS: u32 = 128;

/// Element type of activations and packed weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Element {
    F32,
    F16,
    Bf16,
}

impl Element {
    fn bytes(self) -> usize {
        if self == Element::F32 { 4 } else { 2 }
    }
}

/// A network ready to run in one launch.
pub struct Fused {
    pub element: Element,
    plan: Plan,
    /// Parameter of every number of the packed weights, and the packed number of every parameter.
    to_packed: Buffer<u32>,
    from_packed: Buffer<u32>,
    /// Cubes of the backward pass.
    cubes: usize,
}

/// Calls a method that is generic over the element with that of a network.
macro_rules! with_element {
    ($self:ident.$method:ident($($argument:expr),*)) => {
        match $self.element {
            Element::F32 => $self.$method::<f32>($($argument),*),
            Element::F16 => $self.$method::<f16>($($argument),*),
            Element::Bf16 => $self.$method::<bf16>($($argument),*),
        }
    };
}

/// Values that the forward pass keeps for the backward pass.
pub struct Kept {
    values: Buffer,
    packed: Buffer,
    /// Activated values of each head, `[S, channels]`.
    pub heads: Vec<Buffer>,
}

/// The best element that the device's tensor cores multiply in planes of 32 units.
pub fn tensor_element(gpu: &Gpu) -> Option<Element> {
    let p = gpu.client.properties();
    if gpu.api == Api::Cuda && !has_cuda_headers() {
        return None;
    }
    if p.hardware.plane_size_min != 32 || p.hardware.plane_size_max != 32 {
        return None;
    }
    let offers = |kind| {
        p.features.matmul.cmma.iter().any(|c| {
            let float = |t, k| t == ElemType::Float(k);
            (c.m, c.n, c.k) == (16, 16, 16) && float(c.a_type, kind) && float(c.b_type, kind) && float(c.cd_type, FloatKind::F32)
        })
    };
    let all = [(FloatKind::F16, Element::F16), (FloatKind::BF16, Element::Bf16)];
    all.into_iter().find(|(kind, _)| offers(*kind)).map(|(_, e)| e)
}

impl Fused {
    /// Kernels for the layers up to the heads (each with its number of channels), with input 0 in levels of
    /// `per_level` numbers (0: in rows), and gradients of the inputs that are `wanted`. None where the network
    /// or the device does not fit.
    pub fn new(gpu: &Gpu, mlp: &Mlp, heads: &[(Head, usize)], per_level: usize, wanted: &[bool], element: Element) -> Option<Fused> {
        let hardware = &gpu.client.properties().hardware;
        if !gpu.shared || hardware.max_units_per_cube < CUBE || hardware.max_bindings < 16 {
            return None;
        }
        let mut plan = Plan::new(mlp, heads, per_level, wanted)?;
        if plan.sums() + plan.biases() > MOST_SUMS {
            return None;
        }
        plan.tensor = element != Element::F32;
        if element == Element::F16 {
            plan.largest = 65_504f32.to_bits();
        }
        plan.tile = [64, 32, 16].into_iter().find(|t| plan.bytes(*t, element.bytes()) <= hardware.max_shared_memory_size.min(48 << 10))?;
        let mut to_packed = vec![EMPTY; plan.packed];
        let mut from_packed = vec![EMPTY; mlp.params_len()];
        for (j, l) in plan.layers.iter().enumerate() {
            let mut row = 0;
            for f in &l.feeds {
                for r in 0..f.width {
                    for c in 0..l.width {
                        let (p, q) = (mlp.offsets[j] + (row + r) * l.width + c, l.weight + (f.at + r) * l.padded + c);
                        to_packed[q] = p as u32;
                        from_packed[p] = q as u32;
                    }
                }
                row += f.width;
            }
            if let Some((p, q)) = l.bias {
                (0..l.width).for_each(|c| (to_packed[q + c], from_packed[p + c]) = ((p + c) as u32, (q + c) as u32));
            }
        }
        let processors = hardware.num_streaming_multiprocessors.unwrap_or(PROCESSORS) as usize;
        let (to_packed, from_packed) = (gpu.upload(&to_packed), gpu.upload(&from_packed));
        Some(Fused { element, plan, to_packed, from_packed, cubes: 2 * processors })
    }

    /// Memory for `n` elements.
    fn memory(&self, gpu: &Gpu, n: usize) -> Buffer {
        gpu.empty((n * self.element.bytes()).div_ceil(4))
    }

    /// Weights in the packed layout of the kernels.
    fn pack<E: Float>(&self, gpu: &Gpu, params: &Buffer) -> Buffer {
        let n = self.to_packed.len();
        let out = self.memory(gpu, n);
        let packed: Buffer<E> = out.cast();
        launch!(
            gpu,
            pack_params::<E>,
            n,
            [params => self.from_packed.len(), self.to_packed => n, packed => n],
            n as u32,
            f32::from_bits(self.plan.largest),
        );
        out
    }

    /// Heads of rows of inputs, and with `keep` what [`Fused::backward`] needs.
    pub fn forward(&self, gpu: &Gpu, params: &Buffer, inputs: &[&Buffer], rows: &Rows, keep: bool) -> Kept {
        with_element!(self.forward_as(gpu, params, inputs, rows, keep))
    }

    fn forward_as<E: Float>(&self, gpu: &Gpu, params: &Buffer, inputs: &[&Buffer], rows: &Rows, keep: bool) -> Kept {
        let packed = self.pack::<E>(gpu, params);
        let plan = Plan { keep, ..self.plan.clone() };
        let kept_len = if keep { rows.most * plan.kept } else { 0 };
        let values = self.memory(gpu, kept_len);
        let heads: Vec<Buffer> = plan.heads.iter().map(|h| gpu.empty(rows.most * h.channels)).collect();
        let tiles = rows.most.div_ceil(plan.tile);
        // Bound in place of inputs and heads that the network lacks.
        let none = gpu.empty(0);
        let input = |i: usize| inputs.get(i).copied().unwrap_or(&none);
        let head = |i: usize| heads.get(i).unwrap_or(&none);
        let (weights, kept): (Buffer<E>, Buffer<E>) = (packed.cast(), values.cast());
        launch!(
            gpu,
            forward_tiles::<E>,
            ([tiles.min(MAX_CUBES), tiles.div_ceil(MAX_CUBES), 1], CubeDim::new_1d(CUBE)),
            [
                rows.live => rows.at + 1,
                input(0) => self.input_len(rows, 0),
                input(1) => self.input_len(rows, 1),
                input(2) => self.input_len(rows, 2),
                weights => self.to_packed.len(),
                params => self.from_packed.len(),
                kept => kept_len,
                head(0) => self.head_len(rows, 0),
                head(1) => self.head_len(rows, 1),
            ],
            rows.place(),
            rows.most as u32,
            plan,
        );
        Kept { values, packed, heads }
    }

    /// Width of input `i`; 0 where there is none.
    fn input_len(&self, rows: &Rows, i: usize) -> usize {
        self.plan.inputs.get(i).map_or(0, |input| rows.most * input.width)
    }

    /// Channels of head `i`; 0 where there is none.
    fn head_len(&self, rows: &Rows, i: usize) -> usize {
        self.plan.heads.get(i).map_or(0, |h| rows.most * h.channels)
    }

    /// Gradients of the parameters, and of the inputs where they are wanted, given those of the heads; in half
    /// precision they are computed times `scale`.
    pub fn backward(
        &self,
        gpu: &Gpu,
        params: &Buffer,
        inputs: &[&Buffer],
        kept: &Kept,
        rows: &Rows,
        (d_heads, scale): (&[&Buffer], f32),
    ) -> (Buffer, Vec<Option<Buffer>>) {
        let scale = if self.element == Element::F16 { scale } else { 1.0 };
        let d_inputs: Vec<Option<Buffer>> =
            inputs.iter().zip(&self.plan.inputs).map(|(x, i)| i.wanted.then(|| gpu.empty(x.len()))).collect();
        let cubes = self.cubes.min(rows.most.div_ceil(self.plan.tile)).max(1);
        let parts = gpu.empty(cubes * self.plan.packed);
        let of = Backward { inputs, kept, d_heads, d_inputs: &d_inputs, parts: &parts, cubes, scale };
        with_element!(self.backward_as(gpu, rows, &of));
        let n = params.len();
        let d_params = gpu.empty(n);
        launch!(
            gpu,
            add_up,
            n,
            [parts => cubes * self.plan.packed, self.from_packed => n, d_params => n],
            n as u32,
            cubes as u32,
            self.plan.packed as u32,
            1.0 / scale,
        );
        (d_params, d_inputs)
    }

    fn backward_as<E: Float>(&self, gpu: &Gpu, rows: &Rows, of: &Backward) {
        let plan = &self.plan;
        let none = gpu.empty(0);
        let input = |i: usize| of.inputs.get(i).copied().unwrap_or(&none);
        let d_input = |i: usize| of.d_inputs.get(i).and_then(Option::as_ref).unwrap_or(&none);
        let head = |i: usize| of.kept.heads.get(i).unwrap_or(&none);
        let d_head = |i: usize| of.d_heads.get(i).copied().unwrap_or(&none);
        let d_len = |i: usize| if plan.inputs.get(i).is_some_and(|i| i.wanted) { self.input_len(rows, i) } else { 0 };
        let (weights, kept): (Buffer<E>, Buffer<E>) = (of.kept.packed.cast(), of.kept.values.cast());
        launch!(
            gpu,
            backward_tiles::<E>,
            ([of.cubes, 1, 1], CubeDim::new_1d(CUBE)),
            [
                rows.live => rows.at + 1,
                input(0) => self.input_len(rows, 0),
                input(1) => self.input_len(rows, 1),
                input(2) => self.input_len(rows, 2),
                weights => self.to_packed.len(),
                kept => rows.most * plan.kept,
                head(0) => self.head_len(rows, 0),
                head(1) => self.head_len(rows, 1),
                d_head(0) => self.head_len(rows, 0),
                d_head(1) => self.head_len(rows, 1),
                d_input(0) => d_len(0),
                d_input(1) => d_len(1),
                d_input(2) => d_len(2),
                of.parts => of.cubes * plan.packed,
            ],
            rows.place(),
            rows.most as u32,
            of.scale,
            plan.clone(),
        );
    }
}

/// Buffers of a backward pass.
struct Backward<'a> {
    inputs: &'a [&'a Buffer],
    kept: &'a Kept,
    d_heads: &'a [&'a Buffer],
    d_inputs: &'a [Option<Buffer>],
    /// Gradients of the packed weights, cube by cube.
    parts: &'a Buffer,
    cubes: usize,
    scale: f32,
}

#[cube(launch_unchecked)]
fn pack_params<E: Float>(params: &[f32], map: &[u32], packed: &mut [E], n: u32, largest: f32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let from = map[i];
    let mut v = 0.0f32;
    if from != EMPTY {
        v = clamp(params[from as usize], -largest, largest);
    }
    packed[i] = E::cast_from(v);
}

/// Sums of the cubes' gradients, in the order of the parameters.
#[cube(launch_unchecked)]
fn add_up(parts: &[f32], map: &[u32], out: &mut [f32], n: u32, cubes: u32, packed: u32, scale: f32) {
    let i = ABSOLUTE_POS;
    if i >= n as usize {
        terminate!();
    }
    let mut sum = 0.0f32;
    if map[i] != EMPTY {
        for c in 0..cubes as usize {
            sum += parts[c * packed as usize + map[i] as usize];
        }
    }
    out[i] = sum * scale;
}
