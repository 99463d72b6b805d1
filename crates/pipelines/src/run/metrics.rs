//! Metrics of a run over its steps: `metrics.jsonl`, and the curves that are drawn of it. Which figures there are, only the run knows.

use diorama_data::plot::{Chart, Series};
use diorama_data::tfevents::TfEvents;
use diorama_engine::train::scalar::{self, SCORE_PREFIX};
use diorama_engine::train::{Event, Scalar, Scalars};
use serde_json::{Map, Value};
use std::collections::BTreeSet;
use std::path::Path;

/// File of the metrics.
pub const NAME: &str = "metrics.jsonl";

/// One line of `metrics.jsonl`.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Row {
    pub step: u64,
    pub seconds: f64,
    /// Numbers by name: the loss, the figures of steps, and those of evaluations after [`SCORE_PREFIX`]. Counts are whole numbers.
    #[serde(flatten)]
    pub figures: Map<String, Value>,
}

impl Row {
    /// The row of an event that has figures; figures that are not finite are left out.
    pub fn of(event: &Event) -> Option<Row> {
        let (step, seconds, loss, prefix, Scalars(scalars)) = match event {
            Event::Progress { step, seconds, loss, scalars, .. } => (*step, *seconds, Some(*loss), "", scalars),
            Event::Evaluated { step, seconds, scores } => (*step, *seconds, None, SCORE_PREFIX, scores),
            _ => return None,
        };
        let number = |s: &Scalar| match s.over_steps {
            scalar::OverSteps::Count => Some(Value::from(s.value as u64)),
            _ => s.value.is_finite().then(|| s.value.into()),
        };
        let scalars = scalars.iter().filter_map(|s| Some((format!("{prefix}{}", s.name), number(s)?)));
        let loss = loss.filter(|l| l.is_finite()).map(|l| ("loss".to_string(), l.into()));
        Some(Row { step, seconds, figures: loss.into_iter().chain(scalars).collect() })
    }

    /// The value of a figure, if the row has it.
    pub fn get(&self, name: &str) -> Option<f64> {
        self.figures.get(name).and_then(Value::as_f64)
    }

    /// The row as a line of JSON.
    pub fn line(&self) -> String {
        format!("{}\n", serde_json::to_string(self).expect("a row is JSON"))
    }

    /// Writes the row's values as scalars: those of steps below `train/`, those of evaluations below `val/`.
    ///
    /// # Errors
    /// When they cannot be written.
    pub fn to_tensorboard(&self, t: &mut TfEvents) -> std::io::Result<()> {
        for (name, value) in &self.figures {
            let tag = name.strip_prefix(SCORE_PREFIX).map_or_else(|| format!("train/{name}"), |score| format!("val/{score}"));
            if let Some(v) = value.as_f64() {
                t.scalar(&tag, self.step, self.seconds, v as f32)?;
            }
        }
        Ok(())
    }
}

/// The metrics of a run, without lines that a crash cut short.
pub fn read_rows(path: &Path) -> Vec<Row> {
    let text = std::fs::read_to_string(path.join(NAME)).unwrap_or_default();
    text.lines().filter_map(|l| serde_json::from_str(l).ok()).collect()
}

/// Steps and values of a figure.
pub fn curve(rows: &[Row], name: &str) -> Vec<(u64, f64)> {
    rows.iter().filter_map(|r| r.get(name).map(|v| (r.step, v))).collect()
}

/// A chart for each figure of named runs, with what was held out beside what was trained on; none for counts and rates.
pub fn charts(runs: &[(String, Vec<Row>)]) -> Vec<Chart> {
    let figures = runs.iter().flat_map(|(_, rows)| rows).flat_map(|r| &r.figures);
    let curves = figures.filter(|(name, value)| value.is_f64() && scalar::unit(name) != "/s");
    let names: BTreeSet<&str> = curves.map(|(name, _)| name.strip_prefix(SCORE_PREFIX).unwrap_or(name)).collect();
    let series = |name: String, suffix: &str| -> Vec<Series> {
        let of = |(run, rows): &(String, Vec<Row>)| Series {
            name: format!("{run}{suffix}"),
            points: curve(rows, &name).into_iter().map(|(step, v)| (step as f64, v)).collect(),
        };
        runs.iter().map(of).filter(|s| !s.points.is_empty()).collect()
    };
    let chart = |name: &str| {
        let mut both = series(name.to_string(), " train");
        both.extend(series(format!("{SCORE_PREFIX}{name}"), " held out"));
        Chart { title: scalar::label(name), x: "step".into(), y: scalar::unit(name).into(), series: both }
    };
    names.into_iter().map(chart).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_engine::train::Scores;

    #[test]
    fn figures_that_only_one_application_has_are_logged_and_drawn() {
        let scalars = Scalars::from([Scalar::new("accuracy", 0.5), Scalar::count("words", 7), Scalar::new("mse", f64::NAN)]);
        let progress = Event::Progress { step: 3, seconds: 1.5, progress: 0.1, loss: 2.0, scalars };
        let scores = Scores::from([Scalar::new("albedo_psnr", 21.5)]);
        let rows = [progress, Event::Evaluated { step: 4, seconds: 2.0, scores }].map(|e| Row::of(&e).unwrap());
        assert_eq!(rows[0].line(), "{\"step\":3,\"seconds\":1.5,\"loss\":2.0,\"accuracy\":0.5,\"words\":7}\n");
        assert_eq!(rows[1].line(), "{\"step\":4,\"seconds\":2.0,\"val_albedo_psnr\":21.5}\n");
        let back: Vec<Row> = rows.iter().map(|r| serde_json::from_str(&r.line()).unwrap()).collect();
        assert_eq!(back, rows);
        let charts = charts(&[("a".into(), back)]);
        let titles: Vec<(&str, &str, &str)> = charts.iter().map(|c| (&c.title[..], &c.y[..], &c.series[0].name[..])).collect();
        assert_eq!(titles, [("accuracy", "", "a train"), ("albedo psnr", "dB", "a held out"), ("loss", "", "a train")]);
    }

    #[test]
    fn lines_of_earlier_versions_are_read() {
        let old = r#"{"step":10,"seconds":0.5,"loss":0.1,"mse":null,"psnr":null,"rays":640,"samples":9000,"rays_per_s":1280.0}"#;
        let row: Row = serde_json::from_str(old).unwrap();
        assert_eq!((row.get("loss"), row.get("mse"), row.get("samples")), (Some(0.1), None, Some(9000.0)));
    }
}
