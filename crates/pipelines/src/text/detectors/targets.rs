//! What detectors learn to predict of an image, from the outlines of its writing.
//!
//! EAST: a score map of outlines that are shrunk, and in each of its cells the distances to the four sides of the rotated box (RBOX) and
//! its angle. DB: the map of shrunk outlines, and a threshold map that falls with the distance to the outline.

use super::evaluation::Label;
use super::polygon::{RotatedBox, boundary_distance, bounds, contains, perimeter, signed_area};
use diorama_geom::glam::{DVec2, dvec2};

/// Pixels per cell of EAST's maps.
pub const EAST_STRIDE: usize = 4;
/// Share of the shorter side at a corner by which EAST's outlines shrink there.
const EAST_SHRINK: f64 = 0.3;
/// Shrink ratio `r` of DB: outlines move inward by `A (1 − r²) / L`, with area `A` and perimeter `L`.
pub const DB_SHRINK: f64 = 0.4;
/// Thresholds far from an outline and on it.
const DB_THRESHOLDS: [f64; 2] = [0.3, 0.7];

/// EAST's targets of an image.
#[derive(Clone, Debug, PartialEq)]
pub struct EastTargets {
    /// Rows and columns of cells.
    pub size: [usize; 2],
    /// 1 in shrunk outlines, `[H, W]`.
    pub score: Vec<f32>,
    /// 0 in outlines that are to be ignored, else 1, `[H, W]`.
    pub weight: Vec<f32>,
    /// Distances in pixels to the upper, right, lower and left side, and the angle in radians, `[5, H, W]`; 0 outside.
    pub geometry: Vec<f32>,
}

/// DB's targets of an image; all maps are `[H, W]`.
#[derive(Clone, Debug, PartialEq)]
pub struct DbTargets {
    /// Rows and columns of pixels.
    pub size: [usize; 2],
    /// 1 in shrunk outlines.
    pub shrunk: Vec<f32>,
    /// 0 in outlines that are to be ignored, else 1.
    pub weight: Vec<f32>,
    /// Threshold, from 0.3 to 0.7.
    pub threshold: Vec<f32>,
    /// 1 within the outlines' borders, where thresholds are learned.
    pub threshold_weight: Vec<f32>,
}

/// Whether writing is to be learned: it is not ignored, and its shorter side has `least_px` pixels.
fn is_learned(label: &Label, least_px: f64) -> bool {
    !label.ignore && RotatedBox::around(&label.polygon).size.min_element() >= least_px
}

/// Cells whose centers lie within the bounds of a polygon, with these centers in pixels.
fn cells(polygon: &[DVec2], stride: usize, [h, w]: [usize; 2], margin: f64) -> impl Iterator<Item = (usize, DVec2)> {
    let (low, high) = bounds(polygon);
    let s = stride as f64;
    let first = |v: f64| ((v - margin) / s - 0.5).ceil().max(0.0) as usize;
    let end = |v: f64, n: usize| (((v + margin) / s - 0.5).floor() + 1.0).clamp(0.0, n as f64) as usize;
    let (columns, rows) = (first(low.x)..end(high.x, w), first(low.y)..end(high.y, h));
    rows.flat_map(move |r| columns.clone().map(move |c| (r * w + c, dvec2(s * (c as f64 + 0.5), s * (r as f64 + 0.5)))))
}

/// A quadrilateral whose corners moved along its sides, by a share of the shorter side at each; the longer pair of sides goes first.
fn shrunk(quad: [DVec2; 4], share: f64) -> [DVec2; 4] {
    let side = |k: usize| quad[k % 4].distance(quad[(k + 1) % 4]);
    let by: [f64; 4] = std::array::from_fn(|k| share * side(k).min(side(k + 3)));
    let first = if side(0) + side(2) >= side(1) + side(3) { 0 } else { 1 };
    let mut out = quad;
    for k in [first, first + 2, first + 1, first + 3] {
        let (a, b) = (k % 4, (k + 1) % 4);
        let along = (out[b] - out[a]).normalize_or_zero();
        (out[a], out[b]) = (out[a] + along * by[a], out[b] - along * by[b]);
    }
    out
}

/// EAST's targets of an image of `size` (rows and columns of pixels, multiples of [`EAST_STRIDE`]). Writing lower than `least_px`, or so
/// small that no cell is in its shrunk outline, is ignored.
pub fn east(labels: &[Label], size: [usize; 2], least_px: f64) -> EastTargets {
    let [h, w] = size.map(|n| n / EAST_STRIDE);
    let n = h * w;
    let mut out = EastTargets { size: [h, w], score: vec![0.0; n], weight: vec![1.0; n], geometry: vec![0.0; 5 * n] };
    for label in labels {
        let rotated = RotatedBox::around(&label.polygon);
        let quad: [DVec2; 4] = label.polygon[..].try_into().unwrap_or(rotated.corners());
        let inner = shrunk(quad, EAST_SHRINK);
        let mut has_cells = false;
        if is_learned(label, least_px) {
            let (sin, cos) = rotated.angle.sin_cos();
            for (i, p) in cells(&inner, EAST_STRIDE, [h, w], 0.0).filter(|c| contains(&inner, c.1)) {
                let d = p - rotated.center;
                let (x, y) = (d.dot(dvec2(cos, sin)), d.dot(dvec2(-sin, cos)));
                let half = 0.5 * rotated.size;
                let values = [half.y + y, half.x - x, half.y - y, half.x + x].map(|v| v.max(0.0)).into_iter().chain([rotated.angle]);
                values.enumerate().for_each(|(k, v)| out.geometry[k * n + i] = v as f32);
                (out.score[i], has_cells) = (1.0, true);
            }
        }
        if !has_cells {
            ignore(&mut out.weight, label, EAST_STRIDE, [h, w]);
        }
    }
    out
}

/// Clears the weights of cells in an outline.
fn ignore(weight: &mut [f32], label: &Label, stride: usize, size: [usize; 2]) {
    cells(&label.polygon, stride, size, 0.0).filter(|c| contains(&label.polygon, c.1)).for_each(|(i, _)| weight[i] = 0.0);
}

/// Distance in pixels by which DB's outline of a polygon moves inward.
pub fn db_offset(polygon: &[DVec2]) -> f64 {
    signed_area(polygon).abs() * (1.0 - DB_SHRINK * DB_SHRINK) / perimeter(polygon).max(f64::MIN_POSITIVE)
}

/// DB's targets of an image of `size` (rows and columns). A pixel is in the shrunk outline where it is inside and at least the offset away
/// from the boundary, which is what moving the boundary inward leaves of any simple polygon. Writing lower than `least_px`, or that
/// vanishes, is ignored.
pub fn db(labels: &[Label], size: [usize; 2], least_px: f64) -> DbTargets {
    let n = size[0] * size[1];
    let [low, high] = DB_THRESHOLDS;
    let mut out =
        DbTargets { size, shrunk: vec![0.0; n], weight: vec![1.0; n], threshold: vec![low as f32; n], threshold_weight: vec![0.0; n] };
    for label in labels {
        let offset = db_offset(&label.polygon);
        let mut has_pixels = false;
        if is_learned(label, least_px) {
            for (i, p) in cells(&label.polygon, 1, size, offset) {
                let (distance, is_inside) = (boundary_distance(&label.polygon, p), contains(&label.polygon, p));
                if is_inside && distance >= offset {
                    (out.shrunk[i], has_pixels) = (1.0, true);
                }
                if is_inside || distance < offset {
                    let near = (1.0 - distance / offset).clamp(0.0, 1.0);
                    out.threshold[i] = out.threshold[i].max((low + (high - low) * near) as f32);
                    out.threshold_weight[i] = 1.0;
                }
            }
        }
        if !has_pixels {
            ignore(&mut out.weight, label, 1, size);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::polygon::tests::rectangle;
    use super::*;

    fn label(polygon: Vec<DVec2>) -> Label {
        Label { polygon, ignore: false, cluster: None }
    }

    #[test]
    fn east_shrinks_by_shares_of_the_shorter_side() {
        let quad = [dvec2(0.0, 0.0), dvec2(40.0, 0.0), dvec2(40.0, 20.0), dvec2(0.0, 20.0)];
        assert_eq!(shrunk(quad, 0.3), [dvec2(6.0, 6.0), dvec2(34.0, 6.0), dvec2(34.0, 14.0), dvec2(6.0, 14.0)]);
        let t = east(&[label(quad.to_vec())], [24, 48], 4.0);
        assert_eq!(t.size, [6, 12]);
        // Centers of cells lie at 2, 6, 10 …: from 6 (on the side) or 10 to 30 across, and 10 down.
        let at = |r: usize, c: usize, k: usize| t.geometry[k * 72 + r * 12 + c];
        assert_eq!(t.score[2 * 12 + 2..2 * 12 + 8], [1.0; 6]);
        assert_eq!((t.score[12 * 4 + 4], t.score[2 * 12 + 9]), (0.0, 0.0));
        assert_eq!([0, 1, 2, 3, 4].map(|k| at(2, 3, k)), [10.0, 26.0, 10.0, 14.0, 0.0]);
        assert!(t.weight.iter().all(|w| *w == 1.0));
    }

    #[test]
    fn db_shrinks_by_area_over_perimeter_and_thresholds_fall_with_distance() {
        let l = label(rectangle(10.0, 10.0, 40.0, 20.0));
        let offset = db_offset(&l.polygon);
        assert!((offset - 800.0 * 0.84 / 120.0).abs() < 1e-12);
        let t = db(&[l], [48, 64], 4.0);
        // Offset 5.6: columns with centers from 15.6 to 44.4, rows from 15.6 to 24.4.
        let inside = |x: usize, y: usize| t.shrunk[y * 64 + x];
        assert_eq!([inside(15, 18), inside(16, 18), inside(43, 18), inside(44, 18)], [0.0, 1.0, 1.0, 0.0]);
        assert_eq!(t.shrunk.iter().sum::<f32>(), 28.0 * 8.0);
        let threshold = |x: usize, y: usize| t.threshold[y * 64 + x];
        assert!((threshold(10, 20) as f64 - (0.3 + 0.4 * (1.0 - 0.5 / 5.6))).abs() < 1e-6 && threshold(10, 20) == threshold(9, 20));
        assert_eq!((threshold(30, 20), threshold(0, 20)), (0.3, 0.3));
        assert_eq!((t.threshold_weight[20 * 64 + 30], t.threshold_weight[20 * 64 + 5], t.threshold_weight[20 * 64]), (1.0, 1.0, 0.0));
    }

    #[test]
    fn what_is_ignored_low_or_vanishes_has_no_weight() {
        let low = label(rectangle(4.0, 4.0, 40.0, 3.0));
        let ignored = Label { ignore: true, ..label(rectangle(4.0, 16.0, 40.0, 16.0)) };
        let e = east(&[low.clone(), ignored.clone()], [48, 64], 8.0);
        assert!(e.score.iter().all(|s| *s == 0.0));
        assert_eq!((e.weight[5 * 16 + 3], e.weight[16 + 3], e.weight[10 * 16]), (0.0, 0.0, 1.0));
        let d = db(&[low, ignored], [48, 64], 8.0);
        assert!(d.shrunk.iter().chain(&d.threshold_weight).all(|s| *s == 0.0));
        assert_eq!((d.weight[5 * 64 + 20], d.weight[20 * 64 + 20], d.weight[40 * 64]), (0.0, 0.0, 1.0));
        // Higher than asked, yet between the centers of cells.
        let thin = label(rectangle(4.0, 1.0, 40.0, 5.0));
        let e = east(&[thin], [48, 64], 4.0);
        assert!(e.score.iter().all(|s| *s == 0.0) && e.weight[3] == 0.0);
    }
}
