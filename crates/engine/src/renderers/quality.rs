//! Quality presets of views.

use crate::fields::Pruning;

/// How exactly a view is rendered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Quality {
    /// Every pixel is traced until a thousandth of the light is left, no sample that light reaches is left out.
    #[default]
    Full,
    /// For previews: rays end earlier, faint samples and pixels between like neighbours are left out.
    Fast,
}

impl Quality {
    /// Samples that a view leaves out.
    pub fn pruning(self) -> Pruning {
        match self {
            Quality::Full => Pruning { stop: 1e-3, min_alpha: 0.0, thin: f32::INFINITY, min_weight: 0.0 },
            Quality::Fast => Pruning { stop: 3e-2, min_alpha: 1e-2, thin: f32::INFINITY, min_weight: 1e-2 },
        }
    }

    /// The [`super::volume::Tracer::shared_weight`].
    pub fn shared_weight(self) -> f32 {
        match self {
            Quality::Full => 1.0 / 16.0,
            Quality::Fast => 1.0 / 8.0,
        }
    }

    /// The [`super::volume::Tracer::tolerance`].
    pub fn tolerance(self) -> f32 {
        match self {
            Quality::Full => 0.0,
            Quality::Fast => 0.05,
        }
    }
}

impl std::str::FromStr for Quality {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        match s {
            "full" => Ok(Quality::Full),
            "fast" => Ok(Quality::Fast),
            _ => Err(format!("quality {s:?}: expected full or fast")),
        }
    }
}
