//! Rendered views, and interpolation of pixels between those that were traced.

use diorama_geom::Image;

/// Layers of a rendered view.
#[derive(Clone, Debug)]
pub struct View {
    /// sRGB with the background, `[H, W, 3]`.
    pub rgb: Image,
    /// `[H, W, 1]`
    pub opacity: Image,
    /// Expected distance along the ray in model units, 0 where nothing is hit, `[H, W, 1]`.
    pub depth: Image,
}

impl View {
    /// A black view that meets nothing.
    pub fn empty(width: usize, height: usize) -> View {
        let layer = |channels| Image::zeros(width, height, channels);
        View { rgb: layer(3), opacity: layer(1), depth: layer(1) }
    }
}

/// Orders pixels by square tiles of the given edge, so that neighbors are traced together.
pub fn sort_by_tiles(pixels: &mut [u32], width: usize, edge: usize) {
    let (width, edge) = (width as u32, edge as u32);
    pixels.sort_by_cached_key(|p| (p / width / edge, p % width / edge, *p));
}

/// Fills pixels half way between those `stride` apart: interpolated where the corners around them differ by no more than `tolerance`,
/// else listed in `wanted`.
pub fn interpolate_between(view: &mut View, stride: usize, tolerance: f32, wanted: &mut Vec<u32>) {
    let (w, h, half) = (view.rgb.width, view.rgb.height, stride / 2);
    for y in (0..h).step_by(half) {
        for x in (0..w).step_by(half) {
            let (dx, dy) = (x % stride, y % stride);
            if dx == 0 && dy == 0 {
                continue;
            }
            let (x0, y0) = (x - dx, y - dy);
            let (x1, y1) = (x0 + stride, y0 + stride);
            let at = y * w + x;
            if x1 >= w || y1 >= h {
                wanted.push(at as u32);
                continue;
            }
            let corners = [y0 * w + x0, y0 * w + x1, y1 * w + x0, y1 * w + x1];
            let alike = |data: &[f32], channels: usize, k: usize, slack: f32| {
                let v = corners.map(|c| data[c * channels + k]);
                v.iter().copied().fold(f32::MIN, f32::max) - v.iter().copied().fold(f32::MAX, f32::min) <= slack
            };
            let depth = view.depth.data[corners[0]];
            let flat = (0..3).all(|k| alike(&view.rgb.data, 3, k, tolerance))
                && alike(&view.opacity.data, 1, 0, tolerance)
                && alike(&view.depth.data, 1, 0, tolerance * depth);
            if !flat {
                wanted.push(at as u32);
                continue;
            }
            let of = |dx: usize| if dx == 0 { [1.0, 0.0] } else { [0.5, 0.5] };
            let (fx, fy) = (of(dx), of(dy));
            let weights = [fy[0] * fx[0], fy[0] * fx[1], fy[1] * fx[0], fy[1] * fx[1]];
            let mix = |data: &mut [f32], channels: usize| {
                for k in 0..channels {
                    data[at * channels + k] = corners.iter().zip(weights).map(|(c, w)| w * data[c * channels + k]).sum();
                }
            };
            mix(&mut view.rgb.data, 3);
            mix(&mut view.opacity.data, 1);
            mix(&mut view.depth.data, 1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(w: usize, h: usize, f: impl Fn(usize, usize) -> f32) -> View {
        let mut v = View::empty(w, h);
        for i in 0..w * h {
            v.rgb.data[i * 3..i * 3 + 3].fill(f(i % w, i / w));
            (v.opacity.data[i], v.depth.data[i]) = (1.0, 2.0);
        }
        v
    }

    #[test]
    fn pixels_are_interpolated_where_neighbours_agree_and_traced_where_not() {
        let (w, h) = (17, 13);
        let ramp = |x: usize, y: usize| 0.001 * x as f32 + 0.002 * y as f32;
        let mut v = picture(w, h, |x, y| if x % 4 == 0 && y % 4 == 0 { ramp(x, y) } else { 9.0 });
        let mut wanted = Vec::new();
        for stride in [4, 2] {
            wanted.clear();
            interpolate_between(&mut v, stride, 0.05, &mut wanted);
            // Lattice cells that reach beyond the picture have no corners to go by.
            assert!(wanted.iter().all(|&p| p as usize % w >= 16 || p as usize / w >= 12), "{wanted:?}");
            wanted.iter().for_each(|&p| v.rgb.data[p as usize * 3..][..3].fill(ramp(p as usize % w, p as usize / w)));
        }
        for i in (0..w * h).filter(|i| i % w < 16 && i / w < 12) {
            assert!((v.rgb.data[i * 3] - ramp(i % w, i / w)).abs() < 1e-6, "pixel {i}");
        }
        let mut edge = picture(w, h, |x, _| (x > 7) as u8 as f32);
        wanted.clear();
        interpolate_between(&mut edge, 4, 0.05, &mut wanted);
        assert!(wanted.contains(&(2 * w as u32 + 6)) && !wanted.contains(&(2 * w as u32 + 2)), "{wanted:?}");
    }
}
