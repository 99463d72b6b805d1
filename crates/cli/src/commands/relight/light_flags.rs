//! Options that describe distant light.

use crate::commands::process::usage;
use clap::Args;
use diorama_pipelines::Result;
use diorama_pipelines::relight::light::LightOptions;

const DEFAULT: &str = "sky:35,140";

#[derive(Args, Clone, Debug)]
pub struct LightFlags {
    /// Environment map (.hdr, .exr, or .png and .jpg of a probe), spherical harmonics (.txt), sky:ELEVATION,ROTATION in degrees, or uniform
    #[arg(long, default_value = DEFAULT)]
    light: String,
    /// Turn of the light about the vertical in degrees, counterclockwise from above
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true)]
    rotate: f64,
    /// Factor of the light [default: 1; skies: 0.02]
    #[arg(long)]
    strength: Option<f64>,
    /// A sun besides: AZIMUTH,ELEVATION in degrees and POWER, the irradiance of a surface that faces it
    #[arg(long, allow_hyphen_values = true)]
    sun: Option<String>,
}

impl LightFlags {
    /// Whether the user said anything about light.
    pub fn is_given(&self) -> bool {
        self.light != DEFAULT || self.rotate != 0.0 || self.strength.is_some() || self.sun.is_some()
    }

    /// The light as described.
    ///
    /// # Errors
    /// When an option is not of its form.
    pub fn options(&self) -> Result<LightOptions> {
        let source = self.light.parse().map_err(|e: String| usage(format!("light {e}")))?;
        // The radiance of a sky is in watts: 0.02 makes a white surface in the sun about as bright as a white pixel.
        let strength = self.strength.unwrap_or(if self.light.starts_with("sky:") { 0.02 } else { 1.0 });
        let sun = self.sun.as_deref().map(|text| {
            let numbers: Vec<f64> = text.split(',').filter_map(|n| n.trim().parse().ok()).collect();
            <[f64; 3]>::try_from(numbers).map_err(|_| usage(format!("sun {text:?}: expected AZIMUTH,ELEVATION,POWER")))
        });
        Ok(LightOptions { source, rotate_deg: self.rotate, strength, sun: sun.transpose()? })
    }
}
