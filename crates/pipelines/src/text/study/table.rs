//! Tables of scores of detectors: means and ranges over seeds, beside the paper's figures.

use crate::text::detectors::config::Kind;
use crate::text::detectors::evaluation::Score;
use crate::text::detectors::judge::Judged;
use serde::{Deserialize, Serialize};

/// Precision, recall and F in percent.
pub type Percent = [f64; 3];

/// Scores of a detector on a test set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Judgement {
    pub images: usize,
    /// Labels and detections that count.
    pub labels: usize,
    pub detections: usize,
    /// Over all instances, and means over scenes of means over their images.
    pub instance: Percent,
    pub scene: Percent,
}

impl Judgement {
    pub fn of(judged: &Judged) -> Judgement {
        let percent = |s: &Score| [s.precision, s.recall, s.f].map(|v| 100.0 * v);
        let e = &judged.evaluation;
        Judgement { images: e.images, labels: e.labels, detections: e.detections, instance: percent(&e.instance), scene: percent(&e.scene) }
    }
}

/// A detector that was trained on a set and judged on a test set.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Trial {
    pub model: Kind,
    pub set: &'static str,
    pub seed: u64,
    /// What its training took.
    pub steps: u64,
    pub seconds: f64,
    pub test: &'static str,
    pub judgement: Judgement,
}

/// Mean, least and greatest of values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    pub mean: f64,
    pub least: f64,
    pub greatest: f64,
}

impl Spread {
    /// Of values, of which there is at least one.
    pub fn of(values: &[f64]) -> Spread {
        Spread {
            mean: values.iter().sum::<f64>() / values.len() as f64,
            least: values.iter().copied().fold(f64::INFINITY, f64::min),
            greatest: values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        }
    }

    /// `64.2 (61.0 to 67.4)`.
    fn text(&self) -> String {
        format!("{:.1} ({:.1} to {:.1})", self.mean, self.least, self.greatest)
    }

    /// The same with signs.
    fn signed(&self) -> String {
        format!("{:+.1} ({:+.1} to {:+.1})", self.mean, self.least, self.greatest)
    }
}

/// Trials of a model on a set, judged on a test set, by seed.
pub fn trials<'a>(all: &'a [Trial], model: Kind, set: &str, test: &str) -> Vec<&'a Trial> {
    let mut out: Vec<&Trial> = all.iter().filter(|t| t.model == model && t.set == set && t.test == test).collect();
    out.sort_by_key(|t| t.seed);
    out
}

/// Spreads over seeds of precision, recall and F by instance, then by scene.
pub fn spreads(trials: &[&Trial]) -> [Spread; 6] {
    let of = |k: usize| trials.iter().map(|t| value(t, k)).collect::<Vec<f64>>();
    std::array::from_fn(|k| Spread::of(&of(k)))
}

/// Spreads of what a model has more on one set than on another with the same seed.
pub fn differences(more: &[&Trial], less: &[&Trial]) -> [Spread; 6] {
    let pairs = || more.iter().flat_map(|a| less.iter().filter(|b| b.seed == a.seed).map(move |b| (a, b)));
    std::array::from_fn(|k| Spread::of(&pairs().map(|(a, b)| value(a, k) - value(b, k)).collect::<Vec<f64>>()))
}

fn value(trial: &Trial, k: usize) -> f64 {
    let j = &trial.judgement;
    if k < 3 { j.instance[k] } else { j.scene[k - 3] }
}

/// Heads of a table of such spreads.
pub const HEADS: &str = "| | P | R | F | P by scene | R by scene | F by scene | steps |\n|---|---|---|---|---|---|---|---|\n";

/// A remark on scores by scene.
pub const EMPTY: &str = "- an image without a word to be read counts as right by scene if nothing is found in it\n";

/// Row of a table with [`HEADS`].
pub fn row(name: &str, trials: &[&Trial]) -> String {
    let cells: String = spreads(trials).iter().map(|s| format!(" {} |", s.text())).collect();
    let steps = || trials.iter().map(|t| t.steps);
    let (least, most) = (steps().min().unwrap_or(0), steps().max().unwrap_or(0));
    let steps = if least == most { least.to_string() } else { format!("{least} to {most}") };
    format!("| {name} |{cells} {steps} |\n")
}

/// Row of [`differences`].
pub fn difference_row(name: &str, more: &[&Trial], less: &[&Trial]) -> String {
    let cells: String = differences(more, less).iter().map(|s| format!(" {} |", s.signed())).collect();
    format!("| {name} |{cells} |\n")
}

/// Row of published figures, by instance and by scene.
pub fn paper_row(name: &str, figures: [Percent; 2]) -> String {
    let cells: String = figures.iter().flatten().map(|v| format!(" {v:.2} |")).collect();
    format!("| {name} |{cells} |\n")
}

/// Row of what published figures have more than others.
pub fn paper_difference_row(name: &str, more: [Percent; 2], less: [Percent; 2]) -> String {
    let cells: String = more.iter().flatten().zip(less.iter().flatten()).map(|(a, b)| format!(" {:+.2} |", a - b)).collect();
    format!("| {name} |{cells} |\n")
}

/// "1 scene", "2 scenes".
pub fn many(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use crate::text::detectors::evaluation::{JudgedImage, Label, evaluate};
    use crate::text::detectors::polygon::tests::rectangle;

    pub fn trial(model: Kind, set: &'static str, seed: u64, instance: Percent) -> Trial {
        let judgement = Judgement { images: 4, labels: 9, detections: 8, instance, scene: instance.map(|v| v - 5.0) };
        Trial { model, set, seed, steps: 100 + seed, seconds: 7.0, test: "test", judgement }
    }

    #[test]
    fn rows_have_means_and_ranges_of_known_evaluations() {
        let all = [
            trial(Kind::Db, "random", 1, [60.0, 40.0, 48.0]),
            trial(Kind::Db, "balanced", 0, [80.0, 70.0, 74.7]),
            trial(Kind::Db, "random", 0, [50.0, 50.0, 50.0]),
            trial(Kind::Db, "balanced", 1, [82.0, 60.0, 69.3]),
            trial(Kind::East, "random", 0, [1.0, 2.0, 3.0]),
        ];
        let of = |set: &str| trials(&all, Kind::Db, set, "test");
        assert_eq!(of("random").iter().map(|t| t.seed).collect::<Vec<_>>(), [0, 1]);
        let expected = "| DB random | 55.0 (50.0 to 60.0) | 45.0 (40.0 to 50.0) | 49.0 (48.0 to 50.0) | 50.0 (45.0 to 55.0) | \
                        40.0 (35.0 to 45.0) | 44.0 (43.0 to 45.0) | 100 to 101 |\n";
        assert_eq!(row("DB random", &of("random")), expected);
        // Of the same seeds: 74.7 − 50 and 69.3 − 48.
        let f = differences(&of("balanced"), &of("random"))[2];
        assert!((f.mean - 23.0).abs() < 1e-9 && (f.least - 21.3).abs() < 1e-9 && (f.greatest - 24.7).abs() < 1e-9, "{f:?}");
        let text = difference_row("difference", &of("balanced"), &of("random"));
        assert!(text.starts_with("| difference | +26.0 (+22.0 to +30.0) | +20.0 (+20.0 to +20.0) | +23.0 (+21.3 to +24.7) |"), "{text}");
        let columns = |line: &str| line.matches('|').count();
        let heads = HEADS.lines().next().unwrap();
        assert!([expected, &text, &paper_row("paper", [[1.0; 3]; 2])].iter().all(|line| columns(line) == columns(heads)));
    }

    #[test]
    fn judgements_are_percent_of_the_evaluation() {
        let label = |x: f64| Label { polygon: rectangle(x, 0.0, 20.0, 10.0), ignore: false, cluster: None };
        let image = |scene: &str, labels: Vec<Label>, found: &[f64]| {
            let detections = found.iter().map(|x| rectangle(*x, 0.0, 20.0, 10.0)).collect();
            JudgedImage { scene: scene.into(), labels, detections }
        };
        // Three of four labels are found, and one detection is wrong; scene a: P 1, R 1; scene b: P 2/3, R 2/3.
        let images = [image("a", vec![label(0.0)], &[0.0]), image("b", vec![label(0.0), label(40.0), label(80.0)], &[0.0, 40.0, 120.0])];
        let evaluation = evaluate(&images);
        let det_eval = evaluation.instance;
        let j = Judgement::of(&Judged { evaluation, det_eval, images_per_s: 1.0 });
        assert_eq!((j.images, j.labels, j.detections), (2, 4, 4));
        assert_eq!(j.instance, [75.0; 3]);
        assert!(j.scene.iter().all(|v| (v - 250.0 / 3.0).abs() < 1e-9), "{:?}", j.scene);
    }
}
