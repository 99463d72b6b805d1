//! DetEval (Wolf and Jolion 2006): scores of detections that may split a label or join several, by shares of areas.
//!
//! A detection and a label are one where the label is covered by 0.8 and the detection is filled by 0.4. A label that several detections
//! cover together, and a detection that several labels fill together, count 0.8.

use super::evaluation::{JudgedImage, Label, Score, counted_detections};
use super::polygon::{intersection_area, signed_area};

/// Share of a label that must be covered, and of a detection that must be filled.
const COVERED: f64 = 0.8;
const FILLED: f64 = 0.4;
/// What a label that was split, or a detection that joins labels, counts.
const SHARED: f64 = 0.8;

/// Sums over images: what labels and detections count, and their numbers.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    recalled: f64,
    precise: f64,
    labels: usize,
    detections: usize,
}

/// Score of images, ignored labels and what lies in them left out.
pub fn evaluate(images: &[JudgedImage]) -> Score {
    let mut sums = Sums::default();
    images.iter().for_each(|i| add(&mut sums, i));
    let share = |v: f64, n: usize| if n > 0 { v / n as f64 } else { 0.0 };
    Score::of(share(sums.precise, sums.detections), share(sums.recalled, sums.labels))
}

fn add(sums: &mut Sums, image: &JudgedImage) {
    let labels: Vec<&Label> = image.labels.iter().filter(|l| !l.ignore).collect();
    let detections: Vec<_> = counted_detections(&image.labels, &image.detections).into_iter().map(|d| &image.detections[d]).collect();
    (sums.labels, sums.detections) = (sums.labels + labels.len(), sums.detections + detections.len());
    let shared: Vec<Vec<f64>> = labels.iter().map(|l| detections.iter().map(|d| intersection_area(&l.polygon, d)).collect()).collect();
    let covered = |l: usize, d: usize| shared[l][d] / signed_area(&labels[l].polygon).abs().max(f64::MIN_POSITIVE);
    let filled = |l: usize, d: usize| shared[l][d] / signed_area(detections[d]).abs().max(f64::MIN_POSITIVE);
    let is_pair = |l: usize, d: usize| covered(l, d) >= COVERED && filled(l, d) >= FILLED;
    let (all_labels, all_detections) = (0..labels.len(), 0..detections.len());
    let (mut is_found, mut is_used) = (vec![false; labels.len()], vec![false; detections.len()]);
    for l in all_labels.clone() {
        let of_label: Vec<usize> = all_detections.clone().filter(|d| is_pair(l, *d)).collect();
        if let [d] = of_label[..]
            && all_labels.clone().filter(|l| is_pair(*l, d)).count() == 1
        {
            (is_found[l], is_used[d]) = (true, true);
            (sums.recalled, sums.precise) = (sums.recalled + 1.0, sums.precise + 1.0);
        }
    }
    // Only what touches several others can be split or join them.
    let (label_touches, detection_touches) =
        (|l: usize| shared[l].iter().filter(|v| **v > 0.0).count(), |d: usize| shared.iter().filter(|row| row[d] > 0.0).count());
    for l in all_labels.clone().filter(|l| !is_found[*l] && label_touches(*l) > 1).collect::<Vec<_>>() {
        let parts: Vec<usize> = all_detections.clone().filter(|d| !is_used[*d] && filled(l, *d) >= FILLED).collect();
        if !parts.is_empty() && parts.iter().map(|d| covered(l, *d)).sum::<f64>() >= COVERED {
            let share = if parts.len() > 1 { SHARED } else { 1.0 };
            (sums.recalled, sums.precise) = (sums.recalled + share, sums.precise + share * parts.len() as f64);
            is_found[l] = true;
            parts.iter().for_each(|d| is_used[*d] = true);
        }
    }
    for d in all_detections.filter(|d| !is_used[*d] && detection_touches(*d) > 1).collect::<Vec<_>>() {
        let parts: Vec<usize> = all_labels.clone().filter(|l| !is_found[*l] && covered(*l, d) >= COVERED).collect();
        if !parts.is_empty() && parts.iter().map(|l| filled(*l, d)).sum::<f64>() >= FILLED {
            let share = if parts.len() > 1 { SHARED } else { 1.0 };
            (sums.recalled, sums.precise) = (sums.recalled + share * parts.len() as f64, sums.precise + share);
            parts.iter().for_each(|l| is_found[*l] = true);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::polygon::tests::rectangle;
    use super::*;
    use diorama_geom::glam::DVec2;

    fn score(labels: &[(f64, f64, bool)], detections: &[(f64, f64)]) -> Score {
        let of = |x: f64, w: f64| -> Vec<DVec2> { rectangle(x, 0.0, w, 10.0) };
        let labels = labels.iter().map(|(x, w, ignore)| Label { polygon: of(*x, *w), ignore: *ignore, cluster: None }).collect();
        let detections = detections.iter().map(|(x, w)| of(*x, *w)).collect();
        evaluate(&[JudgedImage { scene: "a".into(), labels, detections }])
    }

    #[test]
    fn pairs_splits_and_joins_count_as_published() {
        // Alike; twice as long as the label, which is filled by a half; covered by 0.7 alone.
        assert_eq!(score(&[(0.0, 20.0, false)], &[(0.0, 20.0)]), Score::of(1.0, 1.0));
        assert_eq!(score(&[(0.0, 20.0, false)], &[(0.0, 40.0)]), Score::of(1.0, 1.0));
        assert_eq!(score(&[(0.0, 20.0, false)], &[(0.0, 14.0)]), Score::of(0.0, 0.0));
        // Split into two halves, and two words joined.
        assert_eq!(score(&[(0.0, 20.0, false)], &[(0.0, 10.0), (10.0, 10.0)]), Score::of(0.8, 0.8));
        assert_eq!(score(&[(0.0, 10.0, false), (12.0, 10.0, false)], &[(0.0, 22.0)]), Score::of(0.8, 0.8));
        // A right one and a wrong one; what lies in an ignored label is left out.
        assert_eq!(score(&[(0.0, 20.0, false)], &[(0.0, 20.0), (50.0, 9.0)]), Score::of(0.5, 1.0));
        assert_eq!(score(&[(0.0, 20.0, false), (50.0, 20.0, true)], &[(0.0, 20.0), (50.0, 9.0)]), Score::of(1.0, 1.0));
        assert_eq!(score(&[], &[]), Score::of(0.0, 0.0));
    }
}
