//! A chain of layers on AMX tiles: `y = relu(… relu(x W₀) …) Wₙ`, 32 rows at a time. The activations between two
//! layers stay in tile form, in the first-level cache.

use crate::gemm::amx::{self, BLOCK, K, Line};
use std::arch::x86_64::*;
use std::mem::MaybeUninit;

/// Widest layer, in tiles of 32.
const MOST_TILES: usize = 4;

/// One layer's weights as tiles.
#[derive(Clone, Debug)]
struct Layer {
    lines: Vec<Line>,
    /// Tiles along the inputs, and columns.
    k_tiles: usize,
    columns: usize,
}

/// Weights of a chain, rounded to bf16.
#[derive(Clone, Debug)]
pub struct Chain {
    layers: Vec<Layer>,
}

/// The sums of 2 × 2 tiles.
#[repr(C, align(64))]
struct Sum([f32; BLOCK * BLOCK]);

impl Chain {
    /// Packs the weights `[k, n]` of layers `(k, n, weights)`; none where the CPU has no tiles or a layer is too wide.
    ///
    /// # Panics
    /// When a layer's inputs are not the outputs of the one before it, or weights are missing.
    pub fn new(layers: &[(usize, usize, &[f32])]) -> Option<Chain> {
        let fits = |&(k, n, _): &(usize, usize, &[f32])| k > 0 && n > 0 && k.max(n) <= MOST_TILES * K;
        if !crate::gemm::has_bf16() || layers.is_empty() || !layers.iter().all(fits) {
            return None;
        }
        assert!(layers.windows(2).all(|w| w[0].1 == w[1].0), "chain: widths");
        let pack = |&(k, n, weights): &(usize, usize, &[f32])| {
            assert!(weights.len() >= k * n, "chain: weights");
            let k_tiles = k.div_ceil(K);
            let mut lines = vec![Line::ZERO; n.div_ceil(BLOCK) * 2 * k_tiles * 16];
            // SAFETY: the CPU has the instructions; `lines` holds the tiles of n columns.
            unsafe { amx::pack_weights(k, n, weights, &mut lines) };
            Layer { lines, k_tiles, columns: n }
        };
        Some(Chain { layers: layers.iter().map(pack).collect() })
    }

    /// Tiles of a row of the chain's input.
    pub fn input_tiles(&self) -> usize {
        self.layers[0].k_tiles
    }

    /// Number of tile lines that hold `n` rows of input.
    pub fn input_lines(&self, n: usize) -> usize {
        n.next_multiple_of(BLOCK) * self.input_tiles()
    }

    /// Columns of the chain's output.
    pub fn columns(&self) -> usize {
        self.layers.last().map_or(0, |l| l.columns)
    }

    /// Writes `n` rows of `width` numbers to input lines and fills the rest with zeros.
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn pack_rows(&self, rows: &[f32], width: usize, n: usize, lines: &mut [Line]) {
        let kt = self.input_tiles();
        assert!(rows.len() >= n * width && lines.len() >= self.input_lines(n) && width.div_ceil(K) == kt, "chain: rows");
        // SAFETY: a chain exists only where the CPU has the instructions; lengths were asserted.
        unsafe { amx::pack_lines(rows, width, n, kt, lines) };
    }

    /// The last layer's output `[n, columns]`.
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn run(&self, lines: &[Line], n: usize, out: &mut [f32]) {
        assert!(lines.len() >= self.input_lines(n) && out.len() >= n * self.columns(), "chain: shapes");
        // SAFETY: a chain exists only where the CPU has the instructions; lengths were asserted.
        unsafe {
            amx::with_tiles(|| {
                for first in (0..n).step_by(BLOCK) {
                    let a = lines.as_ptr().add(first * self.input_tiles());
                    self.block(a, BLOCK.min(n - first), out[first * self.columns()..].as_mut_ptr());
                }
            });
        }
    }

    /// Takes 32 rows through all layers and writes the first `rows` of the results.
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn block(&self, input: *const Line, rows: usize, out: *mut f32) {
        // What is read of either was written before.
        let mut between = [MaybeUninit::<[Line; 2 * MOST_TILES * 16]>::uninit(), MaybeUninit::uninit()];
        let mut sum = MaybeUninit::<Sum>::uninit();
        let sum = sum.as_mut_ptr().cast::<f32>();
        let mut a = input;
        let last = self.layers.len() - 1;
        for (l, layer) in self.layers.iter().enumerate() {
            let next = between[l % 2].as_mut_ptr().cast::<Line>();
            let next_tiles = layer.columns.div_ceil(K);
            for j in (0..layer.columns).step_by(BLOCK) {
                // SAFETY: `a` holds 2 · k_tiles tiles, the weights as many for these columns; `next` holds
                // 2 · next_tiles tiles, and `out` `rows` rows of the last layer's columns.
                unsafe {
                    amx::sum_tiles(a, layer.lines.as_ptr().add(j / 16 * layer.k_tiles * 16), layer.k_tiles, sum);
                    if l == last {
                        write(sum, rows, layer.columns - j, layer.columns, out.add(j));
                    } else {
                        store_as_input(sum, next.add(j / BLOCK * 16), next_tiles);
                    }
                }
            }
            a = next;
        }
    }
}

/// Rounds `relu(sum)` to the tiles of the next layer's input.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn store_as_input(sum: *const f32, next: *mut Line, tiles: usize) {
    let zero = _mm512_setzero_ps();
    for r in 0..BLOCK {
        // SAFETY: 32 rows of 32 sums; row r of either tile, see the caller.
        unsafe {
            let lo = _mm512_max_ps(_mm512_loadu_ps(sum.add(r * BLOCK)), zero);
            let hi = _mm512_max_ps(_mm512_loadu_ps(sum.add(r * BLOCK + 16)), zero);
            let both = std::mem::transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(hi, lo));
            _mm512_store_si512(next.add(r / 16 * tiles * 16 + r % 16).cast(), both);
        }
    }
}

/// Copies up to 32 columns of `rows` sums into rows of `width`.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn write(sum: *const f32, rows: usize, columns: usize, width: usize, out: *mut f32) {
    for half in 0..2 {
        let left = columns.saturating_sub(16 * half);
        if left == 0 {
            return;
        }
        let mask = if left >= 16 { u16::MAX } else { (1u16 << left) - 1 };
        for r in 0..rows {
            // SAFETY: masked to the columns that there are, see the caller.
            unsafe {
                _mm512_mask_storeu_ps(out.wrapping_add(r * width + 16 * half), mask, _mm512_loadu_ps(sum.add(r * BLOCK + 16 * half)))
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gemm::Precision;
    use crate::ops::fused_mlp::Mlp;
    use crate::ops::fused_mlp::cpu::{Activations, forward_block};
    use diorama_geom::rng::Rng;
    use diorama_testkit::random;

    #[test]
    fn a_chain_equals_its_layers_one_by_one() {
        if !crate::gemm::has_bf16() {
            println!("no bf16 tiles here");
            return;
        }
        for (inputs, widths) in [(32, vec![64, 16]), (40, vec![64, 64, 16]), (7, vec![5]), (128, vec![100, 33, 3])] {
            let mlp = Mlp { precision: Precision::Bf16, ..Mlp::chain(vec![inputs], &widths, false) };
            let params = mlp.init(&Rng::new(1, 1));
            let layers: Vec<_> = (0..widths.len()).map(|j| (mlp.fan_in(j), widths[j], &params[mlp.offsets[j]..])).collect();
            let chain = Chain::new(&layers).expect("tiles");
            for n in [0, 1, 31, 32, 75] {
                let x = random(n * inputs, 2);
                let mut acts = Activations::default();
                forward_block(&mlp, &params, &[&x], n, &mut acts);
                let columns = *widths.last().unwrap();
                let want = &acts.values[widths.len() - 1][..n * columns];
                let mut lines = vec![Line::ZERO; chain.input_lines(n)];
                chain.pack_rows(&x, inputs, n, &mut lines);
                let mut got = vec![9.0; n * columns];
                chain.run(&lines, n, &mut got);
                for (g, w) in got.iter().zip(want) {
                    assert!((g - w).abs() <= 1e-5 * w.abs().max(1.0), "{inputs} {widths:?} {n}: {g} {w}");
                }
            }
        }
        assert!(Chain::new(&[(200, 16, &[0.0; 3200])]).is_none(), "wider than the scratch");
    }
}
