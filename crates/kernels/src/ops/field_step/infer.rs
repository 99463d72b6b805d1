//! Density and color of a hash-grid field without gradients. Both run on the calling thread: callers are parallel over
//! blocks of samples that stay in cache. On CPUs with bf16 tiles, features and activations stay in tile form from the
//! table to the color.

use super::{FieldNet, Output};
#[cfg(target_arch = "x86_64")]
use crate::amx_chain::Chain;
use crate::gemm::Precision;
#[cfg(target_arch = "x86_64")]
use crate::gemm::amx::Line;
use crate::ops::fused_mlp::cpu::{Activations, forward_block};
use crate::ops::fused_mlp::{Head, Layer, Mlp, Source};
use crate::ops::hash_grid::{self, HashGrid};
use crate::ops::linear::{self, Activation};

/// Rows per block of a network that runs layer by layer.
const BLOCK: usize = 256;

/// A field's parameters, split into the layers that read positions alone and those that color reads besides.
pub struct Inference<'a> {
    grid: &'a HashGrid,
    table: &'a [f32],
    sigma: Head,
    rgb: Head,
    density: Part<'a>,
    color: Part<'a>,
    #[cfg(target_arch = "x86_64")]
    tiles: Option<(Chain, Chain)>,
}

/// Some consecutive layers of a network.
struct Part<'a> {
    mlp: Mlp,
    params: &'a [f32],
}

/// Buffers that are reused between calls.
#[derive(Default)]
pub struct InferBuffers {
    points: Vec<f32>,
    features: Vec<f32>,
    rows: Vec<f32>,
    raw: Vec<f32>,
    acts: Activations,
    #[cfg(target_arch = "x86_64")]
    lines: Vec<Line>,
}

/// Codes of rays that the color layers read: values `[R, width]`.
pub type Codes<'a> = (&'a [f32], usize);

impl<'a> Inference<'a> {
    /// None where color reads more than the outputs of the density head's layer and codes of rays, or is not all that is composited.
    pub fn new(grid: &'a HashGrid, table: &'a [f32], net: &'a FieldNet, params: &'a [f32]) -> Option<Self> {
        let all = &net.mlp;
        let cut = net.density.layer + 1;
        let &[Output { head: rgb, channels: 3, are_shares: false }] = &net.outputs[..] else { return None };
        if rgb.layer < cut || rgb.layer + 1 != all.layers.len() || all.layers.iter().any(|l| l.modulation.is_some()) {
            return None;
        }
        let density = Mlp::new(all.input_widths[..1].to_vec(), all.layers[..cut].to_vec());
        // Input 0 of the color layers are the geometry features, which the density head's layer gives.
        let source = |s: &Source| match *s {
            Source::Layer(j) if j + 1 == cut => Some(Source::Input(0)),
            Source::Layer(j) => j.checked_sub(cut).map(Source::Layer),
            Source::Input(0) => None,
            Source::Input(i) => Some(Source::Input(i)),
        };
        let layers =
            all.layers[cut..].iter().map(|l| Some(Layer { inputs: l.inputs.iter().map(source).collect::<Option<_>>()?, ..l.clone() }));
        let widths = [all.layers[cut - 1].width].into_iter().chain(all.input_widths[1..].iter().copied());
        let color = Mlp::new(widths.collect(), layers.collect::<Option<_>>()?);
        let part = |mlp: Mlp, first: usize| Part {
            params: &params[first..first + mlp.params_len()],
            mlp: Mlp { precision: all.precision, ..mlp },
        };
        let (density, color) = (part(density, 0), part(color, all.offsets[cut]));
        #[cfg(target_arch = "x86_64")]
        let tiles =
            if all.precision == Precision::Bf16 && hash_grid::cpu::has_lines(grid) { density.chain().zip(color.chain()) } else { None };
        Some(Inference {
            grid,
            table,
            sigma: net.density,
            rgb: Head { layer: rgb.layer - cut, ..rgb },
            density,
            color,
            #[cfg(target_arch = "x86_64")]
            tiles,
        })
    }

    /// Numbers per sample that [`Inference::density`] gives and [`Inference::color`] reads.
    pub fn geometry_width(&self) -> usize {
        self.color.mlp.input_widths[0]
    }

    /// Densities `[n]` and geometry features `[n, G]` of points in `[0, 1]³`, given by coordinate.
    ///
    /// # Panics
    /// When the coordinates are not of one length.
    pub fn density(&self, points: &[Vec<f32>; 3], sigma: &mut Vec<f32>, geometry: &mut Vec<f32>, buf: &mut InferBuffers) {
        let (n, width) = (points[0].len(), self.geometry_width());
        assert!(points.iter().all(|p| p.len() == n), "field: points");
        sigma.resize(n, 0.0);
        geometry.resize(n * width, 0.0);
        self.geometry(points, geometry, buf);
        for (s, g) in sigma.iter_mut().zip(geometry.chunks_exact(width)) {
            *s = g[self.sigma.channel] + self.sigma.shift;
        }
        linear::cpu::activate(self.sigma.activation, sigma);
    }

    fn geometry(&self, points: &[Vec<f32>; 3], out: &mut [f32], buf: &mut InferBuffers) {
        let n = points[0].len();
        #[cfg(target_arch = "x86_64")]
        if let Some((chain, _)) = &self.tiles {
            // The last group of sixteen is filled up with zeros.
            let whole = n / 16 * 16;
            fit(&mut buf.lines, chain.input_lines(n));
            let [x, y, z] = points;
            hash_grid::cpu::forward_lines(self.grid, [&x[..whole], &y[..whole], &z[..whole]], self.table, &mut buf.lines);
            if whole < n {
                let mut rest = [[0.0; 16]; 3];
                rest.iter_mut().zip(points).for_each(|(r, p)| r[..n - whole].copy_from_slice(&p[whole..]));
                let [x, y, z] = &rest;
                hash_grid::cpu::forward_lines(self.grid, [x, y, z], self.table, &mut buf.lines[whole..]);
            }
            return chain.run(&buf.lines, n, out);
        }
        let (f, dims) = (self.grid.config.features, self.grid.output_dims());
        buf.points.clear();
        buf.points.extend((0..n).flat_map(|i| [points[0][i], points[1][i], points[2][i]]));
        buf.features.resize(n * dims, 0.0);
        hash_grid::cpu::forward_serial(self.grid, &buf.points, self.table, &mut buf.features);
        buf.rows.resize(n * dims, 0.0);
        for (l, level) in buf.features.chunks_exact((n * f).max(1)).enumerate() {
            for (row, v) in buf.rows.chunks_exact_mut(dims).zip(level.chunks_exact(f)) {
                row[l * f..(l + 1) * f].copy_from_slice(v);
            }
        }
        let width = self.geometry_width();
        for first in (0..n).step_by(BLOCK) {
            let last = (first + BLOCK).min(n);
            forward_block(&self.density.mlp, self.density.params, &[&buf.rows[first * dims..last * dims]], last - first, &mut buf.acts);
            out[first * width..last * width].copy_from_slice(&buf.acts.values[self.sigma.layer][..(last - first) * width]);
        }
    }

    /// Colors `[n, 3]` of samples with geometry features `[n, G]`, each on the ray of `rays` `[n]`.
    ///
    /// # Panics
    /// When the codes are not those that the network reads.
    pub fn color(&self, geometry: &[f32], rays: &[u32], codes: &[Codes], out: &mut Vec<f32>, buf: &mut InferBuffers) {
        let (n, widths) = (rays.len(), &self.color.mlp.input_widths);
        assert!(codes.len() + 1 == widths.len() && codes.iter().zip(&widths[1..]).all(|(c, w)| c.1 == *w), "field: codes");
        assert_eq!(geometry.len(), n * widths[0], "field: geometry");
        out.resize(n * 3, 0.0);
        let raw_width = self.color.mlp.layers[self.rgb.layer].width;
        buf.raw.resize(n * raw_width, 0.0);
        self.raw_color(geometry, rays, codes, buf);
        for (o, v) in out.chunks_exact_mut(3).zip(buf.raw.chunks_exact(raw_width)) {
            for k in 0..3 {
                o[k] = v[self.rgb.channel + k] + self.rgb.shift;
            }
        }
        linear::cpu::activate(self.rgb.activation, out);
    }

    fn raw_color(&self, geometry: &[f32], rays: &[u32], codes: &[Codes], buf: &mut InferBuffers) {
        let (n, g) = (rays.len(), self.geometry_width());
        #[cfg(target_arch = "x86_64")]
        if let Some((_, chain)) = &self.tiles {
            let width: usize = self.color.mlp.input_widths.iter().sum();
            buf.rows.resize(n * width, 0.0);
            for ((row, geometry), &r) in buf.rows.chunks_exact_mut(width).zip(geometry.chunks_exact(g)).zip(rays) {
                let (own, mut rest) = row.split_at_mut(g);
                own.copy_from_slice(geometry);
                for &(values, w) in codes {
                    let (own, tail) = rest.split_at_mut(w);
                    own.copy_from_slice(&values[r as usize * w..(r as usize + 1) * w]);
                    rest = tail;
                }
            }
            fit(&mut buf.lines, chain.input_lines(n));
            chain.pack_rows(&buf.rows, width, n, &mut buf.lines);
            return chain.run(&buf.lines, n, &mut buf.raw);
        }
        let width = self.color.mlp.layers[self.rgb.layer].width;
        for first in (0..n).step_by(BLOCK) {
            let last = (first + BLOCK).min(n);
            let per_sample: Vec<Vec<f32>> = codes
                .iter()
                .map(|&(values, w)| {
                    rays[first..last].iter().flat_map(|&r| &values[r as usize * w..(r as usize + 1) * w]).copied().collect()
                })
                .collect();
            let inputs: Vec<&[f32]> = [&geometry[first * g..last * g]].into_iter().chain(per_sample.iter().map(|v| &v[..])).collect();
            forward_block(&self.color.mlp, self.color.params, &inputs, last - first, &mut buf.acts);
            buf.raw[first * width..last * width].copy_from_slice(&buf.acts.values[self.rgb.layer][..(last - first) * width]);
        }
    }
}

/// Makes room for at least `n` lines.
#[cfg(target_arch = "x86_64")]
fn fit(lines: &mut Vec<Line>, n: usize) {
    if lines.len() < n {
        lines.resize(n, Line::ZERO);
    }
}

#[cfg(target_arch = "x86_64")]
impl Part<'_> {
    /// The layers as tiles, where they follow one another without biases, each but the last with a ReLU, and only the
    /// first reads inputs, all of them in order.
    fn chain(&self) -> Option<Chain> {
        let last = self.mlp.layers.len() - 1;
        let inputs: Vec<Source> = (0..self.mlp.input_widths.len()).map(Source::Input).collect();
        let plain = |(j, l): (usize, &Layer)| {
            let reads = if j == 0 { l.inputs == inputs } else { l.inputs == [Source::Layer(j - 1)] };
            reads && !l.bias && l.activation == if j < last { Activation::Relu } else { Activation::None }
        };
        if !self.mlp.layers.iter().enumerate().all(plain) {
            return None;
        }
        let layers = self.mlp.layers.iter().enumerate().map(|(j, l)| (self.mlp.fan_in(j), l.width, &self.params[self.mlp.offsets[j]..]));
        Chain::new(&layers.collect::<Vec<_>>())
    }
}
