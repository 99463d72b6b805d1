//! Where text is in images and how large: the default, or what labels of a user's images say.

use crate::error::Result;
use diorama_data::text_labels::LabelledImage;
use diorama_data::{DataError, atomic, error};
use diorama_geom::rng::Rng;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;

/// Cells along an axis of the histogram of centers.
pub const CELLS: usize = 32;
/// The default: share of centers around the middle, their deviation in widths and heights, and area ratios.
const AROUND: f64 = 0.8;
const DEVIATION: [f64; 2] = [0.22, 0.18];
const AREAS: [f64; 2] = [0.003, 0.15];
/// Area ratios that are kept.
const MOST_AREAS: usize = 4096;
const LIMIT: u64 = 1 << 26;

/// Distribution of text in images.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Prior {
    /// Regions that it was made of; 0: the default.
    pub regions: usize,
    /// Number of centers in each cell, rows from the top, `[CELLS, CELLS]`.
    pub centers: Vec<f64>,
    /// Areas over those of the images, ascending, at equal steps of probability.
    pub areas: Vec<f64>,
}

impl Prior {
    /// Statistics of labels of images of known sizes.
    pub fn of(images: &[LabelledImage], sizes: &HashMap<String, (u32, u32)>) -> Prior {
        let mut out = Prior { regions: 0, centers: vec![0.0; CELLS * CELLS], areas: Vec::new() };
        for image in images {
            let Some((w, h)) = sizes.get(&image.image) else { continue };
            for region in image.regions.iter().filter(|r| !r.ignore) {
                let n = region.polygon.len() as f64;
                let middle = [0, 1].map(|k| region.polygon.iter().map(|p| p[k]).sum::<f64>() / n);
                let cell = |v: f64, of: u32| ((v / of as f64 * CELLS as f64) as usize).min(CELLS - 1);
                out.centers[cell(middle[1], *h) * CELLS + cell(middle[0], *w)] += 1.0;
                out.areas.push(super::super::label::in_view::area(&region.polygon).abs() / (*w as f64 * *h as f64));
                out.regions += 1;
            }
        }
        out.areas.sort_by(f64::total_cmp);
        if out.areas.len() > MOST_AREAS {
            let last = out.areas.len() - 1;
            out.areas = (0..MOST_AREAS).map(|k| out.areas[k * last / (MOST_AREAS - 1)]).collect();
        }
        out
    }

    /// # Errors
    /// When the file is missing or no prior.
    pub fn read(path: &Path) -> Result<Prior> {
        let bytes = error::read(path, LIMIT)?;
        let wrong = |e: String| DataError::input(path, format!("{e}; make it with `diorama text prior`"));
        let prior: Prior = serde_json::from_slice(&bytes).map_err(|e| wrong(e.to_string()))?;
        let is_weight = |v: &f64| v.is_finite() && *v >= 0.0;
        let is_ratio = |v: &f64| *v > 0.0 && *v <= 1.0;
        let sound = prior.centers.len() == CELLS * CELLS
            && prior.centers.iter().all(is_weight)
            && prior.centers.iter().sum::<f64>() > 0.0
            && !prior.areas.is_empty()
            && prior.areas.iter().all(is_ratio)
            && prior.areas.is_sorted();
        if !sound {
            return Err(wrong(format!("expected {CELLS} × {CELLS} counts and ascending area ratios from 0 to 1")).into());
        }
        Ok(prior)
    }

    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<()> {
        Ok(atomic::write(path, &serde_json::to_vec(self).expect("plain values"))?)
    }

    fn is_default(&self) -> bool {
        self.regions == 0
    }

    /// A center in widths and heights from the upper left, of four random numbers from `counter` on.
    pub fn center(&self, rng: &Rng, counter: u64) -> [f64; 2] {
        let u = |k: u64| rng.uniform(counter + k) as f64;
        if self.is_default() {
            if u(0) >= AROUND {
                return [u(1), u(2)];
            }
            return [0, 1].map(|k| (0.5 + DEVIATION[k] * rng.normal(counter + 1 + k as u64) as f64).clamp(0.0, 1.0));
        }
        let mut left = u(0) * self.centers.iter().sum::<f64>();
        let cell = self.centers.iter().position(|w| {
            left -= w;
            left < 0.0
        });
        let cell = cell.unwrap_or_else(|| self.centers.iter().rposition(|w| *w > 0.0).unwrap_or(0));
        [((cell % CELLS) as f64 + u(1)) / CELLS as f64, ((cell / CELLS) as f64 + u(2)) / CELLS as f64]
    }

    /// An area ratio of one random number.
    pub fn area(&self, rng: &Rng, counter: u64) -> f64 {
        let u = rng.uniform(counter) as f64;
        if self.is_default() {
            return AREAS[0] * (AREAS[1] / AREAS[0]).powf(u);
        }
        let at = u * (self.areas.len() - 1) as f64;
        let k = (at as usize).min(self.areas.len().saturating_sub(2));
        let next = self.areas.get(k + 1).copied().unwrap_or(self.areas[k]);
        self.areas[k] + (at - k as f64) * (next - self.areas[k])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diorama_data::text_labels::{Kind, LabelledRegion};

    #[test]
    fn draws_follow_the_labels() {
        let region = |x: f64, y: f64, w: f64, h: f64| LabelledRegion {
            id: 0,
            polygon: vec![[x, y], [x + w, y], [x + w, y + h], [x, y + h]],
            transcription: "A".into(),
            script: None,
            kind: Kind::Text,
            ignore: false,
        };
        let image = LabelledImage { image: "a.png".into(), regions: vec![region(90.0, 4.0, 8.0, 4.0), region(4.0, 60.0, 20.0, 30.0)] };
        let prior = Prior::of(&[image], &HashMap::from([("a.png".to_string(), (100, 100))]));
        assert_eq!((prior.regions, &prior.areas[..]), (2, &[0.0032, 0.06][..]));
        let rng = Rng::new(3, 0);
        let n = 2000;
        let mut upper = 0;
        for i in 0..n {
            let [x, y] = prior.center(&rng, 8 * i);
            let is_upper = y < 0.1;
            assert!(if is_upper { (0.9..0.97).contains(&x) } else { (0.1..0.19).contains(&x) && (0.7..0.8).contains(&y) }, "{x} {y}");
            upper += is_upper as u64;
            assert!((0.0032..=0.06).contains(&prior.area(&rng, 8 * i + 4)));
        }
        assert!((900..1100).contains(&upper));
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("prior.json");
        prior.save(&file).unwrap();
        assert_eq!(Prior::read(&file).unwrap(), prior);
        std::fs::write(&file, r#"{"regions":1,"centers":[1],"areas":[0.1]}"#).unwrap();
        let e = Prior::read(&file).unwrap_err();
        assert!(e.is_input() && e.to_string().contains("prior.json: expected 32 × 32 counts"), "{e}");
    }

    #[test]
    fn the_default_is_mostly_around_the_middle_and_logarithmic_in_area() {
        let (prior, rng) = (Prior::default(), Rng::new(5, 1));
        let n = 4000u64;
        let centers: Vec<[f64; 2]> = (0..n).map(|i| prior.center(&rng, 8 * i)).collect();
        let near = centers.iter().filter(|c| (c[0] - 0.5).abs() < 0.22 && (c[1] - 0.5).abs() < 0.18).count() as f64 / n as f64;
        // 0.8 · 0.683² + 0.2 · 0.44 · 0.36
        assert!((near - 0.405).abs() < 0.03, "{near}");
        let mut areas: Vec<f64> = (0..n).map(|i| prior.area(&rng, 8 * i + 5)).collect();
        areas.sort_by(f64::total_cmp);
        assert!((areas[n as usize / 2].ln() - (0.003f64 * 0.15).ln() / 2.0).abs() < 0.1);
    }
}
