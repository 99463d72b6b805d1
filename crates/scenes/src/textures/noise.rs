//! Noise that repeats on the unit square.

use diorama_geom::rng::Rng;

/// Values and points of a lattice, from a seed.
#[derive(Clone, Copy, Debug)]
pub struct Noise {
    rng: Rng,
}

/// The lattice point closest to a position.
#[derive(Clone, Copy, Debug)]
pub struct Cell {
    /// Distance to the nearest point, in lattice cells.
    pub nearest: f32,
    /// Distance to the second nearest point, in lattice cells.
    pub second: f32,
    pub column: i64,
    pub row: i64,
}

impl Noise {
    /// Noise of a stream of random numbers.
    pub fn new(seed: u64, stream: u64) -> Noise {
        Noise { rng: Rng::new(seed, stream) }
    }

    /// A number in [0, 1) for a lattice point; `channel` tells apart several numbers of one point.
    pub fn value(&self, column: i64, row: i64, channel: u64) -> f32 {
        self.rng.uniform((column as u64 & 0xffff) << 24 | (row as u64 & 0xffff) << 8 | channel)
    }

    /// Smooth noise in [0, 1] on a lattice of `columns × rows`.
    pub fn smooth(&self, u: f32, v: f32, columns: i64, rows: i64, channel: u64) -> f32 {
        let (x, y) = (u * columns as f32, v * rows as f32);
        let (i, j) = (x.floor(), y.floor());
        let fade = |t: f32| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
        let (fx, fy) = (fade(x - i), fade(y - j));
        let at = |di: i64, dj: i64| self.value((i as i64 + di).rem_euclid(columns), (j as i64 + dj).rem_euclid(rows), channel);
        let (top, bottom) = (at(0, 0) + (at(1, 0) - at(0, 0)) * fx, at(0, 1) + (at(1, 1) - at(0, 1)) * fx);
        top + (bottom - top) * fy
    }

    /// Sum of octaves in [0, 1], each with twice the frequency and half the amplitude of the last one.
    pub fn fractal(&self, u: f32, v: f32, columns: i64, rows: i64, octaves: u32) -> f32 {
        let (mut sum, mut total) = (0.0, 0.0);
        for k in 0..octaves {
            let amplitude = 0.5f32.powi(k as i32);
            sum += amplitude * self.smooth(u, v, columns << k, rows << k, k as u64 + 8);
            total += amplitude;
        }
        sum / total
    }

    /// Nearest of the points scattered by `jitter` cells about the centers of a lattice whose odd rows are shifted by half a cell.
    pub fn cell(&self, u: f32, v: f32, n: i64, jitter: f32) -> Cell {
        let (x, y) = (u * n as f32, v * n as f32);
        let mut best = Cell { nearest: f32::MAX, second: f32::MAX, column: 0, row: 0 };
        for dj in -1..=1 {
            for di in -2..=2 {
                let (i, j) = (x.floor() as i64 + di, y.floor() as i64 + dj);
                let (column, row) = (i.rem_euclid(n), j.rem_euclid(n));
                let shift = if row % 2 == 0 { 0.25 } else { 0.75 };
                let px = i as f32 + shift + jitter * (self.value(column, row, 1) - 0.5);
                let py = j as f32 + 0.5 + jitter * (self.value(column, row, 2) - 0.5);
                let d = (x - px).abs().powi(3) + (y - py).abs().powi(3);
                let d = d.cbrt();
                if d < best.nearest {
                    best = Cell { nearest: d, second: best.nearest, column, row };
                } else if d < best.second {
                    best.second = d;
                }
            }
        }
        best
    }
}
