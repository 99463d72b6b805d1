//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{gpu as on_gpu, reference};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError, table::Table};
use diorama_geom::PixelFormat;
use diorama_testkit::random_unit;

/// Packed pixels, and those that are wanted.
pub struct Case {
    pub format: PixelFormat,
    pub words: Vec<u32>,
    pub at: Vec<usize>,
}

pub fn cases() -> Vec<Case> {
    let formats = [PixelFormat::Unorm8, PixelFormat::Unorm16, PixelFormat::Half];
    formats.into_iter().flat_map(|format| [0, 1, 67].map(|n| of(format, n))).collect()
}

fn of(format: PixelFormat, n: usize) -> Case {
    // Half floats from 2⁻¹⁴ to 2, of both signs: larger ones would hide errors of the others.
    let sixteen = |v: &f32| {
        let bits = (v * 65536.0) as u32;
        if format == PixelFormat::Half { bits & 0x8000 | (0x0400 + bits % 0x3c00) } else { bits }
    };
    let words = random_unit(400, 1).as_chunks().0.iter().map(|[a, b]| sixteen(b) << 16 | sixteen(a)).collect();
    Case { format, words, at: random_unit(n, 2).iter().map(|v| (v * 100.0) as usize).collect() }
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for Case { format, words, at } in cases() {
        let places: Vec<u32> = at.iter().map(|i| *i as u32).collect();
        let got = on_gpu::gather(gpu, format, &gpu.upload(&words), &gpu.upload(&places));
        table.close("pixel gather", "forward", format!("R={} {format:?}", at.len()), &got, &reference::gather(format, &words, &at))?;
    }
    Ok(())
}
