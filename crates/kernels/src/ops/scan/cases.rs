//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
#[cfg(feature = "gpu")]
use diorama_testkit::wide;
use diorama_testkit::{random, random_unit};

/// Samples per ray, where each begins, and a number for each sample.
pub struct Case {
    pub counts: Vec<u32>,
    pub offsets: Vec<u32>,
    pub x: Vec<f32>,
}

pub fn cases() -> Vec<Case> {
    let few = [vec![], vec![0], vec![3, 0, 7, 1], vec![100; 5]];
    let many = [77, 255, 256, 1023, 1024, 10_001].map(|n| random_unit(n, 1).iter().map(|v| (v * 40.0) as u32).collect());
    few.into_iter().chain(many).map(of).collect()
}

/// The reference sums each prefix anew, which is too slow for the longest case.
fn of(counts: Vec<u32>) -> Case {
    let mut offsets = vec![0];
    counts.iter().for_each(|c| offsets.push(offsets[offsets.len() - 1] + c));
    Case { x: random(offsets[counts.len()] as usize, 2), counts, offsets }
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for Case { counts, offsets, x } in cases() {
        let shape = format!("R={} S={}", counts.len(), x.len());
        table.equal("scan", "exclusive", &shape, &on_gpu::exclusive(gpu, &gpu.upload(&counts)), &offsets)?;
        let (starts, numbers) = (gpu.upload(&offsets), gpu.upload(&x));
        let want = reference::inclusive(&offsets, &wide(&x));
        table.close("scan", "inclusive", &shape, &on_gpu::inclusive(gpu, &starts, &numbers), &want)?;
        let want = reference::inclusive_backward(&offsets, &wide(&x));
        table.close("scan", "d inclusive", &shape, &on_gpu::inclusive_backward(gpu, &starts, &numbers), &want)?;
    }
    if !gpu.shared {
        // One cube sums few counts. Mesa's software Vulkan ends loops after 65,535 rounds.
        return Ok(());
    }
    // Sums of parts that are themselves summed in parts.
    let n = if gpu.software { (1 << 20) + 5 } else { (1 << 22) + 5 };
    let Case { counts, offsets, .. } = of((0..n).map(|i: u32| (i * 7 + i / 1000) % 5 % 3).collect());
    table.equal("scan", "exclusive", format!("R={n}"), &on_gpu::exclusive(gpu, &gpu.upload(&counts)), &offsets)
}
