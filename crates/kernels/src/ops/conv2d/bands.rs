//! Divides a batch of images into bands whose copies fit in the L2 cache, and provides per-thread scratch memory.

use crate::gemm::Rounded;
use std::cell::RefCell;
use std::ops::Range;

/// Bands of whole rows: of one image where it is large, of several images where they are small.
#[derive(Clone, Copy, Debug)]
pub struct Bands {
    batch: usize,
    height: usize,
    /// Images per band.
    pub images: usize,
    /// Rows per band.
    pub rows: usize,
}

impl Bands {
    /// Divides images of `rows` by `columns` into bands of about equal size, at most about `pixels` each.
    pub fn plan(batch: usize, rows: usize, columns: usize, pixels: usize) -> Self {
        let (rows, columns) = (rows.max(1), columns.max(1));
        if 2 * rows * columns <= pixels {
            let images = (pixels / (rows * columns)).clamp(1, batch.max(1));
            return Bands { batch, height: rows, images: batch.max(1).div_ceil(batch.max(1).div_ceil(images)), rows };
        }
        let parts = rows.div_ceil((pixels / columns).max(1));
        Bands { batch, height: rows, images: 1, rows: rows.div_ceil(parts) }
    }

    /// The same bands, or up to twice as many that take fewer tiles of `width` cells, where rows are `pitch` cells apart.
    pub fn fitted(self, columns: usize, pitch: usize, width: usize) -> Self {
        let tiles = |rows: usize| if rows > 0 { ((rows - 1) * pitch + columns).div_ceil(width) } else { 0 };
        let cost = |rows: usize| self.height / rows * tiles(rows) + tiles(self.height % rows);
        let rows = (self.rows.div_ceil(2)..=self.rows).rev().min_by_key(|&rows| cost(rows));
        Bands { rows: rows.filter(|_| self.images == 1).unwrap_or(self.rows), ..self }
    }

    /// Number of bands.
    pub fn len(&self) -> usize {
        self.batch.div_ceil(self.images) * self.height.div_ceil(self.rows)
    }

    /// Images and rows of band `i`.
    pub fn band(&self, i: usize) -> (Range<usize>, Range<usize>) {
        let per_image = self.height.div_ceil(self.rows);
        let (image, row) = (i / per_image * self.images, i % per_image * self.rows);
        (image..(image + self.images).min(self.batch), row..(row + self.rows).min(self.height))
    }
}

/// Buffers that a thread keeps between calls.
#[derive(Default)]
pub struct Scratch {
    pub planes: Vec<f32>,
    pub panel: Vec<f32>,
    pub sums: Vec<f32>,
    pub taps: Vec<f32>,
    pub segments: Vec<crate::tile::Segment>,
    pub offsets: Vec<(u32, u32)>,
    pub columns: Vec<u32>,
    pub rounded: Rounded,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// Runs `work` with this thread's scratch, or with a new one if a caller already uses it.
pub fn with_scratch<R>(work: impl FnOnce(&mut Scratch) -> R) -> R {
    let mut scratch = SCRATCH.take();
    let result = work(&mut scratch);
    SCRATCH.set(scratch);
    result
}

/// Grows the buffer if necessary and returns `len` of its floats, aligned to a cache line; their values are unspecified.
pub fn aligned(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if buffer.len() < len + 16 {
        buffer.resize(len + 16, 0.0);
    }
    let first = buffer.as_ptr().align_offset(64).min(16);
    &mut buffer[first..first + len]
}
