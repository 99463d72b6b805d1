//! Training photographs in the form that samplers and devices read.

use diorama_data::pixel_store::PixelStore;
use diorama_engine::samplers::pixels::PixelSource;
use diorama_kernels::ops::pixel_gather;

/// Decoded photographs.
pub struct StoredPhotographs(PixelStore);

impl StoredPhotographs {
    pub fn new(store: PixelStore) -> Self {
        StoredPhotographs(store)
    }

    pub fn store(&self) -> &PixelStore {
        &self.0
    }

    /// Multiplies the channels of a photograph.
    pub fn brighten(&mut self, image: usize, by: [f32; 3]) {
        self.0.brighten(image, by);
    }
}

impl PixelSource for StoredPhotographs {
    fn images(&self) -> usize {
        self.0.len()
    }
    fn size(&self, image: usize) -> (u32, u32) {
        self.0.size(image)
    }
    fn snap(&self, image: usize, x: u32, y: u32) -> (u32, u32) {
        self.0.snap(image, x, y)
    }
    fn stride(&self) -> u32 {
        self.0.stride()
    }
    fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4] {
        pixel_gather::cpu::convert(self.0.format(), self.0.pixel(image, x, y))
    }
    fn counts(&self, image: usize, x: u32, y: u32) -> bool {
        self.0.counts(image, x, y)
    }
}

/// The pixels that are kept, and which of them count, on a device.
#[cfg(feature = "gpu")]
pub(super) fn resident(
    gpu: &diorama_kernels::gpu::Gpu,
    store: &PixelStore,
    observations: &[diorama_engine::samplers::pixels::Observation],
) -> diorama_kernels::ops::pixel_draw::gpu::GpuPhotographs {
    let n = store.len();
    let sizes: Vec<(u32, u32)> = (0..n).map(|i| store.size(i)).collect();
    let keys: Vec<_> = (0..n).map(|i| store.kept_by(i)).collect();
    let pixels: Vec<u32> = (0..n).flat_map(|i| store.words(i)).collect();
    let mut mask = vec![u32::MAX; (0..n).map(|i| store.kept(i)).sum::<usize>().div_ceil(32)];
    let (mut all, mut first) = (true, 0);
    for i in 0..n {
        for (at, _) in store.counting(i).into_iter().flatten().enumerate().filter(|(_, counts)| !counts) {
            mask[(first + at) / 32] &= !(1 << ((first + at) % 32));
            all = false;
        }
        first += store.kept(i);
    }
    let pixels = (store.format(), &pixels[..]);
    let mut images = diorama_kernels::ops::pixel_draw::gpu::GpuPhotographs::upload(
        gpu,
        &sizes,
        store.stride(),
        &keys,
        pixels,
        (!all).then_some(&mask[..]),
    );
    images.observe(gpu, observations);
    images
}
