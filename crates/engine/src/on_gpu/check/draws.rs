//! Checks of drawn pixels and of the error map that guides the draws.

use super::*;

/// Two photographs of unlike size, of which one of so many by so many pixels was kept; the left half of the second may
/// not be trained on.
struct Two {
    stride: u32,
    format: PixelFormat,
}

impl Two {
    fn kept_by(image: usize) -> Rng {
        Rng::new(image as u64, 77)
    }

    /// What was kept, square by square.
    fn kept(&self) -> Vec<(usize, u32, u32)> {
        let s = self.stride;
        let squares = |i: usize| {
            let (w, h) = self.size(i);
            (0..h.div_ceil(s)).flat_map(move |y| (0..w.div_ceil(s)).map(move |x| (i, x * s, y * s)))
        };
        (0..2).flat_map(squares).map(|(i, x, y)| (i, self.snap(i, x, y))).map(|(i, (x, y))| (i, x, y)).collect()
    }
}

impl Two {
    /// A pixel as it is stored; half floats of it reach up to 3.
    fn words(&self, image: usize, x: u32, y: u32) -> [u32; 2] {
        let v = [x * 7, y * 30, image as u32, 200 + x];
        match self.format {
            PixelFormat::Unorm8 => [u32::from_le_bytes(v.map(|v| v as u8)), 0],
            PixelFormat::Unorm16 => [((v[1] * 257) << 16) | (v[0] * 257), ((v[3] * 257) << 16) | (v[2] * 257)],
            PixelFormat::Half => [(0x3000 + v[1] * 21) << 16 | (0x3000 + v[0] * 21), 0x3c00 << 16 | (0x3000 + v[2])],
        }
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
        image == 0 || x > 16
    }
}

pub(super) fn draws(gpu: &Gpu, table: &mut Table) -> Result<(), GpuError> {
    // Errors whose roots add up exactly, so that the same cells are drawn.
    let mut errors = ErrorMap::new(2);
    errors.errors.iter_mut().enumerate().for_each(|(i, e)| *e = [0.0625, 0.0, 1.0, 0.25][i * 7 % 4]);
    errors.refresh();
    use PixelFormat::{Half, Unorm8, Unorm16};
    // Some of them masked, in the second photograph; and none.
    let seen: Vec<Observation> = (0..30)
        .map(|i| Observation { image: i % 2, x: i * 3 % [8, 33][i as usize % 2], y: i % [4, 7][i as usize % 2], distance: 0.5 + i as f32 })
        .collect();
    for (stride, map, format, observed) in
        [(1, None, Unorm8, 0), (3, None, Unorm8, 30), (1, Some(&errors), Unorm8, 30), (3, None, Unorm16, 0), (1, None, Half, 1)]
    {
        let observations = &seen[..observed];
        let two = Two { stride, format };
        let (sizes, kept) = ([two.size(0), two.size(1)], two.kept());
        let own = pixel_gather::words_per_pixel(format);
        let words: Vec<u32> = kept.iter().flat_map(|(i, x, y)| two.words(*i, *x, *y).into_iter().take(own)).collect();
        let mut mask = vec![0u32; kept.len().div_ceil(32)];
        kept.iter().enumerate().for_each(|(at, (i, x, y))| mask[at / 32] |= (two.counts(*i, *x, *y) as u32) << (at % 32));
        let mut photographs = GpuPhotographs::upload(gpu, &sizes, stride, &[0, 1].map(Two::kept_by), (format, &words), Some(&mask));
        photographs.observe(gpu, &observations.iter().map(|o| (o.image, o.x, o.y, o.distance)).collect::<Vec<_>>());
        let camera = PosedCamera { camera: Camera::pinhole(8, 4, 1.0), pose: Pose::look_at(DVec3::X, DVec3::ZERO, DVec3::Z) };
        let on_gpu = map.map(|m| GpuErrorMap::upload(gpu, &m.errors, &m.drawn));
        let (rng, back) = (Rng::new(3, 1), Rng::new(3, 2));
        // Counters beyond 32 bits, too.
        for (n, first) in [(0, 0), (1, 5), (700, (1 << 33) + 12_345)] {
            let mut batch = RayBatch::default();
            batch.resize(n);
            let o = DrawOptions { cameras: &[camera; 2], first, rng, near: 0.1, cube: (0.0, 1.0), error_map: map, observations };
            pixels::draw(&two, &o, &mut batch);
            let drawn = photographs.draw(gpu, n, first, &rng, on_gpu.as_ref(), Backdrop::Random(back));
            let (shape, exact) = (
                format!("R={n} from {first} 1 of {stride}² {format:?}{} observed={observed}", if map.is_some() { " by error" } else { "" }),
                |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>(),
            );
            table.equal("draw", "images", &shape, &drawn.images, &batch.images)?;
            table.equal("draw", "pixels", &shape, &drawn.pixels, &exact(&batch.pixels))?;
            table.equal("draw", "jitter", &shape, &drawn.jitter, &exact(&batch.jitter))?;
            let refused: Vec<u32> = batch.counts.iter().map(|c| !c as u32).collect();
            table.equal("draw", "left out", &shape, &drawn.left_out, &refused)?;
            table.equal("draw", "distance", &shape, &drawn.distance, &exact(&batch.distance))?;
            let background: Vec<f32> = (0..n * 3).map(|i| back.uniform(first * 3 + i as u64)).collect();
            table.equal("draw", "background", &shape, &drawn.background, &exact(&background))?;
            let mut got = gpu.read(&drawn.target)?;
            got.chunks_exact_mut(4).zip(&refused).filter(|(_, r)| **r == 1).for_each(|(t, _)| t.fill(0.0));
            batch.target.chunks_exact_mut(4).zip(&refused).filter(|(_, r)| **r == 1).for_each(|(t, _)| t.fill(0.0));
            table.close("draw", "target", &shape, &gpu.upload(&got), &wide(&batch.target))?;
            let color = photographs.draw(gpu, n, first, &rng, on_gpu.as_ref(), Backdrop::Color([0.25, 0.5, 0.75])).background;
            table.close("draw", "one background", &shape, &color, &wide(&[0.25, 0.5, 0.75].repeat(n)))?;

            let Some(errors_gpu) = &on_gpu else { continue };
            let (before, seen) = (errors_gpu.read(gpu)?.0, random_unit(n, 4));
            let mut of_cell = vec![Vec::new(); before.len()];
            for r in (0..n).filter(|r| refused[*r] == 0) {
                let (image, (w, h)) = (batch.images[r] as usize, two.size(batch.images[r] as usize));
                let cell = |at: f32, of: u32| ((at / of as f32 * CELLS as f32) as usize).min(CELLS - 1);
                of_cell[(image * CELLS + cell(batch.pixels[r * 2 + 1], h)) * CELLS + cell(batch.pixels[r * 2], w)].push(seen[r] as f64);
            }
            let mixed = before.iter().zip(&of_cell).map(|(e, seen)| {
                let kept = 0.9f64.powi(seen.len() as i32);
                kept * *e as f64 + (1.0 - kept) * seen.iter().sum::<f64>() / seen.len().max(1) as f64
            });
            errors_gpu.record(gpu, &photographs, &drawn, &gpu.upload(&seen));
            table.close("error map", "errors", &shape, &gpu.upload(&errors_gpu.read(gpu)?.0), &mixed.collect::<Vec<_>>())?;
            // The next draws go by the errors of the start again.
            let sums = errors.drawn.iter().scan(0.0, |sum, e| {
                *sum += (*e as f64).sqrt();
                Some(*sum)
            });
            table.close("error map", "sums", &shape, errors_gpu.cdf(), &sums.collect::<Vec<_>>())?;
        }
    }
    Ok(())
}
