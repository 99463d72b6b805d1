//! Learned perceptual distance of two pictures (Zhang et al. 2018, LPIPS 0.1): `Σ_l mean_xy w_l · (â_l − b̂_l)²`, where `â_l` are the
//! features of AlexNet or VGG16 after five of their layers, of length 1 at each pixel. The weights are the user's.

use diorama_geom::Image;
use diorama_kernels::gemm::{self, Init, Precision, View};
use rayon::prelude::*;

/// A named tensor: name, shape, values row by row.
pub type NamedTensor = (String, Vec<usize>, Vec<f32>);

/// A convolution with ReLU, after a maximum where there is one.
#[derive(Clone, Copy)]
struct Layer {
    /// Number among torchvision's `features`.
    index: usize,
    /// Edge of the window whose maximum is taken first, in steps of 2; 0: none.
    pool: usize,
    kernel: usize,
    stride: usize,
    pad: usize,
    /// Channels in and out.
    channels: (usize, usize),
    /// Whether the distance takes its features.
    is_tap: bool,
}

const fn layer(index: usize, pool: usize, (kernel, stride, pad): (usize, usize, usize), channels: (usize, usize), is_tap: bool) -> Layer {
    Layer { index, pool, kernel, stride, pad, channels, is_tap }
}

const SMALL: (usize, usize, usize) = (3, 1, 1);

const ALEXNET: &[Layer] = &[
    layer(0, 0, (11, 4, 2), (3, 64), true),
    layer(3, 3, (5, 1, 2), (64, 192), true),
    layer(6, 3, SMALL, (192, 384), true),
    layer(8, 0, SMALL, (384, 256), true),
    layer(10, 0, SMALL, (256, 256), true),
];

const VGG16: &[Layer] = &[
    layer(0, 0, SMALL, (3, 64), false),
    layer(2, 0, SMALL, (64, 64), true),
    layer(5, 2, SMALL, (64, 128), false),
    layer(7, 0, SMALL, (128, 128), true),
    layer(10, 2, SMALL, (128, 256), false),
    layer(12, 0, SMALL, (256, 256), false),
    layer(14, 0, SMALL, (256, 256), true),
    layer(17, 2, SMALL, (256, 512), false),
    layer(19, 0, SMALL, (512, 512), false),
    layer(21, 0, SMALL, (512, 512), true),
    layer(24, 2, SMALL, (512, 512), false),
    layer(26, 0, SMALL, (512, 512), false),
    layer(28, 0, SMALL, (512, 512), true),
];

/// Mean and spread of the pictures that the networks were trained on, for values in [−1, 1].
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Keeps features of no length finite.
const EPSILON: f32 = 1e-10;
/// Pixels whose neighborhoods are laid out at once.
const PIXELS: usize = 256;

/// What a tensor's name stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    Weight(usize),
    Bias(usize),
    Head(usize),
}

/// Names as in torchvision (`features.0.weight`) and in the Python package `lpips` (`net.slice1.0.weight`, `lin0.model.1.weight`).
fn part(name: &str) -> Option<Part> {
    let name = name.strip_prefix("module.").unwrap_or(name);
    if let Some(head) = name.strip_prefix("lins.").or(name.strip_prefix("lin")) {
        let (k, rest) = head.split_once('.')?;
        return (rest == "model.1.weight" || rest == "weight").then_some(Part::Head(k.parse().ok()?));
    }
    let name = name.strip_prefix("net.").unwrap_or(name);
    let (block, rest) = name.split_once('.')?;
    let (index, kind) = rest.split_once('.')?;
    if block != "features" && !block.starts_with("slice") {
        return None;
    }
    match kind {
        "weight" => Some(Part::Weight(index.parse().ok()?)),
        "bias" => Some(Part::Bias(index.parse().ok()?)),
        _ => None,
    }
}

/// Whether a tensor of this name is part of the distance.
pub fn is_wanted(name: &str) -> bool {
    part(name).is_some()
}

/// One convolution, ready to be computed.
struct Convolution {
    layer: Layer,
    /// `[kernel, kernel, in, out]`
    weights: Vec<f32>,
    bias: Vec<f32>,
    /// Weights of the squared differences, of a tap.
    head: Vec<f32>,
}

/// A network with the heads that weigh its features.
pub struct Lpips {
    name: &'static str,
    convolutions: Vec<Convolution>,
}

/// Features of a picture, `[H, W, C]`.
struct Features {
    width: usize,
    height: usize,
    channels: usize,
    data: Vec<f32>,
}

impl Lpips {
    /// Takes the tensors of AlexNet's or VGG16's convolutions and of the linear heads; others are left.
    ///
    /// # Errors
    /// A line that says what is missing or has another shape.
    pub fn new(tensors: Vec<NamedTensor>) -> Result<Lpips, String> {
        let mut parts: Vec<(Part, NamedTensor)> = tensors.into_iter().filter_map(|t| Some((part(&t.0)?, t))).collect();
        let first = parts.iter().find(|(p, _)| *p == Part::Weight(0)).map(|(_, t)| t.1.clone());
        let (name, layers) = match first.as_deref() {
            Some([64, 3, 11, 11]) => ("AlexNet", ALEXNET),
            Some([64, 3, 3, 3]) => ("VGG16", VGG16),
            Some(other) => {
                return Err(format!("the first convolution is {other:?}: neither AlexNet's [64, 3, 11, 11] nor VGG16's [64, 3, 3, 3]"));
            }
            None if parts.is_empty() => return Err("no tensor of AlexNet, VGG16 or LPIPS (features.0.weight, lin0.model.1.weight)".into()),
            None => {
                return Err("only the linear heads: the network itself is missing (features.0.weight …); give both files, \
                            separated by a comma: torchvision's alexnet or vgg16, and the heads"
                    .into());
            }
        };
        if !parts.iter().any(|(p, _)| matches!(p, Part::Head(_))) {
            return Err(format!(
                "holds {name} without the linear heads of LPIPS (lin0.model.1.weight …); give both files, separated by a comma: \
                 the heads are in the Python package lpips, weights/v0.1"
            ));
        }
        let mut take = |wanted: Part, shape: &[usize]| {
            let i = parts.iter().position(|(p, _)| *p == wanted).ok_or_else(|| format!("{wanted:?} of {name} is missing"))?;
            let (_, (named, found, values)) = parts.swap_remove(i);
            if found != shape || values.len() != shape.iter().product::<usize>() {
                return Err(format!("{named} is {found:?} where {name} has {shape:?}"));
            }
            if values.iter().any(|v| !v.is_finite()) {
                return Err(format!("{named} holds numbers that are not finite"));
            }
            Ok(values)
        };
        let mut convolutions = Vec::new();
        for l in layers {
            let (n, k, tap) = (l.channels, l.kernel, convolutions.iter().filter(|c: &&Convolution| c.layer.is_tap).count());
            let given = take(Part::Weight(l.index), &[n.1, n.0, k, k])?;
            let mut weights = vec![0.0; given.len()];
            for (i, w) in given.iter().enumerate() {
                let (x, y, from, to) = (i % k, i / k % k, i / (k * k) % n.0, i / (k * k * n.0));
                weights[((y * k + x) * n.0 + from) * n.1 + to] = *w;
            }
            let bias = take(Part::Bias(l.index), &[n.1])?;
            let head = if l.is_tap { take(Part::Head(tap), &[1, n.1, 1, 1])? } else { Vec::new() };
            convolutions.push(Convolution { layer: *l, weights, bias, head });
        }
        Ok(Lpips { name, convolutions })
    }

    /// `AlexNet` or `VGG16`.
    pub fn network(&self) -> &'static str {
        self.name
    }

    /// The distance of two pictures of equal size in sRGB, `[H, W, 3]`; values outside of [0, 1] count as the nearest within.
    ///
    /// # Errors
    /// When the pictures are too small for the network.
    ///
    /// # Panics
    /// When their sizes differ.
    pub fn distance(&self, a: &Image, b: &Image) -> Result<f64, String> {
        assert_eq!((a.width, a.height, a.channels, b.channels), (b.width, b.height, 3, 3), "LPIPS");
        let mut pair = [scaled(a), scaled(b)];
        let mut sum = 0.0;
        for c in &self.convolutions {
            for f in &mut pair {
                if c.layer.pool > 0 {
                    *f = f.pooled(c.layer.pool).ok_or_else(|| self.too_small(a))?;
                }
                *f = c.of(f).ok_or_else(|| self.too_small(a))?;
            }
            if c.layer.is_tap {
                sum += weighted_difference(&pair[0], &pair[1], &c.head);
            }
        }
        Ok(sum)
    }

    fn too_small(&self, im: &Image) -> String {
        format!("LPIPS with {}: {} x {} pixels are too few; 32 x 32 are enough", self.name, im.width, im.height)
    }
}

fn scaled(im: &Image) -> Features {
    let value = |(i, v): (usize, &f32)| (2.0 * v.clamp(0.0, 1.0) - 1.0 - SHIFT[i % 3]) / SCALE[i % 3];
    Features { width: im.width, height: im.height, channels: 3, data: im.data.iter().enumerate().map(value).collect() }
}

impl Features {
    /// The maximum of each window of `size` pixels' edge, two apart; none where the picture is smaller.
    fn pooled(&self, size: usize) -> Option<Features> {
        let (w, h, c) = (self.width.checked_sub(size)? / 2 + 1, self.height.checked_sub(size)? / 2 + 1, self.channels);
        let mut data = vec![f32::NEG_INFINITY; w * h * c];
        data.par_chunks_mut(w * c).enumerate().for_each(|(y, row)| {
            for (x, out) in row.chunks_exact_mut(c).enumerate() {
                for (dy, dx) in (0..size * size).map(|k| (k / size, k % size)) {
                    let at = ((2 * y + dy) * self.width + 2 * x + dx) * c;
                    out.iter_mut().zip(&self.data[at..at + c]).for_each(|(o, v)| *o = o.max(*v));
                }
            }
        });
        Some(Features { width: w, height: h, channels: c, data })
    }
}

impl Convolution {
    /// `relu(weights ∗ f + bias)`: neighborhoods as rows of a matrix, times the weights; none where the picture is too small.
    fn of(&self, f: &Features) -> Option<Features> {
        let Layer { kernel, stride, pad, channels: (from, to), .. } = self.layer;
        let size = |n: usize| Some((n + 2 * pad).checked_sub(kernel)? / stride + 1);
        let (w, h) = (size(f.width)?, size(f.height)?);
        let depth = kernel * kernel * from;
        let mut data = vec![0.0; w * h * to];
        data.par_chunks_mut(PIXELS * to).enumerate().for_each_init(Vec::new, |rows, (part, out)| {
            let n = out.len() / to;
            rows.clear();
            rows.resize(n * depth, 0.0);
            for (i, row) in rows.chunks_exact_mut(depth).enumerate() {
                let p = part * PIXELS + i;
                for ky in 0..kernel {
                    let Some(y) = (p / w * stride + ky).checked_sub(pad).filter(|y| *y < f.height) else { continue };
                    for kx in 0..kernel {
                        let Some(x) = (p % w * stride + kx).checked_sub(pad).filter(|x| *x < f.width) else { continue };
                        let (at, to) = ((y * f.width + x) * from, (ky * kernel + kx) * from);
                        row[to..to + from].copy_from_slice(&f.data[at..at + from]);
                    }
                }
            }
            let a = View::rows(rows, depth);
            gemm::gemm(
                Precision::F32,
                gemm::Gemm { m: n, n: to, k: depth, a, b: &self.weights, ldb: to, ldc: to, init: Init::Bias(&self.bias), relu: true },
                out,
            );
        });
        Some(Features { width: w, height: h, channels: to, data })
    }
}

/// Mean over the pixels of `Σ_c head_c (â_c − b̂_c)²`.
fn weighted_difference(a: &Features, b: &Features, head: &[f32]) -> f64 {
    let c = a.channels;
    let length = |p: &[f32]| p.iter().map(|v| v * v).sum::<f32>().sqrt() + EPSILON;
    let at = |(p, q): (&[f32], &[f32])| {
        let (lp, lq) = (length(p), length(q));
        p.iter().zip(q).zip(head).map(|((p, q), w)| w * (p / lp - q / lq).powi(2)).sum::<f32>() as f64
    };
    a.data.chunks_exact(c).zip(b.data.chunks_exact(c)).map(at).sum::<f64>() / (a.width * a.height) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers in [0, 1) by (stream, counter), as in benches/peers/lpips_reference.py.
    fn unit(stream: u64, n: usize) -> impl Iterator<Item = f64> {
        (0..n as u64).map(move |i| {
            let mut x = i.wrapping_add(stream.wrapping_mul(0x9e37_79b9_7f4a_7c15));
            for by in [0xbf58_476d_1ce4_e5b9u64, 0x94d0_49bb_1331_11eb] {
                x = (x ^ (x >> 29)).wrapping_mul(by);
            }
            x ^= x >> 32;
            (x >> 40) as f64 / 16_777_216.0
        })
    }

    fn random(name: String, stream: u64, shape: &[usize], low: f64, high: f64) -> NamedTensor {
        let values = unit(stream, shape.iter().product()).map(|u| (low + (high - low) * u) as f32).collect();
        (name, shape.to_vec(), values)
    }

    /// A network and heads of the generator's numbers.
    fn weights(layers: &[Layer]) -> Vec<NamedTensor> {
        let mut out = Vec::new();
        for l in layers {
            let (n, k) = (l.channels, l.kernel);
            let bound = (6.0 / (n.0 * k * k) as f64).sqrt();
            let next = out.len() as u64 + 1;
            out.push(random(format!("net.slice1.{}.weight", l.index), next, &[n.1, n.0, k, k], -bound, bound));
            out.push(random(format!("net.slice1.{}.bias", l.index), next + 1, &[n.1], -0.05, 0.05));
        }
        for (i, l) in layers.iter().filter(|l| l.is_tap).enumerate() {
            out.push(random(format!("lin{i}.model.1.weight"), out.len() as u64 + 1, &[1, l.channels.1, 1, 1], 0.0, 1.0));
        }
        out
    }

    /// A gradient with noise.
    fn picture(stream: u64, share: f32) -> Image {
        let data = unit(stream, 3 * 48 * 64).enumerate().map(|(i, noise)| {
            let (x, y) = ((i / 3 % 64) as f32 / 64.0, (i / 192) as f32 / 48.0);
            0.8 * [x, y, 0.5 * (x + y)][i % 3] + share * noise as f32
        });
        Image { width: 64, height: 48, channels: 3, data: data.collect() }
    }

    #[test]
    fn distances_are_those_of_the_reference_package() {
        let (a, b) = (picture(100, 0.05), picture(101, 0.2));
        // By benches/peers/lpips_reference.py: lpips 0.1.4.
        for (layers, expected) in [(ALEXNET, 0.312_101_870_8), (VGG16, 0.243_961_110_7)] {
            let net = Lpips::new(weights(layers)).unwrap();
            let found = net.distance(&a, &b).unwrap();
            assert!((found - expected).abs() <= 1e-4, "{}: {found} {expected}", net.network());
            assert!((net.distance(&b, &a).unwrap() - found).abs() < 1e-6);
            assert_eq!(net.distance(&a, &a).unwrap(), 0.0);
        }
    }

    #[test]
    fn what_is_missing_is_named() {
        let all = weights(ALEXNET);
        let without = |what: &str| Lpips::new(all.iter().filter(|t| !t.0.contains(what)).cloned().collect()).err().unwrap();
        assert!(without("lin").contains("holds AlexNet without the linear heads"));
        assert!(without("net.").contains("the network itself is missing"));
        assert!(without("lin3").contains("Head(3)"));
        assert!(without("slice1.6.bias").contains("Bias(6)"));
        assert!(Lpips::new(Vec::new()).err().unwrap().contains("no tensor of"));
        let mut other = all.clone();
        other[2].1 = vec![192, 64, 3, 3];
        assert!(Lpips::new(other).err().unwrap().contains("[192, 64, 3, 3]"));
        let mut broken = all;
        broken[1].2[3] = f32::NAN;
        assert!(Lpips::new(broken).err().unwrap().contains("not finite"));
    }

    #[test]
    fn names_of_torchvision_and_of_the_package_are_known() {
        for (name, wanted) in [
            ("features.10.bias", Some(Part::Bias(10))),
            ("net.slice3.6.weight", Some(Part::Weight(6))),
            ("lin4.model.1.weight", Some(Part::Head(4))),
            ("lins.2.model.1.weight", Some(Part::Head(2))),
            ("classifier.1.weight", None),
            ("scaling_layer.shift", None),
            ("linear.weight", None),
        ] {
            assert_eq!(part(name), wanted, "{name}");
        }
    }

    #[test]
    fn pictures_that_are_too_small_are_refused() {
        let net = Lpips::new(weights(ALEXNET)).unwrap();
        let tiny = Image::zeros(20, 40, 3);
        assert!(net.distance(&tiny, &tiny).unwrap_err().contains("20 x 40"));
    }
}
