//! From the maps that detectors predict to boxes around writing.

use super::polygon::{RotatedBox, bounds, contains, iou};
use super::targets::{DB_SHRINK, EAST_STRIDE};
use crate::text::surface::hull;
use diorama_geom::glam::{DVec2, dvec2};
use serde::{Deserialize, Serialize};

/// Detected writing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detection {
    /// From the upper left in reading order, clockwise, in pixels.
    pub corners: [DVec2; 4],
    /// From 0 to 1.
    pub score: f64,
}

/// How EAST's maps become boxes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EastDecoding {
    /// Score above which a cell tells a box.
    pub score: f32,
    /// IoU above which boxes are one.
    pub overlap: f64,
}

impl Default for EastDecoding {
    fn default() -> Self {
        EastDecoding { score: 0.9, overlap: 0.2 }
    }
}

/// How DB's map becomes boxes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DbDecoding {
    /// Probability above which a pixel is writing.
    pub pixel: f32,
    /// Mean probability above which a box is kept.
    pub score: f32,
    /// Boxes grow by `ratio · A / L`, with area `A` and perimeter `L`; 0: by the distance that the shrinking of outlines took away.
    pub unclip: f64,
    /// Least shorter side in pixels, before growing and, two pixels more, after.
    pub least_px: f64,
}

impl Default for DbDecoding {
    fn default() -> Self {
        DbDecoding { pixel: 0.3, score: 0.6, unclip: 1.5, least_px: 3.0 }
    }
}

/// Boxes of EAST's maps.
///
/// # Shapes
/// score `[H, W]`; geometry `[5, H, W]`: distances in pixels to the upper, right, lower and left side, angle in radians.
pub fn east(score: &[f32], geometry: &[f32], [h, w]: [usize; 2], decoding: &EastDecoding) -> Vec<Detection> {
    let n = h * w;
    let cells = (0..n).filter(|i| score[*i] > decoding.score);
    let boxes = cells.map(|i| {
        let [up, right, down, left, angle] = std::array::from_fn(|k| geometry[k * n + i] as f64);
        let s = EAST_STRIDE as f64;
        let at = dvec2(s * ((i % w) as f64 + 0.5), s * ((i / w) as f64 + 0.5));
        let (sin, cos) = angle.sin_cos();
        let corner = |x: f64, y: f64| at + dvec2(cos, sin) * x + dvec2(-sin, cos) * y;
        let corners = [corner(-left, -up), corner(right, -up), corner(right, down), corner(-left, down)];
        Detection { corners, score: score[i] as f64 }
    });
    suppressed(merged(boxes, decoding.overlap), decoding.overlap)
}

/// A box merged of several: the mean weighted by scores.
#[derive(Clone, Copy)]
struct Merged {
    mean: Detection,
    /// Sum of the scores.
    weight: f64,
    count: f64,
}

impl Merged {
    fn of(d: Detection) -> Merged {
        Merged { mean: d, weight: d.score, count: 1.0 }
    }

    fn add(&mut self, d: Detection) {
        let (mut corners, weight) = (d.corners, self.weight + d.score);
        let off = |corners: &[DVec2; 4]| (0..4).map(|k| corners[k].distance(self.mean.corners[k])).sum::<f64>();
        let mut turned = corners;
        turned.rotate_left(2);
        // The angles of vertical writing lie at both ends of their range.
        if off(&turned) < off(&corners) {
            corners = turned;
        }
        let share = d.score / weight;
        for (mean, corner) in self.mean.corners.iter_mut().zip(corners) {
            *mean += (corner - *mean) * share;
        }
        self.mean.score += (d.score - self.mean.score) / (self.count + 1.0);
        (self.weight, self.count) = (weight, self.count + 1.0);
    }
}

/// First pass of locality-aware NMS: boxes of consecutive cells that overlap become their mean.
fn merged(boxes: impl Iterator<Item = Detection>, overlap: f64) -> Vec<Merged> {
    let mut out: Vec<Merged> = Vec::new();
    for b in boxes {
        match out.last_mut() {
            Some(last) if iou(&last.mean.corners, &b.corners) > overlap => last.add(b),
            _ => out.push(Merged::of(b)),
        }
    }
    out
}

/// Second pass: of boxes that overlap, the one that most cells speak for remains.
fn suppressed(mut boxes: Vec<Merged>, overlap: f64) -> Vec<Detection> {
    boxes.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    let mut out: Vec<Detection> = Vec::new();
    for b in boxes {
        if out.iter().all(|kept| iou(&kept.corners, &b.mean.corners) <= overlap) {
            out.push(b.mean);
        }
    }
    out
}

/// Boxes of DB's probability map, best first.
///
/// # Shapes
/// probability `[H, W]`.
pub fn db(probability: &[f32], size: [usize; 2], decoding: &DbDecoding) -> Vec<Detection> {
    let mut out: Vec<Detection> = Vec::new();
    for pixels in components(probability, size, decoding.pixel) {
        let b = around_pixels(&pixels, size[1]);
        if b.size.min_element() < decoding.least_px {
            continue;
        }
        let score = mean_within(&b.corners(), probability, size);
        let grown = b.grown(unclip_distance(b.size, decoding.unclip));
        if score > decoding.score as f64 && grown.size.min_element() >= decoding.least_px + 2.0 {
            out.push(Detection { corners: grown.corners(), score });
        }
    }
    out.sort_by(|a, b| b.score.total_cmp(&a.score));
    out
}

/// Distance by which a box grows; see [`DbDecoding::unclip`].
fn unclip_distance(size: DVec2, ratio: f64) -> f64 {
    let (area, half) = (size.x * size.y, size.x + size.y);
    if ratio > 0.0 {
        return ratio * area / (2.0 * half);
    }
    // The root of D · L(D) = (1 − r²) A(D), with area and perimeter of the box grown by D.
    let k = 1.0 - DB_SHRINK * DB_SHRINK;
    let (a, b, c) = (8.0 - 4.0 * k, 2.0 * half * (1.0 - k), -k * area);
    ((b * b - 4.0 * a * c).sqrt() - b) / (2.0 * a)
}

/// Pixels above a threshold that touch each other, corners included, as indices.
fn components(values: &[f32], [h, w]: [usize; 2], threshold: f32) -> Vec<Vec<usize>> {
    let mut is_left: Vec<bool> = values.iter().map(|v| *v > threshold).collect();
    let mut out = Vec::new();
    for first in 0..h * w {
        if !std::mem::take(&mut is_left[first]) {
            continue;
        }
        let mut found = vec![first];
        let mut next = 0;
        while next < found.len() {
            let (r, c) = (found[next] / w, found[next] % w);
            next += 1;
            for y in r.saturating_sub(1)..(r + 2).min(h) {
                for x in c.saturating_sub(1)..(c + 2).min(w) {
                    if std::mem::take(&mut is_left[y * w + x]) {
                        found.push(y * w + x);
                    }
                }
            }
        }
        out.push(found);
    }
    out
}

/// The smallest rectangle around the centers of pixels, its longer side read from left to right. It grows by at most the half pixel
/// that centers leave out, as far as its area stays below that of the pixels.
fn around_pixels(pixels: &[usize], w: usize) -> RotatedBox {
    let centers = pixels.iter().map(|i| dvec2((i % w) as f64 + 0.5, (i / w) as f64 + 0.5)).collect();
    let outline = hull(centers);
    let mut b = RotatedBox::around(&outline);
    if b.size.y > b.size.x {
        let mut corners = b.corners();
        corners.rotate_left(1);
        b = RotatedBox::around(&corners);
    }
    let (half, missing) = (0.5 * (b.size.x + b.size.y), pixels.len() as f64 - b.area());
    // 4 δ² + 2 (width + height) δ = missing area.
    let by = if missing > 0.0 { 0.5 * ((half * half + missing).sqrt() - half) } else { 0.0 };
    b.grown(by.min(0.5))
}

/// Mean of the values whose pixels' centers lie in a polygon.
fn mean_within(polygon: &[DVec2], values: &[f32], [h, w]: [usize; 2]) -> f64 {
    let (low, high) = bounds(polygon);
    let range = |low: f64, high: f64, n: usize| (low.floor().max(0.0) as usize)..(high.ceil().clamp(0.0, n as f64) as usize);
    let (mut sum, mut count) = (0.0, 0);
    for y in range(low.y, high.y, h) {
        for x in range(low.x, high.x, w) {
            if contains(polygon, dvec2(x as f64 + 0.5, y as f64 + 0.5)) {
                (sum, count) = (sum + values[y * w + x] as f64, count + 1);
            }
        }
    }
    sum / count.max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::super::evaluation::Label;
    use super::super::targets;
    use super::*;
    use proptest::prelude::*;

    /// Size of the test images: rows and columns.
    const SIZE: [usize; 2] = [192, 256];

    fn label(b: RotatedBox) -> Label {
        Label { polygon: b.corners().to_vec(), ignore: false, cluster: None }
    }

    fn decoded_east(labels: &[Label]) -> Vec<Detection> {
        let t = targets::east(labels, SIZE, 4.0);
        east(&t.score, &t.geometry, t.size, &EastDecoding::default())
    }

    fn decoded_db(labels: &[Label], unclip: f64) -> Vec<Detection> {
        let t = targets::db(labels, SIZE, 4.0);
        db(&t.shrunk, t.size, &DbDecoding { unclip, ..DbDecoding::default() })
    }

    #[test]
    fn several_boxes_are_told_apart() {
        let at = |x: f64, y: f64, angle: f64| RotatedBox { center: dvec2(x, y), size: dvec2(60.0, 24.0), angle };
        let boxes = [at(50.0, 40.0, 0.0), at(150.0, 40.0, 0.5), at(60.0, 130.0, -1.4), at(180.0, 140.0, 1.0)];
        let labels = boxes.map(label);
        for found in [decoded_east(&labels), decoded_db(&labels, 0.0)] {
            assert_eq!(found.len(), 4);
            for b in &boxes {
                let best = found.iter().map(|d| iou(&d.corners, &b.corners())).fold(0.0, f64::max);
                assert!(best > 0.9, "{best}");
            }
            assert!(found.iter().all(|d| (d.score - 1.0).abs() < 0.1));
        }
    }

    #[test]
    fn growing_in_proportion_loses_long_boxes() {
        // What r = 0.4 takes away, 1.5 A / L gives back to squares, but not to long boxes: hence the exact inverse.
        let iou_of = |w: f64, h: f64, unclip: f64| {
            let b = RotatedBox { center: dvec2(128.0, 96.0), size: dvec2(w, h), angle: 0.0 };
            iou(&decoded_db(&[label(b)], unclip)[0].corners, &b.corners())
        };
        assert!(iou_of(50.0, 50.0, 1.5) > 0.9);
        assert!(iou_of(200.0, 20.0, 1.5) < 0.6);
        assert!(iou_of(200.0, 20.0, 0.0) > 0.85);
        // Exact without pixels: the grown box shrinks to the one before.
        let size = dvec2(37.0, 11.0);
        let d = unclip_distance(size, 0.0);
        let corners = RotatedBox { center: DVec2::ZERO, size, angle: 0.0 }.grown(d).corners();
        assert!((targets::db_offset(&corners) - d).abs() < 1e-12);
    }

    #[test]
    fn small_faint_and_empty_maps_give_nothing() {
        let d = DbDecoding::default();
        let mut map = vec![0.0; 64];
        assert!(db(&map, [8, 8], &d).is_empty());
        (18..22).for_each(|i| map[i] = 1.0);
        assert!(db(&map, [8, 8], &d).is_empty(), "one pixel high");
        map.iter_mut().for_each(|v| *v = 0.5);
        assert!(db(&map, [8, 8], &d).is_empty(), "a mean of 0.5");
        map.iter_mut().for_each(|v| *v = 0.7);
        let found = db(&map, [8, 8], &d);
        assert!(found.len() == 1 && (found[0].score - 0.7).abs() < 1e-6);
    }

    #[test]
    fn votes_of_neighbors_are_averaged_and_the_weaker_box_goes() {
        let d = |x: f64, score: f64| Detection {
            corners: [(0.0, 0.0), (10.0, 0.0), (10.0, 4.0), (0.0, 4.0)].map(|(a, b)| dvec2(a + x, b)),
            score,
        };
        let merged = merged([d(0.0, 0.9), d(1.0, 0.9), d(40.0, 1.0), d(0.5, 0.95)].into_iter(), 0.2);
        assert_eq!(merged.len(), 3);
        assert!((merged[0].mean.corners[0].x - 0.5).abs() < 1e-12 && (merged[0].mean.score - 0.9).abs() < 1e-12);
        let kept = suppressed(merged, 0.2);
        assert_eq!(kept.iter().map(|k| k.corners[0].x).collect::<Vec<_>>(), [0.5, 40.0]);
        // The same box with its corners from the other end.
        let mut turned = d(0.0, 0.9);
        turned.corners.rotate_left(2);
        let mut m = Merged::of(d(0.0, 0.9));
        m.add(turned);
        assert!(m.mean.corners[0].distance(d(0.0, 0.9).corners[0]) < 1e-12);
    }

    prop_compose! {
        fn any_box()(x in 90.0..160.0f64, y in 80.0..110.0f64, h in 20.0..50.0f64, ratio in 1.0..4.0f64, angle in -1.57..1.57f64) -> RotatedBox {
            RotatedBox { center: dvec2(x, y), size: dvec2((h * ratio).min(130.0), h), angle }
        }
    }

    proptest! {
        #[test]
        fn targets_decode_to_the_boxes_that_they_were_made_of(b in any_box()) {
            for found in [decoded_east(&[label(b)]), decoded_db(&[label(b)], 0.0)] {
                prop_assert_eq!(found.len(), 1);
                let v = iou(&found[0].corners, &b.corners());
                prop_assert!(v > 0.9, "{}", v);
            }
        }

        #[test]
        fn quadrilaterals_in_slight_perspective_come_back_too(b in any_box(), shift in prop::array::uniform8(-1.0..1.0f64)) {
            let mut corners = b.corners();
            let by = 0.03 * b.size.y;
            corners.iter_mut().zip(shift.chunks_exact(2)).for_each(|(c, s)| *c += by * dvec2(s[0], s[1]));
            let label = Label { polygon: corners.to_vec(), ignore: false, cluster: None };
            for found in [decoded_east(std::slice::from_ref(&label)), decoded_db(&[label], 0.0)] {
                prop_assert!(found.len() == 1 && iou(&found[0].corners, &corners) > 0.85);
            }
        }
    }
}
