//! Scores of detected writing against labels: precision, recall and F over all instances, over scenes, and per cluster of poses.

use super::polygon::{self, iou, signed_area};
use diorama_geom::glam::DVec2;
use serde::Serialize;
use std::collections::BTreeMap;

/// Intersection over union above which a detection is a label's.
const MATCH_IOU: f64 = 0.5;
/// Share of a detection within a label that is to be ignored, above which the detection is ignored too.
const IGNORED_SHARE: f64 = 0.5;

/// A label of an image.
#[derive(Clone, Debug, PartialEq)]
pub struct Label {
    pub polygon: Vec<DVec2>,
    /// Whether it counts neither as found nor as missed.
    pub ignore: bool,
    /// Cluster of its pose, where that is known.
    pub cluster: Option<usize>,
}

/// Labels of an image and what was detected in it.
#[derive(Clone, Debug, PartialEq)]
pub struct JudgedImage {
    pub scene: String,
    pub labels: Vec<Label>,
    pub detections: Vec<Vec<DVec2>>,
}

/// Which detections of an image are right.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matches {
    /// Labels that count, and the detection that each has.
    pub of_label: Vec<(usize, Option<usize>)>,
    /// Detections that count and are no label's.
    pub wrong: Vec<usize>,
}

impl Matches {
    fn counts(&self) -> Counts {
        let right = self.of_label.iter().filter(|l| l.1.is_some()).count();
        Counts { right, detections: right + self.wrong.len(), labels: self.of_label.len() }
    }
}

/// Detections of which at most half lies in any label that is to be ignored.
pub(super) fn counted_detections(labels: &[Label], detections: &[Vec<DVec2>]) -> Vec<usize> {
    let ignored = |d: &[DVec2]| {
        let area = signed_area(d).abs();
        let share = |l: &Label| l.ignore && polygon::intersection_area(d, &l.polygon) > IGNORED_SHARE * area;
        labels.iter().any(share)
    };
    (0..detections.len()).filter(|d| !ignored(&detections[*d])).collect()
}

/// Matches one to one, best pairs first: those with an IoU above 0.5. Detections more than half of which lie in a label that is to be
/// ignored are left out before.
pub fn matches(labels: &[Label], detections: &[Vec<DVec2>]) -> Matches {
    let counted = counted_detections(labels, detections);
    let wanted: Vec<usize> = (0..labels.len()).filter(|l| !labels[*l].ignore).collect();
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (i, l) in wanted.iter().enumerate() {
        let close = counted.iter().map(|d| (iou(&labels[*l].polygon, &detections[*d]), i, *d));
        pairs.extend(close.filter(|p| p.0 > MATCH_IOU));
    }
    pairs.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut of_label: Vec<(usize, Option<usize>)> = wanted.into_iter().map(|l| (l, None)).collect();
    let mut is_taken = vec![false; detections.len()];
    for (_, i, d) in pairs {
        if of_label[i].1.is_none() && !is_taken[d] {
            (of_label[i].1, is_taken[d]) = (Some(d), true);
        }
    }
    let wrong = counted.into_iter().filter(|d| !is_taken[*d]).collect();
    Matches { of_label, wrong }
}

/// Instances of images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Counts {
    right: usize,
    detections: usize,
    labels: usize,
}

impl Counts {
    fn add(&mut self, other: Counts) {
        self.right += other.right;
        self.detections += other.detections;
        self.labels += other.labels;
    }

    /// Nothing detected where nothing is labelled is perfect.
    fn score(self) -> Score {
        let share = |of: usize, otherwise: f64| if of > 0 { self.right as f64 / of as f64 } else { otherwise };
        let precision = share(self.detections, if self.labels == 0 { 1.0 } else { 0.0 });
        Score::of(precision, share(self.labels, 1.0))
    }
}

/// Precision, recall and their harmonic mean, from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Score {
    pub precision: f64,
    pub recall: f64,
    pub f: f64,
}

impl Score {
    /// The score of a precision and a recall.
    pub fn of(precision: f64, recall: f64) -> Score {
        let sum = precision + recall;
        Score { precision, recall, f: if sum > 0.0 { 2.0 * precision * recall / sum } else { 0.0 } }
    }

    /// Means of precision and recall, and F of these means.
    fn mean(scores: &[Score]) -> Score {
        let n = scores.len().max(1) as f64;
        Score::of(scores.iter().map(|s| s.precision).sum::<f64>() / n, scores.iter().map(|s| s.recall).sum::<f64>() / n)
    }
}

/// A scene's score: means over its images.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneScore {
    pub scene: String,
    pub images: usize,
    pub score: Score,
}

/// A pose cluster's score.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ClusterScore {
    pub cluster: usize,
    pub labels: usize,
    pub score: Score,
}

/// Scores of a set of images.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    pub images: usize,
    /// Labels and detections that count.
    pub labels: usize,
    pub detections: usize,
    /// Over all instances.
    pub instance: Score,
    /// Means over scenes of means over their images.
    pub scene: Score,
    pub scenes: Vec<SceneScore>,
    /// Of clusters that have labels; empty where no label's cluster is known.
    pub clusters: Vec<ClusterScore>,
}

/// Scores images. A wrong detection counts to the cluster of the label that it overlaps most, or else of the label nearest to it.
pub fn evaluate(images: &[JudgedImage]) -> Evaluation {
    let mut total = Counts::default();
    let mut scenes: BTreeMap<&str, Vec<Score>> = BTreeMap::new();
    let mut clusters: BTreeMap<usize, Counts> = BTreeMap::new();
    for image in images {
        let found = matches(&image.labels, &image.detections);
        let counts = found.counts();
        total.add(counts);
        scenes.entry(&image.scene).or_default().push(counts.score());
        for (l, d) in &found.of_label {
            if let Some(cluster) = image.labels[*l].cluster {
                let right = d.is_some() as usize;
                clusters.entry(cluster).or_default().add(Counts { right, detections: right, labels: 1 });
            }
        }
        for d in &found.wrong {
            if let Some(cluster) = responsible(&image.labels, &image.detections[*d]) {
                clusters.entry(cluster).or_default().detections += 1;
            }
        }
    }
    let of_scene =
        |(scene, scores): (&str, Vec<Score>)| SceneScore { scene: scene.to_string(), images: scores.len(), score: Score::mean(&scores) };
    let scenes: Vec<SceneScore> = scenes.into_iter().map(of_scene).collect();
    let of_cluster = |(cluster, c): (usize, Counts)| ClusterScore { cluster, labels: c.labels, score: c.score() };
    Evaluation {
        images: images.len(),
        labels: total.labels,
        detections: total.detections,
        instance: total.score(),
        scene: Score::mean(&scenes.iter().map(|s| s.score).collect::<Vec<_>>()),
        scenes,
        clusters: clusters.into_iter().map(of_cluster).collect(),
    }
}

/// The cluster to which a wrong detection counts.
fn responsible(labels: &[Label], detection: &[DVec2]) -> Option<usize> {
    let center = |p: &[DVec2]| p.iter().sum::<DVec2>() / p.len().max(1) as f64;
    let key = |l: &Label| (iou(&l.polygon, detection), -center(&l.polygon).distance(center(detection)));
    let counted = labels.iter().filter(|l| !l.ignore && l.cluster.is_some());
    let best = counted.max_by(|a, b| {
        let (a, b) = (key(a), key(b));
        a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
    });
    best.and_then(|l| l.cluster)
}

#[cfg(test)]
mod tests {
    use super::super::polygon::tests::rectangle;
    use super::*;
    use proptest::prelude::*;

    fn label(x: f64, w: f64) -> Label {
        Label { polygon: rectangle(x, 0.0, w, 10.0), ignore: false, cluster: None }
    }

    fn image(scene: &str, labels: Vec<Label>, detections: Vec<Vec<DVec2>>) -> JudgedImage {
        JudgedImage { scene: scene.into(), labels, detections }
    }

    #[test]
    fn pairs_are_one_to_one_and_the_best_come_first() {
        let labels = [label(0.0, 20.0), label(100.0, 20.0)];
        // Two detections for one label: the closer one is right, whichever comes first.
        let detections = [rectangle(4.0, 0.0, 20.0, 10.0), rectangle(1.0, 0.0, 20.0, 10.0), rectangle(110.0, 0.0, 20.0, 10.0)];
        let found = matches(&labels, &detections);
        assert_eq!(found, Matches { of_label: vec![(0, Some(1)), (1, None)], wrong: vec![0, 2] });
        // An IoU of exactly a half is none.
        assert_eq!(matches(&[label(0.0, 10.0)], &[rectangle(0.0, 0.0, 20.0, 10.0)]).wrong, [0]);
    }

    #[test]
    fn what_lies_in_ignored_labels_does_not_count() {
        let labels = [label(0.0, 20.0), Label { ignore: true, ..label(40.0, 30.0) }];
        let detections = [rectangle(0.0, 0.0, 20.0, 10.0), rectangle(45.0, 0.0, 10.0, 10.0), rectangle(64.0, 0.0, 20.0, 10.0)];
        let e = evaluate(&[image("a", labels.to_vec(), detections.to_vec())]);
        assert_eq!((e.labels, e.detections), (1, 2), "the second detection is ignored, the third is 30 % inside");
        assert_eq!((e.instance.precision, e.instance.recall), (0.5, 1.0));
        assert!((e.instance.f - 2.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn scenes_are_means_of_means() {
        let hit = || image("a", vec![label(0.0, 20.0)], vec![rectangle(0.0, 0.0, 20.0, 10.0)]);
        let half = image("a", vec![label(0.0, 20.0), label(50.0, 20.0)], vec![rectangle(0.0, 0.0, 20.0, 10.0)]);
        let miss = image("b", vec![label(0.0, 20.0)], vec![]);
        let e = evaluate(&[hit(), half, miss]);
        // Instances: 2 of 2 detections, 2 of 4 labels.
        assert_eq!((e.instance.precision, e.instance.recall), (1.0, 0.5));
        // Scene a: precision 1, recall (1 + 0.5) / 2; scene b: nothing.
        assert_eq!(e.scenes[0].score, Score::of(1.0, 0.75));
        assert_eq!((e.scene.precision, e.scene.recall), (0.5, 0.375));
        assert!((e.scene.f - 3.0 / 7.0).abs() < 1e-12);
        // The figures of the paper's table: F of mean precision and mean recall.
        assert!((Score::of(0.7157, 0.4862).f - 0.5790).abs() < 5e-5);
    }

    #[test]
    fn clusters_have_their_own_labels_and_the_wrong_detections_near_them() {
        let of = |x, cluster| Label { cluster: Some(cluster), ..label(x, 20.0) };
        let detections = vec![rectangle(0.0, 0.0, 20.0, 10.0), rectangle(112.0, 0.0, 20.0, 10.0), rectangle(300.0, 0.0, 20.0, 10.0)];
        let e = evaluate(&[image("a", vec![of(0.0, 3), of(100.0, 5)], detections)]);
        let scores: Vec<_> = e.clusters.iter().map(|c| (c.cluster, c.labels, c.score.precision, c.score.recall)).collect();
        assert_eq!(scores, [(3, 1, 1.0, 1.0), (5, 1, 0.0, 0.0)]);
    }

    #[test]
    fn nothing_in_nothing_is_perfect_and_something_in_nothing_is_wrong() {
        let e = evaluate(&[image("a", vec![], vec![])]);
        assert_eq!(e.instance, Score::of(1.0, 1.0));
        let e = evaluate(&[image("a", vec![], vec![rectangle(0.0, 0.0, 5.0, 5.0)])]);
        assert_eq!(e.instance, Score::of(0.0, 1.0));
        assert_eq!(evaluate(&[]).scene.f, 0.0);
    }

    prop_compose! {
        fn any_rectangle()(x in 0.0..60.0f64, y in 0.0..40.0f64, w in 5.0..30.0f64, h in 5.0..20.0f64) -> Vec<DVec2> {
            rectangle(x, y, w, h)
        }
    }

    proptest! {
        #[test]
        fn orders_do_not_matter_and_counts_are_bounded(
            labels in prop::collection::vec((any_rectangle(), prop::bool::weighted(0.2)), 0..6),
            detections in prop::collection::vec(any_rectangle(), 0..6),
            turn in 0..6usize,
        ) {
            let labels: Vec<Label> = labels.into_iter().map(|(polygon, ignore)| Label { polygon, ignore, cluster: None }).collect();
            let score = |l: &[Label], d: &[Vec<DVec2>]| evaluate(&[image("a", l.to_vec(), d.to_vec())]);
            let e = score(&labels, &detections);
            let (mut l, mut d) = (labels.clone(), detections.clone());
            l.rotate_left(turn.min(labels.len()));
            d.rotate_left(turn.min(detections.len()));
            prop_assert_eq!(&e, &score(&l, &d));
            let s = e.instance;
            prop_assert!([s.precision, s.recall, s.f].iter().all(|v| (0.0..=1.0).contains(v)) && e.detections <= detections.len());
            // Labels as detections are all right, but where a label lies in one that is ignored.
            let same: Vec<Vec<DVec2>> = labels.iter().filter(|l| !l.ignore).map(|l| l.polygon.clone()).collect();
            let own = score(&labels, &same);
            prop_assert!(own.detections == 0 || own.instance.precision == 1.0);
        }
    }
}
