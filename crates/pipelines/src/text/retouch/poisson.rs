//! Joining of a patch to an image by its gradients (Pérez, Gangnet, Blake 2003): `Δf = div v` inside, f = the image on the border, solved
//! by sine transforms.

use super::sine_transform::SineTransform;
use diorama_geom::Image;
use rayon::prelude::*;

/// Gradients that the joined image shall have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gradients {
    /// Those of the patch.
    Patch,
    /// At each pair of neighbors those of the patch or the image, whichever are larger over all channels.
    Mixed,
}

/// A patch joined to an image of its size: the border is the image's, the gradients inside are the patch's or both's.
///
/// # Shapes
/// Both and the result `[H, W, C]`.
///
/// # Panics
/// When sizes differ.
pub fn blend(patch: &Image, image: &Image, gradients: Gradients) -> Image {
    let size = |i: &Image| (i.width, i.height, i.channels);
    assert_eq!(size(patch), size(image), "the patch and the image have different sizes");
    if image.width < 3 || image.height < 3 {
        return image.clone();
    }
    let (columns, rows) = (image.width - 2, image.height - 2);
    let mut divergences = divergences(patch, image, gradients);
    let (along, down) = (SineTransform::new(columns), SineTransform::new(rows));
    divergences.iter_mut().for_each(|d| solve(d, columns, rows, [&along, &down]));
    let mut out = image.clone();
    let channels = out.channels;
    out.data.par_chunks_mut(image.width * channels).enumerate().skip(1).take(rows).for_each(|(y, row)| {
        for x in 1..=columns {
            for (k, solution) in divergences.iter().enumerate() {
                row[x * channels + k] = solution[(y - 1) * columns + x - 1] as f32;
            }
        }
    });
    out
}

/// Divergence of the wanted gradients at inner pixels, less what the border adds to the Laplacian, `[C]` of `[H−2, W−2]`.
fn divergences(patch: &Image, image: &Image, gradients: Gradients) -> Vec<Vec<f64>> {
    let (width, height, channels) = (image.width, image.height, image.channels);
    let columns = width - 2;
    let inner = |x: usize, y: usize| x > 0 && y > 0 && x < width - 1 && y < height - 1;
    let mut sums = vec![0.0; columns * (height - 2) * channels];
    sums.par_chunks_mut(channels).enumerate().for_each(|(i, sums)| {
        let (x, y) = (i % columns + 1, i / columns + 1);
        for (nx, ny) in [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)] {
            let step = |im: &Image, k: usize| (im.pixel(nx, ny)[k] - im.pixel(x, y)[k]) as f64;
            let size = |im: &Image| (0..channels).map(|k| step(im, k).powi(2)).sum::<f64>();
            let from = if gradients == Gradients::Mixed && size(image) > size(patch) { image } else { patch };
            for (k, sum) in sums.iter_mut().enumerate() {
                *sum += step(from, k) - if inner(nx, ny) { 0.0 } else { image.pixel(nx, ny)[k] as f64 };
            }
        }
    });
    (0..channels).map(|k| sums.iter().skip(k).step_by(channels).copied().collect()).collect()
}

/// Solves `Δf = values` in place for f = 0 around them: sines are eigenvectors, of eigenvalues `2 cos(πi/(n+1)) − 2` along each axis.
fn solve(values: &mut Vec<f64>, columns: usize, rows: usize, [along, down]: [&SineTransform; 2]) {
    transform_lines(values, columns, along);
    let mut transposed = transposed(values, columns, rows);
    transform_lines(&mut transposed, rows, down);
    let eigenvalue = |i: usize, n: usize| 2.0 * (std::f64::consts::PI * (i + 1) as f64 / (n + 1) as f64).cos() - 2.0;
    let scale = 4.0 / ((columns + 1) * (rows + 1)) as f64;
    let of_rows: Vec<f64> = (0..rows).map(|y| eigenvalue(y, rows)).collect();
    for (x, line) in transposed.chunks_mut(rows).enumerate() {
        let of_column = eigenvalue(x, columns);
        line.iter_mut().zip(&of_rows).for_each(|(v, of_row)| *v *= scale / (of_column + of_row));
    }
    transform_lines(&mut transposed, rows, down);
    *values = self::transposed(&transposed, rows, columns);
    transform_lines(values, columns, along);
}

fn transform_lines(values: &mut [f64], n: usize, transform: &SineTransform) {
    values.par_chunks_mut(n).for_each_init(|| transform.scratch(), |scratch, line| transform.apply(line, scratch));
}

/// `[rows, columns]` as `[columns, rows]`.
fn transposed(values: &[f64], columns: usize, rows: usize) -> Vec<f64> {
    (0..values.len()).map(|i| values[i % rows * columns + i / rows]).collect()
}
