//! Cases of the op, for its tests and for `bench check`.

#[cfg(feature = "gpu")]
use super::{
    Backdrop,
    gpu::{Drawn, GpuPhotographs},
    reference,
};
use super::{Draw, Observation, PixelSource};
use crate::ops::error_map::ErrorMap;
use crate::ops::pixel_gather;
#[cfg(feature = "gpu")]
use crate::{
    gpu::{Gpu, GpuError, table::Table},
    ops::error_map::gpu::GpuErrorMap,
};
use diorama_geom::PixelFormat;
use diorama_geom::rng::Rng;
#[cfg(feature = "gpu")]
use diorama_testkit::wide;

/// Two photographs of unlike size, of which one pixel of each `stride × stride` square is stored; most of the second is masked.
pub struct Two {
    pub stride: u32,
    pub format: PixelFormat,
}

impl Two {
    fn kept_by(image: usize) -> Rng {
        Rng::new(image as u64, 77)
    }

    /// The stored pixels, square by square.
    #[cfg(feature = "gpu")]
    fn stored(&self) -> Vec<(usize, u32, u32)> {
        let s = self.stride;
        let squares = |i: usize| {
            let (w, h) = self.size(i);
            (0..h.div_ceil(s)).flat_map(move |y| (0..w.div_ceil(s)).map(move |x| (i, x * s, y * s)))
        };
        (0..2).flat_map(squares).map(|(i, x, y)| (i, self.snap(i, x, y))).map(|(i, (x, y))| (i, x, y)).collect()
    }

    /// A pixel as it is stored; half floats of it reach up to 3.
    fn words(&self, image: usize, x: u32, y: u32) -> [u32; 2] {
        let v = [x * 7, y * 30, image as u32, 200 + x];
        match self.format {
            PixelFormat::Unorm8 => [u32::from_le_bytes(v.map(|v| v as u8)), 0],
            PixelFormat::Unorm16 => [((v[1] * 257) << 16) | (v[0] * 257), ((v[3] * 257) << 16) | (v[2] * 257)],
            PixelFormat::Half => [(0x3000 + v[1] * 21) << 16 | (0x3000 + v[0] * 21), 0x3c00 << 16 | (0x3000 + v[2])],
        }
    }

    /// The photographs on a device.
    #[cfg(feature = "gpu")]
    fn upload(&self, gpu: &Gpu, observations: &[Observation]) -> GpuPhotographs {
        let (sizes, stored) = ([self.size(0), self.size(1)], self.stored());
        let own = pixel_gather::words_per_pixel(self.format);
        let words: Vec<u32> = stored.iter().flat_map(|(i, x, y)| self.words(*i, *x, *y).into_iter().take(own)).collect();
        let mut mask = vec![0u32; stored.len().div_ceil(32)];
        stored.iter().enumerate().for_each(|(at, (i, x, y))| mask[at / 32] |= (self.counts(*i, *x, *y) as u32) << (at % 32));
        let keys = [0, 1].map(Two::kept_by);
        let mut out = GpuPhotographs::upload(gpu, &sizes, self.stride, &keys, (self.format, &words), Some(&mask));
        out.observe(gpu, observations);
        out
    }
}

impl PixelSource for Two {
    fn images(&self) -> usize {
        2
    }
    fn size(&self, image: usize) -> (u32, u32) {
        [(8, 4), (33, 7)][image]
    }
    fn snap(&self, image: usize, x: u32, y: u32) -> (u32, u32) {
        let (s, (w, h)) = (self.stride, self.size(image));
        let (x0, y0) = (x / s * s, y / s * s);
        let random = Two::kept_by(image).bits((y0 as u64) << 32 | x0 as u64);
        (x0 + random as u32 % s.min(w - x0), y0 + (random >> 32) as u32 % s.min(h - y0))
    }
    fn rgba(&self, image: usize, x: u32, y: u32) -> [f32; 4] {
        pixel_gather::cpu::convert(self.format, self.words(image, x, y))
    }
    fn counts(&self, image: usize, x: u32, _: u32) -> bool {
        image == 0 || x > 29
    }
}

/// A draw of `rays` pixels.
pub struct Case {
    pub source: Two,
    pub error_map: Option<ErrorMap>,
    pub observations: Vec<Observation>,
    pub rays: usize,
    pub first: u64,
}

pub fn cases() -> Vec<Case> {
    use PixelFormat::{Half, Unorm8, Unorm16};
    // Errors whose roots add up exactly, so that the same cells are drawn.
    let mut errors = ErrorMap::new(2);
    errors.errors.iter_mut().enumerate().for_each(|(i, e)| *e = [0.0625, 0.0, 1.0, 0.25][i * 7 % 4]);
    errors.refresh();
    // Some of them masked, in the second photograph.
    let seen =
        |i: u32| Observation { image: i % 2, x: i * 3 % [8, 33][i as usize % 2], y: i % [4, 7][i as usize % 2], distance: 0.5 + i as f32 };
    let kinds = [(1, false, Unorm8, 0), (3, false, Unorm8, 30), (1, true, Unorm8, 30), (3, false, Unorm16, 0), (1, false, Half, 1)];
    // Counters beyond 32 bits, too.
    let draws = [(0, 0), (1, 5), (700, (1 << 33) + 12_345)];
    let of = |((stride, by_error, format, observed), (rays, first)): ((u32, bool, PixelFormat, u32), (usize, u64))| Case {
        source: Two { stride, format },
        error_map: by_error.then(|| errors.clone()),
        observations: (0..observed).map(seen).collect(),
        rays,
        first,
    };
    kinds.into_iter().flat_map(|kind| draws.map(|draw| (kind, draw))).map(of).collect()
}

impl Case {
    pub fn draw(&self) -> Draw<'_> {
        Draw { rng: Rng::new(3, 1), first: self.first, error_map: self.error_map.as_ref(), observations: &self.observations }
    }
}

#[cfg(feature = "gpu")]
pub fn check(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    for c in cases() {
        let (photographs, draw, back) = (c.source.upload(gpu, &c.observations), c.draw(), Rng::new(3, 2));
        let sizes = [c.source.size(0), c.source.size(1)];
        let errors = c.error_map.as_ref().map(|m| GpuErrorMap::upload(gpu, m, &sizes));
        let drawn = photographs.draw(gpu, c.rays, c.first, &draw.rng, errors.as_ref(), Backdrop::Random(back));
        let shape = format!(
            "R={} from {} 1 of {}² {:?}{} observed={}",
            c.rays,
            c.first,
            c.source.stride,
            c.source.format,
            if errors.is_some() { " by error" } else { "" },
            c.observations.len()
        );
        c.compare(table, &shape, &drawn)?;
        let background: Vec<u32> = (0..c.rays as u64 * 3).map(|i| back.uniform(c.first * 3 + i).to_bits()).collect();
        table.equal("draw", "background", &shape, &drawn.background, &background)?;
        let color = photographs.draw(gpu, c.rays, c.first, &draw.rng, errors.as_ref(), Backdrop::Color([0.25, 0.5, 0.75])).background;
        table.close("draw", "one background", &shape, &color, &wide(&[0.25, 0.5, 0.75].repeat(c.rays)))?;
    }
    Ok(())
}

#[cfg(feature = "gpu")]
impl Case {
    fn compare(&self, table: &mut Table, shape: &str, drawn: &Drawn) -> Result<(), GpuError> {
        let want = reference::draw(&self.source, &self.draw(), self.rays);
        let words = |of: &dyn Fn(&reference::Pixel) -> u32| want.iter().map(of).collect::<Vec<u32>>();
        table.equal("draw", "images", shape, &drawn.images, &words(&|p| p.image))?;
        let centers: Vec<u32> = want.iter().flat_map(|p| [p.x, p.y].map(|v| (v as f32 + 0.5).to_bits())).collect();
        table.equal("draw", "pixels", shape, &drawn.pixels, &centers)?;
        table.equal("draw", "jitter", shape, &drawn.jitter, &words(&|p| p.jitter.to_bits()))?;
        table.equal("draw", "left out", shape, &drawn.left_out, &words(&|p| !p.counts as u32))?;
        table.equal("draw", "distance", shape, &drawn.distance, &words(&|p| p.distance.to_bits()))?;
        let color = |p: &reference::Pixel| self.source.rgba(p.image as usize, p.x, p.y);
        table.close("draw", "target", shape, &drawn.target, &wide(&want.iter().flat_map(color).collect::<Vec<f32>>()))
    }
}
