//! A whole network in one launch (Müller et al. 2021, "Real-time neural radiance caching", section 4): a cube takes a
//! tile of rows through all layers in memory that it shares, and back. Tensor cores multiply where the device has
//! them, with weights and activations in half precision, sums in f32, and gradients scaled so that they stay in
//! its range; elsewhere units multiply in f32.
//!
//! Weights are packed anew from the f32 parameters for every step: each source of a layer is padded to whole
//! blocks of 16 rows, each layer to whole blocks of 16 columns. Gradients of the weights stay in registers while a
//! cube goes from tile to tile, and are added up at the end.

use super::super::{Mlp, Source};
use crate::device::Api;
use crate::gpu::{Buffer, CUBE, Gpu, Rows, has_cuda_headers, units};
use crate::ops::linear::gpu::{add_outer, apply, code, slope};
use crate::ops::ngp_field::Head;
use cubecl::ir::{ElemType, FloatKind};
use cubecl::prelude::*;
use half::{bf16, f16};

/// Edge of a block.
const BLOCK: usize = 16;
/// Planes of a cube, where planes have 32 units.
const PLANES: usize = CUBE as usize / 32;
/// Most inputs and heads.
const INPUTS: usize = 3;
const HEADS: usize = 2;
/// Most results of one unit that wait for the last tile.
const MOST_SUMS: usize = 96;
/// Widest layer, and widest input of a layer.
const MOST_WIDTH: usize = 128;
/// Numbers between rows in shared memory, so that rows begin in different banks.
const PAD: usize = 8;
/// Row of a packed weight that no parameter fills.
const EMPTY: u32 = u32::MAX;
/// Most cubes along one axis.
const MAX_CUBES: usize = 65_535;

/// What activations and packed weights are.
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

/// What a layer reads.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Feed {
    source: Source,
    width: usize,
    padded: usize,
    /// First row in the layer's packed weight.
    at: usize,
    /// First column among a tile's activations on the way forward.
    column: usize,
    /// First column among a tile's gradients on the way back; none: its gradient is not wanted.
    gradient: Option<usize>,
    /// Whether no later layer has left a gradient there.
    fresh: bool,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct PlannedLayer {
    feeds: Vec<Feed>,
    inputs: Vec<usize>,
    width: usize,
    padded: usize,
    /// Rows of the packed weight.
    rows: usize,
    relu: bool,
    /// First number in the packed weights.
    weight: usize,
    /// First number among the parameters, and in the packed gradients.
    bias: Option<(usize, usize)>,
    /// First column among a tile's activations; none: no layer reads it.
    column: Option<usize>,
    /// First column of what is kept for the way back.
    kept: Option<usize>,
    /// First column among a tile's gradients; none: only heads give it any.
    gradient: Option<usize>,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct PlannedInput {
    width: usize,
    padded: usize,
    /// Numbers per level where levels come one after another, `[L, S, F]`; 0: rows `[S, K]`.
    per_level: usize,
    column: usize,
    wanted: bool,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct PlannedHead {
    layer: usize,
    channel: usize,
    channels: usize,
    activation: u32,
    shift: u32,
}

/// A network as its kernels are built for it.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Plan {
    tile: usize,
    tensor: bool,
    /// Greatest number of an element, as bits of an f32.
    largest: u32,
    layers: Vec<PlannedLayer>,
    inputs: Vec<PlannedInput>,
    heads: Vec<PlannedHead>,
    /// Numbers per row: activations, sums of a layer, what is kept, and on the way back input, gradient, gradients to come.
    stride: usize,
    stage: usize,
    kept: usize,
    x: usize,
    g: usize,
    gradients: usize,
    /// Weights and biases of the packed gradients.
    packed: usize,
    keep: bool,
}

fn padded(n: usize) -> usize {
    n.next_multiple_of(BLOCK)
}

/// Columns in use, handed out first fit.
#[derive(Default)]
struct Columns {
    taken: Vec<(usize, usize)>,
    most: usize,
}

impl Columns {
    fn take(&mut self, width: usize) -> usize {
        let mut at = 0;
        for (first, w) in &self.taken {
            if at + width <= *first {
                break;
            }
            at = at.max(first + w);
        }
        self.taken.push((at, width));
        self.taken.sort_unstable();
        self.most = self.most.max(at + width);
        at
    }

    fn free(&mut self, at: usize) {
        self.taken.retain(|(first, _)| *first != at);
    }
}

impl Plan {
    /// Plans layers up to the last that a head needs; none where the network is too large or reads too much.
    fn new(mlp: &Mlp, heads: &[(Head, usize)], per_level: usize, wanted: &[bool]) -> Option<Plan> {
        let count = heads.iter().map(|(h, _)| h.layer + 1).max()?;
        let n_inputs = mlp.input_widths.len();
        if n_inputs > INPUTS || heads.len() > HEADS {
            return None;
        }
        let readers = |s: Source| (0..count).filter(|j| mlp.layers[*j].inputs.contains(&s)).collect::<Vec<_>>();
        let mut inputs: Vec<PlannedInput> = (0..n_inputs)
            .map(|i| {
                let width = mlp.input_widths[i];
                let per_level = if i == 0 { per_level } else { 0 };
                PlannedInput { width, padded: padded(width), per_level, column: 0, wanted: wanted[i] }
            })
            .collect();
        let mut layers: Vec<PlannedLayer> = Vec::new();
        let (mut forward, mut weight, mut kept) = (Columns::default(), 0, 0);
        for (j, l) in mlp.layers[..count].iter().enumerate() {
            let mut loaded = Vec::new();
            for s in &l.inputs {
                if let Source::Input(i) = *s
                    && readers(*s)[0] == j
                    && !loaded.contains(&i)
                {
                    inputs[i].column = forward.take(inputs[i].padded);
                    loaded.push(i);
                }
            }
            let (mut feeds, mut at) = (Vec::new(), 0);
            for s in &l.inputs {
                let width = mlp.source_width(*s);
                let column = match *s {
                    Source::Input(i) => inputs[i].column,
                    Source::Layer(i) => layers[i].column.expect("a layer that is read has a place"),
                };
                feeds.push(Feed { source: *s, width, padded: padded(width), at, column, gradient: None, fresh: true });
                at += padded(width);
            }
            for f in &feeds {
                if readers(f.source).last() == Some(&j) {
                    forward.free(f.column);
                }
            }
            let read = !readers(Source::Layer(j)).is_empty();
            let p = padded(l.width);
            let column = read.then(|| forward.take(p));
            let keeps = read || l.relu;
            let place = keeps.then_some(kept);
            kept += if keeps { p } else { 0 };
            if at > MOST_WIDTH || p > MOST_WIDTH || l.inputs.iter().enumerate().any(|(i, s)| l.inputs[..i].contains(s)) {
                return None;
            }
            layers.push(PlannedLayer {
                feeds,
                inputs: loaded,
                width: l.width,
                padded: p,
                rows: at,
                relu: l.relu,
                weight,
                bias: l.bias.then_some((mlp.offsets[j] + mlp.fan_in(j) * l.width, 0)),
                column,
                kept: place,
                gradient: None,
            });
            weight += at * p;
        }
        for l in &mut layers {
            if let Some((_, at)) = &mut l.bias {
                *at = weight;
                weight += l.padded;
            }
        }
        let mut back = Columns::default();
        let mut seen = vec![false; n_inputs];
        for j in (0..count).rev() {
            // Its gradient is used up before those of what it read are formed.
            if let Some(at) = layers[j].gradient {
                back.free(at);
            }
            let mut passing = Vec::new();
            for e in 0..layers[j].feeds.len() {
                let (source, width) = (layers[j].feeds[e].source, layers[j].feeds[e].padded);
                let (place, fresh) = match source {
                    Source::Input(i) if !wanted[i] => (None, true),
                    Source::Input(i) => {
                        let at = back.take(width);
                        passing.push(at);
                        (Some(at), !std::mem::replace(&mut seen[i], true))
                    }
                    Source::Layer(i) => {
                        let fresh = layers[i].gradient.is_none();
                        let at = *layers[i].gradient.get_or_insert_with(|| back.take(width));
                        (Some(at), fresh)
                    }
                };
                (layers[j].feeds[e].gradient, layers[j].feeds[e].fresh) = (place, fresh);
            }
            passing.into_iter().for_each(|at| back.free(at));
        }
        let heads = heads.iter().map(|(h, channels)| PlannedHead {
            layer: h.layer,
            channel: h.channel,
            channels: *channels,
            activation: code(h.activation),
            shift: h.shift.to_bits(),
        });
        let widest = |f: &dyn Fn(&PlannedLayer) -> usize| layers.iter().map(f).max().unwrap_or(0);
        let (stage, x, g) = (widest(&|l| l.padded) + PAD, widest(&|l| l.rows) + PAD, widest(&|l| l.padded) + PAD);
        let heads = heads.collect();
        Some(Plan {
            tile: 0,
            tensor: false,
            largest: f32::MAX.to_bits(),
            stride: forward.most + PAD,
            stage,
            kept: kept.max(1),
            x,
            g,
            gradients: back.most.max(BLOCK) + PAD,
            packed: weight,
            keep: true,
            layers,
            inputs,
            heads,
        })
    }

    /// Results of a unit that wait for the last tile.
    fn sums(&self) -> usize {
        self.layers.iter().map(|l| (l.rows / BLOCK) * (l.padded / BLOCK)).sum()
    }

    fn biases(&self) -> usize {
        self.layers.iter().filter(|l| l.bias.is_some()).count()
    }

    /// Shared memory of either kernel, the larger.
    fn bytes(&self, tile: usize, element: usize) -> usize {
        let stage = if self.tensor { self.stage } else { 0 };
        let forward = self.stride * element + stage * 4;
        let back = (self.x + self.g) * element + self.gradients * 4;
        tile * forward.max(back)
    }
}

/// A network ready to run in one launch.
pub struct Fused {
    pub element: Element,
    plan: Plan,
    /// For every number of the packed weights its parameter, and the other way round.
    to_packed: Buffer,
    from_packed: Buffer,
    /// Cubes on the way back.
    cubes: usize,
}

/// What the way back needs of the way forward.
pub struct Kept {
    values: Buffer,
    packed: Buffer,
    /// Of each head, activated, `[S, channels]`.
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
    /// `per_level` numbers (0: in rows), and gradients of the inputs that are `wanted`. None where the network or
    /// the device is not made for it.
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
        let processors = hardware.num_streaming_multiprocessors.unwrap_or(16) as usize;
        let (to_packed, from_packed) = (gpu.upload_u32(&to_packed), gpu.upload_u32(&from_packed));
        Some(Fused { element, plan, to_packed, from_packed, cubes: 2 * processors })
    }

    /// Memory for `n` elements.
    fn memory(&self, gpu: &Gpu, n: usize) -> Buffer {
        gpu.empty((n * self.element.bytes()).div_ceil(4))
    }

    /// The weights as the kernels want them.
    fn pack(&self, gpu: &Gpu, params: &Buffer) -> Buffer {
        let n = self.to_packed.len();
        let packed = self.memory(gpu, n);
        let launch = match self.element {
            Element::F32 => arrange::launch_unchecked::<f32>,
            Element::F16 => arrange::launch_unchecked::<f16>,
            Element::Bf16 => arrange::launch_unchecked::<bf16>,
        };
        let largest = f32::from_bits(self.plan.largest);
        // SAFETY: units past the packed weights stop; the map names parameters.
        unsafe {
            launch(&gpu.client, units(n), CubeDim::new_1d(CUBE), params.arg(), self.to_packed.arg(), packed.arg_of(n), n as u32, largest);
        }
        packed
    }

    /// Heads of rows of inputs, and with `keep` what [`Fused::backward`] needs.
    pub fn forward(&self, gpu: &Gpu, params: &Buffer, inputs: &[&Buffer], rows: &Rows, keep: bool) -> Kept {
        let packed = self.pack(gpu, params);
        let plan = Plan { keep, ..self.plan.clone() };
        let kept_len = if keep { rows.most * plan.kept } else { 1 };
        let values = self.memory(gpu, kept_len);
        let heads: Vec<Buffer> = plan.heads.iter().map(|h| gpu.empty(rows.most * h.channels)).collect();
        let tiles = rows.most.div_ceil(plan.tile);
        if tiles > 0 {
            let count = CubeCount::Static(tiles.min(MAX_CUBES) as u32, tiles.div_ceil(MAX_CUBES) as u32, 1);
            let launch = match self.element {
                Element::F32 => ahead::launch_unchecked::<f32>,
                Element::F16 => ahead::launch_unchecked::<f16>,
                Element::Bf16 => ahead::launch_unchecked::<bf16>,
            };
            // Stands in for inputs and heads that the network lacks.
            let none = gpu.empty(1);
            let input = |i: usize| inputs.get(i).copied().unwrap_or(&none).arg();
            let head = |i: usize| heads.get(i).unwrap_or(&none).arg();
            let (live, at) = rows.arg();
            // SAFETY: the kernel checks rows against those in use, and columns against the plan.
            unsafe {
                launch(
                    &gpu.client,
                    count,
                    CubeDim::new_1d(CUBE),
                    live,
                    input(0),
                    input(1),
                    input(2),
                    packed.arg_of(self.to_packed.len()),
                    params.arg(),
                    values.arg_of(kept_len),
                    head(0),
                    head(1),
                    at,
                    rows.most as u32,
                    plan,
                );
            }
        }
        Kept { values, packed, heads }
    }

    /// Gradients of the parameters, and of the inputs where they are wanted, given those of the heads; in half
    /// precision they are carried times `scale`.
    #[allow(clippy::too_many_arguments)]
    pub fn backward(
        &self,
        gpu: &Gpu,
        params: &Buffer,
        inputs: &[&Buffer],
        kept: &Kept,
        rows: &Rows,
        d_heads: &[&Buffer],
        scale: f32,
    ) -> (Buffer, Vec<Option<Buffer>>) {
        let plan = &self.plan;
        let d_inputs: Vec<Option<Buffer>> = inputs.iter().zip(&plan.inputs).map(|(x, i)| i.wanted.then(|| gpu.empty(x.len()))).collect();
        let cubes = self.cubes.min(rows.most.div_ceil(plan.tile)).max(1);
        let parts = gpu.empty(cubes * plan.packed);
        let launch = match self.element {
            Element::F32 => back::launch_unchecked::<f32>,
            Element::F16 => back::launch_unchecked::<f16>,
            Element::Bf16 => back::launch_unchecked::<bf16>,
        };
        let none = gpu.empty(1);
        let input = |i: usize| inputs.get(i).copied().unwrap_or(&none).arg();
        let d_input = |i: usize| d_inputs.get(i).and_then(Option::as_ref).unwrap_or(&none).arg();
        let head = |i: usize| kept.heads.get(i).unwrap_or(&none).arg();
        let d_head = |i: usize| d_heads.get(i).copied().unwrap_or(&none).arg();
        let scale = if self.element == Element::F16 { scale } else { 1.0 };
        let (live, at) = rows.arg();
        // SAFETY: as in `forward`.
        unsafe {
            launch(
                &gpu.client,
                CubeCount::Static(cubes as u32, 1, 1),
                CubeDim::new_1d(CUBE),
                live,
                input(0),
                input(1),
                input(2),
                kept.packed.arg_of(self.to_packed.len()),
                kept.values.arg_of(rows.most * plan.kept),
                head(0),
                head(1),
                d_head(0),
                d_head(1),
                d_input(0),
                d_input(1),
                d_input(2),
                parts.arg(),
                at,
                rows.most as u32,
                scale,
                plan.clone(),
            );
        }
        let d_params = gpu.empty(params.len());
        // SAFETY: units past the parameters stop; the map names packed weights.
        unsafe {
            add_up::launch_unchecked(
                &gpu.client,
                units(params.len()),
                CubeDim::new_1d(CUBE),
                parts.arg(),
                self.from_packed.arg(),
                d_params.arg(),
                params.len() as u32,
                cubes as u32,
                plan.packed as u32,
                1.0 / scale,
            );
        }
        (d_params, d_inputs)
    }
}

#[cube(launch_unchecked)]
fn arrange<E: Float>(params: &[f32], map: &[u32], packed: &mut [E], n: u32, largest: f32) {
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

/// Brings an input's tile to shared memory, zeros where there is nothing.
#[cube]
fn load<E: Float>(
    x: &[f32],
    to: &mut Shared<[E]>,
    first: usize,
    rows: usize,
    most: u32,
    largest: f32,
    #[comptime] input: PlannedInput,
    #[comptime] tile: usize,
    #[comptime] stride: usize,
    #[comptime] column: usize,
) {
    let width = comptime!(input.width);
    let wide = comptime!(input.padded);
    let f = comptime!(input.per_level);
    let mut e = UNIT_POS as usize;
    while e < comptime!(tile * wide) {
        let mut row = e / wide;
        let mut c = e % wide;
        if comptime!(f > 0) {
            // Neighbouring units read neighbouring numbers of one level.
            row = e / f % tile;
            c = e / comptime!(f * tile) * f + e % f;
        }
        let mut v = 0.0f32;
        if first + row < rows && c < width {
            let mut at = (first + row) * width + c;
            if comptime!(f > 0) {
                at = (c / f * most as usize + first + row) * f + c % f;
            }
            v = clamp(x[at], -largest, largest);
        }
        to[row * stride + column + c] = E::cast_from(v);
        e += CUBE as usize;
    }
}

/// What becomes of a layer's sum `v` in row `r` of the tile and column `c`.
#[cube]
fn finish<E: Float>(
    v: f32,
    r: usize,
    c: usize,
    first: usize,
    rows: usize,
    params: &[f32],
    acts: &mut Shared<[E]>,
    kept: &mut [E],
    h0: &mut [f32],
    h1: &mut [f32],
    #[comptime] plan: Plan,
    #[comptime] j: usize,
) {
    let layer = comptime!(plan.layers[j].clone());
    let largest = comptime!(f32::from_bits(plan.largest));
    let mut y = v;
    if comptime!(layer.bias.is_some()) {
        if c < comptime!(layer.width) {
            y += params[comptime!(layer.bias.unwrap().0) + c];
        }
    }
    if comptime!(layer.relu) {
        y = max(y, 0.0);
    }
    let e = E::cast_from(clamp(y, -largest, largest));
    if comptime!(layer.column.is_some()) {
        acts[r * comptime!(plan.stride) + comptime!(layer.column.unwrap()) + c] = e;
    }
    if first + r < rows {
        if comptime!(plan.keep && layer.kept.is_some()) {
            kept[(first + r) * comptime!(plan.kept) + comptime!(layer.kept.unwrap()) + c] = e;
        }
        #[unroll]
        for h in 0..comptime!(plan.heads.len()) {
            let head = comptime!(plan.heads[h].clone());
            if comptime!(head.layer == j) {
                if c >= comptime!(head.channel) && c < comptime!(head.channel + head.channels) {
                    let at = (first + r) * comptime!(head.channels) + c - comptime!(head.channel);
                    let out = apply(y + comptime!(f32::from_bits(head.shift)), comptime!(head.activation));
                    if comptime!(h == 0) {
                        h0[at] = out;
                    } else {
                        h1[at] = out;
                    }
                }
            }
        }
    }
}

/// A tile of rows through all layers.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube(launch_unchecked)]
fn ahead<E: Float>(
    live: &[u32],
    x0: &[f32],
    x1: &[f32],
    x2: &[f32],
    packed: &[E],
    params: &[f32],
    kept: &mut [E],
    h0: &mut [f32],
    h1: &mut [f32],
    at: u32,
    most: u32,
    #[comptime] plan: Plan,
) {
    let rows = live[at as usize] as usize;
    let tile = comptime!(plan.tile);
    let stride = comptime!(plan.stride);
    let first = (CUBE_POS_X as usize + CUBE_POS_Y as usize * MAX_CUBES) * tile;
    if first >= rows {
        terminate!();
    }
    let largest = comptime!(f32::from_bits(plan.largest));
    let unit = UNIT_POS as usize;
    let mut acts = Shared::<[E]>::new_aligned_slice(comptime!(tile * stride), 32usize);
    let mut stage = Shared::<[f32]>::new_aligned_slice(comptime!(if plan.tensor { tile * plan.stage } else { 1 }), 32usize);
    #[unroll]
    for j in 0..comptime!(plan.layers.len()) {
        let layer = comptime!(plan.layers[j].clone());
        #[unroll]
        for l in 0..comptime!(layer.inputs.len()) {
            let i = comptime!(layer.inputs[l]);
            let input = comptime!(plan.inputs[i].clone());
            let column = comptime!(input.column);
            if comptime!(i == 0) {
                load::<E>(x0, &mut acts, first, rows, most, largest, input, tile, stride, column);
            } else if comptime!(i == 1) {
                load::<E>(x1, &mut acts, first, rows, most, largest, input, tile, stride, column);
            } else {
                load::<E>(x2, &mut acts, first, rows, most, largest, input, tile, stride, column);
            }
        }
        sync_cube();
        let n = comptime!(layer.padded);
        if comptime!(plan.tensor) {
            let across = comptime!(n / BLOCK);
            let mut block = unit / 32;
            while block < comptime!(tile / BLOCK * (n / BLOCK)) {
                let r = block / across * BLOCK;
                let c = block % across * BLOCK;
                let sum = cmma::Matrix::<f32>::from_value(
                    cmma::MatrixIdent::Accumulator,
                    BLOCK,
                    BLOCK,
                    BLOCK,
                    cmma::MatrixLayout::Undefined,
                    0.0,
                );
                #[unroll]
                for s in 0..comptime!(layer.feeds.len()) {
                    let feed = comptime!(layer.feeds[s].clone());
                    #[unroll]
                    for k in 0..comptime!(feed.padded / BLOCK) {
                        let from = r * stride + comptime!(feed.column + k * BLOCK);
                        let a = cmma::Matrix::<E>::from_slice(
                            cmma::MatrixIdent::A,
                            BLOCK,
                            BLOCK,
                            BLOCK,
                            cmma::MatrixLayout::RowMajor,
                            &acts[from..comptime!(tile * stride)],
                            stride as u32,
                        );
                        let weight = comptime!(layer.weight + (feed.at + k * BLOCK) * n) + c;
                        let b = cmma::Matrix::<E>::from_slice(
                            cmma::MatrixIdent::B,
                            BLOCK,
                            BLOCK,
                            BLOCK,
                            cmma::MatrixLayout::RowMajor,
                            &packed[weight..comptime!(plan.packed)],
                            n as u32,
                        );
                        cmma::execute(&a, &b, &sum, &sum);
                    }
                }
                let to = r * comptime!(plan.stage) + c;
                cmma::store(&mut stage[to..comptime!(tile * plan.stage)], &sum, comptime!(plan.stage as u32), cmma::MatrixLayout::RowMajor);
                block += PLANES;
            }
            sync_cube();
            let mut e = unit;
            while e < comptime!(tile * n) {
                let r = e / n;
                let c = e % n;
                let v = stage[r * comptime!(plan.stage) + c];
                finish::<E>(v, r, c, first, rows, params, &mut acts, kept, h0, h1, comptime!(plan.clone()), j);
                e += CUBE as usize;
            }
        } else {
            let mr = comptime!(tile / BLOCK);
            let nr = comptime!(n / BLOCK);
            let tx = unit % BLOCK;
            let ty = unit / BLOCK;
            let mut sums = Array::<f32>::new(comptime!(mr * nr));
            let mut left = Array::<f32>::new(mr);
            let mut right = Array::<f32>::new(nr);
            #[unroll]
            for e in 0..comptime!(mr * nr) {
                sums[e] = 0.0;
            }
            #[unroll]
            for s in 0..comptime!(layer.feeds.len()) {
                let feed = comptime!(layer.feeds[s].clone());
                for k in 0..comptime!(feed.padded) {
                    #[unroll]
                    for i in 0..mr {
                        left[i] = f32::cast_from(acts[(ty + i * BLOCK) * stride + comptime!(feed.column) + k]);
                    }
                    #[unroll]
                    for i in 0..nr {
                        right[i] = f32::cast_from(packed[comptime!(layer.weight) + (comptime!(feed.at) + k) * n + tx + i * BLOCK]);
                    }
                    add_outer(&mut sums, &left, &right, mr, nr);
                }
            }
            sync_cube();
            #[unroll]
            for a in 0..mr {
                #[unroll]
                for b in 0..nr {
                    let (r, c) = (ty + a * BLOCK, tx + b * BLOCK);
                    finish::<E>(sums[a * nr + b], r, c, first, rows, params, &mut acts, kept, h0, h1, comptime!(plan.clone()), j);
                }
            }
        }
    }
}

/// Brings what layer `j` kept to shared memory, zeros past the rows.
#[cube]
fn recall<E: Float>(
    kept: &[E],
    to: &mut Shared<[E]>,
    first: usize,
    rows: usize,
    #[comptime] wide: usize,
    #[comptime] from: usize,
    #[comptime] from_stride: usize,
    #[comptime] tile: usize,
    #[comptime] stride: usize,
    #[comptime] column: usize,
) {
    let mut e = UNIT_POS as usize;
    while e < comptime!(tile * wide) {
        let r = e / wide;
        let c = e % wide;
        let mut v = E::cast_from(0.0f32);
        if first + r < rows {
            v = kept[(first + r) * from_stride + from + c];
        }
        to[r * stride + column + c] = v;
        e += CUBE as usize;
    }
}

/// Takes an input's gradient from shared memory to where it belongs.
#[cube]
fn hand_on(
    gradients: &Shared<[f32]>,
    to: &mut [f32],
    first: usize,
    rows: usize,
    most: u32,
    scale: f32,
    #[comptime] input: PlannedInput,
    #[comptime] tile: usize,
    #[comptime] stride: usize,
    #[comptime] column: usize,
    #[comptime] fresh: bool,
) {
    let width = comptime!(input.width);
    let wide = comptime!(input.padded);
    let f = comptime!(input.per_level);
    let mut e = UNIT_POS as usize;
    while e < comptime!(tile * wide) {
        let mut row = e / wide;
        let mut c = e % wide;
        if comptime!(f > 0) {
            row = e / f % tile;
            c = e / comptime!(f * tile) * f + e % f;
        }
        if first + row < rows && c < width {
            let mut at = (first + row) * width + c;
            if comptime!(f > 0) {
                at = (c / f * most as usize + first + row) * f + c % f;
            }
            let v = gradients[row * stride + column + c] / scale;
            if comptime!(fresh) {
                to[at] = v;
            } else {
                to[at] += v;
            }
        }
        e += CUBE as usize;
    }
}

/// A head's share of the gradient of its layer's sum, in row `row` and column `c`.
#[cube]
fn seed(out: &[f32], d: &[f32], row: usize, c: usize, #[comptime] head: PlannedHead) -> f32 {
    let mut g = 0.0f32;
    if c >= comptime!(head.channel) && c < comptime!(head.channel + head.channels) {
        let at = row * comptime!(head.channels) + c - comptime!(head.channel);
        g = d[at] * slope(out[at], comptime!(head.activation));
    }
    g
}

/// Tiles of rows back through all layers.
#[allow(clippy::collapsible_if, reason = "the outer condition is decided when the kernel is built")]
#[cube(launch_unchecked)]
fn back<E: Float>(
    live: &[u32],
    x0: &[f32],
    x1: &[f32],
    x2: &[f32],
    packed: &[E],
    kept: &[E],
    h0: &[f32],
    h1: &[f32],
    d0: &[f32],
    d1: &[f32],
    dx0: &mut [f32],
    dx1: &mut [f32],
    dx2: &mut [f32],
    parts: &mut [f32],
    at: u32,
    most: u32,
    scale: f32,
    #[comptime] plan: Plan,
) {
    let rows = live[at as usize] as usize;
    let tile = comptime!(plan.tile);
    let (xs, gs, ds) = comptime!((plan.x, plan.g, plan.gradients));
    let largest = comptime!(f32::from_bits(plan.largest));
    let unit = UNIT_POS as usize;
    let tx = unit % BLOCK;
    let ty = unit / BLOCK;
    let plane = unit / 32;
    let mut x = Shared::<[E]>::new_aligned_slice(comptime!(tile * xs), 32usize);
    let mut g = Shared::<[E]>::new_aligned_slice(comptime!(tile * gs), 32usize);
    let mut gradients = Shared::<[f32]>::new_aligned_slice(comptime!(tile * ds), 32usize);
    // Weights' gradients: units' sums, or planes' blocks.
    let count = comptime!(if plan.tensor { 1 } else { plan.sums() });
    let mut sums = Array::<f32>::new(count);
    let mut blocks = Sequence::<cmma::Matrix<f32>>::new();
    let mut bias = Array::<f32>::new(comptime!(plan.biases().max(1)));
    #[unroll]
    for e in 0..count {
        sums[e] = 0.0;
    }
    #[unroll]
    for e in 0..comptime!(plan.biases().max(1)) {
        bias[e] = 0.0;
    }
    if comptime!(plan.tensor) {
        #[unroll]
        for _e in 0..comptime!(plan.layers.iter().map(|l| (l.rows / BLOCK * (l.padded / BLOCK)).div_ceil(PLANES)).sum::<usize>()) {
            blocks.push(cmma::Matrix::<f32>::from_value(
                cmma::MatrixIdent::Accumulator,
                BLOCK,
                BLOCK,
                BLOCK,
                cmma::MatrixLayout::Undefined,
                0.0,
            ));
        }
    }
    let mut first = CUBE_POS_X as usize * tile;
    while first < rows {
        #[unroll]
        for back_to_front in 0..comptime!(plan.layers.len()) {
            let j = comptime!(plan.layers.len() - 1 - back_to_front);
            let layer = comptime!(plan.layers[j].clone());
            let n = comptime!(layer.padded);
            let k = comptime!(layer.rows);
            // The gradient of the layer's sum.
            let mut e = unit;
            while e < comptime!(tile * n) {
                let r = e / n;
                let c = e % n;
                let mut v = 0.0f32;
                if first + r < rows {
                    if comptime!(layer.gradient.is_some()) {
                        v = gradients[r * ds + comptime!(layer.gradient.unwrap()) + c];
                    }
                    #[unroll]
                    for h in 0..comptime!(plan.heads.len()) {
                        let head = comptime!(plan.heads[h].clone());
                        if comptime!(head.layer == j) {
                            if comptime!(h == 0) {
                                v += scale * seed(h0, d0, first + r, c, head);
                            } else {
                                v += scale * seed(h1, d1, first + r, c, head);
                            }
                        }
                    }
                    if comptime!(layer.relu) {
                        let y = f32::cast_from(kept[(first + r) * comptime!(plan.kept) + comptime!(layer.kept.unwrap()) + c]);
                        if y <= 0.0 {
                            v = 0.0;
                        }
                    }
                }
                g[r * gs + c] = E::cast_from(clamp(v, -largest, largest));
                e += CUBE as usize;
            }
            // What the layer read.
            #[unroll]
            for s in 0..comptime!(layer.feeds.len()) {
                let feed = comptime!(layer.feeds[s].clone());
                let column = comptime!(feed.at);
                if comptime!(feed.source == Source::Input(0)) {
                    load::<E>(x0, &mut x, first, rows, most, largest, comptime!(plan.inputs[0].clone()), tile, xs, column);
                } else if comptime!(feed.source == Source::Input(1)) {
                    load::<E>(x1, &mut x, first, rows, most, largest, comptime!(plan.inputs[1].clone()), tile, xs, column);
                } else if comptime!(feed.source == Source::Input(2)) {
                    load::<E>(x2, &mut x, first, rows, most, largest, comptime!(plan.inputs[2].clone()), tile, xs, column);
                } else {
                    let from = comptime!(match feed.source {
                        Source::Layer(i) => plan.layers[i].kept.unwrap(),
                        Source::Input(_) => 0,
                    });
                    recall::<E>(kept, &mut x, first, rows, comptime!(feed.padded), from, comptime!(plan.kept), tile, xs, column);
                }
            }
            sync_cube();
            if comptime!(layer.bias.is_some()) {
                let slot = comptime!(plan.layers[..j].iter().filter(|l| l.bias.is_some()).count());
                if unit < n {
                    for r in 0..tile {
                        bias[slot] += f32::cast_from(g[r * gs + unit]);
                    }
                }
            }
            if comptime!(plan.tensor) {
                let across = comptime!(n / BLOCK);
                let total = comptime!(k / BLOCK * (n / BLOCK));
                let before =
                    comptime!(plan.layers[..j].iter().map(|l| (l.rows / BLOCK * (l.padded / BLOCK)).div_ceil(PLANES)).sum::<usize>());
                #[unroll]
                for slot in 0..comptime!(total.div_ceil(PLANES)) {
                    let block = plane + slot * PLANES;
                    if block < total {
                        let from = block / across * BLOCK;
                        let c = block % across * BLOCK;
                        #[unroll]
                        for r in 0..comptime!(tile / BLOCK) {
                            let xa = r * comptime!(BLOCK * xs) + from;
                            let a = cmma::Matrix::<E>::from_slice(
                                cmma::MatrixIdent::A,
                                BLOCK,
                                BLOCK,
                                BLOCK,
                                cmma::MatrixLayout::ColMajor,
                                &x[xa..comptime!(tile * xs)],
                                xs as u32,
                            );
                            let ga = r * comptime!(BLOCK * gs) + c;
                            let b = cmma::Matrix::<E>::from_slice(
                                cmma::MatrixIdent::B,
                                BLOCK,
                                BLOCK,
                                BLOCK,
                                cmma::MatrixLayout::RowMajor,
                                &g[ga..comptime!(tile * gs)],
                                gs as u32,
                            );
                            let sum = blocks.index(comptime!(before + slot));
                            cmma::execute(&a, &b, sum, sum);
                        }
                    }
                }
            } else {
                let kr = comptime!(k / BLOCK);
                let nr = comptime!(n / BLOCK);
                let before = comptime!(plan.layers[..j].iter().map(|l| (l.rows / BLOCK) * (l.padded / BLOCK)).sum::<usize>());
                let mut right = Array::<f32>::new(nr);
                for r in 0..tile {
                    #[unroll]
                    for i in 0..nr {
                        right[i] = f32::cast_from(g[r * gs + tx + i * BLOCK]);
                    }
                    #[unroll]
                    for a in 0..kr {
                        let left = f32::cast_from(x[r * xs + ty + a * BLOCK]);
                        #[unroll]
                        for i in 0..nr {
                            sums[before + a * nr + i] += left * right[i];
                        }
                    }
                }
            }
            // What it read gets its gradient.
            #[unroll]
            for s in 0..comptime!(layer.feeds.len()) {
                let feed = comptime!(layer.feeds[s].clone());
                if comptime!(feed.gradient.is_some()) {
                    let to = comptime!(feed.gradient.unwrap());
                    let adds = comptime!(!feed.fresh && matches!(feed.source, Source::Layer(_)));
                    let across = comptime!(feed.padded / BLOCK);
                    if comptime!(plan.tensor) {
                        let mut block = plane;
                        while block < comptime!(tile / BLOCK * (feed.padded / BLOCK)) {
                            let r = block / across * BLOCK;
                            let c = block % across * BLOCK;
                            let mut sum = cmma::Matrix::<f32>::from_value(
                                cmma::MatrixIdent::Accumulator,
                                BLOCK,
                                BLOCK,
                                BLOCK,
                                cmma::MatrixLayout::Undefined,
                                0.0,
                            );
                            let place = r * ds + to + c;
                            if comptime!(adds) {
                                cmma::load_with_layout(
                                    &mut sum,
                                    &gradients[place..comptime!(tile * ds)],
                                    ds as u32,
                                    cmma::MatrixLayout::RowMajor,
                                );
                            }
                            #[unroll]
                            for b in 0..comptime!(n / BLOCK) {
                                let ga = r * gs + comptime!(b * BLOCK);
                                let left = cmma::Matrix::<E>::from_slice(
                                    cmma::MatrixIdent::A,
                                    BLOCK,
                                    BLOCK,
                                    BLOCK,
                                    cmma::MatrixLayout::RowMajor,
                                    &g[ga..comptime!(tile * gs)],
                                    gs as u32,
                                );
                                let weight = (comptime!(feed.at) + c) * n + comptime!(layer.weight + b * BLOCK);
                                let right = cmma::Matrix::<E>::from_slice(
                                    cmma::MatrixIdent::B,
                                    BLOCK,
                                    BLOCK,
                                    BLOCK,
                                    cmma::MatrixLayout::ColMajor,
                                    &packed[weight..comptime!(plan.packed)],
                                    n as u32,
                                );
                                cmma::execute(&left, &right, &sum, &sum);
                            }
                            cmma::store(&mut gradients[place..comptime!(tile * ds)], &sum, ds as u32, cmma::MatrixLayout::RowMajor);
                            block += PLANES;
                        }
                    } else {
                        let mr = comptime!(tile / BLOCK);
                        let mut dx = Array::<f32>::new(comptime!(mr * across));
                        let mut left = Array::<f32>::new(mr);
                        let mut right = Array::<f32>::new(across);
                        #[unroll]
                        for e in 0..comptime!(mr * across) {
                            dx[e] = 0.0;
                        }
                        for c in 0..n {
                            #[unroll]
                            for i in 0..mr {
                                left[i] = f32::cast_from(g[(ty + i * BLOCK) * gs + c]);
                            }
                            #[unroll]
                            for i in 0..across {
                                right[i] = f32::cast_from(packed[comptime!(layer.weight) + (comptime!(feed.at) + tx + i * BLOCK) * n + c]);
                            }
                            add_outer(&mut dx, &left, &right, mr, across);
                        }
                        #[unroll]
                        for a in 0..mr {
                            #[unroll]
                            for i in 0..across {
                                let place = (ty + a * BLOCK) * ds + to + tx + i * BLOCK;
                                if comptime!(adds) {
                                    gradients[place] += dx[a * across + i];
                                } else {
                                    gradients[place] = dx[a * across + i];
                                }
                            }
                        }
                    }
                }
            }
            sync_cube();
            #[unroll]
            for s in 0..comptime!(layer.feeds.len()) {
                let feed = comptime!(layer.feeds[s].clone());
                if comptime!(feed.gradient.is_some() && matches!(feed.source, Source::Input(_))) {
                    let i = comptime!(match feed.source {
                        Source::Input(i) => i,
                        Source::Layer(_) => 0,
                    });
                    let input = comptime!(plan.inputs[i].clone());
                    let (column, fresh) = comptime!((feed.gradient.unwrap(), feed.fresh));
                    if comptime!(i == 0) {
                        hand_on(&gradients, dx0, first, rows, most, scale, input, tile, ds, column, fresh);
                    } else if comptime!(i == 1) {
                        hand_on(&gradients, dx1, first, rows, most, scale, input, tile, ds, column, fresh);
                    } else {
                        hand_on(&gradients, dx2, first, rows, most, scale, input, tile, ds, column, fresh);
                    }
                }
            }
        }
        sync_cube();
        first += CUBE_COUNT_X as usize * tile;
    }
    let part = CUBE_POS_X as usize * comptime!(plan.packed);
    #[unroll]
    for j in 0..comptime!(plan.layers.len()) {
        let layer = comptime!(plan.layers[j].clone());
        let n = comptime!(layer.padded);
        let weight = part + comptime!(layer.weight);
        if comptime!(plan.tensor) {
            let across = comptime!(n / BLOCK);
            let total = comptime!(layer.rows / BLOCK * (n / BLOCK));
            let before = comptime!(plan.layers[..j].iter().map(|l| (l.rows / BLOCK * (l.padded / BLOCK)).div_ceil(PLANES)).sum::<usize>());
            #[unroll]
            for slot in 0..comptime!(total.div_ceil(PLANES)) {
                let block = plane + slot * PLANES;
                if block < total {
                    let to = weight + block / across * comptime!(BLOCK * n) + block % across * BLOCK;
                    let sum = blocks.index(comptime!(before + slot));
                    cmma::store(&mut parts[to..part + comptime!(plan.packed)], sum, n as u32, cmma::MatrixLayout::RowMajor);
                }
            }
        } else {
            let (kr, nr) = comptime!((layer.rows / BLOCK, n / BLOCK));
            let before = comptime!(plan.layers[..j].iter().map(|l| (l.rows / BLOCK) * (l.padded / BLOCK)).sum::<usize>());
            #[unroll]
            for a in 0..kr {
                #[unroll]
                for i in 0..nr {
                    parts[weight + (ty + a * BLOCK) * n + tx + i * BLOCK] = sums[before + a * nr + i];
                }
            }
        }
        if comptime!(layer.bias.is_some()) {
            let slot = comptime!(plan.layers[..j].iter().filter(|l| l.bias.is_some()).count());
            if unit < n {
                parts[part + comptime!(layer.bias.unwrap().1) + unit] = bias[slot];
            }
        }
    }
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
