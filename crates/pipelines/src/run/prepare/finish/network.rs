//! Runs a segmentation network that the user gives, such as U²-Net: from one image to a mask of the salient object.

use crate::error::{PipelineError, Result};
use diorama_geom::ImageU8;
use std::path::{Path, PathBuf};
use tract_onnx::prelude::*;

/// Mean and standard deviation of ImageNet's RGB values, which normalize the input.
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
/// Edge of the input in pixels, if the network does not fix it.
const EDGE: usize = 320;

/// A loaded network.
pub struct Network {
    file: PathBuf,
    edge: usize,
    run: Box<dyn Fn(Tensor) -> TractResult<Tensor> + Send + Sync>,
}

impl Network {
    /// Reads a network whose first input is `[1, 3, S, S]`; its first output is the mask.
    ///
    /// # Errors
    /// When the file is not an ONNX network that can run here, or takes another input.
    pub fn open(file: &Path) -> Result<Network> {
        let wrong = |e: TractError| PipelineError::Usage(format!("--remove-background {}: cannot be run ({e:#})", file.display()));
        let model = tract_onnx::onnx().model_for_path(file).map_err(wrong)?;
        let shape = model.input_fact(0).map_err(wrong)?.shape.as_concrete_finite().map_err(wrong)?;
        let edge = match shape.as_deref() {
            Some(&[1, 3, h, w]) if h == w => h,
            None => EDGE,
            Some(s) => {
                return Err(PipelineError::Usage(format!(
                    "--remove-background {}: takes {s:?}, expected one picture [1, 3, S, S]",
                    file.display()
                )));
            }
        };
        let model = model
            .with_input_fact(0, f32::fact([1, 3, edge, edge]).into())
            .and_then(|m| m.into_optimized())
            .and_then(|m| m.into_runnable())
            .map_err(wrong)?;
        let run = move |picture: Tensor| Ok(model.run(tvec!(picture.into()))?.remove(0).into_tensor());
        Ok(Network { file: file.to_path_buf(), edge, run: Box::new(run) })
    }

    /// Opacity of each pixel, `[height, width]`.
    ///
    /// # Errors
    /// When the network fails, or its output is not a mask `[1, 1, H, W]` or `[1, H, W]`.
    pub fn alpha(&self, image: &ImageU8) -> Result<Vec<u8>> {
        let s = self.edge;
        let small = if image.width >= s && image.height >= s { image.downsampled(s, s) } else { enlarged(image, s) };
        let value = |i: usize| {
            let (k, at) = (i / (s * s), i % (s * s));
            (small.data[at * small.channels + k] as f32 / 255.0 - MEAN[k]) / DEVIATION[k]
        };
        let values: Vec<f32> = (0..3 * s * s).map(value).collect();
        let failed = |e: TractError| PipelineError::Usage(format!("--remove-background {}: {e:#}", self.file.display()));
        let picture = Tensor::from_shape(&[1, 3, s, s], &values).map_err(failed)?;
        let out = (self.run)(picture).map_err(failed)?;
        let (h, w) = match out.shape() {
            [1, 1, h, w] | [1, h, w] => (*h, *w),
            shape => {
                return Err(PipelineError::Usage(format!(
                    "--remove-background {}: gives {shape:?}, expected a mask [1, 1, H, W]",
                    self.file.display()
                )));
            }
        };
        let mask = out.cast_to::<f32>().map_err(failed)?;
        let mask = mask.to_plain_array_view::<f32>().map_err(failed)?;
        let mask: Vec<f32> = mask.iter().copied().collect();
        // Networks without a final sigmoid are recognized by values outside [0, 1].
        let (lo, hi) = mask.iter().fold((f32::MAX, f32::MIN), |(a, b), v| (a.min(*v), b.max(*v)));
        let open = lo < -0.01 || hi > 1.01;
        let unit = |v: f32| if open { 1.0 / (1.0 + (-v).exp()) } else { v };
        let at = |x: f32, y: f32| {
            let (x, y) = (x.clamp(0.0, (w - 1) as f32), y.clamp(0.0, (h - 1) as f32));
            let (x0, y0) = (x as usize, y as usize);
            let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
            let (fx, fy) = (x - x0 as f32, y - y0 as f32);
            let row = |y: usize| unit(mask[y * w + x0]) * (1.0 - fx) + unit(mask[y * w + x1]) * fx;
            row(y0) * (1.0 - fy) + row(y1) * fy
        };
        let (sx, sy) = (w as f32 / image.width as f32, h as f32 / image.height as f32);
        let pixel = |i: usize| {
            let (x, y) = ((i % image.width) as f32 + 0.5, (i / image.width) as f32 + 0.5);
            (at(x * sx - 0.5, y * sy - 0.5).clamp(0.0, 1.0) * 255.0 + 0.5) as u8
        };
        Ok((0..image.width * image.height).map(pixel).collect())
    }
}

/// Resizes an image to `edge × edge` by nearest neighbor.
fn enlarged(image: &ImageU8, edge: usize) -> ImageU8 {
    let c = image.channels;
    let data = (0..edge * edge).flat_map(|i| image.pixel(i % edge * image.width / edge, i / edge * image.height / edge)).copied().collect();
    ImageU8 { width: edge, height: edge, channels: c, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A network that takes the mean of the channels: one 1 × 1 convolution, in ONNX's protobuf.
    fn mean_of_channels(edge: u8) -> Vec<u8> {
        let field = |number: u8, bytes: &[u8]| [&[number << 3 | 2, bytes.len() as u8][..], bytes].concat();
        let number = |number: u8, v: u8| vec![number << 3, v];
        let value = |name: &str, dims: &[u8]| {
            let dims: Vec<u8> = dims.iter().flat_map(|d| field(1, &number(1, *d))).collect();
            let tensor = [number(1, 1), field(2, &dims)].concat();
            field(1, name.as_bytes()).into_iter().chain(field(2, &field(1, &tensor))).collect::<Vec<u8>>()
        };
        let weights: Vec<u8> = [1.0f32 / 3.0; 3].iter().flat_map(|v| v.to_le_bytes()).collect();
        let weight = [number(1, 1), number(1, 3), number(1, 1), number(1, 1), number(2, 1), field(8, b"w"), field(9, &weights)].concat();
        let node = [field(1, b"x"), field(1, b"w"), field(2, b"y"), field(4, b"Conv")].concat();
        let input = value("x", &[1, 3, edge, edge]);
        let output = value("y", &[1, 1, edge, edge]);
        let graph = [field(1, &node), field(2, b"g"), field(5, &weight), field(11, &input), field(12, &output)].concat();
        let long = |number: u8, bytes: &[u8]| {
            let n = bytes.len();
            [&[number << 3 | 2, (n & 127) as u8 | 128, (n >> 7) as u8][..], bytes].concat()
        };
        [number(1, 8), long(7, &graph), field(8, &number(2, 13))].concat()
    }

    #[test]
    fn a_network_gives_the_mask_of_a_picture() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("mean.onnx");
        std::fs::write(&file, mean_of_channels(32)).unwrap();
        let network = Network::open(&file).unwrap();
        let data = (0..64 * 48).flat_map(|i| if i % 64 < 32 { [255; 3] } else { [0; 3] }).collect();
        let alpha = network.alpha(&ImageU8 { width: 64, height: 48, channels: 3, data }).unwrap();
        // Without a final sigmoid, the network's values lie outside [0, 1].
        assert!(alpha[20 * 64 + 8] > 220 && alpha[20 * 64 + 56] < 50, "{} {}", alpha[20 * 64 + 8], alpha[20 * 64 + 56]);
    }

    #[test]
    fn what_is_no_network_is_told() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("no.onnx");
        std::fs::write(&file, b"not a network").unwrap();
        let told = Network::open(&file).err().unwrap().to_string();
        assert!(told.contains("no.onnx") && !told.contains('\n'), "{told}");
    }
}
