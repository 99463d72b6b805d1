//! Layers that have kernels of ours on a device against the same layers on the CPU, in burn's graph: outputs, and gradients of all inputs.

use super::{Filter, GridMode, GridSettings, Outside, Pool, average_pool, grid_sample, resize};
use crate::OpError;
use crate::bridge::{read_values, tensors};
use burn::tensor::{Device, Tensor, TensorData};
use diorama_kernels::check::{Row, TOLERANCE, Table};
use diorama_kernels::gpu::Gpu;
use diorama_testkit::{compare_proven, random, wide};

/// A line for every result of every layer. The device must let units share memory, as burn's own kernels do wherever they run.
pub fn run(gpu: &Gpu) -> Vec<Row> {
    let mut table = Table::new(gpu);
    let (here, there) = (Device::flex().autodiff(), tensors(gpu).autodiff());
    let image = [2, 3, 9, 7];
    for filter in [Filter::Bilinear { align_corners: false }, Filter::Bilinear { align_corners: true }, Filter::BicubicAntialiased] {
        let layer = |device: &Device| results(device, [image], |[x]| resize(x, filter, [5, 12]));
        table_rows(&mut table, &format!("resize {filter:?}"), layer(&here), layer(&there));
    }
    let pool = Pool { kernel: [3, 2], stride: [2, 3], padding: [1, 0], ceil_mode: true };
    for count_padding in [false, true] {
        let layer = |device: &Device| results(device, [image], |[x]| average_pool(x, pool, count_padding));
        table_rows(&mut table, &format!("average pool, counts padding {count_padding}"), layer(&here), layer(&there));
    }
    for (mode, outside) in
        [(GridMode::Bilinear, Outside::Zeros), (GridMode::Bilinear, Outside::Border), (GridMode::Nearest, Outside::Zeros)]
    {
        let settings = GridSettings { mode, outside, align_corners: false };
        let layer = |device: &Device| results(device, [image, [2, 4, 6, 2]], |[x, grid]| grid_sample(x, grid * 1.3, settings));
        table_rows(&mut table, &format!("grid sample {settings:?}"), layer(&here), layer(&there));
    }
    table.rows
}

/// The output of a layer for random inputs of these shapes, and the gradient of each input, on a device.
fn results<const N: usize>(
    device: &Device,
    shapes: [[usize; 4]; N],
    layer: impl Fn([Tensor<4>; N]) -> Result<Tensor<4>, OpError>,
) -> Result<Vec<Vec<f32>>, String> {
    let given = |shape: [usize; 4], seed: u64| Tensor::<4>::from_data(TensorData::new(random(shape.iter().product(), seed), shape), device);
    let inputs: [Tensor<4>; N] = std::array::from_fn(|i| given(shapes[i], 1 + i as u64).require_grad());
    let out = layer(inputs.clone()).map_err(|e| e.to_string())?;
    // Every element has a gradient of its own.
    let gradients = (out.clone() * given(out.dims(), 50)).sum().backward();
    let of = |x: &Tensor<4>| x.grad(&gradients).map(read_values).ok_or("no gradient".to_string());
    let mut all = vec![read_values(out)];
    for x in &inputs {
        all.push(of(x)?);
    }
    Ok(all)
}

fn table_rows(table: &mut Table, layer: &str, here: Result<Vec<Vec<f32>>, String>, there: Result<Vec<Vec<f32>>, String>) {
    match (here, there) {
        (Ok(here), Ok(there)) => {
            for ((name, want), got) in ["forward", "d x", "d grid"].into_iter().zip(&here).zip(&there) {
                table.row("layer in burn's graph", name, layer.to_string(), compare_proven(got, &wide(want), TOLERANCE));
            }
        }
        (Err(e), _) | (_, Err(e)) => table.row("layer in burn's graph", "forward", layer.to_string(), Err(e)),
    }
}
