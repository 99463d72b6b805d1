//! Named figures of a run. An application reports whatever it measures by a name of its own; the terminal, the log and the viewer show
//! it without knowing the name.

use crate::metrics;
use std::borrow::Cow;

/// Names of the log's own columns.
const RESERVED: [&str; 3] = ["step", "seconds", "loss"];

/// What the log puts before the names of [`Scores`].
pub const SCORE_PREFIX: &str = "val_";

/// A named figure of a step or of an evaluation, for example `mse`, `accuracy` or `albedo_psnr`.
#[derive(Clone, Debug, PartialEq)]
pub struct Scalar {
    /// Lower case with underscores. Its end gives the unit, see [`unit()`].
    pub name: Cow<'static, str>,
    pub value: f64,
    pub over_steps: OverSteps,
    /// Whether the terminal shows it; the log has it in any case.
    pub is_shown: bool,
}

/// How the values of a logging interval's steps become one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OverSteps {
    Mean,
    /// `−10 log₁₀` of the mean of squared errors, dB.
    PsnrOfMean,
    /// Sum over the seconds of the interval.
    Rate,
    /// The last value, which is a whole number: a count since the start of the run.
    Count,
}

impl Scalar {
    /// A figure that is averaged over steps.
    ///
    /// # Panics
    /// When the name is a column of the log's own (`step`, `seconds`, `loss`, `val_…`) or has other characters than `a-z0-9_`.
    pub fn new(name: impl Into<Cow<'static, str>>, value: f64) -> Scalar {
        let name = name.into();
        let is_spelled_well = !name.is_empty() && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
        assert!(is_spelled_well && !RESERVED.contains(&&*name) && !name.starts_with(SCORE_PREFIX), "{name:?} cannot be a figure's name");
        Scalar { name, value, over_steps: OverSteps::Mean, is_shown: true }
    }

    /// The PSNR in dB of a mean squared error; over steps it is that of the mean error.
    ///
    /// # Panics
    /// As [`Scalar::new`].
    pub fn psnr(name: impl Into<Cow<'static, str>>, mse: f64) -> Scalar {
        Scalar { over_steps: OverSteps::PsnrOfMean, ..Scalar::new(name, mse) }
    }

    /// An amount per second; the name should end in `_per_s`.
    ///
    /// # Panics
    /// As [`Scalar::new`].
    pub fn rate(name: impl Into<Cow<'static, str>>, amount: f64) -> Scalar {
        Scalar { over_steps: OverSteps::Rate, ..Scalar::new(name, amount) }
    }

    /// A count since the start of the run, which is logged only.
    ///
    /// # Panics
    /// As [`Scalar::new`].
    pub fn count(name: impl Into<Cow<'static, str>>, total: u64) -> Scalar {
        Scalar { over_steps: OverSteps::Count, is_shown: false, ..Scalar::new(name, total as f64) }
    }

    /// The same figure, left out in the terminal.
    #[must_use]
    pub fn logged_only(self) -> Scalar {
        Scalar { is_shown: false, ..self }
    }

    /// Adds the value of a later step.
    pub(super) fn add(&mut self, later: f64) {
        match self.over_steps {
            OverSteps::Count => self.value = later,
            OverSteps::Mean | OverSteps::PsnrOfMean | OverSteps::Rate => self.value += later,
        }
    }

    /// Value over `steps` steps that took `seconds`, of what [`Scalar::add`] gathered.
    pub(super) fn over(self, steps: u64, seconds: f64) -> Scalar {
        let value = match self.over_steps {
            OverSteps::Mean => self.value / steps as f64,
            OverSteps::PsnrOfMean => metrics::psnr(self.value / steps as f64),
            OverSteps::Rate => self.value / seconds,
            OverSteps::Count => self.value,
        };
        Scalar { value, ..self }
    }
}

/// Named figures, in the order in which they are shown.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scalars(pub Vec<Scalar>);

/// Figures of an evaluation, on data that was held out of training. An evaluation counts as one step.
pub type Scores = Scalars;

impl Scalars {
    /// The value of a figure; none where there is none of that name.
    pub fn get(&self, name: &str) -> Option<f64> {
        self.0.iter().find(|s| s.name == name).map(|s| s.value)
    }

    /// Figures for the terminal.
    pub fn shown(&self) -> impl Iterator<Item = &Scalar> {
        self.0.iter().filter(|s| s.is_shown)
    }
}

impl<const N: usize> From<[Scalar; N]> for Scalars {
    fn from(all: [Scalar; N]) -> Scalars {
        Scalars(all.into())
    }
}

/// Unit that the end of a figure's name gives: `psnr` is in dB, `rays_per_s` per second, `_secs`, `_bytes`, `_m` and `_px` are what they
/// say, everything else has none.
pub fn unit(name: &str) -> &'static str {
    let ends = [("psnr", "dB"), ("_per_s", "/s"), ("_secs", "s"), ("_bytes", "B"), ("_m", "m"), ("_px", "px")];
    ends.iter().find(|(end, _)| name.ends_with(end)).map_or("", |(_, unit)| unit)
}

/// A figure's name in words, without its unit.
pub fn label(name: &str) -> String {
    let (words, held_out) = name.strip_prefix(SCORE_PREFIX).map_or((name, ""), |rest| (rest, "held out "));
    let without_unit = ["_per_s", "_secs", "_bytes", "_m", "_px"].iter().find_map(|end| words.strip_suffix(end));
    format!("{held_out}{}", without_unit.unwrap_or(words).replace('_', " "))
}

/// A figure's value with four digits that count, or all before the point, and its unit.
pub fn text(name: &str, value: f64) -> String {
    let magnitude = if value == 0.0 { 3.0 } else { value.abs().log10().floor() };
    let decimals = (3.0 - magnitude).clamp(0.0, 9.0) as usize;
    let unit = unit(name);
    let space = if unit.is_empty() || unit == "/s" { "" } else { " " };
    format!("{value:.decimals$}{space}{unit}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_steps_become_one() {
        let over = |mut s: Scalar| {
            s.add(0.3);
            s.over(2, 4.0).value
        };
        assert_eq!(over(Scalar::new("accuracy", 0.1)), 0.2);
        assert!((over(Scalar::psnr("albedo_psnr", -0.1)) - 10.0).abs() < 1e-9);
        assert_eq!(over(Scalar::rate("words_per_s", 0.1)), 0.1);
        assert_eq!(over(Scalar::count("words", 7)), 0.3);
    }

    #[test]
    fn names_tell_label_and_unit() {
        let shown = |name: &str, value: f64| format!("{} {}", label(name), text(name, value));
        assert_eq!(shown("albedo_psnr", 23.456), "albedo psnr 23.46 dB");
        assert_eq!(shown("val_psnr", 9.0), "held out psnr 9.000 dB");
        assert_eq!(shown("rays_per_s", 45123.4), "rays 45123/s");
        assert_eq!(shown("accuracy", 0.97312), "accuracy 0.9731");
        assert_eq!(shown("loss", 0.0123456), "loss 0.01235");
        assert_eq!(shown("edge_m", 0.0), "edge 0 m");
    }

    #[test]
    fn columns_of_the_log_are_no_names() {
        for name in ["loss", "step", "val_psnr", "PSNR", ""] {
            assert!(std::panic::catch_unwind(|| Scalar::new(name, 1.0)).is_err(), "{name:?}");
        }
        assert_eq!(Scalars::from([Scalar::new("losses", 1.0)]).get("losses"), Some(1.0));
    }
}
