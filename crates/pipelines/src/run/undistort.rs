//! Photographs as a pinhole camera would have taken them.

use diorama_geom::glam::{DVec2, DVec3};
use diorama_geom::{Camera, ImageU8, Lens};
use rayon::prelude::*;

/// Points per side of the border that must show the photograph.
const RIM: usize = 32;
/// Focal lengths that are tried, as factors, and halvings of the interval.
const ZOOM: (f64, f64) = (0.7, 2.5);
const HALVINGS: usize = 24;

/// The widest pinhole camera of the same size, all of whose pixels the photograph shows; none for lenses that a pinhole cannot replace.
pub fn pinhole(camera: &Camera) -> Option<Camera> {
    if matches!(camera.lens, Lens::Equirectangular) {
        return None;
    }
    let with = |zoom: f64| Camera { fx: camera.fx * zoom, fy: camera.fy * zoom, lens: Lens::Pinhole, ..*camera };
    let (w, h) = (camera.width as f64, camera.height as f64);
    let shows = |c: &Camera| {
        let rim = |i: usize| i as f64 / RIM as f64;
        let points = (0..=RIM).flat_map(|i| [(rim(i), 0.0), (rim(i), 1.0), (0.0, rim(i)), (1.0, rim(i))]);
        points
            .map(|(x, y)| source(camera, c, x * w, y * h))
            .all(|p| p.is_some_and(|p| (-0.5..=w + 0.5).contains(&p.x) && (-0.5..=h + 0.5).contains(&p.y)))
    };
    let (mut wide, mut narrow) = ZOOM;
    if !shows(&with(narrow)) {
        return None;
    }
    for _ in 0..HALVINGS {
        let middle = 0.5 * (wide + narrow);
        if shows(&with(middle)) { narrow = middle } else { wide = middle }
    }
    Some(with(narrow))
}

/// Pixel of the photograph that shows what pixel (x, y) of the pinhole camera shows.
fn source(from: &Camera, to: &Camera, x: f64, y: f64) -> Option<DVec2> {
    from.project(DVec3::new((x - to.cx) / to.fx, (y - to.cy) / to.fy, 1.0))
}

/// The image that `to`, a pinhole camera at the same place, would have taken; bilinear between the photograph's pixels.
pub fn undistorted(image: &ImageU8, from: &Camera, to: &Camera) -> ImageU8 {
    let (w, h, c) = (image.width, image.height, image.channels);
    let mut data = vec![0u8; w * h * c];
    data.par_chunks_mut(w * c).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(c).enumerate() {
            let at = source(from, to, x as f64 + 0.5, y as f64 + 0.5).unwrap_or(DVec2::ZERO) - 0.5;
            let at = at.clamp(DVec2::ZERO, DVec2::new(w as f64 - 1.0, h as f64 - 1.0));
            let (x0, y0) = (at.x as usize, at.y as usize);
            let (fx, fy) = (at.x - x0 as f64, at.y - y0 as f64);
            let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
            for (k, out) in pixel.iter_mut().enumerate() {
                let v = |x: usize, y: usize| image.data[(y * w + x) * c + k] as f64;
                let mixed = (v(x0, y0) * (1.0 - fx) + v(x1, y0) * fx) * (1.0 - fy) + (v(x0, y1) * (1.0 - fx) + v(x1, y1) * fx) * fy;
                *out = (mixed + 0.5) as u8;
            }
        }
    });
    ImageU8 { width: w, height: h, channels: c, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bent(k: f64) -> Camera {
        Camera { lens: Lens::Brown { k: [k, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] }, ..Camera::pinhole(120, 80, 1.0) }
    }

    /// Checks by direction: sines that are smooth over the whole view.
    fn photograph(camera: &Camera) -> ImageU8 {
        let value = |i: usize| {
            let d = camera.direction((i % 120) as f64 + 0.5, (i / 120) as f64 + 0.5);
            (127.0 + 60.0 * (9.0 * d.x / d.z).sin() + 60.0 * (7.0 * d.y / d.z).cos()).round() as u8
        };
        ImageU8 { width: 120, height: 80, channels: 1, data: (0..120 * 80).map(value).collect() }
    }

    #[test]
    fn the_undistorted_photograph_is_that_of_the_pinhole() {
        for k in [-0.15, 0.12] {
            let from = bent(k);
            let to = pinhole(&from).unwrap();
            assert!(to.lens == Lens::Pinhole && (to.fx / from.fx - 1.0).abs() > 0.005, "{}", to.fx / from.fx);
            let (got, want) = (undistorted(&photograph(&from), &from, &to), photograph(&to));
            let worst = got.data.iter().zip(&want.data).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
            assert!(worst <= 3, "{k}: {worst}");
        }
        assert!(pinhole(&Camera::equirectangular(64, 32)).is_none());
    }
}
