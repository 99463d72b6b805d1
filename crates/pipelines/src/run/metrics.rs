//! Metrics of a run over its steps: `metrics.jsonl`, and the curves that are drawn of it.

use diorama_data::plot::{Chart, Series};
use diorama_data::tfevents::TfEvents;
use diorama_engine::train::Event;
use std::path::Path;

/// File of the metrics.
pub const NAME: &str = "metrics.jsonl";

/// One line of `metrics.jsonl`.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Row {
    pub step: u64,
    pub seconds: f64,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub loss: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mse: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub psnr: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub rays: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub samples: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub rays_per_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub val_psnr: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub val_mse: Option<f64>,
}

impl Row {
    /// What an event says of a step; none of events that say nothing of it.
    pub fn of(event: &Event) -> Option<Row> {
        match *event {
            Event::Progress { step, seconds, loss, mse, psnr, rays, samples, rays_per_s, .. } => Some(Row {
                step,
                seconds,
                loss: Some(loss),
                mse: Some(mse),
                psnr: Some(psnr),
                rays: Some(rays),
                samples: Some(samples),
                rays_per_s: Some(rays_per_s),
                ..Row::default()
            }),
            Event::Evaluated { step, seconds, psnr, mse, .. } => {
                Some(Row { step, seconds, val_psnr: Some(psnr), val_mse: Some(mse), ..Row::default() })
            }
            _ => None,
        }
    }

    /// The row as a line of JSON.
    pub fn line(&self) -> String {
        format!("{}\n", serde_json::to_string(self).expect("a row is JSON"))
    }

    /// Writes the row's values as scalars.
    ///
    /// # Errors
    /// When they cannot be written.
    pub fn to_tensorboard(&self, t: &mut TfEvents) -> std::io::Result<()> {
        let tags = [
            ("train/loss", self.loss),
            ("train/mse", self.mse),
            ("train/psnr", self.psnr),
            ("train/rays_per_s", self.rays_per_s),
            ("val/psnr", self.val_psnr),
            ("val/mse", self.val_mse),
        ];
        for (tag, value) in tags {
            if let Some(v) = value {
                t.scalar(tag, self.step, self.seconds, v as f32)?;
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

/// PSNR and MSE curves of named runs; held-out values where there are any.
pub fn charts(runs: &[(String, Vec<Row>)]) -> Vec<Chart> {
    let series = |f: fn(&Row) -> Option<f64>, suffix: &str| -> Vec<Series> {
        runs.iter()
            .map(|(name, rows)| Series {
                name: format!("{name}{suffix}"),
                points: rows.iter().filter_map(|r| f(r).map(|v| (r.step as f64, v))).collect(),
            })
            .filter(|s| !s.points.is_empty())
            .collect()
    };
    let both = |train: fn(&Row) -> Option<f64>, val: fn(&Row) -> Option<f64>| {
        let mut s = series(train, " train");
        s.extend(series(val, " held out"));
        s
    };
    vec![
        Chart { title: "PSNR".into(), x: "step".into(), y: "dB".into(), series: both(|r| r.psnr, |r| r.val_psnr) },
        Chart { title: "MSE".into(), x: "step".into(), y: "mean squared error".into(), series: both(|r| r.mse, |r| r.val_mse) },
    ]
}
